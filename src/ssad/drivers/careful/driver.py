"""Careful models as driving systems: keep route and speed, and brake when the model demands it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Observation
from ssad.core.types import F32, F64, Bool, Controller, Episode, SignalState
from ssad.drivers.careful.encounter import Encounter
from ssad.drivers.careful.models import CarefulModel, Reaction, careful_model, initial_reaction, react
from ssad.drivers.careful.sight import BEYOND, Path, encounters
from ssad.drivers.careful.steering import pursue
from ssad.world.models import agent_model

STEP = 0.1  # s, of the world
REACH = 100.0  # m that it sees
FAST = 27.0  # m/s: who aims for more than any town's limit sees as far as it needs to stop at EASY
BEND = 2.5  # m/s^2, lateral acceleration in bends
EASY = 2.0  # m/s^2, braking before bends and for red lights
PULL = 2.0  # m/s^2, acceleration to its target speed
WAIT = 3.0  # m to a standing agent in its path at which it stays standing
SOON = 3.0  # s to a conflict within which it does not accelerate
CROSSING = 10.0  # m ahead within which a standing driver lets others cross
RESPONSE = 0.5  # s, time constant with which its speed follows a change
APPROACH = 1.0  # m/s^2, braking with which it comes to its following gap
OPENING = 0.3  # 1/s, share of a missing gap by which it is slower than the vehicle in front


class Careful:
    """A careful driver of the regulation literature, at the wheel.

    It keeps its route at its target speed, slower in bends, and stops at red lights. Of others it knows what is in line
    of sight; it brakes for them as its model says, keeps the following gap of its model behind a vehicle in front, and
    waits behind who stands in its way. It neither changes lane nor swerves, and knows no right of way and no stop
    signs.
    """

    controller = Controller.EXTERNAL
    sensors: tuple[str, ...] = ("truth",)

    def __init__(self, name: str = "cc", *, model: CarefulModel | None = None, keep_speed: bool = False) -> None:
        """Choose the model.

        Args:
            name: Its short name, one of `ssad.drivers.careful.MODELS`.
            model: A custom model instead.
            keep_speed: Keep the speed at the takeover instead of the target speed, at least 1 m/s, and follow a vehicle
                only once the model has braked for it.

        Raises:
            UnknownNameError: There is no such model.
        """
        self.model = careful_model(name) if model is None else model
        self.name = f"careful-{self.model.name}"
        self.keep_speed = keep_speed
        self._half = self._power = self._wheel = np.zeros((0, 2))
        self._cruise = np.zeros(0)
        self._memory = initial_reaction((0, 0))
        self._moved = np.zeros((0, 0))
        self._follows = np.zeros((0, 0), bool)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget all agents and prepare for new episodes."""
        bodies = [agent_model(episode.agents[0]) for episode in episodes]
        self._half = np.array([(0.5 * body.length, 0.5 * body.width) for body in bodies]).reshape(-1, 2)
        self._power = np.array([(body.max_accel, body.max_brake) for body in bodies]).reshape(-1, 2)
        self._wheel = np.array([(body.wheelbase, body.max_steer) for body in bodies]).reshape(-1, 2)
        self._cruise = np.full(len(bodies), np.nan)
        self._forget(max((len(episode.agents) for episode in episodes), default=0))

    def _forget(self, agent_count: int) -> None:
        """Make a new memory of this many agents in each episode."""
        shape = (len(self._half), agent_count)
        self._memory, self._moved = initial_reaction(shape), np.zeros(shape)
        self._follows = np.full(shape, not self.keep_speed)

    def snapshot(self) -> Mapping[str, npt.NDArray[Any]]:
        """Return its memory of the agents [B, A], whom it follows [B, A], and its speed at the takeover [B], m/s."""
        return {
            "since": self._memory.since,
            "brake": self._memory.brake,
            "lateral_travel": self._moved,
            "follows": self._follows,
            "cruise": self._cruise,
        }

    def restore(self, states: Mapping[str, npt.NDArray[Any]]) -> None:
        """Set the memory of each episode."""
        self._memory = Reaction(states["since"], states["brake"])
        self._moved, self._follows = states["lateral_travel"], states["follows"]
        self._cruise = states["cruise"]

    def act(self, view: Observation) -> F32:
        """Return the controls: speed keeping limited by bends, other agents, red lights and the model."""
        scenes, agent_count = view.scene, view.readings["truth"].kind.shape[1]
        if agent_count > self._moved.shape[1]:  # the world has room for more agents than these episodes have
            self._forget(agent_count)
        target_speed = np.asarray(view.target_speed, np.float64)
        reach = np.where(target_speed > FAST, target_speed * target_speed / (2.0 * EASY), REACH)
        path, half_size = Path(view.route, BEYOND + reach - REACH), self._half[scenes]
        encounter, visible, lateral_travel = encounters(
            view, path, half=half_size, reach=reach, moved=self._moved[scenes], dt=STEP
        )
        memory = Reaction(np.where(visible, self._memory.since[scenes], -1.0), self._memory.brake[scenes])
        # hidden agents are moved far behind, where no model reacts to them
        demanded, updated_memory = react(self.model, _visible_only(encounter, visible), memory, STEP)
        self._memory.since[scenes], self._memory.brake[scenes], self._moved[scenes] = (
            updated_memory.since,
            updated_memory.brake,
            lateral_travel,
        )
        self._follows[scenes] |= updated_memory.brake > 0.0
        speed = np.asarray(view.speed, np.float64)
        is_new = np.isnan(self._cruise[scenes])
        self._cruise[scenes] = np.where(is_new, speed, self._cruise[scenes])
        target = np.maximum(self._cruise[scenes], 1.0) if self.keep_speed else target_speed
        allowed = squared_bend_speeds(view.route)
        bend_limit = bend_speed(allowed, np.arange(allowed.shape[1], dtype=np.float64))
        acceleration = np.clip((np.minimum(target, bend_limit) - speed) / RESPONSE, -2.0 * EASY, PULL)
        following = following_acceleration(self.model, encounter, self._follows[scenes] & visible)
        hardest = -EASY if self.keep_speed else -2.0 * EASY
        following_limit: F64 = np.maximum(following, hardest).min(1, initial=PULL)
        acceleration = np.minimum(acceleration, following_limit)
        must_wait = (visible & is_in_the_way(encounter, half_size[:, :1])).any(1)
        acceleration = np.where((visible & is_coming(encounter)).any(1), np.minimum(acceleration, 0.0), acceleration)
        brake = np.maximum(demanded.max(1, initial=0.0), _red_light_braking(view, half_size[:, 0]))
        brake = np.where(must_wait & (speed < 1.5), np.maximum(brake, 2.0 * EASY), brake)
        acceleration = np.where(brake > 0.0, np.minimum(acceleration, -brake), acceleration)
        power, steering = self._power[scenes], self._wheel[scenes]
        look_ahead = 3.0 + 0.5 * np.maximum(speed, 0.0)
        steer = pursue(path, look_ahead, aside=np.zeros(len(look_ahead)), wheelbase=steering[:, 0], lock=steering[:, 1])
        controls = np.stack([acceleration / power[:, 0], -acceleration / power[:, 1], steer], 1)
        return np.clip(controls, [0.0, 0.0, -1.0], 1.0).astype(np.float32)


def _visible_only(encounter: Encounter, is_visible: Bool) -> Encounter:
    """Return the encounters with visible agents; all others are moved far behind."""
    values = vars(encounter) | {"gap": np.where(is_visible, encounter.gap, -1e6)}
    return Encounter(**values)


def is_in_the_way(encounter: Encounter, half_length: F64) -> Bool:
    """Return the agents for which a standing driver waits: those ahead of it, and those that cross or soon will."""
    is_near = (encounter.gap > -half_length) & (encounter.lead < 1.0)
    is_blocking = (encounter.lateral <= 0.0) & (encounter.gap < WAIT)
    is_crossing = (encounter.approach > 0.3) & (encounter.gap < CROSSING) & (encounter.time_to_enter() < 3.0)
    return np.asarray(is_near & (is_blocking | is_crossing))


def following_acceleration(model: CarefulModel, encounter: Encounter, follows: Bool) -> F64:
    """Return the acceleration, m/s^2, with which a driver comes to or keeps its gap to each vehicle in front.

    Args:
        model: The model with the following gap.
        encounter: The others that the driver sees.
        follows: Which of them it follows, if they are in its path and move along it or stand.

    Returns:
        The acceleration, of any size; infinite where there is no vehicle to follow.
    """
    is_in_front = (encounter.lateral <= 0.0) & np.isinf(encounter.through) & (encounter.gap > -0.5 * encounter.length)
    lead = np.maximum(encounter.lead, 0.0)
    # what the gap will be when the speed has followed
    gap = encounter.gap - RESPONSE * np.maximum(encounter.speed - lead, 0.0)
    room = gap - np.maximum(model.following_gap(lead), WAIT)
    approach_speed = np.sqrt(lead * lead + 2.0 * APPROACH * np.maximum(room, 0.0))
    allowed = np.where(room > 0.0, approach_speed, np.maximum(lead + OPENING * room, 0.0))
    is_followed = follows & is_in_front & (encounter.lead > -0.5)
    return np.where(is_followed, (allowed - encounter.speed) / RESPONSE, np.inf)


def is_coming(encounter: Encounter) -> Bool:
    """Return the agents towards which no driver speeds up: those in its way, or soon to be, and reached soon."""
    is_soon = np.maximum(encounter.gap, 0.0) < SOON * np.maximum(encounter.closing(), 1.0)
    return np.asarray(
        is_soon
        & (encounter.gap > -encounter.length)
        & (encounter.lead < encounter.speed)
        & (encounter.time_to_enter() < 3.0)
    )


def squared_bend_speeds(route: npt.NDArray[np.floating]) -> F64:
    """Return squared speed limits of bends [N, R - 4], (m/s)^2, of routes [N, R, 2] with a point per metre."""
    points = np.asarray(route, np.float64)
    steps = np.diff(points, axis=1)
    yaw = np.unwrap(np.arctan2(steps[..., 1], steps[..., 0]), axis=1)
    is_segment = np.hypot(steps[..., 0], steps[..., 1]) > 1e-3
    curvature = np.where(is_segment[:, 1:] & is_segment[:, :-1], np.abs(np.diff(yaw, axis=1)), 0.0)
    # average over three metres, as routes are not smooth
    curvature = (curvature[:, :-2] + curvature[:, 1:-1] + curvature[:, 2:]) / 3.0
    return np.asarray(BEND / np.maximum(curvature, 1e-3))


def bend_speed(allowed: F64, ahead: F64) -> F64:
    """Return the speed limit [N], m/s, of bends `ahead` [N, R] m from the driver, approached at comfort braking."""
    braking_term = 2.0 * EASY * np.maximum(ahead - 2.0, 0.0)
    return np.asarray(np.sqrt(np.where(ahead > -0.5, allowed + braking_term, np.inf).min(1)))


def _red_light_braking(view: Observation, half_length: F64) -> F64:
    """m/s^2 to stop before a red light, or a yellow one if that is easy; 0 as long as there is time."""
    state, line_distance = np.asarray(view.signal, np.float64).T
    speed = np.asarray(view.speed, np.float64)
    room = line_distance - half_length - 1.0
    required = speed * speed / (2.0 * np.maximum(room, 0.2))
    must_stop = (state == SignalState.RED) & (required > EASY) & (room > -2.0) & (required < 8.0)
    must_stop |= (state == SignalState.YELLOW) & (required > EASY) & (required < 3.5) & (room > 0.0)
    standing = (state == SignalState.RED) & (room > -2.0) & (room < 1.5) & (speed < 1.0)
    return np.where(standing, 2.0 * EASY, np.where(must_stop, required, 0.0))


class CarefulCC(Careful):
    """Careful and competent human driver of UN Regulation 157."""

    def __init__(self) -> None:
        """Choose the model."""
        super().__init__("cc")


class CarefulReg157(Careful):
    """Driver of paragraph 5.2.5.2 of UN Regulation 157."""

    def __init__(self) -> None:
        """Choose the model."""
        super().__init__("reg157")


class CarefulRSS(Careful):
    """Driver of Responsibility-Sensitive Safety."""

    def __init__(self) -> None:
        """Choose the model."""
        super().__init__("rss")


class CarefulFSM(Careful):
    """Driver of the Fuzzy Safety Model."""

    def __init__(self) -> None:
        """Choose the model."""
        super().__init__("fsm")

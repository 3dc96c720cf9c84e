"""The careful models as driving systems: keep the route and the speed, and brake when the model says so."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Observation
from ssad.core.types import F32, F64, Bool, Controller, Episode, SignalState
from ssad.drivers.careful.encounter import Encounter
from ssad.drivers.careful.models import CarefulModel, Reaction, careful_model, react
from ssad.drivers.careful.sight import Path, encounters
from ssad.drivers.careful.steering import pursue
from ssad.world.models import model

STEP = 0.1  # s, of the world
REACH = 100.0  # m that it sees
BEND = 2.5  # m/s^2 across in bends
EASY = 2.0  # m/s^2 with which it slows before bends and for red lights
PULL = 2.0  # m/s^2 to its speed
WAIT = 3.0  # m that it keeps from who stands in its way, once it stands
SOON = 3.0  # s before it reaches somebody within which it does not speed up
CROSSING = 10.0  # m ahead within which it lets people cross, once it stands


class Careful:
    """A careful driver of the regulation literature, at the wheel.

    It keeps its route at its target speed, slower in bends, and stops at red lights. Of others it knows what is in line
    of sight; it does nothing about them but what its model says, which is to brake, and waits behind who stands in its
    way. It neither changes lane nor swerves, and knows no right of way and no stop signs.
    """

    controller = Controller.EXTERNAL
    sensors: tuple[str, ...] = ("truth",)

    def __init__(self, name: str = "cc", *, model: CarefulModel | None = None, keep_speed: bool = False) -> None:
        """Choose the model.

        Args:
            name: Its short name, one of `ssad.drivers.careful.MODELS`.
            model: A model of your own in its place.
            keep_speed: Drive at the speed at which it takes over, in place of the target speed; at least 1 m/s.

        Raises:
            UnknownNameError: There is no such model.
        """
        self.model = careful_model(name) if model is None else model
        self.name = f"careful-{self.model.name}"
        self.keep_speed = keep_speed
        self._half = self._power = self._wheel = np.zeros((0, 2))
        self._cruise = np.zeros(0)
        self._memory: Reaction | None = None
        self._moved = np.zeros((0, 0))

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget everybody."""
        bodies = [model(episode.agents[0].model) for episode in episodes]
        self._half = np.array([(0.5 * b.length, 0.5 * b.width) for b in bodies]).reshape(-1, 2)
        self._power = np.array([(b.max_accel, b.max_brake) for b in bodies]).reshape(-1, 2)
        self._wheel = np.array([(b.wheelbase, b.max_steer) for b in bodies]).reshape(-1, 2)
        self._cruise = np.full(len(bodies), np.nan)
        self._memory = None

    def act(self, view: Observation) -> F32:
        """See `Driver`."""
        rows, count = view.scene, view.readings["truth"].kind.shape[1]
        if self._memory is None:
            shape = (len(self._half), count)
            self._memory, self._moved = Reaction(np.full(shape, -1.0), np.zeros(shape)), np.zeros(shape)
        path, half = Path(view.route), self._half[rows]
        e, seen, moved = encounters(view, path, half=half, reach=REACH, moved=self._moved[rows], dt=STEP)
        before = Reaction(np.where(seen, self._memory.since[rows], -1.0), self._memory.brake[rows])
        # far to the side there is nobody: so much nobody covers across the path within a few seconds
        asked, after = react(self.model, _only(e, seen), before, STEP)
        self._memory.since[rows], self._memory.brake[rows], self._moved[rows] = after.since, after.brake, moved
        speed = np.asarray(view.speed, np.float64)
        fresh = np.isnan(self._cruise[rows])
        self._cruise[rows] = np.where(fresh, speed, self._cruise[rows])
        given = np.asarray(view.target_speed, np.float64)
        target = np.maximum(self._cruise[rows], 1.0) if self.keep_speed else given
        fits = bends(view.route)
        slow = bend_speed(fits, np.arange(fits.shape[1], dtype=np.float64))
        push = np.clip(2.0 * (np.minimum(target, slow) - speed), -2.0 * EASY, PULL)
        waits = (seen & in_the_way(e, half[:, :1])).any(1)
        push = np.where((seen & comes(e)).any(1), np.minimum(push, 0.0), push)
        brake = np.maximum(asked.max(1, initial=0.0), _red_light(view, half[:, 0]))
        brake = np.where(waits & (speed < 1.5), np.maximum(brake, 2.0 * EASY), brake)
        push = np.where(brake > 0.0, np.minimum(push, -brake), push)
        power, wheel = self._power[rows], self._wheel[rows]
        far = 3.0 + 0.5 * np.maximum(speed, 0.0)
        steer = pursue(path, far, aside=np.zeros(len(far)), wheelbase=wheel[:, 0], lock=wheel[:, 1])
        out = np.stack([push / power[:, 0], -push / power[:, 1], steer], 1)
        return np.clip(out, [0.0, 0.0, -1.0], 1.0).astype(np.float32)


def _only(e: Encounter, seen: Bool) -> Encounter:
    """The encounters with those who are seen; the others are far behind."""
    values = vars(e) | {"gap": np.where(seen, e.gap, -1e6)}
    return Encounter(**values)


def in_the_way(e: Encounter, half: F64) -> Bool:
    """For whom a driver that stands stays there: who stands before it, and who crosses or will within a moment."""
    near = (e.gap > -half) & (e.lead < 1.0)
    stands = (e.lateral <= 0.0) & (e.gap < WAIT)
    crosses = (e.approach > 0.3) & (e.gap < CROSSING) & (e.time_to_enter() < 3.0)
    return np.asarray(near & (stands | crosses))


def comes(e: Encounter) -> Bool:
    """Towards whom no driver speeds up: who is in its way or will be within a moment, and is reached soon."""
    soon = np.maximum(e.gap, 0.0) < SOON * np.maximum(e.closing(), 1.0)
    return np.asarray(soon & (e.gap > -e.length) & (e.lead < e.speed) & (e.time_to_enter() < 3.0))


def bends(route: npt.NDArray[np.floating]) -> F64:
    """What the bends of routes [N, R, 2] of a point a metre allow, [N, R - 4] (m/s)^2; the first is two points on."""
    points = np.asarray(route, np.float64)
    step = np.diff(points, axis=1)
    yaw = np.unwrap(np.arctan2(step[..., 1], step[..., 0]), axis=1)
    moves = np.hypot(step[..., 0], step[..., 1]) > 1e-3
    turn = np.where(moves[:, 1:] & moves[:, :-1], np.abs(np.diff(yaw, axis=1)), 0.0)
    # over three metres, as routes are not smooth
    turn = (turn[:, :-2] + turn[:, 1:-1] + turn[:, 2:]) / 3.0
    return np.asarray(BEND / np.maximum(turn, 1e-3))


def bend_speed(allowed: F64, ahead: F64) -> F64:
    """m/s [N] that `bends` allow that begin `ahead` [N, R] m from the driver, slowing down with `EASY`."""
    room = 2.0 * EASY * np.maximum(ahead - 2.0, 0.0)
    return np.asarray(np.sqrt(np.where(ahead > -0.5, allowed + room, np.inf).min(1)))


def _red_light(view: Observation, half: F64) -> F64:
    """m/s^2 to stop before a red light, or a yellow one if that is easy; 0 as long as there is time."""
    state, line = np.asarray(view.signal, np.float64).T
    speed = np.asarray(view.speed, np.float64)
    room = line - half - 1.0
    needs = speed * speed / (2.0 * np.maximum(room, 0.2))
    stop = (state == SignalState.RED) & (needs > EASY) & (room > -2.0) & (needs < 8.0)
    stop |= (state == SignalState.YELLOW) & (needs > EASY) & (needs < 3.5) & (room > 0.0)
    held = (state == SignalState.RED) & (room > -2.0) & (room < 1.5) & (speed < 1.0)
    return np.where(held, 2.0 * EASY, np.where(stop, needs, 0.0))


class CarefulCC(Careful):
    """The careful and competent human driver of UN Regulation 157."""

    def __init__(self) -> None:
        """Choose the model."""
        super().__init__("cc")


class CarefulReg157(Careful):
    """The driver of paragraph 5.2.5.2 of UN Regulation 157."""

    def __init__(self) -> None:
        """Choose the model."""
        super().__init__("reg157")


class CarefulRSS(Careful):
    """The driver of Responsibility-Sensitive Safety."""

    def __init__(self) -> None:
        """Choose the model."""
        super().__init__("rss")


class CarefulFSM(Careful):
    """The driver of the Fuzzy Safety Model."""

    def __init__(self) -> None:
        """Choose the model."""
        super().__init__("fsm")

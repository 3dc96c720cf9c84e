"""The kinematic limit: the latest moment and the gentlest manoeuvre with which anybody could have stayed clear.

A search over simple manoeuvres, each driven in the world itself: brake or speed up by some amount and move to a side by
some distance, from some moment on. One stays clear if the ego then touches nobody and stays on the road and on its own
side of it. Who knows the future could do it; the careful models tell what who does not know it would have done.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

import numpy as np

from ssad.core.driving import Observation
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F32, Bool, Episode
from ssad.drivers.careful.sight import Path
from ssad.drivers.careful.steering import pursue
from ssad.world.models import GRIP, agent_model
from ssad.world.world import World

MOMENTS = 8  # start times, evenly between the start of the danger and the contact
BRAKES = (0.25, 0.5, 0.75, 1.0)  # shares of the body's maximum
PULLS = (0.5, 1.0)
ASIDES = (0.0, 0.6, -0.6, 1.2, -1.2, 2.0, -2.0)  # m to the left of the route
RISE = 1.5  # limit of the speed as a factor of the initial speed
BETWEEN = 8.0  # m, minimum distance of a lateral shift
EASY_ACROSS = 4.0  # m/s^2, maximum lateral acceleration during a shift


@dataclass(frozen=True)
class Manoeuvre:
    """Evasive manoeuvre of the search.

    Attributes:
        start: Start time, s.
        accel: Acceleration along the path, m/s^2; limited to standstill and 1.5 times the initial speed.
        aside: Target offset to the left of the route, m.
    """

    start: float
    accel: float
    aside: float

    def effort(self) -> tuple[float, float]:
        """Return the effort for comparison: longitudinal acceleration first, then lateral offset."""
        return abs(self.accel), abs(self.aside)


@dataclass(frozen=True)
class Limit:
    """Result of the search.

    Attributes:
        latest: s before the contact at which the last clear manoeuvre begins; NaN: there is none.
        manoeuvre: Gentlest clear manoeuvre of those at the start of the danger, else of the latest ones.
        clear: Number of clear manoeuvres.
        tried: Number of manoeuvres.
    """

    latest: float
    manoeuvre: Manoeuvre | None
    clear: int
    tried: int

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for a record."""
        return asdict(self)


class Evasions:
    """Driver of one manoeuvre per scene."""

    sensors: tuple[str, ...] = ()

    def __init__(self, manoeuvres: Sequence[Manoeuvre]) -> None:
        """Store the manoeuvres of the scenes."""
        self.accel = np.array([manoeuvre.accel for manoeuvre in manoeuvres])
        self.aside = np.array([manoeuvre.aside for manoeuvre in manoeuvres])
        self.power = self.wheel = np.zeros((len(manoeuvres), 2))
        self.begun = np.full(len(manoeuvres), np.nan)
        self.speed = np.zeros(len(manoeuvres))
        self.gone = np.zeros(len(manoeuvres))

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Prepare for new episodes."""
        bodies = [agent_model(episode.agents[0]) for episode in episodes]
        self.power = np.array([(body.max_accel, body.max_brake) for body in bodies])
        self.wheel = np.array([(body.wheelbase, body.max_steer) for body in bodies])
        self.begun[:] = np.nan
        self.gone[:] = 0.0

    def act(self, view: Observation) -> F32:
        """Return the controls of the manoeuvres."""
        scene = view.scene
        speed = np.asarray(view.speed, np.float64)
        is_new = np.isnan(self.begun[scene])
        self.begun[scene] = np.where(is_new, view.lane_offset, self.begun[scene])
        self.speed[scene] = np.where(is_new, speed, self.speed[scene])
        path = Path(view.route)
        # distance of the shift that keeps the lateral acceleration bearable
        shift = np.abs(self.aside[scene] - self.begun[scene])
        shift_distance = np.maximum(BETWEEN, self.speed[scene] * np.sqrt(6.0 * shift / EASY_ACROSS))
        look_ahead = 3.0 + 0.3 * np.maximum(speed, 0.0)
        progress = np.clip((self.gone[scene] + look_ahead) / shift_distance, 0.0, 1.0)
        # Smoothstep: no jump of the heading at either end of the shift.
        target_offset = self.begun[scene] + (self.aside[scene] - self.begun[scene]) * progress * progress * (
            3.0 - 2.0 * progress
        )
        self.gone[scene] += np.maximum(speed, 0.0) * 0.1
        power, steering = self.power[scene], self.wheel[scene]
        steer = pursue(path, look_ahead, aside=target_offset, wheelbase=steering[:, 0], lock=steering[:, 1])
        accel = np.where((self.accel[scene] > 0) & (speed >= RISE * self.speed[scene]), 0.0, self.accel[scene])
        controls = np.stack([accel / power[:, 0], -accel / power[:, 1], steer], 1)
        return np.clip(controls, [0.0, 0.0, -1.0], 1.0).astype(np.float32)


class WrongSideObserver:
    """Observer of egos that leave the road or cross to its other side after their takeover.

    Args:
        episodes: Episodes of the scenes.
        graphs: Lane graphs by name of the town.
        starts: Times of the takeovers, s.
    """

    def __init__(self, episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph], starts: Sequence[float]) -> None:
        # the world counts lanes over all its towns, in the order of their names
        towns = sorted({episode.town for episode in episodes})
        first_lane = dict(
            zip(towns, np.cumsum([0, *(len(graphs[town].kind) for town in towns)]).tolist(), strict=False)
        )
        wrong_lanes: dict[int, Bool] = {}
        for episode in episodes:
            if id(episode) not in wrong_lanes:
                wrong_lanes[id(episode)] = wrong_side(episode, graphs[episode.town])
        self.wrong = np.zeros((len(episodes), max(map(len, wrong_lanes.values()))), bool)
        for lane_mask, episode in zip(self.wrong, episodes, strict=True):
            lanes = wrong_lanes[id(episode)]
            lane_mask[: len(lanes)] = lanes
        self.first = np.array([first_lane[episode.town] for episode in episodes])
        self.start = np.array(starts)
        self.left = np.zeros(len(starts), bool)

    def __call__(self, world: World) -> None:
        """Record one step of the world."""
        lane = world.array("lane")[:, 0]
        is_active = world.array("step") * world.dt > self.start + 1e-4
        is_off = (lane < 0) | self.wrong[np.arange(len(lane)), np.maximum(lane - self.first, 0)]
        self.left |= is_active & is_off & (world.ended() == 0)


def wrong_side(episode: Episode, graph: LaneGraph) -> Bool:
    """Return which lanes of a town are on the other side of the roads on the ego's route."""
    route = episode.agents[0].route
    assert route is not None
    direction = graph.forward
    ego_sides = {(int(graph.road[lane]), int(direction[lane])) for lane in np.unique(route.lane[route.lane >= 0])}
    roads = {road for road, _ in ego_sides}
    pairs = list(zip(graph.road.tolist(), direction.tolist(), strict=True))
    return np.array([road in roads and (road, lane_direction) not in ego_sides for road, lane_direction in pairs]) & (
        graph.junction < 0
    )


def manoeuvres(episode: Episode, start: float, contact: float) -> list[Manoeuvre]:
    """Return all combinations of start times from `start` to the contact, accelerations and offsets."""
    body = agent_model(episode.agents[0])
    accelerations = [
        0.0,
        *(-brake_share * min(body.max_brake, GRIP + 1.0) for brake_share in BRAKES),
        *(pull_share * body.max_accel for pull_share in PULLS),
    ]
    start_times = sorted({round(float(moment), 1) for moment in np.linspace(start, max(contact - 0.1, start), MOMENTS)})
    return [
        Manoeuvre(moment, acceleration, offset)
        for moment, acceleration, offset in product(start_times, accelerations, ASIDES)
    ]


def limit_of(options: Sequence[Manoeuvre], clear: Bool, *, contact: float) -> Limit:
    """Summarise the search.

    Args:
        options: The manoeuvres.
        clear: [N] True where a manoeuvre stayed clear.
        contact: Time of the recorded contact, s.

    Returns:
        The limit.
    """
    clear_options = [option for option, is_clear in zip(options, clear, strict=True) if is_clear]
    if not clear_options:
        return Limit(float("nan"), None, 0, len(options))
    earliest = min(option.start for option in options)
    earliest_clear = [option for option in clear_options if option.start == earliest]
    latest = max(option.start for option in clear_options)
    gentlest = min(
        earliest_clear or [option for option in clear_options if option.start == latest], key=Manoeuvre.effort
    )
    return Limit(contact - latest, gentlest, len(clear_options), len(options))

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
from ssad.world.models import GRIP, model
from ssad.world.world import World

MOMENTS = 8  # at which manoeuvres begin, evenly between the start of the danger and the contact
BRAKES = (0.25, 0.5, 0.75, 1.0)  # shares of what the body can
PULLS = (0.5, 1.0)
ASIDES = (0.0, 0.6, -0.6, 1.2, -1.2, 2.0, -2.0)  # m to the left of the route
RISE = 1.5  # times the speed at which it begins: more is not sped up to
BETWEEN = 8.0  # m over which a shift to a side is driven, at least
EASY_ACROSS = 4.0  # m/s^2 across, at most, while it moves aside


@dataclass(frozen=True)
class Manoeuvre:
    """What the search tries.

    Attributes:
        start: s from which on it is driven.
        accel: m/s^2 along the path; braking ends at rest, speeding up at 1.5 times the speed at its start.
        aside: m left of the route that the ego moves to and keeps.
    """

    start: float
    accel: float
    aside: float

    def effort(self) -> tuple[float, float]:
        """How violent it is: braking or speeding up first, then the way to the side."""
        return abs(self.accel), abs(self.aside)


@dataclass(frozen=True)
class Limit:
    """What the search found.

    Attributes:
        latest: s before the contact at which the last manoeuvre that stays clear begins; NaN: none does.
        manoeuvre: The gentlest of those that begin when the danger begins, or of the latest ones.
        clear: How many stay clear.
        tried: How many were tried.
    """

    latest: float
    manoeuvre: Manoeuvre | None
    clear: int
    tried: int

    def as_dict(self) -> dict[str, Any]:
        """Plain data for a record."""
        return asdict(self)


class Evasions:
    """Drives a manoeuvre in each scene."""

    sensors: tuple[str, ...] = ()

    def __init__(self, manoeuvres: Sequence[Manoeuvre]) -> None:
        """Take the manoeuvres of the scenes."""
        self.accel = np.array([m.accel for m in manoeuvres])
        self.aside = np.array([m.aside for m in manoeuvres])
        self.power = self.wheel = np.zeros((len(manoeuvres), 2))
        self.begun = np.full(len(manoeuvres), np.nan)
        self.speed = np.zeros(len(manoeuvres))
        self.gone = np.zeros(len(manoeuvres))

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Begin anew."""
        bodies = [model(episode.agents[0].model) for episode in episodes]
        self.power = np.array([(b.max_accel, b.max_brake) for b in bodies])
        self.wheel = np.array([(b.wheelbase, b.max_steer) for b in bodies])
        self.begun[:] = np.nan
        self.gone[:] = 0.0

    def act(self, view: Observation) -> F32:
        """See `Driver`."""
        k = view.scene
        speed = np.asarray(view.speed, np.float64)
        new = np.isnan(self.begun[k])
        self.begun[k] = np.where(new, view.lane_offset, self.begun[k])
        self.speed[k] = np.where(new, speed, self.speed[k])
        path = Path(view.route)
        # as long a way as keeps the acceleration across bearable; there and not back
        far = np.abs(self.aside[k] - self.begun[k])
        way = np.maximum(BETWEEN, self.speed[k] * np.sqrt(6.0 * far / EASY_ACROSS))
        ahead = 3.0 + 0.3 * np.maximum(speed, 0.0)
        share = np.clip((self.gone[k] + ahead) / way, 0.0, 1.0)
        aim = self.begun[k] + (self.aside[k] - self.begun[k]) * share * share * (3.0 - 2.0 * share)
        self.gone[k] += np.maximum(speed, 0.0) * 0.1
        power, wheel = self.power[k], self.wheel[k]
        steer = pursue(path, ahead, aside=aim, wheelbase=wheel[:, 0], lock=wheel[:, 1])
        accel = np.where((self.accel[k] > 0) & (speed >= RISE * self.speed[k]), 0.0, self.accel[k])
        out = np.stack([accel / power[:, 0], -accel / power[:, 1], steer], 1)
        return np.clip(out, [0.0, 0.0, -1.0], 1.0).astype(np.float32)


class OwnSide:
    """Watches whether egos leave the road or cross to the other side of it, from their takeover on.

    Args:
        episodes: Of the scenes.
        graphs: Their towns by name.
        starts: s of the takeovers.
    """

    def __init__(self, episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph], starts: Sequence[float]) -> None:
        # the world counts lanes over all its towns, in the order of their names
        towns = sorted({episode.town for episode in episodes})
        first = dict(zip(towns, np.cumsum([0, *(len(graphs[town].kind) for town in towns)]).tolist(), strict=False))
        wrong: dict[int, Bool] = {}
        for episode in episodes:
            if id(episode) not in wrong:
                wrong[id(episode)] = wrong_side(episode, graphs[episode.town])
        self.wrong = np.zeros((len(episodes), max(map(len, wrong.values()))), bool)
        for row, episode in zip(self.wrong, episodes, strict=True):
            lanes = wrong[id(episode)]
            row[: len(lanes)] = lanes
        self.first = np.array([first[episode.town] for episode in episodes])
        self.start = np.array(starts)
        self.left = np.zeros(len(starts), bool)

    def __call__(self, world: World) -> None:
        """After each step."""
        lane = world.array("lane")[:, 0]
        on = world.array("step") * world.dt > self.start + 1e-4
        off = (lane < 0) | self.wrong[np.arange(len(lane)), np.maximum(lane - self.first, 0)]
        self.left |= on & off & (world.ended() == 0)


def wrong_side(episode: Episode, graph: LaneGraph) -> Bool:
    """Which lanes of a town are on the other side of the roads that the ego's route takes."""
    route = episode.agents[0].route
    assert route is not None
    side = np.sign(graph.lane_id)
    mine = {(int(graph.road[k]), int(side[k])) for k in np.unique(route.lane[route.lane >= 0])}
    roads = {road for road, _ in mine}
    pairs = list(zip(graph.road.tolist(), side.tolist(), strict=True))
    return np.array([road in roads and (road, s) not in mine for road, s in pairs]) & (graph.junction < 0)


def manoeuvres(episode: Episode, start: float, contact: float) -> list[Manoeuvre]:
    """All that are tried: moments from `start` to the contact x accelerations x sides."""
    body = model(episode.agents[0].model)
    accels = [0.0, *(-b * min(body.max_brake, GRIP + 1.0) for b in BRAKES), *(p * body.max_accel for p in PULLS)]
    moments = sorted({round(float(t), 1) for t in np.linspace(start, max(contact - 0.1, start), MOMENTS)})
    return [Manoeuvre(t, a, aside) for t, a, aside in product(moments, accels, ASIDES)]


def limit_of(options: Sequence[Manoeuvre], clear: Bool, *, contact: float) -> Limit:
    """Sum up the search.

    Args:
        options: What was tried.
        clear: Which stayed clear.
        contact: s at which the drive met its end.

    Returns:
        The limit.
    """
    good = [m for m, fine in zip(options, clear, strict=True) if fine]
    if not good:
        return Limit(float("nan"), None, 0, len(options))
    first = min(m.start for m in options)
    early = [m for m in good if m.start == first]
    latest = max(m.start for m in good)
    best = min(early or [m for m in good if m.start == latest], key=Manoeuvre.effort)
    return Limit(contact - latest, best, len(good), len(options))

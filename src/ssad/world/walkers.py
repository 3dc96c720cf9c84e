"""Tables for the walkers of natural traffic: their routes, the crossings, and the passages of vehicles over these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F32, F64, Episode, WalkStyle
from ssad.world.kernels.data import TurnRank, Walkers, array_types
from ssad.world.roads.crossings import crossing_axis, road_crossings
from ssad.world.roads.sidewalks import sidewalk_network

TAIL = 14.0  # m from the middle of a vehicle to its rear, at most
JUST_AFTER = 15.0  # m beyond a turn within which a crossing belongs to the road that is entered
EDGE = 1.0  # m beyond the kerb up to which a route leads over a crossing


def has_walkers(episodes: Sequence[Episode]) -> bool:
    """Return whether natural traffic of any of the episodes has walkers."""
    return any(agent.walk is not None for episode in episodes for agent in episode.agents)


Passing = tuple[float, float, float, int, int]


def passings(path: F32, rule: F32, ends: F64, kerbs: F64, half_width: F64) -> list[Passing]:
    """Find where a route leads over crossings.

    Args:
        path: [N, 4] route points a metre apart: x, y (m), yaw, curvature.
        rule: [N, 4] as in `Roads.rule`.
        ends: [C, 2, 2] both ends of each crossing, m.
        kerbs: [C, 2] distances of the edges of the road from its first end, m.
        half_width: [C] m.

    Returns:
        Sorted rows: distance along the route to both edges of the crossing, distance of the place from the crossing's
        first end (m), number of the crossing, 1 if the route turns just before it.
    """
    axis = ends[:, 1] - ends[:, 0]
    axis /= np.hypot(*axis.T)[:, None]
    offset = path[:, None, :2].astype(np.float64) - ends[None, :, 0]
    place = (offset * axis).sum(2)
    aside = np.abs(offset[..., 1] * axis[:, 0] - offset[..., 0] * axis[:, 1])
    inside = (aside <= half_width) & (place >= kerbs[:, 0] - EDGE) & (place <= kerbs[:, 1] + EDGE)
    rows = []
    for crossing in np.flatnonzero(inside.any(0)).tolist():
        edges = np.flatnonzero(np.diff(inside[:, crossing].astype(np.int8), prepend=0, append=0))
        for first, after in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            low, high = float(first), float(after - 1)
            width = half_width[crossing]
            if first > 0 and aside[first - 1, crossing] > width:
                low -= (width - aside[first, crossing]) / (aside[first - 1, crossing] - aside[first, crossing])
            if after < len(path) and aside[after, crossing] > width:
                high += (width - aside[after - 1, crossing]) / (aside[after, crossing] - aside[after - 1, crossing])
            before = slice(max(int(low - JUST_AFTER), 0), first + 1)
            turns = (rule[before, 2] == 0.0) & (rule[before, 3] % TurnRank.YIELD != TurnRank.STRAIGHT)
            middle = float(place[first:after, crossing].mean())
            rows.append((low, high, middle, crossing, int(turns.any())))
    return sorted(rows)


@dataclass
class _Rows:
    """Rows of the tables, by name."""

    crossing: list[tuple[float, float, float, float]] = field(default_factory=list)
    form: list[tuple[float, float, float, float]] = field(default_factory=list)
    signals: list[tuple[int, int]] = field(default_factory=list)
    signal: list[int] = field(default_factory=list)
    part: list[tuple[float, float, float]] = field(default_factory=list)
    stage: list[tuple[float, float, float, float]] = field(default_factory=list)
    stage_crossing: list[int] = field(default_factory=list)
    passing: list[tuple[float, float, float]] = field(default_factory=list)
    passing_crossing: list[tuple[int, int, int]] = field(default_factory=list)

    def add_crossings(self, graph: LaneGraph, numbers: Sequence[int]) -> dict[int, int]:
        """Append crossings of a town; return the row of each."""
        crossings, roads = sidewalk_network(graph).crossings, road_crossings(graph)
        rows = {}
        for number in numbers:
            rows[number] = len(self.crossing)
            crossing, road = crossings[number], roads[number]
            axis = crossing_axis(crossing)
            self.crossing.append((float(crossing.xy[0, 0]), float(crossing.xy[0, 1]), float(axis[0]), float(axis[1])))
            self.form.append((0.5 * crossing.width, *road.kerbs, float(crossing.crosswalk >= 0)))
            self.signals.append((len(self.signal), len(road.traffic)))
            for traffic in road.traffic:
                self.signal.append(traffic.signal)
                self.part.append((traffic.low, traffic.high, traffic.seconds))
        return rows

    def add_route(self, next_passing: npt.NDArray[np.int32], path: F32, rule: F32, rows: Sequence[int]) -> None:
        """Append the passages of a route over crossings (rows of `crossing`), and write its part of `next_passing`."""
        lines = np.array([self.crossing[row] for row in rows])
        form = np.array([self.form[row] for row in rows])
        ends = np.stack([lines[:, :2], lines[:, :2] + lines[:, 2:]], 1)
        route_passings = passings(path, rule, ends, form[:, 1:3], form[:, 0])
        first = len(self.passing)
        next_passing[:] = -1
        for number, passing in reversed(list(enumerate(route_passings))):
            next_passing[: max(int(passing[1] + TAIL) + 1, 0)] = first + number
        for number, (low, high, place, crossing, turns) in enumerate(route_passings):
            self.passing.append((low, high, place))
            self.passing_crossing.append((rows[crossing], turns, int(number + 1 < len(route_passings))))


def build_walkers(  # noqa: PLR0917
    episodes: Sequence[Episode],
    graphs: Mapping[str, LaneGraph],
    route: npt.NDArray[np.int32],
    path: F32,
    rule: F32,
    device: str,
) -> Walkers:
    """Return the tables of the walkers of a bank of episodes.

    Args:
        episodes: The bank.
        graphs: Lane graphs by town.
        route: [E, A, 2] first route point of each agent in the pool, number of points.
        path: [N, 4] the pool, as in `Roads.path`.
        rule: [N, 4] as in `Roads.rule`.
        device: Warp device.

    Raises:
        ConfigError: A walker has no route, or its group has no such walker.
    """
    shape = route.shape[:2]
    rows = _Rows()
    arrays: dict[str, npt.NDArray[Any]] = {
        "agents": np.zeros((len(episodes), 2), np.int32),
        "style": np.zeros((*shape, 4), np.float32),
        "depth": np.zeros(shape, np.float32),
        "leader": np.full(shape, -1, np.int32),
        "stages": np.zeros((*shape, 2), np.int32),
        "next_passing": np.full(len(path), -1, np.int32),
    }
    used: dict[str, set[int]] = {}
    for episode in episodes:
        for agent in episode.agents:
            if agent.walk is not None:
                used.setdefault(episode.town, set()).update(place.crossing for place in agent.walk.crossings)
    crossing_rows = {town: rows.add_crossings(graphs[town], sorted(numbers)) for town, numbers in used.items()}
    routes: set[tuple[str, int, int]] = set()
    for number, episode in enumerate(episodes):
        walkers = [index for index, agent in enumerate(episode.agents) if agent.walk is not None]
        if not walkers:
            continue
        arrays["agents"][number] = walkers[0], walkers[-1] + 1
        names = {episode.agents[index].name: index for index in walkers}
        for index, agent in enumerate(episode.agents):
            if agent.walk is None:
                if route[number, index, 1] > 1 and crossing_rows[episode.town]:
                    routes.add((episode.town, *route[number, index].tolist()))
                continue
            if route[number, index, 1] < 2:
                raise ConfigError(f"episode {episode.key}: walker {agent.name} needs a route of at least two points")
            walk = agent.walk
            if walk.group and walk.group not in names:
                raise ConfigError(f"episode {episode.key}: walker {agent.name}: there is no walker '{walk.group}'")
            arrays["style"][number, index] = walk.margin, walk.room, walk.offset, walk.row
            arrays["depth"][number, index] = walk.depth
            arrays["leader"][number, index] = names.get(walk.group, index)
            arrays["stages"][number, index] = len(rows.stage), len(walk.crossings)
            _add_stages(rows, walk, crossing_rows[episode.town])
    for town, first, count in sorted(routes):
        part = slice(first, first + count)
        rows.add_route(arrays["next_passing"][part], path[part], rule[part], list(crossing_rows[town].values()))
    tables = Walkers()
    for name, array_type in array_types(Walkers).items():
        width = getattr(array_type.dtype, "_length_", 1)
        values = arrays[name] if name in arrays else np.array(getattr(rows, name), np.float64)
        if values.size == 0:  # an array on a device needs a row
            values = np.zeros((1, width) if width > 1 else 1)
        setattr(tables, name, wp.array(values, dtype=array_type.dtype, device=device))
    return tables


def _add_stages(rows: _Rows, walk: WalkStyle, crossing_rows: Mapping[int, int]) -> None:
    for place in walk.crossings:
        rows.stage.append((place.wait, place.kerb, place.far, 1.0 if place.forward else -1.0))
        rows.stage_crossing.append(crossing_rows[place.crossing])

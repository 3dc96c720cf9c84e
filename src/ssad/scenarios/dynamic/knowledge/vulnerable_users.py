"""Walkers and cyclists of natural traffic, drawn by key: the draw of the vehicles does not change with them.

Walkers walk on the sidewalks near the ego's route and over crossings, alone or in groups; their speeds and groups
follow the published values in `ssad.metrics.human_driving`. Cyclists are Autopilots with the body of a bicycle and a
style of their own, on biking lanes and near the edge of driving lanes up to 60 km/h.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.geometry import obb_distance
from ssad.core.seeding import generator
from ssad.core.types import (
    F64,
    Controller,
    DriverStyle,
    EpisodeAgent,
    LaneType,
    Pose,
    Route,
    TrafficPlan,
    WalkCrossing,
    WalkStyle,
)
from ssad.metrics.human_driving import published, spread
from ssad.scenarios.dynamic.knowledge._caching import cached_by_identity
from ssad.scenarios.dynamic.knowledge._placing import LanePosition, pose_at
from ssad.scenarios.dynamic.knowledge.natural_junction import APART, spawn_places
from ssad.world.models import agent_model, model

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph
    from ssad.world.roads.sidewalks import SidewalkNetwork, Walk

NEAR = 40.0  # m from the route within which walkers and cyclists start
CLEAR = 15.0  # m around the ego's start without cyclists
MAX_SPEED_LIMIT = 60.0 / 3.6 + 0.1  # m/s; there are no cyclists on faster roads
SPEED_LIMITS = (0.6, 2.2)  # m/s of walkers
GROUP_SLOWER = 0.15  # m/s by which groups are slower: the middle of what Gates et al. (2006) measured
MAX_GROUP = 6  # walkers
ABREAST = 0.7  # m between the two walkers of a row
ROW = 1.0  # m between the rows of a group
START_GAP = 6.0  # m between the starts of groups
BODIES_APART = 0.3  # m between a walker and anything else at the start
CROSSING_SHARE = 0.5  # of walkers that cross although the sidewalk goes on; at corners, straight on means to cross
MARGINS = (1.0, 3.0)  # s beyond the time to cross: the Highway Capacity Manual (2010) has 3 s, walkers accept less
KERB = 0.7  # m from the kerb to a waiting walker
SPARE = 1.2  # times the distance walked in an episode, so that no walker reaches the end of its way
ROUTE = 400.0  # m of a cyclist's route
MAX_DURATION = 600.0  # s of a walk
SET_OFF = 0.7  # s that a standing walker takes to start
RED_MARGIN = 1.0  # s of red beyond the time to cross, below which a walker avoids a crossing
CYCLING_SPREAD = 0.8  # m/s between the speeds of cyclists
CYCLING_LIMITS = (2.5, 7.0)  # m/s
CYCLING_ACCELERATION = (0.5, 1.0)  # m/s^2, from the lower half of the published range: the rest is sport
CYCLING_DECELERATION = (1.2, 2.0)  # m/s^2
EDGE = (0.6, 1.2)  # m between a cyclist and the edge of its lane
BLEND = 12  # m over which a cyclist moves to another place in the lane
_ATTEMPTS = 20  # places that are tried for each group


def group_size(random: np.random.Generator) -> int:
    """Draw the number of walkers in a group, 1 for a walker alone: Poisson without 0 (Moussaïd et al. 2010).

    With the rate r, the share of walkers who are in groups is 1 - exp(-r); it is the middle of the published shares.
    """
    share = float(np.mean(spread("share of walkers in groups")))
    rate = -math.log(1.0 - share)
    while True:
        size = int(random.poisson(rate))
        if 1 <= size <= MAX_GROUP:
            return size


def walking_speed(size: int, random: np.random.Generator) -> float:
    """Draw the speed of a group of walkers, m/s: Weidmann's distribution within 0.6 to 2.2 m/s, slower in groups."""
    statistic = next(value for value in published("walking speed") if value.sd is not None)
    mean, deviation = float(statistic.mean or 0.0), float(statistic.sd or 0.0)
    while True:
        speed = float(random.normal(mean - (GROUP_SLOWER if size > 1 else 0.0), deviation))
        if SPEED_LIMITS[0] <= speed <= SPEED_LIMITS[1]:
            return speed


@dataclass(frozen=True)
class _Group:
    """Walkers who walk together: their number, speed (m/s) and margin at crossings (s)."""

    size: int
    speed: float
    margin: float

    @property
    def rows(self) -> int:
        """Rows in which they walk, two abreast."""
        return math.ceil(self.size / 2)


def draw_walkers(
    plan: TrafficPlan,
    graph: LaneGraph,
    route: Route | None,
    others: Sequence[EpisodeAgent],
    duration: float,
    *key: object,
) -> list[EpisodeAgent]:
    """Draw the walkers of an episode.

    Args:
        plan: Number of walkers.
        graph: Lane graph of the town; without sidewalks near the route there are no walkers.
        route: The ego's route; None: they start anywhere in the town.
        others: Agents whose bodies stay free of walkers.
        duration: Time for which they walk, s.
        *key: Key of the draw.

    Returns:
        Walkers with a way and a behaviour, at most `plan.walkers`.
    """
    from ssad.world.roads.sidewalks import sidewalk_network

    if plan.walkers == 0:
        return []
    network = sidewalk_network(graph)
    if route is None:
        candidates = tuple(index for index, edge in enumerate(network.edges) if edge.lane >= 0)
    else:
        candidates = _edges_near(graph, route)
    if not candidates:
        return []
    random = generator("walkers", *key)
    lengths = np.array([network.edges[edge].length for edge in candidates])
    points = _sparse(route) if route is not None else None
    starts: list[F64] = []
    agents: list[EpisodeAgent] = []
    for _ in range(_ATTEMPTS * plan.walkers):
        if len(agents) == plan.walkers:
            break
        edge = int(candidates[random.choice(len(candidates), p=lengths / lengths.sum())])
        position = float(random.uniform(0.0, network.edges[edge].length))
        reverse = bool(random.integers(2))
        size = min(group_size(random), plan.walkers - len(agents))
        group = _Group(size, walking_speed(size, random), float(random.uniform(*MARGINS)))
        side = float(random.uniform(-0.25, 0.25)) if size == 1 else 0.0
        walk_length = SPARE * group.speed * min(duration, MAX_DURATION) + ROW * group.rows
        closed = closed_crossings(graph, group.speed, ROW * (group.rows - 1))
        state = random.bit_generator.state
        ways = []
        for offset in (side,) if size == 1 else (side - 0.5 * ABREAST, side + 0.5 * ABREAST):
            random.bit_generator.state = state  # the members of a group take the same way
            walk = network.random_walk(
                edge,
                position,
                walk_length,
                random,
                reverse=reverse,
                crossing_share=CROSSING_SHARE,
                closed=closed,
                offset=offset,
            )
            ways.append((walk, offset))
        start = ways[0][0].route.xy[0].astype(np.float64)
        is_far = points is not None and float(np.hypot(*(points - start).T).min()) > NEAR
        if is_far or any(math.dist(start, other) < START_GAP for other in starts):
            continue
        members = list(_members(graph, network, ways, group, len(agents)))
        if not members or not _has_room(members, [*others, *agents]):
            continue
        starts.append(start)
        agents += members
    return agents


def _members(
    graph: LaneGraph, network: SidewalkNetwork, ways: Sequence[tuple[Walk, float]], group: _Group, first: int
) -> Iterator[EpisodeAgent]:
    """Yield the walkers of a group, its leader first; none if one of them would start on a road."""
    paths = [(*_metric_way(walk), walk, offset) for walk, offset in ways]
    for member in range(group.size):
        path, crossing, walk, offset = paths[member % len(paths)]
        index = round(ROW) * (group.rows - 1 - member // 2)
        if index >= len(path.xy) or (crossing[: index + 2] >= 0).any():
            return
    leader = f"walker {first + 1}"
    for member in range(group.size):
        path, crossing, walk, offset = paths[member % len(paths)]
        index = round(ROW) * (group.rows - 1 - member // 2)
        x, y = path.xy[index].tolist()
        style = WalkStyle(
            crossings=tuple(_crossings_on(graph, network, path, crossing)),
            margin=group.margin,
            room=max(0.5 * float(walk.route.width.min()) - 0.5 * model("walker").width - 0.05, abs(offset)),
            offset=offset,
            group="" if member == 0 else leader,
            row=ROW * (member // 2),
            depth=ROW * (group.rows - 1) if member == 0 else 0.0,
        )
        yield EpisodeAgent(
            name=f"walker {first + member + 1}",
            model="walker",
            controller=Controller.SCRIPT,
            pose=Pose(x, y, float(path.yaw[index])),
            speed=group.speed,
            target_speed=group.speed,
            route=path,
            walk=style,
        )


def _metric_way(walk: Walk) -> tuple[Route, F64]:
    """Return the route of a walk with points a metre apart, and the crossing under each point, -1: none."""
    route = walk.route
    arc_lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route.xy.astype(np.float64), axis=0).T))])
    positions = np.arange(int(arc_lengths[-1]) + 1, dtype=np.float64)
    xy = np.column_stack([np.interp(positions, arc_lengths, column) for column in route.xy.astype(np.float64).T])
    nearest = np.abs(arc_lengths[None] - positions[:, None]).argmin(1)
    steps = np.diff(xy, axis=0)
    yaw = np.arctan2(steps[:, 1], steps[:, 0])
    path = Route(
        xy=xy.astype(np.float32),
        yaw=np.append(yaw, yaw[-1:]).astype(np.float32),
        lane=route.lane[nearest],
        speed_limit=route.speed_limit[nearest],
        width=route.width[nearest],
    )
    return path, walk.crossing[nearest].astype(np.float64)


def _crossings_on(graph: LaneGraph, network: SidewalkNetwork, path: Route, crossing: F64) -> Iterator[WalkCrossing]:
    """Yield the crossings on a way with points a metre apart."""
    from ssad.world.roads.crossings import crossing_axis, road_crossings

    edges = [0, *(np.flatnonzero(np.diff(crossing)) + 1).tolist(), len(crossing)]
    for first, after in itertools.pairwise(edges):
        number = int(crossing[first])
        if number < 0:
            continue
        start, stop = max(first - 3, 0), min(after + 3, len(crossing))
        axis = crossing_axis(network.crossings[number])
        place = (path.xy[start:stop].astype(np.float64) - network.crossings[number].xy[0]) @ axis
        forward = bool(place[-1] > place[0])
        kerbs = road_crossings(graph)[number].kerbs
        near, far = kerbs if forward else (-kerbs[1], -kerbs[0])
        # the way may bend back a little where it joins the crossing
        along = np.maximum.accumulate(place if forward else -place) + 1e-9 * np.arange(stop - start)
        wait, kerb, end = start + np.interp([near - KERB, near, far], along, np.arange(stop - start))
        if after < len(crossing):  # a way that ends on a crossing ends before it
            yield WalkCrossing(number, float(wait), float(kerb), float(end), forward)


def _has_room(members: Sequence[EpisodeAgent], others: Sequence[EpisodeAgent]) -> bool:
    """Return whether walkers start clear of others and of each other."""
    boxes = [
        (agent.pose.x, agent.pose.y, agent.pose.yaw, body.length, body.width)
        for agent, body in ((agent, agent_model(agent)) for agent in (*others, *members))
    ]
    for number, box in enumerate(boxes[len(others) :], len(others)):
        for other in boxes[:number]:
            reach = 0.5 * (math.hypot(*box[3:]) + math.hypot(*other[3:])) + BODIES_APART
            if math.dist(box[:2], other[:2]) > reach:
                continue
            gap = float(obb_distance(box, other))
            if gap < BODIES_APART and not (number >= len(others) and other in boxes[len(others) :] and gap > 0.05):
                return False
    return True


def closed_crossings(graph: LaneGraph, speed: float, depth: float) -> frozenset[int]:
    """Return the crossings at signals that never show red long enough for a group of walkers.

    Args:
        graph: Lane graph of the town.
        speed: Speed of the walkers, m/s.
        depth: Distance from the first one to the last, m.
    """
    from ssad.world.episode_arrays import signal_programs
    from ssad.world.roads.crossings import road_crossings

    programs = signal_programs(graph)
    closed = set()
    for number, crossing in enumerate(road_crossings(graph)):
        for traffic in crossing.traffic:
            cycle, _, green, yellow = programs[traffic.signal].tolist()
            way = KERB + max(traffic.high - crossing.kerbs[0], crossing.kerbs[1] - traffic.low)
            if SET_OFF + (way + depth) / speed - traffic.seconds + RED_MARGIN > cycle - green - yellow:
                closed.add(number)
    return frozenset(closed)


def draw_cyclists(
    plan: TrafficPlan, graph: LaneGraph, route: Route, others: Sequence[EpisodeAgent], *key: object
) -> list[EpisodeAgent]:
    """Draw the cyclists of an episode, with speeds around the published means.

    Args:
        plan: Number of cyclists, and the distance of the ego at which they set out.
        graph: Lane graph of the town.
        route: The ego's route.
        others: Agents from whose starts they keep 8 m.
        *key: Key of the draw.

    Returns:
        Autopilots with the body and the driver of a bicycle, at most `plan.cyclists`.
    """
    from ssad.world.roads import random_route

    if plan.cyclists == 0:
        return []
    random = generator("cyclists", *key)
    places = _cycling_places(graph, route)
    agents: list[EpisodeAgent] = []
    for index in random.permutation(len(places)):
        if len(agents) == plan.cyclists:
            break
        place, pose = places[int(index)]
        if any(math.hypot(pose.x - agent.pose.x, pose.y - agent.pose.y) < APART for agent in (*others, *agents)):
            continue
        number = len(agents) + 1
        path = cycling_route(graph, random_route(graph, place.lane, place.s, ROUTE, random), random.uniform(*EDGE))
        agents.append(cyclist(f"cyclist {number}", path, plan.wake_distance, random))
    return agents


def cyclist(name: str, path: Route, wake_distance: float, random: np.random.Generator) -> EpisodeAgent:
    """Draw a cyclist that rides along a route from its start."""
    mean = float(np.mean(spread("cycling speed")))
    speed = float(np.clip(random.normal(mean, CYCLING_SPREAD), *CYCLING_LIMITS))
    style = DriverStyle(
        time_gap=float(random.uniform(0.9, 1.5)),
        standstill_gap=float(random.uniform(0.8, 1.6)),
        acceleration=float(random.uniform(*CYCLING_ACCELERATION)),
        deceleration=float(random.uniform(*CYCLING_DECELERATION)),
        jerk=2.0,
        reaction_time=float(random.uniform(0.5, 1.0)),
        key=int(random.integers(0, 1 << 23)),
    )
    return EpisodeAgent(
        name=name,
        model="bicycle",
        controller=Controller.AUTOPILOT,
        pose=Pose(float(path.xy[0, 0]), float(path.xy[0, 1]), float(path.yaw[0])),
        target_speed=speed,
        route=path,
        wake_distance=wake_distance,
        driver=style,
    )


def cycling_route(graph: LaneGraph, route: Route, from_edge: float) -> Route:
    """Move a route to where cyclists ride: the middle of a biking lane beside its lanes, or near the edge of these.

    Args:
        graph: Lane graph of the town.
        route: Route along driving lanes, with points a metre apart.
        from_edge: Distance from the cyclist to the edge of a driving lane on the near side, m.
    """
    near_side = 1.0 if graph.left_hand[0] else -1.0
    beside = graph.left if graph.left_hand[0] else graph.right
    aside = near_side * np.maximum(0.5 * route.width.astype(np.float64) - from_edge, 0.0)
    for lane in np.unique(route.lane[route.lane >= 0]).tolist():
        neighbour = int(beside[lane])
        if neighbour >= 0 and graph.kind[neighbour] == LaneType.BIKING:
            width = float(graph.width[graph.points(neighbour)].mean())
            on_lane = route.lane == lane
            aside[on_lane] = near_side * 0.5 * (route.width[on_lane].astype(np.float64) + width)
    kernel = np.ones(2 * min(BLEND // 2, (len(aside) - 1) // 2) + 1)  # a short route at the end of a map
    aside = np.convolve(aside, kernel, mode="same") / np.convolve(np.ones(len(aside)), kernel, mode="same")
    yaw = np.unwrap(route.yaw.astype(np.float64))
    xy = route.xy.astype(np.float64) + aside[:, None] * np.column_stack([-np.sin(yaw), np.cos(yaw)])
    arc_lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    positions = np.arange(int(arc_lengths[-1]) + 1, dtype=np.float64)
    moved = np.column_stack([np.interp(positions, arc_lengths, column) for column in xy.T])
    nearest = np.minimum(np.searchsorted(arc_lengths, positions), len(arc_lengths) - 1)
    steps = np.gradient(moved, axis=0)
    return Route(
        xy=moved.astype(np.float32),
        yaw=np.arctan2(steps[:, 1], steps[:, 0]).astype(np.float32),
        lane=route.lane[nearest],
        speed_limit=route.speed_limit[nearest],
        width=route.width[nearest],
    )


def _sparse(route: Route) -> F64:
    """Return points of a route about every 5 m [N, 2]."""
    return route.xy[:: max(round(5.0 / route.spacing), 1)].astype(np.float64)


@cached_by_identity(64)
def _edges_near(graph: LaneGraph, route: Route) -> tuple[int, ...]:
    """Return the sidewalk edges with a point near the route."""
    from ssad.world.roads.sidewalks import sidewalk_network

    points = _sparse(route)
    return tuple(
        index
        for index, edge in enumerate(sidewalk_network(graph).edges)
        if edge.lane >= 0 and np.hypot(*(edge.xy[:, None] - points[None]).transpose(2, 0, 1)).min() <= NEAR
    )


@cached_by_identity(64)
def _cycling_places(graph: LaneGraph, route: Route) -> tuple[tuple[LanePosition, Pose], ...]:
    """Return the spawn places of cyclists near a route, and their poses."""
    points = _sparse(route)
    beside = graph.left if graph.left_hand[0] else graph.right
    accepted = []
    for place in spawn_places(graph):
        neighbour = int(beside[place.lane])
        if neighbour >= 0 and graph.kind[neighbour] == LaneType.DRIVING:
            continue  # cyclists keep to the outermost lane
        pose = pose_at(graph, place)
        distances = np.hypot(points[:, 0] - pose.x, points[:, 1] - pose.y)
        if distances.min() <= NEAR and distances[0] > CLEAR and graph.speed_limit[place.lane] <= MAX_SPEED_LIMIT:
            accepted.append((place, pose))
    return tuple(accepted)

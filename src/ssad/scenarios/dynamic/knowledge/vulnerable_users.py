"""Walkers and cyclists of natural traffic, drawn by key: the draw of the vehicles does not change with them.

Walkers walk on the sidewalks near the ego's route, alone or in groups; their speeds and groups follow the published
values in `ssad.metrics.human_driving`. They do not cross roads. Cyclists are Autopilots with the body of a bicycle on
driving lanes up to 60 km/h, with the speeds of cyclists.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.seeding import generator
from ssad.core.types import F64, Controller, EpisodeAgent, Pose, Route, TrafficPlan
from ssad.metrics.human_driving import published, spread
from ssad.scenarios.dynamic.knowledge._caching import cached_by_identity
from ssad.scenarios.dynamic.knowledge._placing import LanePosition, pose_at
from ssad.scenarios.dynamic.knowledge.natural_junction import APART, spawn_places

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

NEAR = 40.0  # m from the route within which walkers and cyclists start
CLEAR = 15.0  # m around the ego's start without cyclists
MAX_SPEED_LIMIT = 60.0 / 3.6 + 0.1  # m/s; on faster roads nobody cycles
SPEED_LIMITS = (0.6, 2.2)  # m/s of walkers
GROUP_SLOWER = 0.15  # m/s by which groups are slower: the middle of what Gates et al. (2006) measured
MAX_GROUP = 6  # walkers
ABREAST = 0.7  # m between the two walkers of a row
ROW = 1.0  # m between the rows of a group
START_GAP = 6.0  # m between the starts of groups
ROUTE = 400.0  # m of a cyclist's route
MAX_DURATION = 600.0  # s of a walk
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


def draw_walkers(
    plan: TrafficPlan, graph: LaneGraph, route: Route, duration: float, *key: object
) -> list[EpisodeAgent]:
    """Draw the walkers of an episode.

    Args:
        plan: Number of walkers.
        graph: Lane graph of the town; without sidewalks near the route there are no walkers.
        route: The ego's route.
        duration: Time for which they walk, s.
        *key: Key of the draw.

    Returns:
        Scripted agents that hold their speed, at most `plan.walkers`.
    """
    from ssad.world.roads.sidewalks import sidewalk_network

    if plan.walkers == 0:
        return []
    network, candidates = sidewalk_network(graph), _edges_near(graph, route)
    if not candidates:
        return []
    random = generator("walkers", *key)
    lengths = np.array([network.edges[edge].length for edge in candidates])
    points = _sparse(route)
    starts: list[F64] = []
    agents: list[EpisodeAgent] = []
    for _ in range(_ATTEMPTS * plan.walkers):
        if len(agents) == plan.walkers:
            break
        edge = int(candidates[random.choice(len(candidates), p=lengths / lengths.sum())])
        position = float(random.uniform(0.0, network.edges[edge].length))
        reverse = bool(random.integers(2))
        size = min(group_size(random), plan.walkers - len(agents))
        speed = walking_speed(size, random)
        side = float(random.uniform(-0.25, 0.25)) if size == 1 else 0.0
        rows = math.ceil(size / 2)
        walk_length = speed * min(duration, MAX_DURATION) + ROW * rows
        state = random.bit_generator.state
        routes = []
        for offset in (side,) if size == 1 else (side - 0.5 * ABREAST, side + 0.5 * ABREAST):
            random.bit_generator.state = state  # the members of a group take the same way
            walk = network.random_walk(
                edge, position, walk_length, random, reverse=reverse, crossing_share=0.0, offset=offset
            )
            routes.append(walk.route)
        start = routes[0].xy[0].astype(np.float64)
        is_far = float(np.hypot(*(points - start).T).min()) > NEAR
        if is_far or any(math.dist(start, other) < START_GAP for other in starts):
            continue
        starts.append(start)
        for member in range(size):
            path = routes[member % 2]
            index = round(ROW / path.spacing) * (rows - 1 - member // 2)
            x, y = path.xy[index].tolist()
            agents.append(
                EpisodeAgent(
                    name=f"walker {len(agents) + 1}",
                    model="walker",
                    controller=Controller.SCRIPT,
                    pose=Pose(x, y, float(path.yaw[index])),
                    speed=speed,
                    target_speed=speed,
                    route=path,
                )
            )
    return agents


def draw_cyclists(
    plan: TrafficPlan, graph: LaneGraph, route: Route, others: Sequence[EpisodeAgent], *key: object
) -> list[EpisodeAgent]:
    """Draw the cyclists of an episode, with speeds between the published means.

    Args:
        plan: Number of cyclists, and the distance of the ego at which they set out.
        graph: Lane graph of the town.
        route: The ego's route.
        others: Agents from whose starts they keep 8 m.
        *key: Key of the draw.

    Returns:
        Autopilots with the body of a bicycle, at most `plan.cyclists`.
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
        speed = float(random.uniform(*spread("cycling speed")))
        agents.append(
            EpisodeAgent(
                name=f"cyclist {len(agents) + 1}",
                model="bicycle",
                controller=Controller.AUTOPILOT,
                pose=pose,
                target_speed=speed,
                route=random_route(graph, place.lane, place.s, ROUTE, random),
                wake_distance=plan.wake_distance,
            )
        )
    return agents


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
    accepted = []
    for place in spawn_places(graph):
        pose = pose_at(graph, place)
        distances = np.hypot(points[:, 0] - pose.x, points[:, 1] - pose.y)
        if distances.min() <= NEAR and distances[0] > CLEAR and graph.speed_limit[place.lane] <= MAX_SPEED_LIMIT:
            accepted.append((place, pose))
    return tuple(accepted)

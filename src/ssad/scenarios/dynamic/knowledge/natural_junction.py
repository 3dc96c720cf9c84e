"""Natural junction: a route through one junction among random traffic, all signals green (FREA's scenario 9).

As in FREA: places near the route's start and end and near its junction, not on the ego's lanes nor opposite
to its start; shuffled; a share `intensity` of them, between `minimum` and `maximum`; parked until the ego
is within 50 m. Differences from FREA: places are every 25 m on driving lanes outside junctions (CARLA's spawn
points are not part of a map file); no two vehicles start within 8 m; the shuffle depends on the scenario's
seed (FREA: always seed 2000); each vehicle drives a random route of its own near 8 m/s (FREA: CARLA's
traffic manager); long vehicles drive only where they can turn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.types import (
    Controller,
    EpisodeAgent,
    LaneType,
    Pose,
    Route,
    Scenario,
    SignalPlan,
    TrafficPlan,
)
from ssad.scenarios.dynamic.knowledge._caching import cached_by_identity
from ssad.scenarios.dynamic.knowledge._kind import Parameter, ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import LanePosition, pose_at
from ssad.world.models import model

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

NEAR_START = 20.0
NEAR_JUNCTION = 50.0
NEAR_END = 30.0
CLEAR_OF_EGO = 5.0
CLEAR_AHEAD = 10.0
APART = 8.0
_SPACING = 25.0
_FROM_END = 6.0  # m; minimum distance of a start from a lane's end
_ROUTE = 400.0  # m; longer than any episode of 60 s at town speed
_NOSE = 2.2  # m from the path: a lane's half width and a little
_MIX: dict[str, float] = {
    "car": 0.30,
    "suv": 0.20,
    "coupe": 0.12,
    "compact": 0.18,
    "van": 0.06,
    "motorcycle": 0.07,
    "truck": 0.04,
    "bus": 0.03,
}


def spawn_places(graph: LaneGraph) -> list[LanePosition]:
    """Return places every 25 m on driving lanes outside junctions, the same for every episode of a town."""
    positions = []
    for lane in np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0)):
        usable_length = float(graph.length[lane]) - 2.0 * _FROM_END
        if usable_length < 0.0:
            continue
        count = int(usable_length / _SPACING) + 1
        first_position = _FROM_END + (usable_length - (count - 1) * _SPACING) / 2.0
        positions += [LanePosition(int(lane), first_position + index * _SPACING) for index in range(count)]
    return positions


@cached_by_identity(64)
def spawn_candidates(graph: LaneGraph, route: Route) -> tuple[tuple[LanePosition, Pose], ...]:
    """Return the spawn places that FREA's rules allow for a route.

    Args:
        graph: Lane graph of the town.
        route: The ego's route.

    Returns:
        Places on lanes and their poses, in the order of `spawn_places`.

    Raises:
        RouteError: No point of the route is on the lane graph.
    """
    graph_lanes = route.lane[route.lane >= 0]
    if not len(graph_lanes):
        raise RouteError("the route is nowhere on the lane graph")
    ego_lanes = {(int(graph.road[lane]), int(graph.lane_id[lane])) for lane in np.unique(graph_lanes)}
    # a route may begin inside a junction; "the ego's road" is then the one after it
    lanes_outside = graph_lanes[graph.junction[graph_lanes] < 0]
    first_lane = int(lanes_outside[0] if len(lanes_outside) else graph_lanes[0])
    in_junction = (route.lane >= 0) & (graph.junction[route.lane] >= 0)
    regions = [(route.xy[0], NEAR_START), (route.xy[-1], NEAR_END)]
    if in_junction.any():
        regions.append((route.xy[in_junction].mean(axis=0), NEAR_JUNCTION))
    start_points = route.xy[: round(CLEAR_AHEAD / route.spacing) + 1]
    accepted = []
    for place in spawn_places(graph):
        road, lane_id = int(graph.road[place.lane]), int(graph.lane_id[place.lane])
        opposite = road == int(graph.road[first_lane]) and graph.forward[place.lane] != graph.forward[first_lane]
        if opposite or (road, lane_id) in ego_lanes:
            continue
        pose = pose_at(graph, place)
        if not any(math.hypot(pose.x - centre[0], pose.y - centre[1]) <= radius for centre, radius in regions):
            continue
        if float(np.hypot(start_points[:, 0] - pose.x, start_points[:, 1] - pose.y).min()) <= CLEAR_OF_EGO:
            continue
        accepted.append((place, pose))
    return tuple(accepted)


def fits_route(model_name: str, route: Route) -> bool:
    """Return True if a vehicle takes a route's tightest bend without its nose swinging into the oncoming lane.

    At curvature k of its centre's path the body lags by the slip asin(k wheelbase / 2), so that its front
    corner reaches length / 2 sin(slip) + width / 2 outwards; at most `_NOSE` m are allowed.
    """
    vehicle = model(model_name)
    curvature = np.abs(np.diff(np.unwrap(route.yaw.astype(np.float64)))) / route.spacing
    # average over 3 m: a single kink between two lanes is no bend
    smoothed = np.convolve(curvature, np.ones(3) / 3.0, mode="valid")
    slip = 0.5 * float(smoothed.max()) * vehicle.wheelbase
    return 0.5 * vehicle.length * slip + 0.5 * vehicle.width <= _NOSE


def mixed_body(rng: np.random.Generator) -> str:
    """Draw a vehicle model by its frequency in traffic."""
    return str(rng.choice(list(_MIX), p=list(_MIX.values())))


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Place background vehicles that drive autonomously."""
    plan = scenario.traffic or TRAFFIC
    return background_vehicles(spawn_candidates(graph, route), plan, SCENARIO.values(scenario.parameters), graph, rng)


def background_vehicles(
    spawn_positions: Sequence[tuple[LanePosition, Pose]],
    plan: TrafficPlan,
    values: Mapping[str, float],
    graph: LaneGraph,
    rng: np.random.Generator,
) -> list[EpisodeAgent]:
    """Draw vehicles for a share of the places, at least 8 m apart, each with a random route of its own.

    Args:
        spawn_positions: Places on lanes and their poses.
        plan: Share of the places, and limits of the number of vehicles.
        values: `speed` and `speed_spread` that vehicles want, m/s.
        graph: Lane graph of the town.
        rng: Source of all draws.
    """
    from ssad.world.roads import random_route

    count = min(max(int(len(spawn_positions) * plan.intensity), plan.minimum), plan.maximum)
    agents: list[EpisodeAgent] = []
    for index in rng.permutation(len(spawn_positions)):
        if len(agents) == count:
            break
        place, pose = spawn_positions[int(index)]
        if any(math.hypot(pose.x - agent.pose.x, pose.y - agent.pose.y) < APART for agent in agents):
            continue
        model_name = mixed_body(rng)
        vehicle_route = random_route(graph, place.lane, place.s, _ROUTE, rng)
        if not fits_route(model_name, vehicle_route):
            model_name = "compact"
        speed = values["speed"] + values["speed_spread"] * float(rng.uniform(-1.0, 1.0))
        agents.append(
            EpisodeAgent(
                name=f"{model_name} {len(agents) + 1}",
                model=model_name,
                controller=Controller.AUTOPILOT,
                pose=pose,
                target_speed=min(speed, float(graph.speed_limit[place.lane])),
                route=vehicle_route,
                wake_distance=plan.wake_distance,
            )
        )
    return agents


TRAFFIC = TrafficPlan()
SCENARIO = ScenarioType(
    name="NaturalJunction",
    title="Natural junction",
    nhtsa="The ego drives through a junction among random traffic.",
    build=build,
    parameters=(
        Parameter("speed", 3.0, 15.0, 8.0, "m/s", "mean speed that the vehicles want", allowed=(3.0, 40.0)),
        Parameter("speed_spread", 0.0, 3.0, 1.5, "m/s", "half range of the speeds that they want"),
    ),
    signals=SignalPlan(ego="green", others="green", until=1.0e6),
    traffic=TRAFFIC,
    whole_town=True,
)

"""Natural junction: a route through one junction among random traffic, all signals green (FREA's scenario 9).

As in FREA: places near the route's start and end and near its junction, not on the ego's lanes nor opposite
to its start; shuffled; a share `intensity` of them, between `minimum` and `maximum`; parked until the ego
is within 50 m. Other than in FREA: places are every 25 m on driving lanes outside junctions (CARLA's spawn
points are not part of a map file); no two vehicles start within 8 m; the shuffle depends on the scenario's
seed (FREA: always seed 2000); each vehicle drives a random route of its own near 8 m/s (FREA: CARLA's
traffic manager); long vehicles drive only where they can turn.
"""

from __future__ import annotations

import math
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
from ssad.scenarios.dynamic.knowledge._kind import Parameter, ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import Place, pose_at
from ssad.scenarios.dynamic.knowledge._remember import remembered
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
_FROM_END = 6.0  # no vehicle starts nearer than this to a lane's end
_ROUTE = 400.0  # m; more than anyone drives in an episode of 60 s at town speed
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


def spawn_places(graph: LaneGraph) -> list[Place]:
    """Places every 25 m on the driving lanes outside junctions, the same for every episode of a town."""
    places = []
    for lane in np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0)):
        free = float(graph.length[lane]) - 2.0 * _FROM_END
        if free < 0.0:
            continue
        count = int(free / _SPACING) + 1
        first = _FROM_END + (free - (count - 1) * _SPACING) / 2.0
        places += [Place(int(lane), first + k * _SPACING) for k in range(count)]
    return places


@remembered(64)
def candidates(graph: LaneGraph, route: Route) -> tuple[tuple[Place, Pose], ...]:
    """The places that FREA's rules leave for a route.

    Args:
        graph: Lane graph of the town.
        route: The ego's route.

    Returns:
        Places on lanes and their poses, in the order of `spawn_places`.

    Raises:
        RouteError: The route is nowhere on the lane graph.
    """
    on_graph = route.lane[route.lane >= 0]
    if not len(on_graph):
        raise RouteError("the route is nowhere on the lane graph")
    own = {(int(graph.road[n]), int(graph.lane_id[n])) for n in np.unique(on_graph)}
    # a route may begin inside a junction; "the ego's road" is then the one after it
    roads = on_graph[graph.junction[on_graph] < 0]
    first = int(roads[0] if len(roads) else on_graph[0])
    inside = (route.lane >= 0) & (graph.junction[route.lane] >= 0)
    near = [(route.xy[0], NEAR_START), (route.xy[-1], NEAR_END)]
    if inside.any():
        near.append((route.xy[inside].mean(axis=0), NEAR_JUNCTION))
    start = route.xy[: round(CLEAR_AHEAD / route.spacing) + 1]
    found = []
    for place in spawn_places(graph):
        road, lane_id = int(graph.road[place.lane]), int(graph.lane_id[place.lane])
        opposite = road == int(graph.road[first]) and lane_id * int(graph.lane_id[first]) < 0
        if opposite or (road, lane_id) in own:
            continue
        pose = pose_at(graph, place)
        if not any(math.hypot(pose.x - xy[0], pose.y - xy[1]) <= radius for xy, radius in near):
            continue
        if float(np.hypot(start[:, 0] - pose.x, start[:, 1] - pose.y).min()) <= CLEAR_OF_EGO:
            continue
        found.append((place, pose))
    return tuple(found)


def fits(body: str, route: Route) -> bool:
    """Whether a vehicle can drive a route's tightest bend without its nose swinging into the oncoming lane.

    At curvature k of its centre's path the body lags by the slip asin(k wheelbase / 2), so that its front
    corner reaches length / 2 sin(slip) + width / 2 outwards; at most `_NOSE` m are allowed.
    """
    vehicle = model(body)
    turn = np.abs(np.diff(np.unwrap(route.yaw.astype(np.float64)))) / route.spacing
    # over 3 m, as a single kink between two lanes is none
    smooth = np.convolve(turn, np.ones(3) / 3.0, mode="valid")
    slip = 0.5 * float(smooth.max()) * vehicle.wheelbase
    return 0.5 * vehicle.length * slip + 0.5 * vehicle.width <= _NOSE


def mixed_body(rng: np.random.Generator) -> str:
    """A model as it is common in traffic."""
    return str(rng.choice(list(_MIX), p=list(_MIX.values())))


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Vehicles that drive on their own."""
    from ssad.world.roads import random_route

    plan = scenario.traffic or TRAFFIC
    value = SCENARIO.values(scenario.parameters)
    places = candidates(graph, route)
    count = min(max(int(len(places) * plan.intensity), plan.minimum), plan.maximum)
    agents: list[EpisodeAgent] = []
    for index in rng.permutation(len(places)):
        if len(agents) == count:
            break
        place, pose = places[int(index)]
        if any(math.hypot(pose.x - a.pose.x, pose.y - a.pose.y) < APART for a in agents):
            continue
        body = mixed_body(rng)
        path = random_route(graph, place.lane, place.s, _ROUTE, rng)
        if not fits(body, path):
            body = "compact"
        speed = value["speed"] + value["speed_spread"] * float(rng.uniform(-1.0, 1.0))
        agents.append(
            EpisodeAgent(
                name=f"{body} {len(agents) + 1}",
                model=body,
                controller=Controller.AUTOPILOT,
                pose=pose,
                target_speed=min(speed, float(graph.speed_limit[place.lane])),
                route=path,
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
        Parameter("speed", 3.0, 15.0, 8.0, "m/s", "mean speed that the vehicles want"),
        Parameter("speed_spread", 0.0, 3.0, 1.5, "m/s", "half range of the speeds that they want"),
    ),
    signals=SignalPlan(ego="green", others="green", until=1.0e6),
    traffic=TRAFFIC,
    whole_town=True,
)

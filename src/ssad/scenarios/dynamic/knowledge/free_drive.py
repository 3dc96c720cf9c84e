"""Free drive: a route of any length in natural traffic, with signals that follow their programmes.

Vehicles wait along the whole route, on its own lanes too, and set out when the ego comes near. Numbers of vehicles
and their speeds are those of the natural junction (FREA), a vehicle for each 100 m of a longer route.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssad.core.types import EpisodeAgent, Pose, Route, Scenario, TrafficPlan
from ssad.scenarios.dynamic.knowledge._caching import cached_by_identity
from ssad.scenarios.dynamic.knowledge._kind import Parameter, ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import LanePosition, pose_at
from ssad.scenarios.dynamic.knowledge.natural_junction import background_vehicles, spawn_places

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

NEAR = 50.0  # m from the route within which vehicles start
CLEAR = 25.0  # m around the ego's start without vehicles
EVERY = 100.0  # m of the route for each vehicle above those of the plan
MOST = 40  # vehicles


@cached_by_identity(64)
def spawn_candidates(graph: LaneGraph, route: Route) -> tuple[tuple[LanePosition, Pose], ...]:
    """Return the spawn places within 50 m of a route and more than 25 m from its start, and their poses."""
    points = route.xy[:: max(round(5.0 / route.spacing), 1)].astype(np.float64)
    accepted = []
    for place in spawn_places(graph):
        pose = pose_at(graph, place)
        distances = np.hypot(points[:, 0] - pose.x, points[:, 1] - pose.y)
        if distances.min() <= NEAR and distances[0] > CLEAR:
            accepted.append((place, pose))
    return tuple(accepted)


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Place background vehicles along the route that drive autonomously."""
    plan = scenario.traffic or traffic_of(route)
    return background_vehicles(spawn_candidates(graph, route), plan, SCENARIO.values(scenario.parameters), graph, rng)


def traffic_of(route: Route) -> TrafficPlan:
    """Return the traffic of a route: between 5 and 18 vehicles, and one more for each 100 m, up to 40."""
    return TrafficPlan(maximum=min(TrafficPlan().maximum + int(route.length / EVERY), MOST))


SCENARIO = ScenarioType(
    name="FreeDrive",
    title="Free drive",
    nhtsa="The ego drives a route among random traffic.",
    build=build,
    parameters=(
        Parameter("speed", 3.0, 15.0, 8.0, "m/s", "mean speed that the vehicles want", allowed=(3.0, 40.0)),
        Parameter("speed_spread", 0.0, 3.0, 1.5, "m/s", "half range of the speeds that they want"),
    ),
    whole_town=True,
)

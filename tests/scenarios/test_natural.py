"""Random traffic of the natural junctions: FREA's rules hold, and draws are reproducible."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Controller, EpisodeAgent, LaneType, Pose, Route, Scenario, TrafficPlan
from ssad.scenarios.dynamic import scenario_type
from ssad.scenarios.dynamic.knowledge import natural_junction as natural
from ssad.world.models import model


def traffic(graph: LaneGraph, route: Route, seed: int = 0, plan: TrafficPlan | None = None) -> list[EpisodeAgent]:
    scenario = Scenario("t", "NaturalJunction", graph.name, (Pose(0, 0), Pose(1, 0)), traffic=plan)
    rng = np.random.default_rng(seed)
    return list(scenario_type("NaturalJunction").build(scenario, graph, route, rng))


def test_places_are_on_driving_lanes_outside_junctions(crossroads: LaneGraph) -> None:
    places = natural.spawn_places(crossroads)
    # 16 lanes of 100 m: 88 m are free, which holds four places 25 m apart
    assert len(places) == 16 * 4
    lanes = [p.lane for p in places]
    assert (crossroads.kind[lanes] == LaneType.DRIVING).all()
    assert (crossroads.junction[lanes] == -1).all()
    first = [p.s for p in places if p.lane == lanes[0]]
    assert np.allclose(first, [12.5, 37.5, 62.5, 87.5])


@pytest.mark.parametrize("way", ["straight", "left", "right"])
def test_candidates_keep_freas_rules(way: str, crossroads: LaneGraph, routes: Any) -> None:
    g, route = crossroads, getattr(routes, way)
    found = natural.candidates(g, route)
    own = {(int(g.road[n]), int(g.lane_id[n])) for n in route.lane}
    for place, pose in found:
        key = (int(g.road[place.lane]), int(g.lane_id[place.lane]))
        assert key not in own
        assert not (key[0] == 13 and key[1] < 0)  # opposite to the ego's start
        near = [math.hypot(pose.x - x, pose.y - y) for x, y in (route.xy[0], route.xy[-1])]
        middle = route.xy[(g.junction[route.lane] >= 0)].mean(axis=0)
        assert near[0] <= 20 or near[1] <= 30 or math.hypot(pose.x - middle[0], pose.y - middle[1]) <= 50
        assert near[0] > 5
    # nothing that the rules allow is left out
    kept = {(p.lane, p.s) for p, _ in found}
    east = [p for p in natural.spawn_places(g) if int(g.road[p.lane]) == 10 and p.lane not in set(route.lane.tolist())]
    inner = [p for p in east if abs(g.at(p.lane, p.s)[0]) < 30]
    assert inner
    assert all((p.lane, p.s) in kept for p in inner)


@pytest.mark.parametrize(
    ("plan", "count"),
    [
        (TrafficPlan(intensity=0.0), 5),
        (TrafficPlan(intensity=1.0), 18),
        (TrafficPlan(intensity=0.0, minimum=0), 0),
        (TrafficPlan(intensity=0.3, minimum=0, maximum=2), 2),
    ],
)
def test_count_is_clipped(plan: TrafficPlan, count: int, crossroads: LaneGraph, routes: Any) -> None:
    agents = traffic(crossroads, routes.straight, plan=plan)
    apart = count if count < 18 else len(agents)  # neighbouring lanes are nearer than 8 m: some places stay empty
    assert len(agents) == apart
    assert len(agents) <= 18


def test_vehicles_drive_on_their_own(crossroads: LaneGraph, routes: Any) -> None:
    agents = traffic(crossroads, routes.left, plan=TrafficPlan(intensity=0.6, wake_distance=40.0))
    assert len(agents) >= 8
    for i, agent in enumerate(agents):
        assert agent.controller == Controller.AUTOPILOT
        assert agent.wake_distance == 40.0
        assert model(agent.model).max_speed > 0
        assert 6.5 <= agent.target_speed <= 9.5
        assert agent.route is not None
        assert np.allclose(agent.route.xy[0], [agent.pose.x, agent.pose.y], atol=0.6)
        for other in agents[:i]:
            assert math.hypot(agent.pose.x - other.pose.x, agent.pose.y - other.pose.y) >= 8.0


def test_draws_are_reproducible_and_differ_by_seed(crossroads: LaneGraph, routes: Any) -> None:
    def key(seed: int) -> list[tuple[str, Pose, float]]:
        return [(a.model, a.pose, a.target_speed) for a in traffic(crossroads, routes.straight, seed)]

    assert key(1) == key(1)
    assert key(1) != key(2)


def test_a_route_off_the_graph_is_an_error(crossroads: LaneGraph, routes: Any) -> None:
    lost = Route(
        routes.straight.xy, routes.straight.yaw, np.full_like(routes.straight.lane, -1),
        routes.straight.speed_limit, routes.straight.width,
    )  # fmt: skip
    with pytest.raises(RouteError, match="nowhere on the lane graph"):
        traffic(crossroads, lost)

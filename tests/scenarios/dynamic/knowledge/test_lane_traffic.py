"""Lane traffic: who drives with the ego, and where."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from ssad.core.errors import RouteError
from ssad.core.types import Controller, Pose, TrafficPlan
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.scenarios.dynamic.knowledge.lane_traffic import lanes_beside
from ssad.world.models import MODELS
from ssad.world.roads import load_town


def test_columns_stand_on_the_lanes_of_the_egos_direction_and_keep_apart() -> None:
    graph = load_town("ProvingGround")
    lane = 10
    assert len(lanes_beside(graph, lane)) == 2
    assert lane in lanes_beside(graph, lane)
    start, end = graph.at(lane, 60.0), graph.at(lane, 300.0)
    (base, *_) = load_scenarios("lane-traffic")
    for draw in range(8):
        scenario = replace(
            base,
            town=graph.name,
            route=(Pose(*start[:3]), Pose(*end[:3])),
            traffic=TrafficPlan(minimum=0, maximum=12, wake_distance=0.0, draw=draw),
        )
        made = build_episode(scenario, graph, seed=0)
        assert 4 <= len(made.agents) - 1 <= 12
        lanes: dict[int, list[tuple[float, float]]] = {}
        for agent in made.agents[1:]:
            assert agent.controller == Controller.AUTOPILOT
            assert agent.route is not None
            own = int(agent.route.lane[0])
            assert own in lanes_beside(graph, lane)
            place = agent.pose.x  # this part of the road leads east
            lanes.setdefault(own, []).append((place, MODELS[agent.model].length))
        assert len(lanes) == 2
        for column in lanes.values():
            column.sort()
            gaps = [b[0] - a[0] - 0.5 * (a[1] + b[1]) for a, b in itertools.pairwise(column)]
            assert all(gap > 5.0 for gap in gaps)
        distance = [np.hypot(a.pose.x - start[0], a.pose.y - start[1]) for a in made.agents[1:]]
        assert max(distance) < 110.0


def test_it_starts_on_a_lane() -> None:
    (base, *_) = load_scenarios("lane-traffic")
    graph = load_town(base.town)
    inside = int(np.flatnonzero(graph.junction >= 0)[0])
    x, y, yaw, _ = graph.at(inside, 0.5 * float(graph.length[inside]))
    after = int(graph.successors(inside)[0])
    end = graph.at(after, 0.8 * float(graph.length[after]))
    with pytest.raises(RouteError, match="starts on a lane"):
        build_episode(replace(base, route=(Pose(x, y, yaw), Pose(*end[:3]))), graph, seed=0)

"""Lane traffic: the ego drives with others along a road of several lanes; what happens, chance decides.

The vehicles are those nearest to the ego of a column on each lane of its direction, with gaps that are drawn. They
drive as natural traffic does, each as fast as it likes. Without noise in the world (`ssad.world.noise`) little happens.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.types import Controller, EpisodeAgent, LaneType, Route, Scenario, TrafficPlan
from ssad.scenarios.dynamic.knowledge._kind import Parameter, ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import Place, pose_at, project
from ssad.scenarios.dynamic.knowledge.natural_junction import mixed_body
from ssad.world.models import model

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

_BEHIND, _AHEAD = 25.0, 80.0  # m of the ego within which columns are drawn
_LEAST_HEADWAY = 0.7  # s


def lanes_beside(graph: LaneGraph, lane: int) -> list[int]:
    """The lane and the driving lanes of its direction beside it, from left to right."""
    sides: list[list[int]] = [[], []]
    for side, found in zip((graph.left, graph.right), sides, strict=True):
        other = int(side[lane])
        while other >= 0 and graph.kind[other] == LaneType.DRIVING and graph.same_direction(lane, other):
            found.append(other)
            other = int(side[other])
    return [*reversed(sides[0]), lane, *sides[1]]


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Vehicles of each lane's column, the nearest to the ego first."""
    from ssad.world.roads import random_route

    plan = scenario.traffic or TRAFFIC
    value = SCENARIO.values(scenario.parameters)
    own = int(route.lane[0])
    if own < 0 or graph.junction[own] >= 0:
        raise RouteError("the ego of lane traffic starts on a lane, not in a junction or off the road")
    x, y = (float(v) for v in route.xy[0])
    found: list[tuple[float, EpisodeAgent]] = []
    for lane in lanes_beside(graph, own):
        here = project(graph, lane, x, y).s
        # the ego leads its own column; beside it a column begins anywhere
        s = here + 2.5 if lane == own else max(here - _BEHIND - float(rng.uniform(0.0, 20.0)), 0.0)
        while s < min(here + _AHEAD, float(graph.length[lane]) - 10.0):
            speed = value["speed"] + value["speed_spread"] * float(rng.uniform(-1.0, 1.0))
            body = mixed_body(rng)
            headway = _LEAST_HEADWAY + float(rng.exponential(value["headway"] - _LEAST_HEADWAY))
            s += headway * value["speed"] + 0.5 * model(body).length
            if s < float(graph.length[lane]) - 10.0:
                place = Place(lane, s)
                agent = EpisodeAgent(
                    name=body,
                    model=body,
                    controller=Controller.AUTOPILOT,
                    pose=pose_at(graph, place),
                    speed=speed,
                    target_speed=speed,
                    route=random_route(graph, lane, s, 400.0, rng),
                    wake_distance=plan.wake_distance,
                )
                found.append((abs(s - here), agent))
            s += 0.5 * model(body).length
    nearest = [agent for _, agent in sorted(found, key=lambda pair: pair[0])[: plan.maximum]]
    return [replace(agent, name=f"{agent.model} {k}") for k, agent in enumerate(nearest, 1)]


TRAFFIC = TrafficPlan(minimum=0, maximum=6, wake_distance=0.0)
SCENARIO = ScenarioType(
    name="LaneTraffic",
    title="Lane traffic",
    nhtsa="The ego drives with others along a road of several lanes.",
    build=build,
    parameters=(
        Parameter("speed", 3.0, 40.0, 14.0, "m/s", "mean speed that the vehicles want"),
        Parameter("speed_spread", 0.0, 5.0, 1.5, "m/s", "half range of the speeds that they want"),
        Parameter("headway", 1.0, 10.0, 2.0, "s", "mean time from one vehicle to the next of its lane"),
    ),
    traffic=TRAFFIC,
)

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
from ssad.scenarios.dynamic.knowledge._placing import LanePosition, pose_at, project
from ssad.scenarios.dynamic.knowledge.natural_junction import mixed_body
from ssad.world.models import model

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

_BEHIND, _AHEAD = 25.0, 80.0  # m around the ego covered by columns
_MIN_HEADWAY = 0.7  # s


def lanes_beside(graph: LaneGraph, lane: int) -> list[int]:
    """Return a lane and the driving lanes of its direction beside it, from left to right."""
    sides: list[list[int]] = [[], []]
    for adjacent, side_lanes in zip((graph.left, graph.right), sides, strict=True):
        neighbour = int(adjacent[lane])
        while neighbour >= 0 and graph.kind[neighbour] == LaneType.DRIVING and graph.is_same_direction(lane, neighbour):
            side_lanes.append(neighbour)
            neighbour = int(adjacent[neighbour])
    return [*reversed(sides[0]), lane, *sides[1]]


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Place the vehicles of each lane's column, the nearest to the ego first."""
    from ssad.world.roads import random_route

    plan = scenario.traffic or TRAFFIC
    values = SCENARIO.values(scenario.parameters)
    ego_lane = int(route.lane[0])
    if ego_lane < 0 or graph.junction[ego_lane] >= 0:
        raise RouteError("the ego of lane traffic starts on a lane, not in a junction or off the road")
    x, y = (float(coordinate) for coordinate in route.xy[0])
    candidates: list[tuple[float, EpisodeAgent]] = []
    for lane in lanes_beside(graph, ego_lane):
        ego_position = project(graph, lane, x, y).s
        # in its own lane the ego leads the column; other columns begin at a random position
        arc_length = (
            ego_position + 2.5 if lane == ego_lane else max(ego_position - _BEHIND - float(rng.uniform(0.0, 20.0)), 0.0)
        )
        while arc_length < min(ego_position + _AHEAD, float(graph.length[lane]) - 10.0):
            speed = values["speed"] + values["speed_spread"] * float(rng.uniform(-1.0, 1.0))
            model_name = mixed_body(rng)
            headway = _MIN_HEADWAY + float(rng.exponential(values["headway"] - _MIN_HEADWAY))
            arc_length += headway * values["speed"] + 0.5 * model(model_name).length
            if arc_length < float(graph.length[lane]) - 10.0:
                place = LanePosition(lane, arc_length)
                agent = EpisodeAgent(
                    name=model_name,
                    model=model_name,
                    controller=Controller.AUTOPILOT,
                    pose=pose_at(graph, place),
                    speed=speed,
                    target_speed=speed,
                    route=random_route(graph, lane, arc_length, 400.0, rng),
                    wake_distance=plan.wake_distance,
                )
                candidates.append((abs(arc_length - ego_position), agent))
            arc_length += 0.5 * model(model_name).length
    nearest_agents = [agent for _, agent in sorted(candidates, key=lambda pair: pair[0])[: plan.maximum]]
    return [replace(agent, name=f"{agent.model} {number}") for number, agent in enumerate(nearest_agents, 1)]


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

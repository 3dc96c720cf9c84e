"""Turning Obstacle: a cyclist crosses just behind the junction where the ego turns.

SafeBench's VehicleTurningRoute.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.types import EpisodeAgent, LaneType, Route, Scenario
from ssad.scenarios.dynamic.knowledge._kind import Parameter, ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import (
    junction_span,
    make_drive_phase,
    move_pose,
    place_ahead,
    pose_at,
    route_place,
    scripted_agent,
    to_outermost,
    width_at,
)

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

_PER_LANE = 1.0  # m further on for each lane crossed on the way to the kerb


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Place a cyclist (actor 0) beside the exit road, facing it."""
    values = SCENARIO.values(scenario.parameters)
    _, exit_index = junction_span(graph, scenario, route)
    exit_position = place_ahead(graph, route_place(graph, scenario, route, exit_index), values["exit_distance"])
    outermost, crossed = to_outermost(graph, exit_position, kinds=(LaneType.DRIVING, LaneType.PARKING))
    kerb_position = place_ahead(graph, outermost, _PER_LANE * crossed + values["longitudinal"])
    kerb = move_pose(pose_at(graph, kerb_position), 0.0, -values["lateral"] * width_at(graph, kerb_position))
    cyclist = move_pose(kerb, 0.0, 0.0, math.pi / 2.0 + values["yaw"])
    return [
        scripted_agent("cyclist", "bicycle", cyclist, [make_drive_phase(values["speed"], values["trigger_distance"])])
    ]


SCENARIO = ScenarioType(
    name="TurningObstacle",
    title="Turning Obstacle",
    nhtsa="The ego turns at a junction and finds an unseen cyclist crossing the road that it enters.",
    build=build,
    parameters=(
        Parameter("trigger_distance", 10.0, 50.0, 20.0, "m", "the cyclist starts when the ego is this near to it", 2.0),
        Parameter("speed", 2.0, 12.0, 10.0, "m/s", "speed that the cyclist accelerates to", 1.25),
        Parameter("exit_distance", 2.0, 20.0, 8.0, "m", "from the junction's exit along the route to the cyclist", 2.0),
        Parameter("longitudinal", -5.0, 5.0, 0.0, "m", "shift along the exit road"),
        Parameter("lateral", 0.0, 2.0, 1.0, "lane widths", "cyclist to the right of the outermost lane's centre", 0.15),
        Parameter("yaw", -math.pi, math.pi, 0.0, "rad", "turn of the cyclist from facing the road", 0.1),
    ),
    max_distance=180.0,
)

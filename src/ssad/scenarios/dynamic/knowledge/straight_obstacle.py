"""Straight Obstacle: a walker steps from behind a vending machine onto the road.

SafeBench's DynamicObjectCrossing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.rotations import wrap_scalar
from ssad.core.types import EpisodeAgent, LaneType, Pose, Route, Scenario
from ssad.scenarios.dynamic.knowledge._kind import Parameter, ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import (
    make_drive_phase,
    move_pose,
    place_ahead,
    pose_at,
    scripted_agent,
    standing_agent,
    to_outermost,
    trigger_place,
    width_at,
)

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

_PER_LANE = 1.5  # m further on for each lane between the ego's and the kerb
_BLOCKER = 0.9  # the vending machine stands at this share of the line from the trigger to the walker
_LANES = (LaneType.DRIVING, LaneType.SHOULDER, LaneType.PARKING, LaneType.BIKING)


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Place a walker (actor 0) beside the outermost lane, facing the road, behind a vending machine."""
    values = SCENARIO.values(scenario.parameters)
    reference = trigger_place(graph, scenario, route)
    outermost, crossed = to_outermost(graph, reference, kinds=_LANES)
    in_junction = bool(graph.junction[outermost.lane] >= 0)
    kerb_position = place_ahead(
        graph, outermost, values["start_distance"] + _PER_LANE * crossed, stop_at_junction=not in_junction
    )
    kerb = move_pose(pose_at(graph, kerb_position), 0.0, -values["lateral"] * width_at(graph, reference))
    walker = move_pose(kerb, 0.0, 0.0, math.pi / 2.0 + values["yaw"])
    origin = pose_at(graph, reference)
    blocker = Pose(
        origin.x + _BLOCKER * (walker.x - origin.x),
        origin.y + _BLOCKER * (walker.y - origin.y),
        wrap_scalar(walker.yaw + math.pi),
    )
    return [
        scripted_agent(
            "walker", "walker", walker, [make_drive_phase(values["walker_speed"], values["trigger_distance"])]
        ),
        standing_agent("vending machine", "vending_machine", blocker),
    ]


SCENARIO = ScenarioType(
    name="StraightObstacle",
    title="Straight Obstacle",
    nhtsa="The ego drives straight and an unseen walker enters the road; it must brake or swerve.",
    build=build,
    # the spread of the speed gives a standard deviation of 0.26 m/s: that of walking speeds (Weidmann 1993)
    parameters=(
        Parameter("trigger_distance", 15.0, 50.0, 20.0, "m", "the walker starts when the ego is this near to it", 2.0),
        Parameter("walker_speed", 0.5, 4.0, 2.5, "m/s", "speed of the walker", 0.45),
        Parameter("start_distance", 35.0, 55.0, 45.0, "m", "from the trigger along the lane to the walker", 3.0),
        Parameter("lateral", 0.0, 1.0, 1.0, "lane widths", "walker to the right of the outermost lane's centre", 0.15),
        Parameter("yaw", -math.pi / 3, math.pi / 3, 0.0, "rad", "turn of the walker from facing the road", 0.1),
    ),
    max_distance=150.0,
)

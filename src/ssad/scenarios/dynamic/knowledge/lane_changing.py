"""Lane Changing: the car ahead brakes hard while another fills the lane to the left.

SafeBench's OtherLeadingVehicle.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssad.core.types import EpisodeAgent, Phase, PhaseTrigger, Route, Scenario
from ssad.scenarios.dynamic.knowledge._kind import Parameter, ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import (
    ahead_and_left,
    bending_route,
    make_drive_phase,
    pose_at,
    scripted_agent,
)

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Place a leader (actor 0) in the ego's lane and a neighbour (actor 1) to its left.

    Raises:
        RouteError: There is no lane to the left.
    """
    values = SCENARIO.values(scenario.parameters)
    leader_position, neighbour_position = ahead_and_left(
        graph, scenario, route, distance=values["distance"], gap=values["gap"]
    )
    drive_phase = make_drive_phase(values["leader_speed"], values["trigger_distance"])
    brake_phase = Phase(values["brake_speed"], PhaseTrigger("travelled", values["brake_after"]))
    return [
        scripted_agent(
            "leader",
            "suv",
            pose_at(graph, leader_position),
            [drive_phase, brake_phase],
            bending_route(graph, leader_position),
        ),
        scripted_agent(
            "neighbour",
            "coupe",
            pose_at(graph, neighbour_position),
            [make_drive_phase(values["neighbour_speed"], values["trigger_distance"])],
            bending_route(graph, neighbour_position),
        ),
    ]


SCENARIO = ScenarioType(
    name="LaneChanging",
    title="Lane Changing",
    nhtsa="The ego follows a car that decelerates suddenly; the lane it would evade to is taken.",
    build=build,
    parameters=(
        Parameter("trigger_distance", 20.0, 50.0, 35.0, "m", "both start when the ego is this near to the leader", 2.0),
        Parameter("distance", 30.0, 40.0, 35.0, "m", "from the trigger along the lane to the leader", 2.0),
        Parameter("gap", 0.0, 5.0, 1.0, "m", "neighbour ahead of the leader", 1.0),
        Parameter("leader_speed", 8.0, 16.0, 12.0, "m/s", "speed of the leader before it brakes", 1.5, (8.0, 20.0)),
        Parameter("neighbour_speed", 8.0, 16.0, 12.0, "m/s", "speed of the neighbour", 1.5, (8.0, 20.0)),
        Parameter("brake_after", 2.0, 20.0, 5.0, "m", "the leader brakes after driving this far", 1.5, (2.0, 25.0)),
        Parameter("brake_speed", 0.0, 6.0, 2.0, "m/s", "speed that the leader brakes to", 0.5),
    ),
    max_distance=200.0,
)

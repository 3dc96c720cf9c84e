"""Vehicle Passing: a parked car blocks the lane and another comes up beside it.

SafeBench's ManeuverOppositeDirection.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssad.core.types import EpisodeAgent, Route, Scenario
from ssad.scenarios.dynamic.knowledge._kind import Parameter, ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import (
    ahead_and_left,
    bending_route,
    make_drive_phase,
    pose_at,
    scripted_agent,
    standing_agent,
)

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Place a parked car (actor 0) in the ego's lane and an oncoming car (actor 1) in the lane to the left."""
    values = SCENARIO.values(scenario.parameters)
    parked_place, oncoming_place = ahead_and_left(
        graph, scenario, route, distance=values["distance"], gap=values["gap"]
    )
    return [
        standing_agent("parked car", "compact", pose_at(graph, parked_place)),
        scripted_agent(
            "oncoming car",
            "compact",
            pose_at(graph, oncoming_place),
            [make_drive_phase(values["speed"], values["trigger_distance"])],
            bending_route(graph, oncoming_place),
        ),
    ]


SCENARIO = ScenarioType(
    name="VehiclePassing",
    title="Vehicle Passing",
    nhtsa="The ego's lane is blocked; to pass it must use the opposite lane, where a car comes towards it.",
    build=build,
    parameters=(
        Parameter(
            "trigger_distance",
            20.0,
            60.0,
            45.0,
            "m",
            "the car starts when the ego is this near to the parked one",
            2.0,
        ),
        Parameter("distance", 40.0, 60.0, 50.0, "m", "from the trigger along the lane to the parked car", 3.0),
        Parameter("gap", 20.0, 40.0, 30.0, "m", "oncoming car behind the parked one, along the ego's lane", 3.0),
        Parameter("speed", 6.0, 10.0, 8.0, "m/s", "speed of the oncoming car", 1.0),
    ),
    max_distance=200.0,
)

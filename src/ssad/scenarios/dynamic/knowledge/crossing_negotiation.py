"""Crossing Negotiation: two cars meet at a junction without right-of-way rules.

SafeBench's NoSignalJunctionCrossingRoute.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssad.core.types import EpisodeAgent, Route, Scenario, SignalPlan
from ssad.scenarios.dynamic.knowledge._junction import FROM_LEFT, FROM_RIGHT, junction_parameters, meeting_car
from ssad.scenarios.dynamic.knowledge._kind import ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import wait_and_drive_phases

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Place a car (actor 0) on the crossing road, from the left if there is such an approach."""
    values = SCENARIO.values(scenario.parameters)
    phases = wait_and_drive_phases(values["speed"], values["trigger_distance"])
    return meeting_car(
        SCENARIO, scenario, graph, route, name="crossing car", sides=(FROM_LEFT, FROM_RIGHT), phases=phases
    )


SCENARIO = ScenarioType(
    name="CrossingNegotiation",
    title="Crossing Negotiation",
    nhtsa="The ego meets a crossing car at a junction without signals.",
    build=build,
    parameters=junction_parameters(speed=10.0, trigger_distance=35.0),
    signals=SignalPlan(ego="off", others="off"),
    max_distance=150.0,
)

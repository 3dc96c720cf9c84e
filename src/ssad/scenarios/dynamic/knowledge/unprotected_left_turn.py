"""Unprotected Left-turn: an oncoming car has green too.

SafeBench's SignalizedJunctionLeftTurn.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssad.core.types import EpisodeAgent, Route, Scenario, SignalPlan
from ssad.scenarios.dynamic.knowledge._junction import ONCOMING, junction_parameters, meeting_car
from ssad.scenarios.dynamic.knowledge._kind import ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import make_drive_phase

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Place a car (actor 0) on the opposite approach; it goes straight on."""
    values = SCENARIO.values(scenario.parameters)
    phases = [make_drive_phase(values["speed"], values["trigger_distance"])]
    return meeting_car(SCENARIO, scenario, graph, route, name="oncoming car", sides=(ONCOMING,), phases=phases)


SCENARIO = ScenarioType(
    name="UnprotectedLeftTurn",
    title="Unprotected Left-turn",
    nhtsa="The ego turns left at green across the path of an oncoming car that has green too.",
    build=build,
    parameters=junction_parameters(speed=12.0, trigger_distance=45.0),
    signals=SignalPlan(ego="green", others="green"),
    max_distance=150.0,
)

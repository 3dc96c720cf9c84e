"""Right-turn: a car from the left has green where the ego turns in.

SafeBench's SignalizedJunctionRightTurn.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssad.core.types import EpisodeAgent, Route, Scenario, SignalPlan
from ssad.scenarios.dynamic.knowledge._junction import FROM_LEFT, junction_parameters, meeting_car
from ssad.scenarios.dynamic.knowledge._kind import ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import wait_and_drive_phases

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Place a car (actor 0) from the left, on the road that the ego turns into."""
    values = SCENARIO.values(scenario.parameters)
    phases = wait_and_drive_phases(values["speed"], values["trigger_distance"])
    return meeting_car(SCENARIO, scenario, graph, route, name="car from the left", sides=(FROM_LEFT,), phases=phases)


SCENARIO = ScenarioType(
    name="RightTurn",
    title="Right-turn",
    nhtsa="The ego turns right at red into a road where a car from the left has green.",
    build=build,
    parameters=junction_parameters(speed=12.0, trigger_distance=35.0),
    signals=SignalPlan(ego="red", others="green"),
    max_distance=150.0,
)

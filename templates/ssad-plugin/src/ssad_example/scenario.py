"""A class of scenarios: several walkers cross the ego's road, one after the other."""

from __future__ import annotations

import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Controller, EpisodeAgent, Phase, PhaseTrigger, Pose, Route, Scenario
from ssad.scenarios.dynamic import Parameter, ScenarioType


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """All agents but the ego: three walkers to the right of the road, who start when the ego is near."""
    value = SCENARIO.values(scenario.parameters)
    walkers = []
    for number in range(3):
        at = min(round(value["distance"] + number * value["gap"]), len(route.xy) - 1)  # route points are 1 m apart
        yaw, side = float(route.yaw[at]), 1.5 * float(route.width[at])
        x, y = route.xy[at].astype(float) + side * np.array([np.sin(yaw), -np.cos(yaw)])
        start = Phase(value["speed"], PhaseTrigger("ego_distance", value["trigger"], number))
        walkers.append(
            EpisodeAgent(
                f"walker {number}",
                "walker",
                Controller.SCRIPT,
                Pose(float(x), float(y), yaw + np.pi / 2),
                target_speed=value["speed"],
                phases=(start,),
            )
        )
    return walkers


SCENARIO = ScenarioType(
    name="ExampleWalkers",
    title="Three walkers",
    nhtsa="Walkers enter the road ahead of the ego, one after the other.",
    build=build,
    parameters=(
        # name, least, greatest, default, unit, what it is, and how much repetitions vary it
        Parameter("distance", 20.0, 60.0, 40.0, "m", "along the route to the first walker", 3.0),
        Parameter("gap", 2.0, 10.0, 5.0, "m", "between two walkers", 1.0),
        Parameter("trigger", 10.0, 40.0, 25.0, "m", "a walker starts when the ego is this near", 2.0),
        Parameter("speed", 0.5, 4.0, 1.8, "m/s", "speed of the walkers", 0.26),
    ),
    max_distance=150.0,
    scenarios=(  # what the class stands for in a suite, `scenarios: [ExampleWalkers]`; more are in walkers.yaml
        Scenario("Walkers/crossing", "ExampleWalkers", "ProvingGround", (Pose(217.0, -5.25), Pose(317.0, -5.25))),
    ),
)

"""What the four junction scenarios share: one car that meets the ego in a junction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ssad.core.types import EpisodeAgent, Phase, Route, Scenario
from ssad.scenarios.dynamic.knowledge._kind import Parameter, ScenarioType
from ssad.scenarios.dynamic.knowledge._meeting import meeting_place
from ssad.scenarios.dynamic.knowledge._placing import (
    ahead,
    bending_route,
    pose_at,
    scripted,
    shifted,
)

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

FROM_LEFT = -math.pi / 2.0
FROM_RIGHT = math.pi / 2.0
ONCOMING = math.pi
_BODY = "coupe"


def box(speed: float, trigger_distance: float) -> tuple[Parameter, ...]:
    """Speed, trigger distance and place, each 5 either side of SafeBench's value."""
    return (
        Parameter(
            "trigger_distance", trigger_distance - 5.0, trigger_distance + 5.0, trigger_distance, "m",
            "the car starts when the ego is this near to it",
        ),
        Parameter("speed", speed - 5.0, speed + 5.0, speed, "m/s", "speed that the car accelerates to"),
        Parameter("longitudinal", -5.0, 5.0, 0.0, "m", "shift of the car along its heading"),
    )  # fmt: skip


def meeting_car(
    kind: ScenarioType,
    scenario: Scenario,
    graph: LaneGraph,
    route: Route,
    *,
    name: str,
    sides: Sequence[float],
    phases: Sequence[Phase],
) -> list[EpisodeAgent]:
    """The car where the author put it, going straight; else on a lane, where it meets the ego.

    That place is found with the class's default speed and trigger distance: other values change the outcome.
    """
    value = kind.values(scenario.parameters)
    if scenario.placements:
        pose = shifted(scenario.placements[0], value["longitudinal"], 0.0)
        return [scripted(name, _BODY, pose, phases)]
    place = meeting_place(
        graph,
        scenario,
        route,
        sides=sides,
        trigger_distance=kind.box["trigger_distance"].default,
        speed=kind.box["speed"].default,
        body=_BODY,
    )
    place = ahead(graph, place, value["longitudinal"])
    return [scripted(name, _BODY, pose_at(graph, place), phases, bending_route(graph, place))]

"""Shared parts of the four junction scenarios: one car that meets the ego in a junction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ssad.core.types import EpisodeAgent, Phase, Route, Scenario
from ssad.scenarios.dynamic.knowledge._kind import SPEED_SPREAD, Parameter, ScenarioType
from ssad.scenarios.dynamic.knowledge._meeting import meeting_place
from ssad.scenarios.dynamic.knowledge._placing import (
    bending_route,
    move_pose,
    place_ahead,
    pose_at,
    scripted_agent,
)

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

FROM_LEFT = -math.pi / 2.0
FROM_RIGHT = math.pi / 2.0
ONCOMING = math.pi
_BODY = "coupe"


def junction_parameters(speed: float, trigger_distance: float) -> tuple[Parameter, ...]:
    """Return the parameters of a car that meets the ego in a junction, each 5 around SafeBench's value.

    Args:
        speed: SafeBench's speed of the car, m/s.
        trigger_distance: SafeBench's trigger distance, m.

    Returns:
        Trigger distance, speed and place along the car's heading.
    """
    return (
        Parameter(
            "trigger_distance",
            trigger_distance - 5.0,
            trigger_distance + 5.0,
            trigger_distance,
            "m",
            "the car starts when the ego is this near to it",
            2.0,
            (trigger_distance - 6.0, trigger_distance + 6.0),
        ),
        Parameter(
            "speed",
            speed - 5.0,
            speed + 5.0,
            speed,
            "m/s",
            "speed that the car accelerates to",
            SPEED_SPREAD * speed,
        ),
        Parameter("longitudinal", -5.0, 5.0, 0.0, "m", "shift of the car along its heading", 1.5),
    )


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
    """Return the car at its placement, going straight; else on a lane from which it meets the ego.

    That place is found with the class's default speed and trigger distance: other values change the outcome.

    Args:
        kind: The scenario's class.
        scenario: The scenario; its first placement, if there is one, is the car's place.
        graph: Lane graph of the town.
        route: The ego's route.
        name: Name of the car.
        sides: Headings of the car relative to the ego's, rad, best first.
        phases: What the car does.

    Returns:
        The car alone.

    Raises:
        RouteError: No lane into the ego's junction crosses its route.
    """
    values = kind.values(scenario.parameters)
    if scenario.placements:
        pose = move_pose(scenario.placements[0], values["longitudinal"], 0.0)
        return [scripted_agent(name, _BODY, pose, phases)]
    start_place = meeting_place(
        graph,
        scenario,
        route,
        sides=sides,
        trigger_distance=kind.box["trigger_distance"].default,
        speed=kind.box["speed"].default,
        body=_BODY,
    )
    start_place = place_ahead(graph, start_place, values["longitudinal"])
    return [scripted_agent(name, _BODY, pose_at(graph, start_place), phases, bending_route(graph, start_place))]

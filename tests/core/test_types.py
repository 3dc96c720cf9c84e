"""Numbers that are written to disk and read by kernels keep their meaning."""

from __future__ import annotations

from enum import IntEnum, IntFlag

import numpy as np
import pytest

from ssad.core.types import (
    AgentKind,
    Contact,
    Controller,
    EpisodeAgent,
    EpisodeLimits,
    LaneType,
    PhaseTrigger,
    Pose,
    Route,
    Scenario,
    SignalPlan,
    SignalState,
    TrafficPlan,
)


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (LaneType, "NONE DRIVING SHOULDER SIDEWALK PARKING BIKING MEDIAN"),
        (AgentKind, "NONE CAR TRUCK BUS MOTORCYCLE BICYCLE WALKER PROP"),
        (SignalState, "OFF RED YELLOW GREEN"),
        (Controller, "NONE EXTERNAL AUTOPILOT FOLLOW SCRIPT PLACED TRAJECTORY"),
    ],
)
def test_numbers_of_kinds(kind: type[IntEnum], names: str) -> None:
    """Towns, traces and results hold them."""
    assert {member.name: int(member) for member in kind} == {name: k for k, name in enumerate(names.split())}


def test_contacts_are_bits() -> None:
    assert issubclass(Contact, IntFlag)
    found = {member.name: int(member) for member in Contact.__members__.values()}
    assert found == {"NONE": 0, "VEHICLE": 1, "WALKER": 2, "CYCLIST": 4, "STATIC": 8}


def test_what_a_scenario_leaves_out() -> None:
    """Scenario files rely on these: a file that names none of them means them."""
    scenario = Scenario("s", "Custom", "Town", (Pose(0, 0), Pose(9, 0)))
    assert (scenario.target_speed, scenario.seed, scenario.group, scenario.source) == (8.0, 0, "", "")
    assert (scenario.trigger, scenario.traffic, scenario.actors, scenario.placements) == (None, None, (), ())
    assert scenario.signals == SignalPlan("program", "program", 60.0)
    assert scenario.limits == EpisodeLimits(300, 60.0, 1.0e9)
    assert TrafficPlan() == TrafficPlan(0.3, 5, 18, 50.0)
    assert PhaseTrigger() == PhaseTrigger("always", 0.0, 0)
    assert Pose(1.0, 2.0).yaw == 0.0
    agent = EpisodeAgent("a", "car", Controller.NONE, Pose(0, 0))
    assert (agent.speed, agent.target_speed, agent.phases, agent.route, agent.wake_distance) == (
        0.0,
        8.0,
        (),
        None,
        0.0,
    )


def test_a_route_is_as_long_as_its_steps() -> None:
    points = np.zeros((5, 2), np.float32)
    flat, lanes = np.zeros(5, np.float32), np.zeros(5, np.int32)
    assert Route(points, flat, lanes, flat, flat).length == 4.0
    assert Route(points, flat, lanes, flat, flat, spacing=0.5).length == 2.0

"""Drivers at motorway speeds on the high-speed track: who holds the test speed, and who stops in time."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Actor, EpisodeLimits, EpisodeTrace, LaneType, Phase, Pose, Scenario
from ssad.drivers import make_system
from ssad.scenarios.dynamic import build_episode
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

TRACK = "HighSpeedTrack"
MOTORWAY = 130.0 / 3.6  # m/s
SPEEDS = (10.0 / 3.6, MOTORWAY, 40.0)
WALL = tuple(Actor(f"wall {lane}", "truck", Pose(450.0, y)) for lane, y in enumerate((-1.75, -5.25)))
SLOW = Actor("slow", "car", Pose(120.0, -1.75), speed=70.0 / 3.6, phases=(Phase(70.0 / 3.6),))
PARKED = Actor("parked", "car", Pose(60.0, -1.75))


@cache
def track() -> LaneGraph:
    return load_town(TRACK)


@cache
def drives(system: str) -> list[EpisodeTrace]:
    """Drives along the southern straight from a rolling start: free ones, then one to each obstacle."""
    cases = [(speed, (), 50) for speed in SPEEDS]
    cases += [(MOTORWAY, WALL, 250), (MOTORWAY, (SLOW,), 150), (20.0 / 3.6, (PARKED,), 150)]
    episodes = [
        build_episode(
            Scenario(
                f"test/{number}",
                "Custom",
                TRACK,
                (Pose(0.0, -1.75), Pose(700.0, -1.75)),
                target_speed=speed,
                parameters={"ego_speed": speed},
                actors=actors,
                limits=EpisodeLimits(max_steps=steps),
            ),
            track(),
            seed=0,
        )
        for number, (speed, actors, steps) in enumerate(cases)
    ]
    return rollout(World(episodes, {TRACK: track()}), make_system(system))


def test_the_track_has_a_straight_of_two_kilometres_without_a_limit_below_40_m_s() -> None:
    graph = track()
    straight = (graph.kind == LaneType.DRIVING) & (graph.length > 2000.0)
    assert straight.sum() == 4
    assert graph.speed_limit[straight].min() >= 40.0
    assert not len(graph.signal_phase)


@pytest.mark.parametrize("system", ["autopilot", "no-action", "careful-reg157"])
def test_drivers_hold_the_test_speed_and_their_lane(system: str) -> None:
    for speed, trace in zip(SPEEDS, drives(system), strict=False):
        assert trace.speed[:, 0] == pytest.approx(speed, abs=0.05)
        assert np.abs(trace.y[:, 0] + 1.75).max() < 0.05


def test_no_action_hits_what_stands_there_at_the_test_speed() -> None:
    for speed, trace in zip((MOTORWAY, MOTORWAY, 20.0 / 3.6), drives("no-action")[3:], strict=True):
        assert trace.end == "collision"
        assert trace.speed[-1, 0] == pytest.approx(speed, abs=0.05)


@pytest.mark.parametrize("system", ["autopilot", "careful-reg157"])
def test_drivers_avoid_what_stands_or_creeps_on_the_motorway(system: str) -> None:
    wall, slow, parked = drives(system)[3:]
    assert {trace.end for trace in (wall, slow, parked)} == {"max_steps"}
    assert wall.speed[-1, 0] < 8.0
    assert np.diff(wall.speed[:, 0]).min() / 0.1 > -5.0  # they see it early enough for gentle braking

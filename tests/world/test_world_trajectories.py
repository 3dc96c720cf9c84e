"""Actors that follow a time-stamped trajectory: where they are, when they are there, and what others make of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.types import Actor, Controller, EpisodeAgent, EpisodeLimits, Pose, Scenario
from ssad.scenarios.dynamic.episode import build_episode
from ssad.scenarios.dynamic.schema import check
from ssad.scenarios.dynamic.yamlio import read_scenarios, save_scenarios
from ssad.world.roads.library import load_town
from ssad.world.world import World

from .worlds import GRAPHS, ego, episode

FAR = EpisodeLimits(max_steps=10_000, max_time=1e6)


def follower(rows: list[tuple[float, float, float, float]], name: str = "other") -> EpisodeAgent:
    return EpisodeAgent(name, "car", Controller.TRAJECTORY, Pose(*rows[0][1:]), trajectory=tuple(rows))


def curve(until: float = 6.0, spacing: float = 0.5, begin: float = 0.0) -> list[tuple[float, float, float, float]]:
    """A bend of 20 m radius at 5 m/s, far from the ego, through a heading of 180 degrees."""
    times = np.arange(begin, until + 1e-9, spacing)
    angle = 0.25 * times + 2.8
    return [
        (t, 200 + 20 * np.sin(a), 60 - 20 * np.cos(a), float(np.angle(np.exp(1j * a))))
        for t, a in zip(times.tolist(), angle.tolist(), strict=True)
    ]


def test_it_is_where_its_rows_have_it() -> None:
    rows = curve(spacing=0.1)
    world = World([episode(ego(), follower(rows), limits=FAR)], GRAPHS)
    for k in range(1, 60):
        world.step(np.zeros((1, 2, 3), np.float32))
        pose = world.array("pose")[0, 1]
        assert np.hypot(*(pose[:2] - rows[k][1:3])) < 1e-3
        assert abs(np.angle(np.exp(1j * (pose[2] - rows[k][3])))) < 1e-3
        assert world.array("speed")[0, 1] == pytest.approx(5.0, rel=1e-2)


def test_between_rows_it_goes_straight_on_and_backwards_has_a_negative_speed() -> None:
    rows = [(0.0, 300.0, 60.0, 0.0), (2.0, 290.0, 60.0, 0.0), (3.0, 290.0, 60.0, 0.0)]
    world = World([episode(ego(), follower(rows), limits=FAR)], GRAPHS)
    for _ in range(5):
        world.step(np.zeros((1, 2, 3), np.float32))
    assert world.array("pose")[0, 1].tolist() == pytest.approx([297.5, 60.0, 0.0], abs=1e-4)
    assert world.array("speed")[0, 1] == pytest.approx(-5.0)
    for _ in range(20):
        world.step(np.zeros((1, 2, 3), np.float32))
    assert world.array("speed")[0, 1] == 0.0


def test_between_rows_it_turns_the_short_way() -> None:
    rows = [(0.0, 300.0, 60.0, 3.0), (1.0, 300.0, 60.0, -3.0)]
    world = World([episode(ego(), follower(rows), limits=FAR)], GRAPHS)
    for _ in range(3):
        world.step(np.zeros((1, 2, 3), np.float32))
    assert world.array("pose")[0, 1, 2] == pytest.approx(3.0 + 0.3 * (2 * np.pi - 6.0), abs=1e-4)


def test_before_and_after_its_rows_it_is_not_there_and_hits_nobody() -> None:
    here = [(0.6, 30.0, 0.0, 0.0), (1.0, 30.0, 0.0, 0.0)]
    world = World([episode(ego(x=30.0), follower(here), limits=replace(FAR, contact="count"))], GRAPHS)
    there = []
    for _ in range(15):
        world.step(np.zeros((1, 2, 3), np.float32))
        there.append((bool(world.array("active")[0, 1]), bool(world.array("ego.touching")[0])))
    assert there == [(0.55 < 0.1 * k < 1.05, 0.55 < 0.1 * k < 1.05) for k in range(1, 16)]


def test_who_is_removed_after_a_contact_does_not_come_back() -> None:
    rows = [(0.0, 60.0, 0.0, 0.0), (9.0, 60.0, 0.0, 0.0)]
    world = World([episode(ego(x=40.0, speed=15.0), follower(rows), limits=replace(FAR, contact="remove"))], GRAPHS)
    there = []
    for _ in range(40):
        world.step(np.zeros((1, 2, 3), np.float32))
        there.append(bool(world.array("active")[0, 1]))
    assert there[0]
    assert not any(there[-20:])


def test_who_is_removed_by_hand_does_not_come_back_until_the_scene_starts_again() -> None:
    world = World([episode(ego(), follower(curve()), limits=FAR)], GRAPHS)
    world.step(np.zeros((1, 2, 3), np.float32))
    world.remove(np.array([[False, True]]))
    for _ in range(3):
        world.step(np.zeros((1, 2, 3), np.float32))
        assert not world.array("active")[0, 1]
    world.reset()
    world.step(np.zeros((1, 2, 3), np.float32))
    assert world.array("active")[0, 1]


def test_a_snapshot_continues_to_the_bit() -> None:
    world = World([episode(ego(speed=5.0), follower(curve(begin=0.25)), limits=FAR)], GRAPHS)
    for _ in range(10):
        world.step(np.zeros((1, 2, 3), np.float32))
    kept = world.snapshot()
    ends = []
    for _ in range(2):
        world.restore(kept)
        for _ in range(30):
            world.step(np.zeros((1, 2, 3), np.float32))
        ends.append(world.hashes())
    assert ends[0] == ends[1]


def scenario(**changes: object) -> Scenario:
    rows = tuple(curve())
    actor = Actor("other", "suv", Pose(*rows[0][1:]), trajectory=rows)
    route = (Pose(217.0, -5.25), Pose(317.0, -5.25))
    base = Scenario("Logged/one", "Custom", "ProvingGround", route, actors=(replace(actor, **changes),))
    check(base)
    return base


def test_a_scenario_with_a_trajectory_round_trips(tmp_path: Path) -> None:
    one = scenario()
    save_scenarios(tmp_path / "one.yaml", [one])
    assert read_scenarios(tmp_path / "one.yaml") == (one,)


def test_it_starts_in_the_middle_of_a_trajectory_that_began_before() -> None:
    rows = tuple(curve(begin=-1.25))
    made = build_episode(scenario(trajectory=rows, pose=Pose(*rows[0][1:])), load_town("ProvingGround"), seed=0)
    agent = made.agents[1]
    assert agent.controller == Controller.TRAJECTORY
    k = 2  # rows at -0.25 and 0.25
    assert agent.pose.x == pytest.approx((rows[k][1] + rows[k + 1][1]) / 2)
    assert agent.speed == pytest.approx(5.0, rel=0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trajectory": ((0.0, 1.0, 2.0, 0.0),), "pose": Pose(1.0, 2.0)}, "at least two rows"),
        ({"trajectory": ((0.0, 1.0, 2.0, 0.0), (0.0, 2.0, 2.0, 0.0)), "pose": Pose(1.0, 2.0)}, "times must increase"),
        ({"trajectory": ((0.0, 1.0, 2.0, 0.0), (1.0, 1e9, 2.0, 0.0)), "pose": Pose(1.0, 2.0)}, "beyond"),
        ({"pose": Pose(1.0, 2.0)}, "differs from the first row"),
        ({"path": ((0.0, 0.0), (1.0, 0.0))}, "neither phases nor a path"),
    ],
)
def test_what_is_no_trajectory(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        scenario(**changes)

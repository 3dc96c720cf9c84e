"""Grades: who avoids a collision in the same encounter, when the danger begins, and what nobody avoids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.types import Controller, Episode, EpisodeAgent, EpisodeLimits, EpisodeTrace, Phase, PhaseTrigger, Pose
from ssad.drivers import make_system
from ssad.drivers.careful import grade
from ssad.drivers.careful.grade import Grade, grade_collision, grade_collisions
from ssad.drivers.careful.limit import wrong_side
from ssad.world.rollout import rollout
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode, line_route


def walker(distance: float, trigger: float, speed: float = 2.5) -> EpisodeAgent:
    """Walks into the road 60 m down it once the ego is near."""
    start = Pose(60.0, -distance, np.pi / 2)
    phases = (Phase(speed, PhaseTrigger("ego_distance", trigger, 0)),)
    return EpisodeAgent("walker", "walker", Controller.SCRIPT, start, phases=phases)


def drive(one: Episode) -> EpisodeTrace:
    (trace,) = rollout(World([one], GRAPHS), make_system("blind"))
    return trace


def graded(*others: EpisodeAgent, **more: float) -> Grade:
    one = episode(ego(speed=10.0, **more), *others)
    trace = drive(one)
    assert trace.end == "collision"
    return grade_collision(one, GRAPHS["Straight"], trace)


def test_who_walks_out_early_is_avoided_by_all_and_late_by_fewer() -> None:
    early, late = graded(walker(8.0, 34.0)), graded(walker(3.4, 14.0))
    assert early.verdict == "avoidable"
    assert all(early.avoids[name] for name in ("cc", "rss", "fsm"))
    assert early.exact
    assert late.verdict == "limit"
    assert not any(late.avoids.values())
    assert early.limit.latest < early.contact - early.danger + 1e-6


def test_a_wall_at_the_bumper_is_marked_unavoidable() -> None:
    wall = [EpisodeAgent(f"b{k}", "truck", Controller.NONE, Pose(17.0, y, np.pi / 2)) for k, y in enumerate((-9, 0, 9))]
    found = graded(*wall)
    assert found.verdict == "unavoidable"
    assert not any(found.avoids.values())
    assert found.limit.manoeuvre is None
    assert np.isnan(found.limit.latest)
    assert found.metrics() == {f"avoided_by_{name}": 0.0 for name in ("cc", "reg157", "rss", "fsm", "limit")}


def test_nobody_reacts_to_whom_a_van_hides() -> None:
    # the walker comes from behind a van that stands beside the lane
    van = EpisodeAgent("van", "van", Controller.NONE, Pose(56.6, -2.2, 0.0))
    hidden, open_ = graded(walker(6.0, 26.0), van), graded(walker(6.0, 26.0))
    assert not any(hidden.avoids.values())
    assert sum(open_.avoids.values()) == 3
    never = graded(walker(3.6, 17.0), van)
    assert never.contact - never.danger < 0.6, "it is seen only at the last moment"


def test_the_danger_begins_with_the_script_or_while_both_are_on_course() -> None:
    found = graded(walker(8.0, 34.0))
    trace = drive(episode(ego(speed=10.0), walker(8.0, 34.0)))
    moves = int(np.flatnonzero(trace.speed[:, 1] > 0)[0])
    assert found.danger == pytest.approx(moves * trace.dt, abs=0.11)
    car = EpisodeAgent("car", "car", Controller.NONE, Pose(90.0, 0.0, 0.0))
    stands = graded(car)
    assert stands.contact - stands.danger == pytest.approx(4.0, abs=0.15)
    assert all(stands.avoids.values())


def test_an_oncoming_car_in_the_own_lane_is_an_encounter_too() -> None:
    oncoming = EpisodeAgent(
        "car",
        "car",
        Controller.FOLLOW,
        Pose(150.0, 0.0, np.pi),
        speed=10.0,
        target_speed=10.0,
        route=line_route(150.0, 0.0),
    )
    found = graded(oncoming)
    # to stop does not help where the other drives on
    assert found.contact - found.danger > 3.5
    assert not any(found.avoids.values())
    # nor does a manoeuvre on the own side: the lane is 3.5 m wide and ends at a sidewalk
    assert found.verdict == "unavoidable"


def test_the_own_side_of_the_road_ends_at_its_middle() -> None:
    assert wrong_side(episode(ego()), GRAPHS["Straight"]).tolist() == [False, True, False]


def test_a_grade_is_the_same_again_and_leaves_the_recorded_drive_as_it_was() -> None:
    one = episode(ego(speed=10.0), walker(5.0, 20.0))
    trace = drive(one)
    first, second = (grade_collision(one, GRAPHS["Straight"], trace) for _ in range(2))
    assert first == second
    short = replace(one, limits=EpisodeLimits(max_steps=len(trace.x) - 1))
    assert grade_collision(short, GRAPHS["Straight"], trace).avoids == first.avoids


def test_a_town_may_be_known_by_the_path_of_its_map() -> None:
    one = episode(ego(speed=10.0), walker(8.0, 34.0))
    named = grade_collision(one, GRAPHS["Straight"], trace := drive(one))
    assert grade_collision(replace(one, town="maps/Straight.xodr"), GRAPHS["Straight"], trace) == named


def test_grades_do_not_depend_on_who_is_graded_beside(monkeypatch: pytest.MonkeyPatch) -> None:
    van = EpisodeAgent("van", "van", Controller.NONE, Pose(56.6, -2.2, 0.0))
    wall = [EpisodeAgent(f"b{k}", "truck", Controller.NONE, Pose(17.0, y, np.pi / 2)) for k, y in enumerate((-9, 0, 9))]
    some = [episode(ego(speed=10.0), *others) for others in ([walker(8.0, 34.0)], wall, [walker(6.0, 26.0), van])]
    # another town, whose name comes first: its lanes are counted before
    graphs = [GRAPHS["Straight"]] * 3 + [replace(GRAPHS["Straight"], name="Another")]
    some.append(replace(some[0], town="Another"))
    drives = [
        (one, graph, rollout(World([one], {graph.name: graph}), make_system("blind"))[0])
        for one, graph in zip(some, graphs, strict=True)
    ]
    alone = [grade_collision(*drive) for drive in drives]
    assert {one.verdict for one in alone} >= {"avoidable", "unavoidable"}
    for scenes in (4096, 1):  # all in one world, one after another
        monkeypatch.setattr(grade, "SCENES", scenes)
        together = grade_collisions(drives)
        assert [repr(one) for one in together] == [repr(one) for one in alone]  # NaN is not equal to itself
    assert grade_collisions([]) == []


def test_without_a_collision_there_is_nothing_to_grade() -> None:
    one = episode(ego(speed=10.0))
    with pytest.raises(ValueError, match="no contact"):
        grade_collision(one, GRAPHS["Straight"], drive(one))

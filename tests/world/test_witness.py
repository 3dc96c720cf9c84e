"""The feasibility witness: verdicts on plain cases, and the driver it names really stays clear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssad.core.types import Condition, Controller, EpisodeAgent, Phase, Pose
from ssad.world.rollout import rollout
from ssad.world.witness import _drive, find_witness, shifted
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode, line_route


def walker(distance: float, trigger: float) -> EpisodeAgent:
    return EpisodeAgent(
        "w",
        "walker",
        Controller.SCRIPT,
        Pose(60.0, -distance, np.pi / 2),
        phases=(Phase(2.5, Condition("ego_distance", trigger, 0)),),
    )


class Asked:
    """Runs episodes as they are."""

    name = "asked"
    controller = Controller.FOLLOW

    def reset(self, episodes) -> None: ...

    def act(self, view): ...


def test_a_late_walker_is_avoidable_and_the_witness_can_be_run() -> None:
    one = episode(ego(speed=8.0), walker(6.0, 20.0))
    found = find_witness(one, GRAPHS["Straight"])
    assert found.verdict == "avoidable"
    assert found.route_complete == 100.0
    assert 0 < found.clear <= found.tried
    m = found.manoeuvre
    assert m is not None
    assert m.start >= found.trigger
    blind = rollout(World([one], GRAPHS), Asked())[0]
    assert blind.end == "collision"
    place = float(np.argmin(np.abs(blind.x[int(m.start / 0.1), 0] - blind.route[:, 0])))
    again = replace(one, agents=(_drive(one.agents[0], m, place), *one.agents[1:]))
    assert rollout(World([again], GRAPHS), Asked())[0].end == "complete"


def test_a_wall_that_nobody_can_pass_needs_no_collision_but_one_at_the_bumper_is_unavoidable() -> None:
    wall = [EpisodeAgent(f"b{k}", "truck", Controller.NONE, Pose(17.0, y, np.pi / 2)) for k, y in enumerate((-9, 0, 9))]
    found = find_witness(episode(ego(x=10.0, speed=20.0), *wall), GRAPHS["Straight"])
    assert found.verdict == "unavoidable"
    assert found.clear == 0


def test_a_free_road_is_harmless() -> None:
    assert find_witness(episode(ego(speed=8.0)), GRAPHS["Straight"]).verdict == "harmless"


def test_shifted_route_moves_left_and_comes_back() -> None:
    moved = shifted(line_route(0.0, 100.0), 10.0, 2.0)
    assert moved.xy[5, 1] == 0.0
    assert moved.xy[30, 1] == 2.0
    assert abs(moved.xy[90, 1]) < 1e-5

"""The world as a process: futures by key, moved means with exact weights, and a score that says what is near."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.core.types import F64, Controller, End
from ssad.drivers import make_system
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.noise import Noise
from ssad.world.rare.importance import LATER, MixtureProposal, sample
from ssad.world.rare.process import WorldProcess, closeness
from ssad.world.rare.splitting import keys_of, splitting
from ssad.world.roads import load_town
from ssad.world.rollout import Loop
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode, line_route

NOISE = Noise(accel=2.0, accel_time=1.5, lapse=0.2, choice_time=2.0, stretches=3, stretch=10)


def process(batch: int, noise: Noise = NOISE) -> WorldProcess:
    (found,) = load_scenarios("lane-traffic/05")
    graphs = {found.town: load_town(found.town)}
    bank = [build_episode(found, graphs[found.town], seed=0)]
    return WorldProcess(
        Loop(World(bank, graphs, assign=np.zeros(batch, int), noise=noise), {0: make_system("autopilot")})
    )


def test_rows_with_the_same_key_are_the_same_episode() -> None:
    rows = process(4)
    rows.reset(np.array([5, 6, 5, 6], np.uint64))
    rows.run()
    hashes = rows.world.hashes()
    assert hashes[0] == hashes[2] != hashes[1] == hashes[3]
    assert rows.work() == 3 * rows.world.array("step").sum()


def test_what_splitting_finds_collides_again_by_its_keys_alone() -> None:
    rows = process(60, replace(NOISE, lapse=0.3))
    found = splitting(rows, generator("world splitting"), repeats=1)
    assert 0.0 < found.estimates[0] < 0.2
    poses = rows.world.array("pose").copy()
    row = int(np.flatnonzero(found.failed)[-1])
    keys = keys_of(found, row)
    again = process(1, replace(NOISE, lapse=0.3))
    again.reset(np.array([keys[0]], np.uint64))
    for step in range(again.steps):
        if step in keys:
            again.rekey(np.array([0]), np.array([keys[step]], np.uint64))
        again.step()
    assert again.failed()[0]
    np.testing.assert_array_equal(again.world.array("pose")[0], poses[row])


def test_weights_of_a_proposal_average_1_and_sums_are_those_of_what_was_drawn() -> None:
    rows = process(400)
    assert rows.width == 9  # the ego's lapses and the acceleration of two others, in three stretches
    means = generator("means").normal(0.0, 0.15, (2, rows.width))
    drawn = sample(rows, MixtureProposal(np.array([0.2, 0.4, 0.4]), means), generator("w"), episodes=1200)
    assert drawn.weight.mean() == pytest.approx(1.0, abs=4.0 * drawn.weight.std() / np.sqrt(len(drawn.weight)))
    rest = drawn.total - drawn.count * np.vstack([np.zeros(rows.width), means])[drawn.component]
    spread = (rest**2 / drawn.count).mean(axis=0)
    assert np.abs(spread - 1.0).max() < 0.25


def test_what_is_moved_later_moves_the_processes_as_much_then() -> None:
    """The processes are linear in their normal numbers, so with equal keys the difference is exact."""
    noise = replace(NOISE, stretches=9)  # as long as the episode

    def drift(rows: WorldProcess, means: F64) -> F64:
        """[steps, A, 2] of one episode."""
        rows.reset(np.array([3], np.uint64))
        rows.push(means[None])
        seen = []
        for _ in range(35):
            rows.step()
            seen.append(rows.world.array("noise.drift")[0].copy())
        return np.array(seen)

    rows = process(1, noise)
    means = np.zeros((3, 9))
    means[0, :2] = 2.0, 0.5
    means[1, :3] = -1.0, 0.0, 0.3
    plain, moved = drift(rows, np.zeros(27)), drift(rows, means.ravel())
    late = rows.later(means.ravel())
    assert late.shape == (7, 27)
    for by, copy in enumerate(late[:3], 1):
        after = drift(rows, copy) - plain
        # as after the first step: one that is `by` stretches later; and from there on the same
        np.testing.assert_allclose(after[10 * by :], (moved - plain)[: 35 - 10 * by], atol=1e-5)
        assert np.abs(after[: 10 * (by - 1) + 1]).max() < 1e-6
    assert process(1, replace(NOISE, stretches=2)).later(np.ones(6)).shape == (0, 6)
    # a last stretch that goes on is not moved; what never forgets has no start that could be made up for
    late = process(1, replace(NOISE, stretches=4, accel_time=np.inf)).later(np.ones(12)).reshape(2, 3, 4)
    assert (late[..., -1] == 0.0).all()
    assert (late[0, 0, 1:3] > 0.0).all()
    assert (late[0, 1:, 1] == 0.0).all()
    assert (late[0, 1:, 2] == 1.0).all()


@pytest.mark.parametrize("defence", [0.1, 0.9])
def test_copies_that_begin_later_leave_weights_exact(defence: float) -> None:
    rows = process(400)
    share = np.array([defence, 0.6 * (1.0 - defence), 0.4 * (1.0 - defence)])
    plain = MixtureProposal(share, generator("late").normal(0.0, 0.15, (2, rows.width)))
    found = plain.with_later(rows).spread()
    assert found.share.sum() == pytest.approx(1.0)
    assert (found.share >= 0.0).all()
    assert len(found.share) == 1 + 2 * (2 + 2 * 1)
    assert found.share[[3, 4, 7, 8]].sum() == pytest.approx(min(LATER, 0.5 * (1.0 - defence)))
    drawn = sample(rows, found, generator("wl"), episodes=1200)
    assert drawn.weight.mean() == pytest.approx(1.0, abs=4.0 * drawn.weight.std() / np.sqrt(len(drawn.weight)))
    assert drawn.weight.max() <= 1.0 / defence + 1e-9
    nothing = MixtureProposal(np.ones(1), np.zeros((0, rows.width)))
    assert nothing.with_later(rows) is nothing


def test_the_score_rises_towards_a_collision() -> None:
    slow = ego(x=60.0, speed=2.0, controller=Controller.NONE, name="slow", route=line_route(60.0, 390.0))
    world = World([episode(ego(speed=14.0, controller=Controller.FOLLOW, target_speed=14.0), slow)], GRAPHS)
    scores = []
    while world.ended()[0] == End.RUNNING:
        scores.append(float(closeness(world.state())[0]))
        world.step()
    assert world.ended()[0] == End.COLLISION
    assert np.all(np.diff(scores) >= -1e-6)
    assert scores[0] < 0.4
    assert scores[-1] > 0.8


def test_who_passes_at_a_distance_is_no_danger() -> None:
    other = ego(x=60.0, name="other", controller=Controller.NONE, pose=replace(ego().pose, x=60.0, y=30.0))
    world = World([episode(ego(speed=14.0), other)], GRAPHS)
    assert closeness(world.state())[0] < 0.05


def test_a_world_without_noise_is_no_process() -> None:
    with pytest.raises(ConfigError, match="chance"):
        WorldProcess(Loop(World([episode(ego())], GRAPHS), {}))

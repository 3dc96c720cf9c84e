"""Chance in traffic: nothing where it is off, the processes that are promised where it is on, and futures by key."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.core.types import Controller
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.noise import Noise
from ssad.world.roads import load_town
from ssad.world.world import World
from tests.world.kernels.test_overtake import two_lanes
from tests.world.worlds import ego, episode, line_route

NOISE = Noise(accel=0.8, accel_time=0.5, lapse=0.1, careless=0.1, choice_time=2.0, stretches=3, stretch=5)


def traffic(noise: Noise | None, scenes: int = 2, *, autoreset: bool = False) -> World:
    scenarios = load_scenarios("natural")[:2]
    graphs = {s.town: load_town(s.town) for s in scenarios}
    bank = [build_episode(s, graphs[s.town], seed=3) for s in scenarios]
    assign = np.arange(scenes) % 2
    return World(bank, graphs, assign=assign, ego=Controller.AUTOPILOT, noise=noise, autoreset=autoreset)


def run(world: World, steps: int) -> list[str]:
    for _ in range(steps):
        world.step()
    return world.hashes()


def test_noise_that_does_nothing_leaves_every_pose_as_it_is() -> None:
    plain, quiet = traffic(None), traffic(Noise())
    run(plain, 60), run(quiet, 60)
    np.testing.assert_array_equal(plain.array("pose"), quiet.array("pose"))
    assert not any(name.startswith("noise.") for name in plain.snapshot().arrays)


def test_a_snapshot_goes_on_to_the_bit_and_with_another_key_differently() -> None:
    world = traffic(NOISE)
    run(world, 40)
    kept = world.snapshot()
    first = run(world, 40)
    world.restore(kept)
    assert run(world, 40) == first
    world.restore(kept)
    world.rekey(np.array([12345], np.uint64), np.array([1]))
    other = run(world, 40)
    assert other[0] == first[0]
    assert other[1] != first[1]


def test_a_scene_does_not_hang_on_its_batch_and_starts_again_alike() -> None:
    pair, four = traffic(NOISE), traffic(NOISE, 4)
    assert run(four, 50) == run(pair, 50) * 2
    pair.reset()
    four.reset(np.array([2, 3]))
    again = run(pair, 50)
    run(four, 50)
    assert four.hashes()[2:] == again


def test_a_scene_that_starts_again_by_itself_has_another_future() -> None:
    world = traffic(NOISE, autoreset=True)
    world.step()
    first = world.array("noise.key").copy()
    world.put("end", np.array([1, 0], np.int32))
    world.step()
    after = world.array("noise.key")
    assert after[0] != first[0]
    assert after[1] == first[1]


def test_the_processes_have_variance_1_and_forget_as_they_say() -> None:
    world = traffic(NOISE, 400)
    world.rekey(generator("noise test").integers(0, 2**63, 400).astype(np.uint64))
    drifts = []
    for _ in range(9):
        world.step()
        drifts.append(world.array("noise.drift").copy())
    here, later = drifts[3].reshape(-1, 2).astype(float), drifts[8].reshape(-1, 2).astype(float)
    count = len(here)
    assert np.abs(here.mean(0)).max() < 4.0 / np.sqrt(count)
    assert np.abs(here.var(0) - 1.0).max() < 6.0 / np.sqrt(count)
    expected = np.exp(-0.5 / np.array([0.5, 2.0]))
    assert np.abs((here * later).mean(0) - expected).max() < 6.0 / np.sqrt(count)
    assert abs(np.corrcoef(here.T)[0, 1]) < 5.0 / np.sqrt(count)
    # agents and scenes have chance of their own
    flat = drifts[0][..., 0]
    assert len(np.unique(flat)) == flat.size


def test_means_that_are_moved_appear_in_the_sums() -> None:
    plain, moved = traffic(NOISE), traffic(NOISE)
    push = generator("push").normal(size=moved.array("noise.push").shape).astype(np.float32)
    moved.put("noise.push", push)
    run(plain, 12), run(moved, 12)
    steps = np.array([1.0, 5.0, 6.0])[:, None]
    difference = moved.array("noise.total") - plain.array("noise.total")
    np.testing.assert_allclose(difference, push * steps, atol=1e-4)


def test_lapses_and_carelessness_come_as_often_as_they_say() -> None:
    world = traffic(NOISE, 200)
    world.rekey(generator("lapses").integers(0, 2**63, 200).astype(np.uint64))
    run(world, 3)
    share = (world.array("noise.drift")[:, 0, 1] > NOISE.rule(0.1).lapse).mean()
    assert 0.02 < share < 0.2
    # who has a lapse leaves the pedals as they were; who has none shows what it does
    attends = world.array("noise.drift")[:, 0, 1] <= NOISE.rule(0.1).lapse
    np.testing.assert_array_equal(world.array("control")[:, 0, :2], world.array("noise.held")[:, 0])
    world.put("noise.held", np.full_like(world.array("noise.held"), 0.25))
    world.step()
    lapse = world.array("noise.drift")[:, 0, 1] > NOISE.rule(0.1).lapse
    assert lapse.any()
    assert (world.array("control")[lapse, 0, :2] == 0.25).all()
    assert attends.any()


def test_careless_traffic_changes_lane() -> None:
    other = ego(x=60.0, speed=8.0, controller=Controller.AUTOPILOT, name="other", route=line_route(60.0, 390.0))
    scene = episode(ego(), other)

    def aside(noise: Noise | None) -> int:
        world = World([scene], {"Straight": two_lanes(400.0)}, assign=np.zeros(50, int), noise=noise)
        if noise is not None:
            world.rekey(generator("careless").integers(0, 2**63, 50).astype(np.uint64))
        run(world, 40)
        return int((world.array("pose")[:, 1, 1] > 2.0).sum())

    assert aside(None) == 0
    assert aside(Noise(accel=1.0)) == 0
    assert aside(Noise(careless=0.5)) > 10


def test_bad_noise_is_refused() -> None:
    with pytest.raises(ConfigError, match="lapse and careless"):
        Noise(lapse=0.7)
    with pytest.raises(ConfigError, match="times above 0"):
        Noise(accel_time=0.0)
    with pytest.raises(ConfigError, match="no chance"):
        traffic(None).rekey(np.array([1, 2], np.uint64))
    with pytest.raises(ConfigError, match="only one of them has noise"):
        traffic(NOISE).restore(traffic(None).snapshot())

"""What every generator owes its callers (`ssad.core.generators`), and what the newer ones do with it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.metric_traces import make_trace
from helpers.quick import others_slow

from ssad.core.generators import Base, Generator, Outcome
from ssad.drivers import make_system
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.scenarios.dynamic.generate import GENERATORS, Trials, generator_factory
from ssad.scenarios.dynamic.logged.near_miss import near_misses, perturb_motion
from ssad.scenarios.dynamic.policy.l2c import _Distribution
from ssad.scenarios.dynamic.transition.motion import KNOTS, TimedPath
from ssad.world.roads import load_town


@pytest.fixture(scope="module")
def bases() -> list[Base]:
    trials = Trials(lambda: make_system("autopilot"), make_system)
    found = [load_scenarios(name)[0] for name in ("UnprotectedLeftTurn/00", "CrossingNegotiation/01")]
    return [trials.base(scenario, load_town(scenario.town), seed=3) for scenario in found]


def rounds(name: str, bases: list[Base], seeds: list[int], counts: tuple[int, ...] = (8, 5)) -> list[list[Any]]:
    """What a generator proposes for each base, told that later proposals are the more dangerous ones."""
    generator = generator_factory(name)(bases, seeds=seeds, budget=sum(counts))
    assert isinstance(generator, Generator)
    found: list[list[Any]] = [[] for _ in bases]
    for count in counts:
        proposals = [list(row) for row in generator.ask(count)]
        assert len(proposals) == len(bases)
        assert all(len(row) <= count for row in proposals)
        generator.tell([[Outcome(p, gap=9.0 - k) for k, p in enumerate(row)] for row in proposals])
        for whole, row in zip(found, proposals, strict=True):
            whole.extend(row)
    return found


@pytest.mark.parametrize("name", others_slow(GENERATORS, [n for n in GENERATORS if n not in ("king", "cat")]))
def test_a_generator_keeps_its_promises(name: str, bases: list[Base]) -> None:
    both = rounds(name, bases, [5, 6])
    assert [[p.scenario for p in row] for row in rounds(name, bases[1:], [6])] == [[p.scenario for p in both[1]]]
    for base, row in zip(bases, both, strict=True):
        assert row
        for proposal in row:
            episode = build_episode(proposal.scenario, base.graph, seed=3)
            assert set(proposal.adversaries) <= {agent.name for agent in episode.agents[1:]}
            # the ego's start and its wishes are not the generator's
            assert (episode.agents[0].pose, episode.agents[0].speed) == (
                base.episode.agents[0].pose,
                base.episode.agents[0].speed,
            )
            assert proposal.scenario.target_speed == base.scenario.target_speed
            assert proposal.scenario.route == base.scenario.route
    scenarios = {repr(proposal.scenario) for proposal in both[0]}
    if both[0][0].drivers:  # a policy drives the adversary: there is one scenario
        assert len(scenarios) == 1
    else:
        assert len(scenarios) > 5


def test_a_distribution_moves_to_what_was_better_and_follows_a_valley() -> None:
    random, told = np.random.default_rng(0), _Distribution(2)
    for _ in range(60):
        draws = told.draw(random.standard_normal((16, 2)))
        worth = -np.abs(draws[:, 0] + draws[:, 1]) - 0.2 * np.abs(draws[:, 0] - 0.5)
        told.learn(draws, (worth - worth.mean()) / worth.std())
    draws = told.draw(random.standard_normal((400, 2)))
    assert np.abs(draws.sum(1)).mean() < 0.5
    assert told.weight.detach().numpy()[1, 0] < -0.3  # the second parameter has learned to follow the first


def test_a_way_is_driven_at_other_speeds_and_beside_it() -> None:
    step = 0.1 * np.arange(31)
    trace = make_trace(31, [(0.0, 500.0, 0.0, 0.0), (5.0 * step, 0.0, 0.0, 5.0)])
    way = TimedPath.of(trace, 1)
    assert way.speed == pytest.approx(5.0, abs=1e-4)
    same = way.rows(way.distance)
    assert same[:, 1] == pytest.approx(5.0 * step, abs=1e-5)
    double = way.rows(2.0 * way.distance, 1.0)
    assert double[-1, 1:] == pytest.approx([30.0, 1.0, 0.0], abs=1e-4)
    assert KNOTS > 2


def test_a_near_miss_is_found_and_becomes_a_hit() -> None:
    step = 0.1 * np.arange(101)
    # the ego is at the crossing after 5 s, the other after 6.5 s; a third stands
    bodies = [(8.0 * step, 0.0, 0.0, 8.0), (40.0, -52.0 + 8.0 * step, np.pi / 2, 8.0), (90.0, 50.0, 0.0, 0.0)]
    trace = make_trace(101, bodies)
    (miss,) = near_misses(trace)
    assert miss.agent == 1
    # bodies of 4 m x 2 m overlap as long as centres are within 3 m of each other on both ways
    assert 0.6 < miss.late < 1.5
    rows = perturb_motion(trace, miss, shift=0.0, lateral=0.0)
    apart = np.hypot(rows[:, 1] - 8.0 * step, rows[:, 2])
    assert apart.min() < 3.7
    before = np.hypot(40.0 - 8.0 * step, -52.0 + 8.0 * step)
    assert before.min() > 6.0
    later = perturb_motion(trace, miss, shift=1.0, lateral=0.0)
    assert (np.hypot(later[:, 1] - 8.0 * step, later[:, 2])).min() > apart.min() + 1.0

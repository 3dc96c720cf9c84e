"""Adv.PPO: a generator by name, whose adversaries bring collisions about that natural traffic does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.traces import trace_hash
from ssad.drivers import make_system
from ssad.scenarios.dynamic import load_scenarios
from ssad.scenarios.dynamic.generate import Trials, generator_factory, scenario_of, search
from ssad.scenarios.dynamic.policy.adv_ppo import SHIPPED, Adversary, AdvPPO, PaperAdvPPO
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.selection import FreaSelection
from ssad.world.world import World

TOWN = load_town("Twinford")
TRIALS = Trials(lambda: make_system("autopilot"), policies=make_system)


def bases(*numbers: int):
    scenarios = load_scenarios("natural-twinford")
    return [TRIALS.base(scenarios[k], TOWN, seed=0) for k in numbers]


def test_it_is_a_generator() -> None:
    found = bases(0, 9, 18, 27, 36, 45)
    generator = generator_factory("adv-ppo-paper")(found, seeds=[0] * len(found), budget=4)
    outcomes = search(generator, found, TRIALS, budget=4)
    assert [len(row) for row in outcomes] == [1] * len(found)
    hits = [row[0].collision for row in outcomes]
    assert sum(hits) >= 2
    assert not any(base.trace.end == "collision" for base in found)
    assert all(row[0].adversaries for row, hit in zip(outcomes, hits, strict=True) if hit)
    # what it found is a scenario in which the adversary does the same without its driver; the ego may do otherwise
    k = hits.index(True)
    kept = scenario_of(outcomes[k][0], found[k], name="found/one")
    again, first = TRIALS.base(kept, TOWN, seed=0).trace, outcomes[k][0].trace
    who = outcomes[k][0].adversaries[0]
    other = again.names.index(first.names[who])
    steps = min(len(again.x), len(first.x))
    there = again.active[:steps, other] & first.active[:steps, who]
    assert there.sum() > 10
    np.testing.assert_allclose(again.x[:steps][there, other], first.x[:steps][there, who], atol=0.01)


def test_the_batch_changes_no_bit() -> None:
    episodes = [base.episode for base in bases(0, 11, 22)]

    def drive(*chosen):
        world = World(chosen, {TOWN.name: TOWN})
        drivers = {0: make_system("blind"), FreaSelection(): Adversary(name="adv-ppo-paper")}
        return [trace_hash(trace) for trace in rollout(world, drivers)]

    together = drive(*episodes)
    assert [drive(one)[0] for one in episodes] == together


def test_it_needs_others() -> None:
    (base,) = bases(0)
    alone = replace(base, episode=replace(base.episode, agents=base.episode.agents[:1]))
    with pytest.raises(ConfigError, match="needs other agents"):
        AdvPPO([alone], seeds=[0], budget=1)


@pytest.mark.slow
def test_it_raises_the_collision_rate_of_the_autopilot() -> None:
    every_base = bases(*range(len(load_scenarios("natural-twinford"))))
    outcomes = search(PaperAdvPPO(every_base, seeds=[0] * len(every_base), budget=1), every_base, TRIALS, budget=1)
    assert sum(base.trace.end == "collision" for base in every_base) <= 1
    assert sum(row[0].collision for row in outcomes) >= 0.15 * len(every_base)


def test_weights_are_small() -> None:
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 1 << 20

"""Scenarios that generators have found: parameters searched, motions optimised."""

from __future__ import annotations

from dataclasses import replace

from ssad.core.types import Scenario
from ssad.drivers import make_system
from ssad.scenarios.dynamic import load_scenarios
from ssad.scenarios.dynamic.generate import Trials, generator_factory, scenario_of, search
from ssad.world.roads import load_town

BASES = ("RightTurn/00", "CrossingNegotiation/00", "RedlightRunning/01", "UnprotectedLeftTurn/02", "LaneChanging/00")


def generated(each: int = 1, generators: tuple[str, ...] = ("random", "cma-es", "adv-sim", "cat")) -> list[Scenario]:
    """The `each` most dangerous proposals of every generator on every base, against the system `blind`."""
    trials = Trials(ego=lambda: make_system("blind"))
    bases = [trials.base(s, load_town(s.town), seed=0) for name in BASES for s in load_scenarios(name)]
    found = []
    for name in generators:
        seeds, budget = range(len(bases)), max(8, each)
        generator = generator_factory(name)(bases, seeds=seeds, budget=budget)
        for base, outcomes in zip(bases, search(generator, bases, trials, budget=budget), strict=True):
            good = sorted((o for o in outcomes if o.trace is not None), key=lambda o: -o.danger)
            plain = base.scenario.name.replace("/", "-")
            for k, outcome in enumerate(good[:each]):
                label = f"{name}/{plain}-{k}"
                found.append(replace(scenario_of(outcome, base, name=label), group=name))
    return found

"""Searches over parameter boxes, each on its own and against random points."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.generators import Base, Generator, Outcome, Proposal
from ssad.core.types import F64, Scenario
from ssad.scenarios.dynamic import build_episode, load_scenarios, scenario_type
from ssad.scenarios.dynamic.generate import GENERATORS, generator_factory
from ssad.scenarios.dynamic.sampling import sampling_ranges
from ssad.scenarios.dynamic.search.bayesian import expected_improvement, predict
from ssad.scenarios.dynamic.search.box import ParameterBox
from ssad.world.roads import load_town

SEARCHES = [name for name, where in GENERATORS.items() if ".search." in where]
(SCENARIO,) = load_scenarios("UnprotectedLeftTurn/00")


@pytest.fixture(scope="module")
def base() -> Base:
    episode = build_episode(SCENARIO, load_town(SCENARIO.town), seed=1)
    return Base(episode, load_town(SCENARIO.town), None)  # type: ignore[arg-type]  # a search of a box needs no trace


def outcome_of(proposal: Proposal, danger: float) -> Outcome:
    return Outcome(proposal, gap=-danger)


def point(scenario: Scenario) -> F64:
    box = ParameterBox.of(SCENARIO)
    return np.array([(scenario.parameters[n] - low) / (high - low) for n, (low, high) in box.ranges.items()])


def run(
    name: str, base: Base, danger: Callable[[F64], float], *, budget: int, seed: int = 0, batch: int = 8
) -> list[F64]:
    generator: Generator = generator_factory(name)([base], seeds=[seed], budget=budget)
    tried: list[F64] = []
    while len(tried) < budget:
        (row,) = generator.ask(min(batch, budget - len(tried)))
        if not row:
            break
        tried += [point(p.scenario) for p in row]
        generator.tell([[outcome_of(p, danger(point(p.scenario))) for p in row]])
    return tried


@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_stays_in_the_box_and_depends_on_its_seed_alone(name: str, base: Base) -> None:
    def danger(x: F64) -> float:
        return float(-x.sum())

    first, again, other = (np.array(run(name, base, danger, budget=20, seed=seed)) for seed in (3, 3, 4))
    assert first.shape[1] == 3
    assert ((first >= 0.0) & (first <= 1.0)).all()
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    kind = scenario_type(SCENARIO.type)
    for row in first:
        scenario = ParameterBox.of(SCENARIO).scenario_at(row)
        assert kind.values(scenario.parameters)["ego_speed"] == 0.0  # the ego's start is not the generator's
        build_episode(scenario, base.graph, seed=0)


def test_a_grid_covers_the_box_evenly_and_ends(base: Base) -> None:
    tried = np.array(run("grid", base, lambda x: 0.0, budget=30))
    assert len(tried) == 27  # three cells along each of three parameters
    assert len(np.unique(tried.round(6), axis=0)) == 27
    assert [sorted(set(column.round(3))) for column in tried.T] == [[0.167, 0.5, 0.833]] * 3
    assert len(run("grid", base, lambda x: 0.0, budget=37)) == 36


def test_halton_points_are_more_even_than_random_ones(base: Base) -> None:
    from scipy.stats import qmc

    def unevenness(name: str) -> float:
        return float(
            np.mean([qmc.discrepancy(np.array(run(name, base, lambda x: 0.0, budget=64, seed=s))) for s in range(5)])
        )

    assert unevenness("halton") < 0.5 * unevenness("random")


@pytest.mark.parametrize("name", ["cma-es", "bayesian"])
def test_a_search_that_learns_comes_nearer_to_a_narrow_danger_than_random_points(name: str, base: Base) -> None:
    target = np.array([0.8, 0.25, 0.6])

    def miss(x: F64) -> float:
        return 10.0 * float(np.linalg.norm(x - target))

    def best(search: str) -> list[float]:
        return [min(miss(x) for x in run(search, base, lambda x: -miss(x), budget=48, seed=s)) for s in range(4)]

    assert np.mean(best(name)) < 0.5 * np.mean(best("random"))


@pytest.mark.parametrize("batch", [1, 5, 12, 16, 64])
def test_the_generations_of_cma_es_do_not_depend_on_the_batch(batch: int, base: Base) -> None:
    """Points of an older distribution once counted as the next one's; at 64 the bowl was missed 25 times as far."""

    def bowl(x: F64) -> float:
        return -float(((x - 0.7) ** 2).sum())

    eights, others = (np.array(run("cma-es", base, bowl, budget=192, batch=size)) for size in (8, batch))
    assert np.array_equal(eights, others)
    assert np.linalg.norm(others[-8:] - 0.7, axis=1).min() < 0.05


def test_a_scenario_without_parameters_of_others_is_told_in_a_line(base: Base) -> None:
    custom = dataclasses.replace(base.scenario, type="Custom", parameters={})
    with pytest.raises(
        ConfigError,
        match=r"no parameters of other agents to search; declare some with a range .* king and cat",
    ):
        ParameterBox.of(custom)


def test_a_gaussian_process_goes_through_what_it_knows() -> None:
    x = np.linspace(0.0, 1.0, 9)[:, None]
    y = np.sin(5.0 * x[:, 0])
    mean, deviation = predict(x, y, x)
    assert mean == pytest.approx(y, abs=0.01)
    assert deviation.max() < 0.02
    between, unsure = predict(x, y, np.array([[0.44], [3.0]]))
    assert between[0] == pytest.approx(np.sin(2.2), abs=0.03)
    assert unsure[1] > 10.0 * unsure[0]


def test_the_improvement_expected_is_that_of_many_draws() -> None:
    draws = np.random.default_rng(0).normal(1.0, 2.0, 400_000)
    expected = np.maximum(draws - 2.5, 0.0).mean()
    found = expected_improvement(np.array([1.0]), np.array([2.0]), 2.5)
    assert found[0] == pytest.approx(expected, rel=0.02)


def test_a_value_beyond_what_is_searched_is_kept_and_searches_begin_at_the_nearest() -> None:
    (plain,) = load_scenarios("LaneChanging/00")
    fast = dataclasses.replace(plain, parameters={"leader_speed": 18.0})  # searched: 8 to 16 m/s; allowed: up to 20
    assert sampling_ranges(fast)["leader_speed"] == (16.5, 18.0)
    box = ParameterBox.of(fast)
    nominal = dict(zip(box.ranges, box.nominal(), strict=True))
    assert nominal["leader_speed"] == 1.0
    assert box.scenario_at(box.nominal()).parameters["leader_speed"] == 16.0

"""The estimators of small probabilities on walks whose chance is known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.seeding import generator
from ssad.metrics.rare_events import repeated_estimate, weighted_estimate, weighted_limits
from ssad.world.rare.brute import monte_carlo
from ssad.world.rare.importance import MixtureProposal, importance, learn, sample
from ssad.world.rare.splitting import keys_of, splitting
from tests.helpers.walk import Walk, chance_of


def test_the_chance_of_a_walk_is_that_of_a_closed_form() -> None:
    """A long walk of small steps: the reflection principle, with Siegmund's correction for discrete steps."""
    from scipy.special import ndtr

    steps, height = 100, 30.0
    assert chance_of(height, steps) == pytest.approx(2.0 * ndtr(-(height + 0.5826) / np.sqrt(steps)), rel=0.03)
    assert chance_of(3.0902, 1) == pytest.approx(1e-3, rel=1e-3)


def test_plain_monte_carlo_counts() -> None:
    truth = chance_of(5.0, 6)
    *_, (found, keys) = monte_carlo(Walk(20_000, 5.0, steps=6), generator("mc"), episodes=60_000)
    assert found.low < truth < found.high
    assert found.episodes == 60_000
    assert found.effective == found.events
    # the keys of failures fail again
    again = Walk(len(keys), 5.0, steps=6)
    again.reset(keys)
    while again.running().any():
        again.step()
    assert again.over.all()


@pytest.mark.parametrize("grain", [0.0, 0.1])
def test_splitting_is_unbiased_also_with_ties(grain: float) -> None:
    height, steps, repeats = 9.26, 6, 500
    truth = chance_of(height, steps)
    walk = Walk(repeats * 50, height, steps=steps, grain=grain)
    found = splitting(walk, generator("splitting", grain), repeats=repeats)
    error = found.estimates.std() / np.sqrt(repeats)
    assert abs(found.estimates.mean() - truth) < 4.0 * error
    assert error < 0.2 * truth
    assert found.work.sum() == pytest.approx(walk.work())


def test_a_particle_that_failed_fails_again_by_its_keys() -> None:
    walk = Walk(100, 9.26, steps=6)
    found = splitting(walk, generator("again"), repeats=1)
    assert found.failed.sum() > 10
    for row in np.flatnonzero(found.failed)[:20].tolist():
        again, keys = Walk(1, 9.26, steps=6), keys_of(found, row)
        again.reset(np.array([keys[0]], np.uint64))
        while again.running().any():
            step = int(again.time[0])
            if step in keys:
                again.rekey(np.array([0]), np.array([keys[step]], np.uint64))
            again.step()
        assert again.over[0]
        np.testing.assert_array_equal(again.sums[0], walk.sums[row])


def test_where_everybody_stops_at_the_same_score_the_estimate_is_0() -> None:
    found = splitting(Walk(40, 1e3, steps=2, grain=0.9), generator("stuck"), repeats=2)
    assert (found.estimates == 0.0).all()


def test_weights_average_1_and_are_bounded_by_the_defence() -> None:
    walk = Walk(40_000, 9.26, steps=6)
    means = np.array([[0.5] * 6, [1.0, -0.5, 0.3, 0.0, 0.2, 0.1]])
    drawn = sample(walk, MixtureProposal(np.array([0.2, 0.5, 0.3]), means), generator("weights"), episodes=40_000)
    assert drawn.weight.max() <= 5.0
    assert drawn.weight.mean() == pytest.approx(1.0, abs=4.0 * drawn.weight.std() / 200.0)
    # what was drawn is what the proposal says
    assert (drawn.component == 0).mean() == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize(("height", "steps"), [(3.719, 1), (4.753, 1), (9.26, 6), (11.67, 6)])
def test_intervals_of_importance_sampling_hold(height: float, steps: int) -> None:
    """1e-4 and 1e-6, a tail and a first passage; a fixed good proposal, so that coverage is all that is tested."""
    truth, repeats, size = chance_of(height, steps), 1000, 300
    push = np.full((1, steps), height / steps)
    walk = Walk(repeats * size, height, steps=steps)
    drawn = sample(
        walk, MixtureProposal(np.array([0.1, 0.9]), push), generator("hold", height), episodes=repeats * size
    )
    values = np.where(drawn.failed, drawn.weight, 0.0).reshape(repeats, size)
    low, high = weighted_limits(values.sum(1), (values**2).sum(1), values.max(1), size, unequal_weights=True)
    held = ((low <= truth) & (truth <= high)).mean()
    assert 0.93 <= held <= 0.975
    assert values.mean() == pytest.approx(truth, rel=0.05)


def test_a_learned_proposal_needs_far_fewer_episodes_than_brute_force() -> None:
    truth = chance_of(11.67, 6)
    random, walk = generator("learned"), Walk(600, 11.67, steps=6)
    proposal = learn(walk, random)
    training = walk.work()
    found, drawn = importance(walk, proposal, random, episodes=3000, training=training)
    assert found.low < truth < found.high
    assert found.work == walk.work()
    assert found.half_width < 0.3
    # brute force would need this many steps for that interval
    needed = 6.0 * 1.96**2 / found.half_width**2 / truth
    assert needed > 1000.0 * found.work
    assert found.effective == pytest.approx(
        weighted_estimate(drawn.weight * drawn.failed, "", max_weight=10, work=0).effective
    )


def test_limits_of_few_plain_events_are_those_of_a_poisson_mean() -> None:
    """Mid-p limits by their definition: half the chance of what was seen counts on each side."""
    from scipy.special import gammaincc

    for events in (0, 1, 3, 20):
        low, high = (float(v) * 1e9 for v in weighted_limits(events, events, 1.0, 1e9))

        def below(mean: float, count: int) -> float:
            return float(gammaincc(count + 1, mean)) if count >= 0 else 0.0

        seen = below(high, events) - below(high, events - 1)
        assert below(high, events - 1) + 0.5 * seen == pytest.approx(0.025, rel=1e-3)
        if events:
            seen = below(low, events) - below(low, events - 1)
            assert 1.0 - below(low, events) + 0.5 * seen == pytest.approx(0.025, rel=1e-3)
        else:
            assert low == 0.0


def test_intervals_hold_for_few_weights_of_a_long_tail() -> None:
    """Weights of which a few say much: mid-p limits miss on the lower side, those with room for one more do not."""
    random, mean = generator("long tail"), 100.0
    counts = random.poisson(mean, 4000)
    rows = np.repeat(np.arange(4000), counts)
    weight = random.lognormal(-0.72, 1.2, counts.sum())  # of mean 1
    sums = [np.bincount(rows, weight**k, 4000) for k in (1, 2)]
    largest = np.zeros(4000)
    np.maximum.at(largest, rows, weight)
    held = {}
    for unlike in (False, True):
        low, high = weighted_limits(*sums, largest, 1e7, unequal_weights=unlike)
        held[unlike] = ((low <= mean * 1e-7) & (mean * 1e-7 <= high)).mean()
    assert held[False] < 0.93
    assert 0.93 <= held[True] <= 0.97


def test_intervals_hold_for_few_plain_events() -> None:
    random = generator("poisson")
    for mean in (10.0, 30.0, 100.0):  # a mean of 3 is held by 92 %
        seen = random.poisson(mean, 4000)
        low, high = weighted_limits(seen, seen, 1.0, 1e7)
        assert 0.93 <= ((low <= mean * 1e-7) & (mean * 1e-7 <= high)).mean() <= 0.98


def test_intervals_of_repeats_hold() -> None:
    random = generator("repeats")
    values = random.lognormal(-0.18, 0.6, (1000, 20))
    found = [repeated_estimate(row.tolist(), "splitting", episodes=1, events=1, work=1.0) for row in values]
    assert 0.92 <= np.mean([e.low <= 1.0 <= e.high for e in found]) <= 0.98

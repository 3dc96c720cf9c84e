"""Numbers of cases that a difference of two rates needs, from flip rates and from how alike the cases of clusters are.

Two systems meet the same cases. The *flip rate* is the share of cases with another outcome: where only the first has
the event, or only the second. It sets the variance of the difference; how alike the cases of a cluster are sets how
many of them count. `power` asks of the intervals of `ssad.metrics.paired_difference` how often they leave out 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ssad.core.types import F64
from ssad.metrics.intervals import (
    MIN_ROUTES,
    ConfidenceLimits,
    alike_inverse,
    difference_limits,
    share_limits,
    t_quantile,
    variance_freedom,
)
from ssad.metrics.uncertainty import CaseValue, complete_pairs

MAX_CLUSTERS = 10**9
"""Number of clusters at which a search for the necessary number ends."""


@dataclass(frozen=True)
class CaseSample:
    """Cases in clusters.

    Attributes:
        clusters: Number of clusters.
        mean_size: Mean number of cases of a cluster.
        typical_size: Number of cases in the cluster of a random case; above the mean where sizes differ (Kish 1965).
    """

    clusters: float
    mean_size: float
    typical_size: float

    @classmethod
    def of(cls, clusters: Iterable[str]) -> CaseSample:
        """Return the sample of cases whose clusters are named."""
        _, sizes = np.unique(list(clusters), return_counts=True)
        return cls(float(len(sizes)), float(sizes.mean()), float((sizes**2).sum() / sizes.sum()))

    @property
    def cases(self) -> float:
        """Number of cases."""
        return self.clusters * self.mean_size

    def design_effect(self, correlation: float) -> float:
        """Return by how much the variance exceeds that of independent cases, for a correlation within clusters."""
        return 1.0 + (self.typical_size - 1.0) * correlation


@dataclass(frozen=True)
class FlipRate:
    """Outcomes of two systems in the same cases.

    Attributes:
        rate: Share of the cases whose outcome differs.
        difference: Rate of the first less that of the second.
        mean_rate: Mean of the two rates.
        sample: Cases in which both ran.
        design_effect: Variance of the difference over that of independent cases; NaN where no outcome differs.
        correlation: Correlation of the differences within a cluster, from 0 to 1; NaN where it cannot be told.
        rate_correlation: The same of the outcomes themselves.
    """

    rate: float
    difference: float
    mean_rate: float
    sample: CaseSample
    design_effect: float
    correlation: float
    rate_correlation: float

    @property
    def flips(self) -> int:
        """Number of cases whose outcome differs."""
        return round(self.rate * self.sample.cases)


def flip_rate(first: Mapping[str, CaseValue], second: Mapping[str, CaseValue]) -> FlipRate | None:
    """Return the flip rate of two systems, or None if they share no case that both ran.

    Args:
        first: Values, 0 or 1, of one system by cell, as for `ssad.metrics.paired_difference`.
        second: Values of the other system.
    """
    pairs = list({(pair[0].case, pair[1].case): pair for pair in complete_pairs(first, second)}.values())
    if not pairs:
        return None
    clusters = [pair[0].cluster for pair in pairs]
    outcomes = np.array([[case_value.value for case_value in pair] for pair in pairs])
    sample = CaseSample.of(clusters)
    differences = outcomes[:, 0] - outcomes[:, 1]
    design_effect = _design_effect(differences, clusters)
    rate_effects = [effect for effect in (_design_effect(values, clusters) for values in outcomes.T) if effect >= 0.0]
    return FlipRate(
        rate=float(np.abs(differences).mean()),
        difference=float(differences.mean()),
        mean_rate=float(outcomes.mean()),
        sample=sample,
        design_effect=design_effect,
        correlation=_correlation(design_effect, sample),
        rate_correlation=_correlation(float(np.mean(rate_effects)) if rate_effects else math.nan, sample),
    )


def power(difference: float, flip_rate: float, sample: CaseSample, correlation: float) -> float:
    """Return the probability that the interval of a paired difference leaves out 0, if the true one is `difference`.

    The limits are those of `ssad.metrics.intervals.difference_limits` at the true shares, at the effective number of
    cases that the clusters are expected to show. The difference varies with (flip rate - difference^2) x design
    effect / cases (Connor 1987), by Student's distribution with clusters less one degrees of freedom. In simulations
    the power is between 0.65 and 0.9 where this says 0.8, and between 0.75 and 0.85 from flip rates of twice the
    difference on.

    Args:
        difference: True difference of the rates, above 0.
        flip_rate: Share of the cases whose outcome differs; at least `difference`.
        sample: Cases.
        correlation: Correlation of the differences within a cluster.

    Source:
        Connor, "CaseSample size for testing differences in proportions for the paired-sample design" (1987).
    """
    from scipy.special import stdtr

    shares = (0.5 * (flip_rate + difference), 0.5 * max(flip_rate - difference, 0.0))
    low, _ = difference_limits(*(_expected_limits(share, sample, correlation) for share in shares))
    variance = (flip_rate - difference**2) * sample.design_effect(correlation) / sample.cases
    if variance <= 0.0:
        return float(low > 0.0)
    return float(stdtr(sample.clusters - 1.0, float(low) / math.sqrt(variance)))


def unpaired_power(difference: float, mean_rate: float, sample: CaseSample, correlation: float) -> float:
    """Return the probability that two rates of separate cases are found to differ, each from as many cases.

    Args:
        difference: True difference of the rates, above 0.
        mean_rate: Mean of the two rates.
        sample: Cases of each system.
        correlation: Correlation of the outcomes within a cluster.
    """
    from scipy.special import stdtr

    higher = min(max(mean_rate + 0.5 * difference, difference), 1.0)
    lower = max(higher - difference, 0.0)
    variance = (higher * (1.0 - higher) + lower * (1.0 - lower)) * sample.design_effect(correlation) / sample.cases
    if variance <= 0.0:
        return 1.0
    freedom = 2.0 * (sample.clusters - 1.0)
    return float(stdtr(freedom, difference / math.sqrt(variance) - float(t_quantile(freedom))))


def necessary_clusters(power_of: Callable[[CaseSample], float], sample: CaseSample, *, target: float) -> int | None:
    """Return the number of clusters, as large as those of a sample, from which on a difference is detected.

    Args:
        power_of: Power by sample.
        sample: CaseSample that sets the sizes of the clusters.
        target: Power that is wanted.

    Returns:
        The number, at least `MIN_ROUTES`; None: not even 10^9 are enough.
    """

    def is_enough(clusters: int) -> bool:
        return power_of(replace(sample, clusters=float(clusters))) >= target

    return _first(is_enough, MIN_ROUTES)


def detectable_difference(flip_rate: float, sample: CaseSample, correlation: float, *, target: float) -> float | None:
    """Return the least difference, in hundredths, that a sample detects; None: none, or too few clusters.

    Args:
        flip_rate: Share of the cases whose outcome differs; larger differences flip at least as many.
        sample: Cases.
        correlation: Correlation of the differences within a cluster.
        target: Power that is wanted.
    """
    if sample.clusters < MIN_ROUTES:
        return None
    for hundredths in range(1, 101):
        difference = hundredths / 100.0
        if power(difference, max(flip_rate, difference), sample, correlation) >= target:
            return difference
    return None


def _first(is_enough: Callable[[int], bool], start: int) -> int | None:
    """Return the first number from `start` on that is enough, of a condition that stays true."""
    high = start
    while not is_enough(high):
        high *= 2
        if high > MAX_CLUSTERS:
            return None
    low = max(high // 2, start - 1)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if is_enough(middle) else (middle, high)
    return high


def _expected_limits(share: float, sample: CaseSample, correlation: float) -> ConfidenceLimits:
    """Return the limits of a share at its true value, with the effective number that clusters are expected to show."""
    cases, min_effective = sample.cases, sample.cases / sample.typical_size
    if sample.typical_size == 1.0:
        effective = cases
    elif not 0.0 < share < 1.0:
        effective = min_effective
    else:
        part = _active_part(share, max(round(sample.mean_size), 1), correlation)
        active_clusters = np.asarray(sample.clusters * part)
        inverse = np.asarray(sample.design_effect(correlation) / cases)
        freedom = variance_freedom(active_clusters, round(sample.clusters), sample.clusters - 1.0)
        effective = float(alike_inverse(inverse, active_clusters, min_effective)) ** -1.0
        effective *= (float(t_quantile(math.inf)) / float(t_quantile(freedom))) ** 2
        effective = min(max(effective, min_effective), 2.0 * cases)
    low, high = share_limits(share, effective)
    return ConfidenceLimits(np.asarray(share), low, high, "beta")


def _active_part(share: float, size: int, correlation: float) -> float:
    """Return the part of the clusters that carry the variation of a share: one over the kurtosis of their counts.

    Args:
        share: The share, inside (0, 1).
        size: Cases of a cluster, whose counts are beta-binomial.
        correlation: Correlation within a cluster.
    """
    from scipy.special import betaln, gammaln

    scale = (1.0 - correlation) / correlation if correlation > 0.0 else math.inf
    first, second = share * min(scale, 1e9), (1.0 - share) * min(scale, 1e9)
    if min(first, second) <= 0.0:  # cases all alike
        return share * (1.0 - share) / (1.0 - 3.0 * share * (1.0 - share))
    counts = np.arange(size + 1.0)
    ways = gammaln(size + 1.0) - gammaln(counts + 1.0) - gammaln(size - counts + 1.0)
    chance = np.exp(ways + betaln(counts + first, size - counts + second) - betaln(first, second))
    squares = (counts - size * share) ** 2
    return float((chance @ squares) ** 2 / (chance @ squares**2))


def _design_effect(values: F64, clusters: list[str]) -> float:
    """Return the variance of the mean by clusters over that of independent cases; NaN where nothing varies."""
    _, indices = np.unique(clusters, return_inverse=True)
    sums = np.bincount(indices, values - values.mean())
    cluster_count, variance = len(sums), float(values.var())
    if variance == 0.0 or cluster_count < 2:
        return math.nan
    return float((sums**2).sum()) * cluster_count / (cluster_count - 1.0) / (len(values) * variance)


def _correlation(design_effect: float, sample: CaseSample) -> float:
    """Return the correlation within clusters that makes a design effect, from 0 to 1."""
    if sample.typical_size == 1.0:
        return 0.0
    return min(max((design_effect - 1.0) / (sample.typical_size - 1.0), 0.0), 1.0) if design_effect >= 0.0 else math.nan

"""95 % intervals from clusters of cases: arrays in, limits out, vectorised over leading axes.

Cases of a cluster (repetitions of a scenario, frames of a drive) are dependent, so nothing here uses a single case:
the precision of a mean follows from how the clusters' contributions vary. Two families of limits are enough. A
quantity between two bounds (a share, route completion) gets beta limits at an effective number of cases; a quantity
without bounds gets Student limits, widened where the clusters are skewed. benchmarks/interval_coverage.py measures
their coverage.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import numpy.typing as npt

from ssad.core.types import F64, Bool

LEVEL = 0.95
MIN_CLUSTERS = 5
"""With fewer clusters there is no interval; their range is shown."""
MIN_ROUTES = 10
"""Routes of a town from which on a number of drives has an interval: fewer show their range."""
MIN_DIFFERENT = 8
"""A mean without bounds has an interval only if so many clusters differ from the commonest value."""

_EXTREME_WEIGHT = 0.3
"""Part of a cluster that each end of an interval of a mean leaves room for: of the intervals simulated, at least
93.4 % hold in every case (93.9 with 0.5), and at most 97.5 % where clusters are normal (97.8 with 0.5)."""
_ALIKE_WEIGHT = 0.1
"""Part of a cluster, all of whose cases are alike, that the design effect of a share makes room for."""
_Z = NormalDist().inv_cdf(0.5 + 0.5 * LEVEL)
_TAIL_PROBABILITY = 0.5 - 0.5 * LEVEL


@dataclass(frozen=True)
class Clusters:
    """Grouping of cases, the same for every data set along the leading axes of the functions below.

    Attributes:
        size: [K] cases in each cluster.
        stratum: [K] index of the stratum of each cluster; strata weigh the same in the mean.
    """

    size: F64
    stratum: npt.NDArray[np.intp]

    @property
    def member(self) -> F64:
        """[K, H] 1 where a cluster belongs to a stratum."""
        return np.eye(int(self.stratum.max()) + 1)[self.stratum]

    @property
    def weight(self) -> F64:
        """[K] weight of each cluster in the mean; the sum is 1."""
        cases = self.size @ self.member
        return np.asarray(self.size / cases[self.stratum] / len(cases))


@dataclass(frozen=True)
class ConfidenceLimits:
    """Mean, limits [...] (NaN: no interval) and the name of the method."""

    mean: F64
    low: F64
    high: F64
    method: str


def bounded_limits(sums: F64, clusters: Clusters, *, cap: float = math.inf) -> ConfidenceLimits:
    """Return the interval of the mean of values in [0, 1]: beta limits at an effective number of cases.

    The effective number is that of independent yes-or-no cases whose share would vary as the clusters do (Korn
    and Graubard 1998), less for few degrees of freedom. It is never below the number of clusters, since no values
    in [0, 1] vary more. A stratum whose clusters are all 0 or all 1 counts as if half a cluster differed.

    Values that are 0 or 1 make room for clusters that are more alike than those seen (`alike_inverse`).

    Args:
        sums: [..., K] sum of the values of each cluster.
        clusters: Their sizes and strata.
        cap: Maximum effective number: twice the number of cases for values that are 0 or 1, infinite for others.

    Returns:
        The limits [...]; NaN where values inside (0, 1) do not vary at all and `cap` is infinite.
    """
    means, mean, contributions = _contributions(sums, clusters)
    cluster_counts = clusters.member.sum(axis=0)
    # With a stratum of one cluster, `_spread` merges all strata, so none is degenerate on its own.
    is_degenerate = ((means <= 0.0) | (means >= 1.0)) & (cluster_counts.min() >= 2)
    assumed_share = 0.5 / (cluster_counts + 1.0)
    assumed_contribution = (
        np.sqrt(assumed_share * (1.0 - assumed_share) * (cluster_counts - 1.0) / cluster_counts)[clusters.stratum]
        * clusters.weight
    )
    spread = _spread(np.where(is_degenerate[..., clusters.stratum], assumed_contribution, contributions), clusters)
    min_effective = 1.0 / float((clusters.weight**2).sum())
    if len(cluster_counts) == 1 and (clusters.size == 1.0).all() and math.isfinite(cap):
        effective = np.full(mean.shape, clusters.size.sum())  # nothing to estimate: the cases are independent
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = spread.variance / (mean * (1.0 - mean))
        if math.isfinite(cap):
            inverse = alike_inverse(inverse, spread.active_clusters, min_effective)
        with np.errstate(divide="ignore", invalid="ignore"):
            effective = (_Z / t_quantile(spread.freedom)) ** 2 / inverse
        is_constant = _flat(spread.variance, mean) & (mean > 0.0) & (mean < 1.0)
        effective = np.clip(
            np.where(is_constant, np.inf, np.nan_to_num(effective, nan=min_effective)), min_effective, cap
        )
    lower, upper = share_limits(mean, np.where(np.isinf(effective), 1.0, effective))
    has_interval = np.isfinite(effective)
    return ConfidenceLimits(mean, np.where(has_interval, lower, np.nan), np.where(has_interval, upper, np.nan), "beta")


def alike_inverse(inverse: F64, active_clusters: F64, min_effective: float) -> F64:
    """Return one over the effective number of a share, averaged with that of cases all alike.

    Few clusters with events rarely include the largest ones. So cases all alike stand for 0.1 of a cluster beside
    those that carry the variation.

    Args:
        inverse: [...] variance of the share over that of a single case.
        active_clusters: [...] number of clusters that carry the variation.
        min_effective: Effective number of cases all alike.
    """
    alike_part = _ALIKE_WEIGHT / (active_clusters + _ALIKE_WEIGHT)
    return np.asarray((1.0 - alike_part) * inverse + alike_part / min_effective)


def variance_freedom(active_clusters: F64, clusters: int, max_freedom: float) -> F64:
    """Return the degrees of freedom of a variance that few clusters may carry.

    Args:
        active_clusters: [...] number of equal contributions with the same kurtosis.
        clusters: Number of clusters.
        max_freedom: Clusters less strata.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        kurtosis = clusters / active_clusters
    freedom = np.nan_to_num(2.0 * clusters / np.maximum(kurtosis - 1.0, 1e-9), nan=max_freedom)
    return np.asarray(np.clip(freedom, 1.0, max_freedom))


def mean_limits(sums: F64, clusters: Clusters) -> ConfidenceLimits:
    """Interval of the mean of values without bounds: Student's, wider at both ends and on the side of the skew.

    The degrees of freedom fall with the kurtosis of the clusters; each end leaves room for 0.3 of a cluster more
    that pulls as much as the strongest one; the longer tail gets the skewness term of Johnson (1978).

    Args:
        sums: [..., K] sum of the values of each cluster.
        clusters: their sizes and strata.

    Returns:
        The limits [...]; NaN where fewer than `MIN_DIFFERENT` clusters differ from the commonest value.
    """
    _, mean, contributions = _contributions(sums, clusters)
    spread = _spread(contributions, clusters)
    t = t_quantile(spread.freedom)
    standard_error = np.sqrt(spread.variance)
    skew_term = spread.skew * (2.0 * t * t + 1.0) / 6.0 * standard_error
    lower = mean - t * standard_error - np.maximum(-skew_term, 0.0) + _EXTREME_WEIGHT * contributions.min(axis=-1)
    upper = mean + t * standard_error + np.maximum(skew_term, 0.0) + _EXTREME_WEIGHT * contributions.max(axis=-1)
    has_interval = (_different(sums / clusters.size) >= MIN_DIFFERENT) & ~_flat(spread.variance, mean)
    return ConfidenceLimits(mean, np.where(has_interval, lower, np.nan), np.where(has_interval, upper, np.nan), "t")


def replicate_limits(value: F64, variance: F64, clusters: int, *, bounded: bool) -> tuple[F64, F64]:
    """Return the interval of a score from the variance of its bootstrap replicates over clusters.

    Args:
        value: [...] the score itself, at least 0, and at most 1 if it is bounded.
        variance: [...] sample variance of the replicates.
        clusters: Number of resampled clusters, at least 2.
        bounded: Whether the score cannot exceed 1 (beta limits; otherwise Student limits of its logarithm).
    """
    corrected_variance = (
        variance * clusters / (clusters - 1.0)
    )  # a resample of C clusters varies by (C - 1) / C too little
    t = t_quantile(np.asarray(clusters - 1.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        if bounded:
            effective = np.nan_to_num(
                value * (1.0 - value) / corrected_variance * (_Z / t) ** 2, nan=clusters, posinf=1e9
            )
            return share_limits(value, np.clip(effective, clusters, 1e9))
        # Limits on the logarithm stay above 0; the error of the logarithm is the relative error.
        factor = np.exp(t * np.sqrt(corrected_variance) / value)
    return value / factor, value * factor


def difference_limits(first: ConfidenceLimits, second: ConfidenceLimits) -> tuple[F64, F64]:
    """Return limits of first - second, two shares of one multinomial, from the limits of each (MOVER).

    Args:
        first: Limits [...] of the share of the cases where only the first system has the event.
        second: The same for the second system.

    Source:
        Donner and Zou, "Closed-form confidence intervals for functions of the normal mean and standard deviation"
        (2012); Newcombe, "Improved confidence intervals for the difference between binomial proportions based on
        paired data" (1998).
    """
    product = first.mean * second.mean
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.where(product == 0.0, 0.0, -np.sqrt(product / ((1.0 - first.mean) * (1.0 - second.mean))))

    def margin(first_margin: F64, second_margin: F64) -> F64:
        squares = first_margin**2 + second_margin**2 - 2.0 * correlation * first_margin * second_margin
        return np.asarray(np.sqrt(np.maximum(squares, 0.0)))

    mean = first.mean - second.mean
    lower = mean - margin(first.mean - first.low, second.high - second.mean)
    upper = mean + margin(first.high - first.mean, second.mean - second.low)
    return np.maximum(lower, -1.0), np.minimum(upper, 1.0)


def share_limits(share: npt.ArrayLike, n: npt.ArrayLike) -> tuple[F64, F64]:
    """Return limits of a share observed in n independent cases; n and the number of events need not be whole.

    Midway between Clopper and Pearson's exact limits and Jeffreys' (the exact ones alone hold in 98 to 99 % of
    cases for small n, Jeffreys' in as few as 88 %); with at most one event, or at most one non-event, the exact
    limits.
    """
    from scipy.special import betaincinv

    p, n = np.broadcast_arrays(np.asarray(share, np.float64), np.asarray(n, np.float64))
    events, non_events = p * n, (1.0 - p) * n
    rarer_count = np.minimum(events, non_events)
    jeffreys_part = 0.25 * np.clip(rarer_count - 1.0, 0.0, 1.0)
    # beyond 500 events, beta and score limits agree to three digits
    is_large = rarer_count > 500.0
    centre, half_width = p + _Z**2 / (2.0 * n), _Z * np.sqrt(p * (1.0 - p) / n + _Z**2 / (4.0 * n * n))
    lower = np.where(is_large, (centre - half_width) / (1.0 + _Z**2 / n), 0.0)
    upper = np.where(is_large, (centre + half_width) / (1.0 + _Z**2 / n), 1.0)
    needs_beta = ~is_large & (events > 0.0)
    lower[needs_beta] = betaincinv(
        (events + jeffreys_part)[needs_beta], (non_events + 1.0 - jeffreys_part)[needs_beta], _TAIL_PROBABILITY
    )
    needs_beta = ~is_large & (non_events > 0.0)
    upper[needs_beta] = betaincinv(
        (events + 1.0 - jeffreys_part)[needs_beta], (non_events + jeffreys_part)[needs_beta], 1.0 - _TAIL_PROBABILITY
    )
    return lower, upper


def t_quantile(freedom: npt.ArrayLike) -> F64:
    """Return the two-sided quantile of Student's distribution; degrees of freedom need not be whole."""
    from scipy.special import stdtrit

    return np.asarray(stdtrit(freedom, 0.5 + 0.5 * LEVEL), np.float64)


@dataclass(frozen=True)
class _Spread:
    """Variation of contributions.

    Attributes:
        variance: [...] variance of their sum.
        freedom: [...] degrees of freedom, fewer where few clusters carry the variation.
        active_clusters: [...] number of equal contributions that would have the same kurtosis.
        skew: [...] skewness of the sum.
    """

    variance: F64
    freedom: F64
    active_clusters: F64
    skew: F64


def _contributions(sums: F64, clusters: Clusters) -> tuple[F64, F64, F64]:
    """Means of the strata [..., H], their mean [...], and what each cluster adds to its error [..., K]."""
    cases = clusters.size @ clusters.member
    means = sums @ clusters.member / cases
    mean = means.mean(axis=-1)
    has_single = clusters.member.sum(axis=0).min() < 2
    # A stratum of one cluster has no variance of its own: all then vary around the common mean.
    centre = mean[..., None] if has_single else means[..., clusters.stratum]
    return means, mean, (sums / clusters.size - centre) * clusters.weight


def _spread(contributions: F64, clusters: Clusters) -> _Spread:
    cluster_counts = clusters.member.sum(axis=0)
    if cluster_counts.min() < 2:
        cluster_counts = np.array([float(len(contributions.T))])
        stratum_count = np.full(contributions.shape[-1], cluster_counts[0])
    else:
        stratum_count = cluster_counts[clusters.stratum]
    cluster_count, max_freedom = contributions.shape[-1], float((cluster_counts - 1.0).sum())
    with np.errstate(divide="ignore", invalid="ignore"):
        # One cluster in all has no variance: 0 / 0 is NaN, and so is every limit that needs one.
        variance = (contributions**2 * stratum_count / (stratum_count - 1.0)).sum(axis=-1)
        active_clusters = (contributions**2).sum(axis=-1) ** 2 / (contributions**4).sum(axis=-1)
        third_moment = (
            contributions**3 * stratum_count**2 / np.maximum((stratum_count - 1.0) * (stratum_count - 2.0), 1.0)
        ).sum(axis=-1)
        skew = np.nan_to_num(third_moment / variance**1.5)
    freedom = variance_freedom(active_clusters, cluster_count, max_freedom)
    return _Spread(variance, freedom, np.nan_to_num(active_clusters), skew)


def _different(means: F64) -> npt.NDArray[np.intp]:
    """Return [...] the number of clusters' means [..., K] that differ from the commonest one."""
    is_equal = np.isclose(means[..., :, None], means[..., None, :], rtol=1e-9, atol=1e-12)
    largest_tie = is_equal.sum(axis=-1).max(axis=-1)
    return np.asarray(means.shape[-1] - np.where(largest_tie > 1, largest_tie, 0))


def _flat(variance: F64, mean: F64) -> Bool:
    """Return where the contributions are constant but for rounding."""
    return np.asarray(np.sqrt(variance) <= 1e-12 * np.maximum(np.abs(mean), 1e-12))

"""95 % intervals from clusters of cases: arrays in, limits out, vectorised over leading axes.

Cases of a cluster (repetitions of a scenario, frames of a drive) are alike, so nothing here looks at a case alone: a
mean is known as well as the clusters' contributions to it vary. Two families of limits are enough. A quantity between
two bounds (a share, route completion) gets beta limits at an effective number of cases; a quantity without bounds gets
Student limits, widened where the clusters are skewed. benchmarks/interval_coverage.py measures how often they hold.
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
MIN_DIFFERENT = 8
"""A mean without bounds has an interval only if so many clusters differ from the commonest value."""

_ROOM = 0.3
"""Part of a cluster that each end of an interval of a mean leaves room for: of the intervals simulated, at least
93.4 % hold in every case (93.9 with 0.5), and at most 97.5 % where clusters are normal (97.8 with 0.5)."""
_Z = NormalDist().inv_cdf(0.5 + 0.5 * LEVEL)
_TAIL = 0.5 - 0.5 * LEVEL


@dataclass(frozen=True)
class Clusters:
    """How cases are grouped: the same for every data set along the leading axes of the functions below.

    Attributes:
        size: [K] cases in each cluster.
        stratum: [K] index of the stratum that each cluster belongs to; strata weigh the same in the mean.
    """

    size: F64
    stratum: npt.NDArray[np.intp]

    @property
    def member(self) -> F64:
        """[K, H] 1 where a cluster belongs to a stratum."""
        return np.eye(int(self.stratum.max()) + 1)[self.stratum]

    @property
    def weight(self) -> F64:
        """[K] what each cluster weighs in the mean; the sum is 1."""
        cases = self.size @ self.member
        return np.asarray(self.size / cases[self.stratum] / len(cases))


@dataclass(frozen=True)
class Limits:
    """Mean, limits [...] (NaN: no interval) and the name of the method."""

    mean: F64
    low: F64
    high: F64
    method: str


def bounded_limits(sums: F64, clusters: Clusters, *, cap: float = math.inf) -> Limits:
    """Interval of the mean of values in [0, 1]: beta limits at an effective number of cases.

    The effective number is that of independent yes-or-no cases whose share would vary as the clusters do (Korn and
    Graubard 1998), less for few degrees of freedom. It is never below the number of clusters, since no values in
    [0, 1] vary more. A stratum whose clusters are all 0 or all 1 counts as if half a cluster differed.

    Args:
        sums: [..., K] sum of the values of each cluster.
        clusters: their sizes and strata.
        cap: the effective number is at most this; twice the number of cases for values that are 0 or 1.

    Returns:
        Limits [...]; NaN where values inside (0, 1) do not vary at all and `cap` is infinite.
    """
    means, mean, part = _contributions(sums, clusters)
    count = clusters.member.sum(axis=0)
    # with a stratum of one cluster all are merged below, and none is at an edge of its own
    edge = ((means <= 0.0) | (means >= 1.0)) & (count.min() >= 2)
    share = 0.5 / (count + 1.0)
    assumed = np.sqrt(share * (1.0 - share) * (count - 1.0) / count)[clusters.stratum] * clusters.weight
    spread = _spread(np.where(edge[..., clusters.stratum], assumed, part), clusters)
    least = 1.0 / float((clusters.weight**2).sum())
    if len(count) == 1 and (clusters.size == 1.0).all() and math.isfinite(cap):
        effective = np.full(mean.shape, clusters.size.sum())  # nothing to estimate: the cases are independent
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            effective = mean * (1.0 - mean) / spread.variance * (_Z / t_quantile(spread.freedom)) ** 2
        flat = _flat(spread.variance, mean) & (mean > 0.0) & (mean < 1.0)
        effective = np.clip(np.where(flat, np.inf, np.nan_to_num(effective, nan=least)), least, cap)
    low, high = share_limits(mean, np.where(np.isinf(effective), 1.0, effective))
    known = np.isfinite(effective)
    return Limits(mean, np.where(known, low, np.nan), np.where(known, high, np.nan), "beta")


def mean_limits(sums: F64, clusters: Clusters) -> Limits:
    """Interval of the mean of values without bounds: Student's, wider at both ends and on the side of the skew.

    The degrees of freedom fall with the kurtosis of the clusters; each end leaves room for 0.3 of a cluster more
    that pulls as much as the strongest one; the longer tail gets the skewness term of Johnson (1978).

    Args:
        sums: [..., K] sum of the values of each cluster.
        clusters: their sizes and strata.

    Returns:
        Limits [...]; NaN where fewer than `MIN_DIFFERENT` clusters differ from the commonest value.
    """
    _, mean, part = _contributions(sums, clusters)
    spread = _spread(part, clusters)
    t = t_quantile(spread.freedom)
    error = np.sqrt(spread.variance)
    skewed = spread.skew * (2.0 * t * t + 1.0) / 6.0 * error
    low = mean - t * error - np.maximum(-skewed, 0.0) + _ROOM * part.min(axis=-1)
    high = mean + t * error + np.maximum(skewed, 0.0) + _ROOM * part.max(axis=-1)
    known = (_different(sums / clusters.size) >= MIN_DIFFERENT) & ~_flat(spread.variance, mean)
    return Limits(mean, np.where(known, low, np.nan), np.where(known, high, np.nan), "t")


def replicate_limits(value: F64, variance: F64, clusters: int, *, bounded: bool) -> tuple[F64, F64]:
    """Interval of a score from the variance of its bootstrap replicates over clusters.

    Args:
        value: [...] the score itself, at least 0, and at most 1 if it is bounded.
        variance: [...] sample variance of the replicates.
        clusters: how many clusters were resampled, at least 2.
        bounded: whether the score cannot exceed 1 (then beta limits, else Student limits of its logarithm).
    """
    ours = variance * clusters / (clusters - 1.0)  # a resample of C clusters varies by (C - 1) / C too little
    t = t_quantile(np.asarray(clusters - 1.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        if bounded:
            effective = np.nan_to_num(value * (1.0 - value) / ours * (_Z / t) ** 2, nan=clusters, posinf=1e9)
            return share_limits(value, np.clip(effective, clusters, 1e9))
        factor = np.exp(t * np.sqrt(ours) / value)
    return value / factor, value * factor


def share_limits(share: npt.ArrayLike, n: npt.ArrayLike) -> tuple[F64, F64]:
    """Limits of a share seen in n independent cases; n and the number of events need not be whole.

    Half-way between Clopper and Pearson's exact limits and Jeffreys' (the exact ones alone hold in 98 to 99 % of cases
    for small n, Jeffreys' in as few as 88 %); with one event or none, or all or all but one, the exact limits.
    """
    from scipy.special import betaincinv

    p, n = np.broadcast_arrays(np.asarray(share, np.float64), np.asarray(n, np.float64))
    events, rest = p * n, (1.0 - p) * n
    fewer = np.minimum(events, rest)
    a = 0.25 * np.clip(fewer - 1.0, 0.0, 1.0)
    # beyond 500 events beta and score limits are the same to three digits
    many = fewer > 500.0
    centre, half = p + _Z**2 / (2.0 * n), _Z * np.sqrt(p * (1.0 - p) / n + _Z**2 / (4.0 * n * n))
    low = np.where(many, (centre - half) / (1.0 + _Z**2 / n), 0.0)
    high = np.where(many, (centre + half) / (1.0 + _Z**2 / n), 1.0)
    some = ~many & (events > 0.0)
    low[some] = betaincinv((events + a)[some], (rest + 1.0 - a)[some], _TAIL)
    some = ~many & (rest > 0.0)
    high[some] = betaincinv((events + 1.0 - a)[some], (rest + a)[some], 1.0 - _TAIL)
    return low, high


def t_quantile(freedom: npt.ArrayLike) -> F64:
    """Two-sided quantile of Student's distribution; the degrees of freedom need not be whole."""
    from scipy.special import stdtrit

    return np.asarray(stdtrit(freedom, 0.5 + 0.5 * LEVEL), np.float64)


@dataclass(frozen=True)
class _Spread:
    """How contributions vary: variance of their sum, degrees of freedom, skewness of the sum."""

    variance: F64
    freedom: F64
    skew: F64


def _contributions(sums: F64, clusters: Clusters) -> tuple[F64, F64, F64]:
    """Means of the strata [..., H], their mean [...], and what each cluster adds to its error [..., K]."""
    cases = clusters.size @ clusters.member
    means = sums @ clusters.member / cases
    mean = means.mean(axis=-1)
    single = clusters.member.sum(axis=0).min() < 2
    # a stratum of one cluster does not show how clusters vary: then all vary around the common mean
    centre = mean[..., None] if single else means[..., clusters.stratum]
    return means, mean, (sums / clusters.size - centre) * clusters.weight


def _spread(part: F64, clusters: Clusters) -> _Spread:
    count = clusters.member.sum(axis=0)
    if count.min() < 2:
        count = np.array([float(len(part.T))])
        each = np.full(part.shape[-1], count[0])
    else:
        each = count[clusters.stratum]
    variance = (part**2 * each / (each - 1.0)).sum(axis=-1)
    total, full = part.shape[-1], float((count - 1.0).sum())
    with np.errstate(divide="ignore", invalid="ignore"):
        kurtosis = total * (part**4).sum(axis=-1) / (part**2).sum(axis=-1) ** 2
        freedom = np.nan_to_num(2.0 * total / np.maximum(kurtosis - 1.0, 1e-9), nan=full)
        third = (part**3 * each**2 / np.maximum((each - 1.0) * (each - 2.0), 1.0)).sum(axis=-1)
        skew = np.nan_to_num(third / variance**1.5)
    return _Spread(variance, np.clip(freedom, 1.0, full), skew)


def _different(means: F64) -> npt.NDArray[np.intp]:
    """[...] how many of the clusters' means [..., K] differ from the one that occurs most often, if one does."""
    alike = np.isclose(means[..., :, None], means[..., None, :], rtol=1e-9, atol=1e-12)
    most = alike.sum(axis=-1).max(axis=-1)
    return np.asarray(means.shape[-1] - np.where(most > 1, most, 0))


def _flat(variance: F64, mean: F64) -> Bool:
    """Where the contributions are alike but for rounding."""
    return np.asarray(np.sqrt(variance) <= 1e-12 * np.maximum(np.abs(mean), 1e-12))

"""95 % intervals from clusters of cases: arrays in, limits out, vectorised over leading axes.

Cases of a cluster (repetitions of a scenario, frames of a drive) are alike, so nothing here looks at a case alone: a
mean is known as well as the clusters' contributions to it vary. Two families of limits are enough. A quantity between
two bounds (a share, route completion) gets beta limits at an effective number of cases; a quantity without bounds gets
Student limits, widened where the clusters are skewed. benchmarks/interval_coverage.py measures how often they hold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.types import F64, Bool

LEVEL = 0.95
MIN_CLUSTERS = 5
"""With fewer clusters there is no interval; their range is shown."""
MIN_DIFFERENT = 8
"""A mean without bounds has an interval only if so many clusters differ from the commonest value."""

_Z = NormalDist().inv_cdf(0.5 + 0.5 * LEVEL)
_TAIL = 0.5 - 0.5 * LEVEL
_log_gamma = np.frompyfunc(math.lgamma, 1, 1)


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
    edge = (means <= 0.0) | (means >= 1.0)
    if count.min() < 2:  # the strata are merged below, so none is at an edge unless all are
        edge = np.broadcast_to(((mean <= 0.0) | (mean >= 1.0))[..., None], edge.shape)
        count = np.full(len(count), len(clusters.size))
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

    The degrees of freedom fall with the kurtosis of the clusters; each end leaves room for half a cluster more that
    pulls as much as the strongest one; the longer tail gets the skewness term of Johnson (1978).

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
    low = mean - t * error - np.maximum(-skewed, 0.0) + 0.5 * part.min(axis=-1)
    high = mean + t * error + np.maximum(skewed, 0.0) + 0.5 * part.max(axis=-1)
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
    shape = np.broadcast_shapes(np.shape(share), np.shape(n))
    p = np.broadcast_to(np.asarray(share, np.float64), shape).ravel()
    n = np.broadcast_to(np.asarray(n, np.float64), shape).ravel()
    events, rest = p * n, (1.0 - p) * n
    fewer = np.minimum(events, rest)
    a = 0.25 * np.clip(fewer - 1.0, 0.0, 1.0)
    # beyond 500 events beta and score limits are the same to three digits, and the continued fraction gets long
    centre, half = (p + _Z**2 / (2 * n)) / (1 + _Z**2 / n), np.sqrt(p * (1 - p) / n + _Z**2 / (4 * n * n))
    half = half * _Z / (1 + _Z**2 / n)
    low = np.where(events > 0.0, centre - half, 0.0)
    high = np.where(rest > 0.0, centre + half, 1.0)
    some = (fewer <= 500.0) & (events > 0.0)
    low[some] = beta_quantile(_TAIL, (events + a)[some], (rest + 1.0 - a)[some])
    some = (fewer <= 500.0) & (rest > 0.0)
    high[some] = beta_quantile(1.0 - _TAIL, (events + 1.0 - a)[some], (rest + a)[some])
    return low.reshape(shape), high.reshape(shape)


def t_quantile(freedom: npt.ArrayLike, level: float = LEVEL) -> F64:
    """Two-sided quantile of Student's distribution; the degrees of freedom need not be whole."""
    values, where = np.unique(np.asarray(freedom, np.float64), return_inverse=True)
    x = beta_quantile(1.0 - level, values / 2.0, np.full(values.shape, 0.5))
    return np.asarray(np.sqrt(values * (1.0 - x) / x)[where].reshape(np.shape(freedom)))


def beta_quantile(probability: float, a: F64, b: F64) -> F64:
    """Quantile of the beta distribution with parameters a and b [N]: Newton's method within a bracket."""
    if len(a) == 1:
        return np.array([_one_quantile(probability, float(a[0]), float(b[0]))])
    return _quantiles(probability, a, b)


@lru_cache(maxsize=1 << 16)
def _one_quantile(probability: float, a: float, b: float) -> float:
    """The same few shares come again all over a report."""
    return float(_quantiles(probability, np.array([a]), np.array([b]))[0])


def _quantiles(probability: float, a: F64, b: F64) -> F64:
    low, high = np.zeros(a.shape), np.ones(a.shape)
    x = a / (a + b)
    scale = _log(a + b) - _log(a) - _log(b)
    open_ = np.arange(len(a))
    for _ in range(200):
        y, p, q = x[open_], a[open_], b[open_]
        excess = beta_probability(y, p, q) - probability
        low[open_], high[open_] = np.where(excess < 0.0, y, low[open_]), np.where(excess < 0.0, high[open_], y)
        with np.errstate(all="ignore"):
            step = y - excess / np.exp(scale[open_] + (p - 1.0) * np.log(y) + (q - 1.0) * np.log1p(-y))
        inside = (step > low[open_]) & (step < high[open_])  # False for NaN
        x[open_] = np.where(inside, step, 0.5 * (low[open_] + high[open_]))
        open_ = open_[np.abs(x[open_] - y) > 1e-11 * np.minimum(x[open_], 1.0 - x[open_]) + 1e-300]
        if not len(open_):
            break
    return x


def beta_probability(x: F64, a: F64, b: F64) -> F64:
    """Regularised incomplete beta function by its continued fraction (Abramowitz and Stegun 26.5.8)."""
    flip = x > (a + 1.0) / (a + b + 2.0)
    x, a, b = np.where(flip, 1.0 - x, x), np.where(flip, b, a), np.where(flip, a, b)
    with np.errstate(divide="ignore"):
        front = np.exp(_log(a + b) - _log(a) - _log(b) + a * np.log(x) + b * np.log1p(-x)) / a
    # Lentz's algorithm
    tiny = 1e-300
    d = 1.0 / _away(1.0 - (a + b) * x / (a + 1.0), tiny)
    c, total = np.ones(a.shape), d
    for m in range(1, 2000):
        for step in (
            m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1)),
        ):
            d = 1.0 / _away(1.0 + step * d, tiny)
            c = _away(1.0 + step / c, tiny)
            total = total * d * c
        if (np.abs(d * c - 1.0) < 1e-13).all():
            break
    return np.asarray(np.where(flip, 1.0 - front * total, front * total))


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


def _away(value: F64, tiny: float) -> F64:
    return np.asarray(np.where(np.abs(value) < tiny, tiny, value), np.float64)


def _log(value: F64) -> Any:
    """Logarithm of the gamma function."""
    return np.asarray(_log_gamma(value), np.float64)

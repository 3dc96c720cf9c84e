"""How sure a mean is: intervals for proportions, means and paired differences. Seeded, so the same data give the
same interval, whatever their order."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.seeding import generator
from ssad.core.types import F64

RESAMPLES = 2000
LEVEL = 0.95


@dataclass(frozen=True)
class Estimate:
    """A mean and its interval at 95 %; NaN where the data do not give one.

    n: values behind the mean; failed: episodes that gave no value because they failed; method: how the interval was
    found (`wilson`, `bca`, `percentile`, `cluster`, `mover`, `constant`, `none`).
    """

    mean: float
    low: float
    high: float
    n: int
    failed: int = 0
    method: str = "none"

    def as_dict(self) -> dict[str, Any]:
        """Field name -> value."""
        return asdict(self)


def wilson(successes: int, n: int, *, failed: int = 0, level: float = LEVEL) -> Estimate:
    """Proportion successes / n with Wilson's score interval (Wilson 1927).

    failed: how many of the n have an unknown outcome. They count in n as no success, and the upper limit is that of
    all of them being one, so the interval holds whatever they were.
    """
    if not 0 <= successes <= n - failed:
        raise ValueError(f"{successes} successes and {failed} failed of {n}")
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan, 0, failed)
    low = _score_limits(successes, n, level)[0]
    high = _score_limits(successes + failed, n, level)[1]
    return Estimate(successes / n, low, high, n, failed, "wilson")


def mean_estimate(values: npt.ArrayLike, *, failed: int = 0, level: float = LEVEL) -> Estimate:
    """Mean of the values that are not NaN, with a bias-corrected accelerated bootstrap interval (Efron 1987).

    One value has no interval; equal values have an interval of no width (`constant`), which shows only that the data
    do not vary.
    """
    data = np.asarray(values, np.float64).ravel()
    data = np.sort(data[~np.isnan(data)])
    n = len(data)
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan, 0, failed)
    mean = float(data.mean())
    if n == 1:
        return Estimate(mean, math.nan, math.nan, 1, failed)
    if data[0] == data[-1] or not np.isfinite(data).all():
        return Estimate(mean, mean, mean, n, failed, "constant" if np.isfinite(mean) else "none")
    means = resample_counts(n) @ data / n
    low, high = _bca(means, data, mean, level)
    return Estimate(mean, low, high, n, failed, "bca")


def cluster_estimate(
    values: npt.ArrayLike, clusters: Sequence[Hashable], *, failed: int = 0, level: float = LEVEL
) -> Estimate:
    """Mean of the values, resampled by cluster (episodes of one scenario are alike): percentile bootstrap.

    values [n] and clusters [n]; NaN values are left out.
    """
    data = np.asarray(values, np.float64).ravel()
    groups: dict[Hashable, list[float]] = {}
    for value, cluster in zip(data.tolist(), clusters, strict=True):
        if not math.isnan(value):
            groups.setdefault(cluster, []).append(value)
    if len(groups) < 2:
        mean = math.nan if not groups else float(np.mean(next(iter(groups.values()))))
        return Estimate(mean, math.nan, math.nan, sum(map(len, groups.values())), failed)
    sums = np.array(sorted((math.fsum(group), len(group)) for group in groups.values()))
    counts = resample_counts(len(sums))
    low, high = percentile_interval(counts @ sums[:, 0] / (counts @ sums[:, 1]), level)
    return Estimate(sums[:, 0].sum() / sums[:, 1].sum(), low, high, int(sums[:, 1].sum()), failed, "cluster")


def paired_difference(
    first: Mapping[str, float | None], second: Mapping[str, float | None], *, level: float = LEVEL
) -> Estimate:
    """Mean of first - second over the scenarios (keys) that both have, with its bootstrap interval.

    failed: keys that only one has, or whose value is None or NaN in either.
    """
    keys = sorted(set(first) | set(second))
    pairs = [(first.get(key), second.get(key)) for key in keys]
    difference = [a - b for a, b in pairs if a is not None and b is not None and not math.isnan(a - b)]
    return mean_estimate(difference, failed=len(keys) - len(difference), level=level)


def mean_of_estimates(estimates: Sequence[Estimate]) -> Estimate:
    """Unweighted mean of independent estimates (the paper's Avg. column); those without a mean are left out.

    The limits' distances from the mean add as squares (MOVER, Zou and Donner 2008).
    """
    known = [e for e in estimates if not math.isnan(e.mean)]
    n, failed = sum(e.n for e in estimates), sum(e.failed for e in estimates)
    if not known:
        return Estimate(math.nan, math.nan, math.nan, n, failed)
    mean = math.fsum(e.mean for e in known) / len(known)
    below = math.sqrt(math.fsum((e.mean - e.low) ** 2 for e in known)) / len(known)
    above = math.sqrt(math.fsum((e.high - e.mean) ** 2 for e in known)) / len(known)
    method = "none" if math.isnan(below + above) else "mover"
    return Estimate(mean, mean - below, mean + above, n, failed, method)


@lru_cache(maxsize=16)
def resample_counts(n: int) -> F64:
    """[RESAMPLES, n] how often each of n values is drawn in each resample; read-only, the same in every process."""
    counts = generator("bootstrap", n).multinomial(n, np.full(n, 1.0 / n), size=RESAMPLES).astype(np.float64)
    counts.setflags(write=False)
    return counts


def percentile_interval(samples: npt.ArrayLike, level: float = LEVEL) -> tuple[float, float]:
    """Limits that leave (1 - level) / 2 of the samples on each side."""
    tail = 0.5 * (1.0 - level)
    low, high = np.quantile(np.asarray(samples, np.float64), [tail, 1.0 - tail])
    return float(low), float(high)


def _score_limits(successes: int, n: int, level: float) -> tuple[float, float]:
    z = NormalDist().inv_cdf(0.5 + 0.5 * level)
    share = successes / n
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    # rounding must not move the limits that are 0 and 1 exactly
    low = 0.0 if successes == 0 else max(centre - half, 0.0)
    return low, 1.0 if successes == n else min(centre + half, 1.0)


def _bca(means: F64, data: F64, mean: float, level: float) -> tuple[float, float]:
    normal = NormalDist()
    below = float(((means < mean) + 0.5 * (means == mean)).mean())
    bias = normal.inv_cdf(min(max(below, 0.5 / len(means)), 1.0 - 0.5 / len(means)))
    # a mean with one value left out differs from the mean by -(value - mean) / (n - 1)
    deviation = data - mean
    acceleration = float((deviation**3).sum() / (6.0 * (deviation**2).sum() ** 1.5))
    limits = []
    for tail in (0.5 - 0.5 * level, 0.5 + 0.5 * level):
        z = bias + normal.inv_cdf(tail)
        limits.append(float(np.quantile(means, normal.cdf(bias + z / max(1.0 - acceleration * z, 1e-6)))))
    return min(limits[0], mean), max(limits[1], mean)

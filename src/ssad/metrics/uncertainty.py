"""Uncertainty of results: means, scores and paired differences with their 95 % intervals.

Every estimate takes values with their case and cluster. Copies of one case count once, cases of one cluster are
dependent, and the interval follows from the variation of the clusters. Nothing is drawn at random, so the same data
give the same interval in any order. The methods in plain words: docs/explanation/intervals.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ssad.core.seeding import generator
from ssad.core.types import F64
from ssad.metrics.intervals import (
    MIN_CLUSTERS,
    Clusters,
    ConfidenceLimits,
    bounded_limits,
    difference_limits,
    mean_limits,
    replicate_limits,
)

Kind = Literal["share", "bounded", "mean"]


@dataclass(frozen=True)
class CaseValue:
    """Value of one case.

    Attributes:
        value: The number; NaN where it was not measured, or is unknown because the case failed.
        cluster: Key that dependent cases share (scenario, route, drive).
        case: Key of the case; values of the same case and stratum are copies.
        stratum: Group of the case where several are averaged; groups weigh the same.
        failed: Whether the case failed.
    """

    value: float
    cluster: str
    case: str
    stratum: str = ""
    failed: bool = False


@dataclass(frozen=True)
class Estimate:
    """A mean with its interval; NaN where the data do not give it.

    Attributes:
        mean: The mean over the distinct cases, or over the strata's means.
        low: Lower limit, or the smallest cluster mean where method is "range".
        high: Upper limit, or the largest cluster mean where method is "range".
        n: Distinct cases behind the mean (copies count once), all of which have a value.
        failed: Cases that failed; they widen the limits of a share or of a bounded value.
        method: Meaning of low and high: "beta", "t" (95 % intervals), "range" (over the clusters, which are too
            few or too similar for an interval), "bounds" (one cluster, its failed cases once all 0 and once all at the
            upper bound), "none".
        clusters: Distinct clusters behind the mean.
    """

    mean: float
    low: float
    high: float
    n: int
    failed: int = 0
    method: str = "none"
    clusters: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Return the values by field name."""
        return asdict(self)

    def scaled(self, factor: float, offset: float = 0.0) -> Estimate:
        """Return the estimate of factor x value + offset."""
        limits = sorted((factor * self.low + offset, factor * self.high + offset))
        return replace(self, mean=factor * self.mean + offset, low=limits[0], high=limits[1])


NOTHING = Estimate(math.nan, math.nan, math.nan, 0)


def estimate(
    values: Iterable[CaseValue],
    kind: Kind,
    *,
    scale: float = 1.0,
    min_value: float = -math.inf,
    min_clusters: int = MIN_CLUSTERS,
) -> Estimate:
    """Mean of case values with its 95 % interval; with several strata, the unweighted mean of their means.

    The mean is over the cases that have a value. Failed cases, whose outcome is unknown, widen the limits of a share
    or of a bounded value: all of them count once as 0 and once as the upper bound, so the interval holds whatever
    they were. Where no case has a value there is no mean and no interval.

    Args:
        values: Values of the cases. Copies (same case, same stratum) count once; a value that was not measured is
            left out.
        kind: "share": values are 0 or 1. "bounded": values lie in [0, `scale`]. "mean": any values, whose failed cases
            have no bounds and are only counted.
        scale: Upper bound of a bounded value.
        min_value: Lower bound of a mean; the interval does not go below it.
        min_clusters: Clusters that an interval needs.

    Returns:
        The estimate. Fewer clusters, or clusters too alike for an interval: low and high are the range.
    """
    distinct_values = _distinct(values)
    failed = sum(case_value.failed for case_value in distinct_values)
    measured_values = [case_value for case_value in distinct_values if not math.isnan(case_value.value)]
    if not measured_values:
        return replace(NOTHING, failed=failed)
    limits_of = partial(_limits_of, kind=kind, scale=scale, min_value=min_value, min_clusters=min_clusters)
    measured_limits, cluster_count = limits_of(measured_values, assumed_value=math.nan)
    mean, low, high = (float(limit) for limit in (measured_limits.mean, measured_limits.low, measured_limits.high))
    method = measured_limits.method
    counted_values = [
        case_value for case_value in distinct_values if case_value.failed or not math.isnan(case_value.value)
    ]
    if kind != "mean" and len(counted_values) > len(measured_values):
        lowest, _ = limits_of(counted_values, assumed_value=0.0)
        highest, _ = limits_of(counted_values, assumed_value=1.0)
        low, high, method = float(lowest.low), float(highest.high), lowest.method
        if math.isnan(low) or math.isnan(high):  # one cluster has no interval, but its failed cases have bounds
            low, high, method = float(lowest.mean), float(highest.mean), "bounds"
    return Estimate(
        scale * mean,
        scale * min(low, mean),
        scale * max(high, mean),
        len(measured_values),
        failed,
        method,
        cluster_count,
    )


def _limits_of(
    values: Sequence[CaseValue],
    *,
    kind: Kind,
    scale: float,
    min_value: float,
    min_clusters: int,
    assumed_value: float,
) -> tuple[ConfidenceLimits, int]:
    """Return limits of values over `scale`, with an assumed value for those that are NaN; number of clusters."""
    clusters, cluster_index = _clusters(values)
    scaled_values = np.array([case_value.value for case_value in values]) / scale
    scaled_values[np.isnan(scaled_values)] = assumed_value
    cluster_sums = np.bincount(cluster_index, scaled_values, len(clusters.size)).astype(np.float64)
    return _ends(cluster_sums, clusters, kind, min_value / scale, min_clusters), len(clusters.size)


def replicate_estimate(
    value: float, replicates: Sequence[float], *, n: int, clusters: int, bounded: bool = True
) -> Estimate:
    """Estimate a score that is no mean (mAP, NDS and derived scores), with an interval from bootstrap replicates.

    Args:
        value: The score.
        replicates: The score of resamples of whole clusters (scenes).
        n: Cases behind the score.
        clusters: Number of resampled clusters; fewer than five give no interval.
        bounded: Whether the score lies in [0, 1]; else it is at least 0.
    """
    defined = np.array([replicate for replicate in replicates if not math.isnan(replicate)])
    variance = float(defined.var(ddof=1)) if len(defined) > 1 else math.nan
    if clusters < MIN_CLUSTERS or math.isnan(value + variance) or not (bounded or min(value, variance) > 0.0):
        return Estimate(value, math.nan, math.nan, n, clusters=clusters)
    lower, upper = replicate_limits(np.asarray(value), np.asarray(variance), clusters, bounded=bounded)
    return Estimate(value, float(lower), float(upper), n, 0, "beta" if bounded else "t", clusters)


def replicate_difference(value: float, differences: Sequence[float], *, n: int, clusters: int) -> Estimate:
    """Estimate a difference of two scores in [0, 1], with an interval from paired bootstrap replicates.

    Args:
        value: The difference, in [-1, 1].
        differences: The same of resamples of clusters, in each of which both scores have the same clusters.
        n: As for `replicate_estimate`.
        clusters: As for `replicate_estimate`.

    Returns:
        The estimate; its limits are those of (1 + difference) / 2, a score in [0, 1].
    """
    scores = [0.5 * (1.0 + difference) for difference in differences]
    return replicate_estimate(0.5 * (1.0 + value), scores, n=n, clusters=clusters).scaled(2.0, -1.0)


def paired_difference(
    first: Mapping[str, CaseValue],
    second: Mapping[str, CaseValue],
    *,
    kind: Literal["share", "mean"] = "mean",
    min_clusters: int = MIN_CLUSTERS,
) -> Estimate:
    """Return the mean of first - second over the cells that both have, by the rules of `estimate`.

    A mean has Student limits of the differences. A share has limits even where hardly any cell differs: the
    difference is that of two shares, the cells where only the first is 1 and those where only the second is,
    whose limits are combined (MOVER, with the correlation that two shares of one multinomial have). Cells that failed
    on either side are in neither share's mean, and widen the limits of both.

    Args:
        first: Values of one system by cell (scenario and repetition); clusters count, strata do not.
        second: Values of the other system. Two pairs are copies if both halves are.
        kind: "share": values are 0 or 1. "mean": any values.
        min_clusters: Clusters that an interval needs.

    Returns:
        The estimate; failed: cells that only one has, or that failed or were not measured in either.

    Source:
        Donner and Zou, "Closed-form confidence intervals for functions of the normal mean and standard deviation"
        (2012); Newcombe, "Improved confidence intervals for the difference between binomial proportions based on
        paired data" (1998).
    """
    pairs, missing = _pairs(first, second)
    if kind == "mean" or not pairs:
        return replace(estimate(pairs, "mean", min_clusters=min_clusters), failed=missing)
    unknown_pairs = [
        CaseValue(math.nan, first[key].cluster, f"{key}\nfailed", failed=True)
        for key in set(first) & set(second)
        if first[key].failed or second[key].failed
    ]
    only_first, only_second = (
        estimate(
            [*(replace(pair, value=float(sign * pair.value > 0.0)) for pair in pairs), *unknown_pairs],
            "share",
            min_clusters=min_clusters,
        )
        for sign in (1, -1)
    )
    first_share, second_share = only_first.mean, only_second.mean
    if "beta" not in (only_first.method, only_second.method):
        lowest, highest = (
            estimate(
                [*pairs, *(replace(pair, value=bound) for pair in unknown_pairs)], "mean", min_clusters=min_clusters
            )
            for bound in (-1.0, 1.0)
        )
        return replace(
            estimate(pairs, "mean", min_clusters=min_clusters),
            low=np.fmin(lowest.low, lowest.mean) if unknown_pairs else lowest.low,
            high=np.fmax(highest.high, highest.mean) if unknown_pairs else highest.high,
            failed=missing,
        )
    lower, upper = difference_limits(*(_as_limits(share) for share in (only_first, only_second)))
    return replace(only_first, mean=first_share - second_share, low=float(lower), high=float(upper), failed=missing)


def sign_flip_test(first: Mapping[str, CaseValue], second: Mapping[str, CaseValue], *, draws: int = 20_000) -> float:
    """Test whether first and second differ: how often chance alone gives a mean difference as large.

    If they do not, each cluster's difference is as likely to have the other sign. All signs are tried for up to 14
    clusters that differ (for shares with a case a cluster this is McNemar's exact test), else as many as `draws`.

    Args:
        first: As for `paired_difference`.
        second: As for `paired_difference`.
        draws: Random draws of signs beyond 14 clusters.

    Returns:
        Two-sided p-value; 1 where no cluster differs, NaN without a pair.

    Source:
        Fisher, "The Design of Experiments" (1935), section 21.
    """
    pairs, _ = _pairs(first, second)
    if not pairs:
        return math.nan
    distinct_pairs = _distinct(pairs)
    _, cluster_index = _clusters(distinct_pairs)
    cluster_sums = np.bincount(cluster_index, np.array([pair.value for pair in distinct_pairs]))
    cluster_sums = cluster_sums[cluster_sums != 0.0]
    if not len(cluster_sums):
        return 1.0
    is_exact = len(cluster_sums) <= 14
    if is_exact:
        signs = 1.0 - 2.0 * ((np.arange(2 ** len(cluster_sums))[:, None] >> np.arange(len(cluster_sums))) & 1)
    else:
        signs = generator("sign flip test", len(cluster_sums), draws).choice(
            [-1.0, 1.0], size=(draws, len(cluster_sums))
        )
    # The slack keeps ties that rounding would break.
    as_large = int((np.abs(signs @ cluster_sums) >= np.abs(cluster_sums.sum()) * (1.0 - 1e-9)).sum())
    # Random draws leave out the observed signs, hence the 1.
    return as_large / len(signs) if is_exact else (as_large + 1) / (draws + 1)


def _as_limits(share: Estimate) -> ConfidenceLimits:
    mean, low, high = (np.asarray(number) for number in (share.mean, share.low, share.high))
    return ConfidenceLimits(mean, low, high, share.method)


def complete_pairs(
    first: Mapping[str, CaseValue], second: Mapping[str, CaseValue]
) -> list[tuple[CaseValue, CaseValue]]:
    """Return the values of the cells that both have, that failed in neither and are measured in both.

    Args:
        first: Values of one system by cell.
        second: Values of the other system.
    """
    pairs = [(first[key], second[key]) for key in sorted(set(first) & set(second))]
    return [pair for pair in pairs if not any(half.failed or math.isnan(half.value) for half in pair)]


def _pairs(first: Mapping[str, CaseValue], second: Mapping[str, CaseValue]) -> tuple[list[CaseValue], int]:
    """Return the differences of the cells that both have, and the number of cells without one."""
    pairs = [
        CaseValue(
            first_value.value - second_value.value, first_value.cluster, f"{first_value.case}\n{second_value.case}"
        )
        for first_value, second_value in complete_pairs(first, second)
    ]
    return pairs, len(set(first) | set(second)) - len(pairs)


def _distinct(values: Iterable[CaseValue]) -> list[CaseValue]:
    """Return one value a case and stratum, in an order that does not depend on the input's."""
    distinct: dict[tuple[str, str], CaseValue] = {}
    # If copies disagree, one that ran takes precedence over one that failed or was not measured.
    for case_value in sorted(
        values,
        key=lambda case_value: (
            case_value.stratum,
            case_value.case,
            math.isnan(case_value.value),
            case_value.failed,
            case_value.cluster,
            str(case_value.value),
        ),
    ):
        distinct.setdefault((case_value.stratum, case_value.case), case_value)
    return list(distinct.values())


def _clusters(values: Sequence[CaseValue]) -> tuple[Clusters, npt.NDArray[np.intp]]:
    """Return the clusters of the values, and the cluster of each value."""
    strata = {name: index for index, name in enumerate(dict.fromkeys(case_value.stratum for case_value in values))}
    names = {
        name: index
        for index, name in enumerate(dict.fromkeys((case_value.stratum, case_value.cluster) for case_value in values))
    }
    cluster_index = np.array([names[case_value.stratum, case_value.cluster] for case_value in values])
    size = np.bincount(cluster_index).astype(np.float64)
    return Clusters(size, np.array([strata[stratum] for stratum, _ in names])), cluster_index


def _ends(cluster_sums: F64, clusters: Clusters, kind: Kind, min_value: float, min_clusters: int) -> ConfidenceLimits:
    """The interval, or the range of the clusters' means where there is none; one cluster has neither."""
    if len(cluster_sums) >= min_clusters:
        if kind == "mean":
            limits = mean_limits(cluster_sums, clusters)
        else:
            limits = bounded_limits(
                cluster_sums, clusters, cap=2.0 * clusters.size.sum() if kind == "share" else math.inf
            )
        if not math.isnan(float(limits.low)):
            return replace(limits, low=np.maximum(limits.low, min_value))
    means = cluster_sums / clusters.size
    mean = np.asarray(means @ clusters.weight)
    if len(means) == 1:
        return ConfidenceLimits(mean, np.asarray(math.nan), np.asarray(math.nan), "none")
    return ConfidenceLimits(mean, means.min(), means.max(), "range")

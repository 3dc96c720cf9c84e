"""Do two kinds of damage order perturbations alike? Spearman's rank correlation with its interval over families."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ssad.core.seeding import generator
from ssad.metrics.uncertainty import NOTHING, Estimate

REPLICATES = 2000
LEAST = 5
"""With fewer families there is no interval; with fewer points that differ, no correlation."""


def rank_correlation(first: npt.ArrayLike, second: npt.ArrayLike) -> float:
    """Spearman's rank correlation, ties by their mean rank.

    Args:
        first: [N].
        second: [N].

    Returns:
        In -1..1; NaN where either does not vary.
    """
    from scipy.stats import rankdata

    one, other = (rankdata(np.asarray(v, np.float64)) for v in (first, second))
    one, other = one - one.mean(), other - other.mean()
    size = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return float((one * other).sum() / size) if size > 0 else float("nan")


def family_correlation(first: Sequence[float], second: Sequence[float], families: Sequence[str]) -> Estimate:
    """Rank correlation over perturbations, its 95 % interval by drawing families, not points, with replacement.

    Severities of one perturbation are alike, so they never count as independent. Percentiles of the replicates in which
    the correlation is defined.

    Args:
        first: Damage of one kind, one number a perturbation.
        second: Damage of the other kind.
        families: Which family each belongs to.

    Returns:
        The estimate: n the points, clusters the families; method "bootstrap", or "none" with fewer than five families.
    """
    one, other = np.asarray(first, np.float64), np.asarray(second, np.float64)
    known = np.isfinite(one) & np.isfinite(other)
    one, other = one[known], other[known]
    names = [name for name, good in zip(families, known, strict=True) if good]
    unique = sorted(set(names))
    value = rank_correlation(one, other) if len(one) >= 3 else float("nan")
    if np.isnan(value):
        return NOTHING
    if len(unique) < LEAST:
        return Estimate(value, float("nan"), float("nan"), len(one), 0, "none", len(unique))
    rows = [np.array([k for k, name in enumerate(names) if name == family]) for family in unique]
    draws = generator("family correlation", len(one), len(unique))
    found = []
    for _ in range(REPLICATES):
        index = np.concatenate([rows[k] for k in draws.integers(0, len(rows), len(rows))])
        found.append(rank_correlation(one[index], other[index]))
    low, high = np.nanpercentile(found, [2.5, 97.5])
    return Estimate(value, float(low), float(high), len(one), 0, "bootstrap", len(unique))

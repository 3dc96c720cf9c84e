"""Spearman's rank correlation between two kinds of damage, with its interval over families of perturbations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ssad.core.seeding import generator
from ssad.metrics.uncertainty import NOTHING, Estimate

REPLICATES = 2000
MIN_PAIRS = 5
"""With fewer families there is no interval; with fewer points that differ, no correlation."""


def rank_correlation(first: npt.ArrayLike, second: npt.ArrayLike) -> float:
    """Return Spearman's rank correlation; ties get their mean rank.

    Args:
        first: [N].
        second: [N].

    Returns:
        In -1..1; NaN where either does not vary.
    """
    from scipy.stats import rankdata

    first_ranks, second_ranks = (rankdata(np.asarray(values, np.float64)) for values in (first, second))
    first_ranks, second_ranks = first_ranks - first_ranks.mean(), second_ranks - second_ranks.mean()
    norm_product = float(np.sqrt((first_ranks**2).sum() * (second_ranks**2).sum()))
    return float((first_ranks * second_ranks).sum() / norm_product) if norm_product > 0 else float("nan")


def family_correlation(first: Sequence[float], second: Sequence[float], families: Sequence[str]) -> Estimate:
    """Return the rank correlation over perturbations, with a 95 % interval by resampling families, not points.

    Severities of one perturbation are dependent, so they never count as independent. The limits are percentiles
    of the replicates in which the correlation is defined.

    Args:
        first: Damage of one kind, one number a perturbation.
        second: Damage of the other kind.
        families: Family of each perturbation.

    Returns:
        The estimate: n the points, clusters the families; method "bootstrap", or "none" with fewer than five
            families.
    """
    first_values, second_values = np.asarray(first, np.float64), np.asarray(second, np.float64)
    is_known = np.isfinite(first_values) & np.isfinite(second_values)
    first_values, second_values = first_values[is_known], second_values[is_known]
    names = [family_name for family_name, is_valid in zip(families, is_known, strict=True) if is_valid]
    unique = sorted(set(names))
    value = rank_correlation(first_values, second_values) if len(first_values) >= 3 else float("nan")
    if np.isnan(value):
        return NOTHING
    if len(unique) < MIN_PAIRS:
        return Estimate(value, float("nan"), float("nan"), len(first_values), 0, "none", len(unique))
    rows = [np.array([row for row, family_name in enumerate(names) if family_name == family]) for family in unique]
    random_source = generator("family correlation", len(first_values), len(unique))
    replicates = []
    for _ in range(REPLICATES):
        index = np.concatenate([rows[row] for row in random_source.integers(0, len(rows), len(rows))])
        replicates.append(rank_correlation(first_values[index], second_values[index]))
    lower, upper = np.nanpercentile(replicates, [2.5, 97.5])
    return Estimate(value, float(lower), float(upper), len(first_values), 0, "bootstrap", len(unique))

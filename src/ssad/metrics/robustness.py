"""How much a score suffers from shifts, over their severities: one number a system, and whether damage grows.

Scores are given as shift -> its scores at severities 1, 2, ... (such as NDS); every shift needs the same number of them
and none may be missing, since a mean over what happens to be there says nothing. Sources: mCE and mRR as in RoboBEV
(Xie et al. 2023), after Hendrycks and Dietterich 2019; trend test: Page 1963, Jonckheere 1954, by permutation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ssad.core.errors import ConfigError
from ssad.core.types import F64

Scores = Mapping[str, Sequence[float | None]]  # None: not run, which is refused


@dataclass(frozen=True)
class Trend:
    """A test for a trend: the statistic, its one-sided p-value, and how many permutations gave it (0: all of them)."""

    statistic: float
    p_value: float
    permutations: int


def corruption_error(scores: Scores, baseline: Scores) -> dict[str, float]:
    """CE of each shift: sum over severities of 1 - score, relative to that of the baseline system (1 = alike).

    ConfigError: a missing value, other shifts than the baseline, a baseline that is perfect under a shift.
    """
    names, values = _table(scores, "scores")
    others, base = _table(baseline, "baseline")
    if set(names) != set(others) or values.shape != base.shape:
        different = ", ".join(sorted(set(names) ^ set(others))) or "the number of severities"
        raise ConfigError(f"scores and baseline differ in: {different}; run both under the same shifts")
    base = base[[others.index(name) for name in names]]
    error, least = (1.0 - values).sum(axis=1), (1.0 - base).sum(axis=1)
    if (least == 0.0).any():
        name = names[int((least == 0.0).argmax())]
        raise ConfigError(f"shift '{name}': the baseline makes no error there, so none can be relative to it")
    return dict(zip(names, (error / least).tolist(), strict=True))


def mean_corruption_error(scores: Scores, baseline: Scores) -> float:
    """mCE: mean of CE over the shifts. Lower is better; 1 is the baseline itself."""
    return math.fsum(corruption_error(scores, baseline).values()) / len(scores)


def resilience_rate(scores: Scores, clean: float) -> dict[str, float]:
    """RR of each shift: mean over severities of score / clean score. ConfigError: a missing value, clean is not > 0."""
    names, values = _table(scores, "scores")
    if not clean > 0.0 or math.isinf(clean):
        raise ConfigError(f"the clean score is {clean}; a resilience rate needs one above 0")
    return dict(zip(names, (values.mean(axis=1) / clean).tolist(), strict=True))


def mean_resilience_rate(scores: Scores, clean: float) -> float:
    """mRR: mean of RR over the shifts. Higher is better; 1 is no loss."""
    return math.fsum(resilience_rate(scores, clean).values()) / len(scores)


def area_over_severity(clean: float, scores: Sequence[float]) -> float:
    """Area under the curve of a score over severity 0 (clean), 1, 2, ..., divided by its length (trapezoids)."""
    values = np.asarray([clean, *scores], np.float64)
    if len(values) < 2 or np.isnan(values).any():
        raise ConfigError(f"a score is missing: clean {clean}, then {list(scores)}")
    return float((values[1:] + values[:-1]).sum() / (2 * (len(values) - 1)))


def is_monotone(clean: float, scores: Sequence[float], *, tolerance: float = 0.0) -> bool:
    """Whether no score is more than `tolerance` above that of the severity before it."""
    values = np.asarray([clean, *scores], np.float64)
    if np.isnan(values).any():
        raise ConfigError(f"a score is missing: clean {clean}, then {list(scores)}")
    return bool((np.diff(values) <= tolerance).all())


def page_trend(damage: npt.ArrayLike, *, generator: np.random.Generator, permutations: int = 9999) -> Trend:
    """Page's test that damage grows with severity; rows are repetitions (scenes, seeds) of all severities.

    damage [R, S]: paired. The statistic is L, the sum over severities j = 1 ... S of j times the sum of the ranks
    (equal values share theirs); the p-value is the share of permutations within rows with an L as large, this one
    included.
    """
    values = np.asarray(damage, np.float64)
    if values.ndim != 2 or values.shape[1] < 2 or not len(values) or np.isnan(values).any():
        raise ConfigError("a trend test needs rows of at least two severities without a missing value")
    ranks = _ranks(values)
    weights = np.arange(1, values.shape[1] + 1, dtype=np.float64)
    observed = float((ranks @ weights).sum())
    found = np.array([(generator.permuted(ranks, axis=1) @ weights).sum() for _ in range(permutations)])
    return _trend(observed, found)


def jonckheere_trend(
    damage: Sequence[npt.ArrayLike], *, generator: np.random.Generator, permutations: int = 9999
) -> Trend:
    """Jonckheere's test that damage grows with severity, for groups that are not paired.

    damage: the values of each severity, in order. The statistic counts the pairs from two severities that are in order,
    ties half; the p-value is the share of permutations of all values with as many, this one included.
    """
    groups = [np.asarray(group, np.float64).ravel() for group in damage]
    if len(groups) < 2 or any(not len(g) or np.isnan(g).any() for g in groups):
        raise ConfigError("a trend test needs at least two severities, each with values and none missing")
    values = np.concatenate(groups)
    label = np.repeat(np.arange(len(groups)), [len(g) for g in groups])
    in_order = (np.sign(values[None, :] - values[:, None]) + 1.0) / 2.0
    observed = _pairs_in_order(in_order, label)
    found = np.array([_pairs_in_order(in_order, generator.permutation(label)) for _ in range(permutations)])
    return _trend(observed, found)


def _trend(observed: float, found: F64) -> Trend:
    # the statistics are sums of halves, exact in floating point
    larger = int((found >= observed).sum())
    return Trend(observed, (larger + 1) / (len(found) + 1), len(found))


def _pairs_in_order(in_order: F64, label: npt.NDArray[np.int64]) -> float:
    return float(in_order[label[:, None] < label[None, :]].sum())


def _ranks(values: F64) -> F64:
    """Ranks from 1 within each row; equal values share the mean of theirs."""
    less = (values[:, None, :] < values[:, :, None]).sum(axis=2)
    alike = (values[:, None, :] == values[:, :, None]).sum(axis=2)
    return np.asarray(less + (alike + 1) / 2.0)


def _table(scores: Scores, what: str) -> tuple[list[str], F64]:
    """Names of the shifts and scores [C, S]. ConfigError: none, severities that differ in number, a missing value."""
    if not scores:
        raise ConfigError(f"{what}: no shift is given")
    names = list(scores)
    counts = {len(scores[name]) for name in names}
    if counts == {0} or len(counts) > 1:
        listed = ", ".join(f"{name}: {len(scores[name])}" for name in names)
        raise ConfigError(f"{what}: every shift needs the same severities, but there are {listed}")
    values = np.array([[math.nan if v is None else v for v in scores[name]] for name in names], np.float64)
    if np.isnan(values).any():
        row, column = np.argwhere(np.isnan(values))[0].tolist()
        raise ConfigError(f"{what}: shift '{names[row]}' has no value at severity {column + 1}; run that cell first")
    return names, values

"""Robustness of a score to shifts, over their severities: one number a system.

Scores are given as shift -> its scores at severities 1, 2, ... (such as NDS); every shift needs the same number of
them and none may be missing, since a mean over an arbitrary subset is meaningless. Sources: mCE and mRR as in RoboBEV
(Xie et al. 2023), after Hendrycks and Dietterich 2019.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.types import F64

Scores = Mapping[str, Sequence[float | None]]  # None: not run, which raises ConfigError


def corruption_error(scores: Scores, baseline: Scores) -> dict[str, float]:
    """Return the corruption error (CE) of each shift.

    It is the sum over severities of 1 - score, relative to that of the baseline system (1: equally good).

    Args:
        scores: Scores by shift.
        baseline: Scores of the baseline system by shift.

    Returns:
        Shift -> CE.

    Raises:
        ConfigError: A value is missing, the baseline has other shifts, or it is perfect under a shift.
    """
    names, values = _table(scores, "scores")
    baseline_names, baseline_values = _table(baseline, "baseline")
    if set(names) != set(baseline_names) or values.shape != baseline_values.shape:
        differing_names = ", ".join(sorted(set(names) ^ set(baseline_names))) or "the number of severities"
        raise ConfigError(f"scores and baseline differ in: {differing_names}; run both under the same shifts")
    baseline_values = baseline_values[[baseline_names.index(name) for name in names]]
    error, baseline_error = (1.0 - values).sum(axis=1), (1.0 - baseline_values).sum(axis=1)
    if (baseline_error == 0.0).any():
        name = names[int((baseline_error == 0.0).argmax())]
        raise ConfigError(f"shift '{name}': the baseline makes no error there, so none can be relative to it")
    return {name: float(error[row] / baseline_error[row]) for row, name in enumerate(names)}


def resilience_rate(scores: Scores, clean: float) -> dict[str, float]:
    """Return the resilience rate (RR) of each shift: mean over severities of score / clean score.

    Args:
        scores: Scores by shift.
        clean: Score without a shift.

    Returns:
        Shift -> RR.

    Raises:
        ConfigError: A value is missing, or the clean score is not above 0.
    """
    names, values = _table(scores, "scores")
    if not clean > 0.0 or math.isinf(clean):
        raise ConfigError(f"the clean score is {clean}; a resilience rate needs one above 0")
    return {name: float(values[row].mean() / clean) for row, name in enumerate(names)}


def mean_resilience_rate(scores: Scores, clean: float) -> float:
    """Return mRR, the mean of RR over the shifts; higher is better, 1 is no loss."""
    return math.fsum(resilience_rate(scores, clean).values()) / len(scores)


def _table(scores: Scores, table_name: str) -> tuple[list[str], F64]:
    """Names of the shifts and scores [C, S]. ConfigError: none, severities that differ in number, a missing value."""
    if not scores:
        raise ConfigError(f"{table_name}: no shift is given")
    names = list(scores)
    counts = {len(scores[name]) for name in names}
    if counts == {0} or len(counts) > 1:
        rows_by_name = ", ".join(f"{name}: {len(scores[name])}" for name in names)
        raise ConfigError(f"{table_name}: every shift needs the same severities, but there are {rows_by_name}")
    values = np.array([[math.nan if score is None else score for score in scores[name]] for name in names], np.float64)
    if np.isnan(values).any():
        row, column = np.argwhere(np.isnan(values))[0].tolist()
        raise ConfigError(
            f"{table_name}: shift '{names[row]}' has no value at severity {column + 1}; run that cell first"
        )
    return names, values

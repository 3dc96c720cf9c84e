"""Intervals of small probabilities: few events, and events of unequal weight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.types import F64
from ssad.metrics.intervals import LEVEL, Clusters, mean_limits

_TAIL_PROBABILITY = 0.5 - 0.5 * LEVEL


@dataclass(frozen=True)
class RareEstimate:
    """A small probability with its interval.

    Attributes:
        probability: Probability of failure in an episode.
        low: Lower 95 % limit.
        high: Upper 95 % limit.
        method: Name of the estimation method.
        episodes: Episodes simulated for the estimate itself.
        events: Failures among them.
        effective: Effective number of failures: equally weighted failures of the same precision.
        work: Agent-steps simulated in all.
        training: Agent-steps of it that went into learning how to simulate.
    """

    probability: float
    low: float
    high: float
    method: str
    episodes: int
    events: int
    effective: float
    work: float
    training: float = 0.0

    @property
    def half_width(self) -> float:
        """Half the interval's width as a share of the probability; NaN where that is 0."""
        return 0.5 * (self.high - self.low) / self.probability if self.probability > 0.0 else math.nan

    def as_dict(self) -> dict[str, Any]:
        """Return the values by field name."""
        return asdict(self)


def weighted_limits(
    total: npt.ArrayLike,
    square: npt.ArrayLike,
    max_weight: npt.ArrayLike,
    n: npt.ArrayLike,
    *,
    unequal_weights: bool = False,
) -> tuple[F64, F64]:
    """95 % limits of a mean of n values that are 0 but for some rare events.

    The values of the events (1, or weights) are those of a compound Poisson process whose sum is close to a scaled
    Poisson number; gamma limits of that. Of equal values they are the mid-p limits of a Poisson mean. Of unlike ones
    the upper limit leaves room for a whole event more of the largest value: a sum that lacks one of the few large
    values is too small, and so is the variance that it shows.

    Args:
        total: [...] sum of the values.
        square: Sum of their squares.
        max_weight: The largest value that one more event could have; for weights, the largest weight seen or possible.
        n: How many values there are, zeros included.
        unequal_weights: Whether the values of the events differ.

    Returns:
        Lower and upper limits of the mean.

    Source:
        Fay and Feuer, "Confidence intervals for directly standardized rates: a method based on the gamma distribution"
        (1997); Fay and Kim, "Confidence intervals for directly standardized rates using mid-p gamma intervals" (2017).
    """
    from scipy.special import gammainc

    total, square, max_weight, n = np.broadcast_arrays(
        *(np.asarray(argument, np.float64) for argument in (total, square, max_weight, n))
    )
    # Events that are not rare vary less than a Poisson number of them.
    variance = np.maximum(square - total**2 / n, 1e-9 * square)
    has_events = total > 0.0
    positive_total, positive_variance = np.where(has_events, total, 1.0), np.where(has_events, variance, 1.0)
    total_plus_one, variance_plus_one = total + max_weight, variance + max_weight**2

    def probability_below(x: F64, slack: float) -> F64:
        """Return the probability that the gamma variable is at most x, with one event more for the share `slack`."""
        lower_tail = np.where(
            has_events, gammainc(positive_total**2 / positive_variance, x * positive_total / positive_variance), 1.0
        )
        return np.asarray(
            (1.0 - slack) * lower_tail
            + slack * gammainc(total_plus_one**2 / variance_plus_one, x * total_plus_one / variance_plus_one)
        )

    def quantile(probability: float, slack: float) -> F64:
        lower, upper = np.zeros(total.shape), total_plus_one + 20.0 * np.sqrt(variance_plus_one) + 20.0 * max_weight
        # Bisection works elementwise on arrays; 80 halvings exhaust float64.
        for _ in range(80):
            midpoint = 0.5 * (lower + upper)
            is_below = probability_below(midpoint, slack) < probability
            lower, upper = np.where(is_below, midpoint, lower), np.where(is_below, upper, midpoint)
        return np.asarray(0.5 * (lower + upper))

    low_room, high_room = (0.0, 1.0) if unequal_weights else (0.5, 0.5)
    return np.where(has_events, quantile(_TAIL_PROBABILITY, low_room), 0.0) / n, quantile(
        1.0 - _TAIL_PROBABILITY, high_room
    ) / n


def weighted_estimate(
    values: F64, method: str, *, max_weight: float, work: float, training: float = 0.0
) -> RareEstimate:
    """The mean of the values of episodes, which are 0 where nothing happened.

    Args:
        values: [n] 0, or the weight of an episode that failed.
        method: How it was estimated.
        max_weight: The largest weight an episode could have.
        work: Agent-steps simulated in all.
        training: Of those, for learning.
    """
    total, square = float(values.sum()), float((values**2).sum())
    # Without an event there is no observed weight, so the largest possible one bounds the interval.
    largest_weight = float(values.max()) if total > 0.0 else max_weight
    lower, upper = weighted_limits(total, square, largest_weight, len(values), unequal_weights=True)
    events = int((values > 0.0).sum())
    effective = total**2 / square if square > 0.0 else 0.0
    return RareEstimate(
        total / len(values), float(lower), float(upper), method, len(values), events, effective, work, training
    )


def repeated_estimate(values: Sequence[float], method: str, *, episodes: int, events: int, work: float) -> RareEstimate:
    """Estimate the mean of independent unbiased estimates, with Student limits that allow for skew, at least 0."""
    estimates = np.asarray(values, np.float64)
    limits = mean_limits(estimates, Clusters(np.ones(len(estimates)), np.zeros(len(estimates), np.intp)))
    mean = float(estimates.mean())
    variance = float(estimates.var(ddof=1)) / len(estimates) if len(estimates) > 1 else math.nan
    effective = mean**2 / variance if variance > 0.0 else math.nan
    lower, upper = max(float(limits.low), 0.0), float(limits.high)
    return RareEstimate(mean, lower, upper, method, episodes, events, effective, work)

"""Steering along a route."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ssad.core.types import F64
from ssad.drivers.careful.sight import Path


def pursue(path: Path, ahead: F64, *, aside: npt.ArrayLike, wheelbase: npt.ArrayLike, lock: npt.ArrayLike) -> F64:
    """Pure pursuit: turn along the circle that leads to a point down the route.

    Args:
        path: The routes of N drivers, in their frames.
        ahead: [N] m to that point.
        aside: [N] m that it lies left of the route.
        wheelbase: [N] of the bodies, m.
        lock: [N] rad that the front wheels turn at full lock.

    Returns:
        Steer [N], -1 to 1 within the lock.
    """
    here, _, _ = path.project(np.zeros((len(ahead), 1, 2)))
    aim = path.at(here[:, 0] + ahead, np.asarray(aside, np.float64))
    curvature = 2.0 * aim[:, 1] / np.maximum((aim * aim).sum(1), 1.0)
    # the kinematic bicycle about the centre of its box: sin(slip) = curvature x wheelbase / 2
    sine = np.clip(0.5 * curvature * np.asarray(wheelbase), -0.95, 0.95)
    wheel: F64 = np.arctan(2.0 * sine / np.sqrt(1.0 - sine * sine)) / np.asarray(lock)
    return wheel

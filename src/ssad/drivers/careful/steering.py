"""Steering along a route by pure pursuit."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ssad.core.types import F64
from ssad.drivers.careful.sight import Path


def pursue(path: Path, ahead: F64, *, aside: npt.ArrayLike, wheelbase: npt.ArrayLike, lock: npt.ArrayLike) -> F64:
    """Return the steering of pure pursuit: along the circle to a point down the route.

    Args:
        path: The routes of N drivers, in their frames.
        ahead: [N] distance to that point, m.
        aside: [N] offset of the point to the left of the route, m.
        wheelbase: [N] wheelbase of the bodies, m.
        lock: [N] angle of the front wheels at full lock, rad.

    Returns:
        Steer [N], -1 to 1 within the lock.
    """
    ego_position, _, _ = path.project(np.zeros((len(ahead), 1, 2)))
    target_point = path.at(ego_position[:, 0] + ahead, np.asarray(aside, np.float64))
    curvature = 2.0 * target_point[:, 1] / np.maximum((target_point * target_point).sum(1), 1.0)
    # the kinematic bicycle about the centre of its box: sin(slip) = curvature x wheelbase / 2
    slip_sine = np.clip(0.5 * curvature * np.asarray(wheelbase), -0.95, 0.95)
    steer: F64 = np.arctan(2.0 * slip_sine / np.sqrt(1.0 - slip_sine * slip_sine)) / np.asarray(lock)
    return steer

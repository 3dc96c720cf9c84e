"""AdvTraj: the adversary keeps its speed and drives beside its path, by offsets that an optimiser chooses.

SafeBench's form of it, with its reach: 1 m beside the path in the first two pre-crash classes, 2 m in the next two, 3 m
at junctions. SafeBench ships sequences without the optimiser that made them; here it is CMA-ES.

Source: Cao et al., Advdo, ECCV 2022; Zhang et al. 2022 (arXiv 2201.05057); SafeBench (Xu et al. 2022).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from ssad.core.generators import Base
from ssad.core.types import F64
from ssad.scenarios.dynamic.transition.motion import KNOTS, MotionSearch, TimedPath

REACH: Final[Mapping[str, float]] = {
    "StraightObstacle": 1.0,
    "TurningObstacle": 1.0,
    "LaneChanging": 2.0,
    "VehiclePassing": 2.0,
}
ELSEWHERE: Final = 3.0  # m
SMOOTH: Final = 1.0  # s of the moving average of offsets: steering takes time


class AdvTraj(MotionSearch):
    """Lateral offsets of one vehicle from its own path, at unchanged speed, by CMA-ES (AdvTraj)."""

    name = "adv-traj"

    def motion(self, base: Base, way: TimedPath, agent: int, point: F64) -> F64:
        """Interpolate offsets linearly between evenly spaced points of the path, starting from 0."""
        reach = REACH.get(base.scenario.type, ELSEWHERE)
        knot_distances = np.linspace(0.0, max(float(way.distance[-1]), 1.0), KNOTS + 1)
        knot_offsets = np.concatenate([[0.0], reach * (2.0 * point - 1.0)])
        offsets = np.interp(way.distance, knot_distances, knot_offsets)
        window = max(1, round(SMOOTH / way.step))
        padded = np.concatenate([np.zeros(window - 1), offsets])
        return way.rows(way.distance, np.convolve(padded, np.ones(window) / window, mode="valid"))

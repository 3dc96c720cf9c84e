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
from ssad.scenarios.dynamic.transition.motion import KNOTS, MotionSearch, Way

REACH: Final[Mapping[str, float]] = {
    "StraightObstacle": 1.0,
    "TurningObstacle": 1.0,
    "LaneChanging": 2.0,
    "VehiclePassing": 2.0,
}
ELSEWHERE: Final = 3.0  # m
SMOOTH: Final = 1.0  # s over which offsets are means: a wheel does not turn at once


class AdvTraj(MotionSearch):
    """Offsets of one vehicle beside its own path, its speed kept, by CMA-ES (AdvTraj)."""

    name = "adv-traj"

    def motion(self, base: Base, way: Way, agent: int, point: F64) -> F64:
        """On its path at the start; offsets at evenly spaced places of it, linear between them."""
        reach = REACH.get(base.scenario.type, ELSEWHERE)
        places = np.linspace(0.0, max(float(way.distance[-1]), 1.0), KNOTS + 1)
        told = np.concatenate([[0.0], reach * (2.0 * point - 1.0)])
        aside = np.interp(way.distance, places, told)
        window = max(1, round(SMOOTH / way.step))
        padded = np.concatenate([np.zeros(window - 1), aside])
        return way.rows(way.distance, np.convolve(padded, np.ones(window) / window, mode="valid"))

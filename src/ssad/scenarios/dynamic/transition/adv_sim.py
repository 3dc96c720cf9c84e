"""AdvSim: the adversary keeps its path and drives it at other speeds, which an optimiser chooses.

SafeBench's form of it: a speed between 0 and twice the nominal one at each moment. SafeBench ships sequences without
the optimiser that made them; here it is CMA-ES.

Source: Wang et al., AdvSim, CVPR 2021 (arXiv 2101.06549); SafeBench (Xu et al. 2022).
"""

from __future__ import annotations

import numpy as np

from ssad.core.generators import Base
from ssad.core.types import F64
from ssad.scenarios.dynamic.transition.motion import KNOTS, MotionSearch, Way
from ssad.world.models import model

STANDING = 5.0  # m/s, nominal speed of one who stands in the base


class AdvSim(MotionSearch):
    """One vehicle's speeds along its own path, up to twice the nominal one, by CMA-ES (AdvSim)."""

    name = "adv-sim"

    def motion(self, base: Base, way: Way, agent: int, point: F64) -> F64:
        """The speeds wanted at evenly spaced moments, as nearly as the body can follow."""
        body = model(base.trace.models[agent])
        nominal = float(way.speed.max())
        nominal = nominal if nominal > 0.5 else STANDING
        moments = np.linspace(way.time[0], way.time[-1], KNOTS)
        wanted = np.interp(way.time, moments, 2.0 * nominal * point)
        speed = [float(way.speed[0])]
        for target in wanted[1:].tolist():
            change = min(max(target - speed[-1], -body.max_brake * way.step), body.max_accel * way.step)
            speed.append(min(max(speed[-1] + change, 0.0), body.max_speed))
        return way.rows(np.concatenate([[0.0], np.cumsum(speed[:-1]) * way.step]))

"""AdvSim: the adversary keeps its path; an optimiser chooses its speeds.

Variant of SafeBench: a speed between 0 and twice the nominal one at each moment. SafeBench ships sequences without
their optimiser; SSAD uses CMA-ES.

Source: Wang et al., AdvSim, CVPR 2021 (arXiv 2101.06549); SafeBench (Xu et al. 2022).
"""

from __future__ import annotations

import numpy as np

from ssad.core.generators import Base
from ssad.core.types import F64
from ssad.scenarios.dynamic.transition.motion import KNOTS, MotionSearch, TimedPath
from ssad.world.models import agent_model

STANDING = 5.0  # m/s, nominal speed of a vehicle that stands in the base


class AdvSim(MotionSearch):
    """Speed optimisation of one vehicle along its own path, up to twice the nominal speed, by CMA-ES (AdvSim)."""

    name = "adv-sim"

    def motion(self, base: Base, way: TimedPath, agent: int, point: F64) -> F64:
        """Follow the speeds at evenly spaced moments as closely as the body allows."""
        body = agent_model(base.episode.agents[agent])
        nominal_speed = float(way.speed.max())
        nominal_speed = nominal_speed if nominal_speed > 0.5 else STANDING
        moments = np.linspace(way.time[0], way.time[-1], KNOTS)
        target_speeds = np.interp(way.time, moments, 2.0 * nominal_speed * point)
        speeds = [float(way.speed[0])]
        for target_speed in target_speeds[1:].tolist():
            speed_change = min(max(target_speed - speeds[-1], -body.max_brake * way.step), body.max_accel * way.step)
            speeds.append(min(max(speeds[-1] + speed_change, 0.0), body.max_speed))
        return way.rows(np.concatenate([[0.0], np.cumsum(speeds[:-1]) * way.step]))

"""A population of drivers: parameters drawn from published distributions, with their correlations.

Time gap, gap at rest, acceleration and comfortable deceleration have the means and spreads between those of NGSIM
US-101 and I-24 MOTION, weighted alike, and the mean of their correlations with each other and with desired speed.
Trucks and buses accelerate less. The values and their sources are in `ssad.metrics.human_driving`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from ssad.core.seeding import generator
from ssad.core.types import F64, AgentKind, Controller, DriverStyle, EpisodeAgent
from ssad.metrics.human_driving import correlations, published, spread
from ssad.world.models import agent_model

_DATA = ("NGSIM US-101, cars, IDM", "I-24 MOTION, cars, IDM")
_QUANTITIES = ("desired speed", "time gap", "acceleration", "comfortable deceleration", "standstill gap")
# Limits of the draws: those of the fits, and a minimum gap for safety.
_LIMITS = {
    "desired speed": (0.8, 1.2),
    "time gap": (0.8, 2.4),
    "acceleration": (0.9, 2.2),
    "comfortable deceleration": (1.2, 2.4),
    "standstill gap": (1.3, 4.0),
}
_START = 1.6  # times the acceleration of following, with which a driver starts from rest
_HEAVY = 0.7  # times the acceleration of a car, of trucks and buses
_REACTION = (0.75, 0.2, 0.4, 1.3)  # s: mean, spread and limits, of events that a driver expects
_ERROR = (0.05, 0.02, 0.01, 0.1)  # relative error of gaps
_JERK = (2.6, 0.4, 1.8, 3.6)  # m/s^3
_OFFSET = 0.06  # m of spread between the places of drivers in their lanes
_CHANGE = (3.5, 8.0)  # s: limits of the duration of lane changes


@cache
def _distribution() -> tuple[F64, F64, F64]:
    """Return means [5], spreads [5] and the Cholesky factor [5, 5] of the correlations, in the order of the names."""
    means, spreads = [1.0], [0.08]
    for quantity in _QUANTITIES[1:]:
        values = [value for value in published(quantity) if value.population in _DATA]
        means.append(float(np.mean([value.mean for value in values if value.mean is not None])))
        spreads.append(float(np.mean([value.sd for value in values if value.sd is not None])))
    matrix = np.mean([part.matrix for part in correlations() if part.population in _DATA], axis=0)
    return np.array(means), np.array(spreads), np.linalg.cholesky(matrix)


@cache
def _change_duration() -> tuple[float, float]:
    """Return the mean duration of lane changes over its sources, s, and its spread."""
    values = published("lane change duration")
    middles = [float(np.mean(value.values)) if value.mean is None else value.mean for value in values]
    return float(np.mean(middles)), float(np.mean([value.sd for value in values if value.sd is not None]))


def _truncated(random: np.random.Generator, mean: float, spread: float, low: float, high: float) -> float:
    for _ in range(100):
        value = mean + spread * float(random.standard_normal())
        if low <= value <= high:
            return value
    return mean


def draw_driver(kind: AgentKind, *key: object, errors: float = 0.0) -> DriverStyle:
    """Draw the driver of a vehicle.

    Args:
        kind: Kind of the vehicle; trucks and buses accelerate less and keep to the middle of their lane.
        *key: Key of the draw: the same key gives the same driver, whatever else is drawn.
        errors: Errors of the driver an hour.
    """
    random = generator("driver", *key)
    means, spreads, factor = _distribution()
    limits = np.array([_LIMITS[name] for name in _QUANTITIES])
    values = means
    for _ in range(1000):
        draw = means + spreads * (factor @ random.standard_normal(len(means)))
        draw[2] *= _START
        if (draw >= limits[:, 0]).all() and (draw <= limits[:, 1]).all():
            values = draw
            break
    heavy = kind in {AgentKind.TRUCK, AgentKind.BUS}
    return DriverStyle(
        pace=float(values[0]),
        time_gap=float(values[1]) * (1.2 if heavy else 1.0),
        acceleration=float(values[2]) * (_HEAVY if heavy else 1.0),
        deceleration=float(values[3]),
        standstill_gap=float(values[4]),
        jerk=_truncated(random, *_JERK),
        reaction_time=_truncated(random, *_REACTION),
        estimation_error=_truncated(random, *_ERROR),
        lane_offset=0.0 if heavy else _truncated(random, 0.0, _OFFSET, -0.12, 0.12),
        errors=errors,
        key=int(random.integers(0, 1 << 23)),
        politeness=float(random.uniform(*spread("politeness"))),
        change_duration=_truncated(random, *_change_duration(), *_CHANGE),
    )


def with_driver(agent: EpisodeAgent, *key: object, errors: float = 0.0) -> EpisodeAgent:
    """Return an agent with a driver of the population, if the Autopilot drives it; others are returned as they are.

    The speed that the agent wants is multiplied by the driver's pace.
    """
    if agent.controller != Controller.AUTOPILOT:
        return agent
    driver = draw_driver(agent_model(agent).kind, *key, errors=errors)
    return replace(agent, driver=driver, target_speed=agent.target_speed * driver.pace)

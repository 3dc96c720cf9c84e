"""Cut-ins before careful drivers: thousands of encounters on a straight road at once, without a world."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ssad.core.types import F64, Bool
from ssad.drivers.careful.encounter import Encounter
from ssad.drivers.careful.models import CarefulModel, Reaction, initial_reaction, react

STEP = 0.1  # s
CHUNK = 4096  # encounters at a time, so that they stay in the cache


@dataclass(frozen=True)
class CutIns:
    """Cut-ins [N] of two cars of one size; the other car keeps its speed and moves sideways until it is in front.

    Attributes:
        speed: Speed of the driver, m/s.
        lead: Speed of the other car, m/s.
        gap: m from the driver's front to the other's rear at the start.
        approach: Lateral speed of the other car, m/s.
        lateral: m between the sides of both at the start: 1.6 in lanes of 3.5 m, 1.85 in lanes of 3.75 m.
        length: Length of a car, m.
        width: Width of a car, m.
    """

    speed: F64
    lead: F64
    gap: F64
    approach: F64
    lateral: float = 1.6
    length: float = 4.3
    width: float = 1.9

    def __len__(self) -> int:
        """Return the number of encounters."""
        return len(self.speed)


def cut_in_grid(
    pairs: Iterable[tuple[float, float]], gaps: Iterable[float], *, lateral: float = 1.6, sideways: int = 18
) -> CutIns:
    """Return all combinations of speeds, gaps and lateral speeds.

    Args:
        pairs: Speeds of the driver and the other, km/h.
        gaps: m.
        lateral: m between the sides at the start.
        sideways: Number of lateral speeds, from 0 in steps of 0.1 m/s.

    Returns:
        The encounters.
    """
    speeds, gap_values = np.array(list(pairs), np.float64) / 3.6, np.array(list(gaps), np.float64)
    axes = np.meshgrid(np.arange(len(speeds)), gap_values, 0.1 * np.arange(sideways), indexing="ij")
    speed_pair, gap, lateral_speed = (axis.ravel() for axis in axes)
    return CutIns(speeds[speed_pair.astype(int), 0], speeds[speed_pair.astype(int), 1], gap, lateral_speed, lateral)


def speed_pairs(speeds: Iterable[int], lowest: int = 10) -> list[tuple[int, int]]:
    """Each speed with all lower ones, km/h, in steps of 10 from `lowest`."""
    return [(speed, lead) for speed in speeds for lead in range(lowest, speed, 10)]


def crashes(model: CarefulModel, cases: CutIns, *, seconds: float = 60.0) -> Bool:
    """Drive a model through cut-ins and return which ones end in a crash.

    Both bodies are boxes: a side contact while alongside counts too. A crash ends the encounter.

    Args:
        model: The driver model.
        cases: The encounters [N].
        seconds: Duration of each encounter, s.

    Returns:
        [N] True where the cars touch.
    """
    crashed = np.zeros(len(cases), bool)
    for first in range(0, len(cases), CHUNK):
        chunk = slice(first, first + CHUNK)
        crashed[chunk] = _crashes(model, cases, chunk, round(seconds / STEP))
    return crashed


def _crashes(model: CarefulModel, cases: CutIns, part: slice, steps: int) -> Bool:
    """Simulate some of the cases; decided ones drop out."""
    speed, lead, gap, approach = (
        column[part].copy() for column in (cases.speed, cases.lead, cases.gap, cases.approach)
    )
    rows = np.arange(len(speed))
    crashed, brake, memory = np.zeros(len(rows), bool), np.zeros(len(rows)), initial_reaction((len(rows),))
    lateral, joint_length = np.full(len(rows), cases.lateral), 2.0 * cases.length
    for _ in range(steps):
        lateral_speed = np.where(lateral > -cases.width, approach, 0.0)
        lateral_travel = cases.lateral - lateral
        distance_to_leave, passing_length = np.full(len(rows), np.inf), np.full(len(rows), joint_length)
        encounter = Encounter(
            speed, -brake, gap, lead, lateral, lateral_speed, distance_to_leave, passing_length, lateral_travel
        )
        brake, memory = react(model, encounter, memory, STEP)
        next_speed = np.maximum(speed - brake * STEP, 0.0)
        gap = gap + (lead - 0.5 * (speed + next_speed)) * STEP
        speed, lateral = next_speed, np.maximum(lateral - lateral_speed * STEP, -cases.width)
        hit = (lateral < 1e-9) & (gap < 0.0) & (gap > -joint_length)
        crashed[rows[hit]] = True
        # a driver that is past, or not faster than the other car in its lane, is safe
        undecided = ~hit & (gap > -joint_length) & ~((lateral <= 0.0) & (speed <= lead)) & (approach > 0.0)
        rows, brake = rows[undecided], brake[undecided]
        speed, lead, gap, approach, lateral = (
            speed[undecided],
            lead[undecided],
            gap[undecided],
            approach[undecided],
            lateral[undecided],
        )
        memory = Reaction(memory.since[undecided], memory.brake[undecided])
        if not len(rows):
            break
    return crashed

"""A car cuts in before four careful drivers: thousands of encounters on a straight road at once, without a world."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ssad.core.types import F64, Bool
from ssad.drivers.careful.encounter import Encounter
from ssad.drivers.careful.models import CarefulModel, Reaction, calm, react

STEP = 0.1  # s
CHUNK = 4096  # encounters at a time, so that they stay in the cache


@dataclass(frozen=True)
class CutIns:
    """Cut-ins [N]: two cars of one size; the other keeps its speed, and moves across until it is in front.

    Attributes:
        speed: Of the driver, m/s.
        lead: Of the other, m/s.
        gap: m from the driver's front to the other's rear at the start.
        approach: Speed of the other across, m/s.
        lateral: m between the sides of both at the start: 1.6 in lanes of 3.5 m, 1.85 in lanes of 3.75 m.
        length: Of a car, m.
        width: Of a car, m.
    """

    speed: F64
    lead: F64
    gap: F64
    approach: F64
    lateral: float = 1.6
    length: float = 4.3
    width: float = 1.9

    def __len__(self) -> int:
        """How many there are."""
        return len(self.speed)


def grid(
    pairs: Iterable[tuple[float, float]], gaps: Iterable[float], *, lateral: float = 1.6, sideways: int = 18
) -> CutIns:
    """All combinations.

    Args:
        pairs: Speeds of the driver and the other, km/h.
        gaps: m.
        lateral: m between the sides at the start.
        sideways: How many lateral speeds, from 0 in steps of 0.1 m/s.

    Returns:
        The encounters.
    """
    speeds, space = np.array(list(pairs), np.float64) / 3.6, np.array(list(gaps), np.float64)
    index = np.meshgrid(np.arange(len(speeds)), space, 0.1 * np.arange(sideways), indexing="ij")
    pair, gap, across = (part.ravel() for part in index)
    return CutIns(speeds[pair.astype(int), 0], speeds[pair.astype(int), 1], gap, across, lateral)


def slower(speeds: Iterable[int], least: int = 10) -> list[tuple[int, int]]:
    """Each speed with all lower ones, km/h, in steps of 10 from `least`."""
    return [(speed, lead) for speed in speeds for lead in range(least, speed, 10)]


def crashes(model: CarefulModel, cases: CutIns, *, seconds: float = 60.0) -> Bool:
    """Drive a model through cut-ins.

    Both bodies are boxes: to be run into from the side while alongside counts too. A crash ends the encounter.

    Args:
        model: Who drives.
        cases: The encounters [N].
        seconds: How long they are followed.

    Returns:
        [N] whether they touch.
    """
    out = np.zeros(len(cases), bool)
    for first in range(0, len(cases), CHUNK):
        part = slice(first, first + CHUNK)
        out[part] = _crashes(model, cases, part, round(seconds / STEP))
    return out


def _crashes(model: CarefulModel, cases: CutIns, part: slice, steps: int) -> Bool:
    """`crashes` for some of the cases; those that are decided drop out."""
    speed, lead, gap, approach = (a[part].copy() for a in (cases.speed, cases.lead, cases.gap, cases.approach))
    rows = np.arange(len(speed))
    out, brake, memory = np.zeros(len(rows), bool), np.zeros(len(rows)), calm((len(rows),))
    lateral, both = np.full(len(rows), cases.lateral), 2.0 * cases.length
    for _ in range(steps):
        moving = np.where(lateral > -cases.width, approach, 0.0)
        moved = cases.lateral - lateral
        stays_on, length = np.full(len(rows), np.inf), np.full(len(rows), both)
        e = Encounter(speed, -brake, gap, lead, lateral, moving, stays_on, length, moved)
        brake, memory = react(model, e, memory, STEP)
        after = np.maximum(speed - brake * STEP, 0.0)
        gap = gap + (lead - 0.5 * (speed + after)) * STEP
        speed, lateral = after, np.maximum(lateral - moving * STEP, -cases.width)
        hit = (lateral < 1e-9) & (gap < 0.0) & (gap > -both)
        out[rows[hit]] = True
        # who is past, or no faster than the other in its lane, is out of it
        on = ~hit & (gap > -both) & ~((lateral <= 0.0) & (speed <= lead)) & (approach > 0.0)
        rows, brake = rows[on], brake[on]
        speed, lead, gap, approach, lateral = speed[on], lead[on], gap[on], approach[on], lateral[on]
        memory = Reaction(memory.since[on], memory.brake[on])
        if not len(rows):
            break
    return out

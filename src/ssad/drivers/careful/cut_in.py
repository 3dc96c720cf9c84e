"""Cut-ins before careful drivers: thousands of encounters on a straight road at once, without a world."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ssad.core.types import F64, Bool
from ssad.drivers.careful.encounter import Encounter
from ssad.drivers.careful.models import CarefulModel, Reaction, initial_reaction, react

STEP = 0.1  # s
PAST = -1e6  # m, gap to a car behind the driver, to which no model reacts
CHUNK = 4096  # encounters at a time, so that they stay in the cache


@dataclass(frozen=True)
class SweepRules:
    """Rules of a sweep beside the formulas of the models.

    Attributes:
        lead_in: Lateral acceleration of the other car before the gap and the lateral distance of the sweep are reached,
            m/s^2; infinite: it has its lateral speed from the start.
        whole_steps: True: a delay ends with a step, bodies move a whole step at its final speed, and a driver brakes
            only while its formula demands it, after an interruption without another delay. False: a delay ends within
            a step, speeds change evenly over a step, and `react` decides how long a driver brakes.
        past_at_centre: True: a driver reacts until its centre is past that of the other; False: until its rear is past
            the front of the other.
        safe_ttc: TTC above which an encounter ends as avoided once the bodies overlap across the path, s.
    """

    lead_in: float = np.inf
    whole_steps: bool = False
    past_at_centre: bool = False
    safe_ttc: float = np.inf


PLAIN_RULES = SweepRules()
JRC_RULES = SweepRules(lead_in=1.5, whole_steps=True, past_at_centre=True)
"""Rules of ec-jrc/JRC-FSM for Reg157, FSM and RSS; for CC, `safe_ttc` is 2 s as well."""


@dataclass(frozen=True)
class CutIns:
    """Cut-ins [N] of two cars of one size; the other car keeps its speed and moves sideways until it is in front.

    Attributes:
        speed: Speed of the driver, m/s.
        lead: Speed of the other car, m/s.
        gap: m from the driver's front to the other's rear at the start.
        approach: Lateral speed of the other car, m/s.
        lateral: m between the sides of both at the start: 1.6 in lanes of 3.5 m, as in ec-jrc/JRC-FSM.
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


def speed_pairs(speeds: Iterable[int], lowest: int = 10, step: int = 10) -> list[tuple[int, int]]:
    """Return each speed with all lower ones, km/h, in steps of `step` from `lowest`."""
    return [(speed, lead) for speed in speeds for lead in range(lowest, speed, step)]


def crashes(model: CarefulModel, cases: CutIns, *, seconds: float = 60.0, rules: SweepRules = PLAIN_RULES) -> Bool:
    """Drive a model through cut-ins and return which ones end in a crash.

    Both bodies are boxes: a side contact while alongside counts too. A crash ends the encounter.

    Args:
        model: The driver model.
        cases: The encounters [N].
        seconds: Duration of each encounter, s.
        rules: Motion of the other car and steps of the driver.

    Returns:
        [N] True where the cars touch.
    """
    crashed = np.zeros(len(cases), bool)
    for first in range(0, len(cases), CHUNK):
        chunk = slice(first, first + CHUNK)
        crashed[chunk] = _crashes(model, cases, chunk, round(seconds / STEP), rules)
    return crashed


def _crashes(model: CarefulModel, cases: CutIns, part: slice, steps: int, rules: SweepRules) -> Bool:
    """Simulate some of the cases; decided ones drop out."""
    speed, lead, gap, approach = (
        column[part].copy() for column in (cases.speed, cases.lead, cases.gap, cases.approach)
    )
    rows, joint_length = np.arange(len(speed)), 2.0 * cases.length
    crashed, brake, memory = np.zeros(len(rows), bool), np.zeros(len(rows)), initial_reaction((len(rows),))
    # the lateral speeds of the lead-in are 0, 1, 2, ... increments
    increment = rules.lead_in * STEP if np.isfinite(rules.lead_in) else 0.0
    # the tolerance keeps whole quotients whole
    lead_in_steps = np.maximum(np.ceil(approach / (rules.lead_in * STEP) - 1e-9), 0.0)
    gap = gap + (speed - lead) * lead_in_steps * STEP
    lateral = cases.lateral + 0.5 * lead_in_steps * (lead_in_steps - 1.0) * increment * STEP
    first_lateral = lateral
    passing_length = joint_length * (0.5 if rules.past_at_centre else 1.0)
    reaction = react_in_whole_steps if rules.whole_steps else react
    for step in range(steps):
        target_speed = np.where(step < lead_in_steps, step * increment, approach)
        lateral_speed = np.where(lateral > -cases.width, target_speed, 0.0)
        encounter = Encounter(
            speed=speed,
            accel=-brake,
            gap=np.where(gap > -passing_length, gap, PAST),
            lead=lead,
            lateral=lateral,
            approach=lateral_speed,
            through=np.full(len(rows), np.inf),
            length=np.full(len(rows), joint_length),
            moved=first_lateral - lateral,
        )
        is_over = (lateral <= 0.0) & (np.abs(gap) > rules.safe_ttc * np.abs(speed - lead))
        brake, memory = reaction(model, encounter, memory, STEP)
        next_speed = np.maximum(speed - brake * STEP, 0.0)
        step_speed = next_speed if rules.whole_steps else 0.5 * (speed + next_speed)
        gap = gap + (lead - step_speed) * STEP
        speed, lateral = next_speed, np.maximum(lateral - lateral_speed * STEP, -cases.width)
        hit = (lateral < 1e-9) & (gap < 0.0) & (gap > -joint_length) & ~is_over
        crashed[rows[hit]] = True
        # a driver that is past, or not faster than the other car in its lane, is safe
        is_behind = (lateral <= 0.0) & (speed <= lead)
        undecided = ~hit & ~is_over & (gap > -joint_length) & ~is_behind & (approach > 0.0)
        rows, brake, lead_in_steps, first_lateral = (
            rows[undecided],
            brake[undecided],
            lead_in_steps[undecided],
            first_lateral[undecided],
        )
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


def react_in_whole_steps(
    model: CarefulModel, encounter: Encounter, previous: Reaction, dt: float
) -> tuple[F64, Reaction]:
    """One step of a model whose delay is a count of steps in danger, which an interruption does not reset.

    Args:
        model: The model.
        encounter: The others that the driver sees.
        previous: Its memory, where `since` is the time in danger so far, s.
        dt: Duration of the step, s.

    Returns:
        Braking over the step, m/s^2, and the new memory.
    """
    demanded = model.demand(encounter)
    is_danger, since = demanded > 0.0, np.maximum(previous.since, 0.0)
    brake = np.where(since < model.delay, model.coast, np.minimum(demanded, previous.brake + model.jerk * dt))
    memory = Reaction(np.where(is_danger, since + dt, since), np.where(is_danger, brake, previous.brake))
    return np.where(is_danger, brake, 0.0), memory

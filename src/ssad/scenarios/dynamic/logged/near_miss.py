"""Near misses of a recorded drive, perturbed until somebody meets.

A near miss is where the ego and another vehicle use the same place at different times: it has a place, a time, and the
seconds by which they missed each other (the post-encroachment time). It is found in the drive that the base is: an
imported log (`ssad import drive`), or traffic that was driven here. The vehicle then comes earlier or later by about as
much, at a slightly other speed along its own recorded path and a little beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.geometry import obb_distance
from ssad.core.seeding import generator
from ssad.core.types import F64, AgentKind, EpisodeTrace
from ssad.metrics.criticality import trace_boxes
from ssad.scenarios.dynamic.frozen import freeze_episode, with_motion
from ssad.scenarios.dynamic.transition.king import King
from ssad.scenarios.dynamic.transition.motion import MOVES, TimedPath

LATEST: Final = 6.0  # s by which they missed each other at most
EARLY: Final = 0.5  # s after the start in which nobody meets
STRIDE: Final = 2  # rows between those that are compared
SHIFT: Final = 0.4  # s, spread of the time by which the other comes at another moment than that of the encounter
ASIDE: Final = 0.3  # m, spread of its place across its path
FACTOR: Final = 0.5, 1.6  # least and greatest, of its recorded speeds


@dataclass(frozen=True)
class NearMiss:
    """Near miss of the ego and another vehicle.

    Attributes:
        agent: Index of the other vehicle.
        time: s at which the ego was at the place.
        late: s by which the other vehicle came later (negative: earlier).
    """

    agent: int
    time: float
    late: float


def near_misses(trace: EpisodeTrace) -> list[NearMiss]:
    """Return the closest near miss of each moving vehicle, the smallest time difference first."""
    agent_boxes, step = trace_boxes(trace), STRIDE * float(trace.dt)
    rows = np.arange(0, len(trace.x), STRIDE)
    max_rows = round(LATEST / step)
    misses = []
    for agent in np.flatnonzero(trace.kind <= AgentKind.BICYCLE).tolist():
        if agent == 0 or np.hypot(np.ptp(trace.x[:, agent]), np.ptp(trace.y[:, agent])) < MOVES:
            continue
        centres = agent_boxes[rows, 0, :2][:, None] - agent_boxes[rows, agent, :2][None]
        contact_range = 0.5 * np.hypot(trace.length[[0, agent]], trace.width[[0, agent]]).sum()
        both_present = trace.active[rows, 0][:, None] & trace.active[rows, agent][None]
        # All pairs of rows (ego time, other time) are compared, not only simultaneous ones.
        near_pairs = both_present & (np.hypot(centres[..., 0], centres[..., 1]) <= contact_range)
        ego_row, other_row = np.nonzero(near_pairs)
        # a vehicle that meets the ego right after its start cannot be shifted in time
        first_row = np.flatnonzero(trace.active[rows, agent])[0]
        candidates = (
            (np.abs(other_row - ego_row) <= max_rows)
            & (other_row > first_row + EARLY / step)
            & (ego_row * step > EARLY)
        )
        ego_row, other_row = ego_row[candidates], other_row[candidates]
        if len(ego_row):
            touching = obb_distance(agent_boxes[rows[ego_row], 0], agent_boxes[rows[other_row], agent]) <= 0.0
            ego_row, other_row = ego_row[touching], other_row[touching]
        if len(ego_row):
            closest = int(np.lexsort((ego_row, np.abs(other_row - ego_row)))[0])
            misses.append(
                NearMiss(agent, float(ego_row[closest] * step), float((other_row[closest] - ego_row[closest]) * step))
            )
    return sorted(misses, key=lambda miss: (abs(miss.late), miss.agent))


class NearMisses:
    """Recorded near misses in which the other vehicle comes slightly earlier or later."""

    name = "near-miss"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        self.bases = list(bases)
        self._frozen = [freeze_episode(base.episode, base.trace) for base in bases]
        self._misses = [near_misses(base.trace) for base in bases]
        self._random = [generator("near misses", seed) for seed in seeds]
        self._tried = [0] * len(self.bases)

    @staticmethod
    def check(episode: object) -> None:
        """Check that an episode has a vehicle. ConfigError if it has none."""
        King.check(episode)  # type: ignore[arg-type]

    def ask(self, count: int) -> list[list[Proposal]]:
        """Return perturbed near misses of each base, the closest ones most often; none without near misses."""
        return [
            [self._proposal(base_index) for _ in range(count)] if self._misses[base_index] else []
            for base_index in range(len(self.bases))
        ]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Ignore the outcomes: the recording alone defines the proposals."""

    def _proposal(self, k: int) -> Proposal:
        misses, random, base = self._misses[k], self._random[k], self.bases[k]
        proposal_count = self._tried[k]
        self._tried[k] += 1
        weights = np.exp(-np.abs([miss.late for miss in misses]))
        miss_index = (
            proposal_count
            if proposal_count < len(misses)
            else int(random.choice(len(misses), p=weights / weights.sum()))
        )
        shift, offset = random.standard_normal(2) if proposal_count >= len(misses) else (0.0, 0.0)
        name = base.trace.names[misses[miss_index].agent]
        rows = perturb_motion(base.trace, misses[miss_index], shift=SHIFT * shift, lateral=ASIDE * offset)
        return Proposal(with_motion(self._frozen[k], name, rows), adversaries=(name,))


def perturb_motion(trace: EpisodeTrace, miss: NearMiss, *, shift: float, lateral: float) -> F64:
    """The motion [T, 4] of who was missed, scaled in time so that both are at the place at about the same time.

    Args:
        trace: The recorded drive.
        miss: The near miss.
        shift: s by which it then comes later than the ego.
        lateral: m to the left of where it drove.
    """
    recorded_path = TimedPath.of(trace, miss.agent)
    start_time = float(recorded_path.time[0])
    factor = float(np.clip((miss.time + miss.late - start_time) / max(miss.time + shift - start_time, 0.1), *FACTOR))
    warped_time = start_time + (recorded_path.time - start_time) * factor
    overshoot = np.maximum(warped_time - recorded_path.time[-1], 0.0) * max(float(recorded_path.speed[-1]), 0.0)
    # Smoothstep over 2 s: the lateral offset must start at 0 with a continuous heading.
    blend = np.clip((recorded_path.time - start_time) / 2.0, 0.0, 1.0)
    return recorded_path.rows(
        np.interp(warped_time, recorded_path.time, recorded_path.distance) + overshoot,
        lateral * blend * blend * (3.0 - 2.0 * blend),
    )

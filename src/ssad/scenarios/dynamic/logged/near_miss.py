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
from ssad.metrics.criticality import boxes
from ssad.scenarios.dynamic.frozen import frozen, with_motion
from ssad.scenarios.dynamic.transition.kinematics import King
from ssad.scenarios.dynamic.transition.motion import MOVES, Way

LATEST: Final = 6.0  # s by which they missed each other at most
EARLY: Final = 0.5  # s after the start in which nobody meets
STRIDE: Final = 2  # rows between those that are compared
SHIFT: Final = 0.4  # s, spread of the time by which the other comes at another moment than that of the encounter
ASIDE: Final = 0.3  # m, spread of its place across its path
FACTOR: Final = 0.5, 1.6  # least and greatest, of its recorded speeds


@dataclass(frozen=True)
class NearMiss:
    """Two who used one place at different times.

    Attributes:
        agent: Number of the other.
        time: s at which the ego was there.
        late: s by which the other came later (negative: it had been there before).
    """

    agent: int
    time: float
    late: float


def near_misses(trace: EpisodeTrace) -> list[NearMiss]:
    """The nearest miss of each vehicle of a drive that moves, the closest in time first."""
    box, step = boxes(trace), STRIDE * float(trace.dt)
    rows = np.arange(0, len(trace.x), STRIDE)
    most = round(LATEST / step)
    found = []
    for agent in np.flatnonzero(trace.kind <= AgentKind.BICYCLE).tolist():
        if agent == 0 or np.hypot(np.ptp(trace.x[:, agent]), np.ptp(trace.y[:, agent])) < MOVES:
            continue
        centres = box[rows, 0, :2][:, None] - box[rows, agent, :2][None]
        reach = 0.5 * np.hypot(trace.length[[0, agent]], trace.width[[0, agent]]).sum()
        there = trace.active[rows, 0][:, None] & trace.active[rows, agent][None]
        near = there & (np.hypot(centres[..., 0], centres[..., 1]) <= reach)
        ego, other = np.nonzero(near)
        # who meets at once cannot come earlier or later
        first = np.flatnonzero(trace.active[rows, agent])[0]
        kept = (np.abs(other - ego) <= most) & (other > first + EARLY / step) & (ego * step > EARLY)
        ego, other = ego[kept], other[kept]
        if len(ego):
            touch = obb_distance(box[rows[ego], 0], box[rows[other], agent]) <= 0.0
            ego, other = ego[touch], other[touch]
        if len(ego):
            best = int(np.lexsort((ego, np.abs(other - ego)))[0])
            found.append(NearMiss(agent, float(ego[best] * step), float((other[best] - ego[best]) * step)))
    return sorted(found, key=lambda miss: (abs(miss.late), miss.agent))


class NearMisses:
    """Near misses of the recorded drive, in which the other comes a little earlier or later."""

    name = "near-miss"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        self.bases = list(bases)
        self._frozen = [frozen(base.episode, base.trace) for base in bases]
        self._misses = [near_misses(base.trace) for base in bases]
        self._random = [generator("near misses", seed) for seed in seeds]
        self._tried = [0] * len(self.bases)

    @staticmethod
    def check(episode: object) -> None:
        """Whether an episode has a vehicle; raises ConfigError if not."""
        King.check(episode)  # type: ignore[arg-type]

    def ask(self, count: int) -> list[list[Proposal]]:
        """Perturbed near misses of each base, the closest ones most often; none where nobody came near."""
        return [[self._proposal(k) for _ in range(count)] if self._misses[k] else [] for k in range(len(self.bases))]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Nothing to learn: what was recorded says where to look."""

    def _proposal(self, k: int) -> Proposal:
        misses, random, base = self._misses[k], self._random[k], self.bases[k]
        turn = self._tried[k]
        self._tried[k] += 1
        chance = np.exp(-np.abs([miss.late for miss in misses]))
        which = turn if turn < len(misses) else int(random.choice(len(misses), p=chance / chance.sum()))
        shift, aside = random.standard_normal(2) if turn >= len(misses) else (0.0, 0.0)
        name = base.trace.names[misses[which].agent]
        rows = moved(base.trace, misses[which], shift=SHIFT * shift, aside=ASIDE * aside)
        return Proposal(with_motion(self._frozen[k], name, rows), adversaries=(name,))


def moved(trace: EpisodeTrace, miss: NearMiss, *, shift: float, aside: float) -> F64:
    """The motion [T, 4] of who was missed, scaled in time so that both are at the place at about the same time.

    Args:
        trace: The recorded drive.
        miss: The near miss.
        shift: s by which it then comes later than the ego.
        aside: m to the left of where it drove.
    """
    way = Way.of(trace, miss.agent)
    begin = float(way.time[0])
    factor = float(np.clip((miss.time + miss.late - begin) / max(miss.time + shift - begin, 0.1), *FACTOR))
    clock = begin + (way.time - begin) * factor
    over = np.maximum(clock - way.time[-1], 0.0) * max(float(way.speed[-1]), 0.0)
    ease = np.clip((way.time - begin) / 2.0, 0.0, 1.0)
    return way.rows(np.interp(clock, way.time, way.distance) + over, aside * ease * ease * (3.0 - 2.0 * ease))

"""Recorded motion of a vehicle as a path with a speed along it, and searches that change one of the two.

Each vehicle that could become the adversary has its own CMA-ES search (package cmaes). Each search runs for one
generation; from then on only the search with the largest danger continues.

All other agents repeat the base. Triggers of scripts are fixed too: they have become times.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np

from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.seeding import seed32
from ssad.core.types import F64, EpisodeTrace
from ssad.scenarios.dynamic.frozen import freeze_episode, with_motion
from ssad.scenarios.dynamic.transition.king import King, adversary_candidates

KNOTS: Final = 8
POPULATION: Final = 8
SIGMA: Final = 0.25  # of the unit cube
MOVES: Final = 1.0  # m; a vehicle that moves less has no path of its own and drives straight ahead


@dataclass(frozen=True)
class TimedPath:
    """Recorded path of a vehicle with the distance along it over time.

    Attributes:
        time: [T] s, evenly spaced.
        path: [T, 3] x, y m and yaw rad.
        distance: [T] m along the path.
    """

    time: F64
    path: F64
    distance: F64

    @classmethod
    def of(cls, trace: EpisodeTrace, agent: int) -> TimedPath:
        """Return the timed path of an agent while it is present."""
        present_rows = np.flatnonzero(trace.active[:, agent])
        columns = [getattr(trace, name)[present_rows, agent].astype(np.float64) for name in ("x", "y", "yaw")]
        columns[2] = np.unwrap(columns[2])
        path = np.stack(columns, 1)
        distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
        return cls(present_rows.astype(np.float64) * float(trace.dt), path, distance)

    @property
    def step(self) -> float:
        """Time between rows, s."""
        return float(self.time[1] - self.time[0])

    @property
    def speed(self) -> F64:
        """Speed along the path [T], m/s."""
        return np.asarray(np.gradient(self.distance, self.step))

    def rows(self, distance: F64, lateral: F64 | float = 0.0) -> F64:
        """Return time, x, y and yaw [T, 4] at other distances along the path, with lateral offsets.

        Args:
            distance: [T] m along the path, non-decreasing; extrapolated straight beyond its end.
            lateral: [T] m to the left of the path.
        """
        path_distance, last_pose = self.distance, self.path[-1]
        # np.interp needs increasing abscissas; a standing vehicle repeats its distance.
        moving_rows = np.concatenate([[True], np.diff(path_distance) > 1e-6])
        x, y, yaw = (
            np.interp(distance, path_distance[moving_rows], self.path[moving_rows, column]) for column in range(3)
        )
        overshoot = np.maximum(distance - path_distance[-1], 0.0)
        x, y = x + overshoot * np.cos(last_pose[2]), y + overshoot * np.sin(last_pose[2])
        offset = np.broadcast_to(np.asarray(lateral, np.float64), distance.shape)
        x, y = x - offset * np.sin(yaw), y + offset * np.cos(yaw)
        step_ahead = np.maximum(np.gradient(distance), 0.02)  # a standing vehicle does not turn
        turn = np.arctan2(np.gradient(offset), step_ahead)
        return np.stack([self.time, x, y, yaw + turn], 1)


def moving_candidates(base: Base) -> list[int]:
    """Return the candidates for the adversary that move, or all candidates if none does."""
    candidates = adversary_candidates(base)
    trace = base.trace
    moving = [agent for agent in candidates if np.hypot(np.ptp(trace.x[:, agent]), np.ptp(trace.y[:, agent])) > MOVES]
    return moving or candidates


class MotionSearch(ABC):
    """CMA-ES over KNOTS numbers in [0, 1] that change the motion of one vehicle."""

    name: ClassVar[str]
    check = staticmethod(King.check)

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        from cmaes import CMA

        self.bases = list(bases)
        self._frozen = [freeze_episode(base.episode, base.trace) for base in bases]
        self._agents = [moving_candidates(base) for base in bases]
        self._ways = [
            {candidate: TimedPath.of(base.trace, candidate) for candidate in candidates}
            for base, candidates in zip(bases, self._agents, strict=True)
        ]
        self._search: list[dict[int, Any]] = [
            {
                agent: CMA(
                    mean=np.full(KNOTS, 0.5),
                    sigma=SIGMA,
                    bounds=np.tile([0.0, 1.0], (KNOTS, 1)),
                    seed=seed32(self.name, seed, agent),
                    population_size=POPULATION,
                )
                for agent in candidates
            }
            for candidates, seed in zip(self._agents, seeds, strict=True)
        ]
        self._worst: list[dict[int, float]] = [{} for _ in self.bases]
        self._generations: list[dict[int, list[tuple[F64, float]]]] = [
            {candidate: [] for candidate in candidates} for candidates in self._agents
        ]
        self._last_points: list[tuple[int, F64]] = []

    @abstractmethod
    def motion(self, base: Base, way: TimedPath, agent: int, point: F64) -> F64:
        """Return time, x, y and yaw [T, 4] of the adversary at a point [KNOTS] of the unit cube."""

    def ask(self, count: int) -> list[list[Proposal]]:
        """Draw from one vehicle's search in each base."""
        self._last_points = [self._next(base_index, count) for base_index in range(len(self.bases))]
        return [
            [self._proposal(base_index, agent, point) for point in points]
            for base_index, (agent, points) in enumerate(self._last_points)
        ]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Update each search that has a complete generation."""
        for base_index, ((agent, points), base_outcomes) in enumerate(zip(self._last_points, outcomes, strict=True)):
            dangers = [max(outcome.danger, -20.0) for outcome in base_outcomes]
            self._worst[base_index][agent] = max([self._worst[base_index].get(agent, -np.inf), *dangers])
            pending = self._generations[base_index][agent]
            pending += zip(points, (-value for value in dangers), strict=True)
            if len(pending) == POPULATION:
                self._search[base_index][agent].tell(pending)
                self._generations[base_index][agent] = []

    def _next(self, base: int, count: int) -> tuple[int, F64]:
        untried = [agent for agent in self._agents[base] if agent not in self._worst[base]]
        agent = untried[0] if untried else max(self._worst[base], key=lambda candidate: self._worst[base][candidate])
        # At most what the generation still needs: points of an older distribution would mislead the next update.
        missing = POPULATION - len(self._generations[base][agent])
        return agent, np.array([self._search[base][agent].ask() for _ in range(min(count, missing))])

    def _proposal(self, base_index: int, agent: int, point: F64) -> Proposal:
        base = self.bases[base_index]
        rows = self.motion(base, self._ways[base_index][agent], agent, point)
        name = base.trace.names[agent]
        return Proposal(with_motion(self._frozen[base_index], name, rows), adversaries=(name,))

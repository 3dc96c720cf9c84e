"""How a vehicle of a base drove, as a way with a speed along it, and searches that change one of the two.

The search is CMA-ES (by the package cmaes), one for each vehicle that could become the adversary. Each is tried for a
generation; from then on the one goes on that has brought the ego into most danger.

All others repeat what they did in the base. So does the adversary's own choice of moment: a script's trigger has
become a time.
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
from ssad.scenarios.dynamic.frozen import frozen, with_motion
from ssad.scenarios.dynamic.transition.kinematics import King, adversaries

KNOTS: Final = 8
POPULATION: Final = 8
SIGMA: Final = 0.25  # of the unit cube
MOVES: Final = 1.0  # m; who moves less has no way of its own and is taken straight ahead


@dataclass(frozen=True)
class Way:
    """What a vehicle did.

    Attributes:
        time: [T] s, evenly spaced.
        path: [T, 3] x, y m and yaw rad; standing rows are left out of its length.
        distance: [T] m along the path.
    """

    time: F64
    path: F64
    distance: F64

    @classmethod
    def of(cls, trace: EpisodeTrace, agent: int) -> Way:
        """The way of an agent while it is there."""
        there = np.flatnonzero(trace.active[:, agent])
        columns = [getattr(trace, name)[there, agent].astype(np.float64) for name in ("x", "y", "yaw")]
        columns[2] = np.unwrap(columns[2])
        path = np.stack(columns, 1)
        length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
        return cls(there.astype(np.float64) * float(trace.dt), path, length)

    @property
    def step(self) -> float:
        """S between rows."""
        return float(self.time[1] - self.time[0])

    @property
    def speed(self) -> F64:
        """[T] m/s."""
        return np.asarray(np.gradient(self.distance, self.step))

    def rows(self, distance: F64, aside: F64 | float = 0.0) -> F64:
        """Time, x, y and yaw [T, 4] of one who is at other distances along the path, and beside it.

        Args:
            distance: [T] m along the path, not falling; beyond its end it goes straight on.
            aside: [T] m to the left of it.
        """
        length, end = self.distance, self.path[-1]
        kept = np.concatenate([[True], np.diff(length) > 1e-6])
        x, y, yaw = (np.interp(distance, length[kept], self.path[kept, k]) for k in range(3))
        over = np.maximum(distance - length[-1], 0.0)
        x, y = x + over * np.cos(end[2]), y + over * np.sin(end[2])
        beside = np.broadcast_to(np.asarray(aside, np.float64), distance.shape)
        x, y = x - beside * np.sin(yaw), y + beside * np.cos(yaw)
        ahead = np.maximum(np.gradient(distance), 0.02)  # who stands does not turn
        turn = np.arctan2(np.gradient(beside), ahead)
        return np.stack([self.time, x, y, yaw + turn], 1)


def movers(base: Base) -> list[int]:
    """The vehicles of a base that could become adversaries: those that move, or all where none does."""
    found = adversaries(base)
    trace = base.trace
    moving = [a for a in found if np.hypot(np.ptp(trace.x[:, a]), np.ptp(trace.y[:, a])) > MOVES]
    return moving or found


class MotionSearch(ABC):
    """CMA-ES over KNOTS numbers in [0, 1] that say how one vehicle drives otherwise than in the base."""

    name: ClassVar[str]
    check = staticmethod(King.check)

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        from cmaes import CMA

        self.bases = list(bases)
        self._frozen = [frozen(base.episode, base.trace) for base in bases]
        self._agents = [movers(base) for base in bases]
        self._ways = [{a: Way.of(base.trace, a) for a in who} for base, who in zip(bases, self._agents, strict=True)]
        self._search: list[dict[int, Any]] = [
            {
                agent: CMA(
                    mean=np.full(KNOTS, 0.5),
                    sigma=SIGMA,
                    bounds=np.tile([0.0, 1.0], (KNOTS, 1)),
                    seed=seed32(self.name, seed, agent),
                    population_size=POPULATION,
                )
                for agent in who
            }
            for who, seed in zip(self._agents, seeds, strict=True)
        ]
        self._worst: list[dict[int, float]] = [{} for _ in self.bases]
        self._told: list[dict[int, list[tuple[F64, float]]]] = [{a: [] for a in who} for who in self._agents]
        self._asked: list[tuple[int, F64]] = []

    @abstractmethod
    def motion(self, base: Base, way: Way, agent: int, point: F64) -> F64:
        """Time, x, y and yaw [T, 4] of the adversary at a point [KNOTS] of the unit cube."""

    def ask(self, count: int) -> list[list[Proposal]]:
        """Draws of one vehicle's search in each base."""
        self._asked = [self._next(k, count) for k in range(len(self.bases))]
        return [[self._proposal(k, agent, point) for point in points] for k, (agent, points) in enumerate(self._asked)]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Searches that know a whole generation move on."""
        for k, ((agent, points), row) in enumerate(zip(self._asked, outcomes, strict=True)):
            danger = [max(outcome.danger, -20.0) for outcome in row]
            self._worst[k][agent] = max([self._worst[k].get(agent, -np.inf), *danger])
            told = self._told[k][agent]
            told += zip(points, (-d for d in danger), strict=True)
            while len(told) >= POPULATION:
                self._search[k][agent].tell(told[:POPULATION])
                del told[:POPULATION]

    def _next(self, base: int, count: int) -> tuple[int, F64]:
        new = [agent for agent in self._agents[base] if agent not in self._worst[base]]
        agent = new[0] if new else max(self._worst[base], key=lambda a: self._worst[base][a])
        return agent, np.array([self._search[base][agent].ask() for _ in range(count)])

    def _proposal(self, k: int, agent: int, point: F64) -> Proposal:
        base = self.bases[k]
        rows = self.motion(base, self._ways[k][agent], agent, point)
        name = base.trace.names[agent]
        return Proposal(with_motion(self._frozen[k], name, rows), adversaries=(name,))

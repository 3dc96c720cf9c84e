"""Two local searches: a random walk among neighbours, and one parameter at a time forward and backward.

Source: the samplers of ANTI-CARLA (Ramakrishna et al. 2022, arXiv 2208.06309): random neighbourhood search, and the
search forward and backward along a parameter.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ssad.core.generators import Base
from ssad.core.seeding import generator
from ssad.core.types import F64
from ssad.scenarios.dynamic.search.box import BoxSearch

NEAR: Final = 0.12  # standard deviation of a step of the walk, in the unit cube
PATIENCE: Final = 3  # rounds without progress after which a walk begins elsewhere
FIRST_STEP, LAST_STEP = 0.25, 0.03  # forward and backward, in the unit cube


@dataclass
class _SearchState:
    """State of the search of one base.

    Attributes:
        point: [D] current point of the unit cube.
        danger: Danger at that point.
        step: Length of the next step.
        axis: Next parameter and direction to try, counted through both.
        idle: Rounds without progress.
    """

    point: F64
    danger: float = -np.inf
    step: float = FIRST_STEP
    axis: int = 0
    idle: int = 0


class _LocalSearch(BoxSearch):
    """Local search: move to the most dangerous neighbour, and restart elsewhere after a collision."""

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int, objective: str = "proof") -> None:
        super().__init__(bases, seeds=seeds, budget=budget, objective=objective)
        self._random = [generator(self.name, seed) for seed in seeds]
        self._states = [self._begin(base_index, box.nominal()) for base_index, box in enumerate(self.boxes)]

    @abstractmethod
    def neighbours(self, index: int, count: int) -> F64:
        """Return the points [1 to count, D] to try next around the current point of a base."""

    @abstractmethod
    def is_stuck(self, index: int) -> bool:
        """Return True if the search of a base, which has just made no progress, should restart."""

    def points(self, index: int, count: int) -> F64:
        """Return the starting point first, then neighbours of the current point."""
        state = self._states[index]
        if state.danger == -np.inf:
            return np.asarray(np.vstack([state.point, self.neighbours(index, count - 1)]))
        return self.neighbours(index, count)

    def learn(self, index: int, points: F64, danger: F64) -> None:
        """Move to the most dangerous point; restart after a collision or without progress."""
        state = self._states[index]
        worst_index = int(np.argmax(danger))
        if danger[worst_index] > state.danger:
            state.point, state.danger, state.idle = points[worst_index], float(danger[worst_index]), 0
        else:
            state.idle += 1
        if state.danger >= 0.0 or (state.idle and self.is_stuck(index)):
            self._states[index] = self._begin(index, np.asarray(self._random[index].random(points.shape[1])))

    def _begin(self, index: int, point: F64) -> _SearchState:
        """Start a search at a point; the first parameter and the step length are random."""
        random = self._random[index]
        return _SearchState(
            point, step=FIRST_STEP * random.uniform(0.8, 1.2), axis=2 * int(random.integers(len(point)))
        )


class RandomWalk(_LocalSearch):
    """Random walk from the nominal scenario: the most dangerous of several neighbours is the next point."""

    name = "random-walk"

    def neighbours(self, index: int, count: int) -> F64:
        """Return points a normally distributed step away."""
        point = self._states[index].point
        return np.asarray(np.clip(point + NEAR * self._random[index].standard_normal((count, len(point))), 0.0, 1.0))

    def is_stuck(self, index: int) -> bool:
        """Return True after three rounds without progress."""
        return self._states[index].idle >= PATIENCE


class ForwardBackward(_LocalSearch):
    """Coordinate search from the nominal scenario, forward and backward; halves the step without progress."""

    name = "forward-backward"

    def neighbours(self, index: int, count: int) -> F64:
        """Return the next parameters in turn, each forward and backward."""
        state = self._states[index]
        direction_count = 2 * len(state.point)
        candidates = np.repeat(state.point[None], min(count, direction_count), 0)
        for candidate in candidates:
            axis, backward = divmod(state.axis, 2)
            candidate[axis] = np.clip(candidate[axis] + (-state.step if backward else state.step), 0.0, 1.0)
            state.axis = (state.axis + 1) % direction_count
        return np.asarray(candidates)

    def is_stuck(self, index: int) -> bool:
        """Return True once steps are short; until then halve them after each round through all parameters."""
        state = self._states[index]
        # A round tries up to 8 points, and a full turn has two per parameter.
        if state.idle * 8 >= 2 * len(state.point):
            state.step, state.idle = 0.5 * state.step, 0
        return state.step < LAST_STEP

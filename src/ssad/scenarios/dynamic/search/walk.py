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
class _Place:
    """Where a search of a base is.

    Attributes:
        point: [D] in the unit cube.
        danger: There.
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
    """A point that moves to the most dangerous of those tried around it, and begins elsewhere when it found one."""

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        super().__init__(bases, seeds=seeds, budget=budget)
        self._random = [generator(self.name, seed) for seed in seeds]
        self._place = [self._begin(k, box.nominal()) for k, box in enumerate(self.boxes)]

    @abstractmethod
    def neighbours(self, index: int, count: int) -> F64:
        """What to try next [1 to count, D] around the point of a base."""

    @abstractmethod
    def stuck(self, index: int) -> bool:
        """Whether the point of a base, which has just found nothing worse, should begin elsewhere."""

    def points(self, index: int, count: int) -> F64:
        """The point itself first, then what lies around it."""
        place = self._place[index]
        if place.danger == -np.inf:
            return np.asarray(np.vstack([place.point, self.neighbours(index, count - 1)]))
        return self.neighbours(index, count)

    def learn(self, index: int, points: F64, danger: F64) -> None:
        """Move to the worst for the ego; after a collision, or where there is no progress, begin anywhere."""
        place = self._place[index]
        best = int(np.argmax(danger))
        if danger[best] > place.danger:
            place.point, place.danger, place.idle = points[best], float(danger[best]), 0
        else:
            place.idle += 1
        if place.danger >= 0.0 or (place.idle and self.stuck(index)):
            self._place[index] = self._begin(index, np.asarray(self._random[index].random(points.shape[1])))

    def _begin(self, index: int, point: F64) -> _Place:
        """A search from a point; which parameter comes first, and how far, is drawn."""
        random = self._random[index]
        return _Place(point, step=FIRST_STEP * random.uniform(0.8, 1.2), axis=2 * int(random.integers(len(point))))


class RandomWalk(_LocalSearch):
    """A random walk from the nominal scenario: the most dangerous of some neighbours is the next place."""

    name = "random-walk"

    def neighbours(self, index: int, count: int) -> F64:
        """Points a normal step away."""
        point = self._place[index].point
        return np.asarray(np.clip(point + NEAR * self._random[index].standard_normal((count, len(point))), 0.0, 1.0))

    def stuck(self, index: int) -> bool:
        """After three rounds."""
        return self._place[index].idle >= PATIENCE


class ForwardBackward(_LocalSearch):
    """One parameter at a time, forward and backward from the nominal scenario; half the step where nothing is worse."""

    name = "forward-backward"

    def neighbours(self, index: int, count: int) -> F64:
        """The next parameters in turn, each forward and backward."""
        place = self._place[index]
        turns = 2 * len(place.point)
        found = np.repeat(place.point[None], min(count, turns), 0)
        for row in found:
            axis, back = divmod(place.axis, 2)
            row[axis] = np.clip(row[axis] + (-place.step if back else place.step), 0.0, 1.0)
            place.axis = (place.axis + 1) % turns
        return np.asarray(found)

    def stuck(self, index: int) -> bool:
        """Once steps have become short; until then they are halved after each round through all parameters."""
        place = self._place[index]
        if place.idle * 8 >= 2 * len(place.point):
            place.step, place.idle = 0.5 * place.step, 0
        return place.step < LAST_STEP

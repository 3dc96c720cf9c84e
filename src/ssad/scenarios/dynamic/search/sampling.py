"""Searches that learn nothing: random points, a grid, and a Halton sequence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ssad.core.generators import Base
from ssad.core.seeding import generator, seed32
from ssad.core.types import F64
from ssad.scenarios.dynamic.search.box import BoxSearch


class RandomSearch(BoxSearch):
    """Points drawn evenly from the box: what any search must beat."""

    name = "random"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        super().__init__(bases, seeds=seeds, budget=budget)
        self._random = [generator("random search", seed) for seed in seeds]

    def points(self, index: int, count: int) -> F64:
        """The next draws."""
        return self._random[index].random((count, self.boxes[index].dimension))


class GridSearch(BoxSearch):
    """The middles of equal cells: as many along each parameter as the budget allows, in an order drawn at random.

    Parameters that come first get one more where the budget allows it. The order makes a search that is cut short a
    sample of the grid and not a corner of it.
    """

    name = "grid"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        super().__init__(bases, seeds=seeds, budget=budget)
        self._cells = []
        for box, seed in zip(self.boxes, seeds, strict=True):
            counts = _counts(budget, box.dimension)
            axes = np.meshgrid(*((np.arange(n) + 0.5) / n for n in counts), indexing="ij")
            cells = np.stack([axis.ravel() for axis in axes], 1)
            self._cells.append(cells[generator("grid search", seed).permutation(len(cells))])
        self._next = [0] * len(self.boxes)

    def points(self, index: int, count: int) -> F64:
        """The next cells; none when all have been tried."""
        start = self._next[index]
        self._next[index] += count
        return np.asarray(self._cells[index][start : start + count])


class HaltonSearch(BoxSearch):
    """A scrambled Halton sequence, which fills the box more evenly than random points (Halton 1960, Owen 2017)."""

    name = "halton"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        from scipy.stats import qmc

        super().__init__(bases, seeds=seeds, budget=budget)
        self._sequences: list[Any] = [
            qmc.Halton(box.dimension, rng=np.random.default_rng(seed32("halton search", seed)))
            for box, seed in zip(self.boxes, seeds, strict=True)
        ]

    def points(self, index: int, count: int) -> F64:
        """The next points of the sequence."""
        return np.asarray(self._sequences[index].random(count))


def _counts(budget: int, dimension: int) -> list[int]:
    """Cells along each of the axes, at most `budget` in all."""
    each = max(1, math.floor(budget ** (1.0 / dimension) + 1e-9))
    counts = [each] * dimension
    for axis in range(dimension):
        counts[axis] += 1
        if math.prod(counts) > budget:
            counts[axis] -= 1
            break
    return counts

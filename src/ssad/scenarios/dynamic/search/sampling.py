"""Searches without learning: random points, a grid, and a Halton sequence."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.generators import Base
from ssad.core.seeding import generator, seed32
from ssad.core.types import F64
from ssad.scenarios.dynamic.search.box import BoxSearch, ParameterBox

_DRAWS: Final = 1000  # batches of points after which the constraints count as impossible


class RandomSearch(BoxSearch):
    """Uniform random points of the box: the baseline of all searches."""

    name = "random"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        super().__init__(bases, seeds=seeds, budget=budget)
        self._random = [generator("random search", seed) for seed in seeds]

    def points(self, index: int, count: int) -> F64:
        """Return the next random points that meet the constraints."""
        box = self.boxes[index]
        return feasible_points(box, count, lambda missing: self._random[index].random((missing, box.dimension)))


class GridSearch(BoxSearch):
    """Centres of equal grid cells, as many along each parameter as the budget allows, in random order.

    The first parameters get one cell more where the budget allows it. The random order makes an interrupted search a
    sample of the whole grid instead of one corner. Cells that violate a constraint of the scenario are left out.
    """

    name = "grid"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        super().__init__(bases, seeds=seeds, budget=budget)
        self._cells = []
        for box, seed in zip(self.boxes, seeds, strict=True):
            counts = _counts(budget, box.dimension)
            axes = np.meshgrid(*((np.arange(cell_count) + 0.5) / cell_count for cell_count in counts), indexing="ij")
            cells = np.stack([axis.ravel() for axis in axes], 1)
            if box.scenario.constraints:
                cells = cells[[box.is_feasible(cell) for cell in cells]]
            self._cells.append(cells[generator("grid search", seed).permutation(len(cells))])
        self._next = [0] * len(self.boxes)

    def points(self, index: int, count: int) -> F64:
        """Return the next cells; none when all have been tried."""
        start = self._next[index]
        self._next[index] += count
        return np.asarray(self._cells[index][start : start + count])


class HaltonSearch(BoxSearch):
    """Scrambled Halton sequence, which covers the box more evenly than random points (Halton 1960, Owen 2017)."""

    name = "halton"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        from scipy.stats import qmc

        super().__init__(bases, seeds=seeds, budget=budget)
        self._sequences: list[Any] = [
            qmc.Halton(box.dimension, rng=np.random.default_rng(seed32("halton search", seed)))
            for box, seed in zip(self.boxes, seeds, strict=True)
        ]

    def points(self, index: int, count: int) -> F64:
        """Return the next points of the sequence that meet the constraints."""
        return feasible_points(self.boxes[index], count, self._sequences[index].random)


def feasible_points(box: ParameterBox, count: int, draw: Callable[[int], F64]) -> F64:
    """Return the next drawn points [count, D] that meet the constraints of a scenario.

    Args:
        box: Search space of the scenario.
        count: Number of points.
        draw: Function that returns the next points [n, D] of the unit cube.

    Raises:
        ConfigError: Hardly any point meets the constraints.
    """
    points = np.asarray(draw(count), np.float64)
    if not box.scenario.constraints:
        return points
    feasible = [point for point in points if box.is_feasible(point)]
    for _ in range(_DRAWS):
        if len(feasible) == count:
            return np.array(feasible)
        feasible += [point for point in draw(count - len(feasible)) if box.is_feasible(point)]
    raise ConfigError(
        f"scenario {box.scenario.name}: constraints: hardly any point of the ranges meets them; narrow the ranges"
    )


def _counts(budget: int, dimension: int) -> list[int]:
    """Return the number of cells along each axis, at most `budget` in all."""
    # The epsilon makes exact powers (such as 8 = 2^3) robust against rounding.
    per_axis = max(1, math.floor(budget ** (1.0 / dimension) + 1e-9))
    counts = [per_axis] * dimension
    for axis in range(dimension):
        counts[axis] += 1
        if math.prod(counts) > budget:
            counts[axis] -= 1
            break
    return counts

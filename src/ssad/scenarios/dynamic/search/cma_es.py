"""CMA-ES: a normal distribution over the box that moves towards danger, by the package cmaes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ssad.core.generators import Base
from ssad.core.seeding import seed32
from ssad.core.types import F64
from ssad.scenarios.dynamic.search.box import BoxSearch

POPULATION = 8
SIGMA = 0.3  # of the unit cube: the first generation covers most of it


class CmaEs(BoxSearch):
    """Covariance matrix adaptation evolution strategy from the nominal scenario, in generations of 8.

    Source: Hansen and Ostermeier, Completely derandomized self-adaptation in evolution strategies, 2001.
    """

    name = "cma-es"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int, objective: str = "proof") -> None:
        from cmaes import CMA

        super().__init__(bases, seeds=seeds, budget=budget, objective=objective)
        self._search: list[Any] = [
            CMA(
                mean=np.clip(box.nominal(), 0.05, 0.95),
                sigma=SIGMA,
                bounds=np.tile([0.0, 1.0], (box.dimension, 1)),
                seed=seed32("cma-es", seed),
                population_size=POPULATION,
            )
            for box, seed in zip(self.boxes, seeds, strict=True)
        ]
        self._generations: list[list[tuple[F64, float]]] = [[] for _ in self.boxes]

    def points(self, index: int, count: int) -> F64:
        """Draw from the current distribution, at most what its generation still needs."""
        # Points of an older distribution would count as the next one's, and mislead its update.
        missing = POPULATION - len(self._generations[index])
        return np.array([self._search[index].ask() for _ in range(min(count, missing))])

    def learn(self, index: int, points: F64, danger: F64) -> None:
        """Update the distribution once its 8 outcomes are there; the search minimises negative danger."""
        pending = self._generations[index]
        pending += zip(points, (-danger).tolist(), strict=True)
        if len(pending) == POPULATION:
            self._search[index].tell(pending)
            self._generations[index] = []

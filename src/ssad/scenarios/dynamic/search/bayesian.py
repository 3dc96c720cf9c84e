"""Bayesian optimisation: a Gaussian process over the box, asked where it expects most improvement."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from ssad.core.generators import Base
from ssad.core.seeding import generator
from ssad.core.types import F64
from ssad.scenarios.dynamic.search.box import BoxSearch

FIRST: Final = 8  # points drawn evenly before there is a model
CANDIDATES: Final = 512  # half of them anywhere, half around the best point
NEAR: Final = 0.1  # spread of the latter in the unit cube
LENGTHS: Final = np.geomspace(0.05, 2.0, 12)  # length scales that are compared by their likelihood
NOISE: Final = 1e-4  # variance of an outcome, as a share of all outcomes': the world has none, a step of 0.1 s has


class Bayesian(BoxSearch):
    """Expected improvement under a Gaussian process with a Matern kernel (5/2) of one length scale.

    Several points are chosen at once by taking the mean of the process for what is not known yet (Kriging believer).

    Source: Jones, Schonlau and Welch, Efficient global optimization, 1998; Ginsbourger, Le Riche and Carraro, Kriging
    is well-suited to parallelize optimization, 2010.
    """

    name = "bayesian"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        super().__init__(bases, seeds=seeds, budget=budget)
        self._random = [generator("bayesian", seed) for seed in seeds]
        self._tried = [np.zeros((0, box.dimension)) for box in self.boxes]
        self._danger = [np.zeros(0) for _ in self.boxes]

    def points(self, index: int, count: int) -> F64:
        """Even draws first; then, one after the other, where the improvement expected is greatest."""
        x, y, random = self._tried[index], self._danger[index], self._random[index]
        dimension = self.boxes[index].dimension
        chosen: list[F64] = []
        for k in range(count):
            if len(self._tried[index]) + k < FIRST or np.ptp(y) == 0.0:
                chosen.append(random.random(dimension))
                continue
            anywhere = random.random((CANDIDATES // 2, dimension))
            near = x[np.argmax(y)] + NEAR * random.standard_normal((CANDIDATES // 2, dimension))
            candidates = np.concatenate([anywhere, np.clip(near, 0.0, 1.0)])
            mean, deviation = predict(x, y, candidates)
            best = int(np.argmax(expected_improvement(mean, deviation, float(y.max()))))
            chosen.append(candidates[best])
            x, y = np.vstack([x, candidates[best]]), np.append(y, mean[best])
        return np.array(chosen)

    def learn(self, index: int, points: F64, danger: F64) -> None:
        """Keep the outcomes; gaps beyond 20 m are alike."""
        self._tried[index] = np.vstack([self._tried[index], points])
        self._danger[index] = np.append(self._danger[index], np.maximum(danger, -20.0))


def predict(x: F64, y: F64, at: F64) -> tuple[F64, F64]:
    """Mean and standard deviation [M] of the process at points [M, D], from values y [N] at x [N, D].

    The length scale is the likeliest of `LENGTHS`.
    """
    centre, scale = y.mean(), max(float(y.std()), 1e-9)
    told = (y - centre) / scale
    apart = _distance(x, x)
    best, likelihood = None, -math.inf
    for length in LENGTHS:
        factor = np.linalg.cholesky(_matern(apart / length) + NOISE * np.eye(len(x)))
        half = np.linalg.solve(factor, told)
        found = -0.5 * float(half @ half) - float(np.log(np.diag(factor)).sum())
        if found > likelihood:
            best, likelihood = (length, factor, half), found
    assert best is not None
    length, factor, half = best
    across = np.linalg.solve(factor, _matern(_distance(x, at) / length))
    deviation = np.sqrt(np.maximum(1.0 - (across**2).sum(0), 1e-12))
    return centre + scale * (across.T @ half), scale * deviation


def expected_improvement(mean: F64, deviation: F64, best: float) -> F64:
    """How much a normal value with this mean and deviation lies above the best one, where it does, on average."""
    from scipy.special import ndtr

    over = (mean - best) / deviation
    density = np.exp(-0.5 * over**2) / math.sqrt(2.0 * math.pi)
    return np.asarray(deviation * (over * ndtr(over) + density))


def _distance(a: F64, b: F64) -> F64:
    return np.asarray(np.sqrt(((a[:, None] - b[None]) ** 2).sum(-1)))


def _matern(r: F64) -> F64:
    """Matern kernel with smoothness 5/2 at distances in length scales."""
    s = math.sqrt(5.0) * r
    return np.asarray((1.0 + s + s * s / 3.0) * np.exp(-s))

"""Bayesian optimisation: a Gaussian process over the box, sampled where it expects the largest improvement."""

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
NOISE: Final = 1e-4  # variance of one outcome relative to all: the world is deterministic, its 0.1 s steps are coarse


class Bayesian(BoxSearch):
    """Expected improvement under a Gaussian process with a Matern kernel (5/2) of one length scale.

    Points of one batch are chosen in sequence; pending outcomes are replaced by the mean of the process (Kriging
    believer).

    Source: Jones, Schonlau and Welch, Efficient global optimization, 1998; Ginsbourger, Le Riche and Carraro, Kriging
    is well-suited to parallelize optimization, 2010.
    """

    name = "bayesian"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int, objective: str = "proof") -> None:
        super().__init__(bases, seeds=seeds, budget=budget, objective=objective)
        self._random = [generator("bayesian", seed) for seed in seeds]
        self._tried = [np.zeros((0, box.dimension)) for box in self.boxes]
        self._danger = [np.zeros(0) for _ in self.boxes]

    def points(self, index: int, count: int) -> F64:
        """Return uniform draws first; then, one after the other, the points of the largest expected improvement."""
        inputs, dangers, random = self._tried[index], self._danger[index], self._random[index]
        dimension = self.boxes[index].dimension
        batch: list[F64] = []
        for position in range(count):
            if len(self._tried[index]) + position < FIRST or np.ptp(dangers) == 0.0:
                batch.append(random.random(dimension))
                continue
            uniform = random.random((CANDIDATES // 2, dimension))
            local = inputs[np.argmax(dangers)] + NEAR * random.standard_normal((CANDIDATES // 2, dimension))
            candidates = np.concatenate([uniform, np.clip(local, 0.0, 1.0)])
            mean, deviation = predict(inputs, dangers, candidates)
            best_candidate = int(np.argmax(expected_improvement(mean, deviation, float(dangers.max()))))
            batch.append(candidates[best_candidate])
            inputs, dangers = np.vstack([inputs, candidates[best_candidate]]), np.append(dangers, mean[best_candidate])
        return np.array(batch)

    def learn(self, index: int, points: F64, danger: F64) -> None:
        """Store the outcomes; gaps beyond 20 m count as equal."""
        self._tried[index] = np.vstack([self._tried[index], points])
        self._danger[index] = np.append(self._danger[index], np.maximum(danger, -20.0))


def predict(x: F64, y: F64, query_points: F64) -> tuple[F64, F64]:
    """Mean and standard deviation [M] of the process at points [M, D], from values y [N] at x [N, D].

    The length scale is the likeliest of `LENGTHS`.
    """
    # The kernel has unit variance, so values are standardised.
    centre, scale = y.mean(), max(float(y.std()), 1e-9)
    targets = (y - centre) / scale
    distances = _distance(x, x)
    best_fit, best_likelihood = None, -math.inf
    for length in LENGTHS:
        factor = np.linalg.cholesky(_matern(distances / length) + NOISE * np.eye(len(x)))
        whitened = np.linalg.solve(factor, targets)
        log_likelihood = -0.5 * float(whitened @ whitened) - float(np.log(np.diag(factor)).sum())
        if log_likelihood > best_likelihood:
            best_fit, best_likelihood = (length, factor, whitened), log_likelihood
    assert best_fit is not None
    length, factor, whitened = best_fit
    cross = np.linalg.solve(factor, _matern(_distance(x, query_points) / length))
    # Rounding can push the variance at an evaluated point below zero.
    deviation = np.sqrt(np.maximum(1.0 - (cross**2).sum(0), 1e-12))
    return centre + scale * (cross.T @ whitened), scale * deviation


def expected_improvement(mean: F64, deviation: F64, best: float) -> F64:
    """Return the expected amount by which normal values exceed the best value so far."""
    from scipy.special import ndtr

    z_score = (mean - best) / deviation
    density = np.exp(-0.5 * z_score**2) / math.sqrt(2.0 * math.pi)
    return np.asarray(deviation * (z_score * ndtr(z_score) + density))


def _distance(a: F64, b: F64) -> F64:
    return np.asarray(np.sqrt(((a[:, None] - b[None]) ** 2).sum(-1)))


def _matern(r: F64) -> F64:
    """Return the Matern kernel with smoothness 5/2 at distances in length scales."""
    scaled = math.sqrt(5.0) * r
    return np.asarray((1.0 + scaled + scaled * scaled / 3.0) * np.exp(-scaled))

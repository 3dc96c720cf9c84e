"""L2C: a distribution of the initial state, drawn parameter by parameter, that REINFORCE moves to what is dangerous.

Each parameter is normal, with a mean that depends on those drawn before it: together they can follow a narrow valley of
danger that runs across the box. After each round of rollouts the distribution takes a step along the gradient of the
log likelihood, weighted by how much worse for the ego a draw was than the others (the paper's worked example).

Source: the paper, section on driving policies; Ding et al., Learning to collide, IROS 2020 (arXiv 2003.01197), in the
form that SafeBench (Xu et al. 2022) gives it: draws in [-1, 1], softplus of the spread, a bonus for entropy. SafeBench
learns over a thousand episodes of many routes; here each base has its own distribution, and steps are larger.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from torch.nn.functional import softplus

from ssad.core.generators import Base
from ssad.core.seeding import generator
from ssad.core.types import F64
from ssad.scenarios.dynamic.search.box import BoxSearch

RATE: Final = 0.15  # of Adam, for draws in [-1, 1]
ENTROPY: Final = 0.01
FAR: Final = -20.0  # m; gaps beyond are alike
LEAST: Final = 0.05  # standard deviation that is always left: a collapsed distribution learns nothing more


class _Distribution:
    """One base's distribution of D parameters in [-1, 1].

    Attributes:
        mean: [D] of each parameter, where those before it are 0.
        weight: [D, D] how much the mean of one (row) follows those before it (columns).
        raw: [D] the spread before softplus.
    """

    def __init__(self, dimension: int) -> None:
        self.mean = torch.zeros(dimension, dtype=torch.float64, requires_grad=True)
        self.weight = torch.zeros(dimension, dimension, dtype=torch.float64, requires_grad=True)
        self.raw = torch.zeros(dimension, dtype=torch.float64, requires_grad=True)
        self.adam = torch.optim.Adam([self.mean, self.weight, self.raw], lr=RATE, betas=(0.5, 0.9))

    def spread(self) -> torch.Tensor:
        """Standard deviations [D]."""
        return LEAST + softplus(self.raw)

    def draw(self, noise: F64) -> F64:
        """Draws [N, D] from standard normal numbers [N, D], one parameter after the other."""
        mean, weight, spread = (v.detach().numpy() for v in (self.mean, self.weight, self.spread()))
        found = np.zeros_like(noise)
        for k in range(noise.shape[1]):
            found[:, k] = mean[k] + found[:, :k] @ weight[k, :k] + spread[k] * noise[:, k]
        return found

    def learn(self, draws: F64, advantage: F64) -> None:
        """One step of REINFORCE from draws [N, D] and how much better [N] than the others they were."""
        at = torch.from_numpy(draws)
        spread = self.spread()
        mean = self.mean + at @ torch.tril(self.weight, -1).T
        likelihood = (-0.5 * ((at - mean) / spread).square() - spread.log()).sum(1)
        cost = -(torch.from_numpy(advantage) * likelihood).mean() - ENTROPY * spread.log().sum()
        self.adam.zero_grad()
        cost.backward()  # type: ignore[no-untyped-call]
        self.adam.step()


class L2C(BoxSearch):
    """A distribution of the initial state, drawn parameter by parameter, that learns by REINFORCE (L2C)."""

    name = "l2c"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        super().__init__(bases, seeds=seeds, budget=budget)
        self._random = [generator("l2c", seed) for seed in seeds]
        self._of = [_Distribution(box.dimension) for box in self.boxes]
        self._draws: list[F64] = [np.zeros((0, box.dimension)) for box in self.boxes]

    def points(self, index: int, count: int) -> F64:
        """Draws from the present distribution; what lies outside the box is cut."""
        noise = self._random[index].standard_normal((count, self.boxes[index].dimension))
        self._draws[index] = self._of[index].draw(noise)
        return np.asarray(np.clip(0.5 + 0.5 * self._draws[index], 0.0, 1.0))

    def learn(self, index: int, points: F64, danger: F64) -> None:
        """A step from the last draws; nothing where all were alike."""
        gain = np.maximum(danger, FAR)
        if len(gain) > 1 and np.ptp(gain) > 1e-9:
            # ranks: a collision and a miss by a hand's breadth differ as much as their order, whatever the unit
            order = np.argsort(np.argsort(gain, kind="stable"), kind="stable")
            self._of[index].learn(self._draws[index], (order - order.mean()) / order.std())

"""L2C: a distribution of the initial state, drawn parameter by parameter, that REINFORCE moves to what is dangerous.

Each parameter is normal, with a mean that depends on those drawn before it: together they can follow a narrow valley of
danger that runs across the box. After each round of rollouts the distribution takes a step along the gradient of the
log likelihood, weighted by how much worse for the ego a draw was than the others (the paper's worked example).

Source: the paper, section on driving policies; Ding et al., Learning to collide, IROS 2020 (arXiv 2003.01197), in the
form that SafeBench (Xu et al. 2022) gives it: draws in [-1, 1], softplus of the spread, a bonus for entropy. SafeBench
learns over a thousand episodes of many routes; here each base has its own distribution, and steps are larger. It seeks
collisions that may be proven; `l2c?objective=danger` seeks any, as in the paper.
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
FAR: Final = -20.0  # m; larger gaps count as equal
LEAST: Final = 0.05  # smallest standard deviation: a collapsed distribution stops learning


class _Distribution:
    """Autoregressive normal distribution of D parameters of one base in [-1, 1].

    Attributes:
        mean: [D] mean of each parameter where the earlier parameters are 0.
        weight: [D, D] weight of earlier parameters (columns) in the mean of each parameter (rows).
        raw: [D] spread before softplus.
    """

    def __init__(self, dimension: int) -> None:
        self.mean = torch.zeros(dimension, dtype=torch.float64, requires_grad=True)
        self.weight = torch.zeros(dimension, dimension, dtype=torch.float64, requires_grad=True)
        self.raw = torch.zeros(dimension, dtype=torch.float64, requires_grad=True)
        self.adam = torch.optim.Adam([self.mean, self.weight, self.raw], lr=RATE, betas=(0.5, 0.9))

    def spread(self) -> torch.Tensor:
        """Return the standard deviations [D]."""
        return LEAST + softplus(self.raw)

    def draw(self, noise: F64) -> F64:
        """Return draws [N, D] from standard normal numbers [N, D], one parameter after the other."""
        mean, weight, spread = (tensor.detach().numpy() for tensor in (self.mean, self.weight, self.spread()))
        draws = np.zeros_like(noise)
        for dimension in range(noise.shape[1]):
            draws[:, dimension] = (
                mean[dimension]
                + draws[:, :dimension] @ weight[dimension, :dimension]
                + spread[dimension] * noise[:, dimension]
            )
        return draws

    def learn(self, draws: F64, advantage: F64) -> None:
        """Take one REINFORCE step from draws [N, D] and their advantages [N]."""
        draw_tensor = torch.from_numpy(draws)
        spread = self.spread()
        # Only earlier parameters condition later ones, hence the strictly lower triangle.
        mean = self.mean + draw_tensor @ torch.tril(self.weight, -1).T
        likelihood = (-0.5 * ((draw_tensor - mean) / spread).square() - spread.log()).sum(1)
        cost = -(torch.from_numpy(advantage) * likelihood).mean() - ENTROPY * spread.log().sum()
        self.adam.zero_grad()
        cost.backward()  # type: ignore[no-untyped-call]
        self.adam.step()


class L2C(BoxSearch):
    """Autoregressive distribution of the initial state that learns by REINFORCE (L2C)."""

    name = "l2c"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int, objective: str = "proof") -> None:
        super().__init__(bases, seeds=seeds, budget=budget, objective=objective)
        self._random = [generator("l2c", seed) for seed in seeds]
        self._of = [_Distribution(box.dimension) for box in self.boxes]
        self._draws: list[F64] = [np.zeros((0, box.dimension)) for box in self.boxes]

    def points(self, index: int, count: int) -> F64:
        """Draw from the current distribution, clipped to the box."""
        noise = self._random[index].standard_normal((count, self.boxes[index].dimension))
        self._draws[index] = self._of[index].draw(noise)
        return np.asarray(np.clip(0.5 + 0.5 * self._draws[index], 0.0, 1.0))

    def learn(self, index: int, points: F64, danger: F64) -> None:
        """Take a gradient step from the last draws, unless all have the same danger."""
        floored_danger = np.maximum(danger, FAR)
        if len(floored_danger) > 1 and np.ptp(floored_danger) > 1e-9:
            # ranks make the step independent of the unit of danger and of outliers
            order = np.argsort(np.argsort(floored_danger, kind="stable"), kind="stable")
            self._of[index].learn(self._draws[index], (order - order.mean()) / order.std())

"""Projected gradient ascent with restarts, momentum and shrinking steps."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital.attack import Access, keep_best
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.victim import Victim

Start = Literal["none", "uniform", "gaussian"]


def starts(victim: Victim, budget: Budget, first: Start, restarts: int) -> Iterator[Tensor]:
    """Yield the images [B, 3, H, W] from which an attack begins: first as `first` says, then at random in the ball.

    Args:
        victim: Detector and images under attack.
        budget: The ball.
        first: Position of the first start.
        restarts: Number of further starts; uniform if `first` is the clean image.
    """
    for start_index in range(1 + restarts):
        kind: Start = first if start_index == 0 or first != "none" else "uniform"
        images = victim.clean
        if kind != "none":
            draws = victim.draw(kind, "start", start_index)
            images = budget.around(victim.clean, budget.start(draws, kind))
        yield images


@dataclass(frozen=True, slots=True)
class PGD:
    """Steps along the steepest direction, each projected onto the ball; the best image of all steps is kept.

    Without `step`, constant steps are 2.5 / steps of the radius, so that an image can cross the ball and turn around
    (Madry et al. 2018); shrinking steps begin with twice that, at most the radius, which gives the same total length.

    Attributes:
        steps: Gradient steps of each start.
        step: Length of the first step as a share of the radius; None: the rule above.
        schedule: "cosine": steps shrink to zero, so that the last ones settle. "constant": all have the same length.
        start: Position of the first start: the clean image, or a random point of the ball.
        restarts: Further random starts.
        decay: Decay of the momentum of directions; 0: none (Dong et al. 2018 take 1).

    Raises:
        ConfigError: No step, a negative number of restarts, or a step of length 0.

    Source: Madry et al., Towards Deep Learning Models Resistant to Adversarial Attacks (ICLR 2018).
    """

    steps: int = 10
    step: float | None = None
    schedule: Literal["cosine", "constant"] = "cosine"
    start: Start = "uniform"
    restarts: int = 0
    decay: float = 0.0
    name: str = "pgd"
    access: Access = "white-box"

    def __post_init__(self) -> None:
        if self.steps < 1 or self.restarts < 0 or self.decay < 0 or (self.step is not None and self.step <= 0):
            raise ConfigError(f"{self.name}: steps must be 1 or more, step above 0, restarts and decay 0 or more")

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Run the ascent from every start and keep the best images."""
        best = victim.clean, victim.clean.new_full((len(victim),), -torch.inf, dtype=torch.float32)
        for images in starts(victim, budget, self.start, self.restarts):
            best = self._ascend(victim, budget, images, best)
        return best[0]

    def _ascend(
        self, victim: Victim, budget: Budget, images: Tensor, best: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        momentum = torch.zeros_like(images)
        for step_index in range(self.steps):
            loss, gradient = victim.gradient(images)
            best = keep_best(best, images, loss.float())
            if self.decay:
                # Normalised by the mean absolute value, as in Dong et al. (2018), so that all steps weigh the same.
                gradient = gradient / gradient.abs().flatten(1).mean(1).clamp_min(1e-30)[:, None, None, None]
                momentum = gradient = self.decay * momentum + gradient
            images = budget.ascend(images, gradient, victim.clean, budget.radius * self.share(step_index))
        return keep_best(best, images, victim.loss(images).float())

    def share(self, k: int) -> float:
        """Return the length of step `k` as a share of the radius."""
        constant = self.schedule == "constant"
        first_share = self.step if self.step is not None else min(2.5 / self.steps * (1 if constant else 2), 1.0)
        return first_share if constant else first_share * 0.5 * (1 + math.cos(math.pi * k / self.steps))

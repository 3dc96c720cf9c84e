"""Carlini and Wagner's attack: margin ascent inside the ball, and the smallest change that empties the image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital.attack import Access
from ssad.scenarios.static.digital.budget import Budget, lengths
from ssad.scenarios.static.digital.pgd import PGD
from ssad.scenarios.static.digital.victim import Victim

EDGE = 1e-6  # how far from 0 and 1 values are kept before they are mapped to the line


def cw(*, steps: int = 10, restarts: int = 0) -> PGD:
    """Return margin ascent inside the ball (with the loss `margin`), starting at the clean image.

    Args:
        steps: Gradient steps.
        restarts: Further random starts.

    Source: Madry et al. (ICLR 2018) ascend Carlini and Wagner's margin in the same way.
    """
    return PGD(steps, start="none", restarts=restarts, name="cw")


@dataclass(frozen=True, slots=True)
class MinimalCW:
    """Smallest Euclidean change after which the loss `margin` is 0: no location scores above the threshold.

    A change that exceeds the budget is shortened to it.

    Attributes:
        rounds: Rounds of the binary search over the weight of the loss.
        steps: Steps of Adam in each round.
        rate: Learning rate of Adam.
        weight: Weight of the loss in the first round.

    Raises:
        ConfigError: No rounds or steps.

    Source: Carlini and Wagner, Towards Evaluating the Robustness of Neural Networks (2017), section VI.A.
    """

    rounds: int = 5
    steps: int = 40
    rate: float = 0.01
    weight: float = 0.01
    name: str = "cw-min"
    access: Access = "white-box"

    def __post_init__(self) -> None:
        if self.rounds < 1 or self.steps < 1 or self.rate <= 0 or self.weight <= 0:
            raise ConfigError("cw-min: rounds and steps must be 1 or more, rate and weight above 0")

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Search for the smallest emptying change; an image without one keeps the images of its best loss."""
        count = len(victim)
        weight = victim.clean.new_full((count,), self.weight)
        lower_weight, upper_weight = torch.zeros_like(weight), torch.full_like(weight, torch.inf)
        shortest = torch.full_like(weight, torch.inf)
        best_images = victim.clean
        best_loss = torch.full_like(weight, -torch.inf)
        for _ in range(self.rounds):
            solved = torch.zeros(count, dtype=torch.bool, device=weight.device)
            for images, loss in self._descend(victim, weight):
                change_length = lengths(images - victim.clean).flatten()
                empties = loss >= 0
                solved |= empties
                better = (empties & (change_length < shortest)) | (shortest.isinf() & ~empties & (loss > best_loss))
                best_images = torch.where(better[:, None, None, None], images, best_images)
                shortest = torch.where(empties & better, change_length, shortest)
                best_loss = torch.maximum(best_loss, loss)
            upper_weight = torch.where(solved, torch.minimum(upper_weight, weight), upper_weight)
            lower_weight = torch.where(solved, lower_weight, torch.maximum(lower_weight, weight))
            # Grow the weight tenfold until a round succeeds, then bisect.
            weight = torch.where(upper_weight.isinf(), weight * 10, (lower_weight + upper_weight) / 2)
        return budget.project(best_images, victim.clean)

    def _descend(self, victim: Victim, weight: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield the images and losses of an Adam descent with one weight for each image."""
        clean = victim.clean.clamp(EDGE, 1 - EDGE)
        # The logistic map keeps images in [0, 1] without a projection.
        logits = torch.logit(clean).requires_grad_()
        optimizer = torch.optim.Adam([logits], lr=self.rate)
        for _ in range(self.steps):
            images = logits.sigmoid()
            loss, gradient = victim.gradient(images)
            yield images.detach(), loss
            with torch.enable_grad():
                decoded = logits.sigmoid()
                squared_length = ((decoded - victim.clean) ** 2).flatten(1).sum(1)
                linear_loss = (decoded * gradient).flatten(1).sum(1)  # has the gradient of the loss
                (squared_length - weight * linear_loss).sum().backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            optimizer.zero_grad()

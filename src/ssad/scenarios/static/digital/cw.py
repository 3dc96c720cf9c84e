"""Carlini and Wagner's attack: margin ascent inside the ball, and the smallest change that empties the picture."""

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
    """Margin ascent inside the ball (with the loss `margin`), from the clean image.

    Args:
        steps: Gradient steps.
        restarts: Further random starts.

    Returns:
        The attack.

    Source: Madry et al. (ICLR 2018) ascend Carlini and Wagner's margin in the same way.
    """
    return PGD(steps, start="none", restarts=restarts, name="cw")


@dataclass(frozen=True, slots=True)
class MinimalCW:
    """The smallest Euclidean change after which the loss `margin` is 0: no location scores above the threshold.

    Attributes:
        rounds: of the binary search of the weight of the loss.
        steps: of Adam in each round.
        rate: of Adam.
        weight: of the loss in the first round.

    What does not fit into the budget is shortened to it.

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
        """See `Attack`. Images that no change empties are the best that was met."""
        count = len(victim)
        weight = victim.clean.new_full((count,), self.weight)
        low, high = torch.zeros_like(weight), torch.full_like(weight, torch.inf)
        shortest = torch.full_like(weight, torch.inf)
        found = victim.clean
        least = torch.full_like(weight, -torch.inf)
        for _ in range(self.rounds):
            won = torch.zeros(count, dtype=torch.bool, device=weight.device)
            for images, loss in self._descend(victim, weight):
                size = lengths(images - victim.clean).flatten()
                done = loss >= 0
                won |= done
                better = (done & (size < shortest)) | (shortest.isinf() & ~done & (loss > least))
                found = torch.where(better[:, None, None, None], images, found)
                shortest = torch.where(done & better, size, shortest)
                least = torch.maximum(least, loss)
            high = torch.where(won, torch.minimum(high, weight), high)
            low = torch.where(won, low, torch.maximum(low, weight))
            weight = torch.where(high.isinf(), weight * 10, (low + high) / 2)
        return budget.project(found, victim.clean)

    def _descend(self, victim: Victim, weight: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Images and losses that are met with one weight each."""
        clean = victim.clean.clamp(EDGE, 1 - EDGE)
        line = torch.logit(clean).requires_grad_()
        optimizer = torch.optim.Adam([line], lr=self.rate)
        for _ in range(self.steps):
            images = line.sigmoid()
            loss, gradient = victim.gradient(images)
            yield images.detach(), loss
            with torch.enable_grad():
                shown = line.sigmoid()
                size = ((shown - victim.clean) ** 2).flatten(1).sum(1)
                ascended = (shown * gradient).flatten(1).sum(1)  # has the gradient of the loss
                (size - weight * ascended).sum().backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            optimizer.zero_grad()

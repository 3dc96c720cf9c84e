"""A digital attack: a few steps along the sign of the gradient, each half as long as the one before."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ssad.scenarios.static.digital.attack import Access, keep_best
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.victim import Victim


@dataclass(frozen=True, slots=True)
class Steps:
    """The first step is as long as the budget; the best image on the way is kept.

    Attributes:
        steps: How many; in a suite `options: {steps: 5}`.
    """

    steps: int = 3
    name: str = "example-steps"
    access: Access = "white-box"

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Images [B, 3, H, W] that raise the victim's loss, within the budget."""
        loss, gradient = victim.gradient(victim.clean)
        best, images = (victim.clean, loss), victim.clean
        for step in range(self.steps):
            images = budget.ascend(images, gradient, victim.clean, budget.radius / 2**step)
            loss, gradient = victim.gradient(images)
            best = keep_best(best, images, loss)
        return best[0]

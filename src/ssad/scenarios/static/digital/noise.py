"""Random noise of the size of the budget: the control that stands beside every attack."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ssad.scenarios.static.digital.attack import Access
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.victim import Victim


@dataclass(frozen=True, slots=True)
class RandomNoise:
    """Each value moved by the radius up or down at random (L-infinity), or a random direction of that length (L2): as
    large as any attack, and it asks nothing."""

    name: str = "noise"
    access: Access = "none"

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """See `Attack`."""
        draws = victim.draw("gaussian", "noise")
        change = draws.sign() if budget.norm == "linf" else budget.steepest(draws)
        return budget.project(victim.clean + budget.radius * torch.where(change == 0, 1.0, change), victim.clean)

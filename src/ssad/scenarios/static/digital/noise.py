"""Random noise of the size of the budget: the control for every attack."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ssad.scenarios.static.digital.attack import Access
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.victim import CleanImages, Victim


@dataclass(frozen=True, slots=True)
class RandomNoise:
    """Random noise as large as the budget allows, without queries.

    Under L-infinity each value moves up or down by the radius; under L2 the image moves by the radius in a random
    direction, in which values stop at 0 and 1.
    """

    name: str = "noise"
    access: Access = "none"

    def perturb(self, victim: Victim | CleanImages, budget: Budget) -> Tensor:
        """Add random noise of the size of the budget."""
        draws = victim.draw("gaussian", "noise")
        return budget.to_border(victim.clean, torch.where(draws == 0, 1.0, draws))

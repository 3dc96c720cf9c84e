"""Fast gradient sign method: one step of the length of the budget."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ssad.scenarios.static.digital.attack import Access
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.victim import Victim


@dataclass(frozen=True, slots=True)
class FGSM:
    """Single step of the length of the budget along the steepest direction, in which values stop at 0 and 1.

    Source: Goodfellow et al., Explaining and Harnessing Adversarial Examples (ICLR 2015).
    """

    name: str = "fgsm"
    access: Access = "white-box"

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Take one step from the clean images."""
        _, gradient = victim.gradient(victim.clean)
        return budget.to_border(victim.clean, gradient)

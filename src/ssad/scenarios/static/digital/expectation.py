"""Attacks on random defences by expectation over their draws."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital.attack import Access, Attack
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.defences import Defended, RandomDefence
from ssad.scenarios.static.digital.victim import Through, Victim


class _ExpectedVictim(Victim):
    """Victim whose loss is the mean over draws of a random defence."""

    def __init__(self, victim: Victim, defence: RandomDefence, draws: Sequence[Through]) -> None:
        # Share the state of the victim: building a new one would repeat its target assignment.
        self.__dict__.update(vars(victim))
        bare = victim.detector
        if isinstance(bare, Defended) and bare.defence == defence:
            bare = bare.detector
            self.detector = bare
            self.situation = replace(victim.situation, detector=bare)
        self.parts = []
        for draw in draws:
            part = copy.copy(victim)
            part.detector, part.situation, part.through = self.detector, self.situation, draw
            self.parts.append(part)

    def loss(self, images: Tensor) -> Tensor:
        return torch.stack([draw_victim.loss(images) for draw_victim in self.parts]).mean(0)

    def gradient(self, images: Tensor) -> tuple[Tensor, Tensor]:
        losses, gradients = zip(*(draw_victim.gradient(images) for draw_victim in self.parts), strict=True)
        return torch.stack(losses).mean(0), torch.stack(gradients).mean(0)


@dataclass(frozen=True, slots=True)
class Expected:
    """Attack that knows a random defence but not its draw: it ascends the mean loss over draws of its own.

    The defence may stand before the detector (`Defended` or `through`) or not: the attack substitutes its own draws.
    They are the same at all steps, so that losses are comparable; each query costs as many as there are draws.

    Attributes:
        inner: Attack.
        defence: Random defence.
        draws: Number of draws.

    Raises:
        ConfigError: No draws; later: the victim's `through` is another defence.

    Source: expectation over transformation, Athalye et al., Synthesizing Robust Adversarial Examples (ICML 2018).
    """

    inner: Attack
    defence: RandomDefence
    draws: int = 8

    def __post_init__(self) -> None:
        if self.draws < 1:
            raise ConfigError("expected: it needs one draw at least")

    @property
    def name(self) -> str:
        """Name shown in tables."""
        return f"{self.inner.name}-over-{self.defence.name}"

    @property
    def access(self) -> Access:
        """Access of the inner attack."""
        return self.inner.access

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Run the inner attack on the mean loss over the draws."""
        if victim.through is not None and victim.through != self.defence:
            raise ConfigError(f"{self.name}: the pictures pass another defence on their way to the detector")
        draws = [self.defence.fixed_draw(draw_index) for draw_index in range(self.draws)]
        return self.inner.perturb(_ExpectedVictim(victim, self.defence, draws), budget)

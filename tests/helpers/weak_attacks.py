"""Attacks with one fault each, as they occur in practice; the audit must find every one of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ssad.scenarios.static.digital.attack import Access
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.victim import Victim


@dataclass(frozen=True)
class SteppedAttack:
    """PGD with cosine steps whose gradient passes `direction`; without a fault it equals that of SSAD."""

    steps: int = 10
    access: Access = "white-box"

    @property
    def name(self) -> str:
        """Name shown in tables."""
        return type(self).__name__

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Take all steps and return the last image."""
        budget = self.budget(budget)
        images = budget.around(victim.clean, budget.start(victim.draw("uniform", "start", 0), "uniform"))
        for index in range(self.steps):
            direction = self.direction(victim, images, index)
            share = min(5.0 / self.steps, 1.0) * 0.5 * (1 + math.cos(math.pi * index / self.steps))
            images = budget.ascend(images, direction, victim.clean, budget.radius * share)
        return images

    def budget(self, budget: Budget) -> Budget:
        """Return the budget that is used."""
        return budget

    def direction(self, victim: Victim, images: Tensor, index: int) -> Tensor:
        """Return the direction of a step."""
        return victim.gradient(images)[1]


@dataclass(frozen=True)
class RepeatedGradient(SteppedAttack):
    """Repeats its first gradient at every step."""

    memory: dict[str, Any] = field(default_factory=dict, compare=False)

    def direction(self, victim: Victim, images: Tensor, index: int) -> Tensor:
        gradient = victim.gradient(images)[1]
        if index == 0:
            self.memory["gradient"] = gradient
        return self.memory["gradient"]


@dataclass(frozen=True)
class HalfPrecision(SteppedAttack):
    """Scales the loss by its number of values and keeps the gradient in float16, in which most of it underflows."""

    def direction(self, victim: Victim, images: Tensor, index: int) -> Tensor:
        gradient = victim.gradient(images)[1]
        return (gradient / images[0].numel()).half().to(gradient.dtype)


@dataclass(frozen=True)
class FlippedChannel(SteppedAttack):
    """Descends in one of three colour channels."""

    def direction(self, victim: Victim, images: Tensor, index: int) -> Tensor:
        gradient = victim.gradient(images)[1].clone()
        gradient[:, 0] *= -1
        return gradient


@dataclass(frozen=True)
class WrongNormalisation(SteppedAttack):
    """Takes the gradient at images that were normalised for another network."""

    def direction(self, victim: Victim, images: Tensor, index: int) -> Tensor:
        mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
        return victim.gradient((images - mean[:, None, None]) / deviation[:, None, None])[1]


@dataclass(frozen=True)
class KeptMomentum(SteppedAttack):
    """Accumulates directions and never resets them, so that those of one batch go on into the next."""

    memory: dict[str, Any] = field(default_factory=dict, compare=False)

    def direction(self, victim: Victim, images: Tensor, index: int) -> Tensor:
        gradient = victim.gradient(images)[1]
        scale = gradient.abs().flatten(1).mean(1)[:, None, None, None]
        self.memory["momentum"] = self.memory.get("momentum", 0.0) + gradient / scale
        return self.memory["momentum"]


@dataclass(frozen=True)
class TinyRadius(SteppedAttack):
    """Divides its radius by 255 twice."""

    def budget(self, budget: Budget) -> Budget:
        return Budget(budget.radius / 255, budget.norm)


@dataclass(frozen=True)
class RandomSigns(SteppedAttack):
    """Follows random signs in place of the gradient."""

    def direction(self, victim: Victim, images: Tensor, index: int) -> Tensor:
        victim.gradient(images)
        return victim.draw("uniform", "sign", index)


WEAK_ATTACKS: tuple[type[SteppedAttack], ...] = (
    RepeatedGradient,
    HalfPrecision,
    FlippedChannel,
    WrongNormalisation,
    KeptMomentum,
    TinyRadius,
    RandomSigns,
)

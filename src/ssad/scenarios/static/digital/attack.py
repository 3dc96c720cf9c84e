"""Protocol of digital attacks, and `run_attack`, which returns 8-bit images within the budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.scenarios.static.digital.budget import LEVELS, Budget, quantise
from ssad.scenarios.static.digital.gradient_check import check_gradient
from ssad.scenarios.static.digital.objectives import EVERYTHING, Aim, Objective, make_objective
from ssad.scenarios.static.digital.victim import Cost, Precision, Through, Victim, steady

Access = Literal["white-box", "black-box", "none"]


class Attack(Protocol):
    """Attack method; its settings are given to its constructor.

    Attributes:
        name: Name shown in tables.
        access: "white-box": queries gradients. "black-box": queries losses only. "none": queries nothing.
    """

    @property
    def name(self) -> str:
        """Name shown in tables."""

    @property
    def access(self) -> Access:
        """Access to the detector: "white-box": gradients; "black-box": losses only; "none": nothing."""

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Search for images that raise the victim's loss.

        Args:
            victim: Detector, images and loss.
            budget: Maximum change of the images.

        Returns:
            [B, 3, H, W], the best images within the budget. Each depends on its own image and key alone.
        """


@dataclass(frozen=True, slots=True)
class AttackResult:
    """Result of an attack on a batch.

    Attributes:
        images: [B, 3, H, W] float32, multiples of 1/255, as a detector reads them from stored 8-bit images.
        before, after: [B] loss of the clean images, and of `images`.
        idle: [B] mask of the images without anything to attack; they are returned clean.
        cost: Cost per image.
        gradient_error: Largest relative error of the gradient against finite differences before the attack; None if
            it was not checked.
        about: Attack, access, loss and budget as plain data for a record.
    """

    images: Tensor
    before: Tensor
    after: Tensor
    idle: Tensor
    cost: Cost
    gradient_error: float | None = None
    about: Mapping[str, Any] = field(default_factory=dict)

    def rows(self, indices: Sequence[int]) -> AttackResult:
        """Return the result of some images of the batch."""
        rows = list(indices)
        return replace(
            self, images=self.images[rows], before=self.before[rows], after=self.after[rows], idle=self.idle[rows]
        )


def run_attack(
    attack: Attack,
    detector: Detector,
    images: Tensor,
    truth: Sequence[Truth],
    budget: Budget,
    *,
    objective: str | Objective = "margin",
    intrinsic: Tensor | None = None,
    aim: Aim = EVERYTHING,
    keys: Sequence[tuple[object, ...]] | None = None,
    through: Through | None = None,
    precision: Precision = "float32",
    check: bool = True,
) -> AttackResult:
    """Attack a batch of images.

    Args:
        attack: Attack method.
        detector: Detector under attack; its modes, flags and buffers are restored afterwards.
        images: [B, 3, H, W] float in [0, 1], multiples of 1/255.
        truth: Ground truth of each image.
        budget: Maximum change of each image.
        objective: Loss to ascend, or its name.
        intrinsic: [B, 3, 3], for 3D.
        aim: Objects under attack.
        keys: Random keys of the images.
        through: Defence that the attack knows.
        precision: Precision of the gradients; see `Victim`.
        check: Compare the gradient with finite differences first (white-box attacks only).

    Returns:
        The attacked images after an 8-bit round trip, with the losses before and after.

    Raises:
        ConfigError: See `Victim`; the gradient is missing, not finite or wrong; the attack broke the budget.
    """
    loss_function = make_objective(objective) if isinstance(objective, str) else objective
    with steady(detector):
        victim = Victim(
            detector,
            images,
            truth,
            loss_function,
            intrinsic=intrinsic,
            aim=aim,
            keys=keys,
            through=through,
            precision=precision,
        )
        gradient_error = check_gradient(victim) if check and attack.access == "white-box" else None
        loss_before = victim.loss(victim.clean)
        # The cost counts the attack alone, not the checks before it.
        victim.cost = Cost()
        perturbed = attack.perturb(victim, budget) if budget.radius > 0 else victim.clean
        if perturbed.shape != victim.clean.shape or not bool(perturbed.isfinite().all()):
            raise ConfigError(f"attack {attack.name}: what it found has another shape, or is not finite")
        cost = Cost(victim.cost.gradients, victim.cost.queries)
        perturbed = torch.where(victim.idle[:, None, None, None], victim.clean, perturbed.detach())
        stored = quantise(perturbed, victim.codes, budget).to(victim.clean) / LEVELS
        # The loss is measured on the rounded images, which are what a detector reads.
        loss_after = victim.loss(stored)
    metadata = {
        "attack": attack.name,
        "access": attack.access,
        "loss": loss_function.name,
        "norm": budget.norm,
        "radius_px": round(budget.radius * LEVELS, 6),
        "gradients": cost.gradients,
        "queries": cost.queries,
    }
    return AttackResult(stored, loss_before, loss_after, victim.idle, cost, gradient_error, metadata)


def keep_best(best: tuple[Tensor, Tensor], images: Tensor, loss: Tensor) -> tuple[Tensor, Tensor]:
    """Return the images with the higher loss of two sets, and these losses.

    Args:
        best: Best images [B, 3, H, W] and losses [B] so far.
        images: [B, 3, H, W].
        loss: [B].
    """
    better = loss > best[1]
    if bool(better.all()):
        return images, loss
    return torch.where(better[:, None, None, None], images, best[0]), torch.where(better, loss, best[1])

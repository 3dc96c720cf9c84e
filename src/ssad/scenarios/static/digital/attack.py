"""The seam of digital attacks, and the one way to run them: what comes out is an 8-bit picture within its budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
    """A method; what it needs to know is given to its constructor.

    Attributes:
        name: What tables call it.
        access: "white-box": it asks for gradients. "black-box": for losses only. "none": it asks nothing.
    """

    @property
    def name(self) -> str:
        """What tables call it."""

    @property
    def access(self) -> Access:
        """What it asks for: "white-box": gradients; "black-box": only losses; "none": nothing."""

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Look for images that raise the victim's loss.

        Args:
            victim: Detector, images and loss.
            budget: How far images may be moved.

        Returns:
            [B, 3, H, W] the best images found, within the budget. Each depends on its own image and key alone.
        """


@dataclass(frozen=True, slots=True)
class Attacked:
    """What an attack made of a batch.

    Attributes:
        images: [B, 3, H, W] float32, multiples of 1/255: what a detector reads from the stored 8-bit picture.
        before, after: [B] the loss of the clean images, and of `images`.
        idle: [B] images in which there was nothing to attack; they are the clean ones.
        cost: of each image.
        gradient_error: the largest relative error of the gradient against finite differences that was found before the
            attack; None if it was not looked at.
        about: attack, access, loss, budget, as plain data for a record.
    """

    images: Tensor
    before: Tensor
    after: Tensor
    idle: Tensor
    cost: Cost
    gradient_error: float | None = None
    about: Mapping[str, Any] = field(default_factory=dict)


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
) -> Attacked:
    """Attack a batch of images.

    Args:
        attack: The method.
        detector: What is attacked; its modes, flags and buffers are the same afterwards.
        images: [B, 3, H, W] float in [0, 1], multiples of 1/255.
        truth: What is in each image.
        budget: How far each may be moved.
        objective: The loss to ascend, or its name.
        intrinsic: [B, 3, 3], for 3D.
        aim: Which objects are attacked.
        keys: What the random draws of each image come from.
        through: A defence that the attack knows.
        precision: Of the gradients; see `Victim`.
        check: Compare the gradient with finite differences first (white-box attacks only).

    Returns:
        The attacked images after an 8-bit round trip, with the losses before and after.

    Raises:
        ConfigError: See `Victim`; the gradient is missing, not finite or wrong; the attack broke the budget.
    """
    ascended = make_objective(objective) if isinstance(objective, str) else objective
    with steady(detector):
        victim = Victim(
            detector,
            images,
            truth,
            ascended,
            intrinsic=intrinsic,
            aim=aim,
            keys=keys,
            through=through,
            precision=precision,
        )
        error = check_gradient(victim) if check and attack.access == "white-box" else None
        before = victim.loss(victim.clean)
        victim.cost = Cost()
        found = attack.perturb(victim, budget) if budget.radius > 0 else victim.clean
        if found.shape != victim.clean.shape or not bool(found.isfinite().all()):
            raise ConfigError(f"attack {attack.name}: what it found has another shape, or is not finite")
        cost = Cost(victim.cost.gradients, victim.cost.queries)
        found = torch.where(victim.idle[:, None, None, None], victim.clean, found.detach())
        kept = quantise(found, victim.codes, budget).to(victim.clean) / LEVELS
        after = victim.loss(kept)
    about = {
        "attack": attack.name,
        "access": attack.access,
        "loss": ascended.name,
        "norm": budget.norm,
        "radius_px": round(budget.radius * LEVELS, 6),
        "gradients": cost.gradients,
        "queries": cost.queries,
    }
    return Attacked(kept, before, after, victim.idle, cost, error, about)


def keep_best(best: tuple[Tensor, Tensor], images: Tensor, loss: Tensor) -> tuple[Tensor, Tensor]:
    """The images with the higher loss of two sets, and these losses.

    Args:
        best: Images [B, 3, H, W] and losses [B] so far.
        images: [B, 3, H, W].
        loss: [B].
    """
    better = loss > best[1]
    if bool(better.all()):
        return images, loss
    return torch.where(better[:, None, None, None], images, best[0]), torch.where(better, loss, best[1])

"""Auto-PGD: projected ascent that halves its step when progress stalls, and continues from the best image."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital.attack import Access, keep_best
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.pgd import Start, starts
from ssad.scenarios.static.digital.victim import Victim

INERTIA = 0.75  # weight of the new step; the rest repeats the last one
PROGRESS = 0.75  # least share of steps that must raise the loss between two checkpoints
MIN_STEPS = 50
"""Steps from which on it is as strong as `PGD` with as many, as measured (docs/reference/attacks.md#steps-of-apgd)."""


@dataclass(frozen=True, slots=True)
class APGD:
    """Auto-PGD.

    Its first steps are twice the radius, and each checkpoint at most halves them. With few steps they are still long
    at the end, and `PGD` is stronger; `apgd` warns of fewer than `MIN_STEPS`.

    Attributes:
        steps: Gradient steps of each start, including the first gradient.
        start: Position of the first start.
        restarts: Further random starts.
        name: Name shown in tables.
        access: Queries gradients.

    Raises:
        ConfigError: Fewer than two steps, or a negative number of restarts.

    Source: Croce and Hein, Reliable Evaluation of Adversarial Robustness with an Ensemble of Diverse Parameter-free
    Attacks (ICML 2020), algorithm 1; first step of twice the radius, checkpoints of its section 3.
    """

    steps: int = MIN_STEPS
    start: Start = "uniform"
    restarts: int = 0
    name: str = "apgd"
    access: Access = "white-box"

    def __post_init__(self) -> None:
        if self.steps < 2 or self.restarts < 0:
            raise ConfigError("apgd: steps must be 2 or more, restarts 0 or more")

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Run the ascent from every start and keep the best images."""
        best = victim.clean, victim.clean.new_full((len(victim),), -torch.inf, dtype=torch.float32)
        for images in starts(victim, budget, self.start, self.restarts):
            best = keep_best(best, *self._run(victim, budget, images))
        return best[0]

    def _run(self, victim: Victim, budget: Budget, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return the best images and losses of one start."""
        checkpoint_steps = checkpoints(self.steps)
        loss, gradient = victim.gradient(images)
        loss = loss.float()
        best_images, best_loss, best_gradient = images, loss, gradient
        step_length = torch.full_like(loss, 2.0 * budget.radius)
        rise_count = torch.zeros_like(loss)
        last_checkpoint = 0
        previous_step, previous_best = step_length.clone(), loss.clone()
        previous_images = images
        for iteration in range(1, self.steps + 1):
            gradient_step = budget.project(images + _per_image(step_length) * budget.steepest(gradient), victim.clean)
            step_share = INERTIA if iteration > 1 else 1.0
            proposed = images + step_share * (gradient_step - images) + (1 - step_share) * (images - previous_images)
            previous_images, images = images, budget.project(proposed, victim.clean)
            if iteration == self.steps:
                return keep_best((best_images, best_loss), images, victim.loss(images).float())
            new_loss, gradient = victim.gradient(images)
            new_loss = new_loss.float()
            rise_count += new_loss > loss
            loss = new_loss
            improved = new_loss > best_loss
            best_images = torch.where(_per_image(improved), images, best_images)
            best_gradient = torch.where(_per_image(improved), gradient, best_gradient)
            best_loss = torch.where(improved, new_loss, best_loss)
            if iteration in checkpoint_steps:
                # Conditions 1 and 2 of the source.
                stalled = rise_count < PROGRESS * (iteration - last_checkpoint)
                unchanged = (previous_step == step_length) & (previous_best == best_loss)
                restart = stalled | unchanged
                previous_step, previous_best = step_length.clone(), best_loss.clone()
                step_length = torch.where(restart, step_length / 2, step_length)
                # The previous images stay, as in the source: the next step still has momentum.
                images = torch.where(_per_image(restart), best_images, images)
                gradient = torch.where(_per_image(restart), best_gradient, gradient)
                loss = torch.where(restart, best_loss, loss)
                rise_count = torch.zeros_like(rise_count)
                last_checkpoint = iteration
        return best_images, best_loss


def apgd(*, steps: int = MIN_STEPS, start: Start = "uniform", restarts: int = 0) -> APGD:
    """Return Auto-PGD, and warn of fewer steps than it needs beside `PGD`.

    Args:
        steps: Gradient steps of each start, including the first gradient.
        start: Position of the first start.
        restarts: Further random starts.

    Raises:
        ConfigError: See `APGD`.
    """
    attack = APGD(steps, start, restarts)
    if steps < MIN_STEPS:
        _warn_of_few(steps)
    return attack


@cache
def _warn_of_few(steps: int) -> None:
    """Warn of too few steps, once: the attack of a suite is built many times."""
    warnings.warn(
        f"apgd: {steps} steps are too few for its long first steps, so pgd with as many is stronger; take "
        f"{MIN_STEPS} or more, or pgd",
        UserWarning,
        stacklevel=4,
    )


def checkpoints(steps: int) -> frozenset[int]:
    """Return the steps after which progress is checked: at 0.22 of all, then after periods that shrink by 0.03 to 0.06.

    Args:
        steps: All steps.
    """
    fractions = [0.0, 0.22]
    while fractions[-1] < 1.0:
        fractions.append(fractions[-1] + max(fractions[-1] - fractions[-2] - 0.03, 0.06))
    return frozenset(math.ceil(fraction * steps - 1e-9) for fraction in fractions[1:] if fraction < 1.0)


def _per_image(values: Tensor) -> Tensor:
    """Reshape values [B] to [B, 1, 1, 1]."""
    return values[:, None, None, None]

"""Auto-PGD: projected ascent that halves its own step when progress stalls, and goes on from the best image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital.attack import Access, keep_best
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.pgd import Start, starts
from ssad.scenarios.static.digital.victim import Victim

INERTIA = 0.75  # share of the new step; the rest repeats the last one
PROGRESS = 0.75  # least share of steps that must raise the loss between two checkpoints


@dataclass(frozen=True, slots=True)
class APGD:
    """Auto-PGD.

    Attributes:
        steps: Gradient steps of each start, including the first gradient.
        start: Where the first start begins.
        restarts: Further random starts.
        name: What tables call it.
        access: It asks for gradients.

    Raises:
        ConfigError: Fewer than two steps, or a negative number of restarts.

    Source: Croce and Hein, Reliable Evaluation of Adversarial Robustness with an Ensemble of Diverse Parameter-free
    Attacks (ICML 2020), algorithm 1; first step of twice the radius, checkpoints of its section 3.
    """

    steps: int = 10
    start: Start = "uniform"
    restarts: int = 0
    name: str = "apgd"
    access: Access = "white-box"

    def __post_init__(self) -> None:
        if self.steps < 2 or self.restarts < 0:
            raise ConfigError("apgd: steps must be 2 or more, restarts 0 or more")

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """See `Attack`."""
        best = victim.clean, victim.clean.new_full((len(victim),), -torch.inf, dtype=torch.float32)
        for images in starts(victim, budget, self.start, self.restarts):
            best = keep_best(best, *self._run(victim, budget, images))
        return best[0]

    def _run(self, victim: Victim, budget: Budget, images: Tensor) -> tuple[Tensor, Tensor]:
        """Best images and losses of one start."""
        marks = checkpoints(self.steps)
        loss, gradient = victim.gradient(images)
        loss = loss.float()
        best_images, best_loss, best_gradient = images, loss, gradient
        step = torch.full_like(loss, 2.0 * budget.radius)
        rises = torch.zeros_like(loss)
        last_mark = 0
        step_before, best_before = step.clone(), loss.clone()
        before = images
        for k in range(1, self.steps + 1):
            ahead = budget.project(images + _each(step) * budget.steepest(gradient), victim.clean)
            share = INERTIA if k > 1 else 1.0
            moved = images + share * (ahead - images) + (1 - share) * (images - before)
            before, images = images, budget.project(moved, victim.clean)
            if k == self.steps:
                return keep_best((best_images, best_loss), images, victim.loss(images).float())
            fresh, gradient = victim.gradient(images)
            fresh = fresh.float()
            rises += fresh > loss
            loss = fresh
            better = fresh > best_loss
            best_images = torch.where(_each(better), images, best_images)
            best_gradient = torch.where(_each(better), gradient, best_gradient)
            best_loss = torch.where(better, fresh, best_loss)
            if k in marks:
                stalled = rises < PROGRESS * (k - last_mark)
                stuck = (step_before == step) & (best_before == best_loss)
                back = stalled | stuck
                step_before, best_before = step.clone(), best_loss.clone()
                step = torch.where(back, step / 2, step)
                images = torch.where(_each(back), best_images, images)
                before = torch.where(_each(back), best_images, before)
                gradient = torch.where(_each(back), best_gradient, gradient)
                loss = torch.where(back, best_loss, loss)
                rises = torch.zeros_like(rises)
                last_mark = k
        return best_images, best_loss


def checkpoints(steps: int) -> frozenset[int]:
    """Steps after which progress is looked at: at 0.22 of all, then after periods that shrink by 0.03 to 0.06.

    Args:
        steps: All steps.
    """
    marks = [0.0, 0.22]
    while marks[-1] < 1.0:
        marks.append(marks[-1] + max(marks[-1] - marks[-2] - 0.03, 0.06))
    return frozenset(math.ceil(mark * steps - 1e-9) for mark in marks[1:] if mark < 1.0)


def _each(values: Tensor) -> Tensor:
    """[B] as [B, 1, 1, 1]."""
    return values[:, None, None, None]

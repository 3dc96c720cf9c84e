"""Gradient estimates from losses alone, by antithetic pairs of probes, followed in the same way as by PGD."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital.attack import Access, keep_best
from ssad.scenarios.static.digital.budget import Budget, px
from ssad.scenarios.static.digital.pgd import PGD
from ssad.scenarios.static.digital.victim import Victim, draw


@dataclass(frozen=True, slots=True)
class NES:
    """Natural evolution strategies: the mean over random directions of the loss's slope along each, times it.

    The ascent starts at the clean image; the best image of all steps is kept. It takes (2 samples + 1) queries for
    each step, and one more.

    Attributes:
        steps: Ascent steps.
        samples: Pairs of probes for the estimate of each step; each pair costs two queries.
        sigma: Distance of the probes from the image, for each value, in [0, 1].
        step: Length of the first step as a share of the radius; None: the rule of `PGD`; steps shrink in the same
            way.
        decay: Decay of the sum of earlier estimates, which averages their noise.
        directions: "gaussian" (NES), or "signs": every value by `sigma` up or down (SPSA).
        tile: Side of the squares over which a direction is constant. An image has a million values, about which a few
            dozen probes say next to nothing; neighbours have similar slopes, so squares lose little.

    Raises:
        ConfigError: No step or sample, a sigma or step of 0 or less, a decay below 0.

    Source: Ilyas et al., Black-box Adversarial Attacks with Limited Queries and Information (ICML 2018), with its
    antithetic draws and momentum. Tiles: Ilyas et al., Prior Convictions (ICLR 2019), section 3.1. SPSA: Uesato et
    al., Adversarial Risk and the Dangers of Evaluating Against Weak Attacks (ICML 2018).
    """

    steps: int = 20
    samples: int = 25
    sigma: float = px(1)
    step: float | None = None
    decay: float = 0.9
    directions: Literal["gaussian", "signs"] = "gaussian"
    tile: int = 1
    name: str = "nes"
    access: Access = "black-box"

    def __post_init__(self) -> None:
        if self.steps < 1 or self.samples < 1 or self.sigma <= 0 or self.decay < 0:
            raise ConfigError(f"{self.name}: steps and samples must be 1 or more, sigma above 0, decay 0 or more")
        if self.step is not None and self.step <= 0:
            raise ConfigError(f"{self.name}: step must be above 0")
        if self.tile < 1:
            raise ConfigError(f"{self.name}: tile must be 1 or more")
        if self.directions not in ("gaussian", "signs"):
            raise ConfigError(f"{self.name}: directions '{self.directions}'; choose gaussian or signs")

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Ascend along estimated gradients."""
        schedule = PGD(self.steps, step=self.step)
        images = victim.clean
        best = images, victim.loss(images).float()
        estimate = torch.zeros_like(images)
        for step_index in range(self.steps):
            estimate = self.decay * estimate + self.estimate(victim, images, step_index)
            images = budget.ascend(images, estimate, victim.clean, budget.radius * schedule.share(step_index))
            best = keep_best(best, images, victim.loss(images).float())
        return best[0]

    def estimate(self, victim: Victim, images: Tensor, step_index: object = 0) -> Tensor:
        """Return the estimated gradient [B, 3, H, W] of the loss at images; probes are kept in [0, 1].

        Args:
            victim: Detector and images under attack.
            images: [B, 3, H, W].
            step_index: Number of the estimate; each draws its own directions.
        """
        total = torch.zeros_like(images)
        for sample_index in range(self.samples):
            direction = self._direction(victim, step_index, sample_index)
            if self.directions == "signs":
                direction = torch.where(direction < 0, -1.0, 1.0).to(images)
            loss_difference = victim.loss((images + self.sigma * direction).clamp(0.0, 1.0))
            loss_difference = loss_difference - victim.loss((images - self.sigma * direction).clamp(0.0, 1.0))
            total += loss_difference.to(images)[:, None, None, None] * direction
        return total / (2 * self.sigma * self.samples)

    def _direction(self, victim: Victim, *purpose: object) -> Tensor:
        """Return a normal direction [B, 3, H, W], constant over tiles."""
        coarse = draw(victim.clean[:, :, :: self.tile, :: self.tile], victim.keys, "gaussian", self.name, *purpose)
        height, width = victim.clean.shape[2:]
        return coarse.repeat_interleave(self.tile, 2).repeat_interleave(self.tile, 3)[:, :, :height, :width]


def spsa(
    *, steps: int = 20, samples: int = 25, delta: float = px(1), step: float | None = None, decay: float = 0.9
) -> NES:
    """Return simultaneous perturbation stochastic approximation: `NES` with directions of signs.

    Args:
        steps: Ascent steps.
        samples: Pairs of probes for the estimate of each step.
        delta: Distance of the probes from the image, for each value.
        step: Length of the first step as a share of the radius.
        decay: Decay of the sum of earlier estimates.
    """
    return NES(steps, samples, sigma=delta, step=step, decay=decay, directions="signs", name="spsa")

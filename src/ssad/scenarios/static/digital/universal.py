"""Universal perturbations: one change for many images, those of a data set or the frames of an episode."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital.attack import Access
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.victim import CleanImages, Victim, steady

Batches = Iterable[Victim] | Callable[[], Iterable[Victim]]


@dataclass(frozen=True, slots=True, eq=False)
class Universal:
    """Attack that adds one change to every image, without queries.

    Attributes:
        change: [1, 3, H, W], as `fit_universal` finds it; it is held to the budget of each run.

    Raises:
        ConfigError: The change is of another shape or not finite; later: pictures are of another size.
    """

    change: Tensor
    name: str = "universal"
    access: Access = "none"

    def __post_init__(self) -> None:
        shape = tuple(self.change.shape)
        if len(shape) != 4 or shape[:2] != (1, 3) or not bool(self.change.isfinite().all()):
            raise ConfigError(f"universal: the change must be finite and of shape [1, 3, H, W], not {list(shape)}")

    def perturb(self, victim: Victim | CleanImages, budget: Budget) -> Tensor:
        """Add the change, projected onto the budget."""
        _check_size(tuple(self.change.shape), victim)
        return budget.project(victim.clean + self.change.to(victim.clean), victim.clean)


@dataclass(frozen=True, slots=True)
class UniversalFit:
    """Fit of one change for many images of a drive; the attack `universal` of a suite.

    It does not query the images that it is added to; the change must be fitted first (`fit`).

    Attributes:
        over: "others": the change is fitted to frames of other drives, so that it is new to the pictures it is added
            to. "drive": to frames of the same drive, which shows what the best fixed change could do there.
        frames: Number of frames, spread evenly.
        steps: Passes over all of them.
        step: See `fit_universal`.
        method: See `fit_universal`.

    Raises:
        ConfigError: There is no such choice, or a number is below 1; later: it was not fitted.
    """

    over: Literal["others", "drive"] = "others"
    frames: int = 24
    steps: int = 10
    step: float = 0.25
    method: Literal["sign", "adam"] = "sign"
    name: str = "universal"
    access: Access = "none"

    def __post_init__(self) -> None:
        if self.over not in ("others", "drive"):
            raise ConfigError(f"universal: over '{self.over}'; choose others or drive")
        if self.frames < 1 or self.steps < 1 or self.step <= 0 or self.method not in ("sign", "adam"):
            raise ConfigError("universal: frames and steps must be 1 or more, step above 0, method sign or adam")

    @property
    def passes(self) -> int:
        """Forward and backward passes that `fit` takes."""
        return self.frames * (self.steps + 1)

    def fit(self, victims: Sequence[Victim], budget: Budget) -> Universal:
        """Return the attack that adds the change fitted to these images."""
        return Universal(fit_universal(victims, budget, epochs=self.steps, step=self.step, method=self.method))

    def perturb(self, victim: Victim | CleanImages, budget: Budget) -> Tensor:
        """Raise an error, since the change must be fitted first.

        Raises:
            ConfigError: Always.
        """
        raise ConfigError("universal: find the change first (fit, or fit_universal)")


def fit_universal(
    batches: Batches,
    budget: Budget,
    *,
    epochs: int = 20,
    step: float = 0.25,
    method: Literal["sign", "adam"] = "sign",
) -> Tensor:
    """Fit one change that raises the sum of the losses of many images.

    Each epoch takes the gradient of the sum over all images and makes one step, so the result does not depend on the
    batching. Step lengths decay to zero by a cosine; the best change of all epochs is returned.

    Args:
        batches: Victims whose images all have one size, or a function that returns them anew in each epoch, for
            images that do not fit into memory together.
        budget: Maximum change of each value (L-infinity), or of each image (L2).
        epochs: Passes over all images.
        step: Length of the first step as a share of the radius; under Adam its first rate, likewise.
        method: "sign": the steepest direction of the norm. "adam": Adam with the gradient as it is.

    Returns:
        [1, 3, H, W] change within the ball.

    Raises:
        ConfigError: No images, images of different sizes, no epoch, or a step of 0 or less.

    Source: Moosavi-Dezfooli et al., Universal Adversarial Perturbations (CVPR 2017), fitted by ascent of the summed
    loss as in Shafahi et al., Universal Adversarial Training (AAAI 2020).
    """
    if epochs < 1 or step <= 0 or method not in ("sign", "adam"):
        raise ConfigError("universal: epochs must be 1 or more, step above 0, method sign or adam")
    victims = batches if callable(batches) else list(batches)
    first_victim = next(iter(victims() if callable(victims) else victims), None)
    if first_victim is None:
        raise ConfigError("universal: there are no pictures to fit it to")
    change = torch.zeros_like(first_victim.clean[:1], dtype=torch.float64)
    best_change, best_total = change, -math.inf
    adam = torch.optim.Adam([change], eps=1e-30, maximize=True)
    unit_length = math.sqrt(change.numel()) if budget.norm == "l2" else 1.0  # norm of a change of all ones
    for epoch in range(epochs + 1):
        total, gradient = _sum_losses(victims() if callable(victims) else victims, change)
        if total > best_total:
            best_change, best_total = change.clone(), total
        # The last pass only evaluates the final change.
        if epoch == epochs:
            break
        rate = budget.radius * step * 0.5 * (1 + math.cos(math.pi * epoch / epochs))
        if method == "sign":
            change.add_(budget.steepest(gradient), alpha=rate)
        else:
            adam.param_groups[0]["lr"] = rate / unit_length
            change.grad = gradient
            adam.step()
        budget.within(change)
    return best_change.to(first_victim.clean.dtype)


def _sum_losses(batches: Iterable[Victim], change: Tensor) -> tuple[float, Tensor]:
    """Return the sum of all losses and its gradient with respect to the change, in float64."""
    total, gradient = 0.0, torch.zeros_like(change)
    for victim in batches:
        _check_size(tuple(change.shape), victim)
        perturbed = victim.clean + change.to(victim.clean)
        is_inside = (perturbed >= 0.0) & (perturbed <= 1.0)
        with steady(victim.detector):
            losses, gradients = victim.gradient(perturbed.clamp(0.0, 1.0))
        # Image by image in float64: the result is the same for any batching.
        for index in range(len(victim)):
            if not bool(victim.idle[index]):
                total += float(losses[index])
                gradient += (gradients[index] * is_inside[index])[None].double()
    return total, gradient


def _check_size(shape: tuple[int, ...], victim: Victim | CleanImages) -> None:
    image_shape = tuple(victim.clean.shape[1:])
    if shape[1:] != image_shape:
        raise ConfigError(
            f"universal: a change of {shape[2]} x {shape[3]} for pictures of {image_shape[1]} x "
            f"{image_shape[2]}; all pictures "
            "must have one size"
        )

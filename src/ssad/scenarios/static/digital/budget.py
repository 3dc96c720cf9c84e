"""Budgets of attacks, and the rounding that keeps 8-bit images within them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ssad.core.errors import ConfigError

Norm = Literal["linf", "l2"]
LEVELS = 255
_GRID = 1e-3  # tolerance, in code values, of clean images against whole codes


def px(value: float) -> float:
    """Convert 8-bit code values to the scale of images in [0, 1].

    Args:
        value: Code values, 0..255.

    Returns:
        value / 255.
    """
    return value / LEVELS


@dataclass(frozen=True, slots=True)
class Budget:
    """Ball around a clean image that bounds an attack.

    Attributes:
        radius: Radius for images in [0, 1]: `px(5)` is five code values.
        norm: "linf": bounds the change of each value. "l2": bounds the Euclidean length of the change of an image
            over all its values.

    Raises:
        ConfigError: The radius is negative or not finite, or there is no such norm.
    """

    radius: float
    norm: Norm = "linf"

    def __post_init__(self) -> None:
        if not 0.0 <= self.radius < float("inf"):
            raise ConfigError(f"budget: the radius must be 0 or more, got {self.radius}; use px(5) for 5 code values")
        if self.norm not in ("linf", "l2"):
            raise ConfigError(f"budget: norm '{self.norm}'; choose linf or l2")

    def project(self, images: Tensor, clean: Tensor) -> Tensor:
        """Project images onto the ball and [0, 1]: exact under L-infinity; under L2 the ball, then the range.

        Args:
            images: [B, 3, H, W].
            clean: [B, 3, H, W], in [0, 1].

        Returns:
            [B, 3, H, W]. Clipping to [0, 1] never moves values away from the clean ones, so both constraints hold.
        """
        return self.around(clean, images - clean)

    def around(self, clean: Tensor, change: Tensor) -> Tensor:
        """Return the images of `project`, given their change.

        Args:
            clean: [B, 3, H, W], in [0, 1].
            change: [B, 3, H, W]; its memory is used up for the result.
        """
        return self.within(change).add_(clean).clamp_(0.0, 1.0)

    def within(self, change: Tensor) -> Tensor:
        """Project a change onto the ball, in place, since images are large.

        Args:
            change: [B, 3, H, W]; overwritten.
        """
        if self.norm == "linf":
            return change.clamp_(-self.radius, self.radius)
        return change.mul_((self.radius / lengths(change).clamp_min(1e-30)).clamp_max(1.0))

    def ascend(self, images: Tensor, gradient: Tensor, clean: Tensor, length: float) -> Tensor:
        """Take one step along the steepest direction and project onto the ball.

        Args:
            images: [B, 3, H, W], start of the step.
            gradient: [B, 3, H, W], gradient at the start.
            clean: [B, 3, H, W].
            length: Length of the step in this norm.

        Returns:
            [B, 3, H, W]. Only the result takes new memory: on a CPU, allocation costs more than the arithmetic.
        """
        return self.around(clean, self.steepest(gradient).mul_(length).add_(images).sub_(clean))

    def steepest(self, gradient: Tensor) -> Tensor:
        """Return the direction of length 1 in this norm along which a linear function rises most.

        Args:
            gradient: [B, 3, H, W].

        Returns:
            [B, 3, H, W]: the sign, or the gradient divided by its length; 0 where the gradient is 0.
        """
        if self.norm == "linf":
            return gradient.sign()
        return gradient / lengths(gradient).clamp_min(1e-30)

    def start(self, draws: Tensor, kind: Literal["uniform", "gaussian"]) -> Tensor:
        """Return a random initial change.

        Args:
            draws: [B, 3, H, W], uniform in [-1, 1] or normal, according to `kind`.
            kind: "uniform": in the cube, or of a length uniform in [0, radius]. "gaussian": standard deviation of
                half the radius, or of length `radius`.

        Returns:
            [B, 3, H, W], to be projected.
        """
        if self.norm == "linf":
            return draws * (self.radius if kind == "uniform" else 0.5 * self.radius)
        relative_length = 1.0 if kind == "gaussian" else draws.flatten(1)[:, :1].abs()[..., None, None]
        return draws / lengths(draws).clamp_min(1e-30) * (self.radius * relative_length)


def lengths(change: Tensor) -> Tensor:
    """Return the Euclidean length [B, 1, 1, 1] of each image's change [B, 3, H, W]."""
    norms: Tensor = torch.linalg.vector_norm(change, dim=(1, 2, 3), keepdim=True)
    return norms


def codes_of(images: Tensor) -> Tensor:
    """Return the code values of clean images.

    Args:
        images: [B, 3, H, W] in [0, 1].

    Returns:
        int32 [B, 3, H, W] in 0..255.

    Raises:
        ConfigError: The images lie outside [0, 1], or are not multiples of 1/255, so that no exact budget exists.
    """
    scaled = images.detach() * LEVELS
    codes = scaled.round()
    lowest, highest = (float(extreme) for extreme in codes.aminmax())
    if not (lowest >= 0 and highest <= LEVELS and float((scaled - codes).abs().max()) < _GRID):
        raise ConfigError("an attack needs clean images of 8 bits: multiples of 1/255 in [0, 1], as files hold them")
    return codes.int()


def quantise(images: Tensor, clean: Tensor, budget: Budget) -> Tensor:
    """Round attacked images to code values that keep the budget exactly.

    Under L-infinity each value is rounded to the nearest allowed one. Under L2 all values are rounded towards the
    clean image; then those with the largest rounding error are rounded the other way while the budget lasts.

    Args:
        images: [B, 3, H, W], result of the attack.
        clean: int32 [B, 3, H, W], code values of the clean images.
        budget: Budget to keep.

    Returns:
        uint8 [B, 3, H, W].
    """
    if budget.norm == "linf":
        max_change = int(budget.radius * LEVELS + 1e-6)
        image_change = (images.detach() * LEVELS).round_().sub_(clean).clamp_(-max_change, max_change)
        return image_change.add_(clean).clamp_(0, LEVELS).to(torch.uint8)
    # Contiguous, because the helpers change flat views of it in place.
    exact_change = ((images.detach().double() * LEVELS).clamp_(0, LEVELS) - clean).contiguous()
    rounded_change = exact_change.trunc()
    squared_limit = (budget.radius * LEVELS) ** 2 * (1 + 1e-12)
    for image_change, image_exact in zip(rounded_change, exact_change, strict=True):
        _shrink(image_change, squared_limit)
        _round_up(image_change, image_exact, squared_limit)
    return (clean + rounded_change).to(torch.uint8)


def _shrink(change: Tensor, room: float) -> None:
    """Take whole steps back, largest first, from a change that is too long by its float's last digits."""
    while float((change**2).sum()) > room:
        values = change.view(-1)
        largest = values.abs().argmax()
        values[largest] -= values[largest].sign()


def _round_up(change: Tensor, full: Tensor, room: float) -> None:
    """Move values of an integer change one step towards `full`, those first that lack most, while there is room."""
    remainder = (full - change).view(-1)
    order = remainder.abs().argsort(descending=True, stable=True)
    order = order[remainder[order].abs() > 0.5]
    values = change.view(-1)
    # (|c| + 1)^2 - c^2: growth of the squared length by one step.
    squared_cost = 2 * values[order].abs() + 1
    affordable = int((squared_cost.cumsum(0) + (values**2).sum() <= room).sum())
    selected = order[:affordable]
    values[selected] += remainder[selected].sign()

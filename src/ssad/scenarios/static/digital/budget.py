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
_WHOLE_BUDGET = 0.999  # share of the radius from which on a change counts as one of the whole radius
_MAX_ROUNDS = 100  # of a search that ends by itself after a few: each round stops further values at 0 or 1


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
        """Return the nearest images that lie in the ball and in [0, 1].

        Under L2, the nearest image scales the change and then clips it. Values that stop at 0 or 1 leave room in the
        ball, which goes to the others: an image from outside the ball lands on its border.

        Args:
            images: [B, 3, H, W].
            clean: [B, 3, H, W], in [0, 1].

        Returns:
            [B, 3, H, W].
        """
        return self.around(clean, images - clean)

    def to_border(self, clean: Tensor, direction: Tensor) -> Tensor:
        """Return images that move from the clean ones along a direction as far as the ball and [0, 1] allow.

        Args:
            clean: [B, 3, H, W], in [0, 1].
            direction: [B, 3, H, W], of any length; only its sign counts under L-infinity.

        Returns:
            [B, 3, H, W]. Under L2 their change has the length `radius`, unless every value that moves stops at 0 or 1.
        """
        if self.norm == "linf":
            return self.around(clean, direction.sign().mul_(self.radius))
        return (direction * self._scale(clean, direction, limit=1e12)).add_(clean).clamp_(0.0, 1.0)

    def around(self, clean: Tensor, change: Tensor) -> Tensor:
        """Return the images of `project`, given their change.

        Args:
            clean: [B, 3, H, W], in [0, 1].
            change: [B, 3, H, W]; its memory is used up for the result.
        """
        if self.norm == "linf":
            return self.within(change).add_(clean).clamp_(0.0, 1.0)
        return change.mul_(self._scale(clean, change, limit=1.0)).add_(clean).clamp_(0.0, 1.0)

    def _scale(self, clean: Tensor, change: Tensor, *, limit: float) -> Tensor:
        """Return the factors [B, 1, 1, 1], at most `limit`, by which changes have length `radius` after clipping.

        Clipping bounds value i by its room b_i, so the length of s * change is the root of the sum of
        min(s |change_i|, b_i)^2. With the values that stop at a given s held at their rooms, the equation has a
        closed solution, which is never too large; each round stops further values until none is added.
        """
        scale = (self.radius / lengths(change).clamp_min(1e-30)).clamp_max(limit)
        if bool((scale >= limit).all()):
            return scale
        size, room = change.abs(), torch.where(change > 0, 1.0 - clean, clean)
        for _ in range(_MAX_ROUNDS):
            stopped = size * scale > room
            squared_rest = self.radius**2 - lengths(torch.where(stopped, room, 0.0)) ** 2
            free_length = lengths(torch.where(stopped, 0.0, size))
            larger = (squared_rest.clamp_min(0.0).sqrt() / free_length.clamp_min(1e-30)).clamp_max(limit)
            if not bool((larger > scale * (1 + 1e-6)).any()):
                break
            scale = torch.maximum(scale, larger)
        return scale

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
    clean image, and what this leaves of the budget is spent on rounding values up: those first that keep most of the
    direction of the change for the length that they cost. Values beyond one half are rounded up while the budget
    lasts; the others until the stored change is as long as that of `images`. A change that is shorter than the budget
    (such as the smallest one that empties an image) stays as short.

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
    exact_change = ((images.detach().double() * LEVELS).clamp_(0, LEVELS) - clean).contiguous()
    limit = budget.radius * LEVELS
    length = lengths(exact_change)
    exact_change *= (limit / length.clamp_min(1e-30)).clamp_max(1.0)
    rounded_change = exact_change.trunc()
    is_whole = length >= _WHOLE_BUDGET * limit
    target = torch.where(is_whole, limit, length).flatten().tolist()
    # Contiguous, because `_round_up` changes flat views of it in place.
    for image_change, image_exact, image_target in zip(rounded_change, exact_change, target, strict=True):
        _round_up(image_change.view(-1), image_exact.view(-1), limit**2, image_target**2)
    return (clean + rounded_change).to(torch.uint8)


def _round_up(change: Tensor, exact: Tensor, limit: float, target: float) -> None:
    """Move values of an integer change one step up to `exact`, within limits of its squared length, in place.

    A step of a value c with remainder r lengthens the squared change by 2 c + 1, and its product with the exact
    change by c + r. The order by their quotient, that is by (2 r - 1) / (2 c + 1), keeps the direction best.

    Args:
        change: [N] float64 integers, `exact` rounded towards 0.
        exact: [N] float64.
        limit: Limit while remainders above one half are rounded up.
        target: Limit for all others.
    """
    remainder = (exact - change).abs()
    squared_cost = 2 * change.abs() + 1
    gain = (2 * remainder - 1) / squared_cost
    candidates = remainder.nonzero().flatten()
    candidates = candidates[gain[candidates].argsort(descending=True, stable=True)]
    is_nearer = gain[candidates] > 0
    steps = exact.sign()
    squared_length = float((change**2).sum())
    for group, squared_limit in ((candidates[is_nearer], limit), (candidates[~is_nearer], target)):
        # The tolerance covers radii whose float is smaller than the length in whole code values.
        room = squared_limit * (1 + 1e-12) - squared_length
        affordable = group[squared_cost[group] <= room]
        while len(affordable):
            costs = squared_cost[affordable].cumsum(0)
            count = int((costs <= room).sum())
            change[affordable[:count]] += steps[affordable[:count]]
            spent = float(costs[count - 1])
            room, squared_length = room - spent, squared_length + spent
            affordable = affordable[count:]
            affordable = affordable[squared_cost[affordable] <= room]

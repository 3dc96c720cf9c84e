"""How far an attack may move a picture, and pictures that keep to it after they are stored with 8 bits a value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ssad.core.errors import ConfigError

Norm = Literal["linf", "l2"]
LEVELS = 255
_GRID = 1e-3  # how far, in code values, a clean picture may lie from a whole one


def px(value: float) -> float:
    """A change in 8-bit code values, as images in [0, 1] have it.

    Args:
        value: Code values of 0..255.

    Returns:
        value / 255.
    """
    return value / LEVELS


@dataclass(frozen=True, slots=True)
class Budget:
    """The ball around a clean picture in which an attack may move.

    Attributes:
        radius: Its size, for images in [0, 1]: `px(5)` is five code values.
        norm: "linf": no value moves further than the radius. "l2": the Euclidean length of the change of a picture,
            over all its values, is at most the radius.

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
        """The nearest images within the ball and within [0, 1]; under L2 near enough: first the ball, then the range.

        Args:
            images: [B, 3, H, W].
            clean: [B, 3, H, W], in [0, 1].

        Returns:
            [B, 3, H, W]. To move values back into [0, 1] never moves them away from the clean ones, so both hold.
        """
        return self.around(clean, images - clean)

    def around(self, clean: Tensor, change: Tensor) -> Tensor:
        """As `project`, of images that are told by their change.

        Args:
            clean: [B, 3, H, W], in [0, 1].
            change: [B, 3, H, W]; its memory is used up for the result.
        """
        return self.within(change).add_(clean).clamp_(0.0, 1.0)

    def within(self, change: Tensor) -> Tensor:
        """The nearest change within the ball.

        Args:
            change: [B, 3, H, W]; it is changed in place, as pictures are large.
        """
        if self.norm == "linf":
            return change.clamp_(-self.radius, self.radius)
        return change.mul_((self.radius / lengths(change).clamp_min(1e-30)).clamp_max(1.0))

    def ascend(self, images: Tensor, gradient: Tensor, clean: Tensor, length: float) -> Tensor:
        """One step along the steepest direction, and back into the ball.

        Args:
            images: [B, 3, H, W] where the step begins.
            gradient: [B, 3, H, W] there.
            clean: [B, 3, H, W].
            length: of the step, in this norm.

        Returns:
            [B, 3, H, W]. Only this takes fresh memory: on a CPU that costs more than the arithmetic.
        """
        return self.around(clean, self.steepest(gradient).mul_(length).add_(images).sub_(clean))

    def steepest(self, gradient: Tensor) -> Tensor:
        """The direction of a step of length 1 in this norm along which a linear function rises most.

        Args:
            gradient: [B, 3, H, W].

        Returns:
            [B, 3, H, W]: the sign, or the gradient divided by its length; 0 where the gradient is.
        """
        if self.norm == "linf":
            return gradient.sign()
        return gradient / lengths(gradient).clamp_min(1e-30)

    def start(self, draws: Tensor, kind: Literal["uniform", "gaussian"]) -> Tensor:
        """A random change to start from.

        Args:
            draws: [B, 3, H, W], uniform in [-1, 1] or normal, as `kind` says.
            kind: "uniform": in the cube, or of a length uniform in [0, radius]. "gaussian": half a radius of deviation,
                or of length `radius`.

        Returns:
            [B, 3, H, W], to be projected.
        """
        if self.norm == "linf":
            return draws * (self.radius if kind == "uniform" else 0.5 * self.radius)
        size = 1.0 if kind == "gaussian" else draws.flatten(1)[:, :1].abs()[..., None, None]
        return draws / lengths(draws).clamp_min(1e-30) * (self.radius * size)


def lengths(change: Tensor) -> Tensor:
    """Euclidean length [B, 1, 1, 1] of each picture's change [B, 3, H, W]."""
    size: Tensor = torch.linalg.vector_norm(change, dim=(1, 2, 3), keepdim=True)
    return size


def codes_of(images: Tensor) -> Tensor:
    """Code values of clean images.

    Args:
        images: [B, 3, H, W] in [0, 1].

    Returns:
        int32 [B, 3, H, W] in 0..255.

    Raises:
        ConfigError: The images lie outside [0, 1], or are not multiples of 1/255: of them no exact budget can be kept.
    """
    scaled = images.detach() * LEVELS
    codes = scaled.round()
    low, high = (float(one) for one in codes.aminmax())
    if not (low >= 0 and high <= LEVELS and float((scaled - codes).abs().max()) < _GRID):
        raise ConfigError("an attack needs clean images of 8 bits: multiples of 1/255 in [0, 1], as files hold them")
    return codes.int()


def quantise(images: Tensor, clean: Tensor, budget: Budget) -> Tensor:
    """Code values of attacked images, within the budget to the last bit.

    Under L-infinity each value is rounded to the nearest one allowed. Under L2 all are rounded towards the clean
    picture; then those that lost most are rounded the other way while the budget lasts.

    Args:
        images: [B, 3, H, W], what the attack found.
        clean: int32 [B, 3, H, W] code values of the clean images.
        budget: What they are held to.

    Returns:
        uint8 [B, 3, H, W].
    """
    if budget.norm == "linf":
        most = int(budget.radius * LEVELS + 1e-6)
        change = (images.detach() * LEVELS).round_().sub_(clean).clamp_(-most, most)
        return change.add_(clean).clamp_(0, LEVELS).to(torch.uint8)
    wanted = ((images.detach().double() * LEVELS).clamp_(0, LEVELS) - clean).contiguous()
    base = wanted.trunc()
    room = (budget.radius * LEVELS) ** 2 * (1 + 1e-12)
    for change, full in zip(base, wanted, strict=True):
        _shrink(change, room)
        _round_up(change, full, room)
    return (clean + base).to(torch.uint8)


def _shrink(change: Tensor, room: float) -> None:
    """Takes whole steps back, largest first, from a change that is too long by its float's last digits."""
    while float((change**2).sum()) > room:
        flat = change.view(-1)
        largest = flat.abs().argmax()
        flat[largest] -= flat[largest].sign()


def _round_up(change: Tensor, full: Tensor, room: float) -> None:
    """Moves values of an integer change one step towards `full`, those first that lack most, while there is room."""
    lacking = (full - change).view(-1)
    order = lacking.abs().argsort(descending=True, stable=True)
    order = order[lacking[order].abs() > 0.5]
    flat = change.view(-1)
    cost = 2 * flat[order].abs() + 1
    many = int((cost.cumsum(0) + (flat**2).sum() <= room).sum())
    chosen = order[:many]
    flat[chosen] += lacking[chosen].sign()

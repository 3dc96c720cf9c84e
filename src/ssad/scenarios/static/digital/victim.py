"""What an attack may ask of the detector it attacks, and what each question costs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from ssad.core.detections import Dense, Truth
from ssad.core.errors import ConfigError
from ssad.core.eval_mode import evaluating
from ssad.core.protocols import Detector
from ssad.core.seeding import generator
from ssad.scenarios.static.digital.budget import LEVELS, codes_of
from ssad.scenarios.static.digital.objectives import EVERYTHING, Aim, Objective, Situation

Through = Callable[[Tensor], Tensor]
Precision = Literal["float32", "bfloat16"]


@dataclass(slots=True)
class Cost:
    """What an attack used, for one image.

    Attributes:
        gradients: forward and backward passes.
        queries: forward passes without a gradient.
    """

    gradients: int = 0
    queries: int = 0


class NothingToAttackError(ConfigError):
    """A loss or an aim needs objects, and there is none in any of the images."""


@dataclass(frozen=True, slots=True)
class Pictures:
    """Clean images and their random numbers: all that an attack is given which asks no detector anything.

    Attributes:
        clean: [B, 3, H, W] in [0, 1].
        keys: For each image what its random draws come from.
    """

    clean: Tensor
    keys: Sequence[tuple[object, ...]]

    def draw(self, kind: str, *use: object) -> Tensor:
        """See `draw`."""
        return draw(self.clean, self.keys, kind, *use)


class Victim:
    """A detector, the images under attack with a frozen target assignment, and the loss that is ascended.

    The loss of an image depends on this image alone, whatever else is in the batch. The detector stays as it was:
    use it within `steady`.

    Args:
        detector: What is attacked.
        images: [B, 3, H, W] float32 in [0, 1], multiples of 1/255.
        truth: What is in each image, with labels of the detector's classes.
        objective: The loss to ascend.
        intrinsic: [B, 3, 3], for 3D.
        aim: Which objects are attacked.
        keys: For each image what its random draws come from; default: its number in the batch.
        through: What every picture passes on its way to the detector (a defence that the attack knows).
        precision: What the detector computes gradients in, as far as autocast takes it; losses that are asked for
            without a gradient, and the target assignment, are exact in any case.

    Attributes:
        clean: [B, 3, H, W] the images, equal to their code values over 255.
        codes: int32 [B, 3, H, W].
        idle: [B] images in which there is nothing to attack: they are handed back as they are.
        cost: for each image (all images of a batch cost the same).

    Raises:
        ConfigError: Images of another type or not of 8 bits, none at all, truth of another number of images, or no
            object under attack in any image for a loss that needs some.
    """

    def __init__(
        self,
        detector: Detector,
        images: Tensor,
        truth: Sequence[Truth],
        objective: Objective,
        *,
        intrinsic: Tensor | None = None,
        aim: Aim = EVERYTHING,
        keys: Sequence[tuple[object, ...]] | None = None,
        through: Through | None = None,
        precision: Precision = "float32",
    ) -> None:
        if images.ndim != 4 or images.shape[1] != 3 or not images.is_floating_point() or 0 in images.shape:
            raise ConfigError(f"an attack takes images [B, 3, H, W] of floats, not {list(images.shape)} {images.dtype}")
        if len(truth) != len(images):
            raise ConfigError(f"an attack on {len(images)} images got the truth of {len(truth)}")
        self.codes = codes_of(images)
        self.clean = (self.codes.to(images.dtype) / LEVELS).contiguous(memory_format=torch.channels_last)
        self.detector, self.objective, self.intrinsic, self.through = detector, objective, intrinsic, through
        self.keys = [(k,) for k in range(len(images))] if keys is None else list(keys)
        self.cost, self.precision = Cost(), precision
        with torch.no_grad():
            dense = self._dense(self.clean)
            assignment = detector.assign(dense, truth)
            self.situation = Situation(detector, assignment, aim)
            needed = objective.needs_objects or not aim.everything
            self.idle = ~aim.places(detector, assignment).any(1) if needed else torch.zeros(len(images)) > 0
        self.idle = self.idle.to(images.device)
        if bool(self.idle.all()):
            raise NothingToAttackError(
                f"loss '{objective.name}' attacks objects, and no location of these images is assigned to one"
            )

    def __len__(self) -> int:
        return len(self.clean)

    def _dense(self, images: Tensor) -> Dense:
        return self.detector.dense(images if self.through is None else self.through(images), self.intrinsic)

    def loss(self, images: Tensor) -> Tensor:
        """The loss [B] of images, without a gradient: one query each."""
        self.cost.queries += 1
        with torch.no_grad():
            return self.objective(self._dense(images), self.situation).detach()

    def gradient(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Loss [B] and its gradient [B, 3, H, W] at images.

        Raises:
            ConfigError: The loss does not depend on the images as far as the detector tells, or is not finite.
        """
        self.cost.gradients += 1
        images = images.detach().requires_grad_()
        with torch.enable_grad():
            with torch.autocast(images.device.type, torch.bfloat16, enabled=self.precision == "bfloat16"):
                dense = self._dense(images)
            loss = self.objective(dense, self.situation)
            found: tuple[Tensor | None, ...] = (None,)
            if loss.requires_grad:
                found = torch.autograd.grad(loss.sum(), images, allow_unused=True)
        if found[0] is None:
            raise ConfigError(
                f"{self.detector.name} gives no gradient of loss '{self.objective.name}' to the image; a white-box "
                "attack needs one: choose a black-box attack (square, nes)"
            )
        if not bool(found[0].sum().isfinite()):
            raise ConfigError(f"{self.detector.name}: the gradient of loss '{self.objective.name}' is not finite")
        return loss.detach(), found[0]

    def draw(self, kind: str, *use: object) -> Tensor:
        """Random numbers [B, 3, H, W] of each image; see `draw`."""
        return draw(self.clean, self.keys, kind, *use)

    @staticmethod
    def generator(key: tuple[object, ...], *use: object) -> np.random.Generator:
        """The generator of an image's key for one use."""
        return generator("digital attack", *key, *use)


def draw(clean: Tensor, keys: Sequence[tuple[object, ...]], kind: str, *use: object) -> Tensor:
    """Random numbers [B, 3, H, W] of each image, from its own key: the same in any batch.

    Args:
        clean: [B, 3, H, W]: shape, type and device of what is drawn.
        keys: Of each image.
        kind: "uniform" in [-1, 1], or "gaussian".
        *use: What they are for.
    """
    draws = np.empty(tuple(clean.shape), np.float32)
    for own, key in zip(draws, keys, strict=True):
        chance = Victim.generator(key, *use)
        if kind == "uniform":
            chance.random(dtype=np.float32, out=own)
        else:
            chance.standard_normal(dtype=np.float32, out=own)
    found = torch.from_numpy(draws)
    if kind == "uniform":
        found.mul_(2).sub_(1)
    return found.to(clean).contiguous(memory_format=torch.channels_last)


@contextmanager
def steady(detector: Any) -> Iterator[None]:
    """Keep every part of a detector in eval mode, and its parameters without gradients, within the block.

    Afterwards modes, flags, gradients and buffers are restored, whatever an attack or the detector did.
    """
    roots = [detector] if isinstance(detector, nn.Module) else []
    roots += [value for value in getattr(detector, "__dict__", {}).values() if isinstance(value, nn.Module)]
    flags = [(one, one.requires_grad, one.grad) for root in roots for one in root.parameters()]
    buffers = [(one, one.clone()) for root in roots for one in root.buffers()]
    for weight, _, _ in flags:
        weight.requires_grad_(False)
    try:
        with ExitStack() as stack:
            for root in roots:
                stack.enter_context(evaluating(root))
            yield
    finally:
        for weight, flag, grad in flags:
            weight.requires_grad_(flag)
            weight.grad = grad
        with torch.no_grad():
            for one, kept in buffers:
                one.copy_(kept)

"""Interface of an attack to the detector under attack, with the cost of each query."""

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
from ssad.core.eval_mode import in_eval_mode
from ssad.core.protocols import Detector
from ssad.core.seeding import generator
from ssad.scenarios.static.digital.budget import LEVELS, codes_of
from ssad.scenarios.static.digital.objectives import EVERYTHING, Aim, Objective, Situation

Through = Callable[[Tensor], Tensor]
Precision = Literal["float32", "bfloat16"]


@dataclass(slots=True)
class Cost:
    """Cost of an attack, for one image.

    Attributes:
        gradients: Forward and backward passes.
        queries: Forward passes without a gradient.
    """

    gradients: int = 0
    queries: int = 0


class NothingToAttackError(ConfigError):
    """Error of a loss or an aim that needs objects when no image contains one."""


@dataclass(frozen=True, slots=True)
class CleanImages:
    """Clean images and their random keys: the input of attacks that do not query a detector.

    Attributes:
        clean: [B, 3, H, W] in [0, 1].
        keys: Random key of each image.
    """

    clean: Tensor
    keys: Sequence[tuple[object, ...]]

    def draw(self, kind: str, *purpose: object) -> Tensor:
        """See `draw`."""
        return draw(self.clean, self.keys, kind, *purpose)


class Victim:
    """Detector, images under attack with a frozen target assignment, and the loss to ascend.

    The loss of an image depends on this image alone, not on the rest of the batch. The detector must be used within
    `steady`, which keeps it unchanged.

    Args:
        detector: Detector under attack.
        images: [B, 3, H, W] float32 in [0, 1], multiples of 1/255.
        truth: Ground truth of each image, with labels of the detector's classes.
        objective: Loss to ascend.
        intrinsic: [B, 3, 3], for 3D.
        aim: Objects under attack.
        keys: Random key of each image; default: its index in the batch.
        through: Defence that every image passes before the detector and that the attack knows.
        precision: Precision of gradients, as far as autocast supports it; losses without a gradient and the target
            assignment are always exact.

    Attributes:
        clean: [B, 3, H, W] images, equal to their code values over 255.
        codes: int32 [B, 3, H, W].
        idle: [B] mask of the images without anything to attack, which are returned unchanged.
        cost: Cost per image (the same for all images of a batch).

    Raises:
        ConfigError: Images of another type or not of 8 bits, no images, truth of another number of images, or no
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
        self.keys = [(index,) for index in range(len(images))] if keys is None else list(keys)
        self.cost, self.precision = Cost(), precision
        with torch.no_grad():
            dense = self._dense(self.clean)
            assignment = detector.assign(dense, truth)
            self.situation = Situation(detector, assignment, aim)
            needs_objects = objective.needs_objects or not aim.attacks_all
            self.idle = ~aim.places(detector, assignment).any(1) if needs_objects else torch.zeros(len(images)) > 0
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
        """Return the loss [B] of images without a gradient; costs one query each."""
        self.cost.queries += 1
        with torch.no_grad():
            return self.objective(self._dense(images), self.situation).detach()

    def gradient(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return the loss [B] and its gradient [B, 3, H, W] at images.

        Raises:
            ConfigError: The loss does not depend on the images, or its gradient is not finite.
        """
        self.cost.gradients += 1
        images = images.detach().requires_grad_()
        with torch.enable_grad():
            with torch.autocast(images.device.type, torch.bfloat16, enabled=self.precision == "bfloat16"):
                dense = self._dense(images)
            # Outside autocast: only the detector runs in reduced precision.
            loss = self.objective(dense, self.situation)
            gradients: tuple[Tensor | None, ...] = (None,)
            if loss.requires_grad:
                gradients = torch.autograd.grad(loss.sum(), images, allow_unused=True)
        if gradients[0] is None:
            raise ConfigError(
                f"{self.detector.name} gives no gradient of loss '{self.objective.name}' to the image; a white-box "
                "attack needs one: choose a black-box attack (square, nes)"
            )
        if not bool(gradients[0].sum().isfinite()):
            raise ConfigError(f"{self.detector.name}: the gradient of loss '{self.objective.name}' is not finite")
        return loss.detach(), gradients[0]

    def draw(self, kind: str, *purpose: object) -> Tensor:
        """Return random numbers [B, 3, H, W] of each image; see `draw`."""
        return draw(self.clean, self.keys, kind, *purpose)

    @staticmethod
    def generator(key: tuple[object, ...], *purpose: object) -> np.random.Generator:
        """Return the generator of an image's key for one purpose."""
        return generator("digital attack", *key, *purpose)


def draw(clean: Tensor, keys: Sequence[tuple[object, ...]], kind: str, *purpose: object) -> Tensor:
    """Return random numbers [B, 3, H, W] of each image, from its own key: the same in any batch.

    Args:
        clean: [B, 3, H, W]: shape, type and device of the result.
        keys: Key of each image.
        kind: "uniform" in [-1, 1], or "gaussian".
        *purpose: Purpose of the numbers.
    """
    draws = np.empty(tuple(clean.shape), np.float32)
    for image_draws, key in zip(draws, keys, strict=True):
        image_generator = Victim.generator(key, *purpose)
        if kind == "uniform":
            image_generator.random(dtype=np.float32, out=image_draws)
        else:
            image_generator.standard_normal(dtype=np.float32, out=image_draws)
    result = torch.from_numpy(draws)
    if kind == "uniform":
        result.mul_(2).sub_(1)
    return result.to(clean).contiguous(memory_format=torch.channels_last)


@contextmanager
def steady(detector: Any) -> Iterator[None]:
    """Keep every part of a detector in eval mode, with frozen parameters, within the block.

    Modes, flags, gradients and buffers are restored afterwards.
    """
    roots = [detector] if isinstance(detector, nn.Module) else []
    # A wrapper that is no module itself may hold its networks as attributes.
    roots += [value for value in getattr(detector, "__dict__", {}).values() if isinstance(value, nn.Module)]
    flags = [(tensor, tensor.requires_grad, tensor.grad) for module in roots for tensor in module.parameters()]
    buffers = [(tensor, tensor.clone()) for module in roots for tensor in module.buffers()]
    for parameter, _, _ in flags:
        parameter.requires_grad_(False)
    try:
        with ExitStack() as stack:
            for module in roots:
                stack.enter_context(in_eval_mode(module))
            yield
    finally:
        for parameter, requires_grad, gradient in flags:
            parameter.requires_grad_(requires_grad)
            parameter.grad = gradient
        with torch.no_grad():
            for tensor, saved in buffers:
                tensor.copy_(saved)

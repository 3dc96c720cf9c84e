"""Defences that transform an image before the detector, with gradients for attacks that know them.

    Defended(detector, Jpeg(75))    # a detector like any other
    run_attack(PGD(), detector, images, truth, budget, through=Jpeg(75))
    run_attack(Expected(PGD(), resize), detector, images, truth, budget, through=resize)    # see expectation.py

Rounding is exact and has slope one (straight-through), since the true slope of a staircase is 0 almost everywhere
(Athalye et al., Obfuscated Gradients Give a False Sense of Security, ICML 2018). No defence moves content within
the image: boxes and intrinsics stay valid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn import functional

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.core.registry import Reference, check_arguments, make, resolve
from ssad.core.seeding import generator
from ssad.rendering.camera.torch_jpeg import jpeg, quantisation
from ssad.scenarios.static.digital.budget import LEVELS

SMALLEST = 8  # pixels of a side below which pictures are not shrunk


class Defence(Protocol):
    """Transformation of every image before it reaches the detector.

    Attributes:
        name: Name shown in tables.
        smooth: True if its gradient agrees with finite differences. It does not where the defence rounds or draws at
            random; the check before an attack then covers the detector alone.
    """

    @property
    def name(self) -> str:
        """Name shown in tables."""

    @property
    def smooth(self) -> bool:
        """True if its gradient agrees with finite differences."""

    def __call__(self, images: Tensor) -> Tensor:
        """Transform images [B, 3, H, W] in [0, 1] into images of the same shape, differentiably.

        Each output depends on its own image alone.
        """


@runtime_checkable
class RandomDefence(Defence, Protocol):
    """Defence that draws at random, and can hold a draw for an attack that averages over several."""

    def fixed_draw(self, number: int) -> Callable[[Tensor], Tensor]:
        """Return the transformation of one draw, the same for all images.

        Args:
            number: Number of the draw.
        """


@dataclass(frozen=True, slots=True)
class Jpeg:
    """JPEG compression and decompression of an image as libjpeg computes them.

    Attributes:
        quality: 1 to 100.
        subsampling: Chroma subsampling, "420" or "444".

    Raises:
        ConfigError: There is no such quality or subsampling.

    Source: Das et al., Keeping the Bad Guys Out (2017); gradients as in Shin and Song, JPEG-resistant Adversarial
    Images (2017), with straight-through rounding.
    """

    quality: int = 75
    subsampling: Literal["420", "444"] = "420"
    smooth: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        quantisation(self.quality)
        if self.subsampling not in ("420", "444"):
            raise ConfigError(f"defence jpeg: subsampling '{self.subsampling}'; choose 420 or 444")

    @property
    def name(self) -> str:
        """Name shown in tables."""
        return f"jpeg-{self.quality}"

    def __call__(self, images: Tensor) -> Tensor:
        """Compress and decompress images."""
        return jpeg(images, self.quality, self.subsampling)


@dataclass(frozen=True, slots=True)
class BitDepth:
    """Quantisation of each value to fewer levels.

    Attributes:
        bits: 1 to 8.

    Raises:
        ConfigError: Another number of bits.

    Source: Xu et al., Feature Squeezing (NDSS 2018), section II.A.
    """

    bits: int = 5
    smooth: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= 8:
            raise ConfigError(f"defence bits: {self.bits} bits; it must be in 1..8")

    @property
    def name(self) -> str:
        """Name shown in tables."""
        return f"bits-{self.bits}"

    def __call__(self, images: Tensor) -> Tensor:
        """Round images to the levels of `bits`."""
        steps = 2**self.bits - 1
        rounded = (images * steps).round() / steps
        # Straight-through: the value is rounded, the gradient is that of the identity.
        quantised: Tensor = rounded.detach() + (images - images.detach())
        return quantised


@dataclass(frozen=True, slots=True)
class Blur:
    """Gaussian blur; the border repeats the last row and column.

    Attributes:
        sigma: Standard deviation in pixels; the kernel ends after three of them.

    Raises:
        ConfigError: Sigma is not above 0.

    Source: Xu et al., Feature Squeezing (NDSS 2018), section II.B.
    """

    sigma: float = 1.0
    smooth: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.sigma < math.inf:
            raise ConfigError(f"defence blur: sigma must be above 0, got {self.sigma}")

    @property
    def name(self) -> str:
        """Name shown in tables."""
        return f"blur-{self.sigma:g}"

    def __call__(self, images: Tensor) -> Tensor:
        """Blur images along rows, then along columns."""
        reach = math.ceil(3 * self.sigma)
        offsets = torch.arange(-reach, reach + 1, dtype=torch.float64)
        kernel = torch.exp(-0.5 * (offsets / self.sigma) ** 2)
        kernel = (kernel / kernel.sum()).to(images)
        blurred_rows: Tensor = (
            functional.pad(images, (reach, reach, reach, reach), mode="replicate").unfold(2, len(kernel), 1) @ kernel
        )
        return _in_range(blurred_rows.unfold(3, len(kernel), 1) @ kernel)


@dataclass(frozen=True, slots=True)
class RandomResize:
    """Reduction of each image to a random size and enlargement back, so that its content does not move.

    Called as a defence, the size comes from `seed` and the image's own 8-bit codes: an image is always treated in the
    same way, and an attack cannot predict the size for another. For an attack that knows everything but the draw, see
    `expectation.Expected`.

    Attributes:
        smallest: Lower bound of the relative size; sizes are uniform up to 1.
        seed: Seed of the draws.

    Raises:
        ConfigError: A share outside (0, 1).

    Source: Xie et al., Mitigating Adversarial Effects Through Randomization (ICLR 2018); they pad at random, which
    moves boxes, while this enlarges again.
    """

    smallest: float = 0.6
    seed: int = 0
    smooth: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.smallest < 1.0:
            raise ConfigError(f"defence resize: the smallest share must be above 0 and below 1, got {self.smallest}")

    @property
    def name(self) -> str:
        """Name shown in tables."""
        return f"resize-{self.smallest:g}"

    def __call__(self, images: Tensor) -> Tensor:
        """Resize each image by the share that its own codes determine."""
        codes = (images.detach() * LEVELS).round().clamp(0, LEVELS).to(torch.uint8).cpu()
        shares = [self._draw_share(tuple(image.shape), image.numpy().tobytes()) for image in codes]
        return torch.cat(
            [self._resize_and_restore(image[None], share) for image, share in zip(images, shares, strict=True)]
        )

    def fixed_draw(self, number: int) -> Callable[[Tensor], Tensor]:
        """Return the transformation of one draw, the same for all images.

        Args:
            number: Number of the draw.
        """
        share = self._draw_share("draw", number)
        return lambda images: torch.cat([self._resize_and_restore(image[None], share) for image in images])

    def _draw_share(self, *key: object) -> float:
        return float(generator("random resize", self.seed, *key).uniform(self.smallest, 1.0))

    @staticmethod
    def _resize_and_restore(image: Tensor, share: float) -> Tensor:
        full_size = (int(image.shape[2]), int(image.shape[3]))
        reduced_size = tuple(max(round(share * side), min(side, SMALLEST)) for side in full_size)
        reduced = functional.interpolate(image, size=reduced_size, mode="bilinear", antialias=True)
        return _in_range(functional.interpolate(reduced, size=full_size, mode="bilinear"))


def _in_range(images: Tensor) -> Tensor:
    """Clip rounding excess of means of values in [0, 1]; the gradient passes everywhere."""
    # A plain clamp would have no gradient at values that rounding put just outside [0, 1].
    return images.clamp(0.0, 1.0).detach() + (images - images.detach())


_HERE = "ssad.scenarios.static.digital.defences"
DEFENCES: dict[str, str] = {
    "jpeg": f"{_HERE}:Jpeg",
    "bits": f"{_HERE}:BitDepth",
    "blur": f"{_HERE}:Blur",
    "resize": f"{_HERE}:RandomResize",
}


def make_defence(name: str, **options: Any) -> Defence:
    """Create a defence by name.

    Args:
        name: Key of `DEFENCES`, entry point of the group `ssad.defences`, or "module:object"; arguments may follow.
        **options: Arguments of its class or function.

    Raises:
        UnknownNameError: There is no such defence.
        ConfigError: An option is unknown or has an invalid value.
    """
    reference = Reference.parse(name)
    target = resolve("defence", DEFENCES, reference.name)
    check_arguments("defence", name, target, extra_arguments=options)
    defence: Defence = make(
        "defence", reference.name, target, {**reference.options, **options}, ("name", "smooth", "__call__")
    )
    return defence


class Defended:
    """Detector behind a defence, itself a detector: every image passes the defence first.

    Args:
        detector: Detector that receives the defended images.
        defence: Transformation before it; it moves no content, so intrinsics and boxes stay valid.
    """

    def __init__(self, detector: Detector, defence: Defence) -> None:
        self.detector, self.defence = detector, defence
        self.name = f"{detector.name}+{defence.name}"
        self.task, self.classes = detector.task, detector.classes
        # held here as well, so that `steady` finds them
        attributes = [] if isinstance(detector, nn.Module) else list(getattr(detector, "__dict__", {}).values())
        self._parts = [attribute for attribute in attributes if isinstance(attribute, nn.Module)]
        for index, part in enumerate(self._parts):
            setattr(self, f"_part_{index}", part)

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """Detect objects in the defended images."""
        with torch.no_grad():
            defended = self._defend(images)
        return self.detector.predict(defended, intrinsic, threshold=threshold)

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Return the dense outputs for the defended images."""
        return self.detector.dense(self._defend(images), intrinsic)

    def _defend(self, images: Tensor) -> Tensor:
        """Validate images and pass them through the defence, which might hide a wrong shape or type."""
        if images.ndim != 4 or images.shape[1] != 3 or not images.is_floating_point() or 0 in images.shape:
            raise ConfigError(f"images are [B, 3, H, W] of floats, not {list(images.shape)} {images.dtype}")
        return self.defence(images)

    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Assign targets with the wrapped detector."""
        return self.detector.assign(dense, truth)

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """Return the training losses of the wrapped detector."""
        return self.detector.losses(dense, assignment, reduction=reduction)

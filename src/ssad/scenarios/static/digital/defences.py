"""Defences that a picture passes before the detector, with gradients for attacks that know them.

    Defended(detector, Jpeg(75))    # a detector like any other
    run_attack(PGD(), detector, images, truth, budget, through=Jpeg(75))
    run_attack(Expected(PGD(), resize), detector, images, truth, budget, through=resize)    # see expectation.py

Rounding is done for real and has slope one (straight-through): the true slope of a staircase is 0 almost everywhere
(Athalye et al., Obfuscated Gradients Give a False Sense of Security, ICML 2018). None of them moves anything in the
picture: boxes and intrinsics stay what they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.protocols import Detector
from ssad.core.seeding import generator
from ssad.rendering.camera.torch_jpeg import jpeg, quantisation
from ssad.scenarios.static.digital.budget import LEVELS

SMALLEST = 8  # pixels of a side below which pictures are not shrunk


class Defence(Protocol):
    """What every picture passes before it reaches the detector.

    Attributes:
        name: What tables call it.
        smooth: Whether its gradient agrees with finite differences. It does not where the defence rounds or draws at
            random; the check before an attack then covers the detector alone.
    """

    @property
    def name(self) -> str:
        """What tables call it."""

    @property
    def smooth(self) -> bool:
        """Whether its gradient agrees with finite differences."""

    def __call__(self, images: Tensor) -> Tensor:
        """Images [B, 3, H, W] in [0, 1] to images of the same shape, each from its own image alone; differentiable."""


@dataclass(frozen=True, slots=True)
class Jpeg:
    """The picture is written as JPEG and read again, as libjpeg does both.

    Attributes:
        quality: 1 to 100.
        subsampling: of the colours, "420" or "444".

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
        """What tables call it."""
        return f"jpeg-{self.quality}"

    def __call__(self, images: Tensor) -> Tensor:
        """See `Defence`."""
        return jpeg(images, self.quality, self.subsampling)


@dataclass(frozen=True, slots=True)
class BitDepth:
    """Fewer levels for each value.

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
        """What tables call it."""
        return f"bits-{self.bits}"

    def __call__(self, images: Tensor) -> Tensor:
        """See `Defence`."""
        steps = 2**self.bits - 1
        rounded = (images * steps).round() / steps
        found: Tensor = rounded.detach() + (images - images.detach())
        return found


@dataclass(frozen=True, slots=True)
class Blur:
    """A Gaussian blur; what lies beyond the border repeats the last row and column.

    Attributes:
        sigma: in pixels; the kernel ends after three of them.

    Raises:
        ConfigError: It is not above 0.

    Source: Xu et al., Feature Squeezing (NDSS 2018), section II.B.
    """

    sigma: float = 1.0
    smooth: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.sigma < math.inf:
            raise ConfigError(f"defence blur: sigma must be above 0, got {self.sigma}")

    @property
    def name(self) -> str:
        """What tables call it."""
        return f"blur-{self.sigma:g}"

    def __call__(self, images: Tensor) -> Tensor:
        """See `Defence`."""
        reach = math.ceil(3 * self.sigma)
        away = torch.arange(-reach, reach + 1, dtype=torch.float64)
        line = torch.exp(-0.5 * (away / self.sigma) ** 2)
        line = (line / line.sum()).to(images)
        wide: Tensor = (
            functional.pad(images, (reach, reach, reach, reach), mode="replicate").unfold(2, len(line), 1) @ line
        )
        return _in_range(wide.unfold(3, len(line), 1) @ line)


@dataclass(frozen=True, slots=True)
class RandomResize:
    """Each picture is shrunk to a random size and enlarged to its own again, so that nothing moves in it.

    Called as a defence, the size comes from `seed` and the picture's own 8-bit codes: the same picture is always
    treated alike, and each other one anew, which an attack cannot foresee. For an attack that knows all but the draw,
    see `expectation.Expected`.

    Attributes:
        smallest: share of the size that is the least drawn; shares are uniform up to 1.
        seed: of the draws.

    Raises:
        ConfigError: A share outside (0, 1).

    Source: Xie et al., Mitigating Adversarial Effects Through Randomization (ICLR 2018); they pad at random, which
    moves boxes, where this enlarges again.
    """

    smallest: float = 0.6
    seed: int = 0
    smooth: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.smallest < 1.0:
            raise ConfigError(f"defence resize: the smallest share must be above 0 and below 1, got {self.smallest}")

    @property
    def name(self) -> str:
        """What tables call it."""
        return f"resize-{self.smallest:g}"

    def __call__(self, images: Tensor) -> Tensor:
        """See `Defence`."""
        codes = (images.detach() * LEVELS).round().clamp(0, LEVELS).to(torch.uint8).cpu()
        shares = [self._share(tuple(one.shape), one.numpy().tobytes()) for one in codes]
        return torch.cat([self._through(one[None], share) for one, share in zip(images, shares, strict=True)])

    def drawn(self, number: int) -> Callable[[Tensor], Tensor]:
        """What it does to every picture in one draw, whatever is in it.

        Args:
            number: Of the draw.
        """
        share = self._share("draw", number)
        return lambda images: torch.cat([self._through(one[None], share) for one in images])

    def _share(self, *key: object) -> float:
        return float(generator("random resize", self.seed, *key).uniform(self.smallest, 1.0))

    @staticmethod
    def _through(image: Tensor, share: float) -> Tensor:
        whole = (int(image.shape[2]), int(image.shape[3]))
        small = tuple(max(round(share * side), min(side, SMALLEST)) for side in whole)
        less = functional.interpolate(image, size=small, mode="bilinear", antialias=True)
        return _in_range(functional.interpolate(less, size=whole, mode="bilinear"))


def _in_range(images: Tensor) -> Tensor:
    """Means of values in [0, 1] without their last digit's excess, and with the gradient even where they are white."""
    return images.clamp(0.0, 1.0).detach() + (images - images.detach())


DEFENCES: dict[str, Callable[..., Any]] = {"jpeg": Jpeg, "bits": BitDepth, "blur": Blur, "resize": RandomResize}


def make_defence(name: str, **options: Any) -> Defence:
    """A defence by name.

    Args:
        name: Of `DEFENCES`.
        **options: What its constructor takes.

    Raises:
        UnknownNameError: There is no such defence.
        ConfigError: An option that it does not have, or a value that it refuses.
    """
    if name not in DEFENCES:
        raise unknown_name("defence", name, DEFENCES)
    try:
        made: Defence = DEFENCES[name](**options)
    except TypeError as error:
        raise ConfigError(f"defence {name}: {error}") from None
    return made


class Defended:
    """A detector behind a defence, which is a detector itself: whatever it is shown passes the defence first.

    Args:
        detector: What is behind.
        defence: What stands before it; it moves nothing in the picture, so intrinsics and boxes stay what they are.
    """

    def __init__(self, detector: Detector, defence: Defence) -> None:
        self.detector, self.defence = detector, defence
        self.name = f"{detector.name}+{defence.name}"
        self.task, self.classes = detector.task, detector.classes
        # held here as well, so that `steady` finds them
        inside = [] if isinstance(detector, nn.Module) else list(getattr(detector, "__dict__", {}).values())
        self._parts = [one for one in inside if isinstance(one, nn.Module)]
        for number, part in enumerate(self._parts):
            setattr(self, f"_part_{number}", part)

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """See `Detector`."""
        with torch.no_grad():
            shown = self._shown(images)
        return self.detector.predict(shown, intrinsic, threshold=threshold)

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """See `Detector`."""
        return self.detector.dense(self._shown(images), intrinsic)

    def _shown(self, images: Tensor) -> Tensor:
        """What the detector sees; a defence might hide from it that these are no images."""
        if images.ndim != 4 or images.shape[1] != 3 or not images.is_floating_point() or 0 in images.shape:
            raise ConfigError(f"images are [B, 3, H, W] of floats, not {list(images.shape)} {images.dtype}")
        return self.defence(images)

    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """See `Detector`."""
        return self.detector.assign(dense, truth)

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """See `Detector`."""
        return self.detector.losses(dense, assignment, reduction=reduction)

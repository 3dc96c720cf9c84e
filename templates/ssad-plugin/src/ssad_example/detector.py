"""A detector: the shipped YOLOv5n behind a filter that smooths its images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from torch import Tensor
from torch.nn.functional import avg_pool2d

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.detectors import make_detector


class Smoothed:
    """A detector that sees each image as the mean over squares of pixels.

    Args:
        inner: The detector behind the filter.
        width: Of the squares, pixels; odd.
    """

    def __init__(self, inner: Any, width: int) -> None:
        self.inner, self.width = inner, width
        self.name, self.task, self.classes = f"{inner.name}-smoothed", inner.task, inner.classes

    def to(self, device: str) -> Smoothed:
        """The same on a device; `--device` asks for it."""
        return Smoothed(self.inner.to(device), self.width)

    def parameters(self) -> Any:
        """Those of the network, frozen."""
        return self.inner.parameters()

    def _smooth(self, images: Tensor) -> Tensor:
        if not images.is_floating_point() or images.ndim != 4:
            return images  # which the detector refuses
        return avg_pool2d(images, self.width, stride=1, padding=self.width // 2, count_include_pad=False)

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """What is found in each image, best first."""
        found: list[Detections] = self.inner.predict(self._smooth(images), intrinsic, threshold=threshold)
        return found

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Raw outputs, with a gradient to the images through the filter: attacks know of it."""
        raw: Dense = self.inner.dense(self._smooth(images), intrinsic)
        return raw

    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Which true object each place should predict."""
        assigned: Assignment = self.inner.assign(dense, truth)
        return assigned

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """The training losses."""
        parts: dict[str, Tensor] = self.inner.losses(dense, assignment, reduction=reduction)
        return parts


def smoothed(detector: str = "yolov5n", *, width: int = 3) -> Smoothed:
    """A detector by its name, behind the filter; in a suite `example-smoothed?width=5`."""
    return Smoothed(make_detector(detector), width)

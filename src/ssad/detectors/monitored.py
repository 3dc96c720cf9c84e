"""A detector whose failure is a result: used where a stranger's detector must not stop a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ssad.core.detections import Detections, Solids
from ssad.core.errors import SSADError
from ssad.detectors.check import promises


class MonitoredDetector:
    """Detector whose failure is a result: after an error or a broken promise it returns no more detections.

    Exhausted memory and a lost device are raised. Detections are on the host.

    Attributes:
        name: of the system.
        reason: reason of its failure, in one line; "" while it works.
    """

    def __init__(self, detector: Any, name: str = "") -> None:
        self.detector, self.name, self.reason = detector, name, ""

    @property
    def task(self) -> str:
        """Task of the detector."""
        return str(getattr(self.detector, "task", "3d"))

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes of the detector."""
        return tuple(self.detector.classes)

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """Return the detector's predictions, or empty ones after a failure."""
        if not self.reason:
            try:
                detections = Detections.cpu(self.detector.predict(images, intrinsic, threshold=threshold))
                self.reason = self._find_broken_promise(detections, len(images))
                if not self.reason:
                    return detections
            except Exception as error:  # whatever a stranger's detector raises
                self.failed(error)
        empty_floats, empty_integers = torch.zeros(0), torch.zeros(0, dtype=torch.int64)
        solid = None
        if self.task != "2d":
            solid = Solids(
                empty_floats.reshape(0, 3),
                empty_floats.reshape(0, 3),
                empty_floats,
                empty_floats.reshape(0, 2),
                empty_integers,
            )
        return [Detections(empty_floats, empty_integers, empty_floats.reshape(0, 4), solid)] * len(images)

    def failed(self, error: Exception) -> None:
        """Record an error of the detector; raise it if memory is exhausted or the device is lost."""
        if isinstance(error, MemoryError | torch.OutOfMemoryError) or "CUDA error" in str(error):
            raise error
        text = " ".join(str(error).split())
        self.reason = text if isinstance(error, SSADError) else f"{type(error).__name__}: {text}"[:300]

    def _find_broken_promise(self, detections: Sequence[Detections], images: int) -> str:
        if len(detections) != images:
            return "broken promise: predict answers for each image"
        for image_detections in detections:
            for is_kept, promise in promises(
                image_detections, classes=len(self.detector.classes), is_3d=self.task != "2d"
            ):
                if not is_kept:
                    return f"broken promise: {promise}"
        return ""

"""Perceiving systems by name; what they are made of can be chosen in Python, or in suites of kind `gap`."""

from __future__ import annotations

from typing import Any, ClassVar

from ssad.drivers.perceiving.driver import Perceiving
from ssad.drivers.perceiving.eyes import CameraEyes, PerfectEyes, front
from ssad.drivers.perceiving.tracker import Tracking, tracking_of


class OneCamera(Perceiving):
    """One front camera and a detector with the weights that ship.

    Attributes:
        weights: Name of the detector; results depend on them.
    """

    weights: ClassVar[str]

    def __init__(self, *, width: int = 640, tracking: Tracking | None = None, **settings: Any) -> None:
        own = tracking or tracking_of(self.weights)
        super().__init__(CameraEyes(self.weights, front(width), threshold=own.low), tracking=own, **settings)


class Fcos3d(OneCamera):
    """One front camera, FCOS3D light."""

    weights = "fcos3d-light"


class PgdDet(OneCamera):
    """One front camera, PGD-Det light."""

    weights = "pgd-det-light"


class Yolov5n(OneCamera):
    """One front camera, YOLOv5n, whose boxes are lifted by the ground plane."""

    weights = "yolov5n"


class Perfect(Perceiving):
    """One front camera, and a detector that is told the truth: the ceiling of all others with this camera."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(PerfectEyes(), **settings)

"""Perceiving systems by name; their components can be chosen in Python, or in suites of kind `gap`."""

from __future__ import annotations

from typing import Any, ClassVar

from ssad.drivers.perceiving.driver import Perceiving
from ssad.drivers.perceiving.eyes import CameraEyes, PerfectEyes, front
from ssad.drivers.perceiving.tracker import Tracking, tracking_of


class OneCamera(Perceiving):
    """System with one front camera and a detector with shipped weights.

    Attributes:
        weights: Name of the detector; results depend on them.
    """

    weights: ClassVar[str]

    def __init__(self, *, width: int = 640, tracking: Tracking | None = None, **settings: Any) -> None:
        tracker_settings = tracking or tracking_of(self.weights)
        super().__init__(
            CameraEyes(self.weights, front(width), threshold=tracker_settings.low),
            tracking=tracker_settings,
            **settings,
        )


class Fcos3d(OneCamera):
    """System with one front camera and FCOS3D light."""

    weights = "fcos3d-light"


class PgdDet(OneCamera):
    """System with one front camera and PGD-Det light."""

    weights = "pgd-det-light"


class Yolov5n(OneCamera):
    """System with one front camera and YOLOv5n, whose boxes are lifted by the ground plane."""

    weights = "yolov5n"


class Perfect(Perceiving):
    """System with one front camera and a perfect detector: the upper bound of all systems with this camera."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(PerfectEyes(), **settings)

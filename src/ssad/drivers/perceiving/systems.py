"""Perceiving systems by name; what they are made of can be chosen in Python, or in suites of kind `gap`."""

from __future__ import annotations

from typing import Any

from ssad.drivers.perceiving.driver import Perceiving
from ssad.drivers.perceiving.eyes import CameraEyes, PerfectEyes, front


class Fcos3d(Perceiving):
    """One front camera, FCOS3D light."""

    weights = "fcos3d-light"  # results depend on them

    def __init__(self, *, width: int = 640, **settings: Any) -> None:
        super().__init__(CameraEyes(self.weights, front(width)), **settings)


class PgdDet(Perceiving):
    """One front camera, PGD-Det light."""

    weights = "pgd-det-light"  # results depend on them

    def __init__(self, *, width: int = 640, **settings: Any) -> None:
        super().__init__(CameraEyes(self.weights, front(width)), **settings)


class Yolov5n(Perceiving):
    """One front camera, YOLOv5n, whose boxes are lifted by the ground plane."""

    weights = "yolov5n"  # results depend on them

    def __init__(self, *, width: int = 640, **settings: Any) -> None:
        super().__init__(CameraEyes(self.weights, front(width)), **settings)


class Perfect(Perceiving):
    """One front camera, and a detector that is told the truth: the ceiling of all others with this camera."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(PerfectEyes(), **settings)

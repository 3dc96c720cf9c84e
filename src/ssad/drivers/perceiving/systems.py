"""Perceiving systems by name; their parts can be chosen in Python, in suites of kind `gap`, or by arguments."""

from __future__ import annotations

from typing import Any, ClassVar

from ssad.drivers.perceiving.driver import PerceivingDriver
from ssad.drivers.perceiving.parts import (
    Perceiver,
    Tracker,
    make_perceiver,
    make_planner,
    make_tracker,
    part_version,
)
from ssad.drivers.perceiving.perceivers import CameraPerceiver, PerfectPerceiver, nuscenes_cameras
from ssad.drivers.perceiving.tracker import KalmanTracker, TrackerSettings, tracking_settings


class OneCamera(PerceivingDriver):
    """System with one front camera and a detector with shipped weights.

    Attributes:
        weights: Name of the detector; results depend on them.
    """

    weights: ClassVar[str]

    def __init__(self, *, width: int = 640, tracking: TrackerSettings | None = None, **settings: Any) -> None:
        tracker_settings = tracking or tracking_settings(self.weights)
        super().__init__(
            CameraPerceiver(self.weights, nuscenes_cameras(width), threshold=tracker_settings.low),
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


class PerfectSystem(PerceivingDriver):
    """System with one front camera and a perfect detector: the upper bound of all systems with this camera."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(PerfectPerceiver(), **settings)


class ComposedSystem(PerceivingDriver):
    """System of parts that are named by its arguments.

    In any suite: `perceiving?perceiver=my_package.eyes:Eyes&tracker=my_package.tracks:Nearest@mine`. A part may have
    a single argument of its own: `perceiver=my_package.eyes:Eyes?reach=40`. A suite of kind `gap` gives parts any
    arguments, and so does a subclass of `PerceivingDriver`.

    Args:
        perceiver: Name as for `ssad.drivers.perceiving.parts.make_perceiver`.
        tracker: Name as for `make_tracker`. The built-in one has the scores that suit a built-in detector.
        planner: Name as for `make_planner`.
        rate: Looks per second.
        latency: s from an image to its detections.

    Raises:
        UnknownNameError: There is no such part.
        ConfigError: A part cannot be made, or a value is out of its range.
    """

    def __init__(
        self,
        *,
        perceiver: str = "camera",
        tracker: str = "kalman",
        planner: str = "autopilot",
        rate: float = 5.0,
        latency: float = 0.1,
    ) -> None:
        eyes = make_perceiver(perceiver)
        super().__init__(
            eyes, tracker=_tracker(tracker, eyes), planner=make_planner(planner), rate=rate, latency=latency
        )

    @staticmethod
    def version_of_parts(
        *, perceiver: str = "camera", tracker: str = "kalman", planner: str = "autopilot", **_: object
    ) -> str:
        """Return the versions of the parts, for the keys of results; arguments as of the class."""
        eyes = make_perceiver(perceiver)
        parts = (
            ("perceiver", perceiver, eyes),
            ("tracker", tracker, _tracker(tracker, eyes)),
            ("planner", planner, make_planner(planner)),
        )
        return " ".join(filter(None, (part_version(kind, name, part, {}) for kind, name, part in parts)))


def _tracker(name: str, perceiver: Perceiver) -> Tracker:
    """Return a tracker by name; the built-in one without arguments gets the scores that suit the detector."""
    if name == "kalman" and isinstance(perceiver, CameraPerceiver):
        return KalmanTracker(tracking_settings(perceiver.name))
    return make_tracker(name)

"""Frames of cameras and LiDAR: the data of one moment, and its metadata.

Frames of reference: world (x east, y north, z up), ego (x forward, y left, z up), camera (x right, y down, z forward).
A pose `a_to_b` is a 4 x 4 matrix that takes homogeneous points of a into b. Places in a picture count from its corner,
in intrinsics as in 2D boxes: the first pixel spans 0 to 1, its middle lies at (0.5, 0.5). N boxes, P points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssad.core.boxes import TrackedBoxes
from ssad.core.types import F32, F64

# camera looking forward, upright, 1.5 m above the road: x right = -y, y down = -z, z forward = x
FORWARD: F64 = np.array([[0.0, 0, 1, 1.7], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera on the ego: `intrinsic` [3, 3] for `width` x `height` pixels, `to_ego` [4, 4]."""

    width: int
    height: int
    intrinsic: F64
    to_ego: F64 = field(default_factory=FORWARD.copy)
    channel: str = "CAM"

    @staticmethod
    def typical(width: int, height: int, *, channel: str = "CAM") -> Camera:
        """Return a typical camera: that of nuScenes, focal length 0.79 of the width, level, 1.5 m up."""
        focal = 0.79 * width
        matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return Camera(width, height, matrix, channel=channel)


@dataclass(frozen=True, slots=True)
class DepthCamera:
    """A camera that measures depth: metres along its optical axis in place of colours."""

    camera: Camera


@dataclass(frozen=True, slots=True)
class SemanticCamera:
    """A camera that names what it sees: kinds of surfaces in place of colours."""

    camera: Camera


@dataclass(frozen=True, slots=True)
class Frame:
    """One exposure of one camera, without its pixels.

    Attributes:
        camera: The camera.
        scene: Key of random quantities drawn once for a scene, such as weather.
        sample: Key of random quantities drawn once for a file, such as sensor noise.
        time: s.
        ego_to_world: [4, 4].
        ego_velocity: World frame [3], m/s.
        boxes: Objects.
        depth: Depth along the optical axis [h, w], m, in any resolution (0: unknown, inf: sky).
        points: LiDAR returns in the camera frame [P, 3], from which depth is filled in where `depth` is None.
        sun: Visible share of the sun's disc, where another camera of the same moment sees it; None: unknown, so
            each image is judged by itself.
    """

    camera: Camera
    scene: str = ""
    sample: str = ""
    time: float = 0.0
    ego_to_world: F64 = field(default_factory=lambda: np.eye(4))
    ego_velocity: F64 = field(default_factory=lambda: np.zeros(3))
    boxes: TrackedBoxes = field(default_factory=TrackedBoxes.empty)
    depth: F32 | None = None
    points: F32 | None = None
    sun: float | None = None


@dataclass(frozen=True, slots=True)
class SweepFrame:
    """One turn of a LiDAR, without its points: keys, time s, poses [4, 4], velocity m/s (world), boxes."""

    scene: str = ""
    sample: str = ""
    time: float = 0.0
    to_ego: F64 = field(default_factory=lambda: np.eye(4))
    ego_to_world: F64 = field(default_factory=lambda: np.eye(4))
    ego_velocity: F64 = field(default_factory=lambda: np.zeros(3))
    boxes: TrackedBoxes = field(default_factory=TrackedBoxes.empty)


@dataclass(frozen=True, slots=True)
class StandingObject:
    """An object that stands still in the world over a whole scene.

    Attributes:
        kind: A kind of `ssad.rendering.bodies`.
        style: A style of that kind.
        seed: Seed of its appearance.
        size: Length, width, height, m.
        place: Centre of its base in the world, m.
        yaw: rad.
        level: Lowest severity at which it is present.
    """

    kind: str
    style: str
    seed: int
    size: tuple[float, float, float]
    place: tuple[float, float, float]
    yaw: float
    level: int = 1


@dataclass(frozen=True, slots=True)
class SceneContext:
    """Quantities that are constant over a scene and drawn or measured once.

    Attributes:
        scene: Key of the scene.
        light: Brightness of the sky in [0, 1], for airlight and flakes, which are dark at night.
        heading: Heading of the ego in the world at the start of the scene, rad.
        start: First time of the scene, s.
        sun: Unit vector towards the sun in the world, chosen so that it is visible; None: drawn.
        objects: Unclassified objects that stand on the road; None: drawn for each image by itself.
    """

    scene: str = ""
    light: float = 0.8
    heading: float = 0.0
    start: float = 0.0
    sun: tuple[float, float, float] | None = None
    objects: tuple[StandingObject, ...] | None = None


@dataclass(frozen=True, slots=True)
class ShiftReport:
    """Result of a shift on one file: applied or not, its parameters (plain data), and skipped parts with counts."""

    applied: bool
    details: Mapping[str, Any] = field(default_factory=dict)
    skipped: Mapping[str, int] = field(default_factory=dict)


def camera_to_world(frame: Frame) -> F64:
    """Return the 4 x 4 pose of the camera of a frame in the world."""
    return np.asarray(frame.ego_to_world @ frame.camera.to_ego, np.float64)

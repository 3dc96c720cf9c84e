"""Boxes for tests."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from ssad.core.boxes import TrackedBoxes
from ssad.core.frames import FORWARD, Camera
from ssad.core.rotations import quaternion_to_matrix
from ssad.core.types import U8

WIDTH, HEIGHT = 320, 180
CAMERA = Camera.typical(WIDTH, HEIGHT)
GREY = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)


def cars(*centres: tuple[float, float, float], velocity: tuple[float, float, float] = (0, 4, 0)) -> TrackedBoxes:
    """Cars that look along x."""
    n = len(centres)
    return TrackedBoxes(
        np.array(centres, float),
        np.tile([4.0, 1.8, 1.6], (n, 1)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.tile(np.array(velocity, float), (n, 1)),
        tuple(f"car {k}" for k in range(n)),
        np.ones(n),
    )


def outline(boxes: TrackedBoxes, n: int = 0) -> Any:
    """Corners of a box [8, 2] in the picture of CAMERA at the origin."""
    cube = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    world = (quaternion_to_matrix(boxes.rotation[n]) * boxes.size_lwh[n] @ cube.T).T + boxes.centre[n]
    local = (world - FORWARD[:3, 3]) @ FORWARD[:3, :3]
    k = CAMERA.intrinsic
    return local[:, :2] / local[:, 2:] * [k[0, 0], k[1, 1]] + [k[0, 2], k[1, 2]]


def drawn(boxes: TrackedBoxes, colours: list[tuple[int, int, int]]) -> U8:
    """The boxes as flat shapes on grey, the last in front."""
    image = GREY.copy()
    for n, colour in enumerate(colours):
        cv2.fillConvexPoly(image, cv2.convexHull(outline(boxes, n).astype(np.float32)).astype(np.int32), colour)
    return image

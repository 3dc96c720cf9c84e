"""3D boxes in the world, and the box conventions of other formats.

================  ===================================  ==============================  ===========  ==========
format            frame                                origin                          size         rotation
================  ===================================  ==============================  ===========  ==========
`WorldBoxes`      world: x east, y north, z up         centre                          l, w, h      quaternion
nuScenes          world                                centre                          w, l, h      quaternion
`Solids`          camera: x right, y down, z forward   centre                          l, h, w      yaw
mmdetection3d     camera                               centre of the bottom            l, h, w      yaw
KITTI             camera                               centre of the bottom            h, w, l      rotation_y
================  ===================================  ==============================  ===========  ==========

Length lies along the box's heading, width to its left, height up. Yaw in the camera's frame turns about its y axis:
0 points along x, positive from z towards x; KITTI's rotation_y is the same.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ssad.core.rotations import quaternion_to_matrix
from ssad.core.types import F64

NEAR = 0.1  # m; corners nearer to the camera are moved there before projection
UNIT_CORNERS: F64 = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


@dataclass(frozen=True, slots=True)
class WorldBoxes:
    """N boxes in the world, as columns.

    Attributes:
        centre: Centre [N, 3], m.
        size_lwh: Size along the box's x (forward), y (left) and z (up) [N, 3], m.
        rotation: Quaternions (w, x, y, z) of these axes [N, 4].
        velocity: [N, 2 or 3], m/s; NaN where unknown.
    """

    centre: F64
    size_lwh: F64
    rotation: F64
    velocity: F64

    def __len__(self) -> int:
        return len(self.centre)

    @property
    def size_wlh(self) -> F64:
        """Sizes [N, 3] in the order of nuScenes."""
        return self.size_lwh[:, size_columns("lwh", "wlh")]

    def axes(self) -> F64:
        """Return the axes [N, 3, 3] of the boxes as columns: forward, left, up."""
        return quaternion_to_matrix(self.rotation)

    def corners(self) -> F64:
        """Return the corners [N, 8, 3] in the order of `UNIT_CORNERS`."""
        local: F64 = UNIT_CORNERS * self.size_lwh[:, None]
        return np.asarray(np.einsum("nij,nkj->nki", self.axes(), local) + self.centre[:, None])

    def take(self, index: npt.NDArray[Any]) -> Self:
        """Return the rows selected by `index` (positions or a mask)."""
        rows = np.arange(len(self))[index]
        columns: dict[str, Any] = {column_field.name: getattr(self, column_field.name) for column_field in fields(self)}
        for name, column in columns.items():
            columns[name] = tuple(column[row] for row in rows) if isinstance(column, tuple) else column[rows]
        return type(self)(**columns)


@dataclass(frozen=True, slots=True)
class TrackedBoxes(WorldBoxes):
    """Boxes of identified objects.

    Attributes:
        instance: Identity of each object, over time and sensors.
        visible: [N] lower bound of the visible fraction over all cameras, 1 where unknown.
    """

    instance: tuple[str, ...]
    visible: F64

    @staticmethod
    def empty() -> TrackedBoxes:
        """Return no boxes."""
        return TrackedBoxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), (), np.zeros(0))


def image_rectangles(corners: F64, intrinsic: F64, image_size: tuple[int, int]) -> F64:
    """Return the image rectangles around the corners of 3D boxes, cut at the border of the image.

    Args:
        corners: [N, 8, 3] in the camera's frame (x right, y down, z forward), m; those nearer than `NEAR` are moved
            there.
        intrinsic: The camera's matrix [3, 3].
        image_size: Width and height of the image, px.

    Returns:
        x1, y1, x2, y2 [N, 4], px.
    """
    clipped_corners = corners.copy()
    clipped_corners[..., 2] = np.maximum(clipped_corners[..., 2], NEAR)
    homogeneous = clipped_corners @ intrinsic.T
    pixels = homogeneous[..., :2] / homogeneous[..., 2:]
    return np.concatenate([np.clip(pixels.min(1), 0, image_size), np.clip(pixels.max(1), 0, image_size)], 1)


def size_columns(source_order: str, target_order: str) -> list[int]:
    """Columns that bring sizes of one order into another: from "wlh" to "lwh" they are 1, 0, 2."""
    return [source_order.index(side) for side in target_order]


def bottom_centre(centre: Any, size_lhw: Any) -> Any:
    """Return the centre of the bottom [N, 3] of boxes in a camera's frame, the origin of mmdetection3d and KITTI."""
    # A copy, for arrays and tensors alike.
    bottom_point = centre + 0.0
    bottom_point[..., 1] += 0.5 * size_lhw[..., 1]
    return bottom_point


def camera_axes(yaw: F64) -> F64:
    """Return the axes [N, 3, 3] (forward, left, up, as columns) of upright boxes in the camera's frame."""
    cos, sin, zeros = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
    up = np.tile([0.0, -1.0, 0.0], (len(yaw), 1))
    return np.stack([np.stack([cos, zeros, -sin], -1), np.stack([sin, zeros, cos], -1), up], -1)


def camera_yaw(forward: F64) -> F64:
    """Return the yaw [N] in the camera's frame of boxes that point along `forward` [N, 3]."""
    return np.asarray(np.arctan2(-forward[:, 2], forward[:, 0]))

"""Files of a nuScenes folder: camera images in the frame of the tables, and LiDAR sweeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from ssad.core.image_files import ImageFile, read_image_file
from ssad.core.images import annotated_pixels
from ssad.core.types import F32, U8
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.datasets.nuscenes.tables import nuscenes_path
from ssad.datasets.point_files import read_points

__all__ = ["POINT_BYTES", "points_bytes", "read_frame_file", "read_frame_image", "read_frame_points", "read_points"]

POINT_BYTES = 20


def read_frame_image(root: Path, frame: SensorFrame) -> U8:
    """Read the image of a camera as uint8 [H, W, 3] RGB, in the frame that its camera matrix refers to.

    Args:
        root: The nuScenes root.
        frame: A file of a camera.

    Raises:
        FormatError: The file cannot be read, or its size contradicts the tables.
        StoreError: The file leads out of the root.
    """
    return read_frame_file(root, frame)[1]


def read_frame_file(root: Path, frame: SensorFrame) -> tuple[ImageFile, U8]:
    """The same with the content of the file, whose format a shifted image takes over."""
    image_file = read_image_file(nuscenes_path(root, frame.filename))
    return image_file, annotated_pixels(image_file, width=frame.width, height=frame.height)


def read_frame_points(root: Path, frame: SensorFrame) -> F32:
    """Read the points [P, 5] of a LiDAR sweep: x, y, z, intensity and ring.

    Raises:
        FormatError: The file cannot be read.
        StoreError: The file leads out of the root.
    """
    return read_points(nuscenes_path(root, frame.filename))


def points_bytes(points: npt.ArrayLike) -> bytes:
    """Encode points [N, 5] as the bytes of a sweep file. ValueError for another shape."""
    array = np.ascontiguousarray(points, "<f4")
    if array.ndim != 2 or array.shape[1] != 5:
        raise ValueError(f"points have shape {array.shape}, not [N, 5]")
    return array.tobytes()

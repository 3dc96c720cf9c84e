"""Files of a nuScenes folder: camera images in the frame of the tables, and LiDAR sweeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from ssad.core.image_files import ImageFile, read_image_file
from ssad.core.images import annotated_pixels
from ssad.core.types import U8
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.datasets.point_files import read_points

__all__ = ["POINT_BYTES", "points_bytes", "read_frame_file", "read_frame_image", "read_points"]

POINT_BYTES = 20


def read_frame_image(root: Path, frame: SensorFrame) -> U8:
    """Read the image of a camera as uint8 [H, W, 3] RGB, in the frame that its camera matrix refers to.

    Args:
        root: The nuScenes root.
        frame: A file of a camera.

    Raises:
        FormatError: The file cannot be read, or its size contradicts the tables.
    """
    return read_frame_file(root, frame)[1]


def read_frame_file(root: Path, frame: SensorFrame) -> tuple[ImageFile, U8]:
    """The same with the content of the file, whose format a shifted image takes over."""
    image_file = read_image_file(root / frame.filename)
    return image_file, annotated_pixels(image_file, width=frame.width, height=frame.height)


def points_bytes(points: npt.ArrayLike) -> bytes:
    """Encode points [N, 5] as the bytes of a sweep file. ValueError for another shape."""
    array = np.ascontiguousarray(points, "<f4")
    if array.ndim != 2 or array.shape[1] != 5:
        raise ValueError(f"points have shape {array.shape}, not [N, 5]")
    return array.tobytes()

"""LiDAR sweeps of a nuScenes folder: checked reading, and encoding.

Sweeps are float32 [N, 5]: x, y, z in metres in the sensor's frame, intensity, ring.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from ssad.core.errors import FormatError
from ssad.core.safeio import read_bytes
from ssad.core.types import F32

POINT_BYTES = 20


def read_points(path: str | Path) -> F32:
    """Read a LiDAR sweep (.pcd.bin).

    Returns:
        Points, float32 [N, 5].

    Raises:
        FormatError: The file is missing, has a size that does not fit, or holds values that are not finite.
    """
    content = read_bytes(path, limit=1 << 28)
    if len(content) % POINT_BYTES:
        raise FormatError(f"{path}: {len(content)} bytes are no whole number of {POINT_BYTES}-byte points (cut short?)")
    points = np.frombuffer(content, "<f4").reshape(-1, 5).astype(np.float32)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise FormatError(f"{path}: point {int(np.argmin(finite))} is not finite")
    return points


def points_bytes(points: npt.ArrayLike) -> bytes:
    """Encode points [N, 5] as the bytes of a sweep file. ValueError for another shape."""
    array = np.ascontiguousarray(points, "<f4")
    if array.ndim != 2 or array.shape[1] != 5:
        raise ValueError(f"points have shape {array.shape}, not [N, 5]")
    return array.tobytes()

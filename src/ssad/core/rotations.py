"""Rotations: unit quaternions (w, x, y, z), 3 x 3 matrices, yaw, poses. Radians, right-handed; any leading axes.

A matrix takes vectors of the rotated frame to the parent frame; its columns are the rotated axes. Yaw turns about z,
counter-clockwise from x.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.types import F64

Floats = npt.NDArray[np.floating[Any]]


def quaternion_to_matrix(quaternion: npt.ArrayLike) -> F64:
    """Return rotation matrices [..., 3, 3] of quaternions [..., 4] of any length; length 0 is no rotation."""
    values = np.asarray(quaternion, np.float64)
    length = np.linalg.norm(values, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(values / np.where(length > 0.0, length, 1.0), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def matrix_to_quaternion(matrix: npt.ArrayLike) -> F64:
    """Return unit quaternions [..., 4] with w >= 0 of rotation matrices [..., 3, 3], to about 1e-8."""
    rotation = np.asarray(matrix, np.float64)
    xx, yy, zz = rotation[..., 0, 0], rotation[..., 1, 1], rotation[..., 2, 2]
    squares = np.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)
    magnitudes = np.sqrt(np.maximum(squares, 0.0)) / 2
    # Signs come from the products of the largest component with the others, which are farthest from 0.
    wx, wy, wz = (rotation[..., k, j] - rotation[..., j, k] for j, k in ((1, 2), (2, 0), (0, 1)))
    yz, zx, xy = (rotation[..., k, j] + rotation[..., j, k] for j, k in ((1, 2), (2, 0), (0, 1)))
    unit = np.ones_like(wx)
    products = np.stack([unit, wx, wy, wz, wx, unit, xy, zx, wy, xy, unit, yz, wz, zx, yz, unit], -1)
    largest = magnitudes.argmax(-1)[..., None, None]
    signs = np.take_along_axis(products.reshape(*unit.shape, 4, 4), largest, -2)[..., 0, :]
    signed = np.copysign(magnitudes, signs)
    return np.asarray(np.where(np.signbit(signed[..., :1]), -signed, signed) + 0.0, np.float64)  # + 0.0: no -0.0


def yaw_to_quaternion(yaw: npt.ArrayLike) -> F64:
    """Return quaternions [..., 4] of rotations about z by yaw [...]."""
    half_angle = np.asarray(yaw, np.float64) / 2
    zeros = np.zeros_like(half_angle)
    return np.stack([np.cos(half_angle), zeros, zeros, np.sin(half_angle)], -1)


def quaternion_to_yaw(quaternion: npt.ArrayLike) -> F64:
    """Return headings [...] of quaternions [..., 4] of any length: direction of the rotated x axis in the plane."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, np.float64), -1, 0)
    return np.asarray(np.arctan2(2.0 * (x * y + w * z), w * w + x * x - y * y - z * z))


def quaternion_product(first: npt.ArrayLike, second: npt.ArrayLike) -> F64:
    """Return products [..., 4] of quaternions [..., 4]: the rotation `second`, then `first`."""
    w, x, y, z = np.moveaxis(np.asarray(first, np.float64), -1, 0)
    s, i, j, k = np.moveaxis(np.asarray(second, np.float64), -1, 0)
    return np.stack(
        [
            w * s - x * i - y * j - z * k,
            w * i + x * s + y * k - z * j,
            w * j - x * k + y * s + z * i,
            w * k + x * j - y * i + z * s,
        ],
        -1,
    )


def slerp(start: F64, end: F64, fraction: float) -> F64:
    """Rotations [N, 4] between two quaternions [N, 4] along the shorter arc; share 0 is start, 1 is end.

    Nearly equal ones (cosine of half the angle over 0.9995) are interpolated linearly, as in pyquaternion.
    """
    first = start / np.linalg.norm(start, axis=1, keepdims=True)
    last = end / np.linalg.norm(end, axis=1, keepdims=True)
    cosine = np.sum(first * last, axis=1, keepdims=True)
    # q and -q are one rotation; the sign selects the shorter arc.
    first = np.where(cosine < 0.0, -first, first)
    cosine = np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, 0.9995))
    sine = np.sin(angle)
    spherical = np.sin((1.0 - fraction) * angle) / sine * first + np.sin(fraction * angle) / sine * last
    interpolated = np.where(cosine > 0.9995, first + fraction * (last - first), spherical)
    return np.asarray(interpolated / np.linalg.norm(interpolated, axis=1, keepdims=True))


def pose_matrix(translation: npt.ArrayLike, quaternion: npt.ArrayLike) -> F64:
    """Return poses [..., 4, 4] of translations [..., 3] and quaternions [..., 4]."""
    rotation = quaternion_to_matrix(quaternion)
    pose = np.zeros((*rotation.shape[:-2], 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = translation
    pose[..., 3, 3] = 1.0
    return pose


def upright_pose(x: float, y: float, yaw: float, z: float = 0.0) -> F64:
    """Return the pose [4, 4] of an upright object."""
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = x, y, z
    return pose


def upright_poses(place: F64) -> F64:
    """Return the poses [N, 4, 4] of upright objects at x, y, yaw [N, 3]."""
    pose = np.tile(np.eye(4), (len(place), 1, 1))
    cos, sin = np.cos(place[:, 2]), np.sin(place[:, 2])
    pose[:, 0, 0], pose[:, 0, 1], pose[:, 1, 0], pose[:, 1, 1] = cos, -sin, sin, cos
    pose[:, :2, 3] = place[:, :2]
    return pose


def wrap_scalar(angle: float) -> float:
    """Wrap one angle into [-pi, pi), with the bits of `wrap_angle` in a tenth of its time."""
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return -math.pi if wrapped >= math.pi else wrapped


def wrap_angle(angle: npt.ArrayLike) -> Floats:
    """Wrap angles into [-pi, pi)."""
    array = np.asarray(angle)
    value: Floats = array if np.issubdtype(array.dtype, np.floating) else array.astype(np.float64)
    wrapped = (value + np.pi) % (2.0 * np.pi) - np.pi
    # rounding of the remainder may give exactly +pi
    return np.where(wrapped >= np.pi, -np.pi, wrapped).astype(value.dtype)

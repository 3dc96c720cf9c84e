"""Weights, pictures and objects from a seed for comparing monocular 3D detectors; NumPy alone, any version.

Only integers and uniform floats are drawn, and keys are filled in sorted order, so two programs get the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]

# Gain and range of the bias of the layers that answer, by the end of their names; the first that fits counts. Offsets
# and classes vary, depth and size hardly: neighbouring places then give boxes that overlap enough to be suppressed.
LAST = (
    ("conv_cls", 1.5, (-2.5, -0.5)),
    ("conv_centerness", 1.0, (0.0, 1.0)),
    ("conv_dir_cls", 1.0, (-0.5, 0.5)),
    ("conv_attr", 1.0, (-0.5, 0.5)),
    ("conv_depth_cls", 0.1, (-1.0, 1.0)),
    ("conv_regs.0", 0.7, (-0.3, 0.3)),
    ("conv_regs.1", 0.03, (2.6, 3.0)),
    ("conv_regs.2", 0.03, (0.9, 1.4)),
    ("conv_regs.3", 0.3, (-3.0, 3.0)),
    ("conv_regs.4", 1.0, (-1.0, 1.0)),
    ("conv_regs.5", 0.7, (0.5, 2.0)),
    ("conv_offset", 0.5, (-0.5, 0.5)),
)
RARE = -2.8  # added to the bias of the classes
PGD = {"conv_regs.1": (0.02, (-0.3, 0.3)), "conv_regs.2": (0.03, (-0.2, 0.2))}


def weights(shapes: Mapping[str, Sequence[int]], *, seed: int) -> dict[str, npt.NDArray[Any]]:
    """Values for a state dict of mmdetection3d's names, float32 (counters: int64 zeros).

    Every map that a network of them gives is of the order of its unit; more boxes pass the threshold than are kept,
    but fewer with an even seed.
    """
    rng = np.random.default_rng(seed)
    pgd = any("depth_cls" in name for name in shapes)
    found: dict[str, npt.NDArray[Any]] = {}
    for name in sorted(shapes):
        shape = tuple(shapes[name])
        if name.endswith("num_batches_tracked"):
            found[name] = np.zeros(shape, np.int64)
            continue
        low, high = _range(name, shape, pgd)
        rare = RARE if name == "bbox_head.conv_cls.bias" and seed % 2 == 0 else 0.0
        found[name] = np.asarray(low + (high - low) * rng.random(shape) + rare, np.float32)
    return found


def _range(name: str, shape: tuple[int, ...], pgd: bool) -> tuple[float, float]:
    stem, _, kind = name.rpartition(".")
    if kind == "running_var":  # of the stem: it sees pictures of 0..255
        return (4000.0, 9000.0) if stem == "backbone.bn1" else (0.8, 1.3)
    if kind == "running_mean":
        return -0.1, 0.1
    if kind == "scale":
        return 0.8, 1.2
    if name.endswith("fuse_lambda"):
        return -1.0, 1.0
    if stem.endswith((".bn3", ".bn2", ".bn1", ".gn", ".downsample.1")):
        if kind == "bias":
            return -0.1, 0.1
        return (0.2, 0.4) if stem.endswith(".bn3") else (0.8, 1.2)
    gain, bias = math.sqrt(2.0), (-0.1, 0.1)
    for end, *answer in LAST:
        if stem.endswith(end):
            gain, bias = PGD.get(end, answer) if pgd else answer  # type: ignore[assignment]
            break
    if kind == "bias":
        return bias
    bound = gain * math.sqrt(3.0 / math.prod(shape[1:]))
    return -bound, bound


def picture(width: int, height: int, *, seed: int) -> U8:
    """A picture [height, width, 3] of soft blobs and hard-edged rectangles under noise, uint8 BGR.

    Without the noise, even areas would give equal values in a window of the max pooling; which of them the gradient
    takes then depends on the rounding of the convolution, and so on the processor.
    """
    rng = np.random.default_rng([seed, 1])
    found = np.repeat(np.repeat(rng.integers(0, 256, (height // 16 + 2, width // 16 + 2, 3)), 16, 0), 16, 1)
    total = np.cumsum(np.cumsum(np.pad(found, ((1, 0), (1, 0), (0, 0))), 0), 1)  # box filter of 15 x 15, in integers
    found = (total[15:, 15:] - total[:-15, 15:] - total[15:, :-15] + total[:-15, :-15]) // 225
    found = found[:height, :width].copy()
    corner = rng.integers(0, [width, height], (12, 2))
    end = corner + 4 + rng.integers(0, [width // 4, height // 3], (12, 2))
    for (left, top), (right, bottom), colour in zip(corner, end, rng.integers(0, 256, (12, 3)), strict=True):
        found[top:bottom, left:right] = colour
    found = 16 + found * 223 // 255 + rng.integers(-16, 17, found.shape)  # within 0..255: nothing is cut off and even
    return found.astype(np.uint8)


def cam2img(width: int, height: int) -> F64:
    """Matrix [4, 4] of a camera like nuScenes' front one, scaled to the picture's width, its centre a little off."""
    focal = 1266.0 * width / 1600
    found = np.eye(4)
    found[:2, :3] = [[focal, 0.0, 0.51 * width], [0.0, focal * 1.001, 0.53 * height]]
    return found


def objects(width: int, height: int, *, seed: int, count: int = 12) -> dict[str, npt.NDArray[Any]]:
    """True objects before `cam2img(width, height)`: label [Q], centre [Q, 3] (of gravity), size [Q, 3] (length,
    height, width), yaw [Q], velocity [Q, 2], attribute [Q], centre2d [Q, 2], box [Q, 4]: the projected corners' hull
    within the picture."""
    rng = np.random.default_rng([seed, 2])
    lens = cam2img(width, height)[:3, :3]
    depth = 4.0 + 46.0 * rng.random(count) ** 2
    centre2d = rng.random((count, 2)) * [width, height]
    centre = np.column_stack([centre2d * depth[:, None], depth]) @ np.linalg.inv(lens).T
    size = np.exp(rng.random((count, 3)) * 1.6 - 0.6) * [1.8, 1.0, 1.0]
    yaw = (rng.random(count) * 2 - 1) * np.pi
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    local = signs * size[:, None]
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    corners = (
        np.stack(
            [cos * local[..., 0] + sin * local[..., 2], local[..., 1], cos * local[..., 2] - sin * local[..., 0]], -1
        )
        + centre[:, None]
    )
    corners[..., 2] = np.maximum(corners[..., 2], 0.2)
    shown = corners @ lens.T
    shown = np.clip(shown[..., :2] / shown[..., 2:], 0, [width, height])
    velocity = rng.random((count, 2)) * 8 - 4
    label, attribute = rng.integers(0, 10, count), rng.integers(0, 9, count)
    reals = {
        "centre": centre,
        "size": size,
        "yaw": yaw,
        "velocity": velocity,
        "centre2d": centre2d,
        "box": np.concatenate([shown.min(1), shown.max(1)], 1),
    }
    return {"label": label, "attribute": attribute, **{k: v.astype(np.float32) for k, v in reals.items()}}


def rig(*, seed: int) -> tuple[F64, F64]:
    """Six cameras (front, front right, front left, back, back left, back right): camera to ego [6, 4, 4] with a pitch
    and a roll of up to a degree, and ego to world [4, 4] on a slope."""
    rng = np.random.default_rng([seed, 3])
    to_ego = np.tile(np.eye(4), (6, 1, 1))
    for k, degrees in enumerate((0.0, -56.0, 55.0, 180.0, 108.0, -110.0)):
        pitch, roll = (rng.random(2) * 2 - 1) * math.radians(1.0)
        axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # of the camera, in the ego's frame
        turned = turn(2, math.radians(degrees)) @ turn(1, pitch) @ turn(0, roll)
        to_ego[k, :3, :3] = turned @ axes
        to_ego[k, :3, 3] = [*(rng.random(2) * 2 - 0.5), 1.5]
    to_world = np.eye(4)
    to_world[:3, :3] = turn(2, 2.2) @ turn(1, 0.02) @ turn(0, -0.015)
    to_world[:3, 3] = [612.3, 1480.9, 2.7]
    return to_ego, to_world


def turn(axis: int, angle: float) -> F64:
    """Rotation matrix about an axis."""
    one, two = (axis + 1) % 3, (axis + 2) % 3
    found = np.eye(3)
    found[[one, two], [one, two]] = math.cos(angle)
    found[two, one], found[one, two] = math.sin(angle), -math.sin(angle)
    return found


def sightings(*, seed: int, count: int = 120) -> list[dict[str, npt.NDArray[Any]]]:
    """Made-up detections of the six cameras of `rig`, as `objects` has them with score [N] and without boxes; the
    cameras see many objects twice, and some are out of range."""
    rng = np.random.default_rng([seed, 4])
    to_ego, _ = rig(seed=seed)
    spot = np.column_stack([(rng.random((count, 2)) * 2 - 1) * 48.0, rng.random(count)])  # in the ego's frame
    size = np.exp(rng.random((count, 3)) * 1.2) * [1.8, 1.0, 1.0]
    yaw = (rng.random(count) * 2 - 1) * np.pi
    label = rng.integers(0, 10, count)
    found = []
    for k in range(6):
        centre = (spot + rng.random((count, 3)) * 0.8 - to_ego[k, :3, 3]) @ to_ego[k, :3, :3]
        seen = (centre[:, 2] > 1.0) & (np.abs(centre[:, 0]) < 1.2 * centre[:, 2])
        heading = np.arctan2(to_ego[k, 1, 2], to_ego[k, 0, 2])
        values = {
            "centre": centre,
            "size": size * (0.95 + 0.1 * rng.random((count, 3))),
            "yaw": yaw + heading + 0.1 * rng.random(count),
            "velocity": rng.random((count, 2)) * 8 - 4,
            "score": rng.random(count) ** 2,
        }
        one: dict[str, npt.NDArray[Any]] = {name: v[seen].astype(np.float32) for name, v in values.items()}
        found.append({**one, "label": label[seen], "attribute": rng.integers(0, 9, count)[seen]})
    return found

"""From what a detector reports in a camera's picture to objects in the world.

3D boxes are moved by the pose of the camera. 2D boxes are lifted by the ground plane: the middle of a box's lower edge
is taken for the point where the object meets a level road.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ssad.core.boxes import camera_axes
from ssad.core.detections import Detections
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import F64, Bool
from ssad.drivers.perceiving.objects import I64, KINDS, LARGE, SIZES, Objects, no_objects


@dataclass(frozen=True, slots=True, kw_only=True)
class Lifting:
    """Settings.

    Attributes:
        reach: m from the camera beyond which nothing is reported.
        along: Standard deviation of an object's place along the line of sight: m, and m per m of distance.
        across: The same across it.
        overhang: m from a large vehicle's end to the wheels on which its lower edge seems to stand; of 2D boxes alone.
        merge: Share of the longer of two large objects' lengths within which their middles belong to one object.
    """

    reach: float = 60.0
    along: tuple[float, float] = (0.4, 0.05)
    across: tuple[float, float] = (0.2, 0.01)
    merge: float = 0.5
    overhang: float = 0.9


def lift(
    found: Sequence[Detections], camera: Camera, poses: F64, scenes: I64, classes: Sequence[str], *, settings: Lifting
) -> Objects:
    """Objects in the world; classes that do not matter to a driver are left out.

    Args:
        found: What was found in each of n pictures of a camera.
        camera: The camera.
        poses: Of the camera in the world when each picture was taken, [n, 4, 4].
        scenes: [n] to which scene each picture belongs.
        classes: Names of the labels.
        settings: Settings.

    Returns:
        The objects, picture by picture, best first.

    Raises:
        ConfigError: The detector returned a number that is not finite, or a label that is none of its classes.
    """
    if not found:
        return no_objects()
    score, label = _joined([one.score for one in found]), _joined([one.label for one in found]).astype(np.int64)
    _check(score, label, classes)
    kind = np.array([KINDS.get(name, 0) for name in classes], np.int64)[label]
    rows = np.flatnonzero(kind > 0)
    if not len(rows):
        return no_objects()
    picture = np.repeat(np.arange(len(found)), [len(one.score) for one in found])[rows]
    kind, pose = kind[rows], poses[picture]
    solids = [one.solid for one in found if one.solid is not None]
    if len(solids) < len(found):
        box = _joined([one.box for one in found]).astype(np.float64)[rows]
        _finite(box)
        place, yaw, known = _on_ground(box, kind, camera, pose, settings.overhang)
        size: F64 = SIZES[kind, :2]
        velocity: F64 = np.full((len(rows), 2), np.nan)
        rows, kind, place, yaw, pose = rows[known], kind[known], place[known], yaw[known], pose[known]
        size, velocity, picture = size[known], velocity[known], picture[known]
    else:
        centre, lhw, turn, speed = (
            _joined([getattr(one, name) for one in solids]).astype(np.float64)[rows]
            for name in ("centre", "size_lhw", "yaw", "velocity")
        )
        _finite(centre, lhw, turn)
        place = (_turned(pose, centre) + pose[:, :3, 3])[:, :2]
        ahead = _turned(pose, camera_axes(turn)[:, :, 0])
        yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
        size = np.maximum(lhw[:, [0, 2]], 0.2)
        velocity = _turned(pose, np.stack([speed[:, 0], np.zeros(len(rows)), speed[:, 1]], 1))[:, :2]
    spread, away = _spread(place, pose, settings)
    every = Objects(scenes[picture], place, spread, yaw, size, velocity, kind, score[rows].astype(np.float64))
    order = np.lexsort((-every.score, picture))
    return every.take(order[away[order] <= settings.reach])


def merged(found: Objects, share: float) -> Objects:
    """Without the large objects of a scene that a better one stands in: those seen by two cameras, or as two kinds.

    Args:
        found: Objects of some scenes.
        share: See `Lifting.merge`.

    Returns:
        The others, scene by scene, best first.
    """
    found = found.take(np.lexsort((-found.score, found.scene)))
    keep = np.ones(len(found), bool)
    rows = np.flatnonzero(np.isin(found.kind, LARGE))
    if len(rows):
        # a table of the large objects, a line a scene
        _, line, count = np.unique(found.scene[rows], return_inverse=True, return_counts=True)
        slot = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
        shape = (len(count), int(count.max()))
        place, length = np.zeros((*shape, 2)), np.zeros(shape)
        place[line, slot], length[line, slot] = found.place[rows], found.size[rows, 0]
        kept = np.zeros(shape, bool)
        for k in range(shape[1]):
            gap = np.linalg.norm(place[:, :k] - place[:, k, None], axis=-1)
            close = gap < share * np.maximum(length[:, :k], length[:, k, None])
            kept[:, k] = ~(close & kept[:, :k]).any(1)
        keep[rows] = kept[line, slot]
    return found.take(keep)


def _joined(parts: Sequence[Tensor]) -> npt.NDArray[Any]:
    """Rows of all tensors, on the host."""
    return torch.cat([part.detach() for part in parts]).cpu().numpy()


def _turned(pose: F64, vector: F64) -> F64:
    """Vectors [N, 3] turned by poses [N, 4, 4], each by itself: to the bit the same in any company."""
    return np.asarray((pose[:, :3, :3] * vector[:, None, :]).sum(-1))


def _check(score: F64, label: I64, classes: Sequence[str]) -> None:
    _finite(score)
    if len(label) and not (label.min() >= 0 and label.max() < len(classes)):
        raise ConfigError(f"the detector returned a label that is none of its {len(classes)} classes")


def _finite(*arrays: F64) -> None:
    if not all(np.isfinite(array).all() for array in arrays):
        raise ConfigError("the detector returned a number that is not finite")


def _spread(place: F64, pose: F64, settings: Lifting) -> tuple[F64, F64]:
    """Covariances [N, 2, 2] of places as seen from cameras, and distances [N]."""
    line = place - pose[:, :2, 3]
    away = np.linalg.norm(line, axis=1)
    one = line / np.maximum(away, 1e-6)[:, None]
    other = np.stack([-one[:, 1], one[:, 0]], 1)
    along, across = ((own[0] + own[1] * away) ** 2 for own in (settings.along, settings.across))
    return along[:, None, None] * one[:, :, None] * one[:, None, :] + across[:, None, None] * (
        other[:, :, None] * other[:, None, :]
    ), away


def _on_ground(box: F64, kind: I64, camera: Camera, pose: F64, overhang: float) -> tuple[F64, F64, Bool]:
    """Middles [N, 2], headings [N] and whether they lie on the road [N] of objects in 2D boxes [N, 4].

    A box about as wide as the object's end shows it from front or back, so its heading is along the line of sight and
    its middle half a length behind what is seen; a wider one shows its side.
    """
    foot = np.stack([0.5 * (box[:, 0] + box[:, 2]), box[:, 3], np.ones(len(box))], 1)
    ray = _turned(pose[:, :3, :3] @ np.linalg.inv(camera.intrinsic), foot)
    down = -ray[:, 2]
    known = down > 1e-3
    where = pose[:, :3, 3] + ray * (pose[:, 2, 3] / np.where(known, down, 1.0))[:, None]
    line = where[:, :2] - pose[:, :2, 3]
    line = line / np.maximum(np.linalg.norm(line, axis=1), 1e-6)[:, None]
    length, width, height = SIZES[kind].T
    shape = (box[:, 2] - box[:, 0]) / np.maximum(box[:, 3] - box[:, 1], 1e-6)
    aside = shape > np.sqrt(length * width) / height
    course = np.arctan2(line[:, 1], line[:, 0])
    behind = np.where(aside, 0.5 * width, 0.5 * length - np.where(np.isin(kind, LARGE), overhang, 0.0))
    middle = where[:, :2] + behind[:, None] * line
    return middle, course + np.where(aside, 0.5 * np.pi, 0.0), known

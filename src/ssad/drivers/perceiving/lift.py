"""Projection of detections in a camera image to objects in the world.

3D boxes are transformed by the camera pose. 2D boxes are lifted by the ground plane: the middle of the lower edge is
taken as the contact point of the object with a level road.
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
from ssad.core.perception import I64, Objects, no_objects
from ssad.core.types import F64, Bool
from ssad.drivers.perceiving.objects import KINDS, LARGE, SIZES


@dataclass(frozen=True, slots=True, kw_only=True)
class Lifting:
    """Settings of the projection to the world.

    Attributes:
        reach: Maximum distance of reported objects from the camera, m.
        along: Standard deviation of an object's position along the line of sight: m, and m per m of distance.
        across: The same across the line of sight.
        overhang: m from the end of a large vehicle to the visible wheels of its lower edge; for 2D boxes only.
        merge: Two large objects are one if their centres are closer than this share of the longer length.
    """

    reach: float = 60.0
    along: tuple[float, float] = (0.4, 0.05)
    across: tuple[float, float] = (0.2, 0.01)
    merge: float = 0.5
    overhang: float = 0.9


def lift(
    detections: Sequence[Detections],
    camera: Camera,
    poses: F64,
    scenes: I64,
    classes: Sequence[str],
    *,
    settings: Lifting,
) -> Objects:
    """Objects in the world; classes that do not matter to a driver are left out.

    Args:
        detections: What was found in each of n pictures of a camera.
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
    if not detections:
        return no_objects()
    score, label = (
        _concatenate([image_detections.score for image_detections in detections]),
        _concatenate([image_detections.label for image_detections in detections]).astype(np.int64),
    )
    _check_labels(score, label, classes)
    kind = np.array([KINDS.get(name, 0) for name in classes], np.int64)[label]
    rows = np.flatnonzero(kind > 0)
    if not len(rows):
        return no_objects()
    image_index = np.repeat(
        np.arange(len(detections)), [len(image_detections.score) for image_detections in detections]
    )[rows]
    kind, pose = kind[rows], poses[image_index]
    solids = [image_detections.solid for image_detections in detections if image_detections.solid is not None]
    if len(solids) < len(detections):
        box = _concatenate([image_detections.box for image_detections in detections]).astype(np.float64)[rows]
        _check_finite(box)
        position, yaw, on_road = _ground_positions(box, kind, camera, pose, settings.overhang)
        size: F64 = SIZES[kind, :2]
        velocity: F64 = np.full((len(rows), 2), np.nan)
        rows, kind, position, yaw, pose = rows[on_road], kind[on_road], position[on_road], yaw[on_road], pose[on_road]
        size, velocity, image_index = size[on_road], velocity[on_road], image_index[on_road]
    else:
        centre, size_lhw, camera_yaw, speed = (
            _concatenate([getattr(image_detections, name) for image_detections in solids]).astype(np.float64)[rows]
            for name in ("centre", "size_lhw", "yaw", "velocity")
        )
        _check_finite(centre, size_lhw, camera_yaw)
        position = (_rotate(pose, centre) + pose[:, :3, 3])[:, :2]
        direction = _rotate(pose, camera_axes(camera_yaw)[:, :, 0])
        yaw = np.arctan2(direction[:, 1], direction[:, 0])
        size = np.maximum(size_lhw[:, [0, 2]], 0.2)
        velocity = _rotate(pose, np.stack([speed[:, 0], np.zeros(len(rows)), speed[:, 1]], 1))[:, :2]
    spread, distance = position_covariance(position, pose, settings)
    objects = Objects(scenes[image_index], position, spread, yaw, size, velocity, kind, score[rows].astype(np.float64))
    ranking = np.lexsort((-objects.score, image_index))
    return objects.take(ranking[distance[ranking] <= settings.reach])


def merge_duplicates(objects: Objects, share: float) -> Objects:
    """Without the large objects of a scene that a better one stands in: those seen by two cameras, or as two kinds.

    Args:
        objects: Objects of some scenes.
        share: See `Lifting.merge`.

    Returns:
        The others, scene by scene, best first.
    """
    objects = objects.take(np.lexsort((-objects.score, objects.scene)))
    keep_mask = np.ones(len(objects), bool)
    large_rows = np.flatnonzero(np.isin(objects.kind, LARGE))
    if len(large_rows):
        # padded table of the large objects, one row per scene
        _, scene_row, count = np.unique(objects.scene[large_rows], return_inverse=True, return_counts=True)
        slot = np.arange(len(large_rows)) - np.repeat(np.cumsum(count) - count, count)
        shape = (len(count), int(count.max()))
        positions, lengths = np.zeros((*shape, 2)), np.zeros(shape)
        positions[scene_row, slot], lengths[scene_row, slot] = objects.place[large_rows], objects.size[large_rows, 0]
        retained = np.zeros(shape, bool)
        # Greedy suppression: slots are sorted by score, so each is compared with better ones only.
        for column in range(shape[1]):
            distances = np.linalg.norm(positions[:, :column] - positions[:, column, None], axis=-1)
            overlaps = distances < share * np.maximum(lengths[:, :column], lengths[:, column, None])
            retained[:, column] = ~(overlaps & retained[:, :column]).any(1)
        keep_mask[large_rows] = retained[scene_row, slot]
    return objects.take(keep_mask)


def _concatenate(parts: Sequence[Tensor]) -> npt.NDArray[Any]:
    """Concatenate the rows of tensors on the host."""
    return torch.cat([part.detach() for part in parts]).cpu().numpy()


def _rotate(pose: F64, vector: F64) -> F64:
    """Rotate vectors [N, 3] by poses [N, 4, 4], row by row: bit-identical in any batch."""
    return np.asarray((pose[:, :3, :3] * vector[:, None, :]).sum(-1))


def _check_labels(score: F64, label: I64, classes: Sequence[str]) -> None:
    _check_finite(score)
    if len(label) and not (label.min() >= 0 and label.max() < len(classes)):
        raise ConfigError(f"the detector returned a label that is none of its {len(classes)} classes")


def _check_finite(*arrays: F64) -> None:
    if not all(np.isfinite(array).all() for array in arrays):
        raise ConfigError("the detector returned a number that is not finite")


def position_covariance(place: F64, pose: F64, settings: Lifting) -> tuple[F64, F64]:
    """Covariances [N, 2, 2] of places as seen from cameras, and distances [N]."""
    line_of_sight = place - pose[:, :2, 3]
    distance = np.linalg.norm(line_of_sight, axis=1)
    along_axis = line_of_sight / np.maximum(distance, 1e-6)[:, None]
    across_axis = np.stack([-along_axis[:, 1], along_axis[:, 0]], 1)
    along_variance, across_variance = (
        (deviation[0] + deviation[1] * distance) ** 2 for deviation in (settings.along, settings.across)
    )
    return along_variance[:, None, None] * along_axis[:, :, None] * along_axis[:, None, :] + across_variance[
        :, None, None
    ] * (across_axis[:, :, None] * across_axis[:, None, :]), distance


def _ground_positions(box: F64, kind: I64, camera: Camera, pose: F64, overhang: float) -> tuple[F64, F64, Bool]:
    """Middles [N, 2], headings [N] and whether they lie on the road [N] of objects in 2D boxes [N, 4].

    A box about as wide as the object's end shows it from front or back, so its heading is along the line of sight and
    its middle half a length behind what is seen; a wider one shows its side.
    """
    foot_point = np.stack([0.5 * (box[:, 0] + box[:, 2]), box[:, 3], np.ones(len(box))], 1)
    ray = _rotate(pose[:, :3, :3] @ np.linalg.inv(camera.intrinsic), foot_point)
    descent = -ray[:, 2]
    on_road = descent > 1e-3
    contact = pose[:, :3, 3] + ray * (pose[:, 2, 3] / np.where(on_road, descent, 1.0))[:, None]
    direction = contact[:, :2] - pose[:, :2, 3]
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1), 1e-6)[:, None]
    length, width, height = SIZES[kind].T
    aspect = (box[:, 2] - box[:, 0]) / np.maximum(box[:, 3] - box[:, 1], 1e-6)
    side_view = aspect > np.sqrt(length * width) / height
    bearing = np.arctan2(direction[:, 1], direction[:, 0])
    depth_offset = np.where(side_view, 0.5 * width, 0.5 * length - np.where(np.isin(kind, LARGE), overhang, 0.0))
    centre = contact[:, :2] + depth_offset[:, None] * direction
    return centre, bearing + np.where(side_view, 0.5 * np.pi, 0.0), on_road

"""Merging of the boxes of several cameras in the world: the second suppression of the nuScenes export."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ssad.core.boxes import WorldBoxes, camera_axes, size_columns
from ssad.core.detections import Detections
from ssad.core.errors import ConfigError
from ssad.core.nuscenes_names import MMDET3D_ATTRIBUTES, MMDET3D_CLASSES, RANGES, USUAL_ATTRIBUTE
from ssad.core.rotations import matrix_to_quaternion
from ssad.core.types import F64, I32
from ssad.detectors.mono3d.nms import rotated_nms

# m from the ego within which a class is reported
REACH = np.array([RANGES[name] for name in MMDET3D_CLASSES])
MAX_OVERLAP, MIN_SCORE, MAX_BOXES = 0.05, 0.01, 500


@dataclass(frozen=True, slots=True)
class DetectedBoxes(WorldBoxes):
    """Detections of one moment.

    Attributes:
        velocity: [N, 2], m/s.
        score: [N].
        label: Index into MMDET3D_CLASSES [N].
        attribute: Names [N]; "" for none.
    """

    score: F64
    label: I32
    attribute: tuple[str, ...]


def merge_cameras(
    detections: Sequence[Detections], cam_to_ego: Sequence[F64], ego_to_global: Sequence[F64]
) -> DetectedBoxes:
    """Return the detections of the cameras of one moment as boxes in the world, by class and descending score.

    As mmdetection3d exports to nuScenes: boxes beyond the range of their class from the ego are dropped; all are moved
    to the camera that looks ahead (upright there); of those of a class that overlap by 5 % or more on its ground, the
    best stays; if there are more than 500, the best 500 stay. With one pose for all cameras the result is mmdetection3d
    1.4's.

    Args:
        detections: Detections of each camera.
        cam_to_ego: Camera to ego [4, 4] of each.
        ego_to_global: Ego to world [4, 4], at each camera's own time.

    Raises:
        ConfigError: There is not one pose for each camera, or there are no 3D boxes.
    """
    if not len(detections) == len(cam_to_ego) == len(ego_to_global):
        raise ConfigError(
            f"merge_cameras: {len(detections)} cameras with {len(cam_to_ego)} and {len(ego_to_global)} poses"
        )
    if not len(detections):
        return _empty()
    columns = []
    for camera_detections, to_ego, to_world in zip(detections, cam_to_ego, ego_to_global, strict=True):
        if camera_detections.solid is None:
            raise ConfigError("merge_cameras: detections without 3D boxes")
        solid = camera_detections.solid
        centre, size, yaw, velocity = (
            values.detach().cpu().double().numpy()
            for values in (solid.centre, solid.size_lhw, solid.yaw, solid.velocity)
        )
        score, label = camera_detections.score.detach().cpu().double().numpy(), camera_detections.label.cpu().numpy()
        in_range = (score > MIN_SCORE) & (_distance(centre, to_ego) <= REACH[label])
        pose = to_world @ to_ego
        rows = (
            centre @ pose[:3, :3].T + pose[:3, 3],
            size,
            pose[:3, :3] @ camera_axes(yaw),
            _ground_velocity(velocity) @ pose[:3, :3].T,
            score,
            label,
            solid.attribute.cpu().numpy(),
        )
        columns.append(tuple(column[in_range] for column in rows))
    world_centre, size, axes, velocity, score, label, attribute = (
        np.concatenate(parts) for parts in zip(*columns, strict=True)
    )
    front_camera = int(np.argmax([pose[0, 2] for pose in cam_to_ego]))  # its optical axis points along the ego's x
    pose = ego_to_global[front_camera] @ cam_to_ego[front_camera]
    centre = (world_centre - pose[:3, 3]) @ pose[:3, :3]
    camera_frame_axes = pose[:3, :3].T @ axes
    # The source stores boxes upright in the front camera, which keeps the yaw alone.
    yaw = np.arctan2(camera_frame_axes[:, 0, 1], camera_frame_axes[:, 0, 0])
    in_range = np.flatnonzero(_distance(centre, cam_to_ego[front_camera]) <= REACH[label])
    ground = torch.from_numpy(np.column_stack([centre[:, [0, 2]], size[:, [0, 2]], -yaw])[in_range])
    survivors = rotated_nms(
        ground, torch.from_numpy(score[in_range]), torch.from_numpy(label[in_range]), threshold=MAX_OVERLAP
    )
    rows = in_range[survivors.numpy()]
    if len(rows) > MAX_BOXES:
        rows = rows[np.argsort(-score[rows], kind="stable")[:MAX_BOXES]]
    world_velocity = _ground_velocity((velocity[rows] @ pose[:3, :3])[:, [0, 2]]) @ pose[:3, :3].T
    names = tuple(
        _attribute(int(class_index), int(attribute_index))
        for class_index, attribute_index in zip(label[rows], attribute[rows], strict=True)
    )
    rotation = matrix_to_quaternion(pose[:3, :3] @ camera_axes(yaw[rows]))
    return DetectedBoxes(
        world_centre[rows],
        size[rows][:, size_columns("lhw", "lwh")],
        rotation,
        world_velocity[:, :2],
        score[rows],
        label[rows].astype(np.int32),
        names,
    )


def _empty() -> DetectedBoxes:
    empty_vectors = np.zeros((0, 3))
    return DetectedBoxes(
        empty_vectors,
        empty_vectors,
        np.zeros((0, 4)),
        empty_vectors[:, :2],
        empty_vectors[:, 0],
        np.zeros(0, np.int32),
        (),
    )


def _distance(centre: F64, to_ego: F64) -> F64:
    """Return the distances [N] on the ground from the ego to points [N, 3] of a camera's frame."""
    return np.asarray(np.linalg.norm((centre @ to_ego[:3, :3].T + to_ego[:3, 3])[:, :2], axis=1))


def _ground_velocity(velocity: F64) -> F64:
    """Return velocities [N, 3] from x and z [N, 2] in a camera's frame."""
    return np.stack([velocity[:, 0], np.zeros(len(velocity)), velocity[:, 1]], -1)


def _attribute(label: int, attribute: int) -> str:
    """Return the attribute's name if it fits the class, else the class's default."""
    name, class_default = MMDET3D_ATTRIBUTES[attribute], USUAL_ATTRIBUTE[MMDET3D_CLASSES[label]]
    return name if name.split(".")[0] == class_default.split(".")[0] else class_default

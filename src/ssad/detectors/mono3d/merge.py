"""From the cameras of one moment to boxes in the world: the second suppression of the nuScenes export."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ssad.detections import ATTRIBUTES, CLASSES_3D, Detections
from ssad.detectors.mono3d.nms import rotated_nms
from ssad.types import F64, I32

# m from the ego within which a class is reported, in the order of CLASSES_3D (the evaluation's ranges)
RANGES = np.array([50.0, 50.0, 50.0, 50.0, 50.0, 40.0, 40.0, 40.0, 30.0, 30.0])
OVERLAP, LEAST, MOST = 0.05, 0.01, 500
_CYCLES, _VEHICLES = (5, 6), (0, 1, 2, 3, 4)


@dataclass(frozen=True, slots=True)
class WorldBoxes:
    """Boxes of one moment in the world: translation [N, 3]; size [N, 3] width, length, height; rotation [N, 4]
    quaternion w, x, y, z; velocity [N, 2]; score [N]; label [N] index into CLASSES_3D; attribute names ("": none)."""

    translation: F64
    size: F64
    rotation: F64
    velocity: F64
    score: F64
    label: I32
    attribute: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.score)


def merge_cameras(found: Sequence[Detections], cam_to_ego: Sequence[F64], ego_to_global: Sequence[F64]) -> WorldBoxes:
    """Detections of the cameras of one moment as boxes in the world.

    Boxes beyond the range of their class from the ego are dropped; of those of a class that overlap by 5 % or more on
    the ground the best stays; at most 500. The overlap is taken in the ego's plane (the source takes that of the front
    camera, which differs by its tilt). cam_to_ego, ego_to_global [4, 4] at each camera's own time.
    """
    columns: list[tuple[F64, ...]] = []
    for one, to_ego, to_world in zip(found, cam_to_ego, ego_to_global, strict=True):
        solid = one.solid
        if solid is None or not len(one.score):
            continue
        centre, size, yaw, velocity = (
            v.detach().cpu().double().numpy() for v in (solid.centre, solid.size, solid.yaw, solid.velocity)
        )
        in_ego = centre @ to_ego[:3, :3].T + to_ego[:3, 3]
        label = one.label.cpu().numpy().astype(np.float64)
        near = np.hypot(in_ego[:, 0], in_ego[:, 1]) <= RANGES[label.astype(int)]
        turn = (to_world @ to_ego)[:3, :3]
        moved = np.stack([velocity[:, 0], np.zeros(len(velocity)), velocity[:, 1]], -1) @ turn.T
        axes = turn @ _upright(yaw)
        world = in_ego @ to_world[:3, :3].T + to_world[:3, 3]
        rows = (world, size[:, [2, 0, 1]], _quaternions(axes), moved[:, :2], one.score.cpu().double().numpy()[:, None],
                label[:, None], solid.attribute.cpu().double().numpy()[:, None])  # fmt: skip
        columns.append(tuple(r[near] for r in rows))
    if not columns:
        none = np.zeros((0, 1))
        columns = [(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 2)), none, none, none)]
    world, size, rotation, velocity, score, label, attribute = (np.concatenate(c) for c in zip(*columns, strict=True))
    turned = 2 * np.arctan2(rotation[:, 3], rotation[:, 0])
    flat = torch.from_numpy(np.column_stack([world[:, :2] - (world[:1, :2] if len(world) else 0.0),
                                             size[:, [1, 0]], turned]))  # fmt: skip
    enough = np.flatnonzero(score[:, 0] > LEAST)
    kept = rotated_nms(
        flat[enough], torch.from_numpy(score[enough, 0]), torch.from_numpy(label[enough, 0]), threshold=OVERLAP
    )
    rows = enough[kept.numpy()]
    if len(rows) > MOST:
        rows = rows[np.argsort(-score[rows, 0], kind="stable")[:MOST]]
    names = tuple(_attribute(int(k), int(a)) for k, a in zip(label[rows, 0], attribute[rows, 0], strict=True))
    return WorldBoxes(
        world[rows], size[rows], rotation[rows], velocity[rows], score[rows, 0], label[rows, 0].astype(np.int32), names
    )


def _upright(yaw: F64) -> F64:
    """Axes [N, 3, 3] (forward, left, up) of boxes in the camera frame, as columns."""
    cos, sin, none = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
    return np.stack(
        [np.stack([cos, none, -sin], -1), np.stack([sin, none, cos], -1), np.tile([0.0, -1.0, 0.0], (len(yaw), 1))],
        -1,
    )


def _quaternions(m: F64) -> F64:
    """Unit quaternions [N, 4] (w, x, y, z) of rotation matrices [N, 3, 3] that hardly tilt."""
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    half = [0.5 * np.sqrt(np.maximum(0.0, 1 + s)) for s in (xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy)]
    signs = (m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1])
    q = np.stack([half[0], *(np.copysign(h, s) for h, s in zip(half[1:], signs, strict=True))], -1)
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True), np.float64)


def _attribute(label: int, attribute: int) -> str:
    """The attribute's name where it fits the class, else the class's usual one."""
    name = ATTRIBUTES[attribute]
    if label in _VEHICLES:
        usual = "vehicle.moving" if CLASSES_3D[label] == "bus" else "vehicle.parked"
        return name if name.startswith("vehicle.") else usual
    if label in _CYCLES:
        return name if name.startswith("cycle.") else "cycle.without_rider"
    if CLASSES_3D[label] == "pedestrian":
        return name if name.startswith("pedestrian.") else "pedestrian.moving"
    return ""

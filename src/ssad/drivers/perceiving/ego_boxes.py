"""3D boxes of detected objects in the frame of an ego: the result of a perceiver for one row of an observation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.perception import I64, Objects, no_objects
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64
from ssad.drivers.perceiving.lift import Lifting, position_covariance
from ssad.drivers.perceiving.objects import KINDS

LEAST_SIZE = 0.2  # m, so that no object has an empty outline


@dataclass(frozen=True, slots=True)
class EgoBoxes:
    """Upright boxes of M objects in the frame of an ego: x forward, y left, z up, from the middle of its base.

    Attributes:
        centre: [M, 3] centre of the box, m.
        size_lwh: [M, 3] length, width and height, m; above 0.
        yaw: [M] heading, rad, counter-clockwise from x; NaN where unknown.
        velocity: [M, 2] over ground along x and y, m/s; NaN where unknown.
        label: [M] index into the `classes` of the perceiver.
        score: [M] confidence, 0 to 1.
        covariance: [M, 2, 2] covariance of x and y, m^2; None: that of `ssad.drivers.perceiving.lift.Lifting`, which
            grows with the distance.
    """

    centre: F64
    size_lwh: F64
    yaw: F64
    velocity: F64
    label: I64
    score: F64
    covariance: F64 | None = None

    def __len__(self) -> int:
        return len(self.score)


def check_boxes(boxes: EgoBoxes, classes: Sequence[str], perceiver: str) -> None:
    """Check the shapes and ranges of boxes.

    Args:
        boxes: The boxes.
        classes: Names of the labels.
        perceiver: Name of the perceiver, for the message.

    Raises:
        ConfigError: A column has a wrong shape, a value that is not finite or out of range; the message names it.
    """
    count = np.size(boxes.score)
    shapes = {
        "centre": (3,),
        "size_lwh": (3,),
        "yaw": (),
        "velocity": (2,),
        "label": (),
        "score": (),
        "covariance": (2, 2),
    }
    for name, shape in shapes.items():
        value = getattr(boxes, name)
        if value is None and name == "covariance":
            continue
        if np.shape(value) != (count, *shape):
            raise ConfigError(f"perceiver {perceiver}: {name} has shape {np.shape(value)}; expected {(count, *shape)}")
        if name not in ("yaw", "velocity") and not np.isfinite(value).all():
            raise ConfigError(f"perceiver {perceiver}: {name} holds a number that is not finite")
        if np.isinf(value).any():
            raise ConfigError(f"perceiver {perceiver}: {name} is infinite; NaN says that it is not known")
    label, score = np.asarray(boxes.label), np.asarray(boxes.score)
    if not np.issubdtype(label.dtype, np.integer) or ((label < 0) | (label >= len(classes))).any():
        raise ConfigError(f"perceiver {perceiver}: label must be an integer from 0 to {len(classes) - 1}")
    if ((score < 0.0) | (score > 1.0)).any():
        raise ConfigError(f"perceiver {perceiver}: score must lie between 0 and 1")
    if (np.asarray(boxes.size_lwh) <= 0.0).any():
        raise ConfigError(f"perceiver {perceiver}: size_lwh must be above 0 m")


def boxes_in_world(
    boxes: Sequence[EgoBoxes], poses: F64, scenes: I64, classes: Sequence[str], *, settings: Lifting
) -> Objects:
    """Return boxes as objects in the world; classes that are irrelevant to a driver are left out.

    Args:
        boxes: Boxes of n egos.
        poses: [n, 4, 4] ego to world.
        scenes: [n] scenes of the egos.
        classes: Names of the labels.
        settings: Source of the covariance of boxes without one.

    Returns:
        The objects, ego by ego, best first.
    """
    kinds = np.array([KINDS.get(name, 0) for name in classes], np.int64)
    parts = [no_objects()]
    for ego_boxes, pose, scene in zip(boxes, poses, scenes.tolist(), strict=True):
        score, label = np.asarray(ego_boxes.score, np.float64), np.asarray(ego_boxes.label, np.int64)
        order = np.argsort(-score, kind="stable")
        order = order[kinds[label[order]] > 0]
        rotation, count = pose[:2, :2], len(order)
        ego_pose = np.broadcast_to(pose, (count, 4, 4))
        place = _rotate(np.asarray(ego_boxes.centre, np.float64)[order, :2], rotation) + pose[:2, 3]
        if ego_boxes.covariance is None:
            spread, _ = position_covariance(place, ego_pose, settings)
        else:
            spread = rotation @ np.asarray(ego_boxes.covariance, np.float64)[order] @ rotation.T
        yaw = np.asarray(ego_boxes.yaw, np.float64)[order] + np.arctan2(rotation[1, 0], rotation[0, 0])
        objects = Objects(
            np.full(count, scene, np.int64),
            place,
            spread,
            np.asarray(wrap_angle(yaw), np.float64),
            np.maximum(np.asarray(ego_boxes.size_lwh, np.float64)[order, :2], LEAST_SIZE),
            _rotate(np.asarray(ego_boxes.velocity, np.float64)[order], rotation),
            kinds[label[order]],
            score[order],
        )
        parts.append(objects)
    return Objects.cat(parts)


def stop_sign_positions(boxes: EgoBoxes, pose: F64, labels: Sequence[int], *, score: float) -> F64:
    """Return the positions of the stop signs among boxes, x, y in the world [M, 2], m.

    Args:
        boxes: Boxes of an ego.
        pose: [4, 4] ego to world.
        labels: Labels of stop signs.
        score: Minimum score.
    """
    selected = np.isin(boxes.label, labels) & (np.asarray(boxes.score) >= score)
    return _rotate(np.asarray(boxes.centre, np.float64)[selected, :2], pose[:2, :2]) + pose[:2, 3]


def _rotate(vectors: F64, rotation: F64) -> F64:
    """Rotate vectors [M, 2], row by row: bit-identical in any batch."""
    return np.asarray((rotation[None] * vectors[:, None, :]).sum(-1))

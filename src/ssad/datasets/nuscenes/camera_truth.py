"""What a camera of a data set should find: the true boxes of a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ssad.core.boxes import NEAR, camera_yaw, hulls, size_columns
from ssad.core.detections import Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.nuscenes_names import CATEGORY_TO_CLASS, MMDET3D_ATTRIBUTES, MMDET3D_CLASSES, NO_ATTRIBUTE
from ssad.core.types import F64, Bool
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import Annotations, SensorFrame
from ssad.datasets.nuscenes.splits import scenes_of_split

if TYPE_CHECKING:
    import torch


def scenes_of(data: NuScenes, split: str) -> tuple[str, ...]:
    """Scenes of a split that the data set has.

    Raises:
        ConfigError: There is none, or no such split.
    """
    there = {scene.name for scene in data.scenes()}
    found = tuple(name for name in scenes_of_split(data.root, data.version, split) if name in there)
    if not found:
        raise ConfigError(f"{data.root / data.version}: none of its {len(there)} scenes is in the split '{split}'")
    return found


def camera_truth(frame: SensorFrame, found: Annotations, *, hit: bool = True) -> Truth:
    """What a camera should find of a sample's boxes: those of the ten classes whose middle is in the picture.

    Boxes are as `ssad.core.detections` defines them; velocity is in the camera's x and z; box is the hull of the
    projected corners, clipped to the picture.

    Args:
        frame: The camera frame.
        found: Annotations of its sample.
        hit: Whether only boxes with a LiDAR point count: what nobody can see is not learned.
    """
    import torch

    rows, box, turn = boxes_in_picture(frame, found, hit=hit)
    assert frame.intrinsic is not None
    own, centre = found.take(rows), found.centre @ turn[:3, :3].T + turn[:3, 3]
    ahead = own.axes()[:, :, 0] @ turn[:3, :3].T
    speed = own.velocity @ turn[:3, :3].T
    label = [MMDET3D_CLASSES.index(str(CATEGORY_TO_CLASS[name])) for name in own.category]
    attribute = [_attribute(names) for names in own.attributes]

    def floats(values: F64) -> torch.Tensor:
        return torch.from_numpy(np.array(values, np.float32))

    solid = Solids(
        floats(centre[rows]),
        floats(own.size_lwh[:, size_columns("lwh", "lhw")]),
        floats(camera_yaw(ahead)),
        floats(speed[:, [0, 2]]),
        torch.tensor(attribute, dtype=torch.int64),
    )
    return Truth(torch.tensor(label, dtype=torch.int64), floats(box), solid, floats(frame.intrinsic))


def boxes_in_picture(
    frame: SensorFrame, found: Annotations, *, hit: bool = True
) -> tuple[npt.NDArray[np.intp], F64, F64]:
    """Which boxes of a sample a camera should find: those of the ten classes whose middle is in its picture.

    Args:
        frame: The camera frame.
        found: Annotations of its sample.
        hit: Whether only boxes with a LiDAR point count.

    Returns:
        Their rows [N]; hulls of their corners [N, 4], pixels; from the world into the camera's frame [4, 4].

    Raises:
        ConfigError: It is no camera.
    """
    if frame.intrinsic is None:
        raise ConfigError(f"{frame.channel} is no camera")
    wanted = np.array([CATEGORY_TO_CLASS.get(c) in MMDET3D_CLASSES for c in found.category], bool)
    if hit and len(found):
        wanted &= found.lidar_points > 0
    turn: F64 = np.asarray(np.linalg.inv(frame.ego_to_world @ frame.sensor_to_ego), np.float64)
    centre = found.centre @ turn[:3, :3].T + turn[:3, 3]
    flat = centre @ frame.intrinsic.T
    with np.errstate(all="ignore"):
        middle = flat[:, :2] / flat[:, 2:]
    wanted &= (flat[:, 2] > NEAR) & (middle >= 0).all(1)
    wanted &= (middle[:, 0] < frame.width) & (middle[:, 1] < frame.height)
    box, seen = _hulls(frame, found, turn)
    rows = np.flatnonzero(wanted & seen)
    return rows, box[rows], turn


def _attribute(names: Sequence[str]) -> int:
    return MMDET3D_ATTRIBUTES.index(names[0]) if names and names[0] in MMDET3D_ATTRIBUTES else NO_ATTRIBUTE


def _hulls(frame: SensorFrame, found: Annotations, turn: F64) -> tuple[F64, Bool]:
    """2D boxes [N, 4] at pixel edges of 3D boxes, cut at the border, and which have any area."""
    assert frame.intrinsic is not None
    local = found.corners() @ turn[:3, :3].T + turn[:3, 3]
    box = hulls(local, frame.intrinsic, (frame.width, frame.height))
    return box, np.asarray(((box[:, 2:] - box[:, :2]) > 1.0).all(1))

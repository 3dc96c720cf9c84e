"""Ground truth of a camera of a data set: the true boxes of an image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ssad.core.boxes import NEAR, camera_yaw, image_rectangles, size_columns
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
    available = {scene.name for scene in data.scenes()}
    scenes = tuple(name for name in scenes_of_split(data.root, data.version, split) if name in available)
    if not scenes:
        raise ConfigError(f"{data.root / data.version}: none of its {len(available)} scenes is in the split '{split}'")
    return scenes


def camera_truth(frame: SensorFrame, annotations: Annotations, *, require_points: bool = True) -> Truth:
    """Return the boxes of a sample that a camera should find: of the ten classes, with their middle in the image.

    Boxes are as `ssad.core.detections` defines them; velocity is in the camera's x and z; box is the hull of the
    projected corners, clipped to the picture.

    Args:
        frame: The camera frame.
        annotations: Annotations of its sample.
        require_points: Whether only boxes with a LiDAR point count: what nobody can see is not learned.
    """
    import torch

    rows, box, world_to_camera = boxes_in_picture(frame, annotations, require_points=require_points)
    assert frame.intrinsic is not None
    visible_boxes, camera_centres = (
        annotations.take(rows),
        annotations.centre @ world_to_camera[:3, :3].T + world_to_camera[:3, 3],
    )
    axes = visible_boxes.axes()[:, :, 0] @ world_to_camera[:3, :3].T
    velocities = visible_boxes.velocity @ world_to_camera[:3, :3].T
    labels = [MMDET3D_CLASSES.index(str(CATEGORY_TO_CLASS[name])) for name in visible_boxes.category]
    attributes = [_attribute(names) for names in visible_boxes.attributes]

    def floats(values: F64) -> torch.Tensor:
        return torch.from_numpy(np.array(values, np.float32))

    solids = Solids(
        floats(camera_centres[rows]),
        floats(visible_boxes.size_lwh[:, size_columns("lwh", "lhw")]),
        floats(camera_yaw(axes)),
        floats(velocities[:, [0, 2]]),
        torch.tensor(attributes, dtype=torch.int64),
    )
    return Truth(torch.tensor(labels, dtype=torch.int64), floats(box), solids, floats(frame.intrinsic))


def boxes_in_picture(
    frame: SensorFrame, annotations: Annotations, *, require_points: bool = True
) -> tuple[npt.NDArray[np.intp], F64, F64]:
    """Select the boxes of a sample that a camera should find: of the ten classes, with their middle in the image.

    Args:
        frame: The camera frame.
        annotations: Annotations of its sample.
        require_points: Whether only boxes with a LiDAR point count.

    Returns:
        Their rows [N]; hulls of their corners [N, 4], pixels; from the world into the camera's frame [4, 4].

    Raises:
        ConfigError: It is no camera.
    """
    if frame.intrinsic is None:
        raise ConfigError(f"{frame.channel} is no camera")
    is_visible = np.array(
        [CATEGORY_TO_CLASS.get(category) in MMDET3D_CLASSES for category in annotations.category], bool
    )
    if require_points and len(annotations):
        is_visible &= annotations.lidar_points > 0
    world_to_camera: F64 = np.asarray(np.linalg.inv(frame.ego_to_world @ frame.sensor_to_ego), np.float64)
    camera_centres = annotations.centre @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    projected = camera_centres @ frame.intrinsic.T
    # Points in the camera's plane divide by zero; the depth test below drops them.
    with np.errstate(all="ignore"):
        middle = projected[:, :2] / projected[:, 2:]
    is_visible &= (projected[:, 2] > NEAR) & (middle >= 0).all(1)
    is_visible &= (middle[:, 0] < frame.width) & (middle[:, 1] < frame.height)
    box, has_area = _hulls(frame, annotations, world_to_camera)
    rows = np.flatnonzero(is_visible & has_area)
    return rows, box[rows], world_to_camera


def _attribute(names: Sequence[str]) -> int:
    return MMDET3D_ATTRIBUTES.index(names[0]) if names and names[0] in MMDET3D_ATTRIBUTES else NO_ATTRIBUTE


def _hulls(frame: SensorFrame, annotations: Annotations, rotation: F64) -> tuple[F64, Bool]:
    """2D boxes [N, 4] at pixel edges of 3D boxes, cut at the border, and which have any area."""
    assert frame.intrinsic is not None
    camera_corners = annotations.corners() @ rotation[:3, :3].T + rotation[:3, 3]
    box = image_rectangles(camera_corners, frame.intrinsic, (frame.width, frame.height))
    return box, np.asarray(((box[:, 2:] - box[:, :2]) > 1.0).all(1))

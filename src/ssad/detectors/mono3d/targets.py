"""Target assignment: the object that each place should predict, and its values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from ssad.core.detections import Assignment, Truth
from ssad.core.errors import ConfigError
from ssad.core.nuscenes_names import MMDET3D_CLASSES, NO_ATTRIBUTE
from ssad.detectors.mono3d.config import Mono3DConfig
from ssad.detectors.mono3d.decode import PlaceGrid, project

FAR = 1e8


def assign(
    config: Mono3DConfig,
    places: PlaceGrid,
    truth: Sequence[Truth],
    intrinsic: Tensor,
    scale: Tensor,
    *,
    rows_above: int = 0,
) -> Assignment:
    """Return the targets of B images.

    extra: reg [B, P, 13]: offset (place minus projected centre, in strides), depth, size, local yaw, velocity (NaN
    where unknown), 2D distances in strides; attribute [B, P]; centreness [B, P].

    Args:
        config: The configuration of the detector.
        places: Its places.
        truth: Truth of each image.
        intrinsic: Intrinsics of the pictures [B, 3, 3].
        scale: Factors (x, y) from the picture to the network's input [2].
        rows_above: Rows that the network's input has above the picture.

    Raises:
        ConfigError: The truth has no 3D boxes.
    """
    for image_index, image_truth in enumerate(truth):
        if image_truth.solid is None:
            raise ConfigError(f"{config.name}: the truth of image {image_index} has no 3D boxes")
        # On a GPU this check would wait for all queued work.
        if image_truth.label.device.type == "cpu" and bool(
            ((image_truth.label < 0) | (image_truth.label >= len(MMDET3D_CLASSES))).any()
        ):
            raise ConfigError(f"{config.name}: a label of image {image_index} is none of the ten classes")
    count = len(places.stride)
    device, dtype = places.xy.device, places.xy.dtype
    if not any(len(image_truth.label) for image_truth in truth):
        no_label = torch.full((len(truth), count), -1, dtype=torch.int64, device=device)
        regression = torch.zeros((len(truth), count, 13), dtype=dtype, device=device)
        extra = {
            "reg": regression,
            "attribute": torch.full_like(no_label, NO_ATTRIBUTE),
            "centreness": regression[..., 0].clone(),
        }
        return Assignment(no_label, no_label.clone(), tuple(truth), extra)
    label, owner, extra = _assign_places(
        config, places, _pad_objects(truth, device, dtype), intrinsic, scale, rows_above=rows_above
    )
    return Assignment(label, owner, tuple(truth), extra)


class _PaddedObjects(NamedTuple):
    """Objects of B images side by side, Q of each.

    Attributes:
        real: [B, Q] Whether a row holds an object that is no crowd.
    """

    real: Tensor
    label: Tensor
    box: Tensor
    centre: Tensor
    size_lhw: Tensor
    yaw: Tensor
    velocity: Tensor
    attribute: Tensor


def _pad_objects(truth: Sequence[Truth], device: torch.device, dtype: torch.dtype) -> _PaddedObjects:
    solids = [image_truth.solid for image_truth in truth if image_truth.solid is not None]

    def side_by_side(values: Sequence[Tensor]) -> Tensor:
        padded = pad_sequence(list(values), batch_first=True).to(device)
        return padded.to(dtype) if padded.is_floating_point() else padded

    real = [
        torch.ones_like(image_truth.label, dtype=torch.bool) if image_truth.crowd is None else ~image_truth.crowd
        for image_truth in truth
    ]
    return _PaddedObjects(
        side_by_side(real),
        side_by_side([image_truth.label for image_truth in truth]),
        side_by_side([image_truth.box for image_truth in truth]),
        side_by_side([solid.centre for solid in solids]),
        side_by_side([solid.size_lhw for solid in solids]),
        side_by_side([solid.yaw for solid in solids]),
        side_by_side([solid.velocity for solid in solids]),
        side_by_side([solid.attribute for solid in solids]),
    )


def _assign_places(
    config: Mono3DConfig,
    places: PlaceGrid,
    objects: _PaddedObjects,
    intrinsic: Tensor,
    scale: Tensor,
    *,
    rows_above: int,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Return label and owner [B, P] of every place, and its target values."""
    centre = project(objects.centre, intrinsic[:, None])  # [B, Q, 2] in the network's input
    box = objects.box * scale.to(objects.box).repeat(2) + objects.box.new_tensor([0.0, rows_above]).repeat(2)
    centre_offset = places.xy[:, None] - centre[:, None]  # [B, P, Q, 2]
    xy = places.xy[:, None]
    sides = torch.cat([xy - box[:, None, :, :2], box[:, None, :, 2:] - xy], -1)
    # The first range starts below 0, so that it includes every small object.
    limit = places.xy.new_tensor([-1.0, *config.ranges])
    widest = sides.amax(-1)
    is_candidate = (widest >= limit[places.level][:, None]) & (widest <= limit[places.level + 1][:, None])
    is_candidate &= (centre_offset.abs() < config.radius * places.stride[:, None, None]).all(-1) & objects.real[:, None]
    nearest_distance, nearest = torch.where(is_candidate, centre_offset.norm(dim=-1), FAR).min(2)
    is_object = nearest_distance < FAR

    def gather_nearest(values: Tensor) -> Tensor:
        """Return the values [B, P, ...] of the nearest object."""
        index = nearest.reshape(*nearest.shape, *(1,) * (values.ndim - 2)).expand(-1, -1, *values.shape[2:])
        return values.gather(1, index)

    offset = places.xy - gather_nearest(centre)
    stride = places.stride[:, None]
    nearest_box = gather_nearest(box)
    local = objects.yaw - torch.atan2(objects.centre[..., 0], objects.centre[..., 2])
    regression = torch.cat(
        [
            offset / stride,
            gather_nearest(objects.centre)[..., 2:],
            gather_nearest(objects.size_lhw),
            gather_nearest(local)[..., None],
            gather_nearest(objects.velocity),
            torch.cat([places.xy - nearest_box[..., :2], nearest_box[..., 2:] - places.xy], -1) / stride,
        ],
        -1,
    )
    relative_distance = offset.norm(dim=-1) / (1.414 * config.radius * places.stride)
    extra = {
        "reg": torch.where(is_object[..., None], regression, torch.zeros_like(regression)),
        "attribute": torch.where(is_object, gather_nearest(objects.attribute), NO_ATTRIBUTE),
        "centreness": torch.where(is_object, torch.exp(-2.5 * relative_distance), torch.zeros_like(relative_distance)),
    }
    return torch.where(is_object, gather_nearest(objects.label), -1), torch.where(is_object, nearest, -1), extra

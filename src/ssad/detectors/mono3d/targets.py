"""Target assignment: which object each location should predict, and with which values."""

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
from ssad.detectors.mono3d.decode import Places, project

FAR = 1e8


def assign(
    config: Mono3DConfig, places: Places, truth: Sequence[Truth], lens: Tensor, scale: Tensor, *, above: int = 0
) -> Assignment:
    """Targets of B images.

    extra: reg [B, P, 13]: offset (place minus projected centre, in strides), depth, size, local yaw, velocity (NaN
    where unknown), 2D distances in strides; attribute [B, P]; centreness [B, P].

    Args:
        config: The configuration of the detector.
        places: Its places.
        truth: Truth of each image.
        lens: Intrinsics of the pictures [B, 3, 3].
        scale: Factors (x, y) from the picture to the network's input [2].
        above: Rows that the network's input has above the picture.

    Raises:
        ConfigError: The truth has no 3D boxes.
    """
    for k, one in enumerate(truth):
        if one.solid is None:
            raise ConfigError(f"{config.name}: the truth of image {k} has no 3D boxes")
        if one.label.device.type == "cpu" and bool(((one.label < 0) | (one.label >= len(MMDET3D_CLASSES))).any()):
            raise ConfigError(f"{config.name}: a label of image {k} is none of the ten classes")
    count = len(places.stride)
    device, dtype = places.xy.device, places.xy.dtype
    if not any(len(one.label) for one in truth):
        none = torch.full((len(truth), count), -1, dtype=torch.int64, device=device)
        reg = torch.zeros((len(truth), count, 13), dtype=dtype, device=device)
        extra = {
            "reg": reg,
            "attribute": torch.full_like(none, NO_ATTRIBUTE),
            "centreness": reg[..., 0].clone(),
        }
        return Assignment(none, none.clone(), tuple(truth), extra)
    label, owner, extra = _all(config, places, _pad(truth, device, dtype), lens, scale, above=above)
    return Assignment(label, owner, tuple(truth), extra)


class _Padded(NamedTuple):
    """Objects of B images side by side, Q of each; real [B, Q]: those that are there and are no crowd."""

    real: Tensor
    label: Tensor
    box: Tensor
    centre: Tensor
    size_lhw: Tensor
    yaw: Tensor
    velocity: Tensor
    attribute: Tensor


def _pad(truth: Sequence[Truth], device: torch.device, dtype: torch.dtype) -> _Padded:
    solids = [one.solid for one in truth if one.solid is not None]

    def side_by_side(values: Sequence[Tensor]) -> Tensor:
        one = pad_sequence(list(values), batch_first=True).to(device)
        return one.to(dtype) if one.is_floating_point() else one

    real = [torch.ones_like(one.label, dtype=torch.bool) if one.crowd is None else ~one.crowd for one in truth]
    return _Padded(
        side_by_side(real),
        side_by_side([one.label for one in truth]),
        side_by_side([one.box for one in truth]),
        side_by_side([s.centre for s in solids]),
        side_by_side([s.size_lhw for s in solids]),
        side_by_side([s.yaw for s in solids]),
        side_by_side([s.velocity for s in solids]),
        side_by_side([s.attribute for s in solids]),
    )


def _all(
    config: Mono3DConfig, places: Places, objects: _Padded, lens: Tensor, scale: Tensor, *, above: int
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Label and owner [B, P] of every place, and what it should say."""
    centre = project(objects.centre, lens[:, None])  # [B, Q, 2] in the network's input
    box = objects.box * scale.to(objects.box).repeat(2) + objects.box.new_tensor([0.0, above]).repeat(2)
    away = places.xy[:, None] - centre[:, None]  # [B, P, Q, 2]
    xy = places.xy[:, None]
    sides = torch.cat([xy - box[:, None, :, :2], box[:, None, :, 2:] - xy], -1)
    limit = places.xy.new_tensor([-1.0, *config.ranges])
    widest = sides.amax(-1)
    fits = (widest >= limit[places.level][:, None]) & (widest <= limit[places.level + 1][:, None])
    fits &= (away.abs() < config.radius * places.stride[:, None, None]).all(-1) & objects.real[:, None]
    least, nearest = torch.where(fits, away.norm(dim=-1), FAR).min(2)
    found = least < FAR

    def of(values: Tensor) -> Tensor:
        """Those of the nearest object, [B, P, ...]."""
        index = nearest.reshape(*nearest.shape, *(1,) * (values.ndim - 2)).expand(-1, -1, *values.shape[2:])
        return values.gather(1, index)

    picked = places.xy - of(centre)
    stride = places.stride[:, None]
    near = of(box)
    local = objects.yaw - torch.atan2(objects.centre[..., 0], objects.centre[..., 2])
    reg = torch.cat(
        [
            picked / stride,
            of(objects.centre)[..., 2:],
            of(objects.size_lhw),
            of(local)[..., None],
            of(objects.velocity),
            torch.cat([places.xy - near[..., :2], near[..., 2:] - places.xy], -1) / stride,
        ],
        -1,
    )
    relative = picked.norm(dim=-1) / (1.414 * config.radius * places.stride)
    extra = {
        "reg": torch.where(found[..., None], reg, torch.zeros_like(reg)),
        "attribute": torch.where(found, of(objects.attribute), NO_ATTRIBUTE),
        "centreness": torch.where(found, torch.exp(-2.5 * relative), torch.zeros_like(relative)),
    }
    return torch.where(found, of(objects.label), -1), torch.where(found, nearest, -1), extra

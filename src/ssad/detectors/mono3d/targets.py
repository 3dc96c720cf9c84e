"""Which place answers for which object, and what it should say."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ssad.detections import ATTRIBUTES, CLASSES_3D, Assignment, Truth
from ssad.detectors.mono3d.config import Mono3DConfig
from ssad.detectors.mono3d.decode import Places, project
from ssad.errors import ConfigError

FAR = 1e8


def assign(config: Mono3DConfig, places: Places, truth: Sequence[Truth], lens: Tensor, scale: Tensor) -> Assignment:
    """Targets of B images; lens [B, 3, 3] and `scale` [2] (x, y) lead from the picture to the network's input.

    extra: reg [B, P, 13]: offset (place minus projected centre, in strides), depth, size, local yaw, velocity (NaN
    where unknown), 2D distances in strides; attribute [B, P]; centreness [B, P]. ConfigError: truth without 3D boxes.
    """
    rows = []
    for k, one in enumerate(truth):
        if one.solid is None:
            raise ConfigError(f"{config.name}: the truth of image {k} has no 3D boxes")
        if one.label.device.type == "cpu" and bool(((one.label < 0) | (one.label >= len(CLASSES_3D))).any()):
            raise ConfigError(f"{config.name}: a label of image {k} is none of the ten classes")
        rows.append(_one(config, places, one, lens[k], scale))
    label, owner, reg, attribute, centreness = (torch.stack(column) for column in zip(*rows, strict=True))
    return Assignment(label, owner, tuple(truth), {"reg": reg, "attribute": attribute, "centreness": centreness})


def _one(
    config: Mono3DConfig, places: Places, truth: Truth, lens: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Label, owner, regression, attribute, centreness of every place of one image."""
    count = len(places.stride)
    device, dtype = places.xy.device, places.xy.dtype
    label = torch.full((count,), -1, dtype=torch.int64, device=device)
    owner = label.clone()
    reg = torch.zeros((count, 13), dtype=dtype, device=device)
    attribute = torch.full((count,), len(ATTRIBUTES) - 1, dtype=torch.int64, device=device)
    centreness = torch.zeros(count, dtype=dtype, device=device)
    solid = truth.solid
    if solid is None or not len(truth.label):
        return label, owner, reg, attribute, centreness
    centre = project(solid.centre.to(dtype), lens)  # [Q, 2] in the network's input
    box = truth.box.to(dtype) * scale.repeat(2)
    away = places.xy[:, None] - centre
    sides = torch.cat([places.xy[:, None] - box[:, :2], box[:, 2:] - places.xy[:, None]], -1)
    limit = places.xy.new_tensor([-1.0, *config.ranges])
    widest = sides.amax(-1)
    fits = (widest >= limit[places.level][:, None]) & (widest <= limit[places.level + 1][:, None])
    inside = (away.abs() < config.radius * places.stride[:, None, None]).all(-1)
    if truth.crowd is not None:
        inside &= ~truth.crowd
    distance = torch.where(inside & fits, away.norm(dim=-1), FAR)
    least, nearest = distance.min(1)
    found = least < FAR
    owner = torch.where(found, nearest, owner)
    label = torch.where(found, truth.label[nearest], label)
    stride = places.stride[:, None]
    picked = away[torch.arange(count, device=device), nearest]
    local = solid.yaw.to(dtype) - torch.atan2(solid.centre[:, 0], solid.centre[:, 2]).to(dtype)
    reg = torch.cat(
        [picked / stride, solid.centre[nearest, 2:].to(dtype), solid.size[nearest].to(dtype), local[nearest, None],
         solid.velocity[nearest].to(dtype), sides[torch.arange(count, device=device), nearest] / stride], 1,
    )  # fmt: skip
    reg = torch.where(found[:, None], reg, torch.zeros_like(reg))
    attribute = torch.where(found, solid.attribute[nearest], attribute)
    relative = picked.norm(dim=-1) / (1.414 * config.radius * places.stride)
    centreness = torch.where(found, torch.exp(-2.5 * relative), centreness)
    return label, owner, reg, attribute, centreness

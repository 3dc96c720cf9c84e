"""Inputs and outputs of detectors, as tensors. Importing this does not import torch.

Shape letters: B images, P places (all cells, anchors and levels of a detector, one after the other), C classes,
N objects, Q true objects. 2D boxes are x1, y1, x2, y2 in pixels of the image passed in, at pixel edges
(pixel 0 spans 0 to 1). 3D boxes are in the camera frame (x right, y down, z forward), metres and radians:
size is length, height, width (along x, y, z at yaw 0), yaw turns about the y axis as in mmdetection3d and KITTI
(yaw 0: the length along x; positive from z towards x).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.columns import concatenate
from ssad.core.errors import ConfigError
from ssad.core.types import U8

if TYPE_CHECKING:
    import torch
    from torch import Tensor


@dataclass(frozen=True, slots=True)
class Solids:
    """3D boxes in the camera frame.

    Attributes:
        centre: Centre of gravity [N, 3], m.
        size_lhw: Length, height and width [N, 3], m.
        yaw: Rotation about the y axis [N], rad.
        velocity: Velocity along x and z [N, 2], m/s; NaN where unknown.
        attribute: Index into `MMDET3D_ATTRIBUTES` [N].
    """

    centre: Tensor
    size_lhw: Tensor
    yaw: Tensor
    velocity: Tensor
    attribute: Tensor

    @staticmethod
    def cat(parts: Sequence[Solids]) -> Solids:
        """Concatenate boxes in order; at least one part is required."""
        return concatenate(parts)


@dataclass(frozen=True, slots=True)
class Truth:
    """The true objects in one image.

    Attributes:
        label: Index into the detector's classes [Q].
        box: 2D boxes [Q, 4].
        solid: 3D boxes; None for 2D detection.
        intrinsic: Camera matrix [3, 3]; None for 2D detection.
        crowd: Objects that count neither as detected nor as missed, being too small or too occluded [Q] bool.
    """

    label: Tensor
    box: Tensor
    solid: Solids | None = None
    intrinsic: Tensor | None = None
    crowd: Tensor | None = None


@dataclass(frozen=True, slots=True)
class Detections:
    """The objects detected in one image, best first.

    Attributes:
        score: Confidence in 0..1 [N].
        label: Index into the detector's classes [N].
        box: 2D boxes [N, 4]; for 3D, the hull of the projected corners unless the detector predicts 2D boxes
            itself.
        solid: 3D boxes; None for 2D detection.
    """

    score: Tensor
    label: Tensor
    box: Tensor
    solid: Solids | None = None

    @staticmethod
    def cat(parts: Sequence[Detections]) -> Detections:
        """Concatenate detections of one image in order; at least one part is required.

        Raises:
            ValueError: Some parts have 3D boxes and some have none.
        """
        solids = [part.solid for part in parts if part.solid is not None]
        if solids and len(solids) < len(parts):
            raise ValueError("detections with and without 3D boxes cannot be concatenated")
        score, label, box = (_cat([getattr(part, name) for part in parts]) for name in ("score", "label", "box"))
        return Detections(score, label, box, Solids.cat(solids) if solids else None)

    @staticmethod
    def cpu(images: Sequence[Detections]) -> list[Detections]:
        """Copy the detections of images to the CPU, each column at once, since every copy waits for the device.

        Raises:
            ConfigError: The columns are not tensors.
        """
        flat_columns = zip(
            *(_cpu([getattr(image, name) for image in images]) for name in ("score", "label", "box")), strict=True
        )
        solids = [image.solid for image in images if image.solid is not None]
        names = [column.name for column in fields(Solids)]
        columns = zip(*(_cpu([getattr(solid, name) for solid in solids]) for name in names), strict=True)
        # The images that have 3D boxes take theirs in order.
        return [
            Detections(score, label, box, None if image.solid is None else Solids(*next(columns)))
            for image, (score, label, box) in zip(images, flat_columns, strict=True)
        ]


def _cat(parts: Sequence[Tensor]) -> Tensor:
    import torch

    return torch.cat(list(parts))


def _cpu(parts: Sequence[Tensor]) -> Sequence[Tensor]:
    import torch

    if not all(isinstance(part, torch.Tensor) for part in parts):
        raise ConfigError("broken promise: Detections holds tensors")
    return parts if all(part.device.type == "cpu" for part in parts) else transform_together(parts, torch.Tensor.cpu)


def transform_together(parts: Sequence[Tensor], transform: Callable[[Tensor], Tensor]) -> list[Tensor]:
    """Return the changed parts [N, ...], all changed in one call where they are of a kind.

    Args:
        parts: At least one.
        transform: Treats each row by itself.
    """
    import torch

    if len({(part.dtype, part.shape[1:], part.device, part.ndim) for part in parts}) > 1 or not parts[0].ndim:
        return [transform(part) for part in parts]
    return list(torch.split(transform(torch.cat(list(parts))), [len(part) for part in parts]))


@dataclass(frozen=True, slots=True)
class Dense:
    """Raw outputs before any threshold or suppression, differentiable with respect to the image.

    Attributes:
        logit: Class logits [B, P, C].
        quality: Logit whose sigmoid multiplies the class score (objectness, centreness) [B, P]; None for
            detectors without one.
        box: 2D boxes [B, P, 4].
        place: x, y of the cell's centre [P, 2], pixels.
        stride: Stride of each place [P], pixels.
        level: Index of the map of each place [P].
        maps: The detector's own maps by name, as its source returns them.
        features: Maps of trunk or neck [B, K, h, w], finest first, for attention-based attacks.
        size: Height and width of the image.
    """

    logit: Tensor
    quality: Tensor | None
    box: Tensor
    place: Tensor
    stride: Tensor
    level: Tensor
    maps: Mapping[str, list[Tensor]]
    features: tuple[Tensor, ...] = ()
    size: tuple[int, int] = (0, 0)


@dataclass(frozen=True, slots=True)
class Assignment:
    """Target assignment: which object each location is trained to predict. Fixed before an attack or a training step.

    Attributes:
        label: Class [B, P]; -1 background, -2 ignored.
        owner: Index into that image's objects [B, P]; -1 for none.
        truth: The objects of each image.
        extra: What else the detector's loss needs.
    """

    label: Tensor
    owner: Tensor
    truth: tuple[Truth, ...]
    extra: Mapping[str, Tensor] = field(default_factory=dict)


def to_images(images: Sequence[U8], device: torch.device | str) -> Tensor:
    """Return images uint8 RGB [H, W, 3] of one size as float [B, 3, H, W] in 0 to 1 on a device."""
    import torch

    stacked = torch.from_numpy(np.stack(images)).to(device)
    return stacked.permute(0, 3, 1, 2).float() / 255

"""Decoding of dense maps to boxes: places, projection, yaw, corners."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

NEAR = 0.1  # m; corners nearer to the camera are moved there before projection


@dataclass(frozen=True, slots=True)
class FlatMaps:
    """Maps of all levels as rows: level after level, each row by row.

    Attributes:
        logit: Class logits [B, P, 10].
        reg: Regression [B, P, 9 or 13]; see `Head.forward`.
        direction: Logits of the direction bins [B, P, 2], or the vectors of the yaw [B, P, 4].
        attribute: Logits of the attributes [B, P, 9].
        centreness: Logits [B, P].
        bins: Logits of the depth bins [B, P, 6]; None without them.
    """

    logit: Tensor
    reg: Tensor
    direction: Tensor
    attribute: Tensor
    centreness: Tensor
    bins: Tensor | None


@dataclass(frozen=True, slots=True)
class PlaceGrid:
    """P places: x, y of each in pixels [P, 2] (stride times index plus half the stride), stride [P], level [P]."""

    xy: Tensor
    stride: Tensor
    level: Tensor


def flatten(maps: dict[str, list[Tensor]]) -> FlatMaps:
    """Flatten the maps of all levels to rows."""

    def rows(name: str) -> Tensor:
        return torch.cat([level_map.flatten(2).transpose(1, 2) for level_map in maps[name]], 1)

    return FlatMaps(
        rows("cls_scores"),
        rows("bbox_preds"),
        rows("dir_cls_preds"),
        rows("attr_preds"),
        rows("centernesses")[..., 0],
        rows("depth_cls_preds") if "depth_cls_preds" in maps else None,
    )


def select_rows(flat_maps: FlatMaps, image: Tensor, rows: Tensor) -> FlatMaps:
    """Return the rows [N] of images [N]."""
    bins = None if flat_maps.bins is None else flat_maps.bins[image, rows]
    return FlatMaps(
        flat_maps.logit[image, rows],
        flat_maps.reg[image, rows],
        flat_maps.direction[image, rows],
        flat_maps.attribute[image, rows],
        flat_maps.centreness[image, rows],
        bins,
    )


def places_of(maps: list[Tensor], strides: tuple[int, ...]) -> PlaceGrid:
    """Return the places of maps [B, C, h, w]."""
    xy, strides_of_places, level = [], [], []
    for level_index, (level_map, stride) in enumerate(zip(maps, strides, strict=True)):
        y, x = torch.meshgrid(
            torch.arange(level_map.shape[2], device=level_map.device),
            torch.arange(level_map.shape[3], device=level_map.device),
            indexing="ij",
        )
        positions = torch.stack([x, y], -1).reshape(-1, 2).to(level_map.dtype) * stride + stride // 2
        xy.append(positions)
        strides_of_places.append(torch.full((len(positions),), stride, dtype=level_map.dtype, device=level_map.device))
        level.append(torch.full((len(positions),), level_index, dtype=torch.int64, device=level_map.device))
    return PlaceGrid(torch.cat(xy), torch.cat(strides_of_places), torch.cat(level))


def unproject(points: Tensor, intrinsic: Tensor, image: Tensor | None = None) -> Tensor:
    """Return points in the camera frame from pixels and depths.

    Args:
        points: u, v (pixels) and depth (m) [..., 3].
        intrinsic: Intrinsics [..., 3, 3], broadcast against the points; or one for each image [B, 3, 3].
        image: Image that each of the points [N, 3] belongs to [N]; None: `intrinsic` is broadcast.

    Returns:
        x, y, z [..., 3], m.
    """
    u, v, depth = points.unbind(-1)
    homogeneous = torch.stack([u * depth, v * depth, depth], -1)
    # inv_ex, unlike inv, does not wait for the GPU to check that the matrix is invertible.
    inverse: Tensor = torch.linalg.inv_ex(intrinsic.double())[0].to(points.dtype)
    if image is not None:
        inverse = inverse[image]
    return (inverse @ homogeneous[..., None])[..., 0]


def project(points: Tensor, intrinsic: Tensor, *, near: float | None = NEAR) -> Tensor:
    """Return u, v [..., 2] of points [..., 3] in the camera frame, depth clamped to `near` (None: anything but 0)."""
    homogeneous = (intrinsic @ points[..., None])[..., 0]
    depth = homogeneous[..., 2:]
    if near is None:
        return homogeneous[..., :2] / torch.where(depth.abs() < 1e-4, 1e-4, depth)
    return homogeneous[..., :2] / depth.clamp_min(near)


def vectors_of_yaw(yaw: Tensor) -> Tensor:
    """Return cosine and sine of the yaw and of twice the yaw [..., 4]."""
    return torch.stack([yaw.cos(), yaw.sin(), (2 * yaw).cos(), (2 * yaw).sin()], -1)


def yaw_of_vectors(vectors: Tensor, dim: int = -1) -> Tensor:
    """Return the yaw (-pi/2 to 3 pi/2) from two vectors along `dim`, which may be of any length.

    The second vector has the direction of twice the yaw and gives the axis. The first gives the direction along
    it by the sign of its component along the axis; twice this component is the logit of that end being the front.
    """
    cos, sin, cos2, sin2 = vectors.unbind(dim)
    axis = torch.atan2(sin2, cos2) / 2
    points_back = axis.cos() * cos + axis.sin() * sin < 0
    return axis + torch.pi * points_back.to(axis.dtype)


def global_yaw(local: Tensor, direction: Tensor | None, u: Tensor, intrinsic: Tensor, *, offset: float) -> Tensor:
    """Return the yaw from the regressed one, the direction bin [...] and the column u of the centre.

    With a bin, the regressed yaw holds up to half a turn; without (None), it is whole. The viewing angle is taken from
    the focal length along x, as in the source.
    """
    if direction is None:
        return local + ray_angle(u, intrinsic)
    wrapped = local - offset
    wrapped = wrapped - (wrapped / torch.pi).floor() * torch.pi
    return wrapped + offset + torch.pi * direction.to(local.dtype) + ray_angle(u, intrinsic)


def ray_angle(u: Tensor, intrinsic: Tensor) -> Tensor:
    """Return the angle between the ray of column u and the optical axis."""
    return torch.atan2(u - intrinsic[..., 0, 2], intrinsic[..., 0, 0])


def hull(points: Tensor) -> Tensor:
    """Return the bounding rectangle x0, y0, x1, y1 [..., 4] of points [..., K, 2]."""
    return torch.cat([points.amin(-2), points.amax(-2)], -1)

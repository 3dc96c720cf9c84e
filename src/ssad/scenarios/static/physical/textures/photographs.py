"""Textures pasted onto cars in photographs: a planar homography of the face that the camera sees.

The face is the rear or the front of a car's 3D box, or its 2D box where there is none. The texture lies where it lies
on the body that it was made for, and leaves lamps and plate free. The light on the print is estimated: under it the
surroundings of the car have the mean reflectance of a grey world.

Sources: Hartley and Zisserman, Multiple View Geometry (2004), 2.3 (homography of a plane); Buchsbaum, A spatial
processor model for object colour perception (1980), for the grey world.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
import torch
from torch import Tensor

from ssad.core.boxes import camera_axes
from ssad.core.colours import LUMINANCE
from ssad.core.errors import ConfigError
from ssad.core.images import encode_srgb
from ssad.core.types import F32, F64, U8, Bool
from ssad.rendering.camera.scene import TextureLayer
from ssad.rendering.camera.texture import to_linear
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.target import TargetCar, parse_target
from ssad.scenarios.static.physical.textures.carrier import albedo_of
from ssad.scenarios.static.physical.textures.perturbation import Texture

GREY_WORLD: Final = 0.18  # mean reflectance of outdoor scenes
SURROUNDINGS: Final = 2.0  # sides of the part of a photograph that the light is estimated from, in sides of the box
SAMPLES: Final = 4  # samples per pixel and direction of a pasted print
MIN_FACING: Final = 0.5  # least cosine between the normal of a face and the direction to the camera
MAX_RATIO: Final = 1.4  # width by height of a 2D box from which on a car counts as seen from the side
PANEL: Final = "rear"


@dataclass(frozen=True, slots=True)
class FacePrint:
    """Part of a texture that lies on the rear of a car, and its place.

    Attributes:
        colour: sRGB [3, H, W] in 0 to 1.
        mask: Texels [H, W] that lie on paint; all others leave the car as it is.
        rectangle: Left, top, right and bottom as shares of the face of the car's box, from its upper left corner as
            seen from behind; parts may lie beyond it.
    """

    colour: Tensor
    mask: Bool
    rectangle: tuple[float, float, float, float]


@lru_cache(maxsize=32)
def face_print(texture: str) -> FacePrint:
    """Return the part of a texture that lies on the rear of the car that it was made for.

    Args:
        texture: Name or file, as for `Texture`.

    Raises:
        ConfigError: It is no texture of a car, or does not lie on its rear.
        SSADError: See `Texture`.
    """
    printed = Texture(texture).printed_texture()
    target = parse_target(printed.target)
    if not isinstance(target, TargetCar):
        raise ConfigError(f"texture '{texture}': it is made for {printed.target}; choose one that is made for a car")
    body_mesh = target.mesh()
    surface = printed.on(body_mesh)
    if not isinstance(surface.layer, TextureLayer):
        raise ConfigError(f"texture '{texture}': it lies beside the car; choose one that lies on its rear")
    panel = body_mesh.panel_rectangle(PANEL)
    u0, v0, u1, v1 = surface.layer.rectangle
    atlas_part = (max(u0, panel[0]), max(v0, panel[1]), min(u1, panel[2]), min(v1, panel[3]))
    if atlas_part[2] <= atlas_part[0] or atlas_part[3] <= atlas_part[1]:
        raise ConfigError(f"texture '{texture}': it does not lie on the {PANEL} of the car; choose one that does")
    _, pixel_height, pixel_width = printed.colour.shape
    left, right = (round((u - u0) / (u1 - u0) * pixel_width) for u in (atlas_part[0], atlas_part[2]))
    top, bottom = (round((v - v0) / (v1 - v0) * pixel_height) for v in (atlas_part[1], atlas_part[3]))
    texel_crop = np.s_[top : max(bottom, top + 1), left : max(right, left + 1)]
    return FacePrint(
        printed.colour[:, *texel_crop].contiguous(), surface.mask[texel_crop], _share_rectangle(body_mesh, atlas_part)
    )


def _share_rectangle(
    body_mesh: Mesh, atlas_part: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """Return where a rectangle of the atlas lies on the rear of a body, in shares of the rear of its box."""
    is_rear = np.isin(body_mesh.panel, body_mesh.panel_indices(PANEL))
    texture_points = body_mesh.uv[is_rear].reshape(-1, 2).astype(np.float64)
    corners = body_mesh.corners()[is_rear].reshape(-1, 3).astype(np.float64)
    lowest, highest = body_mesh.bounds()
    # From behind, the body's left (+y) is at the left.
    shares = np.stack([highest[1] - corners[:, 1], highest[2] - corners[:, 2]], -1) / (highest[1:] - lowest[1:])
    design = np.concatenate([texture_points, np.ones((len(texture_points), 1))], 1)
    affine_fit, *_ = np.linalg.lstsq(design, shares, rcond=None)
    (left_share, top_share), (right_share, bottom_share) = (
        np.array([[atlas_part[0], atlas_part[1], 1.0], [atlas_part[2], atlas_part[3], 1.0]]) @ affine_fit
    )
    return float(left_share), float(top_share), float(right_share), float(bottom_share)


def face_quad(rectangle: tuple[float, float, float, float], box: F64, solid: F64, intrinsic: F64 | None) -> F64 | None:
    """Return the corners of a part of the face that a camera sees of a car.

    Args:
        rectangle: Left, top, right and bottom in shares of the face.
        box: 2D box [4], pixels.
        solid: 3D box [7] as `ssad.datasets.photographs.Photograph` has it; NaN: there is none.
        intrinsic: Camera matrix [3, 3]; None: unknown.

    Returns:
        Upper left, upper right, lower right and lower left corner [4, 2], pixels; None for a car seen from the side.
    """
    left_share, top_share, right_share, bottom_share = rectangle
    shares = np.array(
        [[left_share, top_share], [right_share, top_share], [right_share, bottom_share], [left_share, bottom_share]]
    )
    if intrinsic is None or not np.isfinite(solid).all():
        pixel_width, pixel_height = box[2] - box[0], box[3] - box[1]
        return (
            None
            if pixel_width > MAX_RATIO * pixel_height
            else np.asarray(box[:2] + shares * np.array([pixel_width, pixel_height]))
        )
    centre, (length, pixel_height, pixel_width) = solid[:3], solid[3:6]
    forward, left, up = camera_axes(solid[6:7])[0].T
    is_front = bool(forward @ centre < 0)
    normal = forward if is_front else -forward
    middle = centre + 0.5 * length * normal
    if normal @ -middle < MIN_FACING * np.linalg.norm(middle):
        return None
    to_left = -left if is_front else left
    points = middle + (0.5 - shares[:, :1]) * pixel_width * to_left + (0.5 - shares[:, 1:]) * pixel_height * up
    if points[:, 2].min() <= 0.5:
        return None
    projected = points @ intrinsic.T
    return np.asarray(projected[:, :2] / projected[:, 2:])


def paste(image: U8, colour: Tensor, mask: Bool, quad: F64, *, light: F32) -> U8:
    """Return a photograph in which a print lies on a face of a car.

    Args:
        image: The photograph [H, W, 3].
        colour: The print, sRGB [3, h, w] in 0 to 1.
        mask: Texels [h, w] that are printed.
        quad: Corners of the print in the photograph [4, 2], pixels, as `face_quad` returns them.
        light: Light on the print, linear RGB [3] (`light_on`).
    """
    pixel_height, pixel_width = image.shape[:2]
    lower_corner = np.clip(np.floor(quad.min(0)).astype(int), 0, (pixel_width, pixel_height))
    upper_corner = np.clip(np.ceil(quad.max(0)).astype(int), 0, (pixel_width, pixel_height))
    columns, rows = (int(length) for length in upper_corner - lower_corner)
    if columns < 1 or rows < 1:
        return image.copy()
    mask_layer = mask[..., None].astype(np.float32)
    print_layer = np.concatenate([albedo_of(colour).permute(1, 2, 0).numpy() * mask_layer, mask_layer], 2)
    texels = np.array([[0, 0], [mask.shape[1], 0], [mask.shape[1], mask.shape[0]], [0, mask.shape[0]]])
    # OpenCV's pixel centres are whole numbers.
    corners = (quad - lower_corner) * SAMPLES - 0.5
    transform = cv2.getPerspectiveTransform((texels - 0.5).astype(np.float32), corners.astype(np.float32))
    size = (columns * SAMPLES, rows * SAMPLES)
    warped = cv2.warpPerspective(print_layer, transform, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = np.zeros(size[::-1], np.float32)
    # Corners with 4 fractional bits.
    cv2.fillConvexPoly(inside, np.rint(corners * 16).astype(np.int32), 1.0, cv2.LINE_8, 4)
    warped *= inside[..., None]
    averaged = cv2.resize(warped, (columns, rows), interpolation=cv2.INTER_AREA)
    window = np.s_[lower_corner[1] : upper_corner[1], lower_corner[0] : upper_corner[0]]
    lit = np.minimum(averaged[..., :3] * light, averaged[..., 3:])
    pasted = image.copy()
    pasted[window] = encode_srgb(_linear(image[window]) * (1 - averaged[..., 3:]) + lit)
    return pasted


def light_on(image: U8, box: F64) -> F32:
    """Return the light on a car, linear RGB [3], under which its surroundings have the mean of a grey world."""
    pixel_height, pixel_width = image.shape[:2]
    centre, sides = (box[:2] + box[2:]) / 2, SURROUNDINGS * (box[2:] - box[:2]) / 2
    lower_corner = np.clip(np.floor(centre - sides).astype(int), 0, (pixel_width - 1, pixel_height - 1))
    upper_corner = np.clip(np.ceil(centre + sides).astype(int), lower_corner + 1, (pixel_width, pixel_height))
    mean = _linear(image[lower_corner[1] : upper_corner[1], lower_corner[0] : upper_corner[0]]).reshape(-1, 3).mean(0)
    # Brightness alone: the colours of few objects say little about the colour of the light.
    return np.full(3, mean @ LUMINANCE / GREY_WORLD, np.float32)


def _linear(image: U8) -> F32:
    return np.asarray(to_linear(torch.from_numpy(image.astype(np.float32) / 255)).numpy())

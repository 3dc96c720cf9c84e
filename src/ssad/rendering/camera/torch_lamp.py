"""The light of a lamp in torch, differentiable with respect to where it is and how it shines.

`render(..., surface=True)` says what each pixel shows. From that, what a lamp would add follows without rendering
again, as the kernels compute it, but for the shadows that it casts and for what of it is mirrored.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.rendering.camera.lamps import Lamp
from ssad.rendering.camera.render import Picture


def lamp_light(
    lamp: Lamp,
    position: Tensor,
    normal: Tensor,
    *,
    pose: Tensor | None = None,
    power: Tensor | None = None,
    spread: Tensor | None = None,
    fog: float = 0.0,
) -> Tensor:
    """Irradiance over pi that a lamp gives to points, without shadows.

    Args:
        lamp: The lamp; its fields stand for what is not given as a tensor. It projects no texture.
        position: Points in the world [..., 3], m.
        normal: Their normals [..., 3], unit.
        pose: Lamp to world [4, 4] (x across, y down, z ahead), in place of the lamp's.
        power: In place of the lamp's, scalar.
        spread: Tangents of the half angles across and down [2], in place of the lamp's.
        fog: Extinction, 1/m (`Weather.fog`).

    Returns:
        Linear RGB [..., 3], differentiable with respect to all tensors; at the edge of a rectangle it jumps.

    Raises:
        ConfigError: The lamp projects a texture (see `ssad.rendering.camera.texture`).
    """
    if lamp.texture >= 0:
        raise ConfigError(
            "a lamp that projects a texture is a linear function of it: use ssad.rendering.camera.texture"
        )
    pose = position.new_tensor(lamp.pose) if pose is None else pose.to(position)
    power = position.new_tensor(lamp.power) if power is None else power.to(position)
    spread = position.new_tensor(lamp.spread) if spread is None else spread.to(position)
    to = position - pose[:3, 3]
    local = to @ pose[:3, :3]
    ahead = local[..., 2]
    facing = -(normal * to).sum(-1)
    lit = (facing > 0.0) & (ahead > 0.02)
    ahead = torch.where(lit, ahead, 1.0)
    square = (to * to).sum(-1).clamp_min(1e-4)
    distance = square.sqrt()
    across = local[..., :2] / ahead[..., None] / spread
    if lamp.is_square:
        weight = (across.abs() <= 1.0).all(-1).to(position)
        area = 4.0 * spread.prod()
    else:
        inner = (1.0 - lamp.soft) ** 2
        radius = (across * across).sum(-1)
        weight = ((1.0 - radius) / (1.0 - inner)).clamp(0.0, 1.0) if inner < 1.0 else (radius <= 1.0).to(position)
        area = torch.pi * spread.prod() * (1.0 + inner) / 2.0
    weight = weight * (3.0 * (1.0 - distance / lamp.reach)).clamp(0.0, 1.0) * torch.exp(-fog * distance)
    given = weight * (distance / ahead) ** 3 * facing / distance / square
    colour = position.new_tensor(lamp.colour)
    return torch.where(lit, given, 0.0)[..., None] * colour * power / area


def shine(picture: Picture, light: Tensor) -> Tensor:
    """What light that is added to the surfaces of a picture adds to its radiance.

    Args:
        picture: Rendered with `surface=True`.
        light: Irradiance over pi of each pixel [B, H, W, 3], as `lamp_light` gives it for `picture.surface`.

    Returns:
        To be added to `picture.radiance` [B, H, W, 3], before `ssad.rendering.camera.torch_sensor.develop`.

    Raises:
        ConfigError: The picture has no surface.
    """
    surface = picture.surface
    if surface is None:
        raise ConfigError("this picture does not say what it shows: render it with surface=True")
    albedo, gain, irradiance = (light.new_tensor(v) for v in (surface.albedo, surface.gain, surface.irradiance))
    return light * albedo * torch.where(irradiance > 0.0, gain / irradiance.clamp_min(1e-12), 0.0)

"""Light of a lamp in torch, differentiable with respect to the lamp's pose, power and spread.

`render(..., surface=True)` exports the surface of each pixel. From it, the light that a lamp would add is computed
as in the kernels, without rendering again; shadows and mirror images of the lamp are not included.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.render import Rendering


def lamp_light(
    lamp: SceneLamp,
    position: Tensor,
    normal: Tensor,
    *,
    pose: Tensor | None = None,
    power: Tensor | None = None,
    spread: Tensor | None = None,
    fog: float = 0.0,
) -> Tensor:
    """Return the irradiance over pi that a lamp gives to points, without shadows.

    Args:
        lamp: The lamp; its fields apply where no tensor is given. It projects no texture.
        position: Points in the world [..., 3], m.
        normal: Their normals [..., 3], unit.
        pose: Lamp to world [4, 4] (x across, y down, z ahead), in place of the lamp's.
        power: In place of the lamp's, scalar.
        spread: Tangents of the half angles across and down [2], in place of the lamp's.
        fog: Extinction, 1/m (`Weather.fog`).

    Returns:
        Linear RGB [..., 3], differentiable with respect to all tensors; it is discontinuous at the edge of a
        rectangle.

    Raises:
        ConfigError: The lamp is a low beam, or projects a texture (see `ssad.rendering.camera.texture`).
    """
    if lamp.texture >= 0:
        raise ConfigError(
            "a lamp that projects a texture is a linear function of it: use ssad.rendering.camera.texture"
        )
    if lamp.pattern == "low_beam":
        raise ConfigError("a low beam has no light in torch: use a lamp with even light")
    pose = position.new_tensor(lamp.pose) if pose is None else pose.to(position)
    power = position.new_tensor(lamp.power) if power is None else power.to(position)
    spread = position.new_tensor(lamp.spread) if spread is None else spread.to(position)
    offset = position - pose[:3, 3]
    local_position = offset @ pose[:3, :3]
    axial_distance = local_position[..., 2]
    facing_distance = -(normal * offset).sum(-1)
    is_lit = (facing_distance > 0.0) & (axial_distance > 0.02)
    # A safe value on dark points keeps NaN out of the gradient.
    axial_distance = torch.where(is_lit, axial_distance, 1.0)
    squared_distance = (offset * offset).sum(-1).clamp_min(1e-4)
    distance = squared_distance.sqrt()
    plane_position = local_position[..., :2] / axial_distance[..., None] / spread
    if lamp.is_square:
        weight = (plane_position.abs() <= 1.0).all(-1).to(position)
        area = 4.0 * spread.prod()
    else:
        inner_squared = (1.0 - lamp.soft) ** 2
        squared_radius = (plane_position * plane_position).sum(-1)
        weight = (
            ((1.0 - squared_radius) / (1.0 - inner_squared)).clamp(0.0, 1.0)
            if inner_squared < 1.0
            else (squared_radius <= 1.0).to(position)
        )
        area = torch.pi * spread.prod() * (1.0 + inner_squared) / 2.0
    weight = weight * (3.0 * (1.0 - distance / lamp.reach)).clamp(0.0, 1.0) * torch.exp(-fog * distance)
    # Even light on a plane across the axis: the intensity grows with the cube of the secant.
    irradiance = weight * (distance / axial_distance) ** 3 * facing_distance / distance / squared_distance
    colour = position.new_tensor(lamp.colour)
    return torch.where(is_lit, irradiance, 0.0)[..., None] * colour * power / area


def shine(rendering: Rendering, added_light: Tensor) -> Tensor:
    """Return the radiance that light added to the surfaces of an image contributes.

    Args:
        rendering: Rendered with `surface=True`.
        added_light: Irradiance over pi of each pixel [B, H, W, 3], as `lamp_light` gives it for `picture.surface`.

    Returns:
        To be added to `picture.radiance` [B, H, W, 3], before `ssad.rendering.camera.torch_sensor.develop`.

    Raises:
        ConfigError: The picture has no surface.
    """
    surface = rendering.surface
    if surface is None:
        raise ConfigError("this picture does not say what it shows: render it with surface=True")
    albedo, gain, irradiance = (
        added_light.new_tensor(values) for values in (surface.albedo, surface.gain, surface.irradiance)
    )
    return added_light * albedo * torch.where(irradiance > 0.0, gain / irradiance.clamp_min(1e-12), 0.0)

"""Light that lamps add to images, for many settings at once."""

from __future__ import annotations

import torch
from torch import Tensor

from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.torch_lamp import lamp_light
from ssad.scenarios.static.physical.lights.lit_image import LitImage


def added_light(
    lamp: SceneLamp, image: LitImage, *, pose: Tensor, power: Tensor, spread: Tensor, colour: Tensor
) -> Tensor:
    """Return the radiance [N, h, w, 3] that a lamp adds under N settings, without shadows; differentiable.

    Args:
        lamp: Its edge and reach; the rest of it is replaced.
        image: Image to light.
        pose: In the target's frame [N, 4, 4].
        power: Lumen [N].
        spread: Tangents of the half angles [N, 2].
        colour: Linear RGB [N, 3].
    """

    def light(pose: Tensor, power: Tensor, spread: Tensor) -> Tensor:
        return lamp_light(lamp, image.position, image.normal, pose=pose, power=power, spread=spread, fog=image.fog)

    position = image.position
    irradiance = torch.vmap(light)(pose.to(position), power.to(position) * image.per_lux, spread.to(position))
    return irradiance * colour.to(position)[:, None, None] * image.answer

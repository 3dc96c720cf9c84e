"""Image as a function of the light on its target.

A search needs thousands of images. So an image is rendered once, with the properties of its surfaces; the effect of
a lamp or a shadow then follows for many settings at once. The result of the search is rendered in full afterwards:
lamps with their shadows and mirror images, cards with the sun's shadow maps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from ssad.core.types import F64
from ssad.rendering.camera.glare import with_lens_effects
from ssad.rendering.camera.photometry import per_lux
from ssad.rendering.camera.render import RenderQuality, View, render, scene_light, view_noise
from ssad.rendering.camera.scene import RenderScene
from ssad.rendering.camera.scene_edit import SceneEdit, ShadowCard
from ssad.rendering.camera.sensor import SensorModel
from ssad.rendering.camera.torch_sensor import develop, scatter, scatter_parts

BLIND: Final = ShadowCard(np.array([[0.0, y, z] for y, z in ((-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0))]))
"""Keeps the whole sun off a target."""


@dataclass(frozen=True, slots=True)
class LitImage:
    """Image whose target can be lit and shaded.

    Attributes:
        before: Whole image without any attack [1, 3, H, W] in 0 to 1.
        corner: First row and column of the crop around the target, both even.
        radiance: Radiance of the crop, linear [h, w, 3].
        sun: Part of the radiance that comes from the sun [h, w, 3].
        answer: Gain in radiance for irradiance over pi of 1 [h, w, 3].
        position: Surface point of each pixel, in the target's frame, m [h, w, 3].
        normal: Surface normal of each pixel [h, w, 3].
        sun_direction: Direction to the sun, in the target's frame [3]; None by night.
        exposure: Factor from radiance to exposure.
        per_lux: Irradiance over pi of one lux (see `ssad.rendering.camera.photometry`).
        fog: Extinction, 1/m.
        sensor: Sensor of the camera.
        scattered: The radiance behind the lens, which scatters the light of the whole image [h, w, 3].
        noise: Noise of the photosites of the crop in standard deviations [1, h, w]; None if there is none.
    """

    before: Tensor
    corner: tuple[int, int]
    radiance: Tensor
    sun: Tensor
    answer: Tensor
    position: Tensor
    normal: Tensor
    sun_direction: F64 | None
    exposure: float
    per_lux: float
    fog: float
    sensor: SensorModel
    scattered: Tensor
    noise: Tensor | None = None

    def show(self, change: Tensor) -> Tensor:
        """Return images with more or less light in the crop around the target.

        Args:
            change: Radiance to add [N, h, w, 3].

        Returns:
            [N, 3, H, W] in 0 to 1, differentiable in the change.
        """
        noise = None if self.noise is None else self.noise.expand(len(change), -1, -1)
        (top, left), (height, width) = self.corner, self.radiance.shape[:2]
        image_size = self.before.shape[2], self.before.shape[3]
        change = torch.maximum(change, -self.radiance)
        # What the lens scatters of the change beyond the crop is too little to see.
        scattered = self.scattered + scatter_parts(change, self.sensor, [self.corner] * len(change), image_size)
        crop = develop(scattered.clamp_min(0.0), self.exposure, replace(self.sensor, glare=0.0, flare=0.0), noise)
        is_whole = (height, width) == image_size
        # At the border of the part the lens lacks what lies beyond it.
        margin = 4 if min(height, width) > 16 and not is_whole else 0
        full_images = self.before.repeat(len(change), 1, 1, 1)
        rows, columns = slice(margin, height - margin), slice(margin, width - margin)
        full_images[:, :, top + margin : top + height - margin, left + margin : left + width - margin] = crop[
            :, :, rows, columns
        ]
        return full_images


def render_lit_image(
    scene: RenderScene,
    view: View,
    tag: int,
    rows: slice,
    columns: slice,
    *,
    blind: int,
    quality: RenderQuality,
    device: str | torch.device = "cpu",
) -> LitImage:
    """Render a view once, as a function of the light on a target.

    Args:
        scene: Scene with its street and bodies, and the body of `BLIND`.
        view: View to render.
        tag: Tag of the target in it.
        rows: Rows of the crop around the target; its first row and column are even.
        columns: See `rows`.
        blind: Index of the body of `BLIND` in the scene.
        quality: Quality of the rendering.
        device: Device of the images.
    """
    rendering = render(scene, [view], quality=quality, surface=True)
    sensor = with_lens_effects(view.sensor, rendering.effects)
    surface, crop = rendering.surface, (0, rows, columns)
    assert surface is not None
    pose = next(scene_object.pose for scene_object in view.objects if scene_object.tag == tag)
    sun = np.array(scene_light(view.weather)[0][0])
    # Two renderings, with and without the sun on the target, give the sun's share.
    shaded = rendering.radiance
    if sun[2] > 0.0:
        shaded_view = SceneEdit(cards=(BLIND,)).on(view, tag, cards=(blind,))
        shaded = render(scene, [shaded_view], quality=quality).radiance
    irradiance = surface.irradiance[crop]
    surface_gain = np.where(irradiance > 0.0, surface.gain[crop] / np.maximum(irradiance, 1e-12), 0.0)

    noise = view_noise(view)

    def on_device(array: Any) -> Tensor:
        return torch.from_numpy(np.array(array, np.float32)).to(device)

    return LitImage(
        on_device(rendering.image).permute(0, 3, 1, 2) / 255,
        (rows.start, columns.start),
        on_device(rendering.radiance[crop]),
        on_device((rendering.radiance - shaded)[crop]),
        on_device(surface.albedo[crop] * surface_gain),
        on_device((surface.position[crop].astype(np.float64) - pose[:3, 3]) @ pose[:3, :3]),
        on_device(surface.normal[crop] @ pose[:3, :3]),
        pose[:3, :3].T @ sun if sun[2] > 0.0 else None,
        float(rendering.exposure[0]),
        per_lux(view.weather),
        view.weather.fog,
        sensor,
        scatter(on_device(rendering.radiance), sensor)[crop],
        None if noise is None else on_device(noise[rows, columns])[None],
    )

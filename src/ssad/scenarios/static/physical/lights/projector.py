"""Projector attack: an image on the target's rear, trained by gradient in the same way as a texture (SLAP, OPAD)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, field
from functools import partial
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from ssad.core.colours import LUMINANCE
from ssad.core.errors import ConfigError
from ssad.core.schema import VALUES, Least, Number, Two, build_validated
from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.scene import TextureLayer
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.camera.texture import to_linear
from ssad.scenarios.static.physical.lights.light import LampDistance, TargetSize, aimed_poses, first_array
from ssad.scenarios.static.physical.textures.carrier import TextureSurface
from ssad.scenarios.static.physical.textures.optimise import TextureAttack
from ssad.scenarios.static.physical.textures.printing import Expectation

AIMED = Expectation((0.9, 1.1), 0.05, 0.02, 0.03, 0.03)


@dataclass(frozen=True, slots=True, config=VALUES)
class Projector:
    """Projector behind the target, on a vehicle or a drone that keeps its distance.

    Source: Lovisotto et al., SLAP (USENIX Security 2021): a coarse image, expectation over view, light and place; the
    model from projector to camera, which the source fits, is the renderer's own light in this implementation.

    Attributes:
        lumens: Luminous flux of a white image (5000 is a strong one).
        distance: Distance from the target's rear, m.
        aside: Angle from straight behind, rad.
        height: Height above the road, m.
        size: Width and height of the image on the rear, in sides of the rear.
        texels: Texels along its longer side.
        leak: Light of black parts, share of white (1 / contrast).
        name: Name shown in tables.
    """

    lumens: Least = 5000.0
    distance: LampDistance = 5.0
    aside: Number = 0.35
    height: Least = 2.0
    size: Two[Annotated[Number, Field(ge=0.05)]] = (1.0, 0.9)
    texels: Annotated[int, Field(ge=1, le=1024)] = 32
    leak: Annotated[Least, Field(lt=1.0)] = 0.001
    name: str = "projector"
    search: str = field(default="gradient", init=False)

    def lamp(self, target: TargetSize) -> SceneLamp:
        """Return the projector as a lamp in the target's frame, power in lumen; it shows texture 0."""
        position = [
            target.rear - self.distance * float(np.cos(self.aside)),
            self.distance * float(np.sin(self.aside)),
            self.height,
        ]
        rear_centre = [target.rear, 0.0, 0.5 * target.height]
        pose = first_array(
            aimed_poses(*(torch.tensor([coordinates], dtype=torch.float64) for coordinates in (position, rear_centre)))
        )
        range_to_rear = float(np.linalg.norm(np.subtract(rear_centre, position)))
        spread = (
            # Seen from the side, the rear is narrower by the cosine of the angle.
            0.5 * self.size[0] * target.width * float(np.cos(self.aside)) / range_to_rear,
            0.5 * self.size[1] * target.height / range_to_rear,
        )
        return SceneLamp(pose, self.lumens, spread, square=True, texture=0)

    def surface(self, target: TargetSize) -> TextureSurface:
        """Return the surface to train; all texels are visible."""
        width, height = self.size[0] * target.width, self.size[1] * target.height
        longest = max(width, height)
        size = max(1, round(self.texels * height / longest)), max(1, round(self.texels * width / longest))
        return TextureSurface(TextureLayer(0), size, np.ones(size, bool), (width, height))

    def light_of(self, colour: Tensor) -> Tensor:
        """Return the transmitted share of the light [3, H, W] for an image in sRGB."""
        return self.leak + (1.0 - self.leak) * to_linear(colour.clamp(0.0, 1.0))

    def edit(self, colour: Tensor, target: TargetSize) -> SceneEdit:
        """Return an image, sRGB [3, H, W], as a scene edit."""
        return SceneEdit(lamps=(self.lamp(target),), textures={0: self.light_of(colour)})

    def power(self, colour: Tensor) -> float:
        """Return the luminous flux of an image, lumen."""
        share = self.light_of(colour).mean((1, 2)).double()
        return float(self.lumens * (share @ share.new_tensor(LUMINANCE)))

    def training(self, /, **settings: Any) -> TextureAttack:
        """Return the settings of the training: no terms for print, and an aim with small errors.

        Args:
            **settings: Fields of `TextureAttack` that differ; of `expectation`, the fields that differ.

        Raises:
            ConfigError: A setting is unknown or has an invalid value.
        """
        options: dict[str, Any] = {
            "epochs": 40,
            "rate": 0.1,
            "smooth": 0.02,
            "inks": False,
            "printed": 0.0,
            "window": 320,
            "expectation": AIMED,
            **settings,
        }
        if isinstance(options["expectation"], Mapping):
            options["expectation"] = {**asdict(AIMED), **options["expectation"]}
        label = f"attack {self.name}"
        attack = build_validated(partial(TextureAttack, self.name), options, subject=label, kind=TextureAttack)
        if attack.inks:
            raise ConfigError(f"{label}: inks=true: a projector's image is light, not print")
        if attack.stealth:
            raise ConfigError(f"{label}: stealth={attack.stealth:g}: it is for what is printed on something")
        return attack

"""Projector: a picture thrown onto the target's rear, trained by gradient as a texture is (SLAP, OPAD)."""

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

from ssad.core.errors import ConfigError
from ssad.core.schema import VALUES, Least, Number, Two, checked
from ssad.rendering.camera.lamps import Lamp
from ssad.rendering.camera.scene import Layer
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.camera.texture import to_linear
from ssad.scenarios.static.physical.lights.light import Away, Target, aimed, numbers
from ssad.scenarios.static.physical.textures.carrier import Surface
from ssad.scenarios.static.physical.textures.optimise import TextureAttack
from ssad.scenarios.static.physical.textures.printing import Expectation

AIMED = Expectation((0.9, 1.1), 0.05, 0.02, 0.03, 0.03)


@dataclass(frozen=True, slots=True, config=VALUES)
class Projector:
    """A projector behind the target, on a vehicle or a drone that keeps its distance.

    Source: Lovisotto et al., SLAP (USENIX Security 2021): a coarse image, expectation over view, light and place; the
    model from projector to camera, which is fitted there, is the renderer's own light here.

    Attributes:
        lumens: With a white picture (5000 is a strong one).
        distance: From the target's rear, m.
        aside: Angle from straight behind, rad.
        height: Above the road, m.
        size: Width and height of the picture on the rear, in sides of the rear.
        texels: Along its longer side.
        leak: Light of black parts, share of white (1 / contrast).
        name: What tables call it.
    """

    lumens: Least = 5000.0
    distance: Away = 5.0
    aside: Number = 0.35
    height: Least = 2.0
    size: Two[Annotated[Number, Field(ge=0.05)]] = (1.0, 0.9)
    texels: Annotated[int, Field(ge=1, le=1024)] = 32
    leak: Annotated[Least, Field(lt=1.0)] = 0.001
    name: str = "projector"
    search: str = field(default="gradient", init=False)

    def lamp(self, target: Target) -> Lamp:
        """The projector in the target's frame, power in lumen; it shows texture 0."""
        place = [
            target.rear - self.distance * float(np.cos(self.aside)),
            self.distance * float(np.sin(self.aside)),
            self.height,
        ]
        middle = [target.rear, 0.0, 0.5 * target.height]
        pose = numbers(aimed(*(torch.tensor([v], dtype=torch.float64) for v in (place, middle))))
        away = float(np.linalg.norm(np.subtract(middle, place)))
        spread = (
            0.5 * self.size[0] * target.width * float(np.cos(self.aside)) / away,
            0.5 * self.size[1] * target.height / away,
        )
        return Lamp(pose, self.lumens, spread, square=True, texture=0)

    def surface(self, target: Target) -> Surface:
        """What is trained: all texels are seen."""
        width, height = self.size[0] * target.width, self.size[1] * target.height
        longest = max(width, height)
        size = max(1, round(self.texels * height / longest)), max(1, round(self.texels * width / longest))
        return Surface(Layer(0), size, np.ones(size, bool), (width, height))

    def light_of(self, colour: Tensor) -> Tensor:
        """Share of the light [3, H, W] that a picture in sRGB lets through."""
        return self.leak + (1.0 - self.leak) * to_linear(colour.clamp(0.0, 1.0))

    def edit(self, colour: Tensor, target: Target) -> SceneEdit:
        """A picture, sRGB [3, H, W], as an edit of a scene."""
        return SceneEdit(lamps=(self.lamp(target),), textures={0: self.light_of(colour)})

    def power(self, colour: Tensor) -> float:
        """Light that leaves it while it shows a picture, lumen."""
        share = self.light_of(colour).mean((1, 2)).double()
        return float(self.lumens * (share @ share.new_tensor([0.2126, 0.7152, 0.0722])))

    def training(self, /, **settings: Any) -> TextureAttack:
        """How its picture is trained: no ink, so nothing about printing; it is aimed well, not perfectly.

        Args:
            **settings: Fields of `TextureAttack` that differ; of `expectation` those of its fields that differ.

        Raises:
            ConfigError: A setting that it does not have, or a value that it refuses.
        """
        given: dict[str, Any] = {
            "epochs": 40,
            "rate": 0.1,
            "smooth": 0.02,
            "printed": 0.0,
            "window": 320,
            "expectation": AIMED,
            **settings,
        }
        if isinstance(given["expectation"], Mapping):
            given["expectation"] = {**asdict(AIMED), **given["expectation"]}
        what = f"attack {self.name}"
        made = checked(partial(TextureAttack, self.name), given, what=what, kind=TextureAttack)
        if made.stealth:
            raise ConfigError(f"{what}: stealth={made.stealth:g}: it is for what is printed on something")
        return made

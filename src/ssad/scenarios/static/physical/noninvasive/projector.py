"""Projector: a picture thrown onto the target's rear, trained by gradient as a texture is (SLAP, OPAD)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.camera.lamps import Lamp
from ssad.camera.scene import Layer
from ssad.camera.scene_edit import SceneEdit
from ssad.camera.texture import to_linear
from ssad.core.errors import ConfigError
from ssad.scenarios.static.physical.carrier import Surface
from ssad.scenarios.static.physical.noninvasive.light import Target, aimed, check_range, numbers
from ssad.scenarios.static.physical.optimise import TextureAttack
from ssad.scenarios.static.physical.printing import Expectation


@dataclass(frozen=True, slots=True)
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

    lumens: float = 5000.0
    distance: float = 5.0
    aside: float = 0.35
    height: float = 2.0
    size: tuple[float, float] = (1.0, 0.9)
    texels: int = 32
    leak: float = 0.001
    name: str = "projector"
    search: str = field(default="gradient", init=False)

    def __post_init__(self) -> None:
        check_range(f"{self.name}: power", 0.0, self.lumens)
        check_range(f"{self.name}: distance", self.distance, self.distance, above=1.0)
        check_range(f"{self.name}: size", min(self.size), max(self.size), above=0.05)
        if not 1 <= self.texels <= 1024 or not 0.0 <= self.leak < 1.0:
            raise ConfigError(f"{self.name}: texels from 1 to 1024, leak from 0 to 1")

    def lamp(self, target: Target) -> Lamp:
        """The projector in the target's frame, power in lumen; it shows texture 0."""
        place = [
            target.rear - self.distance * float(np.cos(self.aside)), self.distance * float(np.sin(self.aside)),
            self.height,
        ]  # fmt: skip
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

    def training(self, **settings: Any) -> TextureAttack:
        """How its picture is trained: no ink, so nothing about printing; it is aimed well, not perfectly."""
        given: dict[str, Any] = {
            "epochs": 40, "rate": 0.1, "smooth": 0.02, "printed": 0.0, "window": 320,
            "expectation": Expectation((0.9, 1.1), 0.05, 0.02, 0.03, 0.03),
        }  # fmt: skip
        return TextureAttack(self.name, "hide", **(given | settings))

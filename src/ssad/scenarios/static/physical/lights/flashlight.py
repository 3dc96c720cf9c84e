"""Flashlight attack: one strong spot light from behind, with a searched position, aim, width and colour."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from ssad.core.colours import LUMINANCE
from ssad.core.schema import VALUES, Least, Number, Part, Span
from ssad.core.types import F64
from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.scenarios.static.physical.lights.lamps import added_light
from ssad.scenarios.static.physical.lights.light import (
    LampDistance,
    Ranges,
    TargetSize,
    aimed_poses,
    first_array,
    value_tensors,
)
from ssad.scenarios.static.physical.lights.lit_image import LitImage


@dataclass(frozen=True, slots=True, config=VALUES)
class Flashlight:
    """Spot light with a colour filter behind the target, held by a person or carried by a drone.

    No paper describes one for vehicles; it is the smallest light attack, a baseline for the others.

    Attributes:
        lumens: Maximum luminous flux, lumen (3000 is a strong hand lamp).
        distance: Minimum and maximum distance from the target's rear, m.
        height: Minimum and maximum height above the road, m.
        aside: Maximum angle from straight behind, rad.
        beam: Minimum and maximum tangent of the half angle of its beam.
        soft: Share of the beam over which it fades.
        name: Name shown in tables.
        search: Default search; its light has exact gradients.
    """

    lumens: Least = 3000.0
    distance: Span[LampDistance] = (4.0, 12.0)
    height: Span[Least] = (0.5, 3.0)
    aside: Number = 0.6
    beam: Span[Annotated[Number, Field(ge=1e-3)]] = (0.03, 0.3)
    soft: Part = 0.5
    name: str = "flashlight"
    search: Literal["swarm", "greedy", "gradient"] = "gradient"

    def ranges(self, target: TargetSize) -> Ranges:
        """Return the ranges of power, position, aim, beam and colour."""
        return {
            "lumens": (0.0, self.lumens),
            "distance": self.distance,
            "height": self.height,
            "aside": (-self.aside, self.aside),
            "aim_left": (-0.5 * target.width, 0.5 * target.width),
            "aim_up": (0.2 * target.height, target.height),
            "beam": self.beam,
            "red": (0.0, 1.0),
            "green": (0.0, 1.0),
            "blue": (0.0, 1.0),
        }

    def _lamp(self, values: Mapping[str, Tensor], target: TargetSize) -> dict[str, Tensor]:
        """Return pose, power, spread and colour of N settings."""
        distance, aside = values["distance"], values["aside"]
        position = torch.stack(
            [target.rear - distance * torch.cos(aside), distance * torch.sin(aside), values["height"]], -1
        )
        aim_point = torch.stack([torch.full_like(distance, target.rear), values["aim_left"], values["aim_up"]], -1)
        colour = torch.stack([values["red"], values["green"], values["blue"]], -1)
        return {
            "pose": aimed_poses(position, aim_point),
            "power": values["lumens"],
            "spread": values["beam"][:, None].expand(-1, 2),
            "colour": colour,
        }

    def change(self, values: Mapping[str, Tensor], picture: LitImage, target: TargetSize) -> Tensor:
        """Return the radiance that the spot light adds to an image."""
        return added_light(SceneLamp(_IDENTITY, 1.0, soft=self.soft), picture, **self._lamp(values, target))

    def edit(self, values: Mapping[str, float], target: TargetSize) -> SceneEdit:
        """Return the spot light as a scene edit."""
        lamp_values = {name: first_array(value) for name, value in self._lamp(value_tensors(values), target).items()}
        return SceneEdit(lamps=(lamp_of(lamp_values, soft=self.soft),))

    def power(self, values: Mapping[str, float]) -> float:
        """Return the luminous flux behind the filter, lumen."""
        red_weight, green_weight, blue_weight = LUMINANCE
        luminance = red_weight * values["red"] + green_weight * values["green"] + blue_weight * values["blue"]
        return values["lumens"] * luminance


_IDENTITY: F64 = first_array(torch.eye(4, dtype=torch.float64)[None])


def lamp_of(values: Mapping[str, F64], **options: Any) -> SceneLamp:
    """Return a lamp from a pose, a power, a spread and a colour."""
    spread_x, spread_y = values["spread"].tolist()
    red, green, blue = values["colour"].tolist()
    return SceneLamp(values["pose"], float(values["power"]), (spread_x, spread_y), (red, green, blue), **options)

"""Shadow attack: the sun's shadow of a card on the target, searched by a particle swarm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from ssad.core.schema import VALUES, Least, Number
from ssad.core.types import F64
from ssad.rendering.camera.scene_edit import SceneEdit, ShadowCard
from ssad.scenarios.static.physical.lights.light import Ranges, TargetSize
from ssad.scenarios.static.physical.lights.lit_image import LitImage


@dataclass(frozen=True, slots=True, config=VALUES)
class Shadow:
    """Triangular card between the sun and the target's rear.

    The search finds the shape of the shadow; the card that casts it is parallel to the rear, has the shadow's shape,
    and hangs towards the sun. It blocks the sun's light only: the light of the sky stays.

    Source: Zhong et al., Shadows can be Dangerous (CVPR 2022): a triangle on the object, a swarm of particles; the
    source darkens the image by a factor, this card blocks the light of the sun.

    Attributes:
        beyond: Maximum distance of its corners beyond the rear, in sides of the rear.
        away: Distance from the rear to the card, m.
        name: Name shown in tables.
        search: Default search, as in the source.
    """

    beyond: Least = 0.25
    away: Annotated[Number, Field(ge=0.5, le=20.0)] = 10.0
    name: str = "shadow"
    search: Literal["swarm", "greedy", "gradient"] = "swarm"

    def ranges(self, target: TargetSize) -> Ranges:
        """Return the ranges of the three corners."""
        half_width, margin = 0.5 * target.width, self.beyond
        lateral_range = -half_width * (1.0 + 2.0 * margin), half_width * (1.0 + 2.0 * margin)
        height_range = max(-margin * target.height, -0.4), (1.0 + margin) * target.height
        return {
            f"{side}_{corner}": bounds
            for corner in "abc"
            for side, bounds in (("left", lateral_range), ("up", height_range))
        }

    def outline(self, values: Mapping[str, float], target: TargetSize) -> F64:
        """Return the corners of the shadow on the plane of the rear [3, 3], target's frame."""
        return np.array([[target.rear, values[f"left_{corner}"], values[f"up_{corner}"]] for corner in "abc"])

    def change(self, values: Mapping[str, Tensor], picture: LitImage, target: TargetSize) -> Tensor:
        """Return the sunlight that the card takes from an image."""
        count = len(values["left_a"])
        if picture.sun_direction is None:
            return picture.radiance.new_zeros(count, *picture.radiance.shape)
        sun = picture.position.new_tensor(picture.sun_direction)
        # where the ray from each point towards the sun meets the plane of the rear
        ray_length = (target.rear - picture.position[..., 0]) / torch.where(sun[0].abs() > 1e-6, sun[0], 1e-6)
        y, z = (picture.position[..., axis] + ray_length * sun[axis] for axis in (1, 2))
        is_behind_card = ray_length + self.away > 0.0  # the card is `away` further on: points beyond it are in the sun
        corners = [torch.stack([values[f"left_{corner}"], values[f"up_{corner}"]], -1).to(sun) for corner in "abc"]
        edge_sides = []
        for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
            start_y, start_z, end_y, end_z = (
                coordinate[:, None, None] for coordinate in (start[:, 0], start[:, 1], end[:, 0], end[:, 1])
            )
            edge_sides.append((end_y - start_y) * (z - start_z) - (end_z - start_z) * (y - start_y))
        all_sides = torch.stack(edge_sides)
        # Inside a triangle of either orientation, all edges have it on the same side.
        inside = ((all_sides >= 0.0).all(0) | (all_sides <= 0.0).all(0)) & is_behind_card
        return -picture.sun * inside[..., None]

    def edit(self, values: Mapping[str, float], target: TargetSize) -> SceneEdit:
        """Return the card as a scene edit."""
        return SceneEdit(cards=(ShadowCard(self.outline(values, target), self.away),))

    def power(self, values: Mapping[str, float]) -> None:
        """Return None, since a card emits no light."""
        return

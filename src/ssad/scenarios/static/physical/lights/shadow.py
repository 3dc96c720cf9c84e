"""Shadow: the sun's shadow of a card on the target, searched by a particle swarm."""

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
from ssad.rendering.camera.scene_edit import Card, SceneEdit
from ssad.scenarios.static.physical.lights.light import Ranges, Target
from ssad.scenarios.static.physical.lights.lit_image import LitPicture


@dataclass(frozen=True, slots=True, config=VALUES)
class Shadow:
    """A triangular card between the sun and the target's rear.

    What the shadow looks like is searched; the card that casts it is parallel to the rear, has the shadow's shape, and
    hangs towards the sun. It takes the sun's light alone: the light of the sky stays.

    Source: Zhong et al., Shadows can be Dangerous (CVPR 2022): a triangle on the object, a swarm of particles; there
    the picture is darkened by a factor, here the card keeps off what the sun gives.

    Attributes:
        beyond: How far its corners may lie beyond the rear, in sides of the rear.
        away: From the rear to the card, m.
        name: What tables call it.
        search: As in the source.
    """

    beyond: Least = 0.25
    away: Annotated[Number, Field(ge=0.5, le=20.0)] = 10.0
    name: str = "shadow"
    search: Literal["swarm", "greedy", "gradient"] = "swarm"

    def ranges(self, target: Target) -> Ranges:
        """See `LightAttack`."""
        half, reach = 0.5 * target.width, self.beyond
        across = -half * (1.0 + 2.0 * reach), half * (1.0 + 2.0 * reach)
        up = max(-reach * target.height, -0.4), (1.0 + reach) * target.height
        return {f"{side}_{corner}": span for corner in "abc" for side, span in (("left", across), ("up", up))}

    def outline(self, values: Mapping[str, float], target: Target) -> F64:
        """The corners of the shadow on the plane of the rear [3, 3], target's frame."""
        return np.array([[target.rear, values[f"left_{c}"], values[f"up_{c}"]] for c in "abc"])

    def change(self, values: Mapping[str, Tensor], picture: LitPicture, target: Target) -> Tensor:
        """See `LightAttack`."""
        count = len(values["left_a"])
        if picture.sun_direction is None:
            return picture.radiance.new_zeros(count, *picture.radiance.shape)
        sun = picture.position.new_tensor(picture.sun_direction)
        # where the ray from each point towards the sun meets the plane of the rear
        along = (target.rear - picture.position[..., 0]) / torch.where(sun[0].abs() > 1e-6, sun[0], 1e-6)
        y, z = (picture.position[..., k] + along * sun[k] for k in (1, 2))
        below = along + self.away > 0.0  # the card is `away` further on: what lies beyond that is in the sun
        points = [torch.stack([values[f"left_{c}"], values[f"up_{c}"]], -1).to(sun) for c in "abc"]
        sides = []
        for a, b in zip(points, [*points[1:], points[0]], strict=True):
            a0, a1, b0, b1 = (v[:, None, None] for v in (a[:, 0], a[:, 1], b[:, 0], b[:, 1]))
            sides.append((b0 - a0) * (z - a1) - (b1 - a1) * (y - a0))
        stacked = torch.stack(sides)
        inside = ((stacked >= 0.0).all(0) | (stacked <= 0.0).all(0)) & below
        return -picture.sun * inside[..., None]

    def edit(self, values: Mapping[str, float], target: Target) -> SceneEdit:
        """See `LightAttack`."""
        return SceneEdit(cards=(Card(self.outline(values, target), self.away),))

    def power(self, values: Mapping[str, float]) -> None:
        """See `LightAttack`: a card gives no light."""
        return

"""Common parts of light attacks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from ssad.core.schema import Number
from ssad.core.types import F64
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.scenarios.static.physical.lights.lit_image import LitImage

Ranges = Mapping[str, tuple[float, float]]
"""Name of a searched setting -> minimum and maximum, in the unit of its name."""

LampDistance = Annotated[Number, Field(ge=1.0)]
"""Distance from the target's rear to a lamp, m."""


@dataclass(frozen=True, slots=True)
class TargetSize:
    """Dimensions of a target for the light on its rear.

    Attributes:
        length: In m.
        width: In m.
        height: In m.
    """

    length: float
    width: float
    height: float

    @property
    def rear(self) -> float:
        """Position of the rear along x, m."""
        return -0.5 * self.length


class LightAttack(Protocol):
    """Search space of a light attack, and the light of a point in it.

    Attributes:
        name: Name shown in tables.
        search: Default search: swarm, greedy or gradient (see `search`).
    """

    @property
    def name(self) -> str:
        """Name shown in tables."""

    @property
    def search(self) -> Literal["swarm", "greedy", "gradient"]:
        """Default search."""

    def ranges(self, target: TargetSize) -> Ranges:
        """Return the ranges of the searched settings."""

    def change(self, values: Mapping[str, Tensor], picture: LitImage, target: TargetSize) -> Tensor:
        """Return the radiance that settings add to an image.

        Args:
            values: Values [N] of each name in the ranges.
            picture: Image to light.
            target: Target in the image.

        Returns:
            [N, h, w, 3]; differentiable where `search` is gradient.
        """

    def edit(self, values: Mapping[str, float], target: TargetSize) -> SceneEdit:
        """Return the settings as a scene edit, to be rendered."""

    def power(self, values: Mapping[str, float]) -> float | None:
        """Return the luminous flux of the device, lumen; None for one without light."""


def aimed_poses(position: Tensor, aim_point: Tensor, roll: Tensor | None = None) -> Tensor:
    """Return poses [N, 4, 4] of lamps (x across, y down, z ahead) that stand at positions and aim at points [N, 3].

    Args:
        position: Positions of the lamps.
        aim_point: Points that they aim at, not straight above or below.
        roll: Turn about the axis [N], rad.
    """
    ahead = torch.nn.functional.normalize(aim_point - position, dim=-1)
    up = position.new_tensor([0.0, 0.0, 1.0]).expand_as(ahead)
    across = torch.nn.functional.normalize(torch.linalg.cross(ahead, up), dim=-1)
    down = torch.linalg.cross(ahead, across)
    if roll is not None:
        cos, sin = torch.cos(roll)[:, None], torch.sin(roll)[:, None]
        across, down = cos * across + sin * down, cos * down - sin * across
    upper_rows = torch.cat([torch.stack([across, down, ahead], -1), position[..., None]], -1)
    last_row = position.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(position), 1, 4)
    return torch.cat([upper_rows, last_row], 1)


def value_tensors(values: Mapping[str, float]) -> dict[str, Tensor]:
    """Convert one setting to tensors [1] of double precision."""
    return {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}


def first_array(tensor: Any) -> F64:
    """Convert the first element of a batch to an array."""
    return np.asarray(tensor[0].detach().cpu().numpy(), np.float64)

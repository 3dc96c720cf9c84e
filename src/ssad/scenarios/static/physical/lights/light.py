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
from ssad.scenarios.static.physical.lights.lit_image import LitPicture

Ranges = Mapping[str, tuple[float, float]]
"""Names of what is searched -> least and greatest value, in the units of their names."""

Away = Annotated[Number, Field(ge=1.0)]
"""From the target's rear to a lamp, m."""


@dataclass(frozen=True, slots=True)
class Target:
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

    def ranges(self, target: Target) -> Ranges:
        """Return the ranges of the searched settings."""

    def change(self, values: Mapping[str, Tensor], picture: LitPicture, target: Target) -> Tensor:
        """Return the radiance that settings add to an image.

        Args:
            values: Values [N] of each name in the ranges.
            picture: Image to light.
            target: Target in the image.

        Returns:
            [N, h, w, 3]; differentiable where `search` is gradient.
        """

    def edit(self, values: Mapping[str, float], target: Target) -> SceneEdit:
        """Return the settings as a scene edit, to be rendered."""

    def power(self, values: Mapping[str, float]) -> float | None:
        """Return the luminous flux of the device, lumen; None for one without light."""


def aimed(place: Tensor, point: Tensor, roll: Tensor | None = None) -> Tensor:
    """Poses [N, 4, 4] of lamps (x across, y down, z ahead) that stand at places and look at points [N, 3].

    Args:
        place: Where they are.
        point: Where they look, not straight up or down.
        roll: Turn about the axis [N], rad.
    """
    ahead = torch.nn.functional.normalize(point - place, dim=-1)
    up = place.new_tensor([0.0, 0.0, 1.0]).expand_as(ahead)
    across = torch.nn.functional.normalize(torch.linalg.cross(ahead, up), dim=-1)
    down = torch.linalg.cross(ahead, across)
    if roll is not None:
        cos, sin = torch.cos(roll)[:, None], torch.sin(roll)[:, None]
        across, down = cos * across + sin * down, cos * down - sin * across
    upper_rows = torch.cat([torch.stack([across, down, ahead], -1), place[..., None]], -1)
    last_row = place.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(place), 1, 4)
    return torch.cat([upper_rows, last_row], 1)


def at_values(values: Mapping[str, float]) -> dict[str, Tensor]:
    """Convert one setting to tensors [1] of double precision."""
    return {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}


def numbers(tensor: Any) -> F64:
    """Convert the first element of a batch to an array."""
    return np.asarray(tensor[0].detach().cpu().numpy(), np.float64)

"""Light attacks: what they have in common."""

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
    """The size of a target, for what shines on its rear.

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
        """Where its rear is along x, m."""
        return -0.5 * self.length


class LightAttack(Protocol):
    """What is searched, and what light the values that are found make.

    Attributes:
        name: What tables call it.
        search: How it is searched by default: swarm, greedy or gradient (see `search`).
    """

    @property
    def name(self) -> str:
        """What tables call it."""

    @property
    def search(self) -> Literal["swarm", "greedy", "gradient"]:
        """How it is searched."""

    def ranges(self, target: Target) -> Ranges:
        """What is searched."""

    def change(self, values: Mapping[str, Tensor], picture: LitPicture, target: Target) -> Tensor:
        """What settings add to the radiance of a picture.

        Args:
            values: Each of the ranges' names [N].
            picture: The picture.
            target: Whose picture it is.

        Returns:
            [N, h, w, 3]; differentiable where `search` is gradient.
        """

    def edit(self, values: Mapping[str, float], target: Target) -> SceneEdit:
        """The settings as an edit of a scene, to be rendered."""

    def power(self, values: Mapping[str, float]) -> float | None:
        """Light that leaves the device, lumen; None for one without light."""


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
    top = torch.cat([torch.stack([across, down, ahead], -1), place[..., None]], -1)
    last = place.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(place), 1, 4)
    return torch.cat([top, last], 1)


def at_values(values: Mapping[str, float]) -> dict[str, Tensor]:
    """One setting as tensors [1] of double precision."""
    return {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}


def numbers(tensor: Any) -> F64:
    """The first of a batch as an array."""
    return np.asarray(tensor[0].detach().cpu().numpy(), np.float64)

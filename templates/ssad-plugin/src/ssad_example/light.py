"""A light attack: a white lamp behind a car, whose power and aim are searched."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.scenarios.static.physical.lights.flashlight import lamp_of
from ssad.scenarios.static.physical.lights.lamps import added_light
from ssad.scenarios.static.physical.lights.light import TargetSize, aimed_poses, first_array, value_tensors
from ssad.scenarios.static.physical.lights.lit_image import LitImage


@dataclass(frozen=True)
class Spot:
    """White spot light 8 m behind the target, 1.5 m above the road.

    Attributes:
        lumens: Maximum luminous flux, lumen; in a suite `{example-spot: {lumens: 500}}`.
        name: Name in tables.
        search: Default search of the settings: swarm, greedy or gradient.
    """

    lumens: float = 2000.0
    name: str = "example-spot"
    search: Literal["swarm", "greedy", "gradient"] = "gradient"

    def ranges(self, target: TargetSize) -> Mapping[str, tuple[float, float]]:
        """Return the ranges of the searched settings."""
        return {"lumens": (0.0, self.lumens), "aim_up": (0.2 * target.height, target.height)}

    def _lamp(self, values: Mapping[str, Tensor], target: TargetSize) -> dict[str, Tensor]:
        """Return pose, power, spread and colour of N settings."""
        power = values["lumens"]
        position = power.new_tensor([target.rear - 8.0, 0.0, 1.5]).expand(len(power), 3)
        aim = torch.stack([torch.full_like(power, target.rear), torch.zeros_like(power), values["aim_up"]], -1)
        spread, colour = power.new_full((len(power), 2), 0.1), power.new_ones((len(power), 3))
        return {"pose": aimed_poses(position, aim), "power": power, "spread": spread, "colour": colour}

    def change(self, values: Mapping[str, Tensor], picture: LitImage, target: TargetSize) -> Tensor:
        """Return the radiance [N, h, w, 3] that the light adds to an image; the search looks at this."""
        pose = first_array(torch.eye(4, dtype=torch.float64)[None])
        return added_light(SceneLamp(pose, 1.0), picture, **self._lamp(values, target))

    def edit(self, values: Mapping[str, float], target: TargetSize) -> SceneEdit:
        """Return the light as an edit of the scene; recordings and the closed loop render this."""
        lamp = {name: first_array(value) for name, value in self._lamp(value_tensors(values), target).items()}
        return SceneEdit(lamps=(lamp_of(lamp),))

    def power(self, values: Mapping[str, float]) -> float:
        """Return the luminous flux, lumen."""
        return values["lumens"]

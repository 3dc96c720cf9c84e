"""Laser beam attack: a line of one wavelength across the target, found by a greedy search (AdvLB)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from ssad.core.schema import VALUES, Above, Least, Number, Span
from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.scenarios.static.physical.lights.flashlight import _IDENTITY, lamp_of
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

LUMEN_PER_WATT = 683.0  # of light of 555 nm, by definition of the candela
TO_SRGB = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))  # IEC 61966-2-1, from XYZ


@dataclass(frozen=True, slots=True, config=VALUES)
class Laser:
    """Laser whose beam a cylindrical lens spreads to a line.

    Its colour follows from the wavelength, its brightness from power, wavelength and the area of the line.

    Source: Duan et al., Adversarial Laser Beam (CVPR 2021): wavelength, place, angle and width of a line; the source
    adds it to the image, this implementation lights the target with it.

    Attributes:
        watts: Maximum optical power, W (0.5 is far beyond a pointer, and dangerous).
        distance: Distance from the target's rear, m.
        height: Height above the road, m.
        fan: Tangent of the half angle of the line.
        width: Minimum and maximum width of the line on the target, m; a narrower one falls between the samples of an
            image from 20 m.
        wavelength: Minimum and maximum wavelength, nm.
        name: Name shown in tables.
        search: Default search, as in the source.
    """

    watts: Least = 0.5
    distance: LampDistance = 8.0
    height: Least = 1.5
    fan: Above = 0.15
    width: Span[Annotated[Number, Field(ge=0.01)]] = (0.05, 0.3)
    wavelength: Span[Annotated[Number, Field(ge=360.0)]] = (400.0, 680.0)
    name: str = "laser"
    search: Literal["swarm", "greedy", "gradient"] = "greedy"

    def ranges(self, target: TargetSize) -> Ranges:
        """Return the ranges of power, wavelength, width, angle and aim."""
        return {
            "watts": (0.0, self.watts),
            "wavelength": self.wavelength,
            "width": self.width,
            "angle": (-0.5 * float(np.pi), 0.5 * float(np.pi)),
            "aim_left": (-0.5 * target.width, 0.5 * target.width),
            "aim_up": (0.2 * target.height, target.height),
        }

    def _lamp(self, values: Mapping[str, Tensor], target: TargetSize) -> dict[str, Tensor]:
        """Return pose, power, spread and colour of N settings."""
        aim_left = values["aim_left"]
        position = aim_left.new_tensor([target.rear - self.distance, 0.0, self.height]).expand(len(aim_left), 3)
        aim_point = torch.stack([torch.full_like(aim_left, target.rear), aim_left, values["aim_up"]], -1)
        half_width = 0.5 * values["width"] / self.distance
        return {
            "pose": aimed_poses(position, aim_point, values["angle"]),
            "power": values["watts"] * LUMEN_PER_WATT,
            "spread": torch.stack([torch.full_like(half_width, self.fan), half_width], -1),
            "colour": spectral_colour(values["wavelength"]),
        }

    def change(self, values: Mapping[str, Tensor], picture: LitImage, target: TargetSize) -> Tensor:
        """Return the radiance that the laser adds to an image."""
        return added_light(SceneLamp(_IDENTITY, 1.0, square=True), picture, **self._lamp(values, target))

    def edit(self, values: Mapping[str, float], target: TargetSize) -> SceneEdit:
        """Return the laser as a scene edit."""
        lamp_values = {name: first_array(value) for name, value in self._lamp(value_tensors(values), target).items()}
        return SceneEdit(lamps=(lamp_of(lamp_values, square=True),))

    def power(self, values: Mapping[str, float]) -> float:
        """Return the luminous flux of the laser, lumen."""
        wavelength = torch.tensor([values["wavelength"]], dtype=torch.float64)
        return values["watts"] * LUMEN_PER_WATT * float(colour_matching(wavelength)[0, 1])


def colour_matching(wavelength: Tensor) -> Tensor:
    """Return the CIE 1931 colour matching functions x, y, z of wavelengths [N] in nm: [N, 3].

    Source: the multi-lobe fit of Wyman, Sloan and Shirley, Simple Analytic Approximations to the CIE XYZ Color
    Matching Functions (JCGT 2013).
    """

    def lobe(height: float, middle: float, below: float, above: float) -> Tensor:
        offset = wavelength - middle
        scaled = offset * torch.where(offset < 0.0, below, above)
        return height * torch.exp(-0.5 * scaled * scaled)

    x = lobe(1.056, 599.8, 0.0264, 0.0323) + lobe(0.362, 442.0, 0.0624, 0.0374) - lobe(0.065, 501.1, 0.0490, 0.0382)
    y = lobe(0.821, 568.8, 0.0213, 0.0247) + lobe(0.286, 530.9, 0.0613, 0.0322)
    z = lobe(1.217, 437.0, 0.0845, 0.0278) + lobe(0.681, 459.0, 0.0385, 0.0725)
    return torch.stack([x, y, z], -1)


def spectral_colour(wavelength: Tensor) -> Tensor:
    """Return the linear RGB [N, 3] of light of wavelengths [N] in nm, for a power in lumen at 555 nm.

    White light of the same luminance is (y, y, y). Every spectral colour lies outside the gamut of sRGB: it is mixed
    with white of its own luminance until no component is negative. Luminance and dominant wavelength stay the same,
    only the purity falls.
    """
    xyz = colour_matching(wavelength)
    luminance = xyz[:, 1:2]
    colour = xyz @ wavelength.new_tensor(TO_SRGB).T
    # Equal to 1 inside the gamut; at its border, the most negative component becomes 0.
    purity = luminance / (luminance - colour.amin(-1, keepdim=True).clamp_max(0.0)).clamp_min(1e-12)
    # The smallest component is 0 but for rounding, which must not leave a negative light.
    return (luminance + purity * (colour - luminance)).clamp_min(0.0)

"""Printability of textures and its variation between cars: regularisers, and the expectation over prints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor
from torch.nn import functional

from ssad.core.schema import Above, Least, Span
from ssad.rendering.camera.torch_sensor import generators_on_device

_XYZ = ((0.4124, 0.3576, 0.1805), (0.2126, 0.7152, 0.0722), (0.0193, 0.1192, 0.9505))  # of linear RGB


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))  # not strict: a suite gives it as a mapping
class Expectation:
    """Variation of a texture between prints and between cars: uniform draws, one of each for an image.

    Attributes:
        contrast: Minimum and maximum factor about mid-grey.
        brightness: Maximum change, as a share of the range of colours.
        noise: Maximum change of a single texel.
        shift: Maximum shift of the texture, share of its sides; the border repeats the edge.
        turn: Maximum rotation, rad.

    Source: ranges of contrast, brightness and noise as in Thys et al., Fooling automated surveillance cameras (2019).
    """

    contrast: Span[Above] = (0.8, 1.2)
    brightness: Least = 0.1
    noise: Least = 0.1
    shift: Annotated[Least, Field(lt=0.5)] = 0.03
    turn: Least = 0.05

    def draw(self, colour: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Return the texture as it is printed on several cars.

        Args:
            colour: sRGB [3, H, W] in 0 to 1.
            generators: One for each car, on the CPU; the noise of texels is drawn on the texture's device (see
                `generators_on_device`).

        Returns:
            [B, 3, H, W] in 0 to 1, differentiable in `colour`.
        """
        textures: Tensor = colour.expand(len(generators), *colour.shape)
        is_moved = self.shift > 0.0 or self.turn > 0.0
        # Twice the shift, since the coordinates of `affine_grid` span -1 to 1.
        ranges = [(-self.turn, self.turn), (-2.0 * self.shift, 2.0 * self.shift)]
        ranges = [ranges[0], ranges[1], ranges[1]] if is_moved else []
        ranges += [self.contrast, (-self.brightness, self.brightness)]
        lowest, highest = torch.tensor(ranges).T
        uniform = torch.stack([torch.rand(len(ranges), generator=random_generator) for random_generator in generators])
        parameters = (lowest + (highest - lowest) * uniform).to(colour)  # one copy to the device for all parameters
        if is_moved:
            angle, offset_uv = parameters[:, 0], parameters[:, 1:3]
            height, width = colour.shape[1:]
            aspect = width / height
            cos, sin = torch.cos(angle), torch.sin(angle)
            transforms = torch.stack(
                [
                    torch.stack([cos, -sin / aspect, offset_uv[:, 0]], -1),
                    torch.stack([sin * aspect, cos, offset_uv[:, 1]], -1),
                ],
                1,
            )
            grid = functional.affine_grid(transforms, list(textures.shape), align_corners=False)
            textures = functional.grid_sample(
                textures, grid, mode="bilinear", padding_mode="border", align_corners=False
            )
        factor, offset = (parameters[:, column, None, None, None] for column in (-2, -1))
        textures = 0.5 + factor * (textures - 0.5) + offset
        if self.noise > 0.0:
            device_generators = generators_on_device(generators, colour.device)
            texel_noise = torch.stack(
                [
                    torch.rand(colour.shape, generator=random_generator, device=random_generator.device)
                    for random_generator in device_generators
                ]
            )
            textures = textures + (2.0 * self.noise * texel_noise - self.noise).to(colour)
        return textures.clamp(0.0, 1.0)


NOMINAL = Expectation((1.0, 1.0), 0.0, 0.0, 0.0, 0.0)
"""Printed and placed exactly."""


def total_variation(colour: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean length of the difference between each texel and its right and lower neighbour.

    Args:
        colour: [3, H, W].
        mask: Texels [H, W] that count; a pair counts if both do. None: all.

    Returns:
        A differentiable scalar; 0 for an even texture.
    """
    counts = torch.ones(colour.shape[1:], dtype=torch.bool, device=colour.device) if mask is None else mask.bool()
    squares_right = (colour[:, :, 1:] - colour[:, :, :-1]).square().sum(0)
    squares_down = (colour[:, 1:] - colour[:, :-1]).square().sum(0)
    squares = torch.cat([squares_right[counts[:, 1:] & counts[:, :-1]], squares_down[counts[1:] & counts[:-1]]])
    if not len(squares):
        return colour.sum() * 0.0
    # The offset keeps the slope of the root finite at 0; its root is taken off again.
    return (squares + 1e-8).sqrt().mean() - 1e-4


def non_printability(colour: Tensor, printable: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean distance of the texels' colours to the nearest printable colour.

    Args:
        colour: sRGB [3, H, W].
        printable: Colours [N, 3] that a printer can produce, sRGB.
        mask: Texels [H, W] that count. None: all.

    Returns:
        A differentiable scalar, 0 if all colours are printable.

    Source: the non-printability score of Sharif et al., Accessorize to a Crime (2016), with the nearest colour in
    place of the product over all, which underflows.
    """
    colours = colour.flatten(1).T if mask is None else colour[:, mask.bool()].T
    if not len(colours):
        return colour.sum() * 0.0
    distances = torch.cdist(colours, printable.to(colours))
    return distances.amin(1).mean()


def conspicuousness(albedo: Tensor, paint: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean CIE 1976 colour difference (Delta E*ab) between a texture and its background; 2 is visible.

    Args:
        albedo: Linear RGB [3, H, W] in 0 to 1, as printed (see `albedo_of`).
        paint: Linear RGB [3] of the covered surface.
        mask: Texels [H, W] that count. None: all.

    Returns:
        A differentiable scalar; 0 for the paint itself, 100 for white on black.

    Source: CIE 15, Colorimetry: CIELAB under D65; sRGB primaries of IEC 61966-2-1.
    """
    colours = albedo.flatten(1).T if mask is None else albedo[:, mask.bool()].T
    if not len(colours):
        return albedo.sum() * 0.0
    lab_difference = lab_of(colours) - lab_of(paint.to(colours)[None])
    return ((lab_difference.square().sum(1) + 1e-8).sqrt() - 1e-4).mean()


def lab_of(colours: Tensor) -> Tensor:
    """Return CIELAB [N, 3] (D65) of linear RGB [N, 3].

    Source: CIE 15, Colorimetry.
    """
    relative_xyz = colours @ colours.new_tensor(_XYZ).T / colours.new_tensor(_XYZ).sum(1)
    linear_limit = (6.0 / 29.0) ** 3
    # Clamped, since the unused branch of `where` would give an infinite gradient at 0.
    f = torch.where(
        relative_xyz > linear_limit,
        relative_xyz.clamp_min(linear_limit) ** (1.0 / 3.0),
        relative_xyz / (3.0 * (6.0 / 29.0) ** 2) + 4.0 / 29.0,
    )
    return torch.stack([116.0 * f[:, 1] - 16.0, 500.0 * (f[:, 0] - f[:, 1]), 200.0 * (f[:, 1] - f[:, 2])], 1)

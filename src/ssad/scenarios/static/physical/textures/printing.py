"""What can be printed, and how it differs from car to car: regularisers, and the expectation over print and place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from torch import Tensor
from torch.nn import functional

from ssad.core.schema import Above, Least, Span
from ssad.rendering.camera.torch_sensor import large_draws

_XYZ = ((0.4124, 0.3576, 0.1805), (0.2126, 0.7152, 0.0722), (0.0193, 0.1192, 0.9505))  # of linear RGB


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))  # not strict: a suite says it as a mapping
class Expectation:
    """How a texture differs from print to print and from car to car: uniform draws, one of each for a picture.

    Attributes:
        contrast: Least and greatest factor about mid-grey.
        brightness: Greatest change, of the range of colours.
        noise: Greatest change of a texel by itself.
        shift: Greatest shift of the texture, share of its sides; what comes in repeats the edge.
        turn: Greatest turn, rad.

    Source: ranges of contrast, brightness and noise as in Thys et al., Fooling automated surveillance cameras (2019).
    """

    contrast: Span[Above] = (0.8, 1.2)
    brightness: Least = 0.1
    noise: Least = 0.1
    shift: Annotated[Least, Field(lt=0.5)] = 0.03
    turn: Least = 0.05

    def draw(self, colour: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """The texture as it is on several cars.

        Args:
            colour: sRGB [3, H, W] in 0 to 1.
            generators: One for each car, on the CPU; the noise of texels is drawn where the texture is (see
                `large_draws`).

        Returns:
            [B, 3, H, W] in 0 to 1, differentiable in `colour`.
        """
        found: Tensor = colour.expand(len(generators), *colour.shape)
        moved = self.shift > 0.0 or self.turn > 0.0
        ranges = [(-self.turn, self.turn), (-2.0 * self.shift, 2.0 * self.shift)]
        ranges = [ranges[0], ranges[1], ranges[1]] if moved else []
        ranges += [self.contrast, (-self.brightness, self.brightness)]
        low, high = torch.tensor(ranges).T
        drawn = torch.stack([torch.rand(len(ranges), generator=one) for one in generators])
        values = (low + (high - low) * drawn).to(colour)  # all in one copy
        if moved:
            angle, move = values[:, 0], values[:, 1:3]
            height, width = colour.shape[1:]
            aspect = width / height
            cos, sin = torch.cos(angle), torch.sin(angle)
            rows = torch.stack(
                [torch.stack([cos, -sin / aspect, move[:, 0]], -1), torch.stack([sin * aspect, cos, move[:, 1]], -1)], 1
            )
            grid = functional.affine_grid(rows, list(found.shape), align_corners=False)
            found = functional.grid_sample(found, grid, mode="bilinear", padding_mode="border", align_corners=False)
        factor, offset = (values[:, k, None, None, None] for k in (-2, -1))
        found = 0.5 + factor * (found - 0.5) + offset
        if self.noise > 0.0:
            large = large_draws(generators, colour.device)
            texels = torch.stack([torch.rand(colour.shape, generator=one, device=one.device) for one in large])
            found = found + (2.0 * self.noise * texels - self.noise).to(colour)
        return found.clamp(0.0, 1.0)


NOMINAL = Expectation((1.0, 1.0), 0.0, 0.0, 0.0, 0.0)
"""Printed and placed exactly."""


def total_variation(colour: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean length of the difference from each texel to the next one across and down.

    Args:
        colour: [3, H, W].
        mask: Texels [H, W] that count; a pair counts if both do. None: all.

    Returns:
        A scalar; 0 for an even texture. Differentiable.
    """
    inside = torch.ones(colour.shape[1:], dtype=torch.bool, device=colour.device) if mask is None else mask.bool()
    across = (colour[:, :, 1:] - colour[:, :, :-1]).square().sum(0)
    down = (colour[:, 1:] - colour[:, :-1]).square().sum(0)
    pairs = torch.cat([across[inside[:, 1:] & inside[:, :-1]], down[inside[1:] & inside[:-1]]])
    if not len(pairs):
        return colour.sum() * 0.0
    return (pairs + 1e-8).sqrt().mean() - 1e-4


def non_printability(colour: Tensor, printable: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean distance of the texels' colours to the nearest printable colour.

    Args:
        colour: sRGB [3, H, W].
        printable: Colours [N, 3] that a printer can make, sRGB.
        mask: Texels [H, W] that count. None: all.

    Returns:
        A scalar, 0 where all colours are printable. Differentiable.

    Source: the non-printability score of Sharif et al., Accessorize to a Crime (2016), with the nearest colour in place
    of the product over all, which underflows.
    """
    rows = colour.flatten(1).T if mask is None else colour[:, mask.bool()].T
    if not len(rows):
        return colour.sum() * 0.0
    gaps = torch.cdist(rows, printable.to(rows))
    return gaps.amin(1).mean()


def conspicuousness(albedo: Tensor, paint: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean colour difference between a texture and what it covers, CIE 1976 (Delta E*ab): from 2 on one can see it.

    Args:
        albedo: Linear RGB [3, H, W] in 0 to 1, as it is printed (see `albedo_of`).
        paint: Linear RGB [3] of what is covered.
        mask: Texels [H, W] that count. None: all.

    Returns:
        A scalar; 0 for the paint itself, 100 for white on black. Differentiable.

    Source: CIE 15, Colorimetry: CIELAB under D65; sRGB primaries of IEC 61966-2-1.
    """
    rows = albedo.flatten(1).T if mask is None else albedo[:, mask.bool()].T
    if not len(rows):
        return albedo.sum() * 0.0
    away = _lab(rows) - _lab(paint.to(rows)[None])
    return ((away.square().sum(1) + 1e-8).sqrt() - 1e-4).mean()


def _lab(rows: Tensor) -> Tensor:
    """CIELAB [N, 3] of linear RGB [N, 3]."""
    share = rows @ rows.new_tensor(_XYZ).T / rows.new_tensor(_XYZ).sum(1)
    least = (6.0 / 29.0) ** 3
    f = torch.where(
        share > least, share.clamp_min(least) ** (1.0 / 3.0), share / (3.0 * (6.0 / 29.0) ** 2) + 4.0 / 29.0
    )
    return torch.stack([116.0 * f[:, 1] - 16.0, 500.0 * (f[:, 0] - f[:, 1]), 200.0 * (f[:, 1] - f[:, 2])], 1)

"""Inks on paper: the colours that tones of cyan, magenta, yellow and black give, and the nearest of them to any other.

Measured patches of offset printing on coated paper say what a tone of each ink gives. Between patches the albedo is
interpolated linearly in each tone, as dots of the neighbouring patches side by side give it (Neugebauer's equations,
cell by cell). What these tones can give is the gamut of the inks.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ssad.core import safeio
from ssad.core.types import F64
from ssad.rendering.camera.texture import PRINTABLE, to_linear, to_printable, to_srgb
from ssad.scenarios.static.physical.textures.printing import lab_of

CHARACTERISATION: Final = "FOGRA39"
# Tone values 0 to 100 of the four inks, and CIE XYZ (D50, 2 degrees, white backing; 100 is a perfect diffuser).
# Source: Fogra, characterization data FOGRA39L (December 2006), offset printing after ISO 12647-2:2004/Amd 1 on coated
# paper, as distributed under the zlib licence in Debian's icc-profiles-free 2.0.1; 192 of its 1617 patches.
MEASURED: Final = Path(__file__).with_name("fogra39.csv")
TONES: Final = ((0.0, 0.4, 0.7, 1.0),) * 3 + ((0.0, 0.4, 0.8),)
"""Tone values of the patches: of cyan, magenta and yellow, and of black, of which 0.8 is the most."""
# from XYZ under D50 to linear sRGB, which is defined under D65: Bradford's adaptation, then IEC 61966-2-1 (Lindbloom)
D50_TO_SRGB: Final = (
    (3.1338561, -1.6168667, -0.4906146),
    (-0.9787684, 1.9161415, 0.0334540),
    (0.0719453, -0.2289914, 1.4052427),
)
TOLERANCE: Final = 1.0
"""Colour difference (CIE 1976) up to which a colour counts as printable; solids of a press may differ by 5."""
ITERATIONS: Final = 20  # of the search for tones
BEYOND: Final = 10.0  # weight of the colour difference between a print and the nearest colour that textures can have
CHUNK: Final = 4096  # colours that are searched for at once


@lru_cache(maxsize=1)
def patches() -> tuple[F64, F64]:
    """Return the tones [192, 4] of the patches, 0 to 1, and their linear RGB [192, 3], which may lie outside 0 to 1.

    Yellow varies fastest, then magenta, cyan and black.
    """
    rows = np.array([line.split(",") for line in safeio.read_text(MEASURED).splitlines()[1:]], np.float64)
    return rows[:, :4] / 100.0, rows[:, 4:] / 100.0 @ np.array(D50_TO_SRGB).T


@lru_cache(maxsize=1)
def printable_colours() -> Tensor:
    """Return the colours of the patches [192, 3] in sRGB, 0 to 1, which `albedo_of` maps to the measured albedos.

    Colours that textures cannot have, such as pure cyan, are moved to the border of theirs.
    """
    return _colour_of(torch.from_numpy(patches()[1].T.copy()).float()).T.contiguous()


def ink_albedo(tones: Tensor) -> Tensor:
    """Return the linear RGB [3, ...] of tones [4, ...] of cyan, magenta, yellow and black.

    Args:
        tones: 0 to 1; of black, 0 to 0.8.

    Returns:
        Linear RGB, differentiable in the tones; slightly below 0 where sRGB does not hold the colour.
    """
    table = torch.from_numpy(patches()[1]).to(tones).reshape(*(len(axis) for axis in (TONES[3], *TONES[:3])), 3)
    indices, fractions = [], []
    for ink, axis in enumerate(TONES):
        ends = tones.new_tensor(axis)
        index = torch.bucketize(tones[ink].detach().contiguous(), ends[1:-1].contiguous(), right=True)
        indices.append(index)
        fractions.append((tones[ink] - ends[index]) / (ends[index + 1] - ends[index]))
    albedo = tones.new_zeros((*tones.shape[1:], 3))
    for corner in product((0, 1), repeat=4):
        cyan, magenta, yellow, black = (index + step for index, step in zip(indices, corner, strict=True))
        weight = torch.ones_like(fractions[0])
        for fraction, step in zip(fractions, corner, strict=True):
            weight = weight * (fraction if step else 1.0 - fraction)
        albedo = albedo + weight[..., None] * table[black, cyan, magenta, yellow]
    return albedo.movedim(-1, 0)


def ink_colour(tones: Tensor) -> Tensor:
    """Return the sRGB [3, ...] in 0 to 1 of tones [4, ...], which `albedo_of` maps to the albedo of the print.

    Differentiable in the tones.
    """
    return _colour_of(ink_albedo(tones))


def clamp_tones(tones: Tensor) -> Tensor:
    """Return tones [4, ...] within what the patches cover."""
    highest = tones.new_tensor([axis[-1] for axis in TONES]).reshape(4, *(1,) * (tones.ndim - 1))
    return torch.minimum(tones.clamp_min(0.0), highest)


def tones_of(colour: Tensor) -> Tensor:
    """Return the tones [4, H, W] whose print comes nearest to a texture (CIE 1976).

    Black is used only where the other inks do not give the colour within `TOLERANCE`.

    Args:
        colour: sRGB [3, H, W] in 0 to 1.
    """
    unique, inverse = torch.unique(colour.detach().flatten(1).T.double().cpu(), dim=0, return_inverse=True)
    tones = torch.cat([_nearest_tones(chunk) for chunk in unique.split(CHUNK)])
    return tones[inverse].T.reshape(4, *colour.shape[1:]).to(colour)


def gamut_distance(colour: Tensor) -> Tensor:
    """Return the colour difference (CIE 1976) [H, W] of a texture's texels to the nearest colour of the inks.

    Args:
        colour: sRGB [3, H, W] in 0 to 1.
    """
    nearest = ink_albedo(tones_of(colour.double()))
    distances: Tensor = torch.linalg.vector_norm(_lab(_albedo(colour.double())) - _lab(nearest), dim=0)
    return distances


def share_outside(colour: Tensor, mask: Tensor | None = None) -> float:
    """Return the share of a texture's texels that the inks cannot give, by more than `TOLERANCE`.

    Args:
        colour: sRGB [3, H, W] in 0 to 1.
        mask: Texels [H, W] that count. None: all.
    """
    texels = colour if mask is None else colour[:, mask.bool()][:, None]
    return float((gamut_distance(texels) > TOLERANCE).double().mean()) if texels.numel() else 0.0


def project_onto_gamut(colour: Tensor) -> Tensor:
    """Return a texture with the nearest printable colour in place of each that is not printable.

    Texels within half of `TOLERANCE` of the gamut stay as they are, so a second projection changes nothing.

    Args:
        colour: sRGB [3, H, W] in 0 to 1.
    """
    tones = tones_of(colour.double())
    nearest = ink_albedo(tones)
    # Half of the tolerance is left for the rounding to eight bits.
    is_outside = (_lab(_albedo(colour.double())) - _lab(nearest)).norm(dim=0) > 0.5 * TOLERANCE
    return torch.where(is_outside, _colour_of(nearest).to(colour), colour)


def _nearest_tones(colours: Tensor) -> Tensor:
    """Return tones [N, 4] for colours [N, 3] in sRGB: the nearest, without black ink where that is enough."""
    target = _lab(_albedo(colours.T)).T
    tones = _search(target, black=False)
    is_reached = _residual(tones, target).norm(dim=1) <= 0.5 * TOLERANCE
    if not bool(is_reached.all()):
        tones = tones.clone()
        tones[~is_reached] = _search(target[~is_reached], black=True)
    return tones


def _search(target: Tensor, *, black: bool) -> Tensor:
    """Return the tones [N, 4] with the least cost for colours [N, 3] in CIELAB, with black ink or without.

    A damped Gauss-Newton descent within the bounds of the tones, from the best tones of a lattice.
    """
    starts, lattice_lab = _lattice(black=black)
    tones = starts[torch.cdist(target, lattice_lab).argmin(1)]
    highest = tones.new_tensor([axis[-1] for axis in TONES])
    highest[3] = highest[3] if black else 0.0
    damping = tones.new_full((len(tones), 1, 1), 1.0)
    residual = _residual(tones, target)
    step = 1e-4
    for _ in range(ITERATIONS):
        slopes = []
        for ink in range(4):
            # Towards the middle, so that the tone stays within its bounds.
            offset = torch.where(tones[:, ink] > 0.5 * highest[ink], -step, step)
            moved = tones.clone()
            moved[:, ink] += offset
            slopes.append((_residual(moved, target) - residual) / offset[:, None])
        jacobian = torch.stack(slopes, -1)
        gradient = (jacobian * residual[..., None]).sum(1)
        is_fixed = ((tones <= 0.0) & (gradient > 0.0)) | ((tones >= highest) & (gradient < 0.0)) | (highest == 0.0)
        jacobian = jacobian.masked_fill(is_fixed[:, None], 0.0)
        normal = jacobian.mT @ jacobian + damping * torch.eye(4, dtype=tones.dtype)
        change = torch.linalg.solve(normal, gradient.masked_fill(is_fixed, 0.0)[..., None])[..., 0]
        candidates = torch.minimum((tones - change).clamp_min(0.0), highest)
        candidate_residual = _residual(candidates, target)
        is_better = candidate_residual.square().sum(1) < residual.square().sum(1)
        tones = torch.where(is_better[:, None], candidates, tones)
        residual = torch.where(is_better[:, None], candidate_residual, residual)
        damping = torch.where(is_better[:, None, None], 0.2 * damping, 10.0 * damping).clamp(1e-3, 1e6)
    return tones


def _residual(tones: Tensor, target: Tensor) -> Tensor:
    """Return differences [N, 6] of the prints of tones [N, 4]: to colours [N, 3] in CIELAB, and to what textures show.

    The latter counts since textures cannot have every print: pure cyan has less than no red in sRGB.
    """
    albedo = ink_albedo(tones.T)
    lab = _lab(albedo).T
    return torch.cat([lab - target, BEYOND**0.5 * (lab - _lab(albedo.clamp(*PRINTABLE)).T)], 1)


@lru_cache(maxsize=2)
def _lattice(*, black: bool) -> tuple[Tensor, Tensor]:
    """Return the tones [M, 4] at which the search begins, and their colours [M, 3] in CIELAB as textures show them."""
    axis = torch.linspace(0.0, 1.0, 11 if black else 17, dtype=torch.float64)
    blacks = torch.tensor([0.2, 0.4, 0.6, 0.8] if black else [0.0], dtype=torch.float64)
    tones = torch.cartesian_prod(axis, axis, axis, blacks)
    return tones, _lab(ink_albedo(tones.T).clamp(*PRINTABLE)).T


def _albedo(colour: Tensor) -> Tensor:
    return to_printable(to_linear(colour))


def _lab(albedo: Tensor) -> Tensor:
    """Return CIELAB [3, ...] of linear RGB [3, ...]."""
    return lab_of(albedo.flatten(1).T).T.reshape(albedo.shape)


def _colour_of(albedo: Tensor) -> Tensor:
    """Return the sRGB in 0 to 1 that `albedo_of` maps to an albedo; beyond its range, its border."""
    darkest, brightest = PRINTABLE
    return to_srgb(((albedo - darkest) / (brightest - darkest)).clamp(0.0, 1.0))

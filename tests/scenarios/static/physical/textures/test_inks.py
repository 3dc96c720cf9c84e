"""Printable colours: as measured, the gamut between them, and the nearest of it to any other colour."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from ssad.scenarios.static.physical.textures.carrier import albedo_of
from ssad.scenarios.static.physical.textures.controls import control
from ssad.scenarios.static.physical.textures.inks import (
    TOLERANCE,
    TONES,
    clamp_tones,
    gamut_distance,
    ink_albedo,
    ink_colour,
    patches,
    printable_colours,
    project_onto_gamut,
    share_outside,
    tones_of,
)
from ssad.scenarios.static.physical.textures.printing import lab_of, non_printability


def random_tones(count: int, *, seed: int = 0) -> Tensor:
    """Tones [4, count, 1] of all inks."""
    draws = torch.rand(4, count, 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return draws * draws.new_tensor([axis[-1] for axis in TONES])[:, None, None]


def test_the_colours_are_those_of_the_patches() -> None:
    """As albedo, the luminance of paper, inks and overprints is the measured one where sRGB holds the colour."""
    colours = printable_colours()
    tones, measured = patches()
    assert colours.shape == (len(TONES[0]) ** 3 * len(TONES[3]), 3)
    albedo = albedo_of(colours.T[:, :, None])[:, :, 0].T.double().numpy()
    inside = ((measured > 0.021) & (measured < 0.89)).all(1)
    assert inside.sum() >= 40
    assert albedo[inside] == pytest.approx(measured[inside], abs=2e-3)
    assert (measured @ [0.2126, 0.7152, 0.0722])[0] == pytest.approx(0.876, abs=0.02), "paper is no perfect white"
    assert tones[-1].tolist() == [1.0, 1.0, 1.0, 0.8]


def test_each_ink_takes_away_its_colour() -> None:
    paper, yellow, magenta, cyan = (printable_colours()[k].numpy() for k in (0, 3, 12, 48))
    assert paper.min() > 0.9
    assert yellow.argmin() == 2
    assert magenta.argmin() == 1
    assert cyan.argmin() == 0
    assert printable_colours()[63].mean() > 3.0 * printable_colours()[191].mean(), "black makes the three inks darker"


def test_ink_costs_nothing_and_screens_green_does() -> None:
    inks = printable_colours()
    patch = inks.T.reshape(3, 8, 24)
    assert float(non_printability(patch, inks)) == pytest.approx(0.0, abs=1e-4)
    green = torch.tensor([0.0, 1.0, 0.0])[:, None, None].expand(3, 4, 4)
    assert float(non_printability(green, inks)) > 0.3


def test_patches_have_their_measured_albedo_and_the_middle_between_two_has_their_mean() -> None:
    tones, measured = patches()
    assert ink_albedo(torch.from_numpy(tones.T.copy())).T.numpy() == pytest.approx(measured, abs=1e-12)
    between = torch.tensor([0.55, 0.7, 0.0, 0.4], dtype=torch.float64)[:, None]
    row = {tuple(tone): albedo for tone, albedo in zip(tones.round(3).tolist(), measured, strict=True)}
    mean = 0.5 * (row[0.4, 0.7, 0.0, 0.4] + row[0.7, 0.7, 0.0, 0.4])
    assert ink_albedo(between)[:, 0].numpy() == pytest.approx(mean, abs=1e-12)


def test_gradients_flow_to_each_tone() -> None:
    """They are those of differences in the middle of a cell, where the interpolation has no kink."""
    tones = torch.tensor([0.2, 0.55, 0.3, 0.2], dtype=torch.float64)[:, None].requires_grad_()
    assert torch.autograd.gradcheck(ink_colour, tones)
    (gradient,) = torch.autograd.grad(ink_colour(tones).sum(), tones)
    assert bool((gradient < -0.1).all()), "more ink is darker"


def test_a_projection_is_inside_idempotent_and_leaves_the_printable() -> None:
    noise = control("noise", (12, 12))
    assert share_outside(noise) > 0.3
    printed = project_onto_gamut(noise)
    assert share_outside(printed) == 0.0
    assert torch.equal(project_onto_gamut(printed), printed)
    is_inside = gamut_distance(noise) < 0.4 * TOLERANCE
    assert bool(is_inside.any())
    assert torch.equal(printed[:, is_inside], noise[:, is_inside])
    assert share_outside((printed * 255).round() / 255) == 0.0, "nor does an image file lose it"


def test_a_projection_is_the_nearest_print() -> None:
    """No tones of a dense sample come nearer to a colour than those found."""
    colours = torch.tensor([[0.0, 1.0, 0.0], [0.1, 0.0, 1.0], [1.0, 0.0, 0.9], [0.02, 0.02, 0.02], [1.0, 1.0, 1.0]])
    colours = colours.double().T[:, :, None]
    sample = lab_of(ink_albedo(random_tones(40_000)).flatten(1).T)
    wanted = lab_of(albedo_of(colours).flatten(1).T)
    found = lab_of(ink_albedo(tones_of(colours)).flatten(1).T)
    nearest = torch.cdist(wanted, sample).amin(1)
    assert bool(((found - wanted).norm(dim=1) < nearest + 0.5).all())
    assert (found - wanted).norm(dim=1)[:3].min() > 20.0


def test_what_inks_give_is_printable_where_textures_can_show_it() -> None:
    """Pure cyan has less than no red in sRGB: what a texture shows of it is another colour, and is projected."""
    tones = random_tones(60, seed=3)
    assert torch.equal(clamp_tones(tones), tones)
    is_shown = ((ink_albedo(tones) >= 0.02) & (ink_albedo(tones) <= 0.9)).all(0)
    assert float(gamut_distance(ink_colour(tones))[is_shown].max()) < 0.1
    cyan = ink_colour(torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)[:, None, None])
    assert share_outside(cyan) == 1.0
    assert share_outside(project_onto_gamut(cyan)) == 0.0


def test_the_share_counts_the_texels_of_the_mask() -> None:
    colours = torch.full((3, 2, 2), 0.5)
    colours[:, 0, 0] = torch.tensor([0.0, 1.0, 0.0])
    assert share_outside(colours) == 0.25
    assert share_outside(colours, torch.tensor([[True, True], [False, False]])) == 0.5
    assert share_outside(colours, torch.zeros(2, 2)) == 0.0
    assert np.isclose(float(gamut_distance(colours)[1, 1]), 0.0, atol=0.05)

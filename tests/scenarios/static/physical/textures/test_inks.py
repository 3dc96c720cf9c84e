"""Printable colours: as measured, and what the score makes of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssad.scenarios.static.physical.textures.carrier import albedo_of
from ssad.scenarios.static.physical.textures.inks import D50_TO_SRGB, FOGRA39, TONES, printable_colours
from ssad.scenarios.static.physical.textures.printing import non_printability


def test_the_colours_are_those_of_the_patches() -> None:
    """As albedo, the luminance of paper, inks and overprints is the measured one where sRGB holds the colour."""
    colours = printable_colours()
    assert colours.shape == (len(TONES) ** 3, 3)
    assert len(colours.unique(dim=0)) == 64
    albedo = albedo_of(colours.T[:, :, None])[:, :, 0].T.double().numpy()
    measured = np.array(FOGRA39)
    wanted = measured / 100.0 @ np.array(D50_TO_SRGB).T
    inside = ((wanted > 0.021) & (wanted < 0.89)).all(1)
    assert inside.sum() >= 20
    assert albedo[inside] == pytest.approx(wanted[inside], abs=2e-3)
    assert (wanted @ [0.2126, 0.7152, 0.0722])[0] == pytest.approx(0.876, abs=0.02), "paper is no perfect white"


def test_the_order_is_cyan_magenta_yellow() -> None:
    paper, yellow, magenta, cyan = (printable_colours()[k].numpy() for k in (0, 3, 12, 48))
    assert paper.min() > 0.9
    assert yellow.argmin() == 2
    assert magenta.argmin() == 1
    assert cyan.argmin() == 0


def test_ink_costs_nothing_and_screens_green_does() -> None:
    inks = printable_colours()
    patch = inks.T.reshape(3, 8, 8)
    assert float(non_printability(patch, inks)) == pytest.approx(0.0, abs=1e-4)
    green = torch.tensor([0.0, 1.0, 0.0])[:, None, None].expand(3, 4, 4)
    assert float(non_printability(green, inks)) > 0.3

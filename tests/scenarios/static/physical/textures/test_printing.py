"""Print and place: regularisers by hand, draws that keep to their ranges, gradients through them, plain controls."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.schema import build_validated
from ssad.scenarios.static.physical.textures.controls import CELL, control
from ssad.scenarios.static.physical.textures.printing import (
    NOMINAL,
    Expectation,
    conspicuousness,
    non_printability,
    total_variation,
)


def test_total_variation_by_hand() -> None:
    even = torch.full((3, 4, 5), 0.3)
    assert float(total_variation(even)) == pytest.approx(0.0, abs=1e-6)
    step = torch.zeros(3, 1, 3)
    step[:, 0, 2] = 0.5
    assert float(total_variation(step)) == pytest.approx(0.5 * (0.5 * 3**0.5 + 1e-4) - 1e-4, abs=1e-5)
    mask = torch.tensor([[True, True, False]])
    assert float(total_variation(step, mask)) == pytest.approx(0.0, abs=1e-6)
    assert float(total_variation(step, torch.tensor([[True, False, True]]))) == 0.0, "no pair"


def test_non_printability_by_hand() -> None:
    inks = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    colour = torch.tensor([[0.0, 0.9, 0.0], [0.0, 0.0, 0.6], [0.0, 0.0, 0.8]]).reshape(3, 1, 3)
    assert float(non_printability(colour, inks)) == pytest.approx((0.0 + 0.1 + 1.0) / 3)
    assert float(non_printability(colour, inks, torch.tensor([[True, True, False]]))) == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("colour", "paint", "away"),
    [
        ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), 100.0),
        ((0.184187, 0.184187, 0.184187), (0.0, 0.0, 0.0), 50.0),  # mid-grey, L* = 50
        ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (53.24**2 + 80.09**2 + 67.20**2) ** 0.5),  # CIELAB of sRGB's primaries
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), ((53.24 - 87.73) ** 2 + (80.09 + 86.18) ** 2 + (67.20 - 83.18) ** 2) ** 0.5),
        ((0.3, 0.5, 0.1), (0.3, 0.5, 0.1), 0.0),
    ],
)
def test_conspicuousness_of_known_colours(
    colour: tuple[float, float, float], paint: tuple[float, float, float], away: float
) -> None:
    paper = torch.tensor(colour)[:, None, None].expand(3, 2, 3)
    assert float(conspicuousness(paper, torch.tensor(paint))) == pytest.approx(away, abs=0.05)
    half = torch.cat([paper, torch.tensor(paint)[:, None, None].expand(3, 2, 3)], 1)
    assert float(conspicuousness(half, torch.tensor(paint))) == pytest.approx(away / 2, abs=0.05), "a mean over texels"
    mask = torch.tensor([[True] * 3] * 2 + [[False] * 3] * 2)
    assert float(conspicuousness(half, torch.tensor(paint), mask)) == pytest.approx(away, abs=0.05)


@pytest.mark.parametrize("what", ["variation", "printing", "conspicuousness", "draw"])
def test_gradients_equal_finite_differences(what: str) -> None:
    draws = torch.Generator().manual_seed(1)
    colour = (0.3 + 0.4 * torch.rand(3, 6, 7, generator=draws)).double()
    inks = torch.rand(5, 3, generator=draws).double()
    weight = torch.rand(3, 6, 7, generator=draws).double()

    def value(colour: torch.Tensor) -> torch.Tensor:
        if what == "variation":
            return total_variation(colour)
        if what == "printing":
            return non_printability(colour, inks)
        if what == "conspicuousness":
            return conspicuousness(colour, inks[0]) / 100.0
        return (Expectation().draw(colour, [torch.Generator().manual_seed(2)])[0] * weight).sum()

    assert torch.autograd.gradcheck(value, (colour.requires_grad_(),), eps=1e-6, atol=1e-5)


def test_printed_exactly_is_the_texture() -> None:
    colour = torch.rand(3, 8, 12, generator=torch.Generator().manual_seed(0))
    assert torch.equal(NOMINAL.draw(colour, [torch.Generator()])[0], colour)


@given(st.integers(0, 2**31), st.floats(0.0, 0.2), st.floats(0.0, 0.3))
def test_a_draw_keeps_to_its_ranges(seed: int, brightness: float, noise: float) -> None:
    """Of mid-grey nothing is left but brightness and noise."""
    expectation = Expectation((0.5, 2.0), brightness, noise, 0.1, 0.2)
    found = expectation.draw(torch.full((3, 5, 9), 0.5), [torch.Generator().manual_seed(seed)])[0]
    assert float((found - 0.5).abs().max()) <= brightness + noise + 1e-5
    assert float(found.min()) >= 0.0
    assert float(found.max()) <= 1.0


def test_a_shift_moves_the_texture_and_a_turn_turns_it_in_its_true_shape() -> None:
    colour = torch.zeros(3, 20, 60)
    colour[:, 8:12, 28:32] = 1.0
    exact = {"contrast": (1.0, 1.0), "brightness": 0.0, "noise": 0.0}
    places = []
    for seed in range(40):
        found = Expectation(shift=0.1, turn=0.0, **exact).draw(colour, [torch.Generator().manual_seed(seed)])[0, 0]
        weight = found / found.sum()
        places.append(((weight.sum(1) * torch.arange(20)).sum() - 9.5, (weight.sum(0) * torch.arange(60)).sum() - 29.5))
    down, across = np.abs(np.array(places)).max(0)
    assert 1.0 < down <= 2.05
    assert 3.0 < across <= 6.05
    bar = torch.zeros(3, 40, 80)
    bar[:, 19:21, 20:60] = 1.0  # 40 texels long
    for seed in range(5):
        found = Expectation(shift=0.0, turn=0.5, **exact).draw(bar, [torch.Generator().manual_seed(seed)])[0, 0]
        assert float(found.sum()) == pytest.approx(80.0, rel=0.05), "its area stays"


def test_the_mean_over_draws_comes_nearer_with_more_of_them() -> None:
    colour = torch.rand(3, 6, 6, generator=torch.Generator().manual_seed(3))
    many = Expectation().draw(colour, [torch.Generator().manual_seed(k) for k in range(640)])
    spread = [float(many.reshape(-1, size, *colour.shape).mean(1).var(0).mean()) for size in (1, 4, 16)]
    assert 3.0 < spread[0] / spread[1] < 5.5
    assert 2.5 < spread[1] / spread[2] < 6.5


@pytest.mark.parametrize(
    "wrong",
    [{"contrast": (1.2, 0.8)}, {"contrast": (0.0, 1.0)}, {"brightness": -0.1}, {"shift": 0.5}],
)
def test_ranges_that_cannot_be_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=f"expectation: {next(iter(wrong))}"):
        build_validated(Expectation, wrong, subject="expectation")


def test_controls() -> None:
    size = (20, 30)
    assert torch.equal(control("grey", size), torch.full((3, 20, 30), 0.5))
    squares = control("random", size, seed=1)
    assert torch.equal(squares[:, :CELL, :CELL], squares[:, :1, :1].expand(3, CELL, CELL))
    assert torch.equal(squares, control("random", size, seed=1))
    assert not torch.equal(squares, control("random", size, seed=2))
    assert len(torch.unique(control("noise", size))) > 1000
    whole = torch.rand(3, 4 * CELL, 2 * CELL, generator=torch.Generator().manual_seed(5))
    mixed = control("shuffled", (4 * CELL, 2 * CELL), trained=whole)
    assert not torch.equal(mixed, whole)
    assert torch.equal(mixed.flatten().sort().values, whole.flatten().sort().values), "the same texels elsewhere"
    blocks = [whole[:, r : r + CELL, c : c + CELL] for r in range(0, 4 * CELL, CELL) for c in (0, CELL)]
    assert any(torch.equal(mixed[:, :CELL, :CELL], block) for block in blocks)
    with pytest.raises(UnknownNameError, match="control 'gray'"):
        control("gray", size)
    with pytest.raises(ConfigError, match="needs the trained one"):
        control("shuffled", size)

"""Budgets hold to the last bit after a round trip through an 8-bit file."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital import Budget, px
from ssad.scenarios.static.digital.budget import codes_of, lengths, quantise
from ssad.scenarios.static.digital.check import is_within_budget

SHAPE = (2, 3, 5, 7)
RADII = st.one_of(st.integers(0, 12).map(float), st.floats(0.0, 300.0, allow_nan=False))


def case(seed: int, reach: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Clean images of 8 bits, and others around them."""
    draws = torch.Generator().manual_seed(seed)
    clean = torch.randint(0, 256, SHAPE, generator=draws) / 255
    return clean, clean + reach * torch.randn(SHAPE, generator=draws)


@settings(max_examples=1000, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    radius=RADII,
    norm=st.sampled_from(["linf", "l2"]),
    reach=st.sampled_from([0.01, 0.3, 5]),
)
def test_what_is_stored_keeps_to_the_budget(seed: int, radius: float, norm: str, reach: float) -> None:
    budget = Budget(px(radius), norm)  # type: ignore[arg-type]
    clean, images = case(seed, reach)
    kept = quantise(budget.project(images, clean), codes_of(clean), budget).int() - codes_of(clean)
    if norm == "linf":
        assert int(kept.abs().max()) <= radius + 1e-9
    else:
        assert bool(((kept.double() ** 2).flatten(1).sum(1) <= radius**2 * (1 + 1e-9)).all())
    assert is_within_budget((codes_of(clean) + kept) / 255, clean, budget)


@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_what_breaks_the_budget_is_brought_back(norm: str) -> None:
    clean, images = case(3, 0.5)
    budget = Budget(px(4), norm)  # type: ignore[arg-type]
    kept = quantise(images.clamp(-1, 2), codes_of(clean), budget)
    assert is_within_budget(kept.float() / 255, clean, budget)
    assert not torch.equal(kept.int(), codes_of(clean))


@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_images_within_the_ball_stay_as_they_are(norm: str) -> None:
    clean, images = case(5, 0.002)
    images = images.clamp(0, 1)
    room = float(lengths(images - clean).max() if norm == "l2" else (images - clean).abs().max())
    kept = Budget(room * 1.001, norm).project(images, clean)  # type: ignore[arg-type]
    assert torch.allclose(kept, images, atol=1e-6)


def test_a_stored_file_gives_the_same_picture(tmp_path: object) -> None:
    clean, images = case(7, 0.02)
    budget = Budget(px(5))
    kept = quantise(budget.project(images, clean), codes_of(clean), budget)
    picture = kept[0].permute(1, 2, 0).numpy()
    path = f"{tmp_path}/attacked.png"
    cv2.imwrite(path, np.ascontiguousarray(picture))
    assert np.array_equal(cv2.imread(path), picture)


def test_the_budget_is_used() -> None:
    """Rounding towards the clean picture alone would leave nothing of a change of less than one code value each."""
    clean = torch.full(SHAPE, 100 / 255)
    budget = Budget(px(6.0), "l2")
    images = clean + budget.radius * budget.steepest(torch.ones(SHAPE))
    moved = quantise(budget.project(images, clean), codes_of(clean), budget).double() - 100
    assert torch.equal((moved**2).flatten(1).sum(1), torch.full((2,), 36.0, dtype=torch.float64))


def test_steepest_directions() -> None:
    gradient = torch.tensor([3.0, -4.0, 0.0]).view(1, 3, 1, 1)
    assert Budget(1.0).steepest(gradient).flatten().tolist() == [1.0, -1.0, 0.0]
    assert torch.allclose(Budget(1.0, "l2").steepest(gradient).flatten(), torch.tensor([0.6, -0.8, 0.0]))
    assert not Budget(1.0, "l2").steepest(torch.zeros(1, 3, 1, 1)).any()


@pytest.mark.parametrize("kind", ["uniform", "gaussian"])
@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_starts_lie_in_the_ball(norm: str, kind: str) -> None:
    budget = Budget(px(5), norm)  # type: ignore[arg-type]
    chance, shape = torch.Generator().manual_seed(0), (64, *SHAPE[1:])  # of a few, all may be short
    clean = torch.full(shape, 0.5)
    uniform = 2 * torch.rand(shape, generator=chance) - 1
    draws = torch.randn(shape, generator=chance) if kind == "gaussian" else uniform
    change = budget.project(clean + budget.start(draws, kind), clean) - clean  # type: ignore[arg-type]
    size = change.abs().max() if norm == "linf" else lengths(change).max()
    assert 0.9 * budget.radius < float(size) <= budget.radius * (1 + 1e-4)


@pytest.mark.parametrize("radius", [-1.0, float("nan"), float("inf")])
def test_a_radius_that_is_none(radius: float) -> None:
    with pytest.raises(ConfigError, match="radius must be 0 or more"):
        Budget(radius)


def test_a_norm_that_there_is_not() -> None:
    with pytest.raises(ConfigError, match="choose linf or l2"):
        Budget(0.1, "l1")  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [0.5, -1 / 255, 256 / 255, float("nan")])
def test_clean_images_have_8_bits(value: float) -> None:
    with pytest.raises(ConfigError, match="8 bits"):
        codes_of(torch.full((1, 3, 2, 2), value))


@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_a_step_is_ascent_and_projection_and_leaves_its_input_alone(norm: str) -> None:
    chance = torch.Generator().manual_seed(0)
    clean = torch.randint(0, 256, SHAPE, generator=chance) / 255
    budget = Budget(px(5) if norm == "linf" else px(100), norm)  # type: ignore[arg-type]
    images = budget.project(clean + 0.1 * torch.randn(SHAPE, generator=chance), clean)
    gradient = torch.randn(SHAPE, generator=chance)
    before = [one.clone() for one in (images, gradient, clean)]
    found = budget.ascend(images, gradient, clean, 0.5 * budget.radius)
    expected = budget.project(images + 0.5 * budget.radius * budget.steepest(gradient), clean)
    assert torch.allclose(found, expected, atol=1e-6)
    assert (found - images).abs().max() > px(1) / 10
    assert all(torch.equal(one, kept) for one, kept in zip((images, gradient, clean), before, strict=True))

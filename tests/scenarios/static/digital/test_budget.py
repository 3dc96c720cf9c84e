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
from ssad.scenarios.static.digital.noise import RandomNoise
from ssad.scenarios.static.digital.victim import CleanImages

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


def stored_length(images: torch.Tensor, clean: torch.Tensor, budget: Budget) -> torch.Tensor:
    """Squared length [B] of the stored change, in code values: an integer."""
    change = quantise(images, codes_of(clean), budget).double() - codes_of(clean)
    return (change**2).flatten(1).sum(1)


def clean_images(size: tuple[int, int], *, saturated: float = 0.0, count: int = 1) -> torch.Tensor:
    """Random images of 8 bits, with a share of values at 0 or 255."""
    draws = torch.Generator().manual_seed(1)
    shape = (count, 3, *size)
    codes = torch.randint(0, 256, shape, generator=draws)
    ends = 255 * torch.randint(0, 2, shape, generator=draws)
    return torch.where(torch.rand(shape, generator=draws) < saturated, ends, codes) / 255


@pytest.mark.parametrize("saturated", [0.0, 0.6])
@pytest.mark.parametrize(
    ("size", "radius"),
    # The first is noise whose values are 0.19 code values each: rounded to the nearest, it loses half its length.
    [((450, 800), 200.0), ((45, 80), 20.0), ((45, 80), 2.5), ((45, 80), 300.0), ((12, 20), 1500.0)],
)
def test_noise_under_l2_is_stored_as_long_as_the_budget(size: tuple[int, int], radius: float, saturated: float) -> None:
    budget, clean = Budget(px(radius), "l2"), clean_images(size, saturated=saturated)
    images = RandomNoise().perturb(CleanImages(clean, [(0,)]), budget)
    squared_length = float(stored_length(images, clean, budget))
    assert squared_length <= radius**2
    assert radius - squared_length**0.5 < 1.0
    if radius <= 300:
        # Steps of length 1 are left over, so the sum of squares is the largest integer within the budget.
        assert squared_length == int(radius**2)


def test_rounding_keeps_the_length_of_a_change_that_is_shorter_than_the_budget() -> None:
    clean = clean_images((45, 80), count=2)
    direction = torch.randn(clean.shape, generator=torch.Generator().manual_seed(2))
    images = Budget(px(30.0), "l2").to_border(clean, direction)
    assert stored_length(images, clean, Budget(px(90.0), "l2")).tolist() == pytest.approx([900.0, 900.0], abs=1.0)


@pytest.mark.parametrize("change", [(3.4, -1.3, 1.0, 0.4), (0.4, 3.3, -2.1, 1.4), (-1.1, 4.4, 2.0, 0.2)])
def test_rounding_keeps_the_direction(change: tuple[float, ...]) -> None:
    """Of all images within its length, the stored one goes furthest along the change, as an exhaustive search shows."""
    # Values in the order of their remainders alone would spend the length on small ones.
    exact = torch.tensor(change, dtype=torch.float64)
    clean = torch.full((1, 4, 1, 1), 100 / 255, dtype=torch.float64)
    budget = Budget(px(float(exact.norm())), "l2")
    stored = quantise(clean + exact.view(1, 4, 1, 1) / 255, codes_of(clean), budget)[0].flatten().int() - 100
    candidates = torch.cartesian_prod(*[torch.arange(-6, 7)] * 4).double()
    candidates = candidates[(candidates**2).sum(1) <= float((exact**2).sum()) + 1e-9]
    best = candidates[(candidates @ exact).argmax()]
    assert stored.tolist() == best.int().tolist()


def test_the_projection_under_l2_is_the_nearest_image_of_the_ball_and_the_range() -> None:
    """Its conditions of optimality: clipped values apart, the image lies on the line to the clean one."""
    clean = clean_images((5, 7), saturated=0.5, count=3)
    images = clean + 0.4 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(4))
    budget = Budget(px(250.0), "l2")
    projected = budget.project(images, clean)
    assert torch.allclose(lengths(projected - clean), torch.tensor(budget.radius), rtol=1e-5)
    for image_clean, image_given, image in zip(clean, images, projected, strict=True):
        is_inside = (image > 0) & (image < 1)
        ratios = ((image - image_clean) / (image_given - image_clean))[is_inside]
        assert float(ratios.max() - ratios.min()) < 1e-3
        assert torch.allclose(
            image, (image_clean + ratios.median() * (image_given - image_clean)).clamp(0, 1), atol=1e-5
        )


def test_an_image_that_cannot_move_far_enough_moves_as_far_as_it_can() -> None:
    clean = torch.zeros(1, 3, 2, 2)
    budget, direction = Budget(50.0, "l2"), torch.ones(1, 3, 2, 2)
    direction[0, 0] = -1.0
    moved = budget.to_border(clean, direction)
    assert torch.equal(moved, (direction > 0).float())
    assert torch.equal(budget.to_border(clean, torch.zeros_like(clean)), clean)

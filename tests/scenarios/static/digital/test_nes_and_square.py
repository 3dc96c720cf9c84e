"""Attacks that ask for losses only: exact budgets, counted queries, one image at a time, better than noise."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers.mono3d import one_thread
from helpers.quick import others_slow
from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.detectors import make_detector
from ssad.scenarios.static.digital import Budget, make_attack, px, run_attack
from ssad.scenarios.static.digital.nes import NES
from ssad.scenarios.static.digital.objectives import Vanish
from ssad.scenarios.static.digital.square import Square, _hill
from ssad.scenarios.static.digital.victim import Victim

from .toy_detector import ToyDetector, TrueLogits, best_linf, toy_scene

FEW: list[tuple[str, dict[str, Any], int]] = [
    ("square", {"queries": 12}, 12),
    ("nes", {"steps": 2, "samples": 3}, 15),
    ("spsa", {"steps": 2, "samples": 3}, 15),
]
BUDGETS = [Budget(px(5)), Budget(px(2.6)), Budget(px(150), "l2")]


def moved(images: Tensor, clean: Tensor, budget: Budget) -> float:
    """The largest move of a batch in code values, in the budget's norm."""
    change = ((images - clean).double() * 255).round().flatten(1)
    return float(change.abs().max() if budget.norm == "linf" else change.norm(dim=1).max())


@pytest.mark.parametrize(("name", "options", "queries"), FEW)
@pytest.mark.parametrize("budget", BUDGETS, ids=str)
def test_budgets_hold_and_queries_are_counted(name: str, options: dict[str, Any], queries: int, budget: Budget) -> None:
    detector = ToyDetector()
    for seed in range(12):
        images, truth = toy_scene(2, seed=seed, size=(32, 40))
        if seed % 3 == 0:  # near black and white, where the range holds before the budget does
            images = ((images - images.mean()) * 8 + seed % 2).clamp(0, 1).mul(255).round() / 255
        found = run_attack(make_attack(name, **options), detector, images, truth, budget, objective=Vanish())
        codes = found.images.double() * 255
        assert float((codes - codes.round()).abs().max()) < 1e-4
        assert 0.0 <= float(found.images.min()) <= float(found.images.max()) <= 1.0
        assert moved(found.images, images, budget) <= budget.radius * 255 + 1e-9
        assert (found.cost.queries, found.cost.gradients) == (queries, 0)
        victim = Victim(detector, images, truth, Vanish())
        inside = make_attack(name, **options).perturb(victim, budget)
        assert moved_exactly(inside, images, budget) <= budget.radius * (1 + 1e-5)


def moved_exactly(images: Tensor, clean: Tensor, budget: Budget) -> float:
    """The largest move of a batch, in the budget's norm."""
    change = (images - clean).double().flatten(1)
    return float(change.abs().max() if budget.norm == "linf" else change.norm(dim=1).max())


@pytest.mark.parametrize(("name", "options", "queries"), FEW)
@pytest.mark.parametrize("budget", BUDGETS, ids=str)
def test_an_image_does_not_know_its_batch(name: str, options: dict[str, Any], queries: int, budget: Budget) -> None:
    detector, (images, truth), keys = ToyDetector(), toy_scene(2), [("a",), ("b",)]
    both = run_attack(make_attack(name, **options), detector, images, truth, budget, objective=TrueLogits(), keys=keys)
    for k in range(2):
        alone = run_attack(
            make_attack(name, **options),
            detector,
            images[k : k + 1],
            truth[k : k + 1],
            budget,
            objective=TrueLogits(),
            keys=keys[k : k + 1],
        )
        assert torch.equal(alone.images[0], both.images[k])
        assert alone.cost == both.cost


@pytest.mark.parametrize("norm", ["linf", "l2"])
@pytest.mark.parametrize("name", ["square", "nes", "spsa"])
def test_they_beat_noise_on_a_linear_detector(name: str, norm: str) -> None:
    detector, (images, truth) = ToyDetector(), toy_scene(3)
    budget = Budget(px(5) if norm == "linf" else px(400), norm)  # type: ignore[arg-type]
    options = {"queries": 600} if name == "square" else {"samples": 10}
    found = run_attack(make_attack(name, **options), detector, images, truth, budget, objective=TrueLogits())
    noise = run_attack(make_attack("noise"), detector, images, truth, budget, objective=TrueLogits())
    assert float(found.after.mean()) > float(noise.after.mean()) + 0.5
    assert bool((found.after >= found.before).all())
    if norm == "linf":
        best = best_linf(detector, images, truth, budget.radius)
        victim = Victim(detector, images, truth, TrueLogits())
        assert bool((found.after <= victim.loss(best) + 1e-4).all())


def test_the_estimate_is_the_gradient_on_average() -> None:
    detector, (images, truth) = ToyDetector(), toy_scene(1, size=(16, 16), objects=2)
    victim = Victim(detector, images, truth, TrueLogits())
    gradient = victim.gradient(images)[1].flatten()
    for directions in ("gaussian", "signs"):
        estimate = NES(samples=600, directions=directions).estimate(victim, images).flatten()  # type: ignore[arg-type]
        # of n draws in d dimensions the squared error is about d / n of the squared length
        along = float(estimate @ gradient / (gradient @ gradient))
        assert 0.8 < along < 1.2
        wrong = float((estimate - gradient).norm() / gradient.norm())
        assert 0.7 < wrong / (len(gradient) / 600) ** 0.5 < 1.3


def test_directions_are_constant_over_tiles_and_find_the_mean_slope_of_each() -> None:
    detector, (images, truth) = ToyDetector(), toy_scene(1, size=(16, 12), objects=2)
    victim = Victim(detector, images, truth, TrueLogits())
    tiles = [(slice(top, top + 8), slice(left, left + 8)) for top in (0, 8) for left in (0, 8)]  # the last is cut off
    slopes = torch.stack([victim.gradient(images)[1][0, :, y, x].sum((1, 2)) for y, x in tiles]).flatten()
    estimate = NES(samples=400, tile=8).estimate(victim, images)[0]
    for y, x in tiles:
        assert bool((estimate[:, y, x] == estimate[:, y, x][:, :1, :1]).all())
    found = torch.stack([estimate[:, y, x][:, 0, 0] for y, x in tiles]).flatten()
    assert float(torch.corrcoef(torch.stack([slopes, found]))[0, 1]) > 0.9


def test_squares_shrink_by_the_schedule_of_the_source() -> None:
    attack = Square(share=0.8)
    sides = [attack.side(done / 10_000, 32, 32) for done in (0, 10, 11, 51, 201, 501, 1001, 2001, 4001, 6001, 8001)]
    assert sides == [29, 29, 20, 14, 10, 7, 5, 4, 3, 2, 1]
    assert attack.side(0.0, 16, 400) == 15
    assert attack.side(1.0, 16, 16, min_side=3) == 3


def test_the_bump_is_that_of_the_source() -> None:
    wanted = torch.tensor([[0.25, 0.25, 0.25], [0.25, 1.25, 0.25], [0.25, 0.25, 0.25]])
    assert torch.allclose(_hill(3, 3), wanted / wanted.norm())


@pytest.mark.parametrize("norm", ["linf", "l2"])
@pytest.mark.parametrize("name", others_slow(["square", "nes", "spsa"], ["square"]))
def test_they_beat_noise_on_a_shipped_detector(name: str, norm: str) -> None:
    with one_thread():
        detector = make_detector("yolov5n")
        chance = torch.Generator().manual_seed(0)
        images = torch.randint(60, 200, (1, 3, 64, 96), generator=chance).float()
        images[:, :, 24:48, 32:64] = torch.tensor([150.0, 20, 20]).view(3, 1, 1)
        images = images / 255
        truth = [Truth(torch.tensor([0]), torch.tensor([[32.0, 24, 64, 48]]))]
        budget = Budget(px(5) if norm == "linf" else px(300), norm)  # type: ignore[arg-type]
        options = {"queries": 60} if name == "square" else {"steps": 5, "samples": 6}
        found = run_attack(make_attack(name, **options), detector, images, truth, budget, objective="full")
        noise = run_attack(make_attack("noise"), detector, images, truth, budget, objective="full")
    assert float(found.after - found.before) > 1.5 * abs(float(noise.after - noise.before))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("square", {"queries": 2}, "queries must be 3 or more"),
        ("square", {"share": 0.0}, "share above 0"),
        ("square", {"querys": 5}, "attack square: "),
        ("nes", {"samples": 0}, "nes: steps and samples must be 1 or more"),
        ("nes", {"sigma": 0.0}, "sigma above 0"),
        ("nes", {"step": -1.0}, "step must be above 0"),
        ("nes", {"tile": 0}, "tile must be 1 or more"),
        ("nes", {"directions": "all"}, "choose gaussian or signs"),
        ("spsa", {"steps": 0}, "spsa: steps"),
    ],
)
def test_bad_options_are_named(name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_attack(name, **options)

"""Defences: gradients through them, detectors behind them, attacks that know them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.scenarios.static.digital import Budget, make_attack, px, run_attack
from ssad.scenarios.static.digital.defences import (
    DEFENCES,
    BitDepth,
    Blur,
    Defence,
    Defended,
    Jpeg,
    RandomResize,
    make_defence,
)
from ssad.scenarios.static.digital.expectation import Expected
from ssad.scenarios.static.digital.gradient_check import check_gradient
from ssad.scenarios.static.digital.nes import NES
from ssad.scenarios.static.digital.objectives import Vanish
from ssad.scenarios.static.digital.pgd import PGD
from ssad.scenarios.static.digital.victim import Victim, steady

from .toy_detector import LENS, ToyDetector, TrueLogits, toy_scene

ALL = [Jpeg(75), Jpeg(90, "444"), BitDepth(4), Blur(0.7), RandomResize(0.7)]
BUDGET = Budget(px(5))


@pytest.mark.parametrize("defence", ALL, ids=lambda one: one.name)
def test_each_image_passes_alone_and_stays_in_range(defence: Defence) -> None:
    images = torch.rand(3, 3, 37, 50, generator=torch.Generator().manual_seed(0))
    passed = defence(images)
    assert passed.shape == images.shape
    assert 0.0 <= float(passed.min()) < float(passed.max()) <= 1.0
    for k in range(3):
        assert torch.equal(defence(images[k : k + 1])[0], passed[k])
    assert not torch.equal(passed, images)
    assert torch.equal(defence(images), passed)


@pytest.mark.parametrize("defence", ALL, ids=lambda one: one.name)
def test_a_gradient_flows_through(defence: Defence) -> None:
    """A step of some code values along it raises the loss behind the defence as far as it says, about."""
    detector, (images, truth) = ToyDetector(), toy_scene(2)
    shown = defence.fixed_draw(0) if isinstance(defence, RandomResize) else defence
    victim = Victim(detector, images, truth, TrueLogits(), through=shown)
    loss, gradient = victim.gradient(images)
    change = px(8) * gradient.sign()
    promised = (gradient * change).sum((1, 2, 3))
    gained = victim.loss(images + change) - loss
    assert bool((promised > 3).all())
    # what JPEG takes away of a pattern as faint as its steps is not in a slope of one
    low = 0.3 if isinstance(defence, Jpeg) else 0.8
    assert bool((gained > low * promised).all())
    assert bool((gained < 1.5 * promised).all())


def test_they_do_what_their_names_say() -> None:
    images = torch.rand(1, 3, 32, 48, generator=torch.Generator().manual_seed(0))
    assert len(BitDepth(3)(images).unique()) == 8
    assert float((BitDepth(3)(images) - images).abs().max()) <= 0.5 / 7 + 1e-6
    point = torch.zeros(1, 3, 33, 33)
    point[..., 16, 16] = 1.0
    spread = Blur(2.0)(point)[0, 0]
    assert float(spread.sum()) == pytest.approx(1.0, abs=1e-5)
    away = torch.arange(33.0) - 16
    assert float((spread.sum(0) * away**2).sum()) == pytest.approx(4.0, rel=0.05)
    assert torch.allclose(spread, spread.T)
    assert torch.allclose(Blur(1.0)(torch.full((1, 3, 8, 8), 0.5)), torch.tensor(0.5))
    less = [float((Jpeg(quality)(images) - images).abs().mean()) for quality in (95, 60, 20)]
    assert less[0] < less[1] < less[2]


def test_resizing_moves_nothing_and_draws_by_picture() -> None:
    slope = torch.linspace(0, 1, 64).expand(1, 3, 48, 64).contiguous()
    resize = RandomResize(0.5)
    for number in range(4):
        kept = resize.fixed_draw(number)(slope)
        assert float((kept - slope)[..., 4:-4].abs().max()) < 0.01
    chance = torch.Generator().manual_seed(0)
    images = (torch.rand(1, 3, 48, 64, generator=chance) * 255).round() / 255
    other = images.clone()
    other[0, 0, 0, 0] += 1 / 255 if float(other[0, 0, 0, 0]) < 0.5 else -1 / 255
    far = [(resize(one) - images)[..., 8:, 8:] for one in (images, other)]
    assert float((far[0] - far[1]).abs().max()) > 0.01  # one code more, and all is drawn anew
    assert not torch.equal(RandomResize(0.5, seed=1)(images), resize(images))
    sizes = {float(resize.fixed_draw(number)(images).std()) for number in range(8)}
    assert len(sizes) >= 5


@pytest.mark.parametrize("task", ["2d", "3d"])
@pytest.mark.parametrize("defence", ALL, ids=lambda one: one.name)
def test_a_defended_detector_is_a_detector(defence: Defence, task: str) -> None:
    bare = ToyDetector(task=task)  # type: ignore[arg-type]
    detector = Defended(bare, defence)
    assert (detector.task, detector.classes) == (task, bare.classes)
    assert detector.name == f"{bare.name}+{defence.name}"
    images, truth = toy_scene(2, solid=True)
    lens = LENS[None].expand(2, 3, 3) if task == "3d" else None
    shown = defence(images)
    assert torch.equal(detector.dense(images, lens).logit, bare.dense(shown, lens).logit)
    for one, other in zip(
        detector.predict(images, lens, threshold=0.1), bare.predict(shown, lens, threshold=0.1), strict=True
    ):
        assert torch.equal(one.box, other.box)
        assert torch.equal(one.score, other.score)
    through = run_attack(PGD(), bare, images, truth, BUDGET, objective="full", intrinsic=lens, through=defence)
    behind = run_attack(PGD(), detector, images, truth, BUDGET, objective="full", intrinsic=lens)
    assert torch.equal(through.images, behind.images)
    assert bool((behind.after > behind.before).all())


@pytest.mark.parametrize(
    "images", [torch.zeros(3, 16, 16), torch.zeros(1, 1, 16, 16), torch.zeros(1, 3, 16, 16).byte()]
)
@pytest.mark.parametrize("defence", ALL, ids=lambda one: one.name)
def test_what_is_no_image_is_refused_before_a_defence(defence: Defence, images: Tensor) -> None:
    detector = Defended(ToyDetector(), defence)
    for call in (detector.predict, detector.dense):
        with pytest.raises(ConfigError, match=r"images are \[B, 3, H, W\] of floats"):
            call(images)


@pytest.mark.parametrize("defence", [Blur(1.3), RandomResize(0.5)], ids=lambda one: one.name)
@pytest.mark.parametrize("value", [0.0, 1.0])
def test_white_and_black_have_a_gradient(defence: Defence, value: float) -> None:
    images = torch.full((1, 3, 24, 24), value, requires_grad=True)
    shown = defence(images)
    assert 0.0 <= float(shown.detach().min()) <= float(shown.detach().max()) <= 1.0
    (gradient,) = torch.autograd.grad(shown.sum(), images)
    assert float(gradient.sum()) == pytest.approx(shown.numel(), rel=1e-3)


def test_what_is_behind_a_defence_is_kept_steady() -> None:
    part = ToyDetector()
    part.train()

    class Wrapper:
        name, task, classes = "wrapper", "2d", part.classes

        def __init__(self) -> None:
            self.model: nn.Module = part

    for detector in (part, Wrapper()):
        with steady(Defended(detector, Blur())):  # type: ignore[arg-type]
            assert not part.training
        assert part.training


def test_an_attack_that_knows_a_defence_is_stronger() -> None:
    detector, (images, truth) = ToyDetector(), toy_scene(4)
    for defence in (Blur(1.0), RandomResize(0.5)):
        behind = Defended(detector, defence)
        blind = run_attack(PGD(start="none"), detector, images, truth, BUDGET, objective=TrueLogits())
        before = Victim(behind, images, truth, TrueLogits())
        attack: Any = PGD(start="none")
        if isinstance(defence, RandomResize):
            attack = Expected(attack, defence)
        known = run_attack(attack, behind, images, truth, BUDGET, objective=TrueLogits())
        assert float(known.after.mean()) > float(before.loss(blind.images).mean()) + 0.3


def test_expectation_is_the_mean_over_the_draws() -> None:
    detector, (images, truth) = ToyDetector(), toy_scene(2)
    resize = RandomResize(0.5)
    seen: list[tuple[Tensor, Tensor, Tensor]] = []

    class Ask:
        name, access = "ask", "white-box"

        def perturb(self, victim: Victim, budget: Budget) -> Tensor:
            seen.append((victim.loss(victim.clean), *victim.gradient(victim.clean)))
            return victim.clean

    cases: list[dict[str, Any]] = [{"detector": detector}, {"detector": detector, "through": resize}]
    cases.append({"detector": Defended(detector, resize)})
    for case in cases:
        found = run_attack(
            Expected(Ask(), resize, draws=3), images=images, truth=truth, budget=BUDGET, objective=Vanish(), **case
        )
        assert (found.cost.queries, found.cost.gradients) == (3, 3)
        assert found.about["attack"] == "ask-over-resize-0.5"
    parts = [Victim(detector, images, truth, Vanish(), through=resize.fixed_draw(k)).gradient(images) for k in range(3)]
    loss, gradient = torch.stack([one[0] for one in parts]).mean(0), torch.stack([one[1] for one in parts]).mean(0)
    for one in seen:
        assert torch.allclose(one[0], loss)
        assert torch.allclose(one[1], loss)
        assert torch.allclose(one[2], gradient, atol=1e-7)


def test_black_box_attacks_pass_defences_too() -> None:
    images, truth = toy_scene(1)
    detector = Defended(ToyDetector(), Blur(0.5))
    found = run_attack(NES(steps=5, samples=5), detector, images, truth, BUDGET, objective=TrueLogits())
    assert float(found.after) > float(found.before) + 0.2


def test_the_check_of_gradients_leaves_stairs_out_and_still_sees_faults() -> None:
    class Wrong(ToyDetector):
        def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Any:
            dense = super().dense(images, intrinsic)
            return replace(dense, logit=dense.logit.detach() * 2 - dense.logit)

    images, truth = toy_scene(1)
    for defence in ALL:
        for wrong in (False, True):
            detector = Wrong() if wrong else ToyDetector()
            for victim in (
                Victim(detector, images, truth, TrueLogits(), through=defence),
                Victim(Defended(detector, defence), images, truth, TrueLogits()),
            ):
                if wrong:
                    with pytest.raises(ConfigError, match="is wrong"):
                        check_gradient(victim)
                else:
                    assert check_gradient(victim) < 0.01


def test_what_is_behind_a_defence_is_checked_in_double() -> None:
    asked: set[torch.dtype] = set()

    class Noted(ToyDetector):
        def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Any:
            asked.add(images.dtype)
            return super().dense(images, intrinsic)

    victim = Victim(Defended(Noted(), Blur(1.0)), *toy_scene(1), TrueLogits())
    asked.clear()
    assert check_gradient(victim) < 1e-6
    assert asked == {torch.float64}


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("jpeg", {"quality": 0}, "quality of 0"),
        ("jpeg", {"subsampling": "411"}, "choose 420 or 444"),
        ("bits", {"bits": 9}, "must be in 1..8"),
        ("blur", {"sigma": 0.0}, "sigma must be above 0"),
        ("blur", {"sigm": 1.0}, "defence 'blur': .*'sigm'"),
        ("resize", {"smallest": 1.0}, "above 0 and below 1"),
    ],
)
def test_bad_options_are_named(name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_defence(name, **options)


def test_bad_names_and_combinations_are_named() -> None:
    assert {make_defence(name).name.split("-")[0] for name in DEFENCES} == set(DEFENCES)
    with pytest.raises(UnknownNameError, match="jpge"):
        make_defence("jpge")
    with pytest.raises(ConfigError, match="one draw at least"):
        make_attack("expected", inner=PGD(), defence=RandomResize(), draws=0)
    images, truth = toy_scene(1)
    with pytest.raises(ConfigError, match="pass another defence"):
        run_attack(Expected(PGD(), RandomResize()), ToyDetector(), images, truth, BUDGET, through=Blur())

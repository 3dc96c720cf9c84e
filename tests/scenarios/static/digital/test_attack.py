"""White-box attacks: closed-form optima, order of strength, one image at a time, detectors left as they were."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from helpers.mono3d import one_thread
from torch import Tensor

from ssad.cli.listing import LISTS
from ssad.core.detections import Truth
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.detectors import make_detector
from ssad.scenarios.static.digital import ATTACKS, Budget, default_loss, make_attack, needs, px, run_attack
from ssad.scenarios.static.digital.apgd import MIN_STEPS, checkpoints
from ssad.scenarios.static.digital.budget import lengths
from ssad.scenarios.static.digital.check import is_within_budget, remaining_quality
from ssad.scenarios.static.digital.gradient_check import check_gradient
from ssad.scenarios.static.digital.objectives import Margin, Vanish, make_objective
from ssad.scenarios.static.digital.victim import Precision, Victim
from ssad.scenarios.static.physical import ATTACKS as PHYSICAL
from ssad.scenarios.static.physical.lights import LIGHTS

from .toy_detector import ToyDetector, TrueLogits, best_linf, toy_scene

PRECISIONS: tuple[Precision, ...] = ("float32", "bfloat16")
WHITE = ["fgsm", "pgd", "momentum", "apgd", "cw"]


@pytest.fixture(autouse=True, scope="module")
def _on_one_thread() -> Iterator[None]:
    with one_thread():
        yield


@pytest.mark.parametrize("name", WHITE)
def test_a_linear_loss_is_maximised(name: str) -> None:
    """One step is the optimum; iterated attacks from anywhere end there."""
    detector = ToyDetector()
    images, truth = toy_scene()
    budget = Budget(px(5))
    found = run_attack(make_attack(name), detector, images, truth, budget, objective=TrueLogits())
    best = best_linf(detector, images, truth, budget.radius)
    victim = Victim(detector, images, truth, TrueLogits())
    assert torch.allclose(found.after, victim.loss(best), rtol=1e-5)
    assert found.gradient_error is not None
    assert found.gradient_error < 1e-6


@pytest.mark.parametrize("name", WHITE)
def test_a_linear_loss_is_maximised_under_l2(name: str) -> None:
    """The rise is the length of the gradient times the radius, less what 8 bits cost."""
    detector = ToyDetector()
    images, truth = toy_scene()
    budget = Budget(px(120), "l2")
    found = run_attack(make_attack(name), detector, images, truth, budget, objective=TrueLogits())
    victim = Victim(detector, images, truth, TrueLogits())
    slope = lengths(victim.gradient(images)[1]).flatten()
    rise = (found.after - found.before) / (slope * budget.radius)
    assert bool((rise > 0.95).all())
    assert bool((rise <= 1 + 1e-5).all())


@pytest.mark.parametrize("norm", ["linf", "l2"])
@pytest.mark.parametrize("name", [*WHITE, "noise", "cw-min"])
def test_every_attack_keeps_its_budget_and_beats_the_clean_image(name: str, norm: str) -> None:
    detector = ToyDetector()
    images, truth = toy_scene()
    budget = Budget(px(5 if norm == "linf" else 150), norm)  # type: ignore[arg-type]
    options = {"steps": 6} if name == "cw-min" else {}
    found = run_attack(make_attack(name, **options), detector, images, truth, budget, objective=default_loss(name))
    assert is_within_budget(found.images, images, budget)
    if name != "noise":
        assert bool((found.after > found.before).all())


@pytest.mark.parametrize("name", ["fgsm", "pgd", "momentum", "apgd", "cw", "square", "nes", "spsa", "noise"])
def test_an_attack_spends_its_l2_budget_on_images_whose_values_stop_at_0_and_255(name: str) -> None:
    images, truth = toy_scene()
    draws = torch.Generator().manual_seed(0)
    ends = torch.randint(0, 2, images.shape, generator=draws).float()
    images = torch.where(torch.rand(images.shape, generator=draws) < 0.4, ends, images)
    options: dict[str, Any] = {"queries": 60} if name == "square" else {"samples": 4} if name in ("nes", "spsa") else {}
    budget = Budget(px(40), "l2")
    attack = make_attack(name, **options)
    stored = run_attack(attack, ToyDetector(), images, truth, budget, objective=default_loss(name)).images
    stored_lengths = 255 * lengths(stored - images).flatten()
    assert bool((stored_lengths <= 40.001).all())
    assert bool((stored_lengths > 39.0).all())


@pytest.mark.parametrize("name", [*WHITE, "noise", "cw-min"])
def test_an_image_fares_the_same_alone(name: str) -> None:
    detector = ToyDetector()
    images, truth = toy_scene(3)
    keys = [("a",), ("b",), ("c",)]
    budget = Budget(px(5))
    options = {"steps": 5, "rounds": 2} if name == "cw-min" else {}
    loss = default_loss(name)
    together = run_attack(make_attack(name, **options), detector, images, truth, budget, objective=loss, keys=keys)
    for k in range(3):
        alone = run_attack(
            make_attack(name, **options),
            detector,
            images[k : k + 1],
            truth[k : k + 1],
            budget,
            objective=loss,
            keys=keys[k : k + 1],
        )
        assert torch.equal(alone.images[0], together.images[k])


def test_strength_rises_with_radius_steps_and_restarts() -> None:
    detector = make_detector("yolov5n")
    images, truth = street()

    def loss(attack: Any, radius: float) -> Tensor:
        return run_attack(attack, detector, images, truth, Budget(px(radius)), objective="vanish", check=False).after

    few, more = loss(make_attack("pgd", steps=2), 2), loss(make_attack("pgd", steps=8), 2)
    assert float(more.mean()) > float(few.mean())
    assert float(loss(make_attack("pgd", steps=8), 4).mean()) > float(more.mean())
    once = loss(make_attack("pgd", steps=4), 2)
    assert bool((loss(make_attack("pgd", steps=4, restarts=2), 2) >= once).all())
    assert float(once.mean()) > float(loss(make_attack("noise"), 2).mean())


def street() -> tuple[Tensor, list[Truth]]:
    """Noise in which YOLOv5n says it sees this and that: what it finds is the truth."""
    draws = torch.Generator().manual_seed(1)
    small = torch.rand((2, 3, 12, 16), generator=draws)
    images = torch.nn.functional.interpolate(small, (96, 128), mode="bicubic").clamp(0, 1)
    images = (images * 255).round() / 255
    detector = make_detector("yolov5n")
    found = detector.predict(images, threshold=0.001)
    return images, [Truth(one.label[:4], one.box[:4]) for one in found]


def test_a_budget_without_bounds_leaves_nothing() -> None:
    detector = ToyDetector()
    images, truth = toy_scene()
    assert remaining_quality(detector, images, truth, None) == 1.0
    found = run_attack(make_attack("pgd"), detector, images, truth, Budget(px(255)), objective="margin")
    assert remaining_quality(detector, found.images, truth, None) == 0.0


def test_the_smallest_change_is_found() -> None:
    """Of a linear detector: one object in one cell, whose logit must fall below the threshold's."""
    detector = ToyDetector(("car",), spread=0.0)
    images, truth = toy_scene(1, objects=1, classes=("car",))

    margin = Margin(threshold=0.3, confidence=0.0)
    attack = make_attack("cw-min", rounds=8, steps=60)
    found = run_attack(attack, detector, images, truth, Budget(px(1000), "l2"), objective=margin)
    assert float(found.after) >= -0.5  # 8 bits move the logit a little
    logit = float(detector.dense(images).logit.max())
    least = (logit - torch.logit(torch.tensor(0.3))) / float(detector.weight[0].norm())
    assert float(lengths(found.images - images)) < 1.3 * float(least)


def test_a_detector_is_left_as_it_was() -> None:
    detector = make_detector("yolov5n")
    detector.train()
    first = next(detector.parameters())
    first.requires_grad_(True)
    first.grad = torch.ones_like(first)
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    images, truth = street()
    run_attack(make_attack("pgd", steps=2), detector, images, truth, Budget(px(2)), objective="full")
    assert detector.training
    assert first.requires_grad
    assert bool((first.grad == 1).all())
    assert all(torch.equal(value, before[name]) for name, value in detector.state_dict().items())


def test_costs_are_counted() -> None:
    detector = ToyDetector()
    images, truth = toy_scene()
    found = run_attack(make_attack("pgd", steps=4, restarts=1), detector, images, truth, Budget(px(3)))
    assert (found.cost.gradients, found.cost.queries) == (8, 2)
    assert found.about["access"] == "white-box"
    assert found.about["radius_px"] == 3.0
    noise = run_attack(make_attack("noise"), detector, images, truth, Budget(px(3)))
    assert (noise.cost.gradients, noise.cost.queries) == (0, 0)


def test_a_black_image_can_be_attacked() -> None:
    detector = ToyDetector()
    found = run_attack(
        make_attack("pgd"), detector, torch.zeros(1, 3, 48, 64), toy_scene(1)[1], Budget(px(5)), objective="vanish"
    )
    assert float(found.images.max()) <= 5 / 255 + 1e-6


def test_nothing_to_attack_is_told() -> None:
    detector = ToyDetector()
    images, truth = toy_scene()
    empty = Truth(torch.zeros(0, dtype=torch.long), torch.zeros(0, 4))
    found = run_attack(make_attack("pgd"), detector, images, [truth[0], empty], Budget(px(5)), objective="mislabel")
    assert found.idle.tolist() == [False, True]
    assert torch.equal(found.images[1], images[1])
    assert not torch.equal(found.images[0], images[0])
    with pytest.raises(ConfigError, match="no location of these images is assigned"):
        run_attack(make_attack("pgd"), detector, images, [empty, empty], Budget(px(5)), objective="mislabel")


def test_a_radius_of_0_changes_nothing() -> None:
    images, truth = toy_scene()
    found = run_attack(make_attack("pgd"), ToyDetector(), images, truth, Budget(0.0))
    assert torch.equal(found.images, images)


@dataclass
class NoGradient:
    """A detector whose outputs do not lead back to the image."""

    inner: ToyDetector
    name: str = "no gradient"

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Any:
        with torch.no_grad():
            return self.inner.dense(images, intrinsic)


@pytest.mark.parametrize("check", [True, False])
def test_a_detector_without_gradients_is_named(check: bool) -> None:
    images, truth = toy_scene()
    with pytest.raises(ConfigError, match=r"gives no gradient of loss 'margin'.*choose a black-box attack"):
        run_attack(make_attack("pgd"), NoGradient(ToyDetector()), images, truth, Budget(px(5)), check=check)


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (torch.zeros(0, 3, 8, 8), "images"),
        (torch.zeros(2, 3, 8, 8, dtype=torch.uint8), "of floats"),
        (torch.full((2, 3, 48, 64), 0.5), "8 bits"),
        (torch.zeros(1, 3, 48, 64), "truth of 2"),
    ],
)
def test_bad_images_are_one_line(images: Tensor, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        run_attack(make_attack("pgd"), ToyDetector(), images, toy_scene()[1], Budget(px(5)))


def test_names_and_options() -> None:
    with pytest.raises(UnknownNameError, match="pgd"):
        make_attack("pdg")
    with pytest.raises(ConfigError, match="attack pgd: there is no option 'stepps'; it has steps, step,"):
        make_attack("pgd", stepps=3)
    with pytest.raises(ConfigError, match="attack transfer: it needs surrogate and inner"):
        make_attack("transfer")
    with pytest.raises(ConfigError, match="steps must be 1"):
        make_attack("pgd", steps=0)
    with pytest.raises(ConfigError, match="steps must be 2"):
        make_attack("apgd", steps=1)
    with pytest.raises(ConfigError, match="rounds"):
        make_attack("cw-min", rounds=0)
    with pytest.raises(UnknownNameError, match="loss"):
        run_attack(make_attack("pgd"), ToyDetector(), *toy_scene(), Budget(px(5)), objective="los")


def test_all_names_are_listed_with_what_they_need() -> None:
    rows = LISTS["attacks"]()
    assert rows.keys() == {*ATTACKS, *PHYSICAL, *LIGHTS, "module:object"}
    assert rows["adv-patch"] == "physical: trains a patch (docs/how-to/paint-a-car.md)"
    assert rows["pgd"] == "white-box, loss full"
    assert "noise" not in rows["universal"]
    assert "one change" in rows["universal"]
    assert rows["transfer"].startswith("made in Python: needs surrogate, inner")
    assert [name for name in ATTACKS if needs(name)] == ["transfer", "expected"]


def test_checkpoints_shrink() -> None:
    assert sorted(checkpoints(100)) == [22, 41, 57, 70, 80, 87, 93, 99]  # Croce and Hein, section 3


def test_apgd_says_that_it_needs_more_steps() -> None:
    few_steps = 9  # a number of its own, since each number is warned of once
    with pytest.warns(UserWarning, match=f"apgd: 9 steps are too few .* take {MIN_STEPS} or more, or pgd"):
        make_attack("apgd", steps=few_steps)
    make_attack("apgd", steps=few_steps)
    assert make_attack("apgd").steps == MIN_STEPS, "without a warning, which would be an error"


def test_pgd_steps_shrink_to_nothing() -> None:
    attack = make_attack("pgd", steps=10)
    lengths_of = [attack.share(k) for k in range(10)]
    assert lengths_of[0] == 0.5
    assert lengths_of == sorted(lengths_of, reverse=True)
    assert lengths_of[-1] < 0.02
    assert {make_attack("pgd", schedule="constant").share(k) for k in range(10)} == {0.25}


def test_random_starts_come_from_the_keys() -> None:
    images, truth = toy_scene()
    victim = Victim(ToyDetector(), images, truth, Vanish(), keys=[("x",), ("x",)])
    first, second = victim.draw("uniform", "start", 0)
    assert torch.equal(first, second)
    assert not torch.equal(first, victim.draw("uniform", "start", 1)[0])


def test_gradients_in_bfloat16_are_nearly_those_of_float32_and_losses_are_the_same() -> None:
    images, truth = toy_scene(2)
    detector = ToyDetector()
    exact, mixed = (Victim(detector, images, truth, make_objective("full"), precision=p) for p in PRECISIONS)
    (loss, slope), (rough, other) = exact.gradient(images), mixed.gradient(images)
    assert not torch.equal(slope, other)
    assert torch.cosine_similarity(slope.flatten(1), other.flatten(1)).min() > 0.99
    torch.testing.assert_close(rough, loss, rtol=0.02, atol=0.02)
    assert torch.equal(exact.loss(images), mixed.loss(images))
    assert check_gradient(mixed) == check_gradient(exact), "the gradient is checked in float64 in any case"
    pgd, small = make_attack("pgd"), Budget(px(3))
    left = [run_attack(pgd, detector, images, truth, small, objective="vanish", precision=p).after for p in PRECISIONS]
    torch.testing.assert_close(left[1], left[0], rtol=0.02, atol=0.02)

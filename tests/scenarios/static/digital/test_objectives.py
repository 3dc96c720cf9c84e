"""Losses on dense outputs: what they ask for, for whom, and that their gradients are those of their values."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from helpers.mono3d import one_thread
from torch import Tensor

from ssad.core.detections import Dense, Truth
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.detectors import make_detector
from ssad.detectors.mono3d.config import FCOS3D, FCOS3D_LIGHT, PGD_DET_LIGHT, Mono3DConfig
from ssad.detectors.mono3d.detector import Mono3D
from ssad.scenarios.static.digital import OBJECTIVES, Aim, Budget, make_attack, make_objective, px, run_attack
from ssad.scenarios.static.digital.check import find_weaknesses
from ssad.scenarios.static.digital.gradient_check import check_gradient
from ssad.scenarios.static.digital.objectives import Margin, Mislabel, Situation, TrainingLosses, Vanish, log_scores
from ssad.scenarios.static.digital.pgd import PGD
from ssad.scenarios.static.digital.victim import Victim

from .toy_detector import ToyDetector, toy_scene

TRAFFIC = ("car", "pedestrian", "bus")


@pytest.fixture(autouse=True, scope="module")
def _on_one_thread() -> Iterator[None]:
    with one_thread():
        yield


def seen_by(name: str | Mono3DConfig) -> tuple[Any, Tensor, Tensor | None, list[Truth]]:
    """A detector, noise, and what it says it sees in it as the truth."""
    detector = make_detector(name) if isinstance(name, str) else Mono3D(name, seed=1)
    draws = torch.Generator().manual_seed(2)
    images = (torch.rand((1, 3, 64, 96), generator=draws) * 255).round() / 255
    lens = None
    if detector.task == "3d":
        lens = torch.tensor([[[80.0, 0.0, 48.0], [0.0, 80.0, 32.0], [0.0, 0.0, 1.0]]])
    found = detector.predict(images, lens, threshold=0.0)
    truth = []
    for one in found:
        box = torch.tensor([[20.0, 16.0, 52.0, 48.0]])
        solid = None
        if one.solid is not None:
            columns = {f: getattr(one.solid, f)[:1] for f in ("size_lhw", "yaw", "velocity", "attribute")}
            solid = type(one.solid)(centre=torch.tensor([[-1.5, 0.0, 10.0]]), **columns)
        truth.append(Truth(torch.zeros(1, dtype=torch.long), box, solid, None if lens is None else lens[0]))
    return detector, images, lens, truth


@pytest.mark.parametrize(
    ("config", "name"),
    [(FCOS3D_LIGHT, "full"), (PGD_DET_LIGHT, "full"), (FCOS3D_LIGHT, "margin"), (PGD_DET_LIGHT, "vanish")],
    ids=lambda value: getattr(value, "name", value),
)
def test_gradients_equal_finite_differences(config: Mono3DConfig, name: str) -> None:
    """Preprocessing, resizing included, is a part of what is differentiated."""
    made, images, lens, truth = seen_by(replace(config, input_width=128))
    victim = Victim(made, images, truth, make_objective(name), intrinsic=lens)
    assert check_gradient(victim) < 1e-2


def test_gradients_through_deformable_convolution() -> None:
    made, images, lens, truth = seen_by(replace(FCOS3D, trunk=50))
    victim = Victim(made, images, truth, make_objective("full"), intrinsic=lens)
    assert check_gradient(victim) < 1e-3


@pytest.mark.parametrize(
    ("detector", "name"),
    [
        ("yolov5n", "vanish"),
        ("yolov5n", "mislabel"),
        ("yolov5n", "localisation"),
        ("yolov3-tiny", "margin"),
        ("yolov3-tiny", "fabricate"),
    ],
)
def test_gradients_of_yolo(detector: str, name: str) -> None:
    made, images, lens, truth = seen_by(detector)
    objective = Mislabel(confidence=100.0) if name == "mislabel" else make_objective(name)
    assert check_gradient(Victim(made, images, truth, objective, intrinsic=lens)) < 0.05


def test_every_objective_rises_under_attack() -> None:
    detector = ToyDetector(TRAFFIC)
    images, truth = toy_scene(classes=TRAFFIC)
    for name in OBJECTIVES:
        if name in ("depth", "orientation"):
            continue
        found = run_attack(make_attack("pgd"), detector, images, truth, Budget(px(5)), objective=name)
        assert bool((found.after > found.before).all()), name


@pytest.mark.parametrize("name", ["depth", "orientation"])
def test_a_loss_that_a_detector_does_not_have(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"has no loss of {name}; its losses are cls, box"):
        run_attack(make_attack("fgsm"), ToyDetector(), *toy_scene(), Budget(px(5)), objective=name)


def classes_at(detector: ToyDetector, images: Tensor, truth: list[Truth]) -> Tensor:
    """The best class at each object of the first image."""
    dense = detector.dense(images)
    label = detector.assign(dense, truth)
    order = label.owner[0][label.label[0] >= 0].argsort()
    return dense.logit[0][label.label[0] >= 0].argmax(1)[order]


def test_one_class_becomes_another() -> None:
    detector = ToyDetector(TRAFFIC, spread=0.0)
    images, truth = toy_scene(1, classes=TRAFFIC, objects=6)
    aim = Aim(becomes={"car": "bus"})
    found = run_attack(
        make_attack("pgd"), detector, images, truth, Budget(px(12)), objective=Mislabel(confidence=1.0), aim=aim
    )
    before, after = truth[0].label, classes_at(detector, found.images, truth)
    assert int((before == 0).sum()) > 0
    assert bool((after[before == 0] == 2).all())
    assert torch.equal(after[before != 0], before[before != 0])


def test_only_the_chosen_object_vanishes() -> None:
    detector = ToyDetector(spread=0.0)
    images, truth = toy_scene(1)
    for name in ("vanish", "margin"):
        found = run_attack(
            make_attack("cw"), detector, images, truth, Budget(px(12)), objective=name, aim=Aim(objects=(1,))
        )
        left, top = truth[0].box[1, :2].long().tolist()
        elsewhere = (found.images != images)[0].any(0)
        elsewhere[top : top + 8, left : left + 8] = False
        assert not bool(elsewhere.any())
        score = detector.dense(found.images).logit[0].amax(-1).sigmoid()
        place = detector.dense(images).place
        own = ((place - truth[0].box[1, :2] - 4).abs() < 1).all(1)
        assert float(score[own]) < 0.3


def test_only_the_chosen_class_vanishes() -> None:
    detector = ToyDetector(spread=0.0)
    images, truth = toy_scene(1, objects=6)
    found = run_attack(
        make_attack("pgd"), detector, images, truth, Budget(px(12)), objective="margin", aim=Aim(classes=("car",))
    )
    left = detector.predict(found.images)[0].label
    assert 0 not in left.tolist()
    assert int((left == 1).sum()) == int((truth[0].label == 1).sum())


def test_an_aim_needs_known_classes_and_a_loss_that_can_aim() -> None:
    images, truth = toy_scene(1)
    with pytest.raises(UnknownNameError, match="tram"):
        run_attack(
            make_attack("fgsm"),
            ToyDetector(),
            images,
            truth,
            Budget(px(5)),
            objective="vanish",
            aim=Aim(classes=("tram",)),
        )
    for name, message in (("full", "is of all objects"), ("fabricate", "takes no classes")):
        with pytest.raises(ConfigError, match=message):
            run_attack(
                make_attack("fgsm"), ToyDetector(), images, truth, Budget(px(5)), objective=name, aim=Aim(objects=(0,))
            )
    with pytest.raises(ConfigError, match="one class"):
        run_attack(
            make_attack("fgsm"),
            ToyDetector(("car",)),
            *toy_scene(1, classes=("car",)),
            Budget(px(5)),
            objective="mislabel",
        )


def test_margin_stops_below_the_threshold() -> None:
    """0 where every score lies below it by the confidence; the shortfall in log-odds elsewhere."""
    detector = ToyDetector()
    images, truth = toy_scene(1)
    dense = detector.dense(images)
    situation = Situation(detector, detector.assign(dense, truth))
    assert Margin(threshold=0.999, confidence=0.0)(dense, situation).item() == 0.0
    odds = dense.logit.amax(-1) - torch.logit(torch.tensor(0.2)) + 1.0
    assert torch.allclose(Margin(threshold=0.2)(dense, situation), -odds.clamp_min(0).sum(1), rtol=1e-3)


def test_vanish_is_the_probability_that_nothing_is_there() -> None:
    detector = ToyDetector()
    images, truth = toy_scene(1)
    dense = replace(detector.dense(images), quality=torch.full((1, 48), 0.5))
    score = dense.logit.sigmoid() * torch.tensor(0.5).sigmoid()
    assert torch.allclose(log_scores(dense).exp(), score, rtol=1e-4)
    found = Vanish()(dense, Situation(detector, detector.assign(dense, truth)))
    assert torch.allclose(found, torch.log(1 - score).sum((1, 2)), rtol=1e-4)


def test_the_attack_goes_on_when_nothing_is_detected() -> None:
    """The loss is of dense outputs: it still has a gradient where no score reaches the threshold."""
    detector = ToyDetector()
    images, truth = toy_scene()
    budget = Budget(px(25))
    found = run_attack(make_attack("pgd"), detector, images, truth, budget, objective="vanish")
    assert not any(len(one.score) for one in detector.predict(found.images))
    victim = Victim(detector, found.images, truth, make_objective("full"))
    assert bool(victim.gradient(found.images)[1].flatten(1).any(1).all())


# ---------------------------------------------------------------- weak attacks are told


@dataclass(frozen=True)
class Detected:
    """A loss of what survives the threshold: it has no gradient for what is not detected."""

    name: str = "detected"
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        score = dense.logit.amax(-1)
        return -torch.where(score.sigmoid() > 0.9, score, score.detach() * 0).sum(1)


@dataclass(frozen=True)
class Detached:
    """Half of the loss is cut off."""

    name: str = "detached"
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        value = -dense.logit.clamp_min(0).sum((1, 2))
        return 3 * value.detach() + value


@dataclass(frozen=True)
class Flipped:
    """The gradient has the wrong sign."""

    name: str = "flipped"
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        value = -dense.logit.clamp_min(0).sum((1, 2))
        return 2 * value.detach() - value


@dataclass(frozen=True)
class Shared:
    """All images of a batch share one loss."""

    name: str = "shared"
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        value = -dense.logit.clamp_min(0).sum((1, 2))
        return value.mean().expand(len(value)) + 0 * value


@dataclass(frozen=True)
class OverBudget(PGD):
    """Leaves the ball."""

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        return PGD().perturb(victim, Budget(3 * budget.radius))


@pytest.mark.parametrize(
    ("attack", "objective", "message"),
    [
        (PGD(step=0.01, schedule="constant", start="none"), "full", "fgsm of the same budget"),
        (PGD(), Detected(), "leaves an average precision"),
        (PGD(), Detached(), "gradient of loss 'detached'.*is wrong"),
        (PGD(), Flipped(), "gradient of loss 'flipped'.*is wrong"),
        (PGD(), Shared(), "depends on the other images"),
        (OverBudget(), "full", "the budget is 6"),
    ],
)
def test_weak_attacks_are_told(attack: Any, objective: Any, message: str) -> None:
    images, truth = toy_scene(2)
    faults = find_weaknesses(attack, ToyDetector(), images, truth, Budget(px(6)), objective=objective)
    assert any(re.search(message, fault) for fault in faults), faults


@pytest.mark.parametrize(
    ("name", "objective"),
    [
        ("pgd", "full"),
        ("pgd", "margin"),
        ("pgd", "vanish"),
        ("cw", "margin"),
        ("apgd", "full"),
        ("apgd", "margin"),
        ("momentum", "full"),
        ("fgsm", "full"),
        ("noise", "full"),
    ],
)
def test_sound_attacks_pass(name: str, objective: str) -> None:
    images, truth = toy_scene(2)
    budget = Budget(px(10))
    assert find_weaknesses(make_attack(name), ToyDetector(), images, truth, budget, objective=objective) == []


def test_one_image_is_too_few_to_tell() -> None:
    with pytest.raises(ConfigError, match="two images"):
        find_weaknesses(PGD(), ToyDetector(), *toy_scene(1), Budget(px(6)))


def test_terms_of_the_full_loss_add_up() -> None:
    detector = ToyDetector()
    images, truth = toy_scene()
    dense = detector.dense(images)
    situation = Situation(detector, detector.assign(dense, truth))
    parts = [TrainingLosses(name, frozenset({name}))(dense, situation) for name in ("cls", "box")]
    assert torch.allclose(sum(parts), make_objective("full")(dense, situation))  # type: ignore[arg-type]

"""What is left of a picture, and the worst case of several attacks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from ssad.core.detections import Detections, Solids, Truth
from ssad.core.errors import ConfigError
from ssad.metrics.detection2d import Boxes2D, average_precision
from ssad.scenarios.static.digital import Aim, Budget, make_attack, px, run_attack
from ssad.scenarios.static.digital.attack import Access
from ssad.scenarios.static.digital.ensemble import Ensemble, run_ensemble
from ssad.scenarios.static.digital.image_quality import ImageQuality, image_quality, truth_of_aim
from ssad.scenarios.static.digital.victim import Victim

from .toy_detector import CELL, LENS, ToyDetector, TrueLogits, toy_scene

BOX = torch.tensor([[0.0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10], [60, 0, 70, 10]])


def found_2d(rows: list[tuple[float, int, int]]) -> Detections:
    """Detections of a score and a label at one of the boxes."""
    score, label, place = zip(*rows, strict=True) if rows else ((), (), ())
    return Detections(torch.tensor(score), torch.tensor(label, dtype=torch.long), BOX[list(place)])


def solids(rows: list[tuple[float, float, float]]) -> Solids:
    """Boxes at centres x, y, z."""
    many = len(rows)
    return Solids(
        torch.tensor(rows).view(-1, 3),
        torch.ones(many, 3),
        torch.zeros(many),
        torch.zeros(many, 2),
        torch.zeros(many, dtype=torch.long),
    )


def test_quality_of_boxes_by_hand() -> None:
    truth = Truth(torch.tensor([0, 0, 1]), BOX[:3])
    right = [(0.9, 0, 0), (0.8, 0, 1), (0.7, 1, 2)]
    assert image_quality(found_2d(right), truth) == ImageQuality(1.0, pytest.approx(-2.4))
    assert image_quality(found_2d([]), truth).value == 0.0
    assert image_quality(found_2d([(0.9, 1, 0), (0.8, 1, 1), (0.7, 0, 2)]), truth).value == 0.0
    # class 0: all found, but the first is false: precision 2/3 at every recall; class 1: missed
    some = image_quality(found_2d([(0.95, 0, 3), *right[:2]]), truth)
    assert some.value == pytest.approx(2 / 3 / 2, abs=1e-8)
    assert some.noise == pytest.approx(0.95 - 1.7)
    # a second detection of the same object is false
    assert image_quality(found_2d([(0.9, 0, 0), (0.8, 0, 0), (0.7, 1, 2)]), truth).noise == pytest.approx(0.8 - 1.6)


def test_crowd_counts_neither_way() -> None:
    truth = Truth(torch.tensor([0, 0, 1]), BOX[:3], crowd=torch.tensor([False, True, True]))
    assert image_quality(found_2d([(0.9, 0, 0)]), truth) == ImageQuality(1.0, pytest.approx(-0.9))
    assert image_quality(found_2d([(0.95, 0, 1), (0.9, 0, 0)]), truth) == ImageQuality(1.0, pytest.approx(-0.9))


def test_a_picture_without_objects() -> None:
    empty = Truth(torch.zeros(0, dtype=torch.long), torch.zeros(0, 4))
    assert image_quality(found_2d([]), empty) == ImageQuality(1.0, 0.0)
    assert image_quality(found_2d([(0.5, 0, 0)]), empty) == ImageQuality(0.0, 0.5)
    crowd = Truth(torch.tensor([0]), BOX[:1], crowd=torch.tensor([True]))
    assert image_quality(found_2d([(0.5, 0, 0)]), crowd).value == 1.0


def test_quality_is_the_average_precision_of_the_metrics() -> None:
    chance = np.random.default_rng(0)
    for _ in range(30):
        label, place = chance.integers(0, 3, 12), chance.integers(0, 4, 12)
        score = chance.choice([0.2, 0.4, 0.6, 0.8], 12)
        truth = Truth(torch.from_numpy(chance.integers(0, 3, 4)), BOX)
        found = found_2d(list(zip(score.tolist(), label.tolist(), place.tolist(), strict=True)))
        real = Boxes2D(np.zeros(4, np.int32), truth.label.numpy().astype(np.int32), BOX.double().numpy())
        own = Boxes2D(np.zeros(12, np.int32), label.astype(np.int32), found.box.double().numpy(), score)
        wanted = np.nanmean(average_precision(real, own, labels=3))
        assert image_quality(found, truth, classes=3).value == pytest.approx(wanted, abs=1e-8)


def test_quality_of_solids_by_hand() -> None:
    truth = Truth(torch.tensor([0, 0]), BOX[:2], solids([(0.0, 0, 10), (3.0, 0, 10)]))

    def found(rows: list[tuple[float, float, float]], label: int = 0) -> Detections:
        many = len(rows)
        score = torch.linspace(0.9, 0.5, many)
        return Detections(score, torch.full((many,), label), BOX[:1].expand(many, 4), solids(rows))

    assert image_quality(found([(0.5, 9, 11), (3.0, 0, 11.9)]), truth, task="3d").value == 1.0  # height is free
    assert image_quality(found([(0.0, 0, 12.1), (5.1, 0, 10)]), truth, task="3d").value == 0.0
    # the first takes the nearer of two, and the other is left for the second
    assert image_quality(found([(1.4, 0, 10), (4.5, 0, 10)]), truth, task="3d").value == 1.0
    assert image_quality(found([(1.6, 0, 10), (-1.5, 0, 10)]), truth, task="3d").value == 1.0
    # one of another class takes nothing away
    both = replace(found([(0.0, 0, 10), (0.0, 0, 10), (3.0, 0, 10)]), label=torch.tensor([1, 0, 0]))
    assert image_quality(both, truth, task="3d").value == 1.0
    assert image_quality(found([(0.0, 0, 10), (3.0, 0, 10)], label=1), truth, task="3d").value == 0.0
    crowd = Truth(truth.label, truth.box, truth.solid, crowd=torch.tensor([False, True]))
    assert image_quality(found([(3.0, 0, 10), (0.0, 0, 10)]), crowd, task="3d") == ImageQuality(
        1.0, pytest.approx(-0.5)
    )
    assert image_quality(found([(8.0, 0, 10), (0.0, 0, 10)]), crowd, task="3d").value == pytest.approx(0.5)
    with pytest.raises(ConfigError, match="needs 3D boxes"):
        image_quality(found([(0.0, 0, 10)]), Truth(truth.label, truth.box), task="3d")


def test_what_is_not_attacked_is_crowd() -> None:
    truth = Truth(torch.tensor([0, 1, 1]), BOX[:3], crowd=torch.tensor([False, False, True]))
    for aim, wanted in (
        (Aim(), [False, False, True]),
        (Aim(classes=("b",)), [True, False, True]),
        (Aim(objects=(0, 2)), [False, True, True]),
        (Aim(becomes={"a": "b"}), [False, True, True]),
    ):
        assert truth_of_aim(truth, aim, ("a", "b")).crowd.tolist() == wanted  # type: ignore[union-attr]


@dataclass(frozen=True)
class Erase:
    """Makes the given objects of each image grey."""

    objects: tuple[int, ...]
    name: str = "erase"
    access: Access = "none"

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        images = victim.clean.clone()
        for k, one in enumerate(victim.situation.assignment.truth):
            for left, top in one.box[list(self.objects), :2].long().tolist():
                images[k, :, top : top + CELL, left : left + CELL] = 128 / 255
        return images


@pytest.mark.parametrize("task", ["2d", "3d"])
def test_it_keeps_the_worst_member_for_each_image(task: str) -> None:
    detector = ToyDetector(task=task)  # type: ignore[arg-type]
    images, truth = toy_scene(6, objects=5, solid=True)
    intrinsic = LENS[None].expand(6, 3, 3) if task == "3d" else None
    members = [(Erase((0, 1)), "full"), (Erase((2, 3)), "vanish"), (make_attack("pgd", steps=3), TrueLogits())]
    members.append((make_attack("square", queries=20), "fabricate"))
    budget = Budget(px(10))
    found = run_ensemble(Ensemble(members), detector, images, truth, budget, intrinsic=intrinsic)  # type: ignore[arg-type]
    runs = [
        run_attack(attack, detector, images, truth, budget, objective=loss, intrinsic=intrinsic)  # type: ignore[arg-type]
        for attack, loss in members
    ]
    won = found.about["won"]
    assert torch.equal(found.images, torch.stack([runs[m].images[k] for k, m in enumerate(won)]))
    assert found.cost.queries == sum(run.cost.queries for run in runs) + 4
    assert found.cost.gradients == 3
    assert found.about["members"] == ["erase/full", "erase/vanish", "pgd/true logits", "square/fabricate"]
    assert found.about["access"] == "white-box"
    after = detector.predict(found.images, intrinsic)
    for k in range(6):
        left = image_quality(after[k], truth[k], task=detector.task).value
        assert left == found.about["quality"][k][won[k]] == min(found.about["quality"][k])
        assert float(found.after[k]) == pytest.approx(1 - left)
        for m, run in enumerate(runs):
            alone = image_quality(detector.predict(run.images, intrinsic)[k], truth[k], task=detector.task)
            assert alone.value == found.about["quality"][k][m] >= left
    assert found.about["clean_quality"] == [1.0] * 6


def test_different_members_win_in_different_images() -> None:
    detector = ToyDetector()
    images, truth = toy_scene(8, objects=5)
    found = run_ensemble(
        Ensemble([(Erase((0, 1)), "full"), (Erase((2, 3)), "full")]), detector, images, truth, Budget(px(10))
    )
    assert set(found.about["won"]) == {0, 1}


def test_of_equal_members_the_noisier_wins_and_then_the_first() -> None:
    detector, (images, truth) = ToyDetector(), toy_scene(1)
    one, other = Erase(()), Erase((0, 1, 2, 3))

    def run(judge: list[ImageQuality]) -> int:
        answers = iter([*judge, ImageQuality(1.0, 0.0)])
        ensemble = Ensemble([(one, "full"), (other, "full")])
        found = run_ensemble(ensemble, detector, images, truth, Budget(px(10)), judge=lambda *_: next(answers))
        return int(found.about["won"][0])

    assert run([ImageQuality(0.0, 0.0), ImageQuality(0.0, 2.0)]) == 1
    assert run([ImageQuality(0.0, 2.0), ImageQuality(0.0, 2.0)]) == 0
    assert run([ImageQuality(0.5, 9.0), ImageQuality(0.2, -9.0)]) == 1


def test_a_defence_stands_before_the_judge_too() -> None:
    detector, (images, truth) = ToyDetector(), toy_scene(1)
    blank = run_ensemble(
        Ensemble([(make_attack("noise"), "full")]),
        detector,
        images,
        truth,
        Budget(px(1)),
        through=lambda x: 0 * x + 0.5,
    )
    assert blank.about["clean_quality"] == [0.0]


def test_bad_input_is_named() -> None:
    with pytest.raises(ConfigError, match="needs one attack at least"):
        Ensemble([])

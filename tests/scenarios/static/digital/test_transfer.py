"""Transfer: the surrogate is attacked, the victim is asked nothing."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.scenarios.static.digital import Aim, Budget, make_attack, px, run_attack
from ssad.scenarios.static.digital.objectives import Vanish
from ssad.scenarios.static.digital.pgd import PGD
from ssad.scenarios.static.digital.transfer import Transfer, translate

from .toy_detector import CELL, LENS, ToyDetector, TrueLogits, best_linf, toy_scene

BUDGET = Budget(px(5))


def cell(images: Tensor, truth: Truth, number: int) -> Tensor:
    """The pixels of one object."""
    left, top = truth.box[number, :2].long().tolist()
    return images[..., top : top + CELL, left : left + CELL]


def test_it_fools_another_detector_and_asks_it_nothing() -> None:
    victim, surrogate = ToyDetector(seed=1), ToyDetector(("tree", "pedestrian", "car"), seed=2, spread=1.0)
    images, truth = toy_scene(3)
    attack = Transfer(surrogate, PGD(start="none"), TrueLogits())
    found = run_attack(attack, victim, images, truth, BUDGET, objective=TrueLogits())
    noise = run_attack(make_attack("noise"), victim, images, truth, BUDGET, objective=TrueLogits())
    white = run_attack(PGD(start="none"), victim, images, truth, BUDGET, objective=TrueLogits())
    assert (found.cost.queries, found.cost.gradients) == (0, 0)
    assert found.about["access"] == "none"
    assert found.about["attack"] == "transfer-pgd-toy-2d-2"
    assert bool((found.after > noise.after + 5).all())
    assert bool((found.after < white.after).all())
    # car and pedestrian were translated by name: the images are the surrogate's own optimum
    own = [translate(one, victim.classes, surrogate.classes)[0] for one in truth]
    assert torch.allclose(found.images, best_linf(surrogate, images, own, BUDGET.radius), atol=1e-6)


def test_objects_of_unknown_classes_are_left_out() -> None:
    victim, surrogate = ToyDetector(), ToyDetector(("pedestrian",), seed=2)
    images, truth = toy_scene(1, objects=6)
    assert {0, 1} == set(truth[0].label.tolist())
    attack = Transfer(surrogate, PGD(start="none"), TrueLogits())
    found = run_attack(attack, victim, images, truth, BUDGET, objective=TrueLogits()).images
    for number, label in enumerate(truth[0].label.tolist()):
        same = torch.equal(cell(found, truth[0], number), cell(images, truth[0], number))
        assert same == (label == 0)


def test_chosen_objects_keep_their_numbers_when_others_are_left_out() -> None:
    victim, surrogate = ToyDetector(), ToyDetector(("pedestrian",), seed=2)
    images, truth = toy_scene(2, objects=6)
    for number in range(6):
        known = [int(one.label[number]) == 1 for one in truth]
        attack = Transfer(surrogate, PGD(start="none"), Vanish())
        if not any(known):
            continue
        found = run_attack(attack, victim, images, truth, BUDGET, objective=Vanish(), aim=Aim(objects=(number,))).images
        for k in range(2):
            for other in range(6):
                same = torch.equal(cell(found[k], truth[k], other), cell(images[k], truth[k], other))
                assert same != (known[k] and other == number)


def test_an_image_does_not_know_its_batch() -> None:
    images, truth = toy_scene(2)
    attack = Transfer(ToyDetector(seed=2), PGD(), "full")
    keys = [("a",), ("b",)]
    both = run_attack(attack, ToyDetector(), images, truth, BUDGET, objective="full", keys=keys).images
    for k in range(2):
        alone = run_attack(
            attack, ToyDetector(), images[k : k + 1], truth[k : k + 1], BUDGET, objective="full", keys=keys[k : k + 1]
        )
        assert torch.equal(alone.images[0], both[k])


def test_the_surrogate_is_as_it_was() -> None:
    surrogate = ToyDetector(seed=2).train()
    surrogate.extra = torch.nn.Parameter(torch.ones(1))
    before = surrogate.weight.clone()
    images, truth = toy_scene(1)
    run_attack(Transfer(surrogate, PGD()), ToyDetector(), images, truth, BUDGET, objective="full")
    assert surrogate.training
    assert surrogate.extra.requires_grad
    assert torch.equal(surrogate.weight, before)


def test_a_2d_surrogate_serves_a_3d_victim_and_the_other_way_round() -> None:
    images, truth = toy_scene(2, solid=True)
    lens = LENS[None].expand(2, 3, 3)
    for victim, surrogate in (("3d", "2d"), ("2d", "3d")):
        attack = Transfer(ToyDetector(task=surrogate, seed=2), PGD(), TrueLogits())  # type: ignore[arg-type]
        found = run_attack(
            attack,
            ToyDetector(task=victim),
            images,
            truth,
            BUDGET,
            objective=TrueLogits(),  # type: ignore[arg-type]
            intrinsic=lens if victim == "3d" else None,
        )
        assert bool((found.after > found.before + 5).all())


def test_bad_input_is_named() -> None:
    images, truth = toy_scene(1)
    with pytest.raises(ConfigError, match="toy-3d-0 finds 3D boxes, and the truth has none"):
        run_attack(Transfer(ToyDetector(task="3d"), PGD()), ToyDetector(), images, truth, BUDGET, objective="full")
    solid = [replace(one, intrinsic=None) for one in toy_scene(1, solid=True)[1]]
    with pytest.raises(ConfigError, match="intrinsics are missing"):
        run_attack(Transfer(ToyDetector(task="3d"), PGD()), ToyDetector(), images, solid, BUDGET, objective="full")
    stranger = ToyDetector(("tree",))
    with pytest.raises(ConfigError, match="knows the class of none of the attacked objects"):
        run_attack(Transfer(stranger, PGD(), TrueLogits()), ToyDetector(), images, truth, BUDGET, objective="full")
    aim = Aim(becomes={"car": "pedestrian"})
    with pytest.raises(ConfigError, match="knows the class of none of the attacked objects"):
        run_attack(
            Transfer(ToyDetector(("car", "tree")), PGD(), "mislabel"),
            ToyDetector(),
            images,
            truth,
            BUDGET,
            objective="mislabel",
            aim=aim,
        )
    with pytest.raises(UnknownNameError, match="loss"):
        Transfer(stranger, PGD(), "fulll")
    with pytest.raises(ConfigError, match="attack transfer: "):
        make_attack("transfer")

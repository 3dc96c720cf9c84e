"""Attacks on the pictures of the loop, where nobody tells the attacker what is there."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from ssad.core.driving import ReadingChange
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.scenarios.static.digital import Budget, make_attack, px, run_attack
from ssad.scenarios.static.digital.live import LiveAttack, attacked_detector, own_truth
from ssad.scenarios.static.digital.objectives import Aim
from ssad.scenarios.static.digital.universal import Universal

from .toy_detector import LENS, ToyDetector, toy_scene

BUDGET = Budget(px(7))


def frames(count: int = 3, **options: Any) -> np.ndarray[Any, Any]:
    """Pictures as cameras of the loop give them."""
    codes: np.ndarray[Any, Any] = (toy_scene(count, **options)[0] * 255).round().to(torch.uint8).numpy()
    return codes


def chances(count: int, first: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng(first + k) for k in range(count)]


def seen(detector: ToyDetector, pictures: np.ndarray[Any, Any]) -> int:
    return sum(len(one.score) for one in detector.predict(torch.from_numpy(pictures).float() / 255))


def test_a_driver_loses_what_its_detector_found_and_nobody_told_the_truth() -> None:
    detector = ToyDetector()
    driver = SimpleNamespace(name="driver", detector=detector)
    attack: ReadingChange = LiveAttack(make_attack("pgd", steps=3), BUDGET)
    clean = frames()
    found = attack.apply(clean, driver, None, chances(3))
    assert found.dtype == np.uint8
    assert int(np.abs(found.astype(int) - clean).max()) == 7
    assert seen(detector, clean) >= 8
    assert seen(detector, found) == 0
    noise = LiveAttack(make_attack("noise"), BUDGET).apply(clean, driver, None, chances(3))
    assert seen(detector, noise) > 0.7 * seen(detector, clean)


def test_what_it_took_is_counted() -> None:
    detector = ToyDetector()
    attack = LiveAttack(make_attack("pgd", steps=3), BUDGET, batch=2)
    attack.apply(frames(), detector, None, chances(3))
    assert (attack.spent.images, attack.spent.gradients) == (3, 9)
    assert attack.spent.queries == 3 * (1 + 1 + 2), "what is there; the end of PGD; before and after"
    assert attack.spent.gradient_error is not None
    assert attack.spent.gradient_error < 1e-3
    noise = LiveAttack(make_attack("noise"), BUDGET)
    noise.apply(frames(), object(), None, chances(3))
    assert (noise.spent.images, noise.spent.queries) == (3, 0), "a control asks nobody anything"


def test_a_picture_does_not_know_its_batch_and_comes_from_its_generator() -> None:
    detector, clean = ToyDetector(), frames(4)
    whole = LiveAttack(make_attack("pgd", steps=2), BUDGET, batch=4).apply(clean, detector, None, chances(4))
    parts = LiveAttack(make_attack("pgd", steps=2), BUDGET, batch=1).apply(clean, detector, None, chances(4))
    assert (whole == parts).all()
    backwards = LiveAttack(make_attack("pgd", steps=2), BUDGET).apply(clean[::-1], detector, None, chances(4)[::-1])
    assert (backwards[::-1] == whole).all()
    other = LiveAttack(make_attack("pgd", steps=2), BUDGET).apply(clean, detector, None, chances(4, first=9))
    assert (other != whole).any()


def test_the_truth_is_used_where_it_is_told() -> None:
    detector, (images, truth) = ToyDetector(), toy_scene(2)
    attack = make_attack("fgsm")
    found = LiveAttack(attack, BUDGET, "mislabel").apply(frames(2), detector, truth, chances(2))
    told = run_attack(attack, detector, images, truth, BUDGET, objective="mislabel")
    assert (found == (told.images * 255).round().to(torch.uint8).numpy()).all()


def test_an_empty_road_and_a_black_picture_are_left_alone() -> None:
    detector = ToyDetector()
    grey = np.full((1, 3, 48, 64), 128, np.uint8)
    attack = LiveAttack(make_attack("pgd", steps=2), BUDGET, "mislabel")
    assert (attack.apply(grey, detector, None, chances(1)) == grey).all(), "there is no object to mislabel"
    mixed = np.concatenate([np.zeros_like(grey), frames(1)])
    attack = LiveAttack(make_attack("pgd", steps=2), BUDGET)
    found = attack.apply(mixed, detector, None, chances(2))
    assert not found[0].any(), "the episode has ended"
    assert (found[1] != mixed[1]).any()
    assert attack.spent.images == 1
    assert (attack.apply(mixed[:1], detector, None, chances(1)) == 0).all()


def test_a_universal_change_is_added_without_a_question() -> None:
    change = torch.full((1, 3, 48, 64), px(9))
    clean = frames(2)
    found = LiveAttack(Universal(change), BUDGET).apply(clean, None, None, chances(2))
    assert (found.astype(int) - clean == 7).all()


def test_a_3d_detector_needs_the_lens() -> None:
    detector = ToyDetector(task="3d")
    driver = SimpleNamespace(name="driver", detector=detector)
    with pytest.raises(ConfigError, match="give the intrinsic"):
        LiveAttack(make_attack("fgsm"), BUDGET).apply(frames(1), driver, None, chances(1))
    attack = LiveAttack(make_attack("pgd", steps=2), BUDGET, intrinsic=LENS.numpy())
    clean = frames(2)
    found = attack.apply(clean, driver, None, chances(2))
    boxes = own_truth(detector, torch.from_numpy(clean).float() / 255, LENS.expand(2, 3, 3))
    assert all(one.solid is not None and len(one.solid.yaw) == len(one.label) > 0 for one in boxes)
    left = own_truth(detector, torch.from_numpy(found).float() / 255, LENS.expand(2, 3, 3))
    assert sum(len(one.label) for one in left) == 0


def test_another_detector_may_be_attacked_than_the_drivers() -> None:
    mine, theirs = ToyDetector(seed=1), ToyDetector()
    asked = []
    driver = SimpleNamespace(name="driver", detector=SimpleNamespace(dense=lambda *given: asked.append(given)))
    attack = LiveAttack(make_attack("pgd", steps=3), BUDGET, detector=mine)
    found = attack.apply(frames(2), driver, None, chances(2))
    assert not asked
    assert seen(theirs, found) < 0.5 * seen(theirs, frames(2)), "they have learned the same patterns"


def test_bad_input_is_one_line() -> None:
    attack = LiveAttack(make_attack("fgsm"), BUDGET, aim=Aim(classes=("cat",)))
    with pytest.raises(UnknownNameError, match="unknown class 'cat'"):
        attack.apply(frames(1), ToyDetector(), None, chances(1))
    with pytest.raises(ConfigError, match="it takes pictures uint8"):
        attack.apply(frames(1).astype(np.float32), ToyDetector(), None, chances(1))
    with pytest.raises(ConfigError, match="as many generators"):
        attack.apply(frames(2), ToyDetector(), None, chances(1))
    with pytest.raises(ConfigError, match="wheel has no detector to attack"):
        attacked_detector(SimpleNamespace(name="wheel"))
    with pytest.raises(UnknownNameError, match="unknown loss 'ful'"):
        LiveAttack(make_attack("fgsm"), BUDGET, "ful")

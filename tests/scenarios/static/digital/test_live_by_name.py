"""Digital attacks in the loop by name: how many steps a picture they take, and that they then harm."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.rendering.sensor_suite import SensorSuite
from ssad.scenarios.static.catalogue import STEPS, parse_perturbation
from tests.scenarios.static.digital.toy_detector import ToyDetector, toy_scene

SIZE = toy_scene(1)[0].shape[-2:]
CAMERAS = {"front": Camera.typical(SIZE[1], SIZE[0], channel="CAM_FRONT")}


def live(name: str, severity: int, detector: Any) -> Any:
    perturbation = parse_perturbation(name).make(severity)
    suite = perturbation.in_loop(SensorSuite(cameras=CAMERAS), target=0, victim=detector, seed=0)
    return suite.changes.readings["front"]


@pytest.mark.parametrize(("name", "steps"), [("pgd", STEPS), ("pgd?steps=2", 2), ("momentum?steps=12", 12)])
def test_a_name_says_how_many_gradient_steps_a_picture_takes(name: str, steps: int) -> None:
    attack = live(name, 3, ToyDetector())
    assert parse_perturbation(name).family == "digital"
    pictures = (toy_scene(2)[0] * 255).round().to(torch.uint8).numpy()
    attack.apply(pictures, None, None, [np.random.default_rng(k) for k in range(2)])
    assert attack.spent.gradients == 2 * steps


@pytest.mark.parametrize(
    "name",
    ["attack-pgd-0", "attack-pgd-05", "attack-pgd-1000", "attack-pgd-\u0665", "attack-fgsm-3", "attack-pgd-", "wear-2"],
)
def test_other_names_with_numbers_are_unknown(name: str) -> None:
    with pytest.raises(ConfigError, match=name):
        parse_perturbation(name)


def test_an_attack_that_cannot_take_so_few_steps_is_refused_before_anything_runs() -> None:
    with pytest.raises(ConfigError, match="apgd: steps must be 2 or more"):
        parse_perturbation("apgd?steps=1").make(3)


def test_pgd_hides_more_than_noise_of_its_size() -> None:
    detector = ToyDetector()
    pictures = (toy_scene(6, seed=1)[0] * 255).round().to(torch.uint8).numpy()

    def left(name: str) -> int:
        draws = [np.random.default_rng(k) for k in range(len(pictures))]
        moved = live(name, 5, detector).apply(pictures, None, None, draws)
        return sum(len(one.score) for one in detector.predict(torch.from_numpy(moved).float() / 255))

    assert left("pgd") < left("noise")

"""Digital attacks in the loop by name: how many steps a picture they take, and that they then harm."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.frames import Camera
from ssad.experiments.gap.loop_perturbations import STEPS, family_of, perturbed
from ssad.rendering.onboard import Onboard
from tests.scenarios.digital.toy_detector import ToyDetector, toy_scene

SIZE = toy_scene(1)[0].shape[-2:]
CAMERAS = {"front": Camera.typical(SIZE[1], SIZE[0], channel="CAM_FRONT")}


def live(name: str, severity: int, detector: Any) -> Any:
    return perturbed(Onboard(), CAMERAS, name, severity, detector=detector)[1]["front"]


@pytest.mark.parametrize(("name", "steps"), [("attack-pgd", STEPS), ("attack-pgd-2", 2), ("attack-apgd-12", 12)])
def test_a_name_says_how_many_gradient_steps_a_picture_takes(name: str, steps: int) -> None:
    attack = live(name, 3, ToyDetector())
    assert family_of(name) == "attack"
    pictures = (toy_scene(2)[0] * 255).round().to(torch.uint8).numpy()
    attack.apply(pictures, None, None, [np.random.default_rng(k) for k in range(2)])
    assert attack.spent.gradients == 2 * steps


@pytest.mark.parametrize(
    "name",
    ["attack-pgd-0", "attack-pgd-05", "attack-pgd-1000", "attack-pgd-\u0665", "attack-fgsm-3", "attack-pgd-", "wear-2"],
)
def test_other_names_with_numbers_are_unknown(name: str) -> None:
    with pytest.raises(UnknownNameError, match=name):
        family_of(name)


def test_an_attack_that_cannot_take_so_few_steps_is_refused_before_anything_runs() -> None:
    with pytest.raises(ConfigError, match="apgd: steps must be 2 or more"):
        family_of("attack-apgd-1")


def test_pgd_hides_more_than_noise_of_its_size() -> None:
    detector = ToyDetector()
    pictures = (toy_scene(6, seed=1)[0] * 255).round().to(torch.uint8).numpy()

    def left(name: str) -> int:
        draws = [np.random.default_rng(k) for k in range(len(pictures))]
        moved = live(name, 5, detector).apply(pictures, None, None, draws)
        return sum(len(one.score) for one in detector.predict(torch.from_numpy(moved).float() / 255))

    assert left("attack-pgd") < left("attack-noise")

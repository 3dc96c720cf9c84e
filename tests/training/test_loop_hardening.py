"""Adversarial training: pictures are made harder within the radius, and the detector is as it was before."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.training import RECIPE, bank, fresh
from torch import Tensor

from ssad.core.detections import Truth
from ssad.training.batches import make_batch
from ssad.training.loop import TrainingStep, perturb_images, train

HARD = replace(RECIPE, radius=4.0, attack_steps=1, amp=False)


def batch() -> tuple[Tensor, list[Truth]]:
    plain = replace(HARD, noise=0.0, jitter=0.0, flip=0.0, zoom=(1.0, 1.0))
    return make_batch(bank(), [0, 1], plain, key=(0,), device=torch.device("cpu"))


@pytest.mark.parametrize("steps", [1, 3])
def test_pictures_get_harder_within_the_radius(steps: int) -> None:
    detector = fresh().requires_grad_(True).train()
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    step, (images, truth) = TrainingStep(detector, amp=False), batch()
    found = perturb_images(step, images, truth, replace(HARD, attack_steps=steps), key=(1,))
    assert 3 / 255 < float((found - images).abs().max()) <= 4 / 255 + 1e-6
    assert float(found.min()) >= 0
    assert float(found.max()) <= 1
    assert all(torch.equal(value, before[name]) for name, value in detector.state_dict().items())
    assert all(part.training for part in detector.modules())
    assert all(one.grad is None and one.requires_grad for one in detector.parameters())
    detector.eval()

    def loss(pictures: Tensor) -> float:
        with torch.no_grad():
            return float(torch.stack(list(step(pictures, truth).values())).sum())

    noise = images + 4 / 255 * (2 * torch.rand(images.shape) - 1).sign()
    assert loss(found) > max(loss(images), loss(noise.clamp(0, 1)))


def test_the_key_decides_the_start() -> None:
    step, (images, truth) = TrainingStep(fresh(), amp=False), batch()
    one, two, other = (perturb_images(step, images, truth, HARD, key=(k,)) for k in (1, 1, 2))
    assert torch.equal(one, two)
    assert not torch.equal(one, other)


def test_a_hardened_training_goes_another_way(tmp_path: Path) -> None:
    few = replace(HARD, epochs=1)
    hard = train(fresh(), bank(), few, out=tmp_path / "hard").state_dict()
    plain = train(fresh(), bank(), replace(few, radius=0.0), out=tmp_path / "plain").state_dict()
    assert any(not torch.equal(value, plain[name]) for name, value in hard.items())

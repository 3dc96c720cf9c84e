"""A universal attack in the loop: found in other drives, once, and the same for all pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.experiments.gap import universal_attack as loop_universal
from ssad.experiments.gap.loop_perturbations import perturbed
from ssad.experiments.gap.universal_attack import pictures_of_other_drives
from ssad.rendering.onboard import Onboard
from tests.scenarios.digital.toy_detector import ToyDetector, toy_scene

SIZE = toy_scene(1)[0].shape[-2:]
CAMERAS = {"front": Camera.typical(SIZE[1], SIZE[0], channel="CAM_FRONT")}


def change(detector: ToyDetector, severity: int, frames: Any) -> Any:
    _, changes = perturbed(Onboard(), CAMERAS, "attack-universal", severity, detector=detector)
    draws = [np.random.default_rng(k) for k in range(len(frames))]
    return changes["front"].apply(frames, None, None, draws)


def test_one_change_is_found_in_other_drives_and_added_to_every_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def others(camera: Camera, count: int, device: str) -> torch.Tensor:
        asked.append((camera.channel, count, device))
        return (toy_scene(40)[0] * 255).round() / 255

    monkeypatch.setattr(loop_universal, "pictures_of_other_drives", others)
    detector = ToyDetector()
    frames = np.full((2, 3, *SIZE), 128, np.uint8)
    found = change(detector, 4, frames)
    assert asked == [("CAM_FRONT", 24, "cpu")]
    moved = found.astype(int) - 128
    assert np.abs(moved).max() == 8
    np.testing.assert_array_equal(moved[0], moved[1])
    np.testing.assert_array_equal(change(detector, 4, frames), found)
    assert len(asked) == 1  # found once
    assert np.abs(change(detector, 1, frames).astype(int) - 128).max() == 1
    # it harms pictures that it was not made for
    clean = (toy_scene(6, seed=1)[0] * 255).round().to(torch.uint8).numpy()
    count = [len(one.score) for one in detector.predict(torch.from_numpy(clean).float() / 255)]
    after = [len(one.score) for one in detector.predict(torch.from_numpy(change(detector, 5, clean)).float() / 255)]
    assert sum(after) < sum(count)


def test_a_detector_that_finds_nothing_there_cannot_be_attacked_so(monkeypatch: pytest.MonkeyPatch) -> None:
    empty = torch.full((4, 3, *SIZE), 128 / 255)
    monkeypatch.setattr(loop_universal, "pictures_of_other_drives", lambda *_: empty)
    with pytest.raises(ConfigError, match="finds nothing in pictures of other drives"):
        change(ToyDetector(), 3, np.zeros((1, 3, *SIZE), np.uint8))


@pytest.mark.slow
def test_pictures_are_of_drives_in_other_towns() -> None:
    pictures = pictures_of_other_drives(Camera.typical(96, 54, channel="CAM_FRONT"), 6, "cpu")
    assert pictures.shape == (6, 3, 54, 96)
    assert len({one.numpy().tobytes() for one in pictures}) == 6
    assert {graph.name for _, graph in loop_universal._drives()} == {"Oldmarket", "Larkhill", "Ringmere", "Longreach"}

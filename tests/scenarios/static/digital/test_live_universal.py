"""A universal attack in the loop: found in other drives, once, and the same for all pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.experiments.gap import other_drives
from ssad.experiments.gap.other_drives import images_of_other_drives
from ssad.rendering.sensor_suite import SensorSuite
from ssad.scenarios.static.catalogue import parse_perturbation
from tests.scenarios.static.digital.toy_detector import ToyDetector, toy_scene

SIZE = toy_scene(1)[0].shape[-2:]
CAMERAS = {"front": Camera.typical(SIZE[1], SIZE[0], channel="CAM_FRONT")}


def change(detector: ToyDetector, severity: int, frames: Any, other_images: Any) -> Any:
    suite = SensorSuite(cameras=CAMERAS, other_images=other_images)
    attack = parse_perturbation("universal").make(severity)
    changes = attack.in_loop(suite, target=0, victim=detector, seed=0).changes
    draws = [np.random.default_rng(k) for k in range(len(frames))]
    return changes.readings["front"].apply(frames, None, None, draws)


def test_one_change_is_found_in_other_drives_and_added_to_every_picture() -> None:
    asked = []

    def others(camera: Camera, count: int) -> torch.Tensor:
        asked.append((camera.channel, count))
        return (toy_scene(40)[0] * 255).round() / 255

    detector = ToyDetector()
    frames = np.full((2, 3, *SIZE), 128, np.uint8)
    found = change(detector, 4, frames, others)
    assert asked == [("CAM_FRONT", 24)]
    moved = found.astype(int) - 128
    assert np.abs(moved).max() == 8
    np.testing.assert_array_equal(moved[0], moved[1])
    np.testing.assert_array_equal(change(detector, 4, frames, others), found)
    assert len(asked) == 1  # found once
    assert np.abs(change(detector, 1, frames, others).astype(int) - 128).max() == 1
    # it harms pictures that it was not made for
    clean = (toy_scene(6, seed=1)[0] * 255).round().to(torch.uint8).numpy()
    count = [len(one.score) for one in detector.predict(torch.from_numpy(clean).float() / 255)]
    after = [
        len(one.score) for one in detector.predict(torch.from_numpy(change(detector, 5, clean, others)).float() / 255)
    ]
    assert sum(after) < sum(count)


def test_a_detector_that_finds_nothing_there_cannot_be_attacked_so() -> None:
    empty = torch.full((4, 3, *SIZE), 128 / 255)
    with pytest.raises(ConfigError, match="finds nothing in images of other drives"):
        change(ToyDetector(), 3, np.zeros((1, 3, *SIZE), np.uint8), lambda *_: empty)


@pytest.mark.slow
def test_pictures_are_of_drives_in_other_towns() -> None:
    pictures = images_of_other_drives(Camera.typical(96, 54, channel="CAM_FRONT"), 6, "cpu")
    assert pictures.shape == (6, 3, 54, 96)
    assert len({one.numpy().tobytes() for one in pictures}) == 6
    assert {graph.name for _, graph in other_drives._drives()} == {"Oldmarket", "Larkhill", "Ringmere", "Longreach"}

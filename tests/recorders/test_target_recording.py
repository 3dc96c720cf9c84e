"""Settings of recordings of targets: how high a target is in the image, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ssad.core.errors import ConfigError
from ssad.experiments.perception.physical.target_table import ApproachViews
from ssad.recorders.target_images import _camera
from ssad.recorders.target_recording import TargetRecording, height_in_pixels
from ssad.rendering.target import TargetCar


def test_a_car_at_the_end_of_an_approach_is_24_pixels_high() -> None:
    """The formula is that of the recorder's own camera: an upright stick, projected."""
    approach, height = ApproachViews(), TargetCar().full_size[2]
    distance = max(approach.distances)
    assert distance == 80.0
    camera = _camera(approach.size)
    top, bottom = (camera.intrinsic @ [0.0, y, distance] for y in (-height, 0.0))
    pixels = bottom[1] / bottom[2] - top[1] / top[2]
    assert height_in_pixels(height, distance, approach.size) == pytest.approx(pixels)
    assert pixels >= 24.0
    assert height_in_pixels(height, distance, 640) < 24.0, "the images of the paper's view are too small for that"


def test_an_empty_approach_leaves_the_identity_of_a_recording(tmp_path: Path) -> None:
    plain = TargetRecording(tmp_path, (("Twinford", 2),))
    assert "approach" not in plain.identity()
    far = TargetRecording(tmp_path, (("Twinford", 2),), approach=(5.0, 40.0))
    assert far.identity() == {**plain.identity(), "approach": [5.0, 40.0]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"approach": (5.0, 81.0)}, "give distances from 3 to 80 m"),
        ({"approach": (5.0, 80.0), "size": 320}, "a car 80 m away needs 431"),
        ({"approach": (5.0, 20.0), "mode": "orbit"}, "give distances for an orbit"),
    ],
)
def test_an_approach_that_cannot_be_recorded_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TargetRecording(tmp_path, (("Twinford", 2),), **change)

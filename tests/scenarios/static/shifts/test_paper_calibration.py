"""The paper's calibration beside what was published."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.published_shifts import NAMES, picture, statistics
from helpers.quick import others_slow

from ssad.scenarios.static.shifts import ShiftSpec, shift_images
from ssad.scenarios.static.shifts import parameters as table


@pytest.mark.parametrize("name", others_slow(["snow", "rain", "fog"], ["fog"]))
def test_published_weather_looks_like_the_originals(name: str) -> None:
    """Statistics of imagecorruptions' snow and fog and imgaug's rain as 3D_Corruptions_AD calls them
    (`benchmarks/make_shift_reference.py`): mean, contrast, and structure by size, within what few pictures can tell."""
    published = json.loads((Path(__file__).parents[3] / "data" / "shifts" / "published.json").read_text())
    image, repeats = picture(), {"snow": 4, "rain": 12, "fog": 20}[name]
    for severity in (1, 3, 5):
        specs = [ShiftSpec(name, severity, seed, "paper") for seed in range(repeats)]
        rows = np.array([statistics(shift_images(image, None, spec)[0], image) for spec in specs])
        for column, key in enumerate(NAMES):
            mean, deviation = published["statistics"][f"{name} {severity}"][key]
            if key in ("fine", "middle", "coarse") and mean < np.log(0.5):  # grey levels: rounding
                assert rows[:, column].max() < np.log(0.6), (severity, key)
                continue
            error = deviation * (1 / published["repeats"] + 1 / repeats) ** 0.5
            room = {"mean": 1.0, "contrast": 0.01}.get(key, 0.06) + 3.5 * error
            assert room < {"mean": 16, "contrast": 0.04}.get(key, 0.5), "no test"
            assert rows[:, column].mean() == pytest.approx(mean, abs=room), (severity, key)


@pytest.mark.parametrize("name", ["snow", "rain", "fog", "sunlight"])
def test_published_lengths_scale_with_the_picture(name: str) -> None:
    """Of a picture of half the size: as if the large one had been made smaller."""
    image, repeats = picture(), 5
    small = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    specs = [ShiftSpec(name, 4, seed, "paper") for seed in range(repeats)]
    large = [
        cv2.resize(shift_images(image, None, s)[0], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for s in specs
    ]
    first = np.array([statistics(out, small) for out in large])
    second = np.array([statistics(shift_images(small, None, spec)[0], small) for spec in specs])
    error = (first - second).std(0, ddof=1) / repeats**0.5  # of pairs: the same draws in both
    room = np.array([0.5, 0.01, 0.06, 0.06, 0.06]) + 3.5 * error
    assert (np.abs(first - second).mean(0) <= room).all(), (first.mean(0), second.mean(0))
    assert (room < [2, 0.03, 0.3, 0.3, 0.3]).all(), "no test"


def test_published_sun_is_white_in_the_middle_and_never_darkens() -> None:
    image = picture()
    for severity in (1, 5):
        out, done = shift_images(image, None, ShiftSpec("sunlight", severity, 2, "paper"))
        x, y, radius = (done[0].details[key] for key in ("x", "y", "radius_px"))
        assert radius == table.PAPER_SUN[severity - 1]
        assert (out[y, x] == 255).all()
        away = np.hypot(np.arange(1600)[None] - x, np.arange(900)[:, None] - y)
        assert (out[away < 0.85 * radius] >= 254).all()
        lightness = [v.max(2).astype(int) + v.min(2) for v in (out, image)]
        assert (lightness[0] >= lightness[1]).all()
        changed = (out != image).any(2) & (away > 4 * radius)  # the faint disc
        assert 0 < changed.sum() < 0.05 * changed.size

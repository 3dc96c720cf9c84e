"""Sheets of targets: the surroundings of the target at one scale, with the detections where they lie."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from ssad.core.detections import Truth
from ssad.experiments.perception.physical import target_sheet as module
from ssad.experiments.perception.physical.target_sheet import WIDTH, _square, target_sheet

EDGE = 2  # px of white around an image


@pytest.mark.parametrize(
    ("box", "square"),
    [
        ((300, 230, 340, 250), (240, 160, 160)),
        ((300, 210, 320, 250), (230, 150, 160)),
        ((100, 40, 140, 60), (40, 0, 160)),
        ((10, 240, 30, 280), (0, 180, 160)),
        ((600, 440, 640, 480), (480, 320, 160)),
        ((0, 0, 400, 400), (0, 0, 480)),
        ((240, 0, 640, 400), (160, 0, 480)),
    ],
)
def test_the_square_is_four_times_the_box_and_inside_the_image(
    box: tuple[int, ...], square: tuple[int, int, int]
) -> None:
    assert _square(box, 640, 480) == square


def test_a_sheet_shows_the_target_with_its_detections(monkeypatch: pytest.MonkeyPatch) -> None:
    """A red target of 40 px on black, two images in rows of two and a third beside white."""
    image = torch.zeros(1, 3, 480, 640)
    image[0, 0, 220:260, 300:340] = 1.0
    found = SimpleNamespace(
        box=torch.tensor([[260.0, 200.0, 380.0, 280.0]]), label=torch.tensor([0]), score=torch.tensor([0.5])
    )
    monkeypatch.setattr(module, "clear_detections", lambda *_: found)
    detector: Any = SimpleNamespace(classes=("car",))
    truth = Truth(torch.tensor([0]), torch.tensor([[300.0, 220.0, 340.0, 260.0]]))
    sheet = target_sheet(detector, [(name, image) for name in "abc"], truth, "cpu", columns=2)
    height, width = sheet.shape[0] // 2, WIDTH + 2 * EDGE
    assert sheet.shape == (2 * height, 2 * width, 3)
    assert (sheet[height:, width:] == 255).all(), "no fourth image"
    shown = sheet[EDGE : EDGE + WIDTH, EDGE : EDGE + WIDTH]
    red = (shown[..., 0] > 200) & (shown[..., 1] < 50)
    rows, columns = np.flatnonzero(red.any(1)), np.flatnonzero(red.any(0))
    assert [rows[0], rows[-1] + 1] == pytest.approx([240, 400], abs=4), "a quarter of the width, in the middle"
    assert [columns[0], columns[-1] + 1] == pytest.approx([240, 400], abs=4)
    for x, y in ((80, 320), (560, 320), (320, 160), (320, 480)):  # the middles of the sides of the box, times 4
        assert (shown[y, x] == module.FOUND).all(), (x, y)


def test_an_image_smaller_than_the_square_is_shown_whole() -> None:
    assert _square((0, 0, 60, 30), 100, 64) == (0, 0, 64)

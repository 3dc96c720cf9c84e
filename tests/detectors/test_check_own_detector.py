"""The detector of docs/how-to/use-detectors.md: short, and it keeps every promise."""

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.training import CLASSES, RECIPE, bank

from ssad.core.detections import Truth
from ssad.detectors import make_detector
from ssad.detectors.check import check_detector
from ssad.training.loop import train

FILE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "own_detector.py"


@pytest.fixture
def own() -> Any:
    """The module, by its path."""
    spec = importlib.util.spec_from_file_location("ssad_docs_own_detector", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_it_is_short_and_the_page_names_it() -> None:
    assert len(FILE.read_text().splitlines()) < 100
    assert "(own_detector.py)" in (FILE.parent / "use-detectors.md").read_text()


@pytest.mark.parametrize("size", [(96, 128), (50, 70)])
def test_it_keeps_every_promise(own: Any, size: tuple[int, int]) -> None:
    check_detector(own.OwnDetector(), size=size)
    check_detector(own.OwnDetector(("a", "b", "c"), seed=1).double(), size=size)


def test_crowd_is_ignored_and_the_smaller_box_wins(own: Any) -> None:
    detector = own.OwnDetector()
    dense = detector.dense(torch.zeros(1, 3, 64, 64))
    box = torch.tensor([[0.0, 0, 64, 64], [0, 0, 16, 16], [40, 40, 64, 64]])
    truth = Truth(torch.tensor([0, 1, 1]), box, crowd=torch.tensor([False, False, True]))
    label = detector.assign(dense, [truth]).label.view(8, 8)
    assert (label[:2, :2] == 1).all()
    assert (label[5:, 5:] == -2).all()
    assert int((label == 0).sum()) == 64 - 4 - 9


def test_it_learns(own: Any, tmp_path: Path) -> None:
    detector, data = own.OwnDetector(CLASSES), bank(8)
    images = data.pictures.permute(0, 3, 1, 2).float() / 255

    def loss(one: Any) -> float:
        with torch.no_grad():
            dense = one.dense(images)
            return float(sum(one.losses(dense, one.assign(dense, data.truth)).values()))

    before = loss(detector)
    recipe = replace(RECIPE, detector="own", epochs=15, average=0.0, zoom=(1.0, 1.0), jitter=0.0, noise=0.0)
    assert loss(train(detector, data, recipe, out=tmp_path)) < 0.75 * before


def test_it_can_be_had_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.chdir(FILE.parent)
    monkeypatch.setattr(sys, "path", list(sys.path))
    try:
        assert make_detector("own_detector:OwnDetector").name == "own"
    finally:
        sys.modules.pop("own_detector", None)

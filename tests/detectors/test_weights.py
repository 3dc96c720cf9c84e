"""The shipped weights: they are those of their cards, and find a car in a town that they never saw."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.bodies import two_phases
from helpers.quick import others_slow
from helpers.sharing import Shared

from ssad.core.checkpoints import read_card
from ssad.core.errors import FormatError
from ssad.core.images import read_image
from ssad.datasets.coco import CocoSet, read_coco
from ssad.detectors import SHIPPED, make_detector
from ssad.detectors.on_scenes import score_2d, score_3d
from ssad.recorders.nuscenes import Recording, record_nuscenes
from ssad.recorders.target_images import record_target_images
from ssad.recorders.target_recording import TargetRecording
from ssad.training.batches import ImageSet, load_images
from ssad.training.detector import coco_items, coco_truth

NAMES = sorted(path.stem for path in SHIPPED.glob("*.json"))
TWO = [name for name in NAMES if name.startswith("yolo")]
THREE = [name for name in NAMES if not name.startswith("yolo")]
SCENES = ["scene-larkhill-000"]


@pytest.fixture(scope="session")
def clips(shared: Shared) -> tuple[CocoSet, ImageSet]:
    """Four pictures from 20 m behind, in a held-out town and with a seed that no training had."""

    def make(out: Path) -> None:
        with two_phases():
            record_target_images(
                TargetRecording(out, images=(("Larkhill", 4),), held_out=("Larkhill",), seed=77), workers=0
            )

    out = shared("shipped-clips", make)
    data = read_coco(out / "annotations" / "test.json")
    bank = load_images(coco_items(out, "test")[1], threads=1)
    return data, ImageSet(bank.pictures, tuple(coco_truth(data, target=True)))


def test_some_are_shipped() -> None:
    assert {"fcos3d-light", "pgd-det-light", "yolov3-tiny", "yolov5n"} <= set(NAMES)
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 60 << 20
    assert all(path.stat().st_size < 15 << 20 for path in SHIPPED.iterdir())


@pytest.mark.parametrize("name", NAMES)
def test_cards_say_where_they_are_from(name: str) -> None:
    card = read_card(SHIPPED / f"{name}.safetensors")
    assert card.command.startswith(f"ssad train detector {name.removesuffix('-robust')} --data")
    assert "ssad record" in card.data
    assert card.metrics
    make_detector(name)  # checks the hash


@pytest.mark.parametrize("name", others_slow(TWO, ["yolov5n"]))
def test_the_followed_car_is_found_in_a_town_never_seen(name: str, clips: tuple[CocoSet, ImageSet]) -> None:
    data, bank = clips
    detector = make_detector(name)
    assert set(detector.classes) <= set(data.classes)
    assert score_2d(detector, bank, classes=data.classes)["AP50_car"] > 0.5  # 0.87 and more


@pytest.mark.slow
@pytest.mark.parametrize("name", TWO)
def test_fresh_weights_do_not_find_it(name: str, clips: tuple[CocoSet, ImageSet]) -> None:
    data, bank = clips
    fresh = make_detector(name, weights="random", classes=data.classes)
    assert score_2d(fresh, bank)["AP50_car"] < 0.1


@pytest.fixture(scope="session")
def drive(shared: Shared) -> Path:
    """Two moments of six cameras in a held-out town, with a seed that no training had."""

    def make(out: Path) -> None:
        towns = ("Larkhill",)
        with two_phases():
            record_nuscenes(Recording(out, towns, towns, scenes=1, seconds=0.5, width=800, seed=77), workers=0)

    return shared("shipped-drive", make)


@pytest.mark.slow
@pytest.mark.parametrize("name", THREE)
def test_objects_are_found_in_space_in_a_town_never_seen(name: str, drive: Path) -> None:
    scores = score_3d(make_detector(name), drive, "v1.0-ssad", SCENES)
    assert scores["AP_car"] > 0.1, scores  # 0.2 and more
    assert scores["mAP"] > 0.1, scores  # 0.2


@pytest.mark.slow
@pytest.mark.parametrize("name", THREE)
def test_smaller_pictures_will_do(name: str, drive: Path) -> None:
    """Where the horizon lies between the rows that the trunk leaves decides it; here it would lie half way."""
    scores = score_3d(make_detector(name, input_width=640), drive, "v1.0-ssad", SCENES)
    assert scores["AP_car"] > 0.1, scores


@pytest.mark.slow
@pytest.mark.parametrize("name", THREE)
def test_fresh_weights_find_nothing_in_space(name: str, drive: Path) -> None:
    fresh = score_3d(make_detector(name, weights="random"), drive, "v1.0-ssad", SCENES)
    assert fresh["AP_car"] < 0.02


def test_other_weights_under_a_shipped_card_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from safetensors.torch import load_file, save_file

    import ssad.detectors as package

    state = load_file(SHIPPED / "yolov5n.safetensors")
    first = next(iter(state))
    state[first] = state[first] + torch.ones_like(state[first])
    save_file(state, tmp_path / "yolov5n.safetensors")
    (tmp_path / "yolov5n.json").write_bytes((SHIPPED / "yolov5n.json").read_bytes())
    monkeypatch.setattr(package, "SHIPPED", tmp_path)
    with pytest.raises(FormatError, match="another hash"):
        make_detector("yolov5n")


def test_each_picture_has_one_target(clips: tuple[CocoSet, ImageSet]) -> None:
    data, bank = clips
    assert len(bank) == 4
    for image in data.images:
        assert read_image(image.file).shape == (640, 640, 3)
        assert int(image.target.sum()) == 1
        assert np.isfinite(image.box).all()

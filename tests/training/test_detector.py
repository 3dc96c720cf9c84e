"""`ssad train detector` from data on disk to weights with a card, and what it refuses."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers.bodies import plain_bodies
from helpers.photographs import CARS, ORANGE, write_bdd100k, write_coco, write_kitti
from helpers.sharing import Shared
from PIL import Image
from torch.multiprocessing.spawn import ProcessRaisedException, spawn

from ssad.cli import main
from ssad.core.checkpoints import read_card
from ssad.core.errors import ConfigError, FormatError
from ssad.detectors import SHIPPED, make_detector
from ssad.recorders.target_images import record_target_images
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.target import parse_target
from ssad.training import detector as training
from ssad.training.data import photograph_items
from ssad.training.detector import DetectorPlan, coco_items, command_of, describe_data, flat_items, run_training
from ssad.training.recipe import find_recipe

SHORT = (("epochs", 2), ("batch", 3), ("validate", 1))


@pytest.fixture(scope="session")
def clips(shared: Shared) -> Path:
    pairs = (("Twinford", 6), ("Oldmarket", 2))

    def make(out: Path) -> None:
        with plain_bodies():
            record_target_images(TargetRecording(out, images=pairs, held_out=("Oldmarket",), size=192), workers=0)

    return shared("clips", make)


@pytest.mark.parametrize("target", ["van:white:3", "stop_sign:worn:2"])
def test_the_target_of_clips_is_part_of_their_command(target: str, tmp_path: Path) -> None:
    about = TargetRecording(tmp_path, (("Twinford", 2),), mode="orbit", target=parse_target(target)).identity()
    (tmp_path / "annotations").mkdir()
    (tmp_path / "annotations" / "all.json").write_text(json.dumps({"info": {"recording": about}}))
    assert f"--clips orbit --towns Twinford --images 2 --target {target} " in describe_data(tmp_path)


@pytest.fixture(scope="session")
def drives(recorded: Path) -> Path:
    return recorded


@pytest.fixture(scope="session")
def done(clips: Path, shared: Shared) -> Path:
    """A finished training."""

    def make(out: Path) -> None:
        list(
            run_training(DetectorPlan("yolov5n", (clips,), out, changes=SHORT, device="cpu"), report=lambda line: None)
        )

    return shared("trained", make)


def test_weights_come_with_a_card_that_says_all(done: Path, clips: Path) -> None:
    card = read_card(done / "yolov5n.safetensors")
    assert card.command == "ssad train detector yolov5n --data clips --set epochs=2 --set batch=3 --set validate=1"
    assert card.data.startswith("ssad record clips --clips drive --towns Twinford,Oldmarket --images 6,2")
    assert card.config["epochs_done"] == 2
    rows = [json.loads(line) for line in (done / "log.jsonl").read_text().splitlines()]
    assert [row["epoch"] for row in rows] == [1, 2]
    assert all("clips_target_AP50" in row for row in rows)
    assert {name: rows[-1][name] for name in card.metrics} == pytest.approx(card.metrics)
    assert make_detector("yolov5n", weights=done / "yolov5n.safetensors").classes == card.classes
    assert (done / "curves.png").is_file()


def test_the_card_tells_what_the_first_weights_were_made_of(done: Path, clips: Path, tmp_path: Path) -> None:
    first = done / "yolov5n.safetensors"
    more = DetectorPlan(
        "yolov5n", (clips,), tmp_path / "a", changes=(*SHORT, ("epochs", 1)), weights=first, device="cpu"
    )
    list(run_training(more, report=lambda line: None))
    second = tmp_path / "a" / "yolov5n.safetensors"
    list(run_training(replace(more, out=tmp_path / "b", weights=second), report=lambda line: None))
    cards = [read_card(path) for path in (first, second, tmp_path / "b" / "yolov5n.safetensors")]
    known = [
        {"data": c.data, "command": c.command, "hash": c.hash, "epochs_done": n}
        for c, n in zip(cards, (2, 1, 1), strict=True)
    ]
    before = {"file": "yolov5n.safetensors", **known[0]}
    assert cards[1].config["first_weights"] == before
    assert cards[2].config["first_weights"] == {"file": "yolov5n.safetensors", **known[1], "first_weights": before}
    assert "--weights yolov5n.safetensors" in cards[2].command


@pytest.mark.parametrize("text", ["[1, 2]", '{"config": [3]}', "{}"])
def test_first_weights_with_a_page_that_is_no_card(text: str, tmp_path: Path) -> None:
    (tmp_path / "w.json").write_text(text)
    assert training._weights_origin(tmp_path / "w.safetensors") == {"first_weights": {"file": "w.safetensors"}}


def test_a_finished_training_does_nothing_more(done: Path, clips: Path) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in done.iterdir()}
    said: list[str] = []
    list(run_training(DetectorPlan("yolov5n", (clips,), done, changes=SHORT, device="cpu"), report=said.append))
    assert said == ["all 2 epochs are done, and yolov5n.safetensors is there"]
    assert {path.name: path.stat().st_mtime_ns for path in done.iterdir()} == before


def test_other_data_and_other_first_weights_are_refused(
    done: Path, clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = DetectorPlan("yolov5n", (clips,), done, changes=SHORT, device="cpu")
    monkeypatch.setattr(training, "load_images", lambda *a, **k: pytest.fail("pictures were read"))
    with pytest.raises(FormatError, match="of other data, other first weights"):
        list(run_training(replace(plan, weights=done / "yolov5n.safetensors")))
    with pytest.raises(FormatError, match="of other data, other first weights"):
        list(run_training(replace(plan, split="all")))
    with pytest.raises(FormatError, match="of another recipe"):
        list(run_training(replace(plan, changes=(*SHORT, ("lr", 0.5)))))


def test_what_is_missing_is_said_before_anything_is_read(
    clips: Path, drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "load_images", lambda *a, **k: pytest.fail("pictures were read"))
    flat = DetectorPlan("yolov5n", (clips,), tmp_path / "out", changes=SHORT, device="cpu")
    deep = replace(flat, recipe="fcos3d-light", data=(drives,))
    twin = tmp_path / "clips"
    twin.symlink_to(clips)
    for plan, words in (
        (replace(flat, val="evening"), "annotations/evening.json"),
        (replace(flat, split="evening"), "annotations/evening.json"),
        (replace(flat, data=(clips, twin)), "the same name"),
        (replace(flat, val_data=drives), "--val-data is for 3D detectors"),
        (replace(deep, data=(drives, tmp_path / "other")), "other"),
        (replace(deep, val="mini_val"), "none of its 2 scenes"),
        (replace(deep, split="mini_train"), "mini_train"),
        (replace(deep, data=(tmp_path / "nowhere",)), "nowhere"),
        (replace(flat, gpus=2), "--gpus 2"),
        (replace(deep, changes=(("options", {"depth": 50}),)), "fcos3d-light: no option 'depth'; there are before, "),
        (replace(flat, changes=(("options", {"depth": 50}),)), "unexpected keyword argument 'depth'"),
    ):
        with pytest.raises((ConfigError, FormatError), match=words) as error:
            list(run_training(plan, report=lambda line: None))
        assert "\n" not in str(error.value)


def test_a_training_of_3d_detectors_runs(drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "make_detector", partial(make_detector, input_width=160))  # as wide as the pictures
    changes = (("epochs", 2), ("batch", 4), ("options", {"heading": "bins"}), ("weigh", {"dir": 0.5}))
    first = SHIPPED / "pgd-det-light.safetensors"
    plan = DetectorPlan("pgd-det-light", (drives,), tmp_path, changes=changes, weights=first, device="cpu", seconds=0.0)
    said: list[str] = []
    list(run_training(plan, report=said.append))
    assert "pgd-det-light.safetensors: 8 weights do not fit and start fresh: " in said[0]
    fresh = {name.split(".")[1] for name in said[0].split("fresh: ")[1].split(", ")}
    assert fresh == {"conv_regs", "conv_dir_cls_prev", "conv_dir_cls"}
    assert said[-1] == "stopped after 1 of 2 epochs; run it again to go on"
    card = read_card(tmp_path / "pgd-det-light.safetensors")
    assert card.config["epochs_done"] == 1
    assert "--seconds 0.0" in card.command
    assert {"mAP", "NDS"} <= card.metrics.keys()
    made = make_detector("pgd-det-light", weights=tmp_path / "pgd-det-light.safetensors")
    assert made.config.heading == "bins"  # the weights say so
    with pytest.raises(FormatError, match="conv_dir_cls"):
        make_detector("pgd-det-light", weights=tmp_path / "pgd-det-light.safetensors", heading="vectors")


def test_a_3d_detector_learns_from_several_data_sets(drives: Path) -> None:
    recipe = find_recipe("fcos3d-light")
    (one, _), (two, _) = (
        training._items(DetectorPlan("fcos3d-light", n * (drives,), Path("out")), recipe) for n in (1, 2)
    )
    assert len(two) == 2 * len(one) > 0


def test_a_2d_detector_learns_from_photographs(tmp_path: Path) -> None:
    data = write_coco(tmp_path / "data")
    changes = (("epochs", 1), ("batch", 2), ("validate", 1), ("photo_size", (64, 96)))
    plan = DetectorPlan("yolov5n", (data,), tmp_path / "out", "train2017", "val2017", changes, device="cpu")
    said: list[str] = []
    list(run_training(plan, report=said.append))
    assert any(line.startswith("2 pictures to learn from") for line in said)
    card = read_card(tmp_path / "out" / "yolov5n.safetensors")
    assert card.learned_from == "other data (data)"
    assert card.classes == read_card(SHIPPED / "yolov5n.json").classes
    assert "data_AP50_car" in card.metrics
    assert "--set 'photo_size=[64,96]'" in card.command


@pytest.mark.parametrize(("write", "split"), [(write_coco, "val2017"), (write_bdd100k, "val"), (write_kitti, "val")])
def test_photographs_of_every_form_can_be_learned_from(
    write: Callable[[Path], Path], split: str, tmp_path: Path
) -> None:
    plan = DetectorPlan("yolov5n", (write(tmp_path / "data"),), tmp_path, split, split)
    sources, options = training._items(plan, find_recipe("yolov5n"), report=lambda line: None)
    assert options["classes"] == read_card(SHIPPED / "yolov5n.json").classes
    assert sources[0].read().shape == (384, 640, 3)
    labels = [sources[0].truth.label[~crowd].tolist() for crowd in [sources[0].truth.crowd] if crowd is not None]
    assert labels == [[0]]


def test_photographs_are_fitted_with_their_boxes(tmp_path: Path) -> None:
    names, items = photograph_items(write_coco(tmp_path), "val2017", (48, 80))
    assert names == read_card(SHIPPED / "yolov5n.json").classes
    for item, scale, car in zip(items, (0.5, 0.5), CARS, strict=True):
        image = item.read()
        assert image.shape == (48, 80, 3)
        assert item.truth.crowd is not None
        is_car = ~item.truth.crowd
        assert [names[label] for label in item.truth.label[is_car]] == ["car"]
        x1, y1, x2, y2 = (round(edge) for edge in item.truth.box[is_car][0].tolist())
        assert (x1, y1, x2, y2) == tuple(round(scale * edge) for edge in car)
        assert np.abs(image[y1 + 1 : y2 - 1, x1 + 1 : x2 - 1].astype(int) - ORANGE).max() < 8
    assert (items[1].read()[:, 48:] == 114).all()


def test_nuscenes_teaches_2d_detectors_too(tiny_set: Path) -> None:
    recipe = find_recipe("yolov5n", photo_size=(45, 80))
    names, items = flat_items(tiny_set, "", recipe)
    assert items[0].read().shape == (45, 80, 3)
    assert names[0] == "car"
    assert sum(len(item.truth.label) for item in items) > 0


def test_the_command_can_be_given_to_a_shell() -> None:
    plan = DetectorPlan(
        "yolov5n",
        (Path("a b"), Path("c")),
        Path("out"),
        split="night",
        val="day",
        seconds=60.0,
        gpus=2,
        changes=(("zoom", (0.8, 1.3)), ("epochs", 3)),
        weights=Path("w.pt"),
    )
    assert command_of(plan) == (
        "ssad train detector yolov5n --data 'a b' --more c --split night --val day --weights w.pt --gpus 2 "
        "--seconds 60.0 --set 'zoom=[0.8,1.3]' --set epochs=3"
    )


def test_an_error_of_a_process_is_what_it_was() -> None:
    text = "\n\n-- Process 1 terminated with the following error:\nTraceback (most recent call last):\n  File x\n"
    with pytest.raises(ConfigError, match=r"^no such thing: here$"), training._rewrap_worker_errors():
        raise ProcessRaisedException(f"{text}ssad.core.errors.ConfigError: no such thing: here\n", 1, 7)
    with pytest.raises(ProcessRaisedException, match="KeyError: 'x'"), training._rewrap_worker_errors():
        raise ProcessRaisedException(f"{text}KeyError: 'x'\n", 1, 7)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_an_error_in_another_process_is_one_line(count: int, tmp_path: Path) -> None:
    plan = DetectorPlan("yolov5n", (tmp_path / "nowhere",), tmp_path / "out", gpus=count)
    with pytest.raises(ConfigError, match=r"nowhere: no annotations/train.json"), training._rewrap_worker_errors():
        spawn(training._worker, (plan, find_recipe("yolov5n"), training._free_port(), "gloo"), nprocs=count)


def test_through_the_command(
    clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["ssad", "train", "detector", "yolov5n", "--data", str(clips), "--out", str(tmp_path / "o")]
    monkeypatch.setattr(sys, "argv", [*words, "--set", "zoom=[0.5,abc]"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    assert "zoom" in capsys.readouterr().err


def test_a_turned_picture_is_trained_on_in_the_frame_of_its_boxes(tmp_path: Path) -> None:
    """COCO's boxes mean the stored pixels; a file whose stated size is the upright one means those."""
    image = np.zeros((40, 60, 3), np.uint8)
    image[5:15, 30:50] = 255
    exif = Image.Exif()
    exif[0x0112] = 6
    (tmp_path / "images").mkdir()
    (tmp_path / "annotations").mkdir()
    Image.fromarray(image).save(tmp_path / "images" / "a.png", exif=exif)
    upright_box = [40 - 15, 30, 10, 20]
    for width, height, box in ((60, 40, [30, 5, 20, 10]), (40, 60, upright_box)):
        row = {"id": 1, "image_id": 1, "category_id": 1, "bbox": box, "area": 200, "iscrowd": 0}
        images = [{"id": 1, "file_name": "a.png", "width": width, "height": height}]
        content = {"images": images, "annotations": [row], "categories": [{"id": 1, "name": "car"}]}
        (tmp_path / "annotations" / "train.json").write_text(json.dumps(content))
        _, (item,) = coco_items(tmp_path, "train")
        pixels = item.read()
        x1, y1, x2, y2 = item.truth.box[0].int().tolist()
        assert pixels.shape == (height, width, 3)
        assert pixels[y1:y2, x1:x2].min() == 255
        assert pixels.sum() == 3 * 255 * 200

"""Kind `reality`: detectors on photographs, textures on the cars in them, and what is refused."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.photographs import CARS, write_coco, write_list
from rich.console import Console

from ssad.core.errors import ConfigError
from ssad.datasets.photographs import read_photographs
from ssad.engine.kind import Job, Plan, Resources
from ssad.engine.run import run
from ssad.experiments.perception.reality.kind import Reality, RealitySuite
from ssad.experiments.perception.reality.photograph_boxes import ROAD_CLASSES, find_boxes, road_label
from ssad.experiments.perception.reality.worn_textures import wearing_cars
from ssad.experiments.runs import write_report
from ssad.experiments.suites import load_suite

ORANGE = "helpers.photographs:OrangeDetector"
PATCH = "adv-patch-yolov5n-twinford"
REAL = Path(os.environ.get("SSAD_DATA", "../shared/data")) / "real"


def suite_of(data: Path | str, **changes: Any) -> RealitySuite:
    base: dict[str, Any] = {
        "kind": "reality",
        "name": "t",
        "data": str(data),
        "detectors": [ORANGE],
        "draws": 2,
        "replicates": 5,
        "wearer_height": 30,
    }
    return RealitySuite.model_validate(base | changes)


def go(plan: Plan, folder: Path) -> list[dict[str, Any]]:
    return run(plan, folder, Resources(0, console=Console(file=io.StringIO())))


def test_detectors_are_scored_and_textures_stand_beside_their_controls(tmp_path: Path) -> None:
    plan = Reality().plan(suite_of(write_list(tmp_path / "photographs"), textures=[PATCH]))
    folder = tmp_path / "run"
    records = go(plan, folder)
    assert [(row["texture"], row["pasted"], row["status"]) for row in records] == [
        ("", "clean", "ok"),
        (PATCH, "trained", "ok"),
        (PATCH, "random", "ok"),
        (PATCH, "shuffled", "ok"),
    ]
    clean, trained, *_ = records
    assert clean["metrics"]["recall"] == clean["metrics"]["precision"] == clean["metrics"]["AP50"] == 1
    assert clean["metrics"]["margin"] == pytest.approx(0.75)
    assert clean["metrics"]["found"] == 1
    assert (clean["n"], clean["cars"], clean["images"]) == (2, 2, 2)
    # a patch covers most of the rear, so that less of the box is orange
    assert trained["n"] == 2
    assert trained["metrics"]["score"] < 0.8
    assert trained["metrics"]["change"] == pytest.approx(trained["metrics"]["score"] - 1, abs=1e-6)
    Reality().finish(plan, folder)
    write_report(folder)
    page = (folder / "report.html").read_text()
    assert "By height of the object" in page
    assert page.count('<img src="data:image/jpeg') == 2
    assert "finds 100 % of 2 objects in 2 photographs" in page
    assert (folder / "tables" / "textures.csv").is_file()


def test_boxes_are_kept_and_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = Reality().plan(suite_of(write_list(tmp_path / "photographs")))
    (record,) = go(plan, tmp_path / "run")
    (file,) = record["artefacts"]["boxes"]
    with np.load(tmp_path / "run" / file) as boxes:
        assert boxes["box"].tolist() == [list(map(float, car)) for car in CARS]
        assert boxes["label"].tolist() == [ROAD_CLASSES.index("car")] * 2
    monkeypatch.setattr("ssad.experiments.perception.reality.kind.find_boxes", lambda *a: pytest.fail("found again"))
    cell = plan.cells[0]
    settings = Reality().prepare(plan, tmp_path / "run", Resources(0))
    again = Reality().result(cell, Job(tmp_path / "run", "cpu", settings))
    assert again["metrics"] == record["metrics"]


def test_other_photographs_are_other_cells(tmp_path: Path) -> None:
    both, first = write_list(tmp_path / "both"), write_list(tmp_path / "first", [0])
    keys = {Reality().plan(suite_of(data)).cells[0].key for data in (both, first)}
    keys |= {Reality().plan(suite_of(both, photographs=1)).cells[0].key}
    assert len(keys) == 2  # the first photograph is the same wherever it lies


def test_what_cannot_be_run_is_one_line(tmp_path: Path) -> None:
    data = write_list(tmp_path / "photographs")
    for changes, words in (
        ({"data": ""}, "--set data=FOLDER"),
        ({"data": str(tmp_path / "nowhere")}, "no such folder"),
        ({"textures": ["adv-patch-yolov5n-stop-sign-twinford"]}, "made for a car"),
        ({"textures": [PATCH, PATCH]}, "appears twice"),
        ({"detectors": ["yolov3"]}, "no weights of yolov3 are shipped"),
    ):
        with pytest.raises(ConfigError, match=words) as error:
            Reality().plan(suite_of(**{"data": data} | changes))
        assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="rising numbers"):
        suite_of(data, heights=[24, 16])


def test_a_cell_without_cars_says_so(tmp_path: Path) -> None:
    plan = Reality().plan(suite_of(write_list(tmp_path / "p", [0]), textures=[PATCH], controls=[], wearer_height=90))
    clean, worn = go(plan, tmp_path / "run")
    assert clean["status"] == "ok"
    assert worn["status"] != "ok"
    assert "lower wearer_height" in worn["reason"]


def test_3d_detectors_need_a_camera_matrix(tmp_path: Path) -> None:
    photographs = read_photographs(write_coco(tmp_path), "val2017").photographs
    detector = type("Deep", (), {"task": "3d", "classes": ("car",)})()
    with pytest.raises(Exception, match="no camera matrix"):
        find_boxes(detector, [(0, photographs[0].read(), photographs[0])], "cpu")


def test_cars_that_are_cut_or_hidden_wear_nothing(tmp_path: Path) -> None:
    boxes = [[20, 20, 50, 60], [100, 20, 140, 60], [98, 30, 142, 70], [0, 10, 30, 50], [60, 10, 150, 55]]
    objects = [{"name": "car", "bbox": box} for box in boxes]
    photographs = read_photographs(write_list(tmp_path, [0], objects=objects)).photographs
    # the second is behind the third, the fourth is cut, the last is seen from the side
    assert [car.row for car in wearing_cars(photographs, 30)] == [0, 2]


def test_names_of_forms_and_detectors_meet() -> None:
    assert road_label("person") == road_label("Pedestrian") == ROAD_CLASSES.index("pedestrian")
    assert road_label("trailer") == road_label("construction_vehicle") == road_label("truck")
    assert road_label("dining table") == road_label("dontcare") == -1


def test_the_suite_is_run_with_a_folder() -> None:
    suite = load_suite("reality", ["data=photographs"])
    assert suite.data.endswith("photographs")
    assert suite.textures


@pytest.mark.skipif(not REAL.is_dir(), reason="no photographs: set SSAD_DATA to the folder that has real/")
def test_photographs_of_streets_are_read_in_place() -> None:
    photographs = read_photographs(REAL).photographs
    assert sum(int((~photograph.ignored).sum()) for photograph in photographs) == 90
    cars = wearing_cars(photographs, 40.0)
    assert {photographs[car.image].name for car in cars} >= {"nuscenes_CAM_FRONT.jpg", "kitti_000008.png"}

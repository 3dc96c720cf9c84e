"""Suites of kind `digital`: 2D detectors beside 3D ones, and universal changes."""

from __future__ import annotations

import io
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.sharing import Shared
from rich.console import Console

from ssad.core.errors import SSADError
from ssad.engine.kind import Resources
from ssad.engine.run import run
from ssad.experiments.perception.digital.kind import Digital, DigitalSuite
from ssad.experiments.perception.digital.page import load_digital_run, main_table
from ssad.experiments.perception.digital.tables import black_box_table, distance_table, hardened_table, transfer_table
from ssad.experiments.runs import write_report
from ssad.report.load import load_run

THREE, OTHER, TWO = (f"helpers.linear3d:{name}" for name in ("build", "build_other", "build_flat"))
HARD = "hard"  # what records call it
OVER = ("others", "drive")


@pytest.fixture(scope="session")
def folder(tiny_set: Path, shared: Shared) -> Path:
    def make(out: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("LINEAR_DATA", str(tiny_set))
            run(Digital().plan(suite_of(tiny_set)), out, Resources(0, console=Console(file=io.StringIO())))
            write_report(out)

    return shared("digital-transfer", make)


def suite_of(root: Path, **changes: Any) -> DigitalSuite:
    base: dict[str, Any] = {
        "kind": "digital",
        "name": "t",
        "detectors": [THREE],
        "transfer_detectors": [TWO, OTHER],
        "data": str(root),
        "split": "all",
        "replicates": 3,
        "transfer": ["fgsm"],
        "hardened": [f"{THREE}@{HARD}"],
        "attacks": ["fgsm", *({"name": "universal", "steps": 3, "options": {"frames": 4, "over": o}} for o in OVER)],
    }
    return DigitalSuite.model_validate(base | changes)


def records(folder: Path) -> dict[tuple[str, str, str], dict[str, Any]]:
    found = [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]
    assert {r["status"] for r in found} == {"ok"}, [r.get("reason") for r in found]
    return {(r["detector"], r["attack"] or "", r["source"] or r["options"]): r for r in found}


def test_a_2d_detector_is_scored_by_its_boxes_in_the_images(folder: Path) -> None:
    clean = records(folder)[TWO, "", ""]["metrics"]
    assert clean["mAP"] == 1.0, "it knows every box, and classes are told by their names"
    assert "NDS" not in clean
    assert "mAP_0-20" not in clean
    attacked = records(folder)[TWO, "fgsm", ""]
    assert attacked["metrics"]["mAP"] < 0.7
    assert attacked["metrics"]["drop"] == pytest.approx(1 - attacked["metrics"]["mAP"], abs=1e-5)
    assert len(attacked["replicates"]["mAP"]) == 3


def test_every_detector_is_shown_what_fools_every_other(folder: Path) -> None:
    table = transfer_table(load_digital_run(load_run(folder)))
    assert table.columns == (THREE, TWO, OTHER)
    assert [row.head[-1] for row in table.rows] == ["nothing: clean", THREE, TWO, OTHER]
    clean, three, two, other = (np.array([cell.mean for cell in row.cells]) for row in table.rows)
    assert (three[:2] < clean[:2]).all(), "from 3D to 2D"
    assert (two[:2] < clean[:2]).all(), "and back"
    assert three[2] == two[2] == pytest.approx(clean[2]), "the pattern of the third has nothing to do with theirs"
    assert other[2] < clean[2]
    assert "AP50 of 2D boxes" in table.note


def test_who_takes_part_in_the_transfer_alone_stands_in_no_other_table(folder: Path) -> None:
    own = load_digital_run(load_run(folder))
    assert main_table(own).columns == (f"{THREE} mAP", f"{THREE} NDS")
    assert {row.head[0] for row in distance_table(own).rows} == {THREE}
    assert not [key for key in records(folder) if key[0] in (TWO, OTHER) and key[1] in ("noise", "universal")]
    assert TWO in (folder / "report.html").read_text()


def test_hardened_weights_stand_beside_ordinary_ones_in_a_table_of_their_own(folder: Path) -> None:
    kept = {key[1:] for key in records(folder) if key[0] == HARD}
    mine = {key[1:] for key in records(folder) if key[0] == THREE}
    assert kept == {key for key in mine if key[1] not in (TWO, OTHER)}, "all but the transfer"
    own = load_digital_run(load_run(folder))
    table = hardened_table(own)
    assert [row.head[:2] for row in table.rows[:3]] == [(HARD, "clean"), (HARD, "noise"), (HARD, "FGSM, full loss")]
    for row in table.rows:
        ordinary, hard, gain = (cell.mean for cell in row.cells)
        assert gain == pytest.approx(hard - ordinary)
    assert 100 * records(folder)[HARD, "fgsm", ""]["metrics"]["mAP"] == pytest.approx(table.rows[2].cells[1].mean)
    assert HARD not in " ".join([*main_table(own).columns, *transfer_table(own).columns])


def test_what_asks_for_no_gradient_stands_beside_noise(folder: Path) -> None:
    table = black_box_table(load_digital_run(load_run(folder)))
    assert [row.head[:2] for row in table.rows] == [
        (name, "universal, full loss") for name in (THREE, HARD) for _ in OVER
    ]
    assert all(math.isfinite(cell.mean) for row in table.rows for cell in row.cells)


def test_2d_detectors_may_have_the_whole_table(tiny_set: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LINEAR_DATA", str(tiny_set))
    members = [{"name": "fgsm"}, {"name": "fgsm", "radius": 5.0, "loss": "vanish"}]
    suite = suite_of(
        tiny_set,
        detectors=[TWO],
        transfer_detectors=[],
        transfer=[],
        hardened=[],
        replicates=0,
        attacks=[
            *members,
            {"name": "ensemble", "members": members},
            {"name": "fgsm", "classes": ["car"], "loss": "vanish", "defence": "bits"},
        ],
    )
    plan = Digital().plan(suite)
    run(plan, tmp_path, Resources(0, console=Console(file=io.StringIO())))
    plan.kind.finish(plan, tmp_path)
    kept = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    assert {r["status"] for r in kept} == {"ok"}, [r.get("reason") for r in kept]
    found = {(r["attack"], r["loss"], r["defence"]): r["metrics"] for r in kept}
    members_left = [found["fgsm", loss, ""]["mAP"] for loss in ("full", "vanish")]
    assert found["ensemble", None, ""]["mAP"] <= min(members_left)
    assert main_table(load_digital_run(load_run(tmp_path))).columns == (f"{TWO} mAP",)
    assert (tmp_path / "pictures" / "detections.jpg").is_file()


def test_a_universal_change_is_found_on_other_pictures_and_asks_nothing(folder: Path) -> None:
    found = records(folder)
    clean = found[THREE, "", ""]["metrics"]["mAP"]
    noise = next(r for (_, attack, _), r in found.items() if attack == "noise")
    assert noise["metrics"]["mAP"] == pytest.approx(clean)
    for over in OVER:
        one = found[THREE, "universal", f"frames=4 over={over}"]
        assert one["metrics"]["mAP"] < clean - 0.05, "the best change is the same for all pictures"
        assert (one["access"], one["steps"]) == ("none", 3)
        assert 0.0 < one["change_px"] <= 5.0
        assert one["gradients"] == pytest.approx(4 * (3 + 1) / 12, abs=1e-5), "of the frames that it was fitted to"
        assert one["gradient_error"] < 1e-4
        assert one["loss_after"] > one["loss_before"]


def test_a_drive_alone_has_no_others(tiny_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LINEAR_DATA", str(tiny_set))
    for options, words in (({"over": "all"}, "choose others or drive"), ({"frames": 0}, "must be 1 or more")):
        with pytest.raises(SSADError, match=words):
            Digital().plan(suite_of(tiny_set, attacks=[{"name": "universal", "options": options}]))


def test_data_without_ground_truth_is_one_line(tiny_set: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    root = tmp_path / "empty"
    shutil.copytree(tiny_set, root)
    (root / "v1.0-mini" / "sample_annotation.json").write_text("[]")
    monkeypatch.setenv("LINEAR_DATA", str(tiny_set))
    plan = Digital().plan(suite_of(root))
    with pytest.raises(SSADError, match="has ground truth: there is nothing to score") as caught:
        run(plan, tmp_path / "out", Resources(0, console=Console(file=io.StringIO())))
    assert "\n" not in str(caught.value)

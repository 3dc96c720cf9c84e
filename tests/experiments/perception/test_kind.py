"""Kind `perception`: perturbations of every family in one suite, on recorded scenes and on recorded targets."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from ssad.core.errors import SSADError
from ssad.engine.kind import Plan, Resources
from ssad.engine.run import run
from ssad.experiments.perception.kind import Perception, PerceptionSuite
from ssad.experiments.runs import write_report

LINEAR = "helpers.linear3d:build"
OWN = "helpers.own_perturbations"


@pytest.fixture(autouse=True)
def known_data(tiny_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LINEAR_DATA", str(tiny_set))


def suite_of(root: Path, **changes: Any) -> PerceptionSuite:
    base: dict[str, Any] = {"name": "t", "data": str(root), "split": "all", "detectors": [LINEAR], "replicates": 5}
    return PerceptionSuite.model_validate(base | changes)


def go(plan: Plan, folder: Path, workers: int = 0) -> list[dict[str, Any]]:
    return run(plan, folder, Resources(workers, console=Console(file=io.StringIO())))


def test_shifts_faults_attacks_and_a_users_own_are_scored_beside_clean_data(tiny_set: Path, tmp_path: Path) -> None:
    perturbations = ["fog", {"pgd": {"radius": 5}}, {f"{OWN}:Smear": {"width": 32}}, f"{OWN}:Mirror"]
    plan = Perception().plan(suite_of(tiny_set, perturbations=perturbations, severities=[2, 5]))
    records = go(plan, tmp_path / "run")
    assert [(row["perturbation"], row["severity"], row["family"], row["status"]) for row in records] == [
        ("none", 0, "none", "ok"),
        ("fog", 2, "shift", "ok"),
        ("fog", 5, "shift", "ok"),
        ("pgd?radius=5", 1, "digital", "ok"),
        (f"{OWN}:Smear?width=32", 1, "fault", "ok"),
        ("mirror", 1, "geometry", "ok"),
    ]
    scores = {(row["perturbation"], row["severity"]): row["metrics"]["mAP"] for row in records}
    assert scores["none", 0] > 0.0
    assert scores["pgd?radius=5", 1] < scores["none", 0], "the gradient of this detector is known: the attack must harm"
    attacked = next(row for row in records if row["family"] == "digital")
    assert attacked["gradient_error"] < 0.05
    Perception().finish(plan, tmp_path / "run")
    write_report(tmp_path / "run")
    assert "mirror" in (tmp_path / "run" / "report.html").read_text()
    again = plan.kind.replay(plan, plan.cells[3], records[3], tmp_path / "run")
    assert again.difference is None


def test_a_2d_detector_is_scored_on_scenes_by_its_boxes_in_the_images(tiny_set: Path, tmp_path: Path) -> None:
    plan = Perception().plan(suite_of(tiny_set, detectors=["yolov5n"], perturbations=["fog"]))
    records = go(plan, tmp_path / "run")
    assert [row["status"] for row in records] == ["ok", "ok"], [row.get("reason") for row in records]
    assert all(0.0 <= row["metrics"]["mAP"] <= 1.0 for row in records)


def test_textures_and_lights_are_scored_on_their_target(tiny_set: Path, tmp_path: Path) -> None:
    suite = suite_of(
        tiny_set,
        detectors=["yolov5n"],
        perturbations=["grey", "flashlight"],
        target_images=2,
        target_size=320,
        floor=0.0,
    )
    plan = Perception().plan(suite)
    assert {cell.fields["data"] for cell in plan.cells} == {"sedan"}, "no scene is needed"
    records = go(plan, tmp_path / "run")
    assert [(row["perturbation"], row["status"]) for row in records] == [
        ("none", "ok"),
        ("grey", "ok"),
        ("flashlight", "ok"),
    ], [row.get("reason") for row in records]
    assert all(0.0 <= row["metrics"]["AP50"] <= 1.0 for row in records)
    Perception().finish(plan, tmp_path / "run")
    write_report(tmp_path / "run")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"target_town": "Nowhere", "perturbations": ["grey"]}, "unknown town 'Nowhere'"),
        ({"perturbations": ["fog", "fog"]}, "fog appears twice"),
        ({"perturbations": [{"grey-sign": {}}], "detectors": [LINEAR]}, "has no class stop_sign"),
    ],
)
def test_a_wrong_suite_is_refused_before_it_runs(tiny_set: Path, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(SSADError, match=words):
        Perception().plan(suite_of(tiny_set, **changes))


def test_two_spellings_of_a_target_are_recorded_once(tiny_set: Path) -> None:
    suite = suite_of(tiny_set, detectors=["yolov5n"], perturbations=["grey", "das-yolov5n-twinford"])
    cells = Perception().plan(suite).cells
    assert [(cell.fields["data"], cell.fields["perturbation"]) for cell in cells] == [
        ("sedan", "none"),
        ("sedan", "grey"),
        ("sedan", "das-yolov5n-twinford"),
    ]

"""Suites of kind `detection`: what runs, what is kept, what the report says, and what ends in one line."""

from __future__ import annotations

import csv
import io
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.run_folder import reseal
from helpers.sharing import Shared
from rich.console import Console
from typer.testing import CliRunner

from ssad.cli import app
from ssad.core.errors import ConfigError, FormatError, SSADError
from ssad.core.jsonl import read_lines
from ssad.core.seeding import generator
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.engine.kind import Plan, Resources
from ssad.engine.local import WORKER_MEMORY
from ssad.engine.replay import describe_difference
from ssad.engine.run import run, run_json
from ssad.experiments.perception import open_loop as detection
from ssad.experiments.perception.scene_boxes import SceneCondition, boxes_path, find_boxes, forget_failures, read_boxes
from ssad.experiments.perception.shifts.kind import Detection, DetectionSuite
from ssad.experiments.perception.shifts.page import load_detection_run, main_table, remaining_table, robustness_table
from ssad.experiments.runs import write_report
from ssad.experiments.suites import load_suite
from ssad.metrics.detection import match
from ssad.report.load import load_run
from ssad.report.paper import SHIFTS as PUBLISHED
from ssad.scenarios.static.shifts import SHIFTS as KNOWN
from ssad.scenarios.static.shifts import ShiftSpec, deal_severities

ORACLE = "helpers.oracle3d:build"


@pytest.fixture(scope="session")
def root(tiny_set: Path) -> Path:
    return tiny_set


@pytest.fixture(autouse=True)
def known(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ORACLE_DATA", str(root))


def plan_detection(suite: DetectionSuite) -> Plan:
    return Detection().plan(suite)


def run_detection(plan: Plan, folder: Path, *, workers: int, retry: bool = False) -> list[dict[str, Any]]:
    return run(plan, folder, Resources(workers, console=Console(file=io.StringIO())), retry=retry)


def suite_of(root: Path, **changes: Any) -> DetectionSuite:
    base: dict[str, Any] = {
        "kind": "detection",
        "name": "t",
        "detectors": [ORACLE],
        "data": str(root),
        "split": "mini_val",
        "reference": "shifts",
        "shifts": ["gaussian", "fog"],
        "severities": [1, 3, 5, "random"],
        "replicates": 20,
    }
    return DetectionSuite.model_validate(base | changes)


@pytest.fixture(scope="session")
def folder(root: Path, shared: Shared) -> Path:
    def make(out: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("ORACLE_DATA", str(root))
            run_detection(plan_detection(suite_of(root)), out, workers=0)
            write_report(out)

    return shared("detection-run", make)


def lines(folder: Path) -> list[dict[str, Any]]:
    return read_lines(folder / "results.jsonl")


def test_scores_fall_with_what_the_detector_sees(folder: Path) -> None:
    found = {(r["shift"], r["severity"]): r["metrics"] for r in lines(folder)}
    assert len(found) == 1 + 2 * 4
    clean = found[None, 0]
    assert clean["mAP"] > 0.3
    assert clean["AP_car"] > 0.6
    noise = [found["gaussian", s]["mAP"] for s in (1, 3, 5)]
    assert clean["mAP"] >= noise[0] >= noise[1] >= noise[2]
    assert noise[2] < 0.8 * clean["mAP"]


def test_random_is_put_together_from_the_severities(folder: Path, root: Path) -> None:
    """In the physical calibration each scene is dealt one: its boxes are those of that severity."""
    assert not list((folder / "detections").glob("*/fog-random"))
    record = next(r for r in lines(folder) if r["shift"] == "fog" and r["severity"] == "random")
    drawn = {Path(p).name for p in record["artefacts"]["detections"]}
    tokens = [s["token"] for s in json.loads((root / "v1.0-mini" / "scene.json").read_text())]
    assert drawn == {f"fog-{severity}" for severity in deal_severities(ShiftSpec("fog"), tokens).values()}
    assert len(drawn) == len(tokens)
    boxes = {Path(p).name: {f.stem for f in (folder / p).glob("*.npz")} for p in record["artefacts"]["detections"]}
    with NuScenes(root) as data:
        dealt = deal_severities(ShiftSpec("fog"), tokens)
        assert all(scene.name in boxes[f"fog-{dealt[scene.token]}"] for scene in data.scenes())


def test_intervals_hold_the_value_and_replicates_are_paired(folder: Path) -> None:
    for record in lines(folder):
        assert record["intervals"] == {}, "two scenes are too few"
        assert len(record["replicates"]["NDS"]) == 20
    # of two scenes a replicate takes one twice, or both: what the same draw gave is equal in every cell
    draws = generator("detection suite", 0, 2).multinomial(2, [0.5, 0.5], size=20)[:, 0]
    assert set(draws) == {0, 1, 2}
    for record in lines(folder):
        for draw in (0, 1, 2):
            assert len(set(np.array(record["replicates"]["mAP"])[draws == draw])) == 1


def test_a_stopped_run_goes_on_to_the_same_records(folder: Path, root: Path, tmp_path: Path) -> None:
    again = tmp_path / "run"
    shutil.copytree(folder, again)
    (again / "results.jsonl").write_text("".join((folder / "results.jsonl").read_text().splitlines(True)[:3]) + '{"k')
    reseal(again)
    shutil.rmtree(next((again / "detections").iterdir()) / "fog-3")
    run_detection(plan_detection(suite_of(root)), again, workers=0)

    def plain(record: dict[str, Any]) -> dict[str, Any]:
        return {k: v for k, v in record.items() if k != "wall_s"}

    assert sorted(map(str, map(plain, lines(again)))) == sorted(map(str, map(plain, lines(folder))))


def test_replay_finds_the_boxes_of_a_cell_again_and_says_what_differs(folder: Path, tmp_path: Path) -> None:
    again = tmp_path / "run"
    again.mkdir()
    shutil.copy(folder / "run.json", again)
    text = (folder / "results.jsonl").read_text()
    record = next(r for r in lines(folder) if (r["shift"], r["severity"]) == ("gaussian", 3))
    for changed, code, verdict in (
        ({}, 0, "metrics, 2 of 2 files of boxes the same to the bit, identical"),
        ({"metrics": record["metrics"] | {"mAP": 0.25}}, 1, "differs: metrics: mAP is"),
    ):
        own = json.dumps(record | changed) + "\n"
        (again / "results.jsonl").write_text("".join(x for x in text.splitlines(True) if record["key"] not in x) + own)
        reseal(again)
        found = CliRunner().invoke(app, ["replay", str(again), record["key"], "--out", str(tmp_path / "out")])
        assert (found.exit_code, verdict in found.output.replace("\n", " ")) == (code, True), found.output
    assert (tmp_path / "out" / f"{record['key']}.jpg").stat().st_size > 10_000
    assert not (again / "detections").exists(), "nothing is written to the run"
    changed = {**record, "metrics": record["metrics"] | {"mAP": 0.25}}
    assert describe_difference(changed, record) == f"metrics: mAP is {record['metrics']['mAP']}, was 0.25"


def test_cells_are_scored_as_soon_as_their_boxes_are_there(
    folder: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Clean first, then what the main table tells, shift by shift; what is scored by then outlives a stop."""
    todo, order = plan_detection(suite_of(root)), []

    def make(examination: Any, scene: SceneCondition, detectors: Any) -> None:
        if not boxes_path(examination.folder, ORACLE, scene).is_file():
            if len(order) == 7:
                raise KeyboardInterrupt
            order.append(scene)
        find_boxes(examination, scene, detectors)

    with monkeypatch.context() as patch:
        patch.setattr(detection, "find_boxes", make)
        with pytest.raises(KeyboardInterrupt):
            run_detection(todo, tmp_path / "run", workers=0)
    assert [getattr(u.perturbation, "name", None) for u in order[:6]] == [
        None,
        None,
        "gaussian",
        "gaussian",
        "fog",
        "fog",
    ]
    assert len({u.scene for u in order[2:4]}) == 2, "the severities drawn for the two scenes"
    done = [(r["shift"], r["severity"]) for r in lines(tmp_path / "run")]
    assert {(None, 0), ("gaussian", "random"), ("fog", "random")} <= set(done)
    run_detection(todo, tmp_path / "run", workers=0)
    found = {r["key"]: r["metrics"] for r in lines(tmp_path / "run")}
    assert found == {r["key"]: r["metrics"] for r in lines(folder)}


def test_the_tables_say_what_the_records_say(folder: Path) -> None:
    run = load_detection_run(load_run(folder))
    rows = {(row.head, row.published): row for row in main_table(run).rows}
    drawn = next(r for r in lines(folder) if r["shift"] == "fog" and r["severity"] == "random")
    ours = rows[("Environment", "fog"), False].cells
    assert ours[0].mean == pytest.approx(100 * drawn["metrics"]["mAP"])
    assert (ours[1].n, ours[1].clusters, ours[1].interval) == (drawn["n"], drawn["scenes"], "")  # too few scenes
    table = robustness_table(run)
    assert table is not None
    cells = dict(zip(table.columns, table.rows[0].cells, strict=True))
    assert cells["mCE (NDS)"].mean == pytest.approx(100.0), "the baseline against itself"
    found = {(r["shift"], r["severity"]): r["metrics"]["NDS"] for r in lines(folder)}
    left = np.mean([np.mean([found[s, k] for k in (1, 3, 5)]) for s in ("gaussian", "fog")]) / found[None, 0]
    assert cells["mRR (NDS)"].mean == pytest.approx(100 * float(left))
    share = next(row for row in remaining_table(run).rows if row.head[1] == "fog").cells[1]
    clean = next(r for r in lines(folder) if r["shift"] is None)
    assert share.mean == pytest.approx(100 * drawn["metrics"]["NDS"] / clean["metrics"]["NDS"])
    assert share.interval == ""
    with open(folder / "tables" / "shifts.csv", encoding="utf-8") as file:
        read = list(csv.DictReader(file))
    assert {row["shift"] for row in read} == {"clean", "gaussian noise", "fog"}
    page = (folder / "report.html").read_text()
    assert f"<b>{ours[0].text}</b>" in page
    assert "http" not in page.replace("http://www.w3.org", "")


def test_the_paper_stands_beside_detectors_of_its_kind(folder: Path, tmp_path: Path) -> None:
    """For a detector whose name begins as the paper's do; where nothing was drawn the mean over severities is told."""
    copy = tmp_path / "run"
    shutil.copytree(folder, copy)
    header = json.loads((copy / "run.json").read_text().replace(ORACLE, "fcos3d-light"))
    header["suite"]["severities"] = [1, 3, 5]
    (copy / "run.json").write_text(json.dumps(header))
    kept = [line for line in (copy / "results.jsonl").read_text().splitlines(True) if '"severity":"random"' not in line]
    assert len(kept) == len(lines(folder)) - 2
    (copy / "results.jsonl").write_text("".join(kept).replace(ORACLE, "fcos3d-light"))
    reseal(copy)
    table = main_table(load_detection_run(load_run(copy)))
    told = {row.head[1]: row for row in table.rows if row.published}
    assert told["gaussian noise"].cells[0].mean == PUBLISHED["gaussian"]["FCOS3D"][0]
    found = [r["metrics"]["mAP"] for r in lines(copy) if r["shift"] == "fog"]
    ours = next(row for row in table.rows if row.head[1] == "fog" and not row.published)
    assert len(found) == 3
    assert ours.cells[0].mean == pytest.approx(100 * float(np.mean(found)))
    shares = {
        (row.head[1], row.published): row.cells for row in remaining_table(load_detection_run(load_run(copy))).rows
    }
    assert [cell.mean for cell in shares["fog", True]] == pytest.approx([100 * 17.97 / 29.8, 100 * 29.50 / 37.7])
    assert [cell.mean for cell in shares["gaussian noise", True]] == pytest.approx(
        [100 * 3.62 / 29.8, 100 * 6.47 / 37.7]
    )
    clean = next(r["metrics"]["mAP"] for r in lines(copy) if r["shift"] is None)
    assert shares["fog", False][0].mean == pytest.approx(100 * float(np.mean(found)) / clean)


def test_stored_boxes_give_the_official_scores(folder: Path, root: Path) -> None:
    from ssad.datasets.nuscenes.truth import read_truth
    from ssad.detectors.on_scenes import box_table
    from ssad.metrics.detection_boxes import filter_boxes

    truth = read_truth(root, "v1.0-mini")
    found = [b for path in sorted(folder.glob("detections/*/gaussian-3/*.npz")) for b in read_boxes(path)[0]]
    scores = match(
        filter_boxes(truth.boxes, points=truth.points, racks=truth.racks),
        filter_boxes(box_table(found, truth), racks=truth.racks),
        samples=len(truth.samples),
    ).scores()
    record = next(r for r in lines(folder) if (r["shift"], r["severity"]) == ("gaussian", 3))
    assert record["metrics"]["NDS"] == pytest.approx(scores.nd_score, abs=1e-6)


def test_a_picture_that_is_gone_fails_its_cells_alone(root: Path, tmp_path: Path) -> None:
    """The clean data need it as well; a shift that needs nothing of that scene would go on."""
    broken = tmp_path / "data"
    shutil.copytree(root, broken)
    victim = next((broken / "samples" / "CAM_FRONT").iterdir())
    victim.unlink()
    todo = suite_of(broken, shifts=["gaussian"], severities=[3])
    records = run_detection(plan_detection(todo), tmp_path / "run", workers=0)
    Detection().finish(plan_detection(todo), tmp_path / "run")  # goes without
    assert {r["status"] for r in records} == {"failed"}
    assert all(victim.name in r["reason"] for r in records)
    page = write_report(tmp_path / "run").read_text()
    assert "Failed cells" in page
    shutil.copy(root / "samples" / "CAM_FRONT" / victim.name, victim)
    mended = run_detection(plan_detection(todo), tmp_path / "run", workers=0, retry=True)
    assert {r["status"] for r in mended} == {"ok"}


@pytest.mark.parametrize("way", ["raises", "breaks a promise"])
def test_a_detector_that_fails_fails_its_own_cells_alone(
    root: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    monkeypatch.setenv("ORACLE_WAY", way)
    todo = suite_of(root, detectors=[ORACLE, "helpers.oracle3d:build_bad"], shifts=["gaussian"], severities=[3])
    records = run_detection(plan_detection(todo), tmp_path / "run", workers=0)
    good = [r for r in records if r["detector"] == ORACLE]
    bad = [r for r in records if r["detector"] != ORACLE]
    assert {r["status"] for r in good} == {"ok"}
    assert {r["status"] for r in bad} == {"failed"}
    words = "ZeroDivisionError: on purpose" if way == "raises" else "broken promise: sizes are above 0"
    assert all(words in r["reason"] and "\n" not in r["reason"] for r in bad)
    alone = {(r["shift"], r["severity"]): r["metrics"] for r in lines(folder)}
    assert all(r["metrics"] == alone[r["shift"], r["severity"]] for r in good), "as if it ran by itself"
    assert "Failed cells" in write_report(tmp_path / "run").read_text()
    again = run_detection(plan_detection(todo), tmp_path / "run", workers=0)
    assert again == records
    monkeypatch.setenv("ORACLE_WAY", "none")
    assert run_detection(plan_detection(todo), tmp_path / "run", workers=0) == records, "what failed is kept"
    mended = run_detection(plan_detection(todo), tmp_path / "run", workers=0, retry=True)
    assert [r["key"] for r in mended] == [r["key"] for r in records]
    assert [r for r in mended if r["detector"] == ORACLE] == good, "what worked was not run again"
    assert [r["metrics"] for r in mended if r["detector"] != ORACLE] == [r["metrics"] for r in good]


DEEDS = {
    "dying": ("crashed", "exit code 9"),
    "hanging": ("timeout", "took longer than 12 s"),
    "raising": ("failed", "ZeroDivisionError: on purpose"),
    "hungry": ("crashed", "out of memory"),
}


def check_deadly_detectors(root: Path, folder: Path, out: Path, resources: Resources) -> None:
    """Four detectors fail, each with its reason; all cells of the one among them that works are there, and equal."""
    bad = [f"helpers.oracle3d:build_{deed}" for deed in DEEDS]
    todo = suite_of(
        root, detectors=[*bad[:2], ORACLE, *bad[2:]], shifts=["gaussian"], severities=[1, 3], timeout_s=12.0
    )
    records = run(plan_detection(todo), out, resources)
    assert len(records) == 15
    alone = {(r["shift"], r["severity"]): r["metrics"] for r in lines(folder)}
    for record in records:
        if record["detector"] == ORACLE:
            assert record["status"] == "ok"
            assert record["metrics"] == alone[record["shift"], record["severity"]]
        else:
            status, words = DEEDS[record["detector"].rpartition("_")[2]]
            assert (record["status"], words in record["reason"]) == (status, True), record


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "ray"), [(1, None), (2, None), (None, "local")])
def test_detectors_that_die_hang_raise_or_eat_memory_fail_alone(
    root: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int | None, ray: str | None
) -> None:
    monkeypatch.setenv(WORKER_MEMORY, str(3 << 29))
    resources = Resources(workers, ray, console=Console(file=io.StringIO()))
    check_deadly_detectors(root, folder, tmp_path / "run", resources)


def start(root: Path, out: Path) -> subprocess.Popen[bytes]:
    """The suite of the fixture `folder` in a process of its own."""
    code = (
        "import sys; from pathlib import Path; from experiments.perception.shifts.test_kind_runs import *\n"
        "run_detection(plan_detection(suite_of(Path(sys.argv[1]))), Path(sys.argv[2]), workers=2)"
    )
    paths = [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"ORACLE_DATA": str(root), "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.Popen(
        [sys.executable, "-c", code, str(root), str(out)],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


@pytest.mark.slow
def test_kill_9_at_20_moments(root: Path, folder: Path, tmp_path: Path) -> None:
    out, moments = tmp_path / "run", random.Random(5)
    began = time.monotonic()
    assert start(root, tmp_path / "whole").wait(timeout=600) == 0
    duration = time.monotonic() - began
    for _ in range(20):
        process = start(root, out)
        time.sleep(moments.uniform(0.2, 1.0) * duration)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert start(root, out).wait(timeout=600) == 0
    tables = [{r["key"]: r | {"wall_s": 0} for r in lines(one)} for one in (folder, tmp_path / "whole", out)]
    assert tables[0] == tables[1] == tables[2]
    assert len(lines(out)) == len(tables[2])


@pytest.mark.slow
def test_detectors_are_built_to_plan_a_run(root: Path) -> None:
    """Slow, since they are not imported by anything else here."""
    plan = plan_detection(suite_of(root, detectors=["fcos3d-light", "fcos3d-light@fresh=random"]))
    assert plan.inputs["weights"]["fcos3d-light"] != plan.inputs["weights"]["fcos3d-light@fresh"]
    for detector, words in (("yolov5n=random", "2D"), ("fcos3d-light=/nowhere.pth", r"nowhere\.pth")):
        with pytest.raises(SSADError, match=words):
            plan_detection(suite_of(root, detectors=[detector]))


def test_two_weights_of_one_kind_have_labels(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built = []

    def detector(name: str, weights: str, device: str) -> torch.nn.Module:
        built.append((name, weights, device))
        module = torch.nn.Linear(2, 2)
        torch.nn.init.constant_(module.weight, len(weights))
        torch.nn.init.zeros_(module.bias)
        module.task = "3d"  # type: ignore[assignment]
        return module

    monkeypatch.setattr("ssad.experiments.perception.scored_data.detector_of", detector)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/nobody")
    given = ["fcos3d-light", "fcos3d-light@fresh=random", "fcos3d-light@a=own.pth", "fcos3d-light@b=~/own.pth"]
    plan = plan_detection(suite_of(root, detectors=given))
    names = ["fcos3d-light", "fcos3d-light@fresh", "fcos3d-light@a", "fcos3d-light@b"]
    files = ["", "random", str(tmp_path / "own.pth"), "/home/nobody/own.pth"]
    assert plan.details == dict(zip(names, files, strict=True))
    assert built == [(name, file, "cpu") for name, file in plan.details.items()]
    weights = plan.inputs["weights"]
    assert len(set(weights.values())) == 4
    assert all(re.fullmatch("[0-9a-f]{12}", version) for version in weights.values())
    (own,) = plan_detection(suite_of(root, detectors=[ORACLE])).inputs["weights"].values()
    assert own.startswith(weights["fcos3d-light"] + " "), "and of its source"


def test_a_changed_detector_of_ones_own_is_another_run(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    source = tmp_path / "own_eye.py"
    source.write_text("from helpers.oracle3d import build\n")
    todo = suite_of(root, detectors=["own_eye:build"], shifts=["fog"], severities=[3])
    first = run_json(plan_detection(todo))["identity"]
    assert run_json(plan_detection(todo))["identity"] == first
    source.write_text("from helpers.oracle3d import build  # mended\n")
    assert run_json(plan_detection(todo))["identity"] != first


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no such data": ({"data": "/nowhere"}, "is no folder"),
    "no such split": ({"split": "evening"}, "unknown split 'evening'"),
    "unknown shift": ({"shifts": ["hail"]}, "hail"),
    "a shift twice": ({"shifts": ["fog", "fog"]}, "twice"),
    "no weights are shipped": ({"detectors": ["fcos3d"]}, "fcos3d=FILE"),
    "unknown detector": ({"detectors": ["fcos3d-lite"]}, "fcos3d-light"),
    "a 2D detector": ({"detectors": ["helpers.oracle3d:build_flat"]}, "build_flat finds 2D boxes"),
    "the same detector twice": ({"detectors": [ORACLE, ORACLE]}, "twice; .*@mine=FILE"),
    "a split of recorded data": ({"data": "recorded", "split": "mini_val"}, "mini_val"),
    "a split without scenes": ({"split": "mini_train"}, "none of its 2 scenes"),
    "an unknown town": ({"data": "recorded", "split": "all", "recorded": {"towns": ["Atlantis"]}}, "Atlantis"),
}


@pytest.mark.parametrize("case", BAD.values(), ids=BAD.keys())
def test_bad_suites_end_in_one_line(root: Path, case: tuple[dict[str, Any], str]) -> None:
    changes, words = case
    with pytest.raises(SSADError, match=words) as caught:
        plan_detection(suite_of(root, **changes))
    assert "\n" not in str(caught.value)


def test_a_broken_file_of_boxes_is_named(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "boxes.npz"
    path.write_bytes(next(folder.glob("detections/*/clean/*.npz")).read_bytes()[:200])
    with pytest.raises(FormatError, match=r"boxes\.npz: broken"):
        read_boxes(path)
    with pytest.raises(FormatError, match=r"boxes\.npz: broken"):
        forget_failures([path])


def test_the_shipped_suites_load_and_take_settings() -> None:
    full = load_suite("shifts")
    assert isinstance(full, DetectionSuite)
    assert sorted(full.shifts) == sorted(KNOWN)
    assert full.severities == [1, 2, 3, 4, 5, "random"]
    changed = load_suite("shifts", ["recorded.scenes=3", "severities=2", "shifts=fog"])
    assert isinstance(changed, DetectionSuite)
    assert changed.recorded.scenes == 3
    assert (changed.severities, changed.shifts) == ([2], ["fog"])
    for setting, words in (
        ("severities=[6]", "severities"),
        ("systems=[blind]", "systems"),
        ("recorded.scenes=0", "scenes"),
        ("recorded.town=[x]", "town"),
        ("split.x=1", "split"),
    ):
        with pytest.raises(ConfigError, match=words):
            load_suite("shifts", [setting])


def test_a_severity_that_cannot_be_is_named_by_its_place() -> None:
    with pytest.raises(ConfigError, match=r"--set severities=\[6\]: severities\[0\]: Input should be less than"):
        load_suite("shifts-quick", ["severities=[6]"])


def test_a_suite_of_an_unknown_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.yaml"
    path.write_text("name: x\nkind: flying\n")
    with pytest.raises(ConfigError, match=r"s\.yaml:2.*flying.*driving, perception, detection"):
        load_suite(str(path))


@pytest.mark.slow
def test_through_the_command(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["run", "shifts", "--out", str(out), "--device", "cpu", "--workers", "1"]
    settings = ["split=mini_val", "shifts=[impulse]", "severities=[2]", "replicates=5"]
    for setting in (f"data={root}", f"detectors={ORACLE}", *settings):
        words += ["--set", setting]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "impulse" in done.output
    assert (out / "pictures" / "detections.jpg").is_file()
    assert (out / "report.html").is_file()


def test_the_papers_table_is_the_papers(data_dir: Path) -> None:
    source = sorted((data_dir.parent / "paper").glob("*.txt"))
    if not source:
        pytest.skip("the paper's source is not beside the data folder")
    text = source[0].read_text(errors="replace").replace(" ", "")
    names = {"": "Clean}", "uniform": "UniformNoise", "gaussian": "GaussianNoise", "impulse": "ImpulseNoise"}
    for shift, values in PUBLISHED.items():
        name = names.get(shift, shift.replace("_", " ").title().replace(" ", ""))
        row = "&".join(f"{v:g}" for pair in values.values() for v in pair)
        shown = [line for line in text.splitlines() if f"{name}&" in line and line.count("&") >= 4]
        numbers = ["&".join(f"{float(v):g}" for v in line.rstrip("\\").split("&")[-4:]) for line in shown]
        assert row in numbers, shift

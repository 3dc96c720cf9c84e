"""Suites of kind `digital`: transfer, defences, targets, ensembles, curves on fewer scenes, distances."""

from __future__ import annotations

import io
import json
import math
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.run_folder import reseal
from helpers.sharing import Shared
from rich.console import Console

from ssad.core.errors import SSADError
from ssad.core.nuscenes_names import CATEGORY_TO_CLASS, MMDET3D_CLASSES
from ssad.datasets.nuscenes.camera_truth import camera_truth
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.truth import GroundTruth
from ssad.detectors.on_scenes import SampleBoxes, match_boxes
from ssad.engine.kind import Job, Resources
from ssad.engine.run import run
from ssad.experiments.perception.digital import attack_scores, kind
from ssad.experiments.perception.digital.attack_scores import (
    _recognised_classes,
    by_distance,
    target_success,
    worst_by_sample,
    worst_of,
)
from ssad.experiments.perception.digital.kind import Digital, DigitalSuite
from ssad.experiments.perception.digital.page import attempts_of, load_digital_run, main_table
from ssad.experiments.perception.digital.points import points_of
from ssad.experiments.perception.digital.run import Resampling, setting_of
from ssad.experiments.perception.digital.tables import (
    defence_table,
    halving,
    halving_table,
    target_table,
    transfer_table,
)
from ssad.experiments.perception.scene_boxes import Examination, SceneCondition, boxes_path, read_scenes, truth_of
from ssad.experiments.perception.shifts.page import interval_note
from ssad.experiments.runs import write_report
from ssad.metrics.detection_boxes import BoxTable
from ssad.report.load import load_run
from ssad.scenarios.static.digital import scene_attacker
from ssad.scenarios.static.digital.chosen_object import NEAREST, chosen_first, chosen_object, chosen_places
from ssad.scenarios.static.digital.perturbation import DigitalAttack
from ssad.scenarios.static.digital.spec import AttackSpec

ONE, OTHER = "helpers.linear3d:build", "helpers.linear3d:build_other"
BLIND = "helpers.linear3d:build_blind"
PGD = {"name": "pgd", "steps": 2}


@pytest.fixture(scope="session")
def root(tiny_set: Path) -> Path:
    return tiny_set


@pytest.fixture(autouse=True)
def known(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LINEAR_DATA", str(root))


def suite_of(root: Path, **changes: Any) -> DigitalSuite:
    base: dict[str, Any] = {
        "kind": "digital",
        "name": "t",
        "detectors": [ONE, OTHER],
        "data": str(root),
        "split": "all",
        "replicates": 0,
        "attacks": [
            "fgsm",
            PGD,
            {"name": "ensemble", "members": ["fgsm", PGD]},
            {**PGD, "defence": "bits", "scenes": 1},
            {**PGD, "defence": "bits", "aware": True, "scenes": 1},
            {**PGD, "defence": "resize", "scenes": 1},
            {**PGD, "defence": "resize", "aware": True, "draws": 2, "scenes": 1},
            {"name": "fgsm", "loss": "vanish", "classes": ["car"]},
            {"name": "fgsm", "loss": "vanish", "classes": ["truck"], "scenes": 1},
            {"name": "fgsm", "loss": "vanish", "object": "nearest", "scenes": 1, "precision": "bfloat16"},
        ],
        "sweeps": [{"name": "pgd", "radii": [0, 1, 5], "scenes": 1, "options": {"steps": 2}}],
        "transfer": [PGD],
    }
    return DigitalSuite.model_validate(base | changes)


@pytest.fixture(scope="session")
def folder(root: Path, shared: Shared) -> Path:
    def make(out: Path) -> None:
        attacked: Counter[str] = Counter()
        real = scene_attacker.run_attack

        def counted(attack: Any, detector: Any, images: Any, *given: Any, **named: Any) -> Any:
            about = f"{attack.name} on {detector.name}"
            if hasattr(detector, "pattern"):
                about += f" {int(detector.pattern[0].sum())}"
            attacked[f"{about}, {named['objective']}, {named['aim'].classes}"] += len(images)
            return real(attack, detector, images, *given, **named)

        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("LINEAR_DATA", str(root))
            patch.setattr(scene_attacker, "run_attack", counted)
            # The audit, which takes a third of the run, has tests of its own.
            patch.setattr(kind, "REFERENCE_IMAGES", 2)
            console = Console(file=io.StringIO(), width=200)
            run(Digital().plan(suite_of(root)), out, Resources(0, console=console))
            write_report(out)
        (out / "attacked.json").write_text(json.dumps({"counts": attacked, "said": console.file.getvalue()}))

    return shared("digital-rows", make)


def lines(folder: Path) -> list[dict[str, Any]]:
    found = [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]
    assert {r["status"] for r in found} == {"ok"}, [r.get("reason") for r in found]
    return found


def one(folder: Path, **wanted: Any) -> dict[str, Any]:
    """The record of the first detector with these fields."""
    if "attack" in wanted and wanted["attack"] is None:
        wanted["radius"] = 0.0
    base = {
        "detector": ONE,
        "attack": "pgd",
        "source": "",
        "defence": "",
        "aware": False,
        "radius": 5.0,
        "subset": 0,
        "target": "",
    }
    fitting = [r for r in lines(folder) if all(r[key] == value for key, value in (base | wanted).items())]
    assert len(fitting) == 1, [(r["attack"], r["defence"], r["subset"]) for r in fitting]
    return fitting[0]


def test_no_picture_is_attacked_twice(folder: Path) -> None:
    told = json.loads((folder / "attacked.json").read_text())
    counts = told["counts"]
    plain = [count for about, count in counts.items() if about.startswith(("pgd on linear ", "fgsm on linear "))]
    assert len(plain) == 10, "two detectors: PGD, FGSM, and FGSM on cars, on trucks and on the nearest object"
    assert max(plain) == 24 + 12, "for table, ensemble, transfer, unknown defences and the curve at once; and at 1 px"
    behind = [count for about, count in counts.items() if "+" in about]
    assert behind == [24, 24], "known ones, 12 pictures of one scene, two detectors"
    passes = 2 * (24 * (2 + 1 + 1) + 12 * (1 + 1 + 2 + 2 * 2 + 2))
    assert f"{passes:,} forward and backward passes for 2 detectors" in told["said"]


def test_what_fools_one_detector_does_nothing_to_another(folder: Path) -> None:
    moved, white, clean = (one(folder, **w) for w in ({"source": OTHER}, {}, {"attack": None}))
    assert white["metrics"]["mAP"] < clean["metrics"]["mAP"] == pytest.approx(moved["metrics"]["mAP"])
    theirs = one(folder, detector=OTHER)
    assert moved["loss_after"] == theirs["loss_after"], "what the attack on the other one took"
    own = load_digital_run(load_run(folder))
    table = transfer_table(own)
    assert table.columns == (ONE, OTHER)
    assert [row.head[-1] for row in table.rows] == ["nothing: clean", ONE, OTHER]
    values = np.array([[cell.mean for cell in row.cells] for row in table.rows])
    assert values[1, 0] == pytest.approx(100 * white["metrics"]["mAP"])
    assert values[1, 1] == pytest.approx(values[0, 1])
    assert values[2, 0] == pytest.approx(100 * moved["metrics"]["mAP"])


def test_defences_are_scored_clean_unknown_and_known(folder: Path) -> None:
    own = load_digital_run(load_run(folder))
    table = defence_table(own)
    rows = {row.head[:2]: [cell.mean for cell in row.cells] for row in table.rows}
    assert set(rows) == {(d, name) for d in (ONE, OTHER) for name in ("bit depth", "random resizing")}
    records = [
        one(folder, attack=None, subset=1),
        one(folder, attack=None, subset=1, defence="bits"),
        one(folder, subset=1),
        one(folder, subset=1, defence="bits"),
        one(folder, subset=1, defence="bits", aware=True),
    ]
    assert rows[ONE, "bit depth"] == pytest.approx([100 * r["metrics"]["mAP"] for r in records])
    assert records[3]["loss_after"] == records[2]["loss_after"], "the same pictures"
    known = one(folder, subset=1, defence="resize", aware=True)
    assert known["options"] == "draws=2"
    assert known["gradients"] == 4
    assert known["clean_mAP"] == one(folder, attack=None, subset=1, defence="resize")["metrics"]["mAP"]


def test_an_ensemble_leaves_no_more_than_any_member(folder: Path) -> None:
    worst = one(folder, attack="ensemble")
    members = [one(folder, attack="fgsm"), one(folder)]
    assert worst["metrics"]["mAP"] <= min(r["metrics"]["mAP"] for r in members)
    assert worst["gradients"] == sum(r["gradients"] for r in members)
    assert worst["options"] == "of fgsm full, pgd full"
    heads = [row.head[0] for row in main_table(load_digital_run(load_run(folder))).rows]
    assert heads == [
        "clean",
        "noise",
        "FGSM, full loss",
        "PGD, full loss",
        "worst of FGSM full, PGD full",
        "FGSM, vanish loss",
    ]


def test_a_target_is_reached_where_the_car_is_gone(folder: Path, root: Path) -> None:
    found = one(folder, attack="fgsm", target="car")
    assert found["metrics"]["targets"] > 0
    assert 0 < found["metrics"]["success"] <= 1
    row = target_table(load_digital_run(load_run(folder))).rows[0]
    assert row.cells[0].mean == pytest.approx(100 * found["metrics"]["success"])
    clean, attacked, truth = boxes_of(folder, root)
    same = target_success(clean, clean, truth, ["car"], target_classes={})
    assert same == {"targets": found["metrics"]["targets"], "success": 0.0, "kept": 1.0}
    assert target_success(clean, clean, truth, target_classes={"car": "car"})["success"] == 1.0
    fewer = target_success(attacked, clean, truth, ["car"], target_classes={})
    assert fewer["targets"] < same["targets"], "only what was found before can be lost"
    assert "success" not in target_success(clean, clean, truth, ["trailer"], target_classes={})
    bands = by_distance(clean, truth)
    told = one(folder, attack=None)["metrics"]
    assert bands == {key: value for key, value in told.items() if key.endswith(("0-20", "20-40", "40+"))}
    assert "mAP_0-20" in bands
    assert all(0 < value <= 1 for value in bands.values())


def test_of_all_objects_only_the_chosen_one_is_attacked(folder: Path, root: Path) -> None:
    found = one(folder, attack="fgsm", target="nearest", subset=1)
    assert (found["options"], found["loss"]) == ("precision=bfloat16", "vanish")
    with NuScenes(root) as data:
        scene = data.scene(data.scenes()[0].name)
    places = chosen_places(scene, NEAREST)
    assert 0 < found["metrics"]["targets"] <= len(places) == len(scene.samples)
    assert found["metrics"]["success"] > 0
    assert found["metrics"]["kept"] > found["metrics"]["mAP"] > 0, "the others stay"
    shows = [
        frame
        for frame in scene.frames
        if frame.modality == "camera" and frame.key_frame and len(chosen_first(scene, frame, NEAREST))
    ]
    assert found["images"] - found["idle"] == len(shows) < found["images"], "pictures without it are left as they are"
    row = target_table(load_digital_run(load_run(folder))).rows
    assert "nearest" in {r.head[3] for r in row}
    assert all(len(r.cells) == 4 for r in row)


def test_the_chosen_object_is_the_nearest_that_a_camera_sees_or_one_instance(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with NuScenes(root) as data:
        scene = data.scene(data.scenes()[0].name)
    sample = scene.samples[0].token
    found = scene.annotations(sample)
    cameras = [f for f in scene.frames if f.sample_token == sample and f.modality == "camera" and f.key_frame]

    def seen(row: int) -> bool:
        return any(len(camera_truth(frame, found.take(np.array([row]))).label) for frame in cameras)

    gap = np.linalg.norm(found.centre[:, :2] - cameras[0].ego_to_world[:2, 3], axis=1)
    for classes in ((), ("car",)):
        names = classes or MMDET3D_CLASSES
        wanted = [k for k in range(len(found)) if CATEGORY_TO_CLASS.get(found.category[k]) in names and seen(k)]
        row = chosen_object(scene, sample, NEAREST, classes)
        assert row == min(wanted, key=lambda k: gap[k])
        assert chosen_object(scene, sample, found.instance[row], classes) == row
        frame = next(f for f in cameras if len(camera_truth(f, found.take(np.array([row]))).label))
        assert chosen_first(scene, frame, NEAREST, classes).token[0] == found.token[row]
    first = chosen_object(scene, sample, NEAREST)
    monkeypatch.setattr(
        "ssad.scenarios.static.digital.chosen_object._is_visible", lambda frame, found, row: row != first
    )
    assert chosen_object(scene, sample, NEAREST) == np.argsort(gap, kind="stable")[1], "the nearest is hidden"
    assert chosen_object(scene, sample, "nobody") is None
    assert chosen_object(scene, sample, NEAREST, ("trailer",)) is None, "the tiny set has none"


def test_an_object_that_is_nowhere_is_a_recorded_failure(root: Path, tmp_path: Path) -> None:
    attacks = [{"name": "fgsm", "loss": "vanish", "object": "nobody", "scenes": 1}]
    suite = suite_of(root, detectors=[ONE], attacks=attacks, sweeps=[], transfer=[])
    records = run(Digital().plan(suite), tmp_path, Resources(0, console=Console(file=io.StringIO())))
    (failed,) = [r for r in records if r["attack"] == "fgsm"]
    assert failed["status"] == "failed"
    assert "no moment of these scenes has it" in failed["reason"]


def boxes_of(folder: Path, root: Path) -> tuple[list[SampleBoxes], list[SampleBoxes], GroundTruth]:
    """Boxes of the first detector on clean pictures and under FGSM, and the truth."""
    examination = Examination(folder, root, "v1.0-mini", (), 0, "cpu", 1)
    with NuScenes(root) as data:
        names = [scene.name for scene in data.scenes()]
    spec = AttackSpec("fgsm", "full", "linf", 5.0)
    clean, _ = read_scenes(examination, ONE, [SceneCondition(name) for name in names])
    attacked, _ = read_scenes(examination, ONE, [SceneCondition(name, DigitalAttack(spec), ONE, 1) for name in names])
    return clean, attacked, truth_of(examination, names)


def test_the_worst_of_several_attacks(folder: Path, root: Path) -> None:
    clean, attacked, truth = boxes_of(folder, root)
    first = [attacked[0], *clean[1:]]
    others = [clean[0], *attacked[1:]]
    worst = worst_by_sample([first, others], truth.samples, lambda boxes: match_boxes(boxes, truth))
    assert tokens(worst) == tokens(attacked), "each moment by itself"
    assert worst_of({"one": first, "two": others}, truth)[0] == "mixture"
    for order in (("clean", "attacked"), ("attacked", "clean")):
        name, boxes = worst_of({one: clean if one == "clean" else attacked for one in order}, truth)
        assert name == "attacked", "of equal ones the first"
        assert tokens(boxes) == tokens(attacked)


def test_an_ensemble_is_not_worse_than_its_members_where_the_mixture_is(
    folder: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clean, attacked, truth = boxes_of(folder, root)
    monkeypatch.setattr(attack_scores, "worst_by_sample", lambda *given: clean)
    name, boxes = worst_of({"one": clean, "two": attacked}, truth)
    assert name == "two"
    assert tokens(boxes) == tokens(attacked)


def tokens(boxes: list[SampleBoxes]) -> list[tuple[str, float]]:
    return [(one.token, float(one.boxes.score.sum())) for one in boxes]


def test_the_radius_that_halves_a_score() -> None:
    assert halving([(0.0, 0.4), (1.0, 0.3), (3.0, 0.1), (5.0, 0.0)]) == pytest.approx(2.0)
    assert halving([(0.0, 0.4), (2.0, 0.2)]) == 2.0
    for never in ([(0.0, 0.4), (5.0, 0.21)], [(0.0, 0.0), (5.0, 0.0)], [(0.0, 0.4)], []):
        assert math.isnan(halving(never))


def test_no_line_is_drawn_over_a_radius_that_has_not_run(folder: Path, tmp_path: Path) -> None:
    part = tmp_path / "part"
    shutil.copytree(folder, part)
    lines = (part / "results.jsonl").read_text().splitlines(keepends=True)
    kept = [one for one in lines if (row := json.loads(one))["radius"] != 1.0 or row["detector"] != ONE]
    assert len(kept) < len(lines)
    (part / "results.jsonl").write_text("".join(kept))
    reseal(part)
    (row,) = halving_table(load_digital_run(load_run(part))).rows
    assert math.isnan(row.cells[0].mean)
    assert row.cells[2].mean > 1


def test_curves_may_run_on_fewer_scenes(root: Path, folder: Path) -> None:
    few, clean = one(folder, subset=1), one(folder, attack=None, subset=1)
    assert few["scenes"] == 1
    assert few["clean_mAP"] == clean["metrics"]["mAP"]
    assert few["images"] == 12
    table = halving_table(load_digital_run(load_run(folder)))
    (row,) = table.rows
    assert row.head == ("PGD, full loss", "2 steps", "1 of each town")
    assert row.cells[1].mean == pytest.approx(100 * one(folder, subset=1, radius=1.0)["metrics"]["mAP"])
    assert 1 < row.cells[0].mean < 5
    groups = {a.group for a in attempts_of(load_digital_run(load_run(folder)))}
    assert groups == {
        "",
        "1 of each town",
        "car",
        "truck, 1 of each town",
        "nearest, 1 of each town",
        "bit depth, 1 of each town",
        "random resizing, 1 of each town",
    }


def test_scenes_are_the_first_of_each_town(root: Path) -> None:
    plan = Digital().plan(suite_of(root))
    scenes = {"a": "", "b": "", "c": "", "d": ""}
    towns = {"a": "x", "b": "x", "c": "y", "d": "y"}
    job = Job(Path(), "cpu", {"scenes": scenes, "towns": towns, "batch": 1})
    (cell,) = [c for c in plan.cells if c.fields["subset"] == 1 and not c.fields["attack"] and c.system == ONE]
    assert [scene.scene for scene in Digital().scenes(cell, job)] == ["a", "c"]
    whole = next(c for c in plan.cells if c.fields["attack"] == "fgsm" and not c.fields["subset"])
    assert [scene.scene for scene in Digital().scenes(whole, job)] == ["a", "b", "c", "d"]


def test_a_failed_attack_fails_what_needs_its_pictures(root: Path, tmp_path: Path) -> None:
    suite = suite_of(root, detectors=[ONE, BLIND], attacks=["fgsm"], sweeps=[], transfer=["fgsm"])
    records = run(Digital().plan(suite), tmp_path, Resources(0, console=Console(file=io.StringIO())))
    status = {(r["detector"], r["attack"], r["source"]): r for r in records}
    assert status[ONE, "fgsm", ""]["status"] == status[BLIND, "fgsm", ONE]["status"] == "ok"
    assert "gives no gradient" in status[BLIND, "fgsm", ""]["reason"]
    assert f"the attack on {BLIND} failed: " in status[ONE, "fgsm", BLIND]["reason"]


def test_a_page_with_one_scene_says_so_in_the_singular() -> None:
    assert interval_note(Resampling(1)) == "no intervals, since one scene is too few (five are the least)."
    assert interval_note(Resampling(2)).startswith("no intervals, since 2 scenes are too few")


def test_records_of_older_versions_can_be_read(folder: Path) -> None:
    told = one(folder)
    older = {key: told[key] for key in ("attack", "loss", "norm", "radius", "steps", "options")}
    assert setting_of(older) == setting_of(told)


def test_pictures_against_different_systems_lie_apart(tmp_path: Path) -> None:
    spec = AttackSpec("fgsm", "full", "linf", 5.0)
    paths = {
        boxes_path(tmp_path, "eye", SceneCondition("s", DigitalAttack(spec), source, 1))
        for source in ("a", "b", "a+jpeg")
    }
    assert len(paths) == 3


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no such defence": ({"attacks": [{**PGD, "defence": "jpg"}]}, "unknown defence 'jpg'"),
    "no such option": (
        {"attacks": [{**PGD, "defence": {"name": "jpeg", "options": {"q": 3}}}]},
        "defence 'jpeg': .*'q'",
    ),
    "aware of nothing": ({"attacks": [{**PGD, "aware": True}]}, "aware of which defence"),
    "no such class": ({"attacks": [{**PGD, "classes": ["cat"]}]}, "unknown class 'cat'"),
    "becomes": ({"attacks": [{**PGD, "becomes": {"car": "bus"}}]}, "becomes needs loss: mislabel"),
    "an object of all": ({"attacks": [{"name": "fgsm", "object": "nearest"}]}, "loss full is of all objects"),
    "a class of all": ({"attacks": [{**PGD, "loss": "depth", "classes": ["car"]}]}, "loss depth is of all objects"),
    "no members": ({"attacks": ["ensemble"]}, "an ensemble has members"),
    "members": ({"attacks": [{**PGD, "members": ["fgsm"]}]}, "an ensemble has members"),
    "budgets": (
        {"attacks": [{"name": "ensemble", "members": ["fgsm", {"name": "pgd", "radius": 2}]}]},
        "different budgets",
    ),
}


@pytest.mark.parametrize("case", BAD.values(), ids=BAD.keys())
def test_bad_rows_end_in_one_line(root: Path, case: tuple[dict[str, Any], str]) -> None:
    changes, words = case
    with pytest.raises(SSADError, match=words) as caught:
        Digital().plan(suite_of(root, **changes))
    assert "\n" not in str(caught.value)


def test_an_attack_behind_a_defence_is_compared_with_the_bare_detector(root: Path) -> None:
    points = points_of(suite_of(root))
    assert any(point.defence and point.aware for point in points)
    assert all(not point.aware for point in points if not point.defence)


def test_objects_near_no_box_have_no_class() -> None:
    truth, found = BoxTable.empty(3), BoxTable.empty(2)
    truth.centre[:, 0] = (0.0, 50.0, 0.0)
    truth.sample[:] = (0, 0, 1)
    found.label[:], found.score[:] = (4, 7), (0.9, 0.8)
    found.centre[:, 0] = (0.5, 30.0)
    assert _recognised_classes(truth, found).tolist() == [4, -1, -1]

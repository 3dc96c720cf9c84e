"""Suites of kind `digital`: what runs, what is kept, what the report says, and what ends in one line."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.linear3d import CLEAN, GAINS
from helpers.run_folder import reseal
from helpers.sharing import Shared
from pydantic import ValidationError
from rich.console import Console

from ssad.core.errors import SSADError
from ssad.core.images import read_image
from ssad.core.jsonl import read_lines
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.detectors.monitored import MonitoredDetector
from ssad.engine.command import command_of
from ssad.engine.kind import Job, Plan, Resources
from ssad.engine.run import run
from ssad.experiments.perception import scored_data
from ssad.experiments.perception.digital import kind as digital
from ssad.experiments.perception.digital.attack_sheet import magnified
from ssad.experiments.perception.digital.kind import Digital, DigitalSuite, _reference_shares
from ssad.experiments.perception.digital.page import (
    attempts_of,
    effort_table,
    load_digital_run,
    lost_table,
    main_table,
    short_of,
)
from ssad.experiments.perception.digital.page import summary as kind_summary
from ssad.experiments.perception.scene_boxes import (
    Examination,
    SceneCondition,
    boxes_path,
    detector_of,
    find_boxes,
    read_boxes,
    recorded_scene,
    samples_at_once,
)
from ssad.experiments.runs import summary, write_report
from ssad.experiments.suites import load_suite
from ssad.metrics.attack_audit import audit
from ssad.report.load import load_run
from ssad.report.paper import DIGITAL as PUBLISHED
from ssad.scenarios.static.digital import scene_attacker
from ssad.scenarios.static.digital.perturbation import DigitalAttack
from ssad.scenarios.static.digital.reference_ensemble import REFERENCE_IMAGES
from ssad.scenarios.static.digital.scene_attacker import SceneAttacker
from ssad.scenarios.static.digital.spec import AttackSpec
from ssad.scenarios.static.digital.tally import sum_notes
from ssad.scenarios.static.digital.universal import UniversalFit
from ssad.training.data import nuscenes_items

LINEAR, BLIND = "helpers.linear3d:build", "helpers.linear3d:build_blind"
PGD = AttackSpec("pgd", "full", "linf", 5.0, (("steps", 3),))


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
        "detectors": [LINEAR, BLIND],
        "data": str(root),
        "split": "mini_val",
        "reference": "digital",
        "attacks": ["fgsm", {"name": "pgd", "steps": 3}],
        "replicates": 5,
        "sweeps": [{"name": "pgd", "radii": [0, 2], "options": {"steps": 3}}],
    }
    return DigitalSuite.model_validate(base | changes)


def run_digital(plan: Plan, folder: Path, *, retry: bool = False) -> list[dict[str, Any]]:
    return run(plan, folder, Resources(0, console=Console(file=io.StringIO())), retry=retry)


@pytest.fixture(scope="session")
def folder(root: Path, shared: Shared) -> Path:
    def make(out: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("LINEAR_DATA", str(root))
            plan = Digital().plan(suite_of(root))
            run_digital(plan, out)
            Digital().finish(plan, out)
            write_report(out)

    return shared("digital-run", make)


def lines(folder: Path) -> list[dict[str, Any]]:
    return read_lines(folder / "results.jsonl")


def by_attack(folder: Path, detector: str) -> dict[tuple[str | None, float], dict[str, Any]]:
    return {(r["attack"], r["radius"]): r for r in lines(folder) if r["detector"] == detector}


def test_cells_are_the_clean_data_noise_of_each_size_the_table_and_the_curves(root: Path) -> None:
    plan = Digital().plan(suite_of(root, detectors=[LINEAR]))
    assert [cell.name.partition("/")[2] for cell in plan.cells] == [
        "clean",
        "noise-full-linf-5",
        "noise-full-linf-2",
        "fgsm-full-linf-5",
        "pgd-full-linf-5-steps3",
        "pgd-full-linf-2-steps3",
    ]
    assert [cell.fields["row"] for cell in plan.cells] == [True, True, False, True, True, False]
    assert [cell.fields["steps"] for cell in plan.cells] == [0, 0, 0, 1, 3, 3]
    assert [plan.kind.order(cell) for cell in plan.cells] == [0, 1, 2, 1, 1, 2]
    keys = {cell.key for cell in plan.cells}
    assert len(keys) == 6
    for changed in ({"seed": 1}, {"replicates": 6}):
        assert not keys & {cell.key for cell in Digital().plan(suite_of(root, detectors=[LINEAR], **changed)).cells}
    fewer_at_once = Digital().plan(suite_of(root, detectors=[LINEAR], batch=2))
    assert keys == {cell.key for cell in fewer_at_once.cells}, "results do not depend on the batch"


def test_a_plan_builds_each_detector_once(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []
    real = scored_data.detector_of
    for module in (scored_data, digital):
        monkeypatch.setattr(module, "detector_of", lambda *given: built.append(given[0]) or real(*given), raising=False)
    plan = Digital().plan(suite_of(root))
    assert built == [LINEAR, BLIND]
    assert {cell.fields["task"] for cell in plan.cells} == {"3d"}


def test_attacks_of_the_kind_by_default(root: Path) -> None:
    suite = DigitalSuite.model_validate(
        {"kind": "digital", "name": "t", "detectors": [LINEAR], "data": str(root), "split": "mini_val"}
    )
    names = [cell.name.partition("/")[2] for cell in Digital().plan(suite).cells]
    assert names == [
        "clean",
        "noise-full-linf-5",
        "fgsm-full-linf-5",
        "pgd-full-linf-5-steps10",
        "cw-margin-linf-5-steps10",
        "pgd-margin-linf-5-steps10",
    ]


def test_one_step_reaches_the_optimum_of_a_linear_detector(root: Path, folder: Path) -> None:
    found = by_attack(folder, LINEAR)
    assert {r["status"] for r in found.values()} == {"ok"}
    fgsm = found["fgsm", 5.0]
    counts = [len(item.truth.label) for item in nuscenes_items(root, None, "mini_val")]
    gain = [np.mean([GAINS[k % 4] for k in range(count)]) if count else 0.0 for count in counts]
    clean = -CLEAN * np.mean([count > 0 for count in counts])
    assert fgsm["loss_before"] == pytest.approx(clean, rel=1e-4)
    # where a picture is black or white it cannot be moved as far, so the optimum is not quite reached
    rise = (fgsm["loss_after"] - clean) / (np.mean(gain) * 5 / 255)
    assert 0.9 < rise <= 1.0 + 1e-4
    assert found["pgd", 5.0]["loss_after"] == pytest.approx(fgsm["loss_after"], rel=0.02)
    assert fgsm["change_px"] == 5.0
    assert fgsm["used"] == pytest.approx(np.mean([count > 0 for count in counts]), rel=0.05), (
        "the others have no gradient"
    )
    assert (fgsm["gradients"], found["pgd", 5.0]["gradients"], found["noise", 5.0]["gradients"]) == (1.0, 3.0, 0.0)
    assert (fgsm["access"], found["noise", 5.0]["access"]) == ("white-box", "none")
    assert fgsm["gradient_error"] < 1e-4
    assert fgsm["coupling"] < 1e-4
    assert found["noise", 5.0]["gradient_error"] is None
    assert fgsm["images"] == 24
    assert fgsm["batch"] == 1


def test_scores_fall_under_attacks_and_not_under_noise(folder: Path) -> None:
    found = by_attack(folder, LINEAR)
    clean = found[None, 0.0]["metrics"]["mAP"]
    assert clean > 0.3
    assert found["noise", 5.0]["metrics"]["mAP"] == pytest.approx(clean)
    assert found["pgd", 5.0]["metrics"]["mAP"] <= found["fgsm", 5.0]["metrics"]["mAP"] + 1e-6 < clean
    assert found["pgd", 2.0]["metrics"]["mAP"] > found["pgd", 5.0]["metrics"]["mAP"]
    drop = 1 - found["pgd", 5.0]["metrics"]["mAP"] / clean
    assert found["pgd", 5.0]["metrics"]["drop"] == pytest.approx(drop, abs=1e-5)


def test_a_detector_without_a_gradient_fails_its_white_box_cells_with_the_reason(folder: Path) -> None:
    found = by_attack(folder, BLIND)
    assert {key: r["status"] for key, r in found.items()} == {
        (None, 0.0): "ok",
        ("noise", 5.0): "ok",
        ("noise", 2.0): "ok",
        ("fgsm", 5.0): "failed",
        ("pgd", 5.0): "failed",
        ("pgd", 2.0): "failed",
    }
    assert "gives no gradient of loss 'full' to the image" in found["fgsm", 5.0]["reason"]


def test_the_report_has_the_papers_numbers_the_audit_and_the_failures(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    assert "Audit passed" in page
    assert "The same audit of the paper" in page
    assert "PGD with 10 steps at 5 px leaves 19.61 mAP, FGSM with 1 step at 5 px 8.77 mAP" in page
    assert "Failed cells" in page
    assert "gives no gradient" in page
    assert "mAP over the budget" in page
    assert 'src="data:image/jpeg' in page
    assert {path.stem for path in (folder / "tables").glob("*.csv")} == {
        "digital",
        "lost",
        "audit",
        "effort",
        "cells",
        "classes",
        "distances",
        "halving",
    }
    own = load_digital_run(load_run(folder))
    assert [row.head[0] for row in main_table(own).rows] == ["clean", "noise", "FGSM, full loss", "PGD, full loss"], (
        "the paper has no such detectors"
    )
    assert len(attempts_of(own)) == 7, "failed cells are no attempts"
    text = io.StringIO()
    Console(file=text, width=200).print(summary(folder))
    assert "Audit passed" in text.getvalue()


def test_published_rows_stand_beside_detectors_of_the_same_kind(folder: Path) -> None:
    found = load_run(folder)
    named = {LINEAR: "fcos3d-mine", BLIND: "pgd-det-mine"}
    renamed = tuple({**r, "detector": named[r["detector"]]} for r in found.lines)
    header = {**found.header, "suite": {**found.suite, "detectors": list(named.values())}}
    run = load_digital_run(type(found)(found.folder, header, renamed, {}, found.planned))
    table = main_table(run)
    rows = {row.head: [cell.mean for cell in row.cells] for row in table.rows if row.published}
    assert rows == {
        ("clean", ""): [29.8, 37.7, 31.74, 39.34],
        ("FGSM", "5 px, 1 step"): [8.3, 21.44, 8.77, 17.99],
        ("PGD", "5 px, 10 steps"): [3.9, 18.73, 19.61, 31.42],
    }
    heads = [row.head[0] for row in table.rows]
    assert heads == ["clean", "clean", "noise", "FGSM, full loss", "FGSM", "PGD, full loss", "PGD"], "each beside ours"
    lost = {row.head[0]: row.cells[0].mean for row in lost_table(run).rows if row.published}
    assert lost["PGD"] == pytest.approx(100 * (1 - 3.9 / 29.8))


def test_what_is_there_is_not_run_again_and_what_failed_is_if_asked(
    root: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    shutil.copytree(folder, out)
    kept = (out / "results.jsonl").read_text().splitlines()
    gone = [k for k, line in enumerate(kept) if json.loads(line)["attack"] == "fgsm"]
    (out / "results.jsonl").write_text("".join(f"{line}\n" for k, line in enumerate(kept) if k not in gone))
    reseal(out)
    asked: list[Any] = []
    monkeypatch.setattr(scene_attacker, "run_attack", lambda *given, **named: asked.append(given))
    records = run_digital(Digital().plan(suite_of(root)), out)
    assert not asked, "the boxes were kept"

    def plain(found: list[dict[str, Any]]) -> dict[str, Any]:
        return {r["key"]: {k: v for k, v in r.items() if k != "wall_s"} for r in found}

    assert plain(records) == plain(lines(folder))
    found = run_digital(Digital().plan(suite_of(root)), out, retry=True)
    assert plain(found) == plain(lines(folder)), "it failed again, for the same reason"


def attacker(root: Path, *, batch: int, device: str = "cpu", seed: int = 0) -> tuple[SceneAttacker, list[Any]]:
    with NuScenes(root) as data:
        name = data.scenes()[0].name
        examination = Examination(Path(), root, "v1.0-mini", ((LINEAR, ""),), seed, device, 1)
        recorded = recorded_scene(examination, data, SceneCondition(name, batch=batch))
    found = SceneAttacker(PGD, recorded, MonitoredDetector(detector_of(LINEAR, "", "cpu")))
    return found, [f for f in recorded.data.frames if f.modality == "camera" and f.key_frame][:4]


def test_an_image_is_attacked_alike_in_any_batch_and_order(root: Path) -> None:
    alone, frames = attacker(root, batch=1)
    together, _ = attacker(root, batch=4)
    together.batch = 4
    first, second = alone.look(frames), together.look(frames[::-1])[::-1]
    assert (alone.tally.batch, together.tally.batch) == (1, 4)
    clean = [read_image(root / frame.filename) for frame in frames]
    for one, other, kept in zip(first, second, clean, strict=True):
        assert (one == other).all()
        assert np.abs(one.astype(int) - kept).max() == 5
    other_seed, _ = attacker(root, batch=1, seed=1)
    assert any((a != b).any() for a, b in zip(first, other_seed.look(frames), strict=True))


def test_several_samples_fill_a_batch_on_a_gpu(root: Path) -> None:
    base, _ = attacker(root, batch=1)
    with NuScenes(root) as data:
        for batch, samples in ((12, 6), (36, 6), (40, 7), (96, 16)):
            examination = Examination(Path(), root, "v1.0-mini", ((LINEAR, ""),), 0, "cpu", 1)
            condition = SceneCondition(base.recorded.data.record.name, DigitalAttack(PGD), LINEAR, batch)
            shown = condition.present(examination, data, [MonitoredDetector(base.watched.detector, LINEAR)])
            assert samples_at_once(shown) == samples


def test_where_memory_does_not_suffice_batches_are_halved(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, frames = attacker(root, batch=4)
    whole.batch = 4
    expected = whole.look(frames)
    sizes: list[int] = []
    real = scene_attacker.run_attack

    def narrow(attack: Any, detector: Any, images: torch.Tensor, *given: Any, **named: Any) -> Any:
        sizes.append(len(images))
        if len(images) > 1:
            raise torch.OutOfMemoryError("no memory")
        return real(attack, detector, images, *given, **named)

    monkeypatch.setattr(scene_attacker, "run_attack", narrow)
    short, _ = attacker(root, batch=4)
    short.batch = 4
    found = short.look(frames)
    assert sizes == [4, 2, 1, 1, 1, 1]
    assert (short.tally.batch, short.tally.halved) == (1, 2), "said in the record"
    assert all((a == b).all() for a, b in zip(found, expected, strict=True))


def test_a_universal_change_is_fitted_to_fewer_images_at_once_where_memory_does_not_suffice(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []
    real = scene_attacker.Victim

    def narrow(detector: Any, images: torch.Tensor, *given: Any, **named: Any) -> Any:
        sizes.append(len(images))
        if len(images) > 1:
            raise torch.OutOfMemoryError("no memory")
        return real(detector, images, *given, **named)

    monkeypatch.setattr(scene_attacker, "Victim", narrow)
    base, _ = attacker(root, batch=4)
    spec = AttackSpec("universal", "full", "linf", 5.0, (("frames", 4), ("over", "drive"), ("steps", 1)))
    own = SceneAttacker(spec, base.recorded, base.watched)
    own.batch = 4
    own._fit()
    assert sizes == [4, 2, 1, 1, 1, 1]
    assert own.tally.halved == 2
    assert own.attack.name == "universal"
    assert not isinstance(own.attack, UniversalFit)


def test_short_memory_is_said_in_the_report_and_on_the_terminal(folder: Path) -> None:
    found = load_run(folder)
    assert not short_of(load_digital_run(found))
    assert "Memory" not in str(kind_summary(found).note)
    lines = tuple({**r, "halved": 2} if r["attack"] == "fgsm" else r for r in found.lines)
    short = type(found)(found.folder, found.header, lines, {}, found.planned)
    assert "batches were halved 4 times" in effort_table(load_digital_run(short)).note
    assert "batches were halved 4 times" in kind_summary(short).note


def test_a_scene_that_is_cut_off_goes_on_from_its_pictures(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base, _ = attacker(root, batch=1)
    view = SceneCondition(base.recorded.data.record.name, DigitalAttack(PGD), LINEAR)
    asked: list[str] = []
    real = scene_attacker.run_attack
    stop_at = 3

    def counted(*given: Any, **named: Any) -> Any:
        (key,) = named["keys"]
        if len(asked) == stop_at:
            raise KeyboardInterrupt
        asked.append(key[1])
        return real(*given, **named)

    monkeypatch.setattr(scene_attacker, "run_attack", counted)
    out = [Examination(tmp_path / name, root, "v1.0-mini", ((LINEAR, ""),), 0, "cpu", 1) for name in ("cut", "whole")]
    with pytest.raises(KeyboardInterrupt):
        find_boxes(out[0], view, [LINEAR])
    kept = sorted((tmp_path / "cut" / "unfinished").rglob("*.npz"))
    assert len(kept) == 3
    kept[0].write_bytes(b"cut off in the middle")
    stop_at = 1000
    find_boxes(out[0], view, [LINEAR])
    many = len([f for f in base.recorded.data.frames if f.modality == "camera" and f.key_frame])
    assert len(asked) == many + 1, "of three one was broken"
    find_boxes(out[1], view, [LINEAR])
    boxes, notes = zip(*(read_boxes(boxes_path(one.folder, LINEAR, view)) for one in out), strict=True)
    assert notes[0] == notes[1]
    assert [one.boxes.score.tolist() for one in boxes[0]] == [one.boxes.score.tolist() for one in boxes[1]]
    assert not (tmp_path / "cut" / "unfinished").exists(), "a finished scene needs them no more"


def test_an_image_without_objects_is_left_as_it_is_by_a_loss_that_needs_some(root: Path) -> None:
    spec = AttackSpec("fgsm", "mislabel", "linf", 5.0)
    base, _ = attacker(root, batch=1)
    own = SceneAttacker(spec, base.recorded, base.watched)
    every = [f for f in base.recorded.data.frames if f.modality == "camera" and f.key_frame]
    empty = [f for f in every if not len(own._truth(f).label)]
    assert empty, "the tiny set has such pictures"
    found = own.look(empty[:1])
    assert own.tally.idle == own.tally.images == 1
    assert (found[0] == read_image(root / empty[0].filename)).all()


def test_notes_of_scenes_are_put_together() -> None:
    one = {
        "access": "white-box",
        "images": 3,
        "idle": 1,
        "gradients": 30,
        "queries": 6,
        "before": 3.0,
        "after": 9.0,
        "used": 1.0,
        "change": 4.0,
        "batch": 2,
        "gradient_error": 0.1,
        "coupling": None,
        "halved": 2,
        "references": [{"attack": "pgd", "token": "b"}, {"attack": "pgd", "token": "a"}],
    }
    empty = one | dict.fromkeys(("images", "idle", "gradients", "queries", "before", "after", "used", "batch"), 0)
    other = one | {
        "images": 1,
        "idle": 0,
        "gradients": 10,
        "queries": 2,
        "used": 0.5,
        "change": 5.0,
        "batch": 1,
        "gradient_error": 0.3,
    }
    del other["references"], empty["references"]  # as older versions have it
    assert sum_notes([one, empty, other]) == {
        "access": "white-box",
        "images": 4,
        "idle": 1,
        "gradients": 10.0,
        "queries": 2.0,
        "loss_before": 1.5,
        "loss_after": 4.5,
        "used": 0.5,
        "change_px": 5.0,
        "batch": 2,
        "gradient_error": 0.3,
        "coupling": None,
        "halved": 4,
        "references": [{"attack": "pgd", "token": "a"}, {"attack": "pgd", "token": "b"}],
    }


def test_a_change_is_magnified_around_grey() -> None:
    clean = np.full((1, 3, 3), 100, np.uint8)
    picture = clean.copy()
    picture[0, 0], picture[0, 1] = 105, 95
    assert magnified(picture, clean)[0, :, 0].tolist() == [255, 0, 128]
    assert magnified(clean, clean)[0, :, 0].tolist() == [128, 128, 128]


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no such attack": ({"attacks": ["pdg"]}, "unknown attack 'pdg'.*ssad list attacks"),
    "no such loss": ({"attacks": [{"name": "pgd", "loss": "ful"}]}, "unknown loss 'ful'"),
    "twice": ({"attacks": ["pgd", "pgd"]}, "one of them appears twice"),
    "no option": ({"attacks": [{"name": "fgsm", "steps": 3}]}, "attack fgsm: .*steps"),
    "refused": ({"attacks": [{"name": "pgd", "options": {"restarts": -1}}]}, "restarts and decay 0 or more"),
    "odd option": ({"attacks": [{"name": "pgd", "options": {"start": ["none"]}}]}, "options are numbers and words"),
    "no radius": ({"attacks": [{"name": "pgd", "radius": 0}]}, "the radius must be above 0"),
    "an empty sweep": ({"sweeps": ["pgd"]}, "neither radii nor steps"),
    "no such data": ({"data": "/nowhere"}, "is no folder"),
    "twice in transfer": ({"transfer_detectors": [LINEAR]}, "appears twice"),
    "transfer of nothing": ({"transfer_detectors": ["yolov5n"]}, "transfer, and it is empty"),
    "a detector of nothing": ({"detectors": ["helpers.linear3d:build_stranger"]}, "none of the ten classes"),
}


@pytest.mark.parametrize("case", BAD.values(), ids=BAD.keys())
def test_bad_suites_end_in_one_line(
    root: Path, case: tuple[dict[str, Any], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ORACLE_DATA", str(root))
    changes, words = case
    with pytest.raises(SSADError, match=words) as caught:
        Digital().plan(suite_of(root, **changes))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "changes",
    [
        {"radius": 0},
        {"radius": -1},
        {"steps": 0},
        {"batch": 0},
        {"attacks": []},
        {"attacks": [{"radius": 5}]},
        {"attacks": [{"name": "pgd", "radius": -5}]},
        {"attacks": [{"name": "pgd", "norm": "l1"}]},
        {"sweeps": [{"name": "pgd", "radii": [-1]}]},
    ],
)
def test_what_no_suite_may_say(root: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        suite_of(root, **changes)


def test_the_shipped_suites_load_and_their_command_repeats_them() -> None:
    full, quick = load_suite("digital"), load_suite("digital-quick")
    assert {one.name for one in quick.attacks} == {"fgsm", "pgd", "cw"}
    assert {one.name for one in full.attacks} == {"fgsm", "pgd", "cw", "ensemble", "square", "nes", "universal"}
    assert {one.defence.name for one in full.attacks if one.defence and one.aware} == {"jpeg", "bits", "blur", "resize"}
    assert (full.radius, full.steps, full.data) == (5, 10, "recorded")
    changed = load_suite("digital", ["attacks=[{name: pgd, steps: 3, options: {restarts: 1}}, fgsm]", "steps=4"])
    words = command_of(changed)
    setting = "attacks=[{name: pgd, options: {restarts: 1}, steps: 3},{name: fgsm}]"
    assert words == f"ssad run digital --set '{setting}' --set steps=4"
    assert load_suite("digital", [setting, "steps=4"]) == changed


def test_the_suite_digital_takes_100_000_passes_of_a_detector_at_most() -> None:
    suite = load_suite("digital")
    plan = Digital().plan(suite)
    towns = {f"{town} {number}": town for town in suite.recorded.towns for number in range(suite.recorded.scenes)}
    job = Job(Path(), "cuda", {"scenes": towns, "towns": towns, "batch": 12})
    every = {
        one.name + one.source: one.perturbation.spec
        for cell in plan.cells
        for one in Digital().scenes(cell, job)
        if isinstance(one.perturbation, DigitalAttack)
    }
    images = 6 * int(2 * suite.recorded.seconds)
    passes = sum(one.passes_in(images) for one in every.values())
    assert 50_000 < passes / len(suite.detectors) <= 100_000


def test_a_column_says_which_share_is_lost() -> None:
    assert [column.name for column in digital.Digital.columns] == ["mAP", "NDS", "AP_car", "drop"]


def test_the_papers_table_is_the_papers(data_dir: Path) -> None:
    source = sorted((data_dir.parent / "paper").glob("*.txt"))
    if not source:
        pytest.skip("the paper's source is not beside the data folder")
    table = source[0].read_text(errors="replace").replace(" ", "").partition("underdigitalattacksonnuScenes")[2]
    names = {"": "{Benign}", "C&W": r"C$\&$W"}
    for attack, scores in PUBLISHED.items():
        (line,) = [
            one for one in table.splitlines()[:20] if f"{names.get(attack, attack)}&" in one and one.count("&") > 3
        ]
        numbers = [float(value) for value in line.rstrip("\\").split("&")[-4:]]
        assert numbers == [*scores["FCOS3D"], *scores["PGD"]], attack


def test_every_attack_is_compared_with_the_reference_ensemble(root: Path, tmp_path: Path) -> None:
    weak = "helpers.weak_attacks:"
    names = ["fgsm", *({"name": name, "options": {"steps": 3}} for name in ("pgd", f"{weak}FlippedChannel"))]
    names.append({"name": "square", "options": {"queries": 20}})  # the thousand of its default prove nothing more
    suite = suite_of(root, detectors=[LINEAR], attacks=names, sweeps=[], steps=3, replicates=2)
    records = {record["attack"]: record for record in run_digital(Digital().plan(suite), tmp_path / "run")}
    for attack in ("fgsm", "pgd", f"{weak}FlippedChannel"):
        compared = records[attack]["references"]
        assert 8 <= len({entry["token"] for entry in compared}) == len(compared) <= REFERENCE_IMAGES
        assert set(compared[0]["references"]) == {"pgd", "square", *(["apgd"] if attack != "fgsm" else [])}
        assert all(entry["loss"] > entry["loss_before"] for entry in compared)
    assert records["square"]["references"] == [], "without gradients there is nothing to compare"
    assert not records["noise"]["references"]
    loaded = load_digital_run(load_run(tmp_path / "run"))
    faults = [fault.text for fault in audit(attempts_of(loaded)).faults if fault.rule == "reference"]
    assert len(faults) == 1, faults
    assert faults[0].startswith(f"{weak}FlippedChannel on loss full with 3 steps at 5 px raises its loss by")
    assert Digital().verdict(load_run(tmp_path / "run"))[0].startswith("Audit of the attacks: ")


def test_the_images_of_the_ensemble_do_not_depend_on_the_cell() -> None:
    assert _reference_shares(["a", "b", "c"]) == {"a": 6, "b": 7, "c": 7}
    many = _reference_shares([str(number) for number in range(50)])
    assert sum(many.values()) == REFERENCE_IMAGES
    assert set(many.values()) == {0, 1}

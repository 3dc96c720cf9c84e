"""Kind `detection` without a detector: its suites, cells, their order, and what it prepares and keeps."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pydantic import ValidationError
from rich.console import Console

from ssad.core.errors import ConfigError, FormatError
from ssad.engine.kind import Job, Plan, Resources
from ssad.experiments.perception import open_loop
from ssad.experiments.perception.scene_boxes import Examination, boxes_path
from ssad.experiments.perception.scored_data import RecordedData, Victims, recording_of
from ssad.experiments.perception.shifts import kind as shifts_kind
from ssad.experiments.perception.shifts.kind import Detection, DetectionSuite, shifted_scene
from ssad.scenarios.static.shifts import SHIFTS, VERSIONS, ShiftSpec, deal_severities
from ssad.scenarios.static.shifts.perturbation import Shift


def replace_name(monkeypatch: pytest.MonkeyPatch, name: str, value: Any) -> None:
    """Replace a name in the kind and in its base, wherever it is used."""
    modules = [module for module in (open_loop, shifts_kind) if hasattr(module, name)]
    assert modules, name
    for module in modules:
        monkeypatch.setattr(module, name, value)


GOOD: dict[str, Any] = {
    "kind": "detection",
    "name": "t",
    "detectors": ["one", "two"],
    "shifts": ["fog"],
    "severities": [1, 3, "random"],
}
SCENES = {f"scene-{k}": f"token-{k}" for k in range(5)}


def suite(**changes: Any) -> DetectionSuite:
    return DetectionSuite.model_validate(GOOD | changes)


@pytest.fixture(autouse=True)
def no_detectors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Detectors are names; looking at data is another matter."""

    def detectors(suite: str, names: list[str]) -> Victims:
        hashes = {name: f"hash of {name}" for name in names}
        return Victims(hashes, {name: f"{name}.pth" for name in names}, dict.fromkeys(names, "3d"))

    replace_name(monkeypatch, "detectors_of", detectors)


def plan_of(device: str = "cpu", **changes: Any) -> Plan:
    return Detection().plan(suite(**changes), device=device)


def job(folder: Path, **changes: Any) -> Job:
    settings = {
        "root": "/data",
        "version": "v1.0-mini",
        "detectors": {"one": "one.pth"},
        "calibration": "physical",
        "seed": 7,
        "replicates": 5,
        "scenes": SCENES,
        "threads": 3,
    }
    return Job(folder, "cuda", settings | changes)


def test_what_a_suite_says_by_default() -> None:
    found = DetectionSuite(kind="detection", name="t")
    assert found.severities == [1, 2, 3, 4, 5, "random"]
    assert found.shifts == list(SHIFTS)
    assert (found.detectors, found.data, found.version) == (["fcos3d-light", "pgd-det-light"], "recorded", None)
    assert (found.split, found.calibration, found.replicates) == ("val", "physical", 100)
    recorded = RecordedData()
    assert (recorded.towns, recorded.scenes, recorded.seconds) == (["Oldmarket", "Larkhill"], 12, 8.0)
    assert (recorded.width, recorded.seed) == (800, 0)


@pytest.mark.parametrize(
    ("key", "good", "bad"),
    [
        ("detectors", [["a"]], [[], [""]]),
        ("data", ["x"], [""]),
        ("shifts", [["fog"]], [[], [""]]),
        ("severities", [[1], [5], ["random"]], [[], [0], [6], ["none"], ["3"]]),
        ("replicates", [0, 10_000], [-1, 10_001]),
        ("calibration", ["paper"], ["other"]),
    ],
)
def test_what_a_suite_may_say(key: str, good: list[Any], bad: list[Any]) -> None:
    for value in good:
        assert getattr(suite(**{key: value}), key) == value
    for value in bad:
        with pytest.raises(ValidationError):
            suite(**{key: value})


@pytest.mark.parametrize(
    ("key", "good", "bad"),
    [
        ("scenes", 1, 0),
        ("seconds", 0.5, 0.49),
        ("width", 64, 63),
        ("seed", 0, -1),
        ("towns", ["a"], []),
        ("seconds", 1.0, float("inf")),
        ("scenes", 2, "2"),
        ("scenes", 2, 2.0),
    ],
)
def test_what_a_suite_may_say_of_its_recording(key: str, good: Any, bad: Any) -> None:
    assert getattr(suite(recorded={key: good}).recorded, key) == good
    for wrong in ({key: bad}, {"other": 1}):
        with pytest.raises(ValidationError):
            suite(recorded=wrong)
    with pytest.raises(ValidationError):
        suite().recorded.scenes = 3


def test_cells_are_the_clean_data_and_each_shift_and_severity() -> None:
    plan = plan_of(seed=4)
    assert [cell.name for cell in plan.cells] == [
        f"{name}/{what}" for name in ("one", "two") for what in ("clean/0", "fog/1", "fog/3", "fog/random")
    ]
    clean, fog = plan.cells[:2]
    assert clean.fields == {"detector": "one", "shift": None, "family": "clean", "severity": 0}
    assert fog.fields == {"detector": "one", "shift": "fog", "family": SHIFTS["fog"][0], "severity": 1}
    assert fog.spec == {"shift": "fog", "calibration": "physical", "labels": "original"}
    assert (fog.seed, fog.system) == (4, "one")
    assert plan.versions == {"shifts": str(VERSIONS["physical"])}
    assert plan.details == {"one": "one.pth", "two": "two.pth"}
    assert plan.inputs["weights"] == {"one": "hash of one", "two": "hash of two"}
    assert len({cell.key for cell in plan.cells}) == 8
    keys = {cell.key for cell in plan.cells}
    for changed in (
        plan_of("cuda", seed=4),
        plan_of(seed=5),
        plan_of(seed=4, replicates=9),
        plan_of(seed=4, calibration="paper"),
        plan_of(seed=4, split="all"),
        plan_of(seed=4, recorded={"scenes": 11}),
    ):
        assert not keys & {cell.key for cell in changed.cells}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shifts": ["fog", "fog"]}, "suite t: a shift appears twice"),
        ({"severities": [1, 1]}, "suite t: a severity appears twice"),
        ({"split": "train"}, "recorded data have the splits val and all, not 'train'"),
        ({"data": "/nowhere"}, "suite t: data: /nowhere is no folder"),
    ],
)
def test_what_no_suite_may_say(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        plan_of(**changes)


def test_the_clean_data_come_first_then_the_main_table_then_the_middle() -> None:
    plan = plan_of(detectors=["one"], severities=[1, 2, 3, 4, 5, "random"])
    order = sorted(plan.cells, key=plan.kind.order)
    assert [cell.fields["severity"] for cell in order] == [0, "random", 3, 2, 4, 1, 5]
    assert plan.kind.order(plan.cells[0]) < plan.kind.order(plan.cells[-1]) < plan.kind.order(plan.cells[3])


def test_scenes_of_a_cell(tmp_path: Path) -> None:
    kind = Detection()
    clean, _, fog, dealt = plan_of(detectors=["one"], seed=4).cells

    def of(cell: Any) -> list[str]:
        pieces = kind.pieces(cell, job(tmp_path))
        assert all(data == cell for data in pieces.values())
        return list(pieces)

    assert of(clean) == [f"clean/{scene}" for scene in SCENES]
    assert of(fog) == [f"fog-3/{scene}" for scene in SCENES]
    severities = deal_severities(ShiftSpec("fog", seed=4), list(SCENES.values()))
    assert severities != deal_severities(ShiftSpec("fog", seed=5), list(SCENES.values()))
    assert of(dealt) == [f"fog-{severities[token]}/{scene}" for scene, token in SCENES.items()]
    *_, drawn = plan_of(detectors=["one"], calibration="paper").cells
    expected = [shifted_scene("fog", "random", "paper", scene) for scene in SCENES]
    assert kind.scenes(drawn, job(tmp_path)) == expected, "drawn by sample"
    assert of(drawn) == [scene.name for scene in expected]
    there = boxes_path(tmp_path, "one", shifted_scene("fog", 3, "physical", "scene-2"))
    there.parent.mkdir(parents=True)
    there.touch()
    assert of(fog) == [f"fog-3/{scene}" for scene in SCENES if scene != "scene-2"]


def test_boxes_are_found_and_scored_with_what_the_job_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    replace_name(monkeypatch, "find_boxes", lambda *given: found.append(given))

    def score(examination: Any, system: str, scenes: Any, *, replicates: int) -> dict[str, Any]:
        assert len(found) == len(SCENES) + 1
        return {"metrics": {"scenes": len(scenes)}, "replicates": replicates, "system": system}

    replace_name(monkeypatch, "score_scenes", score)
    kind, cell = Detection(), plan_of(detectors=["one"]).cells[2]
    expected = Examination(tmp_path, Path("/data"), "v1.0-mini", (("one", "one.pth"),), 7, "cuda", 3)
    kind.make("fog-3/scene-1", cell, ["one", "two"], job(tmp_path))
    assert found == [(expected, shifted_scene("fog", 3, "physical", "scene-1"), ["one", "two"])]
    results = kind.execute([cell], job(tmp_path))
    assert found[1:] == [(expected, shifted_scene("fog", 3, "physical", scene), ["one"]) for scene in SCENES]
    assert results == {
        cell.key: {
            "metrics": {"scenes": 5},
            "replicates": 5,
            "system": "one",
            "artefacts": {"detections": ["detections/one/fog-3"]},
        }
    }


class Data:
    """A data set that only knows its scenes."""

    opened: list[tuple[Path, str | None]]

    def __init__(self, root: Path, version: str | None) -> None:
        self.opened.append((root, version))
        self.version = version or "v1.0-found"

    def __enter__(self) -> Data:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def scene(self, name: str) -> Any:
        return SimpleNamespace(record=SimpleNamespace(token=SCENES[name]), boxes={"sample": [None]})


@pytest.fixture
def data(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, str | None]]:
    """The data sets that were opened."""
    opened: list[tuple[Path, str | None]] = []
    monkeypatch.setattr(Data, "opened", opened, raising=False)
    replace_name(monkeypatch, "NuScenes", Data)
    replace_name(monkeypatch, "scenes_of", lambda data, split: {"val": tuple(SCENES)}[split])
    replace_name(monkeypatch, "default_workers", lambda: 8)
    return opened


def quiet(workers: int | None = None) -> Resources:
    return Resources(workers, "some cluster", console=Console(file=io.StringIO()))


def test_where_none_is_given_a_data_set_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: list[tuple[Path, str | None]]
) -> None:
    recorded = []

    def record(recording: Any, *, workers: int | None, ray: str | None, progress: Any) -> Path:
        progress(2, 24)
        recorded.append((recording, workers, ray))
        return tmp_path / "data"

    replace_name(monkeypatch, "record_nuscenes", record)
    resources = quiet(3)
    settings = Detection().prepare(plan_of(seed=4), tmp_path, resources)
    assert recorded == [(recording_of(suite(), tmp_path / "data"), 3, "some cluster")]
    assert data == [(tmp_path / "data", None)]
    assert settings == {
        "root": str(tmp_path / "data"),
        "version": "v1.0-found",
        "detectors": {"one": "one.pth", "two": "two.pth"},
        "seed": 4,
        "replicates": 100,
        "scenes": SCENES,
        "threads": 2,
    }
    shown = resources.console.file.getvalue()  # type: ignore[attr-defined]
    assert shown.startswith("recording: 2/24 scenes")
    bars: list[tuple[Any, ...]] = []

    class Bar:
        def __init__(self, *words: Any, **options: Any) -> None:
            bars.append((words, options["unit"]))

        def __enter__(self) -> Any:
            return SimpleNamespace(show=lambda done, of: None)

        def __exit__(self, *error: object) -> None:
            pass

    replace_name(monkeypatch, "LiveProgress", Bar)
    Detection().prepare(plan_of(recorded={"scenes": 5}), tmp_path, resources)
    assert bars == [(("recording", 10, 0), "scenes")]


def test_what_is_recorded() -> None:
    own = {"towns": ["Twinford"], "scenes": 3, "seconds": 1.5, "width": 320, "seed": 9}
    recording = recording_of(suite(recorded=own), Path("x"))
    assert (recording.out, recording.towns, recording.held_out) == (Path("x"), ("Twinford",), ("Twinford",))
    assert (recording.scenes, recording.seconds, recording.width, recording.seed) == (3, 1.5, 320, 9)
    assert recording.device == "cpu"


@pytest.mark.parametrize(("workers", "threads"), [(None, 1), (1, 8), (3, 2), (20, 1)])
def test_workers_share_the_cores(
    tmp_path: Path, data: list[tuple[Path, str | None]], workers: int | None, threads: int
) -> None:
    plan = plan_of()
    given = Plan(plan.kind, suite(data=str(tmp_path), version="v9"), "cpu", plan.cells, plan.inputs, {}, plan.details)
    settings = Detection().prepare(given, tmp_path / "out", quiet(workers))
    assert settings["threads"] == threads
    assert (settings["root"], settings["version"]) == (str(tmp_path), "v9")
    assert data == [(tmp_path, "v9")]


def test_boxes_that_could_not_be_found_are_forgotten_when_they_are_tried_again(
    tmp_path: Path, data: list[tuple[Path, str | None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    forgotten: list[Path] = []
    replace_name(monkeypatch, "forget_failures", forgotten.extend)
    plan = plan_of()
    given = Plan(plan.kind, suite(data=str(tmp_path)), "cpu", plan.cells, plan.inputs, {}, plan.details)
    Detection().prepare(given, tmp_path / "out", quiet(), retry=[plan.cells[2]])
    assert forgotten == [
        boxes_path(tmp_path / "out", "one", shifted_scene("fog", 3, "physical", scene)) for scene in SCENES
    ]


@pytest.mark.parametrize(
    ("severities", "shown"), [([1, 3, 5], 3), ([1, 4], 4), ([5, 2], 2), (["random"], 3), ([1, "random"], 1)]
)
def test_the_picture_shows_the_middle_severity(
    tmp_path: Path,
    data: list[tuple[Path, str | None]],
    monkeypatch: pytest.MonkeyPatch,
    severities: list[Any],
    shown: int,
) -> None:
    sheets = []

    def sheet(examination: Examination, split: str, perturbations: Any) -> str:
        sheets.append((examination, split, perturbations))
        return "sheet"

    def save(path: Path, picture: str) -> None:
        path.parent.mkdir()
        path.write_text(picture)

    replace_name(monkeypatch, "detection_sheet", sheet)
    replace_name(monkeypatch, "save_picture", save)
    plan = plan_of("cuda", severities=severities, seed=4)
    for _ in range(2):
        Detection().finish(plan, tmp_path)
    expected = Examination(tmp_path, tmp_path / "data", "v1.0-found", (("one", "one.pth"),), 4, "cuda", 1)
    assert sheets == [(expected, "val", [Shift("fog", shown)])], "made once"
    captions: Mapping[str, str] = json.loads((tmp_path / "pictures" / "pictures.json").read_text())
    assert list(captions) == ["detections.jpg"]
    assert captions["detections.jpg"].startswith("What one finds")
    assert captions["detections.jpg"].endswith(f"severity {shown}.")


def test_a_picture_of_data_that_cannot_be_read_is_left_out(
    tmp_path: Path, data: list[tuple[Path, str | None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*given: Any) -> None:
        raise FormatError("a picture is broken")

    replace_name(monkeypatch, "detection_sheet", broken)
    plan = plan_of()
    given = Plan(plan.kind, suite(data=str(tmp_path / "set")), "cpu", plan.cells, plan.inputs, {}, plan.details)
    Detection().finish(given, tmp_path)
    assert data == [(tmp_path / "set", None)]
    assert not list(tmp_path.iterdir())


def test_a_changed_data_set_is_another_run(tiny_set: Path, tmp_path: Path) -> None:
    import shutil

    root = tmp_path / "set"
    shutil.copytree(tiny_set / "v1.0-mini", root / "v1.0-mini")
    shutil.copytree(tiny_set / "maps", root / "maps")

    def about(**changes: Any) -> Any:
        return plan_of(data=str(root), split="mini_val", **changes).inputs["data"]

    first = about()
    assert {key: first[key] for key in ("version", "split")} == {"version": "v1.0-mini", "split": "mini_val"}
    assert len(first["scenes"]) == 2
    tables = ("sample", "sample_annotation", "sample_data", "calibrated_sensor")
    assert set(first) == {"version", "split", "scenes", *tables}
    assert all(len(first[name]) == 16 for name in tables)
    assert plan_of(data=str(root), split="all").inputs["data"]["split"] == "all"
    for name in tables:
        path = root / "v1.0-mini" / f"{name}.json"
        kept = path.read_text()
        path.write_text(kept + "\n")
        changed = about()
        assert [key for key in first if first[key] != changed[key]] == [name]
        path.write_text(kept)
    assert about() == first

"""Suites of kind `gap`: what runs, that drives are paired and replay to the bit, what fails alone, the page."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.run_folder import write_run
from helpers.sharing import Shared
from pydantic import ValidationError
from rich.console import Console

from ssad.core.errors import SSADError
from ssad.core.jsonl import read_lines
from ssad.core.safeio import read_json
from ssad.core.traces import load_trace
from ssad.core.types import AgentKind
from ssad.engine.kind import Cell, Plan, Resources
from ssad.engine.run import run
from ssad.experiments.gap.kind import Gap, GapSuite, conditions_of
from ssad.experiments.gap.page import cause_table, conditions, drop_table, main_table, rank_table, scatter, sheets
from ssad.experiments.runs import summary, write_report
from ssad.experiments.suites import load_suite, suite_files
from ssad.report import check_artefacts
from ssad.report.load import load_run
from ssad.scenarios.static.catalogue import registered_names
from ssad.scenarios.static.physical.textures.perturbation import Texture
from ssad.world.models import MODELS

SHORT = """
name: short
type: StraightObstacle
town: ProvingGround
route: [{x: 217.0, y: -5.25}, {x: 317.0, y: -5.25}]
limits: {max_steps: 12}
"""
TRUTH = {"name": "perfect", "detector": "truth"}
BRIGHT = {"name": "bright", "detector": "helpers.gap_detectors:Bright", "width": 64, "rate": 5.0}


def suite_of(folder: Path, *systems: dict[str, Any], **changes: Any) -> GapSuite:
    (folder / "short.yaml").write_text(SHORT)
    base: dict[str, Any] = {
        "kind": "gap",
        "name": "t",
        "systems": list(systems),
        "scenarios": [str(folder / "short.yaml")],
    }
    return GapSuite.model_validate(base | changes)


def go(plan: Plan, folder: Path, workers: int = 0) -> list[dict[str, Any]]:
    return run(plan, folder, Resources(workers, console=Console(file=io.StringIO())))


@pytest.fixture(scope="session")
def folder(shared: Shared, tmp_path_factory: pytest.TempPathFactory) -> Path:
    def make(out: Path) -> None:
        place = tmp_path_factory.mktemp("gap")
        suite = suite_of(place, TRUTH, BRIGHT, perturbations=["dropped", "blackout", "fog"], severities=[5])
        plan = Gap().plan(suite)
        go(plan, out)
        Gap().finish(plan, out)
        write_report(out)

    return shared("gap-run", make)


def test_every_condition_meets_the_same_drive(folder: Path) -> None:
    found = load_run(folder)
    told = [(line["system"], line["perturbation"], line["severity"]) for line in found.lines]
    assert told == [
        ("autopilot", "none", 0),
        ("line-of-sight", "none", 0),
        ("perfect", "none", 0),
        ("bright", "none", 0),
        ("bright", "dropped", 5),
        ("bright", "blackout", 5),
        ("bright", "fog", 5),
    ]
    assert {line["status"] for line in found.lines} == {"ok"}
    assert len({line["seed"] for line in found.lines}) == 1
    traces = [load_trace(folder / line["artefacts"]["trace"]) for line in found.lines]
    for trace in traces[1:]:
        np.testing.assert_array_equal(trace.x[0], traces[0].x[0])
    assert check_artefacts(folder) == []


def test_component_metrics_are_those_of_systems_that_look(folder: Path) -> None:
    metrics = {(one["system"], one["perturbation"]): one["metrics"] for one in load_run(folder).lines}
    assert "AP" not in metrics["autopilot", "none"]
    assert metrics["perfect", "none"]["recall"] in (None, 1.0)
    bright = metrics["bright", "none"]
    assert bright["phantoms"] == pytest.approx(1.0)  # a car that is not there, at every look
    assert metrics["bright", "blackout"]["phantoms"] < 1.0
    assert metrics["bright", "dropped"]["phantoms"] < 1.0
    # it is held up by its phantom
    assert bright["driven"] < metrics["autopilot", "none"]["driven"]


def test_a_cell_replays_to_the_bit(folder: Path) -> None:
    found = load_run(folder)
    plan = Gap().plan(GapSuite.model_validate(found.suite))
    for number in (2, 5):
        record = next(line for line in found.lines if line["key"] == plan.cells[number].key)
        again = plan.kind.replay(plan, plan.cells[number], record, folder)
        assert again.difference is None
        if number == 2:  # a perfect detector has no pictures
            assert again.film is None
            continue
        assert again.film is not None
        frames = list(again.film[0])
        assert len(frames) == 7  # 1.2 s, every 0.2 s
        assert len({frame.shape for frame in frames}) == 1
        left, right = frames[4][:, : frames[4].shape[1] // 2], frames[4][:, frames[4].shape[1] // 2 :]
        assert left.shape == right.shape
        assert left[40:300, :300].mean() > right[40:300, :300].mean() + 20  # clean beside blacked out


def test_the_page_has_tables_a_figure_and_drives(folder: Path) -> None:
    found = load_run(folder)
    text = (folder / "report.html").read_text()
    assert [len(t(found).rows) for t in (main_table, drop_table, rank_table, cause_table)] == [7, 3, 2, 0]
    assert len(conditions(found)) == 7
    shown = sheets(found)
    assert 0 < len(shown) <= 6
    assert shown[0]["data"] in text
    assert "What a perturbation changes" in text
    assert (folder / "tables" / "changes.csv").is_file()
    assert summary(folder).rows
    assert scatter(found) == "" or "<svg" in scatter(found)


def test_copies_change_no_table(folder: Path, tmp_path: Path) -> None:
    """Equal drives are one case: a run with each of its lines three times has the same estimates and intervals."""
    header, lines = read_json(folder / "run.json"), read_lines(folder / "results.jsonl")
    copies = [line | {"key": f"{line['key']}{k}"} for k in range(2) for line in lines]
    written = {}
    for name, told in (("plain", lines), ("copied", [*lines, *copies])):
        run = write_run(tmp_path / name, header, told, read_lines(folder / "episodes.jsonl"))
        write_report(run)
        written[name] = {path.name: path.read_bytes() for path in (run / "tables").iterdir()}
    assert written["plain"]
    assert written["copied"] == written["plain"]


def test_a_collision_goes_where_the_object_that_was_hit_is_found(tmp_path: Path) -> None:
    nothing = BRIGHT | {"name": "nothing", "detector": "helpers.gap_detectors:Nothing"}
    suite = suite_of(tmp_path, nothing, ceilings=[], scenarios=["StraightObstacle/00"], sheets=0)
    (line,) = go(Gap().plan(suite), tmp_path / "out")
    assert line["metrics"]["collision"]
    assert line["cause"]["cause"] == "missed"
    assert line["repaired"] == {"collision": False, "same": False}
    (row,) = cause_table(load_run(tmp_path / "out")).rows
    assert [cell.mean for cell in row.cells[:3]] == [1.0, 0.0, 1.0]
    assert row.cells[-1].mean == 1.0


def rows_of(cells: Sequence[Cell]) -> list[tuple[str, int, str]]:
    """Return perturbation, severity and scenario of each cell; scenarios of a file by the name in it."""
    scenarios = [cell.spec["scenario"] for cell in cells]
    names = [scenario["name"] if isinstance(scenario, dict) else scenario for scenario in scenarios]
    return [
        (cell.fields["perturbation"], cell.fields["severity"], name) for cell, name in zip(cells, names, strict=True)
    ]


def test_a_texture_is_worn_where_there_is_a_car(tmp_path: Path) -> None:
    names = ["grey", "das-yolov5n-twinford"]
    suite = suite_of(tmp_path, BRIGHT, ceilings=[], perturbations=names, severities=[2, 5])
    scenarios = [*suite.scenarios, "LaneChanging/00"]
    mixed = suite.model_copy(update={"scenarios": scenarios})
    cells = Gap().plan(mixed).cells
    assert rows_of(cells) == [
        ("none", 0, "short"),
        ("none", 0, "LaneChanging/00"),
        ("grey", 1, "LaneChanging/00"),
        ("das-yolov5n-twinford", 1, "LaneChanging/00"),
    ]
    assert registered_names()["grey"] == "texture"
    cars = sorted(name for name, model in MODELS.items() if model.kind == AgentKind.CAR)
    for name in (name for name, family in registered_names().items() if family == "texture"):
        for model in cars[::4]:
            mesh, edit = Texture(name).agent_edit(1).body(model)
            assert len(mesh.faces) > 100
            assert len(edit.textures) == 1
    assert cells[2].spec["target"] == 1
    lit = suite_of(
        tmp_path,
        BRIGHT,
        ceilings=[],
        perturbations=["night", "laser", "shadow"],
        severities=[2, 5],
        scenarios=scenarios,
    )
    assert rows_of(Gap().plan(lit).cells[2:]) == [
        ("night", 1, "short"),
        ("night", 1, "LaneChanging/00"),
        ("laser", 2, "LaneChanging/00"),
        ("laser", 5, "LaneChanging/00"),
        ("shadow", 1, "LaneChanging/00"),
    ]
    assert Texture("grey").version() == ""
    assert len(Texture("das-yolov5n-twinford").version()) == 64


def test_a_detector_that_returns_nan_fails_its_drives_alone(tmp_path: Path) -> None:
    spoilt = BRIGHT | {"name": "spoilt", "detector": "helpers.gap_detectors:Spoilt"}
    records = go(Gap().plan(suite_of(tmp_path, TRUTH, spoilt, ceilings=[])), tmp_path / "out")
    assert [one["status"] for one in records] == ["ok", "failed"]
    assert "not finite" in records[1]["reason"]
    write_report(tmp_path / "out")
    assert "not finite" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "status"), [("Dying", "crashed"), ("Hanging", "timeout")])
def test_a_detector_that_dies_or_hangs_fails_its_drives_alone(tmp_path: Path, name: str, status: str) -> None:
    broken = BRIGHT | {"name": "broken", "detector": f"helpers.gap_detectors:{name}"}
    suite = suite_of(tmp_path, broken, BRIGHT, ceilings=[], timeout_s=90.0)
    records = go(Gap().plan(suite), tmp_path / "out", workers=1)
    assert [one["status"] for one in records] == [status, "ok"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"perturbations": ["fogg"]}, "fog"),
        ({"severities": [6]}, "less than or equal to 5"),
        ({"perturbations": ["fog", {"fog": 3}]}, "fog appears twice at severity 3"),
        ({"perturbations": ["apgd?steps=1"]}, "steps must be 2 or more"),
        ({"systems": [TRUTH, TRUTH]}, "twice"),
        ({"systems": [BRIGHT | {"detector": "yolov5x"}]}, "yolov5"),
        ({"ceilings": ["autopilo"]}, "autopilot"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    with pytest.raises((SSADError, ValidationError), match=words):
        Gap().plan(suite_of(tmp_path, TRUTH, **changes))


def test_settings_out_of_range_are_refused(tmp_path: Path) -> None:
    for wrong in ({"confirm": 0}, {"missed": 1.0}, {"cameras": ["CAM"]}, {"rate": 0.0}):
        with pytest.raises(ValidationError):
            suite_of(tmp_path, TRUTH | wrong)


def test_the_suites_that_are_shipped_can_be_planned() -> None:
    names = [name for name in suite_files() if name.startswith("gap")]
    assert "gap-quick" in names
    for name in names:
        suite = load_suite(name)
        assert isinstance(suite, GapSuite)
        assert {entry.name for entry in suite.perturbations} <= set(registered_names())


def test_the_suite_has_conditions_enough_for_its_rank_correlation() -> None:
    suite = load_suite("gap")
    assert isinstance(suite, GapSuite)
    for system in (one for one in suite.systems if not one.is_perfect):
        perturbed = [one.perturbation for one in conditions_of(suite) if one.system == system and one.perturbation]
        under = [(perturbation.name, perturbation.severity) for perturbation in perturbed]
        assert len(under) == len(set(under)) >= 40
        assert len({name for name, _ in under}) >= 15

"""The page of the gap's results: what is stored of a run, which conditions are singled out, which drives show them."""

from __future__ import annotations

import json
import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from helpers.run_folder import write_run

from ssad.drivers.perceiving.system import PerceivingSystem
from ssad.experiments.gap.page import scatter, sign_table
from ssad.report.load import load_run

ROOT = Path(__file__).parents[2]
DRIVES = 40


def line(condition: tuple[str, int], drive: int, ap: float, *, crash: bool) -> dict[str, Any]:
    name, severity = condition
    return {
        "key": f"{name}{severity}-{drive}",
        "system": "s",
        "perturbation": name,
        "severity": severity,
        "family": "shift",
        "cluster": f"d{drive}",
        "group": "Twinford",
        "case": f"{name}{severity}{drive}",
        "status": "ok",
        "reason": "",
        "spec": {"repetition": 0},
        "n": 1,
        "metrics": {
            "AP": ap,
            "collision": crash,
            "route_completion": 1.0 - 0.5 * crash,
            "target_recall": ap,
            "recall": 0.7 + 0.2 * (drive % 2),
            "missed_burst": 2.0 + drive % 2,
            "phantoms": 0.1,
        },
        "cause": {"cause": "missed", "unknown_s": 1.0} if crash else None,
        "repaired": {"collision": False, "same": drive % 2 == 0} if crash else None,
    }


@pytest.fixture
def page(tmp_path: Path) -> dict[str, Any]:
    """The module, with a run: fog takes much AP and harms nobody, dirt little and harms many, rain both."""
    lines = []
    for name, severity, share, crashes in (
        ("none", 0, 1.0, 1),
        ("fog", 5, 0.4, 1),
        ("dirt", 3, 0.95, 13),
        ("rain", 5, 0.3, 9),
        ("snow", 1, 0.97, 3),
    ):
        for drive in range(DRIVES):
            ap = share * (0.5 + 0.01 * drive)
            lines.append(line((name, severity), drive, ap, crash=drive < crashes))
    header = {"kind": "gap", "suite": {"kind": "gap", "name": "x", "sheets": 0}, "command": "ssad run x"}
    write_run(tmp_path / "run", header, lines)
    module = runpy.run_path(str(ROOT / "benchmarks" / "gap_page.py"))
    module["keep"].__globals__["RESULTS"] = tmp_path / "stored"
    module["keep"]("damage", tmp_path / "run")
    return module


def test_a_run_of_other_weights_than_those_that_ship_is_told(page: dict[str, Any], tmp_path: Path) -> None:
    """A perfect detector has no weights; those of the other are named in the run."""
    truth, found = PerceivingSystem(name="truth", detector="truth"), PerceivingSystem(name="a", detector="yolov5n")
    suite = {"kind": "gap", "name": "x", "systems": [one.model_dump() for one in (truth, found)]}
    for known, said in ((found.version, []), ("0" * 12, ["yolov5n"])):
        header = {"kind": "gap", "suite": suite, "systems": {"truth": truth.version, "a": known}, "command": "x"}
        write_run(tmp_path / known, header, [line(("none", 0), 0, 0.5, crash=False)])
        assert page["outdated"](load_run(tmp_path / known)) == said


def test_a_later_run_adds_its_conditions_and_replaces_those_it_drove_again(
    page: dict[str, Any], tmp_path: Path
) -> None:
    lines = [line(condition, 0, 0.25, crash=False) for condition in (("fog", 5), ("fog", 3))]
    suite = {"kind": "gap", "name": "x", "sheets": 0}
    header = {"kind": "gap", "suite": suite, "command": "ssad run x --later", "versions": {"device": "cpu"}}
    write_run(tmp_path / "more", header, lines)
    before = page["stored"]("damage")
    page["keep"]("damage", tmp_path / "more", add=True)
    after = page["stored"]("damage")
    count = {
        c: len([one for one in after.lines if page["_condition"](one) == c])
        for c in map(page["_condition"], after.lines)
    }
    assert count == {("s", name, k): DRIVES for name, k in (("none", 0), ("dirt", 3), ("rain", 5), ("snow", 1))} | {
        ("s", "fog", 5): 1,
        ("s", "fog", 3): 1,
    }
    part = page["change"](after, ("s", "fog", 5), "collision")
    assert (part.n, part.failed) == (1, 0), "drives that a condition does not have have not failed"
    assert f"in 2 runs, {4 * DRIVES + 2} of {5 * DRIVES} drives" in page["_measured"](after)
    assert "drives on an unknown device and cpu" in page["_measured"](after)
    assert after.command == before.command
    assert "runs" not in page["_measured"](before).replace("ssad run", "")


def test_the_two_conditions_that_break_the_rule_are_singled_out(page: dict[str, Any]) -> None:
    run = page["stored"]("damage")
    assert page["harmless"](run) == ("s", "fog", 5)
    assert page["harmful"](run) == ("s", "dirt", 3)
    assert page["lost_share"](run, ("s", "fog", 5)) == pytest.approx(0.6)
    told = page["picked"](run)
    # most AP is lost where there was most; a collision that goes with its error comes first, d0 collides anyway
    assert told[1:3] == ["fog5-39", "fog5-38"]
    assert [int(key.partition("-")[2]) % 2 for key in told[4:]] == [1, 1]
    assert "dirt3-0" not in told


def test_conditions_that_were_stopped_early_are_named_and_single_nothing_out(page: dict[str, Any]) -> None:
    run = page["stored"]("damage")
    assert page["fewer"](run) == ""
    kept: dict[str, int] = {"dirt": DRIVES // 2, "fog": DRIVES // 2}
    lines = []
    for one in run.lines:
        kept[one["perturbation"]] = kept.get(one["perturbation"], DRIVES) - 1
        if kept[one["perturbation"]] >= 0:
            lines.append(one)
    cut = replace(run, lines=tuple(lines))
    assert page["fewer"](cut) == f" With fewer than {DRIVES} drives: `fog` 5: {DRIVES // 2}, `dirt` 3: {DRIVES // 2}."
    assert {c[1] for c in page["mostly_driven"](cut)} == {"snow", "rain"}
    assert page["harmful"](cut) != page["harmful"](run)


def test_the_page_is_made_of_what_is_stored(page: dict[str, Any], tmp_path: Path) -> None:
    run = page["stored"]("damage")
    text = "\n".join(page["page"]())
    assert f"{5 * DRIVES} of {5 * DRIVES} drives" in text
    assert "`fog` 5: 60% of the AP, phantoms a look +0.00" in text
    assert "CR +0.000" in text
    assert "the interval does not lie inside ±0.03" in text  # 40 drives are too few for that
    assert "`dirt` 3: 5% of the AP, phantoms a look +0.00" in text
    assert "CR +0.300" in text
    assert "the interval excludes 0. Of its 13 collisions 6 go with" in text
    assert "### Without perturbations" not in text
    page["figure"](run, tmp_path / "gap.png")
    assert (tmp_path / "gap.png").read_bytes()[:4] == b"\x89PNG"
    stored = (tmp_path / "stored" / "damage.json").read_text()
    assert json.loads(stored)["cells"] == 5 * DRIVES


def test_how_a_detector_fails_is_told_as_settings(page: dict[str, Any]) -> None:
    (row,) = page["failing_table"](page["stored"]("damage")).rows
    assert [cell.text for cell in row.cells] == ["0.20", "2.50", "0.10"]
    assert row.cells[0].low < 0.2 < row.cells[0].high


def test_the_figure_of_a_run_names_points_where_there_is_room(page: dict[str, Any], tmp_path: Path) -> None:
    picture = scatter(load_run(tmp_path / "run"))
    assert picture.count("<circle") == 4 + 1  # a point a condition, and the legend of one family
    for name in ("fog 5", "dirt 3", "rain 5"):
        assert f">{name}</text>" in picture
    assert "s, snow 1: AP -0.0" in picture  # told when hovered over


def test_stop_signs_have_a_table_where_they_were_read(page: dict[str, Any], tmp_path: Path) -> None:
    run = load_run(tmp_path / "run")
    assert sign_table(run).rows == ()
    for number, line_ in enumerate(run.lines):
        if line_["perturbation"] == "fog":
            line_["metrics"].update(
                sign_recall=0.5, sign_recall_5_20=float(number % 2), sign_recall_20_40=None, stop_signs=1.0
            )
        elif line_["perturbation"] == "none":
            line_["metrics"]["stop_signs"] = 0.25
    (row,) = sign_table(run).rows
    assert row.head == ("s", "fog", "5")
    assert row.cells[0].mean == pytest.approx(0.5)
    assert row.cells[1].text == "n/a"
    assert (row.cells[3].text, row.cells[4].text) == ("1.00", "0.75")

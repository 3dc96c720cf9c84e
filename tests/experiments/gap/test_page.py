"""Page of a gap run: its figure, stop signs, errors of detectors and what perception costs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.run_folder import write_run

from ssad.experiments.gap.page import (
    ceiling_table,
    error_table,
    lane_courses,
    lane_table,
    scatter,
    section,
    sign_table,
)
from ssad.report.load import Run, load_run

DRIVES = 40


def line(condition: tuple[str, int], drive: int, ap: float, *, crash: bool, system: str = "s") -> dict[str, Any]:
    name, severity = condition
    return {
        "key": f"{system}-{name}{severity}-{drive}",
        "system": system,
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
    }


def ceiling_line(drive: int) -> dict[str, Any]:
    """A drive of a system without a detector, which collides in the first one."""
    record = line(("none", 0), drive, 0.0, crash=drive < 1, system="line-of-sight")
    return record | {"metrics": {"collision": drive < 1, "route_completion": 1.0}}


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Fog takes much AP and harms nobody, dirt little and harms many, rain both."""
    lines = []
    for name, severity, share, crashes in (
        ("none", 0, 1.0, 5),
        ("fog", 5, 0.4, 5),
        ("dirt", 3, 0.95, 17),
        ("rain", 5, 0.3, 13),
        ("snow", 1, 0.97, 7),
    ):
        for drive in range(DRIVES):
            ap = share * (0.5 + 0.01 * drive)
            lines.append(line((name, severity), drive, ap, crash=drive < crashes))
    lines += [ceiling_line(drive) for drive in range(DRIVES)]
    suite = {"kind": "gap", "name": "x", "sheets": 0, "ceilings": ["autopilot", "line-of-sight"]}
    return load_run(write_run(tmp_path / "run", {"kind": "gap", "suite": suite, "command": "ssad run x"}, lines))


def test_errors_of_a_detector_are_settings_of_a_perfect_one(run: Run) -> None:
    table = error_table(run)
    assert table.columns == ("missed", "burst", "phantoms")  # distances were not measured
    (row,) = table.rows  # systems without a detector have no errors
    assert [cell.text for cell in row.cells] == ["0.20", "2.50", "0.10"]
    assert row.cells[0].low < 0.2 < row.cells[0].high


def test_systems_are_compared_with_the_ceilings_that_ran(run: Run) -> None:
    table = ceiling_table(run)
    assert table.columns == ("CR less line-of-sight", "RC less line-of-sight")
    (row,) = table.rows
    assert row.head == ("s",)
    assert [cell.mean for cell in row.cells] == pytest.approx([4 / DRIVES, -2.5 / DRIVES])
    assert row.cells[0].low < 4 / DRIVES < row.cells[0].high
    text, tables = section(run)
    assert [one.name for one in tables] == ["gap", "changes", "rank", "causes", "ceilings", "errors"]
    assert "CR less line-of-sight" in text


def test_a_run_without_ceilings_and_detectors_has_neither_table(tmp_path: Path) -> None:
    lines = [ceiling_line(drive) for drive in range(5)]
    header = {"kind": "gap", "suite": {"kind": "gap", "name": "x"}, "command": "ssad run x"}
    found = load_run(write_run(tmp_path / "run", header, lines))
    assert ceiling_table(found).rows == ()
    assert error_table(found).rows == ()


def test_the_figure_of_a_run_names_points_where_there_is_room(run: Run) -> None:
    picture = scatter(run)
    assert picture.count("<circle") == 4 + 1  # a point a condition, and the legend of one family
    for name in ("fog 5", "dirt 3", "rain 5"):
        assert f">{name}</text>" in picture
    assert "s, snow 1: AP -0.0" in picture  # told when hovered over


def test_stop_signs_have_a_table_where_they_were_read(run: Run) -> None:
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


def test_lane_keepers_have_a_table_and_a_figure(run: Run, tmp_path: Path) -> None:
    assert lane_table(run).rows == ()
    assert lane_courses(run) == ""
    lines = []
    for name, severity, largest in (("none", 0, 0.2), ("dirty-road", 1, 3.0)):
        record = line((name, severity), 0, 0.5, crash=False)
        is_led_astray = severity > 0
        lane_metrics = {
            "off_road": 0.0,
            "distance_to_route": 0.1,
            "lane_deviation": 0.1,
            "lane_deviation_max": largest,
            "lane_departure": float(is_led_astray),
            "departure_time": 1.5 if is_led_astray else None,
            "lane_error": 0.1,
            "lane_detection_rate": 1.0,
        }
        course = {"along": [0.0, 2.0], "deviation": [0.0, largest], "margin": [0.8, 0.8]}
        spec = {"repetition": 0, "scenario": {"name": "road"}}
        lines.append(record | {"metrics": record["metrics"] | lane_metrics, "lane": course, "spec": spec})
    suite = {"kind": "gap", "name": "x", "sheets": 0, "ceilings": []}
    steered = load_run(write_run(tmp_path / "steered", {"kind": "gap", "suite": suite, "command": "ssad run x"}, lines))
    table = lane_table(steered)
    assert [row.head[1:] for row in table.rows] == [("none", ""), ("dirty-road", "1")]
    by_name = dict(zip(table.columns, table.rows[1].cells, strict=True))
    assert by_name["leaves the lane"].mean == 1.0
    assert by_name["after, s"].mean == 1.5
    assert by_name["at most, m"].mean == 3.0
    text, tables = section(steered)
    assert "lanes" in [one.name for one in tables]
    assert "dirty-road" in lane_courses(steered)
    assert "Deviation from the middle of the lane along the route" in text

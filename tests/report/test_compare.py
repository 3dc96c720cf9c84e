"""Two runs beside each other: differences by hand, pairs by name, what changed, and runs that cannot be compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from helpers.run_folder import GROUPS, driving_line, write_lines, write_run
from typer.testing import CliRunner

from ssad.cli import app
from ssad.core.errors import ConfigError, StoreError
from ssad.report.compare import compare_runs, write_comparison
from ssad.report.load import load_run


def driving_run(folder: Path, *, hits: int, system: str = "a", routes: int = 5, **header: Any) -> Path:
    """One system in the eight scenarios, `routes` routes each; the first `hits` episodes end in a collision."""
    lines = []
    for g, group in enumerate(GROUPS):
        for route in range(routes):
            number = g * routes + route
            cluster = f"{group}/0{route}"
            lines.append(driving_line(f"{folder.name}{number}", group, cluster, system=system, collision=number < hits))
    cells = [{"key": line["key"], "name": f"{system}/{line['cluster']}"} for line in lines]
    return write_run(folder, {"kind": "driving", "cells": cells, "suite": {"seed": 0}, **header}, lines)


def scores(folder: Path, value: float, *, seed: int = 0, detector: str = "d") -> Path:
    """A run of another kind: one detector under two shifts, with replicates of ten scenes."""
    lines = [
        {
            "key": f"{folder.name}{shift}",
            "detector": detector,
            "status": "ok",
            "reason": "",
            "n": 60,
            "scenes": 10,
            "metrics": {"mAP": value - k / 10},
            "artefacts": {},
            "spec": {},
            "replicates": {"mAP": [value - k / 10 + d / 100 for d in range(-9, 10)]},
        }
        for k, shift in enumerate(("fog", "rain"))
    ]
    cells = [
        {"key": line["key"], "name": f"{detector}/{shift}"} for line, shift in zip(lines, ("fog", "rain"), strict=True)
    ]
    header = {"kind": "detection", "cells": cells, "suite": {"seed": seed}, "columns": [{"name": "mAP"}]}
    return write_run(folder, header, lines)


def test_differences_are_paired_by_name(tmp_path: Path):
    first, second = driving_run(tmp_path / "one", hits=8), driving_run(tmp_path / "two", hits=18, code="new")
    (found,) = compare_runs([first, second])
    rows = {row.head: row.cells for row in found.table.rows}
    before, now, difference, p = rows["a", "all", "CR"]
    assert (before.mean, now.mean, difference.mean, difference.n) == (8 / 40, 18 / 40, pytest.approx(0.25), 40)
    assert 0.0 < difference.low < 0.25 < difference.high < 1.0
    assert p.mean == pytest.approx(2 * 0.5**10)
    assert (found.both, found.equal, found.only, found.remarks) == (40, 30, (0, 0), [])
    assert found.changes == ("code: nothing → new",)
    assert found.findings == (
        f"a: CR 0.20 → 0.45 ({difference.text} {difference.interval}): larger than chance explains.",
    )
    assert found.verdicts[0] == f"a/{GROUPS[1]}/03: no collision before, collision now"
    assert len(found.verdicts) == 10
    assert found.groups is not None
    group = {row.head: row.cells for row in found.groups.rows}["a", GROUPS[1], "CR"]
    assert [cell.mean for cell in group[:3]] == [0.6, 1.0, pytest.approx(0.4)]


def test_what_one_run_alone_measures_makes_no_cell_unequal_and_equal_runs_have_no_finding(tmp_path: Path):
    first, second = driving_run(tmp_path / "one", hits=8), driving_run(tmp_path / "two", hits=8)
    lines = [json.loads(line) for line in (second / "results.jsonl").read_text().splitlines()]
    for line in lines:
        line["metrics"] |= {"avoidable": 1.0, "time": None}
    write_lines(second, lines)
    (found,) = compare_runs([first, second])
    assert (found.both, found.equal) == (40, 40)
    assert found.findings == ("No difference is larger than chance explains.",)


def test_a_failed_cell_is_no_pair_and_is_named(tmp_path: Path):
    first, second = driving_run(tmp_path / "one", hits=8), driving_run(tmp_path / "two", hits=8)
    lines = [json.loads(line) for line in (second / "results.jsonl").read_text().splitlines()]
    lines[0] |= {"status": "timeout", "reason": "slow", "metrics": {}}
    write_lines(second, lines[:-1])
    (found,) = compare_runs([first, second])
    difference = next(row.cells[2] for row in found.table.rows if row.head[2] == "CR")
    assert (difference.n, difference.failed, difference.mean) == (38, 2, 0.0)
    assert found.verdicts == (f"a/{GROUPS[0]}/00: collision before, timeout now",)
    assert (found.both, found.only) == (39, (1, 0))


def test_two_runs_of_one_system_each_are_compared_whatever_they_are_called(tmp_path: Path):
    first = driving_run(tmp_path / "one", hits=40, system="blind")
    second = driving_run(tmp_path / "two", hits=0, system="mine")
    (found,) = compare_runs([first, second])
    assert found.table.rows[0].head == ("blind → mine", "all", "CR")
    assert found.table.rows[0].cells[2].mean == -1.0


def two_systems(folder: Path, **hits: int) -> Path:
    """A run of several systems, with a number of collisions each."""
    parts = [driving_run(folder / name, hits=count, system=name) for name, count in hits.items()]
    lines = [json.loads(line) for part in parts for line in (part / "results.jsonl").read_text().splitlines()]
    cells = [cell for part in parts for cell in load_run(part).header["cells"]]
    return write_run(folder / "both", {"kind": "driving", "cells": cells, "suite": {"seed": 0}}, lines)


def test_systems_of_one_run_are_compared_by_name(tmp_path: Path):
    folder = two_systems(tmp_path, autopilot=8, mine=18)
    (comparison,) = compare_runs([folder], ["autopilot=mine"])
    assert comparison.table.rows[0].head == ("autopilot → mine", "all", "CR")
    assert comparison.table.rows[0].cells[2].mean == pytest.approx(0.25)
    assert comparison.findings[0].startswith("autopilot → mine: CR 0.20 → 0.45")
    assert comparison.remarks == []
    shown = CliRunner().invoke(
        app, ["compare", str(folder), "--pair", "mine=autopilot", "--out", str(tmp_path / "out")]
    )
    assert shown.exit_code == 0, shown.output
    assert "mine → autopilot" in shown.output


def test_what_only_one_run_has_is_said_first(tmp_path: Path):
    first = two_systems(tmp_path / "one", blind=40, autopilot=8)
    second = two_systems(tmp_path / "two", blind=40, mine=0)
    (comparison,) = compare_runs([first, second])
    assert comparison.remarks == [
        f"Only {comparison.first.label} has autopilot: compared with nothing.",
        f"Only {comparison.second.label} has mine: compared with nothing.",
        "To compare two systems of different names: --pair autopilot=mine.",
    ]
    shown = CliRunner().invoke(app, ["compare", str(first), str(second), "--out", str(tmp_path / "out")]).output
    assert shown.index("compared with nothing") < shown.index("blind"), "before the table, which names who is compared"
    (paired,) = compare_runs([first, second], ["autopilot=mine", "blind=blind"])
    assert [row.head[0] for row in paired.table.rows if row.head[2] == "CR"] == ["autopilot → mine", "blind"]
    assert paired.remarks == []


@pytest.mark.parametrize("pair", ["mine=nobody", "mine", "=mine", "autopilot"])
def test_a_pair_that_a_run_lacks_is_refused(pair: str, tmp_path: Path):
    folder = two_systems(tmp_path, autopilot=8, mine=18)
    with pytest.raises(ConfigError, match="FIRST one of autopilot, mine"):
        compare_runs([folder], [pair])


def test_names_of_a_pair_may_hold_settings(tmp_path: Path):
    first = driving_run(tmp_path / "one", hits=8, system="mine:Mine?reach=20")
    second = driving_run(tmp_path / "two", hits=8, system="mine:Mine?reach=40")
    (comparison,) = compare_runs([first, second], ["mine:Mine?reach=20=mine:Mine?reach=40"])
    assert comparison.both == 40


def test_a_difference_that_failed_cells_may_explain_is_no_finding(tmp_path: Path):
    """Ten cells more collide, and eleven of those that did not have failed: they may have been as bad."""
    first, second = driving_run(tmp_path / "one", hits=8), driving_run(tmp_path / "two", hits=18)
    assert "chance" in compare_runs([first, second])[0].findings[0]
    lines = [json.loads(line) for line in (first / "results.jsonl").read_text().splitlines()]
    for line in lines[18:]:
        line |= {"status": "failed", "reason": "hung", "metrics": {}}
    write_lines(first, lines)
    (comparison,) = compare_runs([first, second])
    difference = next(row.cells[2] for row in comparison.table.rows if row.head[2] == "CR")
    assert difference.low < 0.0 < difference.mean < difference.high
    assert not any("CR" in sentence for sentence in comparison.findings)


def test_scores_are_paired_by_their_replicates(tmp_path: Path):
    first, second = scores(tmp_path / "one", 0.4), scores(tmp_path / "two", 0.5)
    (found,) = compare_runs([first, second])
    (fog, rain) = found.table.rows
    assert (fog.head, rain.head) == (("d", "fog", "mAP"), ("d", "rain", "mAP"))
    # each resample differs by the same 0.1, so there is no doubt about it, though each score alone is uncertain
    assert (fog.cells[2].low, fog.cells[2].high) == (pytest.approx(0.1, abs=1e-3), pytest.approx(0.1, abs=1e-3))
    assert fog.cells[3].mean == pytest.approx(2 / 20)
    assert found.groups is None
    (other,) = compare_runs([first, scores(tmp_path / "three", 0.5, seed=1)])
    assert other.table.rows[0].cells[2].interval == ""
    assert other.table.rows[0].cells[3].text == "n/a"


def test_a_page_and_tables_are_written(tmp_path: Path):
    folders = [driving_run(tmp_path / name, hits=hits) for name, hits in (("one", 8), ("two", 18), ("three", 0))]
    page, found = write_comparison(folders, tmp_path / "out")
    text = page.read_text()
    assert "Replays side by side" not in text, "these runs have none"
    assert "two beside one" in text
    assert "three beside one" in text
    assert [each.table.name for each in found] == ["difference", "difference_2"]
    assert (tmp_path / "out" / "tables" / "difference_2_groups.csv").is_file()
    again = CliRunner().invoke(app, ["compare", *map(str, folders), "--out", str(tmp_path / "out")])
    assert again.exit_code == 0, again.output
    assert "10 with another outcome" in again.output
    assert page.read_text() == text


def test_runs_that_cannot_be_compared(tmp_path: Path):
    first = driving_run(tmp_path / "one", hits=8)
    with pytest.raises(ConfigError, match="two results folders"):
        compare_runs([first])
    with pytest.raises(ConfigError, match="with itself"):
        compare_runs([first, first])
    with pytest.raises(ConfigError, match="different kinds"):
        compare_runs([first, scores(tmp_path / "scores", 0.4)])
    lines = [json.loads(line) for line in (first / "results.jsonl").read_text().splitlines()]
    header = dict(load_run(first).header) | {"cells": [{"key": line["key"], "name": line["key"]} for line in lines]}
    with pytest.raises(ConfigError, match="shares no cell"):
        compare_runs([first, write_run(tmp_path / "renamed", header, lines)])


def test_records_of_another_shape_are_refused_in_a_line(tmp_path: Path):
    first, second = driving_run(tmp_path / "one", hits=8), driving_run(tmp_path / "two", hits=8)
    lines = [json.loads(line) for line in (second / "results.jsonl").read_text().splitlines()]
    for name, value in (("spec", {}), ("spec", {"scenario": []}), ("metrics", None)):
        write_lines(second, [line | {name: value} for line in lines])
        with pytest.raises(StoreError, match=r"one or .*two: its records are not those of kind driving: \w+Error"):
            write_comparison([first, second], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_header_without_a_suite_has_a_title(tmp_path: Path):
    folder = driving_run(tmp_path / "one", hits=8, suite=None, command=None)
    assert load_run(folder).title == "SSAD"

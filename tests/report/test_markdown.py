"""`ssad report DIR... --markdown`: the tables, and the commands, versions and numbers of cases behind them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from helpers.command import ssad
from helpers.run_folder import driving_lines, write_run

from ssad.experiments.runs import write_report


def folder_of(folder: Path, lines: list[dict[str, Any]], planned: list[dict[str, Any]], **header: Any) -> Path:
    about = {
        "identity": "1",
        "suite": {"name": "s", "title": "A suite", "description": "About it."},
        "kind": "driving",
        "code": "c0de",
        "versions": {"ssad": "0.1.0", "torch": "2.15.0", "device": "cpu"},
        "weights": {"detector": "beef", "none": ""},
        "cells": [{"key": line["key"], "name": f"name of {line['key']}"} for line in planned],
        **header,
    }
    return write_run(folder, about, lines)


def test_a_page_has_all_tables_and_says_where_the_numbers_come_from(tmp_path: Path) -> None:
    lines = [line | {"versions": {"device": "cpu"}} for line in driving_lines()]
    folder = folder_of(tmp_path / "run", lines, lines, command="ssad run s")
    done = ssad("report", folder, "--markdown")
    assert done.returncode == 0
    page = done.stdout
    assert page.startswith("# A suite\n\nAbout it.\n\n* ")
    assert not (folder / "report.html").exists()
    write_report(folder)
    for table in (folder / "tables").glob("*.md"):
        assert table.read_text().strip() in page
    failed = [line for line in lines if line["status"] != "ok"]
    assert "```\nssad run s\n```" in page
    assert "* Software: SSAD 0.1.0 (code c0de), torch 2.15.0." in page
    assert "* Weights: `detector` beef." in page
    assert f"* Cells: {len(lines) - len(failed)} of {len(lines)}, {len(lines) - len(failed)} on cpu." in page
    assert f"* Failed ({failed[0]['reason'] or failed[0]['status']}): `name of {failed[0]['key']}`." in page
    assert "\n\nn = " in page


def test_runs_are_joined_and_missing_cells_are_named(tmp_path: Path) -> None:
    lines = driving_lines()
    first = folder_of(tmp_path / "a", lines[:5], lines, command="ssad run s --device cpu")
    second = folder_of(tmp_path / "b", lines[5:-1], lines, command="ssad run s --device cuda")
    page = ssad("report", first, second, "--markdown").stdout
    assert "```\nssad run s --device cpu\nssad run s --device cuda\n```" in page
    assert f"* Not run: `name of {lines[-1]['key']}`." in page
    whole = folder_of(tmp_path / "c", lines[:-1], lines, command="ssad run s")
    tables = page.partition("\n## ")[2]
    assert tables
    assert tables == ssad("report", whole, "--markdown").stdout.partition("\n## ")[2]


def test_runs_of_several_suites_end_in_one_line(tmp_path: Path) -> None:
    lines = driving_lines()[:2]
    first = folder_of(tmp_path / "a", lines, lines)
    header = json.loads((first / "run.json").read_text()) | {"suite": {"name": "t"}}
    second = write_run(tmp_path / "b", header, lines)
    done = ssad("report", first, second, "--markdown")
    assert done.returncode == 2
    assert "is a run of the suite t, not of s" in done.stderr
    assert done.stderr.count("\n") == 1


def test_reports_of_several_folders_are_written(tmp_path: Path) -> None:
    lines = driving_lines()[:2]
    folders = [folder_of(tmp_path / name, lines, lines) for name in "ab"]
    done = ssad("report", *folders)
    assert done.returncode == 0
    assert [(folder / "report.html").is_file() for folder in folders] == [True, True]
    assert done.stdout.count("report: ") == 2

"""Slices of a suite that ran in several folders are one run: its cells, records, versions and commands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.run_folder import driving_lines, write_run

from ssad.core.errors import ConfigError
from ssad.report.join import join_runs
from ssad.report.load import Run, load_run


def part(folder: Path, lines: list[dict[str, Any]], prefix: str = "", **header: Any) -> Run:
    """A run of these lines; keys with a prefix are those of another device, the names are the same."""
    named = [line | {"key": prefix + line["key"]} for line in lines]
    cells = [{"key": line["key"], "name": line["key"].removeprefix(prefix)} for line in named]
    about = {"suite": {"name": "s"}, "kind": "driving", "command": f"ssad run s {prefix}", "cells": cells, **header}
    return load_run(write_run(folder, about, named))


def test_slices_add_up_to_the_whole_run(tmp_path: Path) -> None:
    lines = driving_lines()
    half = len(lines) // 2
    whole = part(tmp_path / "whole", lines)
    run = join_runs([part(tmp_path / "a", lines[:half]), part(tmp_path / "b", lines[half:])])
    assert run.lines == whole.lines
    assert run.planned == whole.planned
    assert run.names == whole.names


def test_a_cell_that_failed_comes_from_another_run_and_keeps_its_place(tmp_path: Path) -> None:
    lines = driving_lines()[:3]
    failed = lines[1] | {"status": "timeout", "reason": "slow", "metrics": {}}
    one = part(tmp_path / "a", [lines[0], failed, lines[2]], systems={"a": "1"})
    two = part(tmp_path / "b", [lines[1]], "gpu-", systems={"a": "1", "b": "2"})
    run = join_runs([one, two])
    assert [line["key"] for line in run.lines] == [lines[0]["key"], f"gpu-{lines[1]['key']}", lines[2]["key"]]
    assert [run.names[line["key"]] for line in run.lines] == [line["key"] for line in lines]
    assert run.failures == []
    assert run.header["systems"] == {"a": "1", "b": "2"}
    assert run.header["commands"] == ["ssad run s ", "ssad run s gpu-"]


@pytest.mark.parametrize(
    ("other", "message"), [({"suite": {"name": "t"}}, "not of s"), ({"weights": {"w": "2"}}, "w has another version")]
)
def test_runs_that_do_not_belong_together_are_refused(tmp_path: Path, other: dict[str, Any], message: str) -> None:
    lines = driving_lines()[:1]
    one = part(tmp_path / "a", lines, weights={"w": "1"})
    two = part(tmp_path / "b", lines, **other)
    with pytest.raises(ConfigError, match=message):
        join_runs([one, two])

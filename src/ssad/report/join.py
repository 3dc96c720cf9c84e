"""Runs of one suite as one run, such as slices of it that ran on several machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ssad.core.errors import ConfigError
from ssad.report.load import Run

INPUTS = ("weights", "systems", "towns")  # keys of run.json that map names to versions


def join_runs(runs: Sequence[Run]) -> Run:
    """Return runs of one suite as one run.

    Cells are the same if their names are. Of a cell that several runs have, the first record that did not fail counts;
    if all failed, the last. The header is that of the first run, with the cells, versions of inputs and commands of
    all.

    Args:
        runs: At least one run.

    Raises:
        ConfigError: The runs are of several suites, or of different versions of one input.
    """
    if len(runs) == 1:
        return runs[0]
    first = runs[0]
    inputs: dict[str, dict[str, Any]] = {key: {} for key in INPUTS if any(key in run.header for run in runs)}
    cells: dict[str, Mapping[str, Any]] = {}
    lines: dict[str, Mapping[str, Any]] = {}
    for run in runs:
        if run.suite.get("name") != first.suite.get("name"):
            raise ConfigError(
                f"{run.folder} is a run of the suite {run.suite.get('name')}, not of {first.suite.get('name')}; "
                "join runs of one suite only"
            )
        for key, versions in inputs.items():
            for name, version in (run.header.get(key) or {}).items():
                if versions.setdefault(name, version) != version:
                    raise ConfigError(
                        f"{run.folder}: {name} has another version than in {first.folder} ({key} of run.json); "
                        "join runs of equal inputs only"
                    )
        for cell in run.header["cells"]:
            cells.setdefault(_name(cell), cell)
        run_cells = {cell["key"]: cell for cell in run.header["cells"]}
        for line in run.lines:
            cell = run_cells.get(line["key"], line)
            name = _name(cell)
            if lines.get(name, {}).get("status") != "ok":
                lines[name] = line
                cells[name] = cell
    commands = list(dict.fromkeys(run.command for run in runs))
    return replace(
        first,
        header={**first.header, **inputs, "cells": list(cells.values()), "commands": commands},
        lines=tuple(lines[name] for name in cells if name in lines),
        episodes={key: episode for run in runs for key, episode in run.episodes.items()},
        planned=len(cells),
        sealed=all(run.sealed for run in runs),
    )


def _name(cell: Mapping[str, Any]) -> str:
    return str(cell.get("name") or cell["key"])

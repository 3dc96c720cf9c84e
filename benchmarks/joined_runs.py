"""Runs of one suite, such as of a pair of towns each or the rest of a run on another device, as one run."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ssad.report.load import Run, load_run


def joined(folders: Sequence[Path], place: Callable[[Mapping[str, Any]], Hashable]) -> Run:
    """The runs in folders as one.

    Args:
        folders: Where they lie; header and folder are those of the first, with the commands of all.
        place: What tells a cell, of run.json or of results.jsonl, from others in whatever run it is. Of a cell that
            several runs have, the first record that did not fail counts.

    Raises:
        SystemExit: A run is of another suite.
    """
    runs = [load_run(folder) for folder in folders]
    lines: dict[Hashable, Mapping[str, Any]] = {}
    cells: dict[Hashable, Mapping[str, Any]] = {}
    for run in runs:
        if run.suite["name"] != runs[0].suite["name"]:
            raise SystemExit(f"{run.folder} is of the suite {run.suite['name']}, not of {runs[0].suite['name']}")
        for line in run.lines:
            if lines.get(place(line), {}).get("status") != "ok":
                lines[place(line)] = line
        cells |= {place(cell): cell for cell in run.header["cells"]}
    told = runs[0].header | {
        "cells": list(cells.values()),
        "commands": list(dict.fromkeys(run.command for run in runs)),
        "weights": {name: weights for run in runs for name, weights in run.header["weights"].items()},
    }
    return replace(runs[0], header=told, lines=tuple(lines[one] for one in cells if one in lines), planned=len(cells))

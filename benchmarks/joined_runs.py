"""Runs of one suite, such as of a pair of towns each or the rest of a run on another device, as one run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ssad.report.load import Run, load_run


def joined(folders: Sequence[Path], place: Callable[[Mapping[str, Any]], Hashable]) -> Run:
    """The runs in folders as one.

    Args:
        folders: Where they lie. Cells, commands and weights of the result are those of all, the rest is the first's.
        place: What tells a cell, of run.json or of results.jsonl, from others in whatever run it is. Of a cell that
            several runs have, the first record that did not fail counts; if all failed, the last.

    Raises:
        SystemExit: The runs are of several suites, or of several weights of one detector.
    """
    runs = [load_run(folder) for folder in folders]
    lines: dict[Hashable, Mapping[str, Any]] = {}
    cells: dict[Hashable, Mapping[str, Any]] = {}
    weights: dict[str, str] = {}
    for run in runs:
        if run.suite["name"] != runs[0].suite["name"]:
            raise SystemExit(f"{run.folder} is of the suite {run.suite['name']}, not of {runs[0].suite['name']}")
        for name, known in run.header["weights"].items():
            if weights.setdefault(name, known) != known:
                raise SystemExit(f"{run.folder} is of other weights of {name} than {runs[0].folder}")
        for line in run.lines:
            if lines.get(place(line), {}).get("status") != "ok":
                lines[place(line)] = line
        cells |= {place(cell): cell for cell in run.header["cells"]}
    commands = list(dict.fromkeys(run.command for run in runs))
    header = runs[0].header | {"cells": list(cells.values()), "commands": commands, "weights": weights}
    kept = tuple(lines[cell] for cell in cells if cell in lines)
    return replace(runs[0], header=header, lines=kept, planned=len(cells))


def summary_of(run: Run, place: Callable[[Mapping[str, Any]], Hashable]) -> dict[str, Any]:
    """run.json of a joined run without its cells: with all commands, how many cells were planned and have run on each
    device, with which PyTorch, the names of those that have not run, and why others failed.
    """
    names = {place(cell): cell["name"] for cell in run.header["cells"]}
    there = {place(line) for line in run.lines}
    return {key: value for key, value in run.header.items() if key not in ("cells", "commands")} | {
        "command": run.header["commands"],
        "planned": run.planned,
        "ran": Counter(line["versions"]["device"] for line in run.lines if line["status"] == "ok"),
        "torch": sorted({line["versions"]["torch"] for line in run.lines if "torch" in line["versions"]}),
        "missing": [name for cell, name in names.items() if cell not in there],
        "failed": {names[place(line)]: line["reason"] for line in run.failures},
    }

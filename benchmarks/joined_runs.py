"""Runs of one suite as one run, and what a page of stored results keeps of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ssad.report.join import join_runs
from ssad.report.load import Run, load_run


def joined(folders: Sequence[Path]) -> Run:
    """Return the runs in folders as one run."""
    return join_runs([load_run(folder) for folder in folders])


def summary_of(run: Run) -> dict[str, Any]:
    """run.json of a joined run without its cells: with all commands, how many cells were planned and have run on each
    device, with which PyTorch, the names of those that have not run, and why others failed.
    """
    finished = {line["key"] for line in run.lines}
    return {key: value for key, value in run.header.items() if key not in ("cells", "commands")} | {
        "command": run.header.get("commands") or [run.command],
        "planned": run.planned,
        "ran": Counter(line["versions"]["device"] for line in run.lines if line["status"] == "ok"),
        "torch": sorted({line["versions"]["torch"] for line in run.lines if "torch" in line["versions"]}),
        "missing": [name for key, name in run.names.items() if key not in finished],
        "failed": {run.names[line["key"]]: line["reason"] for line in run.failures},
    }

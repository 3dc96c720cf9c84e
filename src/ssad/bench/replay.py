"""`ssad replay`: run one driving cell again, alone, and compare every bit with what was recorded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ssad.bench.kind import Cell, find_cell
from ssad.bench.kinds.driving import Driving, drive, town
from ssad.bench.run import read_plan
from ssad.core.errors import ConfigError, StoreError
from ssad.core.jsonl import read_lines
from ssad.core.lane_graph import LaneGraph
from ssad.core.traces import first_difference, load_trace
from ssad.core.types import EpisodeTrace
from ssad.jobs.machine import quiet_warp
from ssad.jobs.store import RESULTS


@dataclass(frozen=True)
class Replay:
    """A cell run again. difference: None when equal to the bit, else where the two part."""

    cell: Cell
    trace: EpisodeTrace
    graph: LaneGraph
    difference: str | None


def replay(folder: str | Path, name: str) -> Replay:
    """Run the cell that `name` means (key, unique start of it, or "system/scenario") once more.

    Raises:
        StoreError: it was not recorded.
        ConfigError: there is no such cell, it is no drive, or the code has changed since.
    """
    quiet_warp()
    plan = read_plan(folder)
    if not isinstance(plan.kind, Driving):
        raise ConfigError(f"{folder}: a run of kind '{plan.kind.name}'; only drives can be replayed")
    cell = find_cell(plan.cells, name)
    record = next((r for r in read_lines(Path(folder) / RESULTS) if r["key"] == cell.key), None)
    if record is None:
        raise StoreError(f"{folder}: cell {cell.key} ({cell.name}) has not run yet; run the suite again first")
    if record["status"] != "ok":
        raise StoreError(
            f"{folder}: cell {cell.key} ({cell.name}) left no trace: {record['status']}, {record['reason']}"
        )
    recorded = load_trace(Path(folder) / record["artefacts"]["trace"])
    _, traces = drive([cell], device=plan.device)
    return Replay(cell, traces[0], town(traces[0].town), first_difference(recorded, traces[0]))

"""`ssad replay`: run one cell again, alone, and compare every bit with the record."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ssad.core.errors import StoreError
from ssad.core.jsonl import read_lines
from ssad.core.run_records import RESULTS
from ssad.engine.kind import Plan, Replay, find_cell


def replay_cell(plan: Plan, folder: str | Path, name: str) -> Replay:
    """Run the cell that `name` denotes (key, unique start of it, or "system/scenario") once more.

    Raises:
        StoreError: It was not recorded.
        ConfigError: There is no such cell, or its kind has no replay.
    """
    cell = find_cell(plan.cells, name)
    record = next((line for line in read_lines(Path(folder) / RESULTS) if line["key"] == cell.key), None)
    if record is None:
        raise StoreError(f"{folder}: cell {cell.key} ({cell.name}) has not run yet; run the suite again first")
    if record["status"] != "ok":
        raise StoreError(
            f"{folder}: cell {cell.key} ({cell.name}) left no trace: {record['status']}, {record['reason']}"
        )
    return plan.kind.replay(plan, cell, record, Path(folder))


def describe_difference(recorded: Mapping[str, Any], result: Mapping[str, Any]) -> str | None:
    """Return the first difference between a result and its record, in words; None: there is none."""
    for part, value in result.items():
        if isinstance(value, dict):
            recorded_values = recorded.get(part, {})
            for name in value:
                if value[name] != recorded_values.get(name):
                    return f"{part}: {name} is {value[name]}, was {recorded_values.get(name)}"
        elif value != recorded.get(part):
            return f"{part} is {value}, was {recorded.get(part)}"
    return None

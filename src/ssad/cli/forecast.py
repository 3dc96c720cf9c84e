"""Forecast of a run: its cells, and time and disk from earlier runs beside it or from a sample."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from ssad.core import safeio
from ssad.core.errors import SSADError
from ssad.core.jsonl import read_lines
from ssad.core.machine import default_workers
from ssad.core.registry import label_of
from ssad.core.run_records import RESULTS
from ssad.core.wording import counted
from ssad.engine.kind import Plan, Resources
from ssad.engine.run import run


@dataclass
class Rates:
    """Cost of finished cells: seconds of work by system, and bytes of all."""

    seconds: dict[str, list[float]] = field(default_factory=dict)
    size: float = 0.0
    cells: int = 0

    def add(self, folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
        """Count the finished cells of a folder, and all of its files."""
        for row in rows:
            if row.get("status") == "ok" and row.get("wall_s"):
                system = str(row.get("system") or row.get("detector") or "")
                self.seconds.setdefault(system, []).append(float(row["wall_s"]))
        self.cells += len(rows)
        self.size += sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())

    def of(self, system: str) -> tuple[float, bool] | None:
        """Return the mean seconds of a cell, and whether they are the system's own; None if nothing is known."""
        system_seconds = self.seconds.get(system)
        samples = system_seconds or [value for values in self.seconds.values() for value in values]
        return (sum(samples) / len(samples), system_seconds is not None) if samples else None


def forecast(plan: Plan, folder: Path, resources: Resources, *, sample: int = 0) -> list[str]:
    """Forecast the cells, time and disk of a run, a line each; nothing is written to the folder.

    Time and disk come from earlier runs of the same kind on the same device that lie beside the folder, or from cells
    that are run as a sample. A quantity that is not known is reported as unknown.

    Args:
        plan: Its cells.
        folder: Results folder that the run would have.
        resources: Resources of the run.
        sample: Number of cells of each system that are run to measure; 0: none.

    Raises:
        SSADError: The sample cannot be run.
    """
    finished_keys = finished(plan, folder)
    remaining = [cell for cell in plan.cells if cell.key not in finished_keys]
    lines = [f"suite {plan.suite.name}, kind {plan.kind.name}, device {plan.device}, folder {folder}"]
    cells_per_system = Counter(label_of(cell.system) for cell in plan.cells)
    lines.append(
        f"cells: {len(plan.cells)}, of which {len(finished_keys)} are there already and {len(remaining)} would run"
    )
    lines += [f"  {system or 'all'}: {count}" for system, count in cells_per_system.items()]
    lines += plan.kind.plan_lines(plan)
    if not remaining:
        return lines
    rates, source = sampled_rates(plan, resources, sample) if sample else earlier_rates(plan, folder)
    if not rates.seconds:
        unknown_text = f"unknown: no earlier run of kind {plan.kind.name} on {plan.device} lies in {folder.parent}"
        return [
            *lines,
            f"time: {unknown_text}; --sample 1 runs a cell of each system to find out",
            f"disk: {unknown_text}",
        ]
    total_seconds, unmeasured = 0.0, set()
    for cell in remaining:
        name = label_of(cell.system)
        estimate = rates.of(name)
        assert estimate is not None
        total_seconds += estimate[0]
        if not estimate[1]:
            unmeasured.add(name)
    available_workers = resources.workers if resources.workers is not None else default_workers()
    # A kind may allow fewer workers than the machine, and more workers than cells would idle.
    worker_count = max(1, min(plan.kind.workers(plan, available_workers) or 1, len(remaining)))
    lines.append(
        f"time: about {duration_text(total_seconds / worker_count)} with {worker_count} workers "
        f"({duration_text(total_seconds)} of work), from {source}"
    )
    if unmeasured:
        lines.append(f"  no such cell was measured for {', '.join(sorted(unmeasured))}: as the mean of the others")
    lines.append(f"disk: about {rates.size / max(rates.cells, 1) * len(remaining) / 1e6:.1f} MB, from the same")
    lines.append("not counted: the start of the workers, data that is recorded first, pictures of the report")
    return lines


def finished(plan: Plan, folder: Path) -> set[str]:
    """Return the keys of the plan's cells that a folder already has."""
    if not (folder / RESULTS).is_file():
        return set()
    return {line["key"] for line in read_lines(folder / RESULTS)} & {cell.key for cell in plan.cells}


def earlier_rates(plan: Plan, folder: Path) -> tuple[Rates, str]:
    """Return the rates of the runs of this kind and device beside a folder, and their source in words."""
    rates, run_names = Rates(), []
    for path in neighbours(folder.parent):
        try:
            header = safeio.read_json(path / "run.json")
            if header.get("kind") != plan.kind.name or header["versions"].get("device") != plan.device:
                continue
            rates.add(path, read_lines(path / RESULTS))
            run_names.append(path.name)
        except (SSADError, OSError, KeyError, AttributeError):
            continue  # no run that can be read says nothing about this one
    return rates, f"earlier runs ({', '.join(run_names[:3])}{', ...' if len(run_names) > 3 else ''})"


def neighbours(folder: Path) -> Iterator[Path]:
    """Yield the results folders in a folder."""
    for path in sorted(folder.glob("*/run.json")):
        yield path.parent


def sampled_rates(plan: Plan, resources: Resources, sample: int) -> tuple[Rates, str]:
    """Run some cells of each system, spread over the plan, in a temporary folder; return their rates and source."""
    by_system: dict[str, list[Any]] = {}
    for cell in plan.cells:
        by_system.setdefault(cell.system, []).append(cell)
    sampled_cells = [cell for cells in by_system.values() for cell in cells[:: max(1, len(cells) // sample)][:sample]]
    rates = Rates()
    with tempfile.TemporaryDirectory() as temporary_folder:
        quiet_resources = replace(resources, console=Console(stderr=True, quiet=True))
        rows = run(replace(plan, cells=tuple(sampled_cells)), Path(temporary_folder) / "run", quiet_resources)
        rates.add(Path(temporary_folder) / "run", rows)
    failure_count = sum(row["status"] != "ok" for row in rows)
    return rates, f"a sample of {counted(len(sampled_cells), 'cell')}" + (
        f", of which {failure_count} failed" if failure_count else ""
    )


def duration_text(seconds: float) -> str:
    """Return a duration in words."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"

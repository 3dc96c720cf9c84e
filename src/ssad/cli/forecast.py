"""What a run would take: its cells, and time and disk from earlier runs beside it or from a sample."""

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
from ssad.engine.kind import Plan, Resources
from ssad.engine.run import run
from ssad.engine.store import RESULTS


@dataclass
class Rates:
    """What cells took: seconds of work by system, and bytes of all."""

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
        """Mean seconds of a cell, and whether it is this system's own; None if nothing is known."""
        own = self.seconds.get(system)
        every = own or [value for values in self.seconds.values() for value in values]
        return (sum(every) / len(every), own is not None) if every else None


def forecast(plan: Plan, folder: Path, resources: Resources, *, sample: int = 0) -> list[str]:
    """Say what a run would do and take, a line each; nothing is written to the folder.

    Time and disk come from earlier runs of the same kind on the same device that lie beside the folder, or from cells
    that are run for it. What is not known is said.

    Args:
        plan: Its cells.
        folder: Where it would lie.
        resources: What it may use.
        sample: How many cells of each system are run to measure; 0: none.

    Raises:
        SSADError: The sample cannot be run.
    """
    done = finished(plan, folder)
    todo = [cell for cell in plan.cells if cell.key not in done]
    lines = [f"suite {plan.suite.name}, kind {plan.kind.name}, device {plan.device}, folder {folder}"]
    counted = Counter(label_of(cell.system) for cell in plan.cells)
    lines.append(f"cells: {len(plan.cells)}, of which {len(done)} are there already and {len(todo)} would run")
    lines += [f"  {system or 'all'}: {count}" for system, count in counted.items()]
    if not todo:
        return lines
    rates, basis = measured(plan, resources, sample) if sample else known(plan, folder)
    if not rates.seconds:
        unknown = f"unknown: no earlier run of kind {plan.kind.name} on {plan.device} lies in {folder.parent}"
        return [*lines, f"time: {unknown}; --sample 1 runs a cell of each system to find out", f"disk: {unknown}"]
    work, guessed = 0.0, set()
    for cell in todo:
        name = label_of(cell.system)
        rate = rates.of(name)
        assert rate is not None
        work += rate[0]
        if not rate[1]:
            guessed.add(name)
    workers = resources.workers if resources.workers is not None else default_workers()
    at_once = max(1, min(plan.kind.workers(plan, workers) or 1, len(todo)))
    lines.append(f"time: about {spoken(work / at_once)} with {at_once} workers ({spoken(work)} of work), from {basis}")
    if guessed:
        lines.append(f"  no such cell was measured for {', '.join(sorted(guessed))}: as the mean of the others")
    lines.append(f"disk: about {rates.size / max(rates.cells, 1) * len(todo) / 1e6:.1f} MB, from the same")
    lines.append("not counted: the start of the workers, data that is recorded first, pictures of the report")
    return lines


def finished(plan: Plan, folder: Path) -> set[str]:
    """Keys of the plan's cells that a folder has already."""
    if not (folder / RESULTS).is_file():
        return set()
    return {line["key"] for line in read_lines(folder / RESULTS)} & {cell.key for cell in plan.cells}


def known(plan: Plan, folder: Path) -> tuple[Rates, str]:
    """Rates of the runs beside a folder that are of this kind and device, and what they come from."""
    rates, names = Rates(), []
    for path in neighbours(folder.parent):
        try:
            header = safeio.read_json(path / "run.json")
            if header.get("kind") != plan.kind.name or header["versions"].get("device") != plan.device:
                continue
            rates.add(path, read_lines(path / RESULTS))
            names.append(path.name)
        except (SSADError, OSError, KeyError, AttributeError):
            continue  # no run that can be read says nothing about this one
    return rates, f"earlier runs ({', '.join(names[:3])}{', ...' if len(names) > 3 else ''})"


def neighbours(folder: Path) -> Iterator[Path]:
    """Results folders in a folder."""
    for path in sorted(folder.glob("*/run.json")):
        yield path.parent


def measured(plan: Plan, resources: Resources, sample: int) -> tuple[Rates, str]:
    """Rates of some cells of each system, spread over the plan and run in a folder that is thrown away."""
    by_system: dict[str, list[Any]] = {}
    for cell in plan.cells:
        by_system.setdefault(cell.system, []).append(cell)
    chosen = [cell for cells in by_system.values() for cell in cells[:: max(1, len(cells) // sample)][:sample]]
    rates = Rates()
    with tempfile.TemporaryDirectory() as place:
        quiet = replace(resources, console=Console(stderr=True, quiet=True))
        rows = run(replace(plan, cells=tuple(chosen)), Path(place) / "run", quiet)
        rates.add(Path(place) / "run", rows)
    failed = sum(row["status"] != "ok" for row in rows)
    return rates, f"a sample of {len(chosen)} cells" + (f", of which {failed} failed" if failed else "")


def spoken(seconds: float) -> str:
    """A time as people say it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"

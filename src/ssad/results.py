"""Python interface of runs: `ssad.run` runs a suite, `ssad.load_results` reads a results folder."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from ssad.core.errors import ConfigError, StoreError
from ssad.core.folders import path_inside
from ssad.core.traces import load_trace
from ssad.core.types import EpisodeTrace
from ssad.experiments.runs import summary, write_report
from ssad.report.load import Run, load_run

if TYPE_CHECKING:
    import pandas

    from ssad.engine.kind import Plan, Resources

PICTURES = (".jpg", ".jpeg", ".png")


class Results(Run):
    """A run: its records and their inputs.

    Printed, it is the table that `ssad run` ends with. It also has `folder`, `header` (run.json), `suite`, `kind`,
    `title`, `names` (key of a cell -> its name), `failures` (the rows of failed cells), `episodes` (key -> line of
    episodes.jsonl), `planned` (number of cells of the complete run) and `command` (runs it again).
    """

    @property
    def rows(self) -> tuple[Mapping[str, Any], ...]:
        """Lines of results.jsonl in the order of the suite, one a cell."""
        return self.lines

    @property
    def report(self) -> Path:
        """Path of report.html; it is written if it is missing.

        Raises:
            StoreError: It cannot be written.
        """
        path = self.folder / "report.html"
        return path if path.is_file() else write_report(self.folder)

    @property
    def pictures(self) -> tuple[Path, ...]:
        """Pictures of the run: those of its report, and those that its cells name."""
        cell_paths = [path for row in self.rows for path in (row.get("hashes") or {}) if path.endswith(PICTURES)]
        report_paths = sorted(p for p in (self.folder / "pictures").glob("*") if p.suffix in PICTURES)
        return tuple(dict.fromkeys([*report_paths, *(path_inside(self.folder, path) for path in cell_paths)]))

    def find(self, cell: str) -> Mapping[str, Any]:
        """Return the row of one cell.

        Args:
            cell: Its key, the start of it, or its name, such as "blind/StraightObstacle/00".

        Raises:
            ConfigError: There is none, or more than one.
        """
        from ssad.engine.kind import Cell, find_cell

        names = self.names
        cells = [Cell(row["key"], names.get(row["key"], row["key"]), "", 0, {}, row) for row in self.rows]
        return find_cell(cells, cell).spec

    def trace(self, cell: str) -> EpisodeTrace:
        """Return the trace of one drive: the states of all agents at each step.

        Args:
            cell: As for `find`.

        Raises:
            ConfigError: There is no such cell.
            StoreError: The cell left no trace, or its path leads out of the folder.
            FormatError: The file is broken.
        """
        row = self.find(cell)
        path = (row.get("artefacts") or {}).get("trace")
        if path is None:
            raise StoreError(f"{self.folder}: cell {row['key']} has no trace: {row['reason'] or 'it is no drive'}")
        return load_trace(path_inside(self.folder, path))

    def traces(self) -> Iterator[EpisodeTrace]:
        """Yield the traces of all drives, in the order of the rows; each is read on demand."""
        for row in self.rows:
            if "trace" in (row.get("artefacts") or {}):
                yield self.trace(row["key"])

    def frame(self) -> pandas.DataFrame:
        """Return the rows as a pandas DataFrame: one line a cell, its fields and then its metrics as columns.

        Raises:
            ConfigError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise ConfigError("frame() needs pandas; `rows` are plain dictionaries that need nothing") from None
        names = self.names
        nested = ("metrics", "spec", "versions", "artefacts", "hashes", "intervals", "replicates", "witness")
        table = []
        for row in self.rows:
            cell_fields = {key: value for key, value in row.items() if key not in nested}
            table.append({"cell": names.get(row["key"], row["key"])} | cell_fields | dict(row.get("metrics") or {}))
        return pandas.DataFrame(table)

    def __str__(self) -> str:
        """Return the table that `ssad run` ends with."""
        buffer = io.StringIO()
        Console(file=buffer, width=120).print(summary(self.folder))
        return buffer.getvalue().rstrip()

    def __repr__(self) -> str:
        """Return folder, number of cells, kind and failures in one line."""
        failure_text = f", {len(self.failures)} failed" if self.failures else ""
        return f"<Results {self.folder}: {len(self.rows)} of {self.planned} cells of kind {self.kind}{failure_text}>"

    def _repr_html_(self) -> str:
        """Return the table for notebooks."""
        console = Console(file=io.StringIO(), record=True, width=120)
        console.print(summary(self.folder))
        return console.export_html(inline_styles=True, code_format="<pre style='line-height:1.25'>{code}</pre>")


def load_results(folder: Path | str) -> Results:
    """Read a folder that `ssad run` or `ssad.run` has written.

    Args:
        folder: Results folder.

    Returns:
        The results.

    Raises:
        StoreError: The folder holds no run with results.
    """
    run = load_run(folder)
    return Results(**{field.name: getattr(run, field.name) for field in fields(run)})


def make_plan(suite: str | Path, settings: Sequence[str] | Mapping[str, Any] = (), *, device: str = "auto") -> Plan:
    """Resolve a suite and check all of its input; nothing is run or written.

    Args:
        suite: Name of a suite, or YAML file.
        settings: As `set` of `run`.
        device: auto, cpu or cuda.

    Returns:
        The cells of the run and all of their inputs.

    Raises:
        SSADError: The suite, a setting or the device is wrong.
    """
    from ssad.core.machine import pick_device
    from ssad.experiments.suites import kind_of, load_suite

    if isinstance(settings, Mapping):
        settings = [f"{key}={json.dumps(value, default=str)}" for key, value in settings.items()]
    resolved_suite = load_suite(str(suite), settings)
    return kind_of(resolved_suite.kind).plan(resolved_suite, device=pick_device(device))


def run_plan(
    plan: Plan,
    folder: Path,
    resources: Resources,
    *,
    retry: bool = False,
    only: Mapping[str, Sequence[str]] | None = None,
) -> Results:
    """Run the missing cells of a plan, and write its report.

    Args:
        plan: The plan.
        folder: Results folder.
        resources: Resources of the run.
        retry: Whether failed cells are run again.
        only: As `only` of `run`.

    Returns:
        The results, all that the folder has by now.

    Raises:
        SSADError: The folder cannot be written, holds another run, or no worker can start.
    """
    from ssad.engine.run import run as run_cells

    if len(run_cells(plan, folder, resources, retry=retry, only=only)) == len(plan.cells):
        resources.console.print(f"{plan.suite.name}: pictures and report", highlight=False)
        plan.kind.finish(plan, folder)
    write_report(folder)
    return load_results(folder)


def run(
    suite: str | Path,
    *,
    set: Sequence[str] | Mapping[str, Any] = (),
    out: Path | str | None = None,
    device: str = "auto",
    workers: int | None = None,
    ray: str | None = None,
    retry: bool = False,
    only: Mapping[str, Sequence[str]] | None = None,
    quiet: bool = False,
) -> Results:
    """Run a suite and write its report, as the command `ssad run` does; called again, it continues.

    Args:
        suite: Name of a suite (`ssad list suites`), or YAML file.
        set: Keys of the suite with other values, such as {"systems": ["blind"], "repetitions": 3}; or texts
            "key=value" as on the command line.
        out: Results folder; None: runs/SUITE.
        device: auto, cpu or cuda.
        workers: Number of worker processes; None: one per core; 0: all in this process.
        ray: Address of a Ray cluster to run on; "local" starts one here.
        retry: Whether failed cells are run again.
        only: Run a slice: the cells whose fields, or name, have one of these values, such as
            {"perturbation": ["none", "fog"]}; "none,fog" means the same. Slices add up in the folder.
        quiet: Whether progress is hidden.

    Returns:
        The results. A failed cell raises nothing: see `Results.failures`.

    Raises:
        SSADError: The suite is wrong, the folder cannot be written, or it holds another run.
    """
    from ssad.engine.kind import Resources

    plan = make_plan(suite, set, device=device)
    console = Console(stderr=True, quiet=quiet)
    folder = Path(out) if out is not None else Path("runs") / plan.suite.name
    return run_plan(plan, folder, Resources(workers, ray, plan.device, console), retry=retry, only=only)

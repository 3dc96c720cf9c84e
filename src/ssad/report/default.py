"""Page of a kind without a page of its own: a table of its columns by its factors, failures, pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from ssad.report.artefacts import pictures
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.records import SWEEP, field, result_cell
from ssad.report.tables import METHODS, Table

MAX_POINTS: Final = 60
"""Most points of a sweep that are rows of their own in the table."""


def section(run: Run, *, verdict: Sequence[str] = (), note: str = "") -> tuple[str, Sequence[Table]]:
    """Return the page of a run, with its leading sentences, and its one table, with a note of its kind."""
    factors = _factors(run)
    table = result_table(run)
    table = replace(table, note=f"{note} {table.note}".strip())
    failures = [
        ([field(name)(line) for name in factors], line["status"], line.get("reason", "")) for line in run.failures
    ]
    page = render(
        "default.html",
        run,
        verdict=verdict,
        results=table,
        factors=factors,
        failures=failures,
        pictures=pictures(run.folder),
    )
    return page, [table]


def summary(run: Run, *, note: str = "") -> Table:
    """Return the table for the terminal, with a note of its kind."""
    return replace(result_table(run), note=note)


def result_table(run: Run, factors: Sequence[str] = ()) -> Table:
    """Return a row for each combination of the factors' values, a column for each metric of the kind.

    Args:
        run: The run.
        factors: Fields of the lines; empty: those of the kind.
    """
    columns: dict[str, Mapping[str, Any]] = {str(column["name"]): column for column in run.header.get("columns") or []}
    if not columns:
        columns = {metric: {"name": metric} for line in run.lines for metric in line.get("metrics") or {}}
    titles = {name: _title(column) for name, column in columns.items()}
    notes = [f"{titles[name]}: {c['better']} is better." for name, c in columns.items() if c.get("better")]
    table = Table.pivot(
        "results",
        "Results",
        run.lines,
        rows={name.removeprefix(SWEEP).replace("_", " "): field(name) for name in factors or _factors(run)},
        columns=titles,
        metric=result_cell,
        note=" ".join([*notes, METHODS]),
    )
    return replace(table, clock=tuple(titles[name] for name, column in columns.items() if column.get("clock")))


def _factors(run: Run) -> list[str]:
    """Return the fields that tell rows apart: the kind's, else the common ones of the lines, else the key.

    The points of a sweep are rows of their own, unless there are very many.
    """
    kind_factors = [str(name) for name in run.header.get("factors") or []]
    swept_fields = sorted({name for line in run.lines for name in line if name.startswith(SWEEP)})
    points = {tuple(line.get(name) for name in swept_fields) for line in run.lines}
    if kind_factors and len(points) <= MAX_POINTS:
        kind_factors += swept_fields
    common_fields = [name for name in ("system", "detector", "group", "shift", "severity") if name in run.lines[0]]
    return kind_factors or common_fields or ["key"]


def _title(column: Mapping[str, Any]) -> str:
    unit = column.get("unit")
    return str(column.get("title") or column["name"]) + (f", {unit}" if unit else "")

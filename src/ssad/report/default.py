"""Page of a kind without a page of its own: a table of its columns by its factors, failures, pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ssad.report.artefacts import pictures
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.records import Line, field, metric_cell
from ssad.report.tables import METHODS, Table, TableCell


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
        rows={name.replace("_", " "): field(name) for name in factors or _factors(run)},
        columns=titles,
        metric=_cell,
        note=" ".join([*notes, METHODS]),
    )
    return replace(table, clock=tuple(titles[name] for name, column in columns.items() if column.get("clock")))


def _factors(run: Run) -> list[str]:
    """Return the fields that tell rows apart: the kind's, else the common ones of the lines, else the key."""
    kind_factors = [str(name) for name in run.header.get("factors") or []]
    common_fields = [name for name in ("system", "detector", "group", "shift", "severity") if name in run.lines[0]]
    return kind_factors or common_fields or ["key"]


def _title(column: Mapping[str, Any]) -> str:
    unit = column.get("unit")
    return str(column.get("title") or column["name"]) + (f", {unit}" if unit else "")


def _cell(lines: Sequence[Line], name: str) -> TableCell:
    """Return a metric over the lines of a row: one line's own interval if it has one, else that of the clusters."""
    values = [(line.get("metrics") or {}).get(name) if line["status"] == "ok" else None for line in lines]
    own_interval = (lines[0].get("intervals") or {}).get(name) if len(lines) == 1 else None
    if own_interval and values[0] is not None:
        lower, upper = (math.nan if limit is None else float(limit) for limit in own_interval)
        return TableCell(float(values[0]), lower, upper, int(lines[0].get("n", 1)), method="given")
    are_booleans = [isinstance(value, bool) for value in values if value is not None]
    cell = metric_cell(lines, name, "share" if are_booleans and all(are_booleans) else "mean")
    is_count = len(values) == 1 and type(values[0]) is int
    return replace(cell, digits=0 if is_count or abs(cell.mean) >= 1000 else 1 if abs(cell.mean) >= 100 else 2)

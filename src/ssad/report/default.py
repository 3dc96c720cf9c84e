"""Page of a kind without a page of its own: a table of its columns by its factors, failures, pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ssad.metrics import CaseValue, estimate
from ssad.report.artefacts import pictures
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.tables import METHODS, Cell, Row, Table

Line = Mapping[str, Any]


def section(run: Run, *, verdict: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """Return the page of a run, with its leading sentences, and its one table."""
    factors = _factors(run)
    table = result_table(run)
    failures = [
        ([_factor(line, name) for name in factors], line["status"], line.get("reason", "")) for line in run.failures
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


def summary(run: Run) -> Table:
    """Return the table for the terminal."""
    return replace(result_table(run), note="")


def result_table(run: Run) -> Table:
    """Return a row for each combination of the factors' values, a column for each metric of the kind."""
    factors = _factors(run)
    columns: list[Mapping[str, Any]] = list(run.header.get("columns") or [])
    if not columns:
        columns = [
            {"name": name}
            for name in dict.fromkeys(metric for line in run.lines for metric in line.get("metrics") or {})
        ]
    cells: dict[tuple[str, ...], list[Line]] = {}
    for line in run.lines:
        cells.setdefault(tuple(_factor(line, name) for name in factors), []).append(line)
    rows = [Row(row_head, tuple(_cell(lines, column) for column in columns)) for row_head, lines in cells.items()]
    titles = [_title(column) for column in columns]
    notes = [f"{title}: {c['better']} is better." for title, c in zip(titles, columns, strict=True) if c.get("better")]
    note = " ".join([*notes, METHODS])
    return Table(
        "results", "Results", tuple(name.replace("_", " ") for name in factors), tuple(titles), tuple(rows), note
    )


def _factors(run: Run) -> list[str]:
    """Return the fields that tell rows apart: the kind's, else the common ones of the lines, else the key."""
    kind_factors = [str(name) for name in run.header.get("factors") or []]
    common_fields = [name for name in ("system", "detector", "group", "shift", "severity") if name in run.lines[0]]
    return kind_factors or common_fields or ["key"]


def _factor(line: Line, name: str) -> str:
    value = line.get(name, (line.get("spec") or {}).get(name))
    return "" if value is None else str(value)


def _title(column: Mapping[str, Any]) -> str:
    unit = column.get("unit")
    return str(column.get("title") or column["name"]) + (f", {unit}" if unit else "")


def _cell(lines: Sequence[Line], column: Mapping[str, Any]) -> Cell:
    """Return a metric over the lines of a row: one line's own interval if it has one, else that of the clusters."""
    name = str(column["name"])
    values = [(line.get("metrics") or {}).get(name) if line["status"] == "ok" else None for line in lines]
    own_interval = (lines[0].get("intervals") or {}).get(name) if len(lines) == 1 else None
    if own_interval and values[0] is not None:
        low, high = (math.nan if limit is None else float(limit) for limit in own_interval)
        return Cell(float(values[0]), low, high, int(lines[0].get("n", 1)), method="given")
    are_booleans = [isinstance(value, bool) for value in values if value is not None]
    cases = [
        CaseValue(
            math.nan if value is None else float(value),
            str(line.get("cluster") or line["key"]),
            str(line.get("case") or line["key"]),
            failed=line["status"] != "ok",
        )
        for line, value in zip(lines, values, strict=True)
    ]
    cell = Cell.of(estimate(cases, "share" if are_booleans and all(are_booleans) else "mean"))
    is_count = len(values) == 1 and type(values[0]) is int
    return replace(cell, digits=0 if is_count or abs(cell.mean) >= 1000 else 1 if abs(cell.mean) >= 100 else 2)

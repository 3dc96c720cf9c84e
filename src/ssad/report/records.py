"""Numbers of records: their fields as factors of a table, and estimates of their metrics."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from ssad.metrics import CaseValue, estimate
from ssad.metrics.uncertainty import Kind
from ssad.report.tables import TableCell

Line = Mapping[str, Any]
"""A line of results.jsonl."""
SWEEP: Final = "sweep."
"""Start of the names of the fields that have the values of swept parameters."""


def field(name: str) -> Callable[[Line], str]:
    """Return the factor of a table that a field of the lines is, or of their specification; empty where it is absent.

    Args:
        name: Name of the field.
    """

    def value_of(line: Line) -> str:
        value = line.get(name, (line.get("spec") or {}).get(name))
        return "" if value is None else str(value)

    return value_of


def scenario_of(line: Line) -> str:
    """Return the name of the scenario of a line; of a kind without scenarios its cluster or key."""
    scenario = (line.get("spec") or {}).get("scenario") or {}
    return str(scenario.get("name") or line.get("cluster") or line["key"])


def metric_of(line: Line, name: str) -> float:
    """Return a metric of a line; NaN where it was not measured or the cell failed."""
    value = (line.get("metrics") or {}).get(name) if line["status"] == "ok" else None
    return math.nan if value is None else float(value)


def case_of(line: Line, value: float) -> CaseValue:
    """Return a value (NaN: not measured) as that of the line's case in its cluster; both are its key by default."""
    return CaseValue(
        value,
        str(line.get("cluster") or line["key"]),
        str(line.get("case") or line["key"]),
        failed=line["status"] != "ok",
    )


def metric_cell(lines: Sequence[Line], name: str, kind: Kind) -> TableCell:
    """Return the mean of a metric over lines with its interval, which the clusters give.

    Args:
        lines: Lines of a row.
        name: Name of the metric.
        kind: Kind of its values; see `ssad.metrics.uncertainty.estimate`.
    """
    return TableCell.of(estimate([case_of(line, metric_of(line, name)) for line in lines], kind))


def result_cell(lines: Sequence[Line], name: str) -> TableCell:
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

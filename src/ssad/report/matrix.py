"""Matrix tables of a sweep: a metric over two swept parameters, a table for each system and value of the others."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, TypeGuard

from ssad.core.wording import counted
from ssad.metrics import METRICS
from ssad.report.load import Run
from ssad.report.records import SWEEP, Line, result_cell
from ssad.report.tables import Table, TableCell, TableRow
from ssad.report.terminal import TerminalRow, TerminalTable

MAX_SLICES: Final = 6
"""Most values of further parameters that have matrices of their own; over more of them the matrix is a mean."""
BETWEEN: Final = " \\ "  # between the parameters in the rows and in the columns
EMPTY: Final = TableCell.value(None)
NOTE: Final = (
    "Points of a grid share their route and their random draws: they are one cluster, and no interval is taken over "
    "them. A mean over a grid describes the grid, not how often something happens on the road."
)


def swept_parameters(run: Run) -> list[str]:
    """Return the swept parameters of a run, in the order of its suite; empty: it has no sweep."""
    names = dict.fromkeys(name for record in run.lines for name in record if name.startswith(SWEEP))
    return [name.removeprefix(SWEEP) for name in names]


def sweep_tables(run: Run) -> list[Table]:
    """Return the matrices of a run with a sweep, and the table of all its points; empty: it has no sweep."""
    if not swept_parameters(run):
        return []
    return [*run_matrices(run), _point_table(run)]


def run_matrices(run: Run) -> list[Table]:
    """Return the matrices of a run, of the metric and with the rows and columns that its suite names."""
    columns = {str(column["name"]): column for column in run.header.get("columns") or []}
    recorded = {metric for record in run.lines for metric in record.get("metrics") or {}}

    def record_name(name: str) -> str:
        return METRICS[name].field or name if name in METRICS and name not in recorded else name

    chosen = run.suite.get("matrix_metric")
    name = str(chosen or next((name for name in ("CR", *columns) if record_name(name) in recorded), "CR"))
    metric = record_name(name)
    column = columns.get(name) or {}
    unit = f", {column['unit']}" if column.get("unit") else ""
    metric_title = f"{column.get('title') or name}{unit}"
    axes = [str(axis) for axis in run.suite.get("matrix") or ()]
    metric_title = metric_title[:1].upper() + metric_title[1:]
    return matrix_tables(run, metric, metric_title, axes=axes)


def matrix_tables(run: Run, metric: str, metric_title: str, *, axes: Sequence[str] = ()) -> list[Table]:
    """Return the matrix tables of a run with a sweep.

    Args:
        run: The run.
        metric: Metric of the records that the cells show.
        metric_title: Title of the metric.
        axes: Parameters in the rows and the columns; empty: the first two that have several values.

    Returns:
        For each system and scenario, a table for each value of the other parameters, or one of the mean over them
        where they have more than `MAX_SLICES` values. With one parameter, systems are the columns. Empty: no sweep.
    """
    records = [record for record in run.lines if any(name.startswith(SWEEP) for name in record)]
    if not records:
        return []
    parameters = swept_parameters(run)
    varied = [name for name in parameters if len(_values(records, name)) > 1] or parameters
    chosen = [name for name in axes if name in parameters]  # a scenario of its own may lack one
    row_name, *column_names = [*chosen, *(name for name in varied if name not in chosen)][:2]
    column_name = column_names[0] if column_names else ""
    others = [name for name in varied if name not in (row_name, column_name)]
    grid_slices = _slices(records, others)
    is_mean = len(grid_slices) > MAX_SLICES
    has_several_scenarios = len(_groups(records, "swept")) > 1
    tables: list[Table] = []
    for scenario_name, scenario_records in _groups(records, "swept").items():
        systems = _groups(scenario_records, "system") if column_name else {"": scenario_records}
        for system_name, system_records in systems.items():
            for point in [{}] if is_mean else grid_slices:
                slice_records = [record for record in system_records if _is_at(record, point)]
                if not slice_records:
                    continue
                point_texts = [f"{name} = {_text(value)}" for name, value in point.items()]
                scenario_text = scenario_name if has_several_scenarios else ""
                subject = ", ".join(filter(None, [system_name, scenario_text, *point_texts]))
                table_rows = _matrix_rows(
                    slice_records, row_name, column_name, lambda cases: result_cell(cases, metric)
                )
                tables.append(
                    Table(
                        f"matrix-{len(tables) + 1}" if tables else "matrix",
                        f"{metric_title}: {subject}" if subject else metric_title,
                        (BETWEEN.join(_with_unit(records, name) for name in (row_name, column_name) if name),),
                        tuple(_text(value) for value in _column_values(slice_records, column_name)),
                        table_rows,
                        note=f"{_count_note(table_rows, _mean_note(records, others) if is_mean else '')} {NOTE}",
                    )
                )
    return tables


def _matrix_rows(
    records: Sequence[Line], row_name: str, column_name: str, cell_of: Callable[[Sequence[Line]], TableCell]
) -> tuple[TableRow, ...]:
    """Return the rows of a matrix; a point that no line has is empty."""
    members: dict[tuple[Any, Any], list[Line]] = {}
    for record in records:
        column_value = record.get(SWEEP + column_name) if column_name else record.get("system", "")
        members.setdefault((record.get(SWEEP + row_name), column_value), []).append(record)
    return tuple(
        TableRow(
            (_text(row_value),),
            tuple(
                cell_of(members[row_value, column_value]) if (row_value, column_value) in members else EMPTY
                for column_value in _column_values(records, column_name)
            ),
        )
        for row_value in _values(records, row_name)
    )


def _column_values(records: Sequence[Line], column_name: str) -> list[Any]:
    """Return the values of the parameter in the columns; the systems without one."""
    return _values(records, column_name) if column_name else list(_groups(records, "system"))


def _point_table(run: Run) -> Table:
    """Return the table of all points of a sweep and all metrics, a row a point, for further computation."""
    metrics = dict.fromkeys(
        metric
        for record in run.lines
        for metric, value in (record.get("metrics") or {}).items()
        if value is None or _is_number(value)
    )
    return Table.pivot(
        "sweep",
        "Points of the sweep",
        [record for record in run.lines if "swept" in record],
        rows={
            "System": lambda record: record.get("system", ""),
            "Scenario": lambda record: record["swept"],
            **{name: _parameter_factor(name) for name in swept_parameters(run)},
        },
        columns={name: name for name in metrics},
        metric=result_cell,
        note=NOTE,
    )


def _parameter_factor(name: str) -> Any:
    return lambda record: _text(record[SWEEP + name]) if SWEEP + name in record else ""


def _count_note(table_rows: Iterable[TableRow], mean_note: str) -> str:
    """Return in sentences how many cases are behind the numbers of a matrix."""
    filled = [table_cell for row in table_rows for table_cell in row.cells if table_cell.n or table_cell.failed]
    if not filled:
        return "No cell of these points ran."
    fewest, most = min(table_cell.n for table_cell in filled), max(table_cell.n for table_cell in filled)
    clusters = max(table_cell.clusters for table_cell in filled)
    count = str(fewest) if fewest == most else f"{fewest} to {most}"
    cluster_text = f" in {counted(clusters, 'cluster')}" if most > 1 else ""
    noun = "case" if most == 1 else "cases"
    return f"{mean_note or 'Each number is of one point of the grid.'} n = {count} {noun} behind it{cluster_text}."


def _mean_note(records: Sequence[Line], others: Sequence[str]) -> str:
    listed = ", ".join(f"{name} ({counted(len(_values(records, name)), 'value')})" for name in others)
    return f"Each number is the mean over {listed}."


def _slices(records: Sequence[Line], names: Sequence[str]) -> list[dict[str, float]]:
    """Return the combinations of values of parameters that occur, in the order of their first occurrence."""
    points = dict.fromkeys(tuple(record.get(SWEEP + name, math.nan) for name in names) for record in records)
    return [dict(zip(names, point, strict=True)) for point in points]


def _is_at(record: Line, point: Mapping[str, float]) -> bool:
    return all(record.get(SWEEP + name) == value for name, value in point.items())


def _groups(records: Sequence[Line], field_name: str) -> dict[str, list[Line]]:
    groups: dict[str, list[Line]] = {}
    for record in records:
        groups.setdefault(str(record.get(field_name, "")), []).append(record)
    return groups


def _values(records: Sequence[Line], parameter: str) -> list[float]:
    """Return the values of a swept parameter, in ascending order."""
    return sorted({value for record in records if _is_number(value := record.get(SWEEP + parameter))})


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float)


def _text(value: Any) -> str:
    return f"{value:.12g}" if _is_number(value) else str(value)


def _with_unit(records: Sequence[Line], parameter: str) -> str:
    """Return the name of a parameter with the unit that its scenario declares."""
    scenario_name = (records[0].get("spec") or {}).get("scenario") or {}
    declaration = (scenario_name.get("parameters") or {}).get(parameter)
    unit = declaration.get("unit", "") if isinstance(declaration, Mapping) else ""
    return f"{parameter}, {unit}" if unit else parameter


def terminal_matrices(run: Run) -> list[TerminalTable]:
    """Return the matrices of a run for the terminal, the last one with their notes; empty: it has no sweep."""
    tables = run_matrices(run)
    notes = dict.fromkeys(table.note for table in tables)
    matrices = []
    for table in tables:
        row_head, _, column_head = table.heads[0].partition(BETWEEN)
        table_rows = (
            TerminalRow((*row.head, *(matrix_text(table_cell, table) for table_cell in row.cells)))
            for row in table.rows
        )
        matrices.append(
            TerminalTable(
                f"{table.title} (columns: {column_head})" if column_head else table.title,
                (row_head, *table.columns),
                tuple(table_rows),
                head_count=1,
                note="\n".join(notes) if table is tables[-1] else "",
            )
        )
    return matrices


def matrix_text(table_cell: TableCell, table: Table) -> str:
    """Return the text of a cell of a matrix: empty where nothing ran, 0 or 1 where all cells are one of them."""
    means = [other.mean for row in table.rows for other in row.cells if not math.isnan(other.mean)]
    if math.isnan(table_cell.mean):
        return ""
    return f"{table_cell.mean:.0f}" if all(mean in (0.0, 1.0) for mean in means) else table_cell.text


def shade(table_cell: TableCell, table: Table) -> str:
    """Return the background of a cell of a matrix, as a CSS colour mix: from 0 to 1, or to the largest number."""
    largest = max((c.mean for row in table.rows for c in row.cells if not math.isnan(c.mean)), default=1.0)
    value = table_cell.mean if not (table_cell.failed and not math.isnan(table_cell.high)) else table_cell.high
    if math.isnan(value):
        return ""
    return f"--bad:{100 * min(max(value / max(largest, 1.0), 0.0), 1.0):.0f}%"

"""Table that a run ends with on the terminal: a few of the page's own numbers."""

from __future__ import annotations

import re
from collections import Counter

import rich.table
from rich import box
from rich.markup import escape

from ssad.report.load import Run
from ssad.report.tables import Table

MODULE = re.compile(r"^[\w.]+:(?=\w+$)")  # of "module:Class"


def terminal_table(run: Run, table: Table) -> rich.table.Table:
    """Return the measured rows of a table: n and interval of the first metric, the values of the others."""
    result = rich.table.Table(
        title=escape(run.title),
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for name in table.heads:
        result.add_column(escape(name.lower()), no_wrap=True)
    row_heads = {head for row in table.rows for head in row.head}
    # A module path is left out only where the short name is unique.
    short_counts = Counter(MODULE.sub("", head) for head in row_heads)
    display_names = {
        head: short_name if short_counts[short_name := MODULE.sub("", head)] == 1 else head for head in ("", *row_heads)
    }
    first_column, *other_columns = table.columns
    for name in ("n", first_column, "", *other_columns):
        result.add_column(escape(name), justify="right", min_width=4)
    rows = [row for row in table.rows if not row.published]
    for previous_row, row, next_row in zip([None, *rows], rows, [*rows[1:], None], strict=False):
        first_cell, *other_cells = row.cells
        repeats_head = previous_row is not None and len(row.head) > 1 and previous_row.head[0] == row.head[0]
        heads = ["" if repeats_head else row.head[0], *row.head[1:]]
        is_average = row.head[0].startswith("Avg.")
        values = [str(first_cell.n or ""), first_cell.text, first_cell.interval, *(cell.text for cell in other_cells)]
        result.add_row(
            *(escape(text) for text in (*(display_names[head] for head in heads), *values)),
            style="bold" if is_average else None,
            end_section=next_row is not None and next_row.head[0].startswith("Avg.") and not is_average,
        )
    failure_count = len(run.failures)
    notes = [
        table.note,
        f"{failure_count} of {len(run.lines)} cells failed; they widen the intervals" if failure_count else "",
    ]
    result.caption, result.caption_justify = escape("\n".join(filter(None, notes))), "left"
    return result


def comparison_table(table: Table) -> rich.table.Table:
    """Return a table of differences: who is compared first, the interval in its own column.

    Other leading columns are left out if they have one value.
    """
    result = rich.table.Table(
        title=escape(table.title),
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    varying_columns = [
        column for column in range(len(table.heads)) if column == 0 or len({row.head[column] for row in table.rows}) > 1
    ]
    for column in varying_columns:
        result.add_column(escape(table.heads[column].lower()))
    for name in (*table.columns, ""):
        result.add_column(escape(name), justify="right", no_wrap=True)
    for row in table.rows:
        *values, difference, p_value = row.cells
        texts = [*(cell.text for cell in values), difference.text, p_value.text, difference.interval]
        result.add_row(*(escape(text) for text in (*(row.head[column] for column in varying_columns), *texts)))
    return result

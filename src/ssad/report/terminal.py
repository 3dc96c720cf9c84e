"""The table that a run ends with on the terminal: a few of the page's own numbers."""

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
    """Rows of a table that were measured here: n and interval of the first metric, the values of the others."""
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
    every = {head for row in table.rows for head in row.head}
    bare = Counter(MODULE.sub("", head) for head in every)
    shown = {head: short if bare[short := MODULE.sub("", head)] == 1 else head for head in ("", *every)}
    first, *others = table.columns
    for name in ("n", first, "", *others):
        result.add_column(escape(name), justify="right", min_width=4)
    rows = [row for row in table.rows if not row.published]
    for before, row, after in zip([None, *rows], rows, [*rows[1:], None], strict=False):
        one, *rest = row.cells
        same = before is not None and len(row.head) > 1 and before.head[0] == row.head[0]
        heads = ["" if same else row.head[0], *row.head[1:]]
        average = row.head[0].startswith("Avg.")
        values = [str(one.n or ""), one.text, one.interval, *(cell.text for cell in rest)]
        result.add_row(
            *(escape(text) for text in (*(shown[head] for head in heads), *values)),
            style="bold" if average else None,
            end_section=after is not None and after.head[0].startswith("Avg.") and not average,
        )
    failed = len(run.failures)
    notes = [table.note, f"{failed} of {len(run.lines)} cells failed and count" if failed else ""]
    result.caption, result.caption_justify = escape("\n".join(filter(None, notes))), "left"
    return result


def comparison_table(table: Table) -> rich.table.Table:
    """A table of differences: the interval in a column of its own, leading columns that say nothing left out."""
    result = rich.table.Table(
        title=escape(table.title),
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    telling = [k for k in range(len(table.heads)) if len({row.head[k] for row in table.rows}) > 1]
    for k in telling:
        result.add_column(escape(table.heads[k].lower()))
    for name in (*table.columns, ""):
        result.add_column(escape(name), justify="right", no_wrap=True)
    for row in table.rows:
        *values, difference, p = row.cells
        texts = [*(cell.text for cell in values), difference.text, p.text, difference.interval]
        result.add_row(*(escape(text) for text in (*(row.head[k] for k in telling), *texts)))
    return result

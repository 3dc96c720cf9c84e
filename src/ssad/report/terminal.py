"""The table that a run ends with on the terminal: a few of the page's own numbers."""

from __future__ import annotations

from pathlib import Path

import rich.table
from rich import box

from ssad.report.load import load_run
from ssad.report.pages import kind_module


def summary(folder: Path | str) -> rich.table.Table:
    """Our rows of the first table of a run's kind: n and interval of the first metric, the values of the others.

    Raises:
        StoreError: the folder holds no run with results.
    """
    run = load_run(folder)
    table = kind_module(run.kind).summary(run)
    result = rich.table.Table(
        title=run.title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False
    )
    for name in table.heads:
        result.add_column(name.lower(), overflow="fold")
    first, *others = table.columns
    for name in ("n", first, "", *others):
        result.add_column(name, justify="right", no_wrap=True)
    rows = [row for row in table.rows if not row.published]
    for row, after in zip(rows, [*rows[1:], None], strict=True):
        one, *rest = row.cells
        heads = (head.rsplit(":", maxsplit=1)[-1] for head in row.head)
        ends = after is not None and len(row.head) > 1 and after.head[0] != row.head[0]
        result.add_row(*heads, str(one.n or ""), one.text, one.interval, *(c.text for c in rest), end_section=ends)
    failed = len(run.failures)
    notes = [table.note, f"{failed} of {len(run.lines)} cells failed and count" if failed else ""]
    result.caption, result.caption_justify = "\n".join(filter(None, notes)), "left"
    return result

"""Table that a run ends with on the terminal: a few of the page's own numbers, in full at any width."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import rich.table
from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType
from rich.text import Text

from ssad.report.load import Run
from ssad.report.tables import Table

MODULE = re.compile(r"^[\w.]+:(?=\w+$)")  # of "module:Class"
MIN_COLUMN_WIDTH = 4
GAP, EDGES = 2, 2  # characters between two columns, and at both ends of a row


@dataclass(frozen=True)
class TerminalRow:
    """A row of a terminal table.

    Attributes:
        texts: A text for each column.
        is_average: Whether it averages other rows: bold.
        ends_section: Whether a blank line follows.
    """

    texts: tuple[str, ...]
    is_average: bool = False
    ends_section: bool = False


@dataclass(frozen=True)
class TerminalTable:
    """Table whose title, note, names and numbers are complete on a terminal of any width.

    Names of columns wrap between words. Columns that do not fit beside the others follow in a further block, which
    repeats the leading columns.

    Attributes:
        title: Title above the table.
        columns: Names of the columns; an empty name continues the column before it and stays beside it.
        rows: Rows.
        head_count: Number of leading columns, which name the row.
        note: Text below the table; its line breaks are kept.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[TerminalRow, ...]
    head_count: int
    note: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        """Yield title, blocks of columns and note, as rich asks for them."""
        yield Text(self.title, style="bold")
        for block in self.blocks(options.max_width):
            yield self._block_table(block, options.max_width)
        if self.note:
            yield Text(self.note, style="table.caption")

    def blocks(self, width: int) -> list[list[int]]:
        """Return the columns of each block; blocks are at most `width` characters wide where that is possible."""
        heads = list(range(self.head_count))
        blocks: list[list[int]] = []
        for group in self._groups():
            if blocks and self._block_width([*blocks[-1], *group]) <= width:
                blocks[-1] += group
            else:
                blocks.append([*heads, *group])
        return blocks or [heads]

    def _groups(self) -> list[list[int]]:
        """Return the columns behind the leading ones, those that belong together in one group."""
        groups: list[list[int]] = []
        for column in range(self.head_count, len(self.columns)):
            if groups and not self.columns[column]:
                groups[-1].append(column)
            else:
                groups.append([column])
        return groups

    def _width(self, column: int, *, name_in_one_line: bool = False) -> int:
        """Return the characters that a column needs for its cells, and for its name or the longest word of it."""
        name = self.columns[column]
        parts = [name] if name_in_one_line else name.split()
        texts = [*parts, *(row.texts[column] for row in self.rows)]
        return max(MIN_COLUMN_WIDTH * (column >= self.head_count), *map(cell_len, texts), 0)

    def _block_width(self, columns: Sequence[int], *, name_in_one_line: bool = False) -> int:
        widths = [self._width(column, name_in_one_line=name_in_one_line) for column in columns]
        return sum(widths) + GAP * (len(widths) - 1) + EDGES

    def _block_table(self, columns: Sequence[int], width: int) -> rich.table.Table:
        result = rich.table.Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        name_in_one_line = self._block_width(columns, name_in_one_line=True) <= width
        for column in columns:
            is_head = column < self.head_count
            # Rich shortens numbers before it wraps names, so widths are fixed; names of rows that alone are wider
            # than the terminal fold.
            column_width = self._width(column, name_in_one_line=name_in_one_line)
            result.add_column(
                Text(self.columns[column]),
                justify="left" if is_head else "right",
                width=None if is_head and self._block_width(columns) > width else column_width,
                overflow="fold",
            )
        for row in self.rows:
            result.add_row(
                *(Text(row.texts[column]) for column in columns),
                style="bold" if row.is_average else None,
                end_section=row.ends_section,
            )
        return result


def terminal_table(run: Run, table: Table) -> TerminalTable:
    """Return the measured rows of a table: n and interval of the first metric, the values of the others."""
    row_heads = {head for row in table.rows for head in row.head}
    # A module path is left out only where the short name is unique.
    short_counts = Counter(MODULE.sub("", head) for head in row_heads)
    display_names = {
        head: short_name if short_counts[short_name := MODULE.sub("", head)] == 1 else head for head in ("", *row_heads)
    }
    rows = [row for row in table.rows if not row.published]
    terminal_rows = []
    for previous_row, row, next_row in zip([None, *rows], rows, [*rows[1:], None], strict=False):
        first_cell, *other_cells = row.cells
        repeats_head = previous_row is not None and len(row.head) > 1 and previous_row.head[0] == row.head[0]
        heads = ["" if repeats_head else row.head[0], *row.head[1:]]
        is_average = row.head[0].startswith("Avg.")
        values = [str(first_cell.n or ""), first_cell.text, first_cell.interval, *(cell.text for cell in other_cells)]
        terminal_rows.append(
            TerminalRow(
                (*(display_names[head] for head in heads), *values),
                is_average=is_average,
                ends_section=next_row is not None and next_row.head[0].startswith("Avg.") and not is_average,
            )
        )
    failure_count = len(run.failures)
    notes = [
        table.note,
        f"{failure_count} of {len(run.lines)} cells failed; they widen the intervals" if failure_count else "",
    ]
    first_column, *other_columns = table.columns
    return TerminalTable(
        run.title,
        (*(name.lower() for name in table.heads), "n", first_column, "", *other_columns),
        tuple(terminal_rows),
        len(table.heads),
        "\n".join(filter(None, notes)),
    )


def comparison_table(table: Table) -> TerminalTable:
    """Return a table of differences: who is compared first, the interval in its own column.

    Other leading columns are left out if they have one value.
    """
    varying_columns = [
        column for column in range(len(table.heads)) if column == 0 or len({row.head[column] for row in table.rows}) > 1
    ]
    rows = []
    for row in table.rows:
        *values, difference, p_value = row.cells
        texts = [*(cell.text for cell in values), difference.text, p_value.text, difference.interval]
        rows.append(TerminalRow((*(row.head[column] for column in varying_columns), *texts)))
    names = (*(table.heads[column].lower() for column in varying_columns), *table.columns, "")
    return TerminalTable(table.title, names, tuple(rows), len(varying_columns))

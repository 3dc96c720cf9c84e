"""Tables of a run, ours and the paper's, as data and as CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from ssad.core import safeio
from ssad.core.folders import path_inside
from ssad.core.wording import counted
from ssad.metrics import Estimate

Record = TypeVar("Record")
Column = TypeVar("Column")
Result = TypeVar("Result")

METHODS = (
    "[a, b]: 95 % interval, from how the clusters (routes of towns, recorded drives) vary: beta limits for shares and "
    "other bounded numbers, Student's t for other means. a–b: the range of the clusters' means, where they are too few "
    "(ten routes of a town, five drives of a recording) or too alike for an interval. Copies of one case count once. "
    "n and means: cases that ran; the limits of shares and other bounded numbers hold whatever the failed ones were. "
    "n/a: not measured."
)


@dataclass(frozen=True)
class TableCell:
    """One number, with the interval and counts of `ssad.metrics.Estimate`; a published number has only its mean."""

    mean: float
    low: float = math.nan
    high: float = math.nan
    n: int = 0
    failed: int = 0
    clusters: int = 0
    method: str = ""
    digits: int = 2
    smallest: float = 0.0  # smallest number that is written out; of smaller ones it is only said that they are

    @classmethod
    def of(cls, estimate: Estimate) -> TableCell:
        """Return the cell of an estimate."""
        return cls(
            estimate.mean, estimate.low, estimate.high, estimate.n, estimate.failed, estimate.clusters, estimate.method
        )

    @classmethod
    def value(cls, number: float | None, *, digits: int = 2) -> TableCell:
        """Return the cell of a number without an interval; None: it was not measured."""
        return cls(math.nan if number is None else number, digits=digits)

    @property
    def text(self) -> str:
        """The number, or n/a."""
        if 0.0 <= self.mean < self.smallest:
            return f"<{self.smallest:.{self.digits}f}"
        return "n/a" if math.isnan(self.mean) else f"{self.mean:.{self.digits}f}"

    @property
    def interval(self) -> str:
        """`[low, high]` of an interval, `low–high` (`low to high` below 0) of a range or of bounds, or empty."""
        if math.isnan(self.low) or math.isnan(self.high):
            return ""
        if self.method in ("range", "bounds"):
            return f"{self.low:.2f}{' to ' if self.low < 0.0 else '–'}{self.high:.2f}"
        return f"[{self.low:.2f}, {self.high:.2f}]"

    @property
    def count(self) -> str:
        """`n = 40 in 4 clusters, 2 failed`; n are the cases that ran."""
        if not self.n and not self.failed:
            return ""
        cluster_text = f" in {counted(self.clusters, 'cluster')}" if self.clusters not in (0, self.n) else ""
        return f"n = {self.n}{cluster_text}" + (f", {self.failed} failed" if self.failed else "")

    @property
    def tip(self) -> str:
        """Count and interval of the number, in a line."""
        method_names = {
            "range": "range over the clusters",
            "bounds": "bounds, whatever the failed cases were",
            "beta": "95 % interval, beta",
            "t": "95 % interval, Student's t",
        }
        interval_text = f"{self.interval} ({method_names.get(self.method, '95 % interval')})" if self.interval else ""
        return ", ".join(part for part in (self.count, interval_text) if part)


@dataclass(frozen=True)
class TableRow:
    """A line of a table; `published` marks numbers that are not ours."""

    head: tuple[str, ...]
    cells: tuple[TableCell, ...]
    published: bool = False

    @classmethod
    def of_published(cls, head: Sequence[str], numbers: Iterable[float | None]) -> TableRow:
        """Return a row of published numbers; None: the publication has no number there."""
        return cls(tuple(head), tuple(TableCell.value(number) for number in numbers), published=True)


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: Name of its files.
        title: Title.
        heads: Heads of the leading columns.
        columns: Heads of the other columns.
        rows: Rows.
        note: Text under the table.
        source: Source of the published numbers.
        clock: Those of `columns` that the machine's clock decides: equal runs differ there.
    """

    name: str
    title: str
    heads: tuple[str, ...]
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    note: str = ""
    source: str = ""
    clock: tuple[str, ...] = ()

    @classmethod
    def pivot(
        cls,
        name: str,
        title: str,
        records: Iterable[Record],
        *,
        rows: Mapping[str, Callable[[Record], object]],
        columns: Mapping[Column, str],
        metric: Callable[[Sequence[Record], Column], TableCell],
        key: Callable[[Record], Hashable] | None = None,
        condition: Callable[[Sequence[Record]], bool] | None = None,
        published: Callable[[Record], Iterable[TableRow]] | None = None,
        footer_rows: Iterable[TableRow] = (),
        note: str = "",
        source: str = "",
    ) -> Table:
        """Return a table with a row for each combination of the row factors, in the order of the records.

        Args:
            name: Name of the table's files.
            title: Title of the table.
            records: Records of a run, such as its lines; a generator expression selects and sorts them.
            rows: Heads of the leading columns -> factor: its value for a record, shown as text.
            columns: Names of metrics, or values of a column factor -> heads of the other columns.
            metric: Function of a row's records and a column, which estimates the number there and its interval.
            key: Key that the records of a row share; None: the values of the row factors.
            condition: Condition on the records of a row; other rows are left out.
            published: Rows of published numbers that follow the row of a record (the first of its row).
            footer_rows: Rows of published numbers at the end.
            note: Text under the table.
            source: Source of the published numbers.
        """
        groups: dict[Hashable, list[Record]] = {}
        for record in records:
            group = key(record) if key else tuple(str(factor(record)) for factor in rows.values())
            groups.setdefault(group, []).append(record)
        table_rows: list[TableRow] = []
        for group_records in groups.values():
            if condition is None or condition(group_records):
                first_record = group_records[0]
                head = tuple(str(factor(first_record)) for factor in rows.values())
                table_rows.append(TableRow(head, tuple(metric(group_records, column) for column in columns)))
                table_rows += published(first_record) if published else ()
        return cls(name, title, tuple(rows), tuple(columns.values()), (*table_rows, *footer_rows), note, source)

    @classmethod
    def listing(
        cls,
        name: str,
        title: str,
        records: Iterable[Record],
        *,
        rows: Mapping[str, Callable[[Record], object]],
        columns: Mapping[Column, str],
        metric: Callable[[Record, Column], TableCell],
        published: Callable[[Record], Iterable[TableRow]] | None = None,
        footer_rows: Iterable[TableRow] = (),
        note: str = "",
        source: str = "",
    ) -> Table:
        """Return a table with a row for each record; the arguments are those of `pivot`."""
        return Table.pivot(
            name,
            title,
            enumerate(records),
            rows={head: partial(_of_second, factor) for head, factor in rows.items()},
            columns=columns,
            metric=lambda entries, column: metric(entries[0][1], column),
            key=lambda entry: entry[0],
            published=partial(_of_second, published) if published else None,
            footer_rows=footer_rows,
            note=note,
            source=source,
        )


def _of_second(function: Callable[[Record], Result], entry: tuple[int, Record]) -> Result:
    """Return a function of the record of a numbered record."""
    return function(entry[1])


def to_csv(table: Table, *, clock: bool = True) -> str:
    """Return one line a number, with interval, n, source, clusters and method: for further computation.

    Args:
        table: The table.
        clock: Whether the columns that the machine's clock decides are there too.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    heads = ("column", "mean", "low", "high", "n", "failed", "source", "clusters", "method")
    writer.writerow([*(head.lower() for head in table.heads), *heads])
    for row in table.rows:
        for column, cell in zip(table.columns, row.cells, strict=True):
            if column in table.clock and not clock:
                continue
            numbers = ["" if math.isnan(number) else repr(float(number)) for number in (cell.mean, cell.low, cell.high)]
            source = "published" if row.published else "ours"
            details = (
                [cell.n, cell.failed, source, cell.clusters, cell.method]
                if cell.n or cell.failed
                else ["", "", source, "", ""]
            )
            writer.writerow([*row.head, column, *numbers, *details])
    return buffer.getvalue()


def to_markdown(table: Table) -> str:
    """Return a table for a README or an issue."""
    titles = [*table.heads, *table.columns]
    lines = [f"## {table.title}", "", "| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
    for row in table.rows:
        suffix = " (published)" if row.published else ""
        names = [*row.head[:-1], row.head[-1] + suffix]
        cells = [f"{cell.text} {cell.interval}".strip() for cell in row.cells]
        lines.append("| " + " | ".join(text.replace("|", "\\|") for text in [*names, *cells]) + " |")
    return "\n".join([*lines, "", table.note, ""])


_TEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"} | {
    c: "\\" + c for c in "&%$#_{}"
}


def tex(text: str) -> str:
    """Return text with LaTeX's special characters escaped."""
    return "".join(_TEX.get(character, character) for character in text)


def to_latex(table: Table) -> str:
    r"""Return a booktabs tabular, with the note as a comment before it; it needs \usepackage{booktabs}."""
    lines = [
        *(f"% {line}" for line in table.note.splitlines()),
        "\\begin{tabular}{" + "l" * len(table.heads) + "c" * len(table.columns) + "}",
        "\\toprule",
        " & ".join(tex(head) for head in [*table.heads, *table.columns]) + r" \\",
        "\\midrule",
    ]
    previous_row = None
    for row in table.rows:
        if previous_row is not None and (
            row.head[0] != previous_row.head[0] if len(row.head) == 2 else row.published != previous_row.published
        ):
            lines.append("\\midrule")
        names = [tex(head) for head in row.head]
        if row.published:
            names[-1] += r"$^\dagger$"
        cells = [cell.text + (f" {{\\scriptsize {cell.interval}}}" if cell.interval else "") for cell in row.cells]
        lines.append(" & ".join([*names, *cells]) + r" \\")
        previous_row = row
    if any(row.published for row in table.rows):
        width = len(table.heads) + len(table.columns)
        lines += ["\\midrule", rf"\multicolumn{{{width}}}{{l}}{{\footnotesize $^\dagger$ {tex(table.source)}}} \\"]
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", ""])


def write_tables(folder: Path, tables: Sequence[Table]) -> list[Path]:
    """Write tables/NAME.csv, .md and .tex, each whole or not at all.

    Args:
        folder: Parent of the folder `tables`.
        tables: The tables.

    Returns:
        Paths of the files.

    Raises:
        StoreError: A file cannot be written.
    """
    paths = []
    safeio.make_folder(folder / "tables")
    for table in tables:
        for suffix, text in (("csv", to_csv(table)), ("md", to_markdown(table)), ("tex", to_latex(table))):
            path = path_inside(folder / "tables", f"{table.name}.{suffix}")
            safeio.write_atomic(path, text)
            paths.append(path)
    return paths

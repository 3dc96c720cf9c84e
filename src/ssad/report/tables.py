"""Tables of a run, ours and the paper's, as data and as CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ssad.core import safeio
from ssad.metrics import METRICS, Estimate, GroupRow, aggregate, aggregate_groups
from ssad.metrics.driving import DIVISORS, normalised
from ssad.report.load import Run
from ssad.report.paper import NATURAL, PRECRASH, SCENARIOS, SOURCE

SHOWN = ("CR", "OR", "DR", "RC")
NATURAL_TYPE = "NaturalJunction"


@dataclass(frozen=True)
class Cell:
    """One number with its 95 % interval and denominator; a published number has none."""

    mean: float
    low: float = math.nan
    high: float = math.nan
    n: int = 0
    failed: int = 0

    @property
    def text(self) -> str:
        """The number, or a dash."""
        return "-" if math.isnan(self.mean) else f"{self.mean:.2f}"

    @property
    def interval(self) -> str:
        """`[low, high]`, or nothing."""
        return "" if math.isnan(self.low) or math.isnan(self.high) else f"[{self.low:.2f}, {self.high:.2f}]"

    @property
    def count(self) -> str:
        """`n=4`, with the failed ones named."""
        if not self.n:
            return ""
        return f"n={self.n}" + (f", {self.failed} failed" if self.failed else "")


@dataclass(frozen=True)
class Row:
    """A line of a table; `published` marks numbers that are not ours."""

    head: tuple[str, ...]
    cells: tuple[Cell, ...]
    published: bool = False


@dataclass(frozen=True)
class Table:
    """A table: name of its files, title, heads of the leading columns, and the rest."""

    name: str
    title: str
    heads: tuple[str, ...]
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""
    source: str = SOURCE


def _cell(estimate: Estimate) -> Cell:
    return Cell(estimate.mean, estimate.low, estimate.high, estimate.n, estimate.failed)


def precrash_table(run: Run) -> Table | None:
    """Metric x system rows, the eight scenarios and their average: the form of the paper's table, its rows below."""
    mine = [r for r in run.records if r.group in SCENARIOS]
    if not mine:
        return None
    found: dict[tuple[str, str], GroupRow] = {
        (row.system, row.group): row for row in aggregate_groups([(r.system, r.group, r.metrics) for r in mine])
    }
    groups = [*SCENARIOS, "Avg."]
    rows = []
    for symbol in SHOWN:
        for system in run.systems:
            if (system, "Avg.") not in found:
                continue
            cells = [
                _cell(found[system, group].values[symbol]) if (system, group) in found else Cell(math.nan)
                for group in groups
            ]
            rows.append(Row((symbol, system), tuple(cells)))
        for system, values in PRECRASH[symbol].items():
            rows.append(Row((symbol, system), tuple(Cell(v) for v in values), published=True))
    return Table(
        "precrash",
        "Pre-crash scenarios",
        ("Metric", "System"),
        (*SCENARIOS.values(), "Avg."),
        tuple(rows),
        f"Shaded rows: {SOURCE}. 95 % intervals: Wilson for CR, bootstrap for the others; Avg. is the mean of the "
        f"scenarios' values. A failed episode counts in the denominator. {_counts(rows)}",
    )


def _counts(rows: Sequence[Row]) -> str:
    """How many episodes are behind the numbers, in a sentence."""
    parts = []
    for row in rows:
        ns = sorted({c.n for c in row.cells[:-1] if c.n})
        if ns and not row.published and row.head[0] == rows[0].head[0]:
            parts.append(f"{row.head[1]} {ns[0]}" if len(ns) == 1 else f"{row.head[1]} {ns[0]} to {ns[-1]}")
    return f"Episodes in a cell (n): {', '.join(parts)}."


def natural_table(run: Run) -> Table | None:
    """System x town: CR, OR, DR, RC among random traffic, the paper's rows below."""
    mine = [r for r in run.records if r.type == NATURAL_TYPE]
    if not mine:
        return None
    towns = list(dict.fromkeys(r.town for r in mine))
    rows = []
    for system in run.systems:
        for town in towns:
            members = [r.metrics for r in mine if r.system == system and r.town == town]
            if members:
                values = aggregate(members)
                rows.append(
                    Row((system, f"Autopilot, n = {len(members)}", town), tuple(_cell(values[s]) for s in SHOWN))
                )
    for (system, traffic), by_town in NATURAL.items():
        for town, numbers in by_town.items():
            rows.append(Row((system, traffic, town), (*(Cell(v) for v in numbers), Cell(math.nan)), published=True))
    return Table(
        "natural",
        "Natural junction routes",
        ("System", "Traffic", "Town"),
        SHOWN,
        tuple(rows),
        f"Shaded rows: {SOURCE}. Their DR fits SafeBench's normalised scale (DR / 5 m); ours here is in metres, and "
        "includes up to half a metre of spacing between route points. See also the normalised table.",
    )


def full_table(run: Run) -> Table:
    """Every metric for every system and group."""
    rows = [
        Row((row.system, SCENARIOS.get(row.group, row.group)), tuple(_cell(row.values[s]) for s in METRICS))
        for row in aggregate_groups([(r.system, r.group, r.metrics) for r in run.records])
    ]
    return Table("metrics", "All metrics", ("System", "Group"), tuple(METRICS), tuple(rows))


def normalised_table(run: Run) -> Table:
    """The terms of SafeBench's overall score, each 0 (best) to 1 (worst), and the two scores made of them."""
    rows = []
    for row in aggregate_groups([(r.system, r.group, r.metrics) for r in run.records]):
        terms = {"CR": row.values["CR"], "OR": row.values["OR"], "DR": row.values["DR"], "TS": row.values["TS"]}
        cells = {name: _scaled(name, estimate) for name, estimate in terms.items()}
        rc, score = row.values["RC"], row.values["OS"]
        cells["IR"] = Cell(1.0 - rc.mean, 1.0 - rc.high, 1.0 - rc.low, rc.n, rc.failed)
        frea = Cell(1.0 - score.mean, 1.0 - score.high, 1.0 - score.low, score.n, score.failed)
        shown = (cells["CR"], cells["OR"], cells["DR"], cells["IR"], cells["TS"], _cell(score), frea)
        rows.append(Row((row.system, SCENARIOS.get(row.group, row.group)), shown))
    return Table(
        "normalised",
        "Normalised metrics and overall scores",
        ("System", "Group"),
        (
            "CR",
            f"OR / {DIVISORS['OR']:g} m",
            f"DR / {DIVISORS['DR']:g} m",
            "1 - RC",
            f"TS / {DIVISORS['TS']:g} s",
            "SafeBench score (lower is better)",
            "FREA score (higher is better)",
        ),
        tuple(rows),
        "SafeBench's score weighs CR 0.4, OR 0.1, DR 0.1, 1 - RC 0.3, TS 0.1; FREA's is one minus it.",
    )


def _scaled(name: str, estimate: Estimate) -> Cell:
    """A raw metric over its divisor, cut at 1."""
    mean, low, high = (
        v if math.isnan(v) else normalised(name, v) for v in (estimate.mean, estimate.low, estimate.high)
    )
    return Cell(mean, low, high, estimate.n, estimate.failed)


def tables(run: Run) -> list[Table]:
    """All tables of a run."""
    found = (precrash_table(run), natural_table(run), normalised_table(run), full_table(run))
    return [t for t in found if t is not None]


def to_csv(table: Table) -> str:
    """One line a number, with interval, n and source: for further computation."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*(h.lower() for h in table.heads), "column", "mean", "low", "high", "n", "failed", "source"])
    for row in table.rows:
        for column, cell in zip(table.columns, row.cells, strict=True):
            numbers = ["" if math.isnan(v) else repr(float(v)) for v in (cell.mean, cell.low, cell.high)]
            source = "published" if row.published else "ours"
            writer.writerow([*row.head, column, *numbers, cell.n or "", cell.failed if cell.n else "", source])
    return out.getvalue()


def to_markdown(table: Table) -> str:
    """A table for a README or an issue."""
    head = [*table.heads, *table.columns]
    lines = [f"## {table.title}", "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in table.rows:
        mark = " (published)" if row.published else ""
        names = [*row.head[:-1], row.head[-1] + mark]
        cells = [f"{c.text} {c.interval}".strip() for c in row.cells]
        lines.append("| " + " | ".join(n.replace("|", "\\|") for n in [*names, *cells]) + " |")
    return "\n".join([*lines, "", table.note, ""])


_TEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"} | {
    c: "\\" + c for c in "&%$#_{}"
}


def tex(text: str) -> str:
    """Text with LaTeX's special characters escaped."""
    return "".join(_TEX.get(c, c) for c in text)


def to_latex(table: Table) -> str:
    """A booktabs tabular; needs \\usepackage{booktabs}."""
    lines = [
        "\\begin{tabular}{" + "l" * len(table.heads) + "c" * len(table.columns) + "}",
        "\\toprule",
        " & ".join(tex(h) for h in [*table.heads, *table.columns]) + r" \\",
        "\\midrule",
    ]
    last = None
    for row in table.rows:
        if last is not None and (
            row.head[0] != last.head[0] if len(row.head) == 2 else row.published != last.published
        ):
            lines.append("\\midrule")
        names = [tex(h) for h in row.head]
        if row.published:
            names[-1] += r"$^\dagger$"
        cells = [c.text + (f" {{\\scriptsize {c.interval}}}" if c.interval else "") for c in row.cells]
        lines.append(" & ".join([*names, *cells]) + r" \\")
        last = row
    if any(row.published for row in table.rows):
        width = len(table.heads) + len(table.columns)
        lines += ["\\midrule", rf"\multicolumn{{{width}}}{{l}}{{\footnotesize $^\dagger$ {tex(table.source)}}} \\"]
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", ""])


def write_tables(folder: Path, found: Sequence[Table]) -> list[Path]:
    """tables/<name>.csv, .md and .tex, each written whole or not at all. StoreError."""
    out = []
    (folder / "tables").mkdir(parents=True, exist_ok=True)
    for table in found:
        for suffix, text in (("csv", to_csv(table)), ("md", to_markdown(table)), ("tex", to_latex(table))):
            path = folder / "tables" / f"{table.name}.{suffix}"
            safeio.write_atomic(path, text)
            out.append(path)
    return out

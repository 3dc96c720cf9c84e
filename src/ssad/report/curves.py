"""Small plots in rows, one line a system, its interval as a band: as inline SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from ssad.report.tables import Cell

WIDE, HIGH, COLUMNS, GAP = 178, 118, 4, 34


@dataclass(frozen=True)
class Point:
    """A number of a line: where it lies along the axis, 0 to 1, the number, and what is told of it."""

    at: float
    cell: Cell
    tip: str


@dataclass(frozen=True)
class Panel:
    """One small plot.

    Attributes:
        title: above it.
        ticks: places along the axis, 0 to 1, and what stands there.
        lines: points of each line, in the order of the colours; the number n/a is left out.
    """

    title: str
    ticks: Sequence[tuple[float, str]]
    lines: Sequence[Sequence[Point]]


def panels(found: Sequence[Panel], *, label: str, columns: int = COLUMNS) -> str:
    """All plots in one scale from 0; as SVG text.

    Args:
        found: the plots.
        label: what a screen reader says.
        columns: plots in a row.
    """
    cells = [point.cell for panel in found for line in panel.lines for point in line]
    ends = [cell.mean if math.isnan(cell.high) else cell.high for cell in cells if not math.isnan(cell.mean)]
    top = max(10.0, 10 * math.ceil(max(ends, default=1.0) / 10))
    parts = []
    for number, panel in enumerate(found):
        left, under = 36 + (number % columns) * (WIDE + GAP), 24 + (number // columns) * (HIGH + 46)

        def place(at: float, value: float, left: int = left, under: int = under) -> str:
            return f"{left + WIDE * at:.1f},{under + HIGH * (1 - min(max(value / top, 0.0), 1.0)):.1f}"

        parts.append(f'<text x="{left}" y="{under - 8}" class="name">{escape(panel.title)}</text>')
        for share in (0.0, 0.5, 1.0):
            y = under + HIGH * (1 - share)
            parts.append(f'<line x1="{left}" x2="{left + WIDE}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>')
            parts.append(f'<text x="{left - 5}" y="{y + 4:.1f}" text-anchor="end">{top * share:.0f}</text>')
        for at, name in panel.ticks:
            x = left + WIDE * at
            parts.append(f'<text x="{x:.1f}" y="{under + HIGH + 15}" text-anchor="middle">{escape(name)}</text>')
        for index, line in enumerate(panel.lines):
            shown = [point for point in line if not math.isnan(point.cell.mean)]
            colour = f"var(--s{index % 5})"
            known = [point for point in shown if not math.isnan(point.cell.low)]
            if known:
                edge = [place(p.at, p.cell.high) for p in known] + [place(p.at, p.cell.low) for p in reversed(known)]
                parts.append(f'<polygon points="{" ".join(edge)}" fill="{colour}" opacity=".16"/>')
            path = " ".join(place(p.at, p.cell.mean) for p in shown)
            parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
            for point in shown:
                x_text, y_text = place(point.at, point.cell.mean).split(",")
                tip = escape(f"{point.tip}: {point.cell.text} {point.cell.interval}")
                parts.append(f'<circle cx="{x_text}" cy="{y_text}" r="3" fill="{colour}"><title>{tip}</title></circle>')
    rows = -(-len(found) // columns)
    return (
        f'<svg viewBox="0 0 {36 + columns * (WIDE + GAP)} {rows * (HIGH + 46) + 12}" role="img" '
        f'aria-label="{escape(label)}">{"".join(parts)}</svg>'
    )

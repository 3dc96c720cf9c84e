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
    """A number of a line: its place along the axis, 0 to 1, the number, and its tool tip."""

    at: float
    cell: Cell
    tip: str


@dataclass(frozen=True)
class Panel:
    """One small plot.

    Attributes:
        title: Title above it.
        ticks: Places along the axis, 0 to 1, and their labels.
        lines: Points of each line, in the order of the colours; points without a number are left out.
    """

    title: str
    ticks: Sequence[tuple[float, str]]
    lines: Sequence[Sequence[Point]]


def panels(found: Sequence[Panel], *, label: str, columns: int = COLUMNS) -> str:
    """Draw all plots in one scale from 0; as SVG text.

    Args:
        found: The plots.
        label: Label for screen readers.
        columns: Plots in a row.
    """
    cells = [point.cell for panel in found for line in panel.lines for point in line]
    upper_ends = [cell.mean if math.isnan(cell.high) else cell.high for cell in cells if not math.isnan(cell.mean)]
    top = max(10.0, 10 * math.ceil(max(upper_ends, default=1.0) / 10))
    parts = []
    for panel_index, panel in enumerate(found):
        left, under = 36 + (panel_index % columns) * (WIDE + GAP), 24 + (panel_index // columns) * (HIGH + 46)

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
            measured = [point for point in line if not math.isnan(point.cell.mean)]
            colour = f"var(--s{index % 5})"
            with_interval = [point for point in measured if not math.isnan(point.cell.low)]
            if with_interval:
                # The outline of the band: along the upper limits and back along the lower ones.
                band_outline = [place(vertex.at, vertex.cell.high) for vertex in with_interval] + [
                    place(vertex.at, vertex.cell.low) for vertex in reversed(with_interval)
                ]
                parts.append(f'<polygon points="{" ".join(band_outline)}" fill="{colour}" opacity=".16"/>')
            path = " ".join(place(vertex.at, vertex.cell.mean) for vertex in measured)
            parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
            for point in measured:
                x_text, y_text = place(point.at, point.cell.mean).split(",")
                tip = escape(f"{point.tip}: {point.cell.text} {point.cell.interval}")
                parts.append(f'<circle cx="{x_text}" cy="{y_text}" r="3" fill="{colour}"><title>{tip}</title></circle>')
    rows = -(-len(found) // columns)
    return (
        f'<svg viewBox="0 0 {36 + columns * (WIDE + GAP)} {rows * (HIGH + 46) + 12}" role="img" '
        f'aria-label="{escape(label)}">{"".join(parts)}</svg>'
    )

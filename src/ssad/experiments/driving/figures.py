"""Figures as inline SVG."""

from __future__ import annotations

import math
from html import escape

from ssad.experiments.driving.episodes import DrivingRun
from ssad.report.tables import Cell

# names end at LABEL, the axis begins at LEFT and is WIDTH long: % of the figure's width, so that it fits any screen
LABEL, LEFT, WIDTH = 44, 47, 48
STEP, GAP = 15, 12  # px
COLOURS = ("var(--s0)", "var(--s1)", "var(--s2)", "var(--s3)", "var(--s4)")


def interval_plot(run: DrivingRun, symbol: str = "CR") -> str:
    """A rate of every system in every group and average, as SVG text: intervals as bars, ranges as thin dashes."""
    parts: list[str] = []
    y = 8.0
    for group, name in run.headings.items():
        system_cells = [
            (candidate, Cell.of(run.numbers[candidate, group][symbol]))
            for candidate in run.systems
            if (candidate, group) in run.numbers
        ]
        if not system_cells:
            continue
        group_y = y + STEP * len(system_cells) / 2
        parts.append(f'<text x="{LABEL}%" y="{group_y + 4:.1f}" text-anchor="end">{escape(name)}</text>')
        for system, cell in system_cells:
            colour = COLOURS[run.systems.index(system) % len(COLOURS)]
            row_y = y + STEP / 2
            if cell.interval:
                low, high = LEFT + WIDTH * cell.low, LEFT + WIDTH * cell.high
                style = (
                    'stroke-width="1.5" stroke-dasharray="3 3"'
                    if cell.method == "range"
                    else 'stroke-width="3" stroke-linecap="round" opacity=".45"'
                )
                parts.append(
                    f'<line x1="{low:.2f}%" x2="{high:.2f}%" y1="{row_y}" y2="{row_y}" stroke="{colour}" {style}/>'
                )
            if not math.isnan(cell.mean):
                parts.append(
                    f'<circle cx="{LEFT + WIDTH * cell.mean:.2f}%" cy="{row_y}" r="5" fill="{colour}">'
                    f"<title>{escape(f'{system}: {cell.text}, {cell.tip}')}</title></circle>"
                )
            y += STEP
        y += GAP
    height = y + 22
    grid_lines = "".join(
        f'<line x1="{LEFT + WIDTH * tick / 4}%" x2="{LEFT + WIDTH * tick / 4}%" y1="2" y2="{y - 6:.1f}" '
        f'class="grid"/><text x="{LEFT + WIDTH * tick / 4}%" y="{y + 12:.1f}" text-anchor="middle">{tick / 4:g}</text>'
        for tick in range(5)
    )
    return (
        f'<svg height="{height:.0f}" role="img" '
        f'aria-label="collision rate with 95 % intervals">{grid_lines}{"".join(parts)}</svg>'
    )

"""Figures as inline SVG."""

from __future__ import annotations

import math
from html import escape

from ssad.metrics import aggregate
from ssad.report.load import Record, Run

LABEL, WIDTH, STEP, GAP = 190, 520, 15, 12
COLOURS = ("var(--s0)", "var(--s1)", "var(--s2)", "var(--s3)", "var(--s4)")


def interval_plot(run: Run, symbol: str = "CR") -> str:
    """Collision rate of every system in every group with its 95 % interval, as SVG text."""
    groups: dict[str, dict[str, list[Record]]] = {}
    for r in run.records:
        name = r.heading
        groups.setdefault(name, {}).setdefault(r.system, []).append(r)
    systems = run.systems
    parts: list[str] = []
    y = 8.0
    for name, by_system in groups.items():
        middle = y + STEP * len(by_system) / 2
        parts.append(f'<text x="{LABEL - 12}" y="{middle + 4:.1f}" text-anchor="end">{escape(name)}</text>')
        for system, records in by_system.items():
            e = aggregate([r.metrics for r in records])[symbol]
            colour = COLOURS[systems.index(system) % len(COLOURS)]
            at = y + STEP / 2
            if not math.isnan(e.low):
                low, high = LABEL + WIDTH * e.low, LABEL + WIDTH * e.high
                parts.append(
                    f'<line x1="{low:.1f}" x2="{high:.1f}" y1="{at}" y2="{at}" stroke="{colour}" '
                    'stroke-width="3" stroke-linecap="round" opacity=".45"/>'
                )
            if not math.isnan(e.mean):
                tip = f"{system}: {e.mean:.2f} [{e.low:.2f}, {e.high:.2f}], n={e.n}"
                parts.append(
                    f'<circle cx="{LABEL + WIDTH * e.mean:.1f}" cy="{at}" r="5" fill="{colour}">'
                    f"<title>{escape(tip)}</title></circle>"
                )
            y += STEP
        y += GAP
    height = y + 22
    grid = "".join(
        f'<line x1="{LABEL + WIDTH * k / 4:.1f}" x2="{LABEL + WIDTH * k / 4:.1f}" y1="2" y2="{y - 6:.1f}" '
        f'class="grid"/><text x="{LABEL + WIDTH * k / 4:.1f}" y="{y + 12:.1f}" text-anchor="middle">{k / 4:g}</text>'
        for k in range(5)
    )
    return (
        f'<svg viewBox="0 0 {LABEL + WIDTH + 24} {height:.0f}" role="img" '
        f'aria-label="collision rate with 95 % intervals">{grid}{"".join(parts)}</svg>'
    )

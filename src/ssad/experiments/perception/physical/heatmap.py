"""Heat maps in rows: a number in each cell of two axes, red where it is low; as inline SVG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

CELL_WIDE, CELL_HIGH, LEFT, ABOVE, GAP = 40, 24, 62, 42, 26


@dataclass(frozen=True)
class HeatMap:
    """One map.

    Attributes:
        title: Title above it.
        rows: Labels at the left of each row, from the top.
        columns: Labels above each column.
        values: By row and column, 0 to 1; absent or None: not measured.
        marked: A cell with a frame.
        tips: Tool tips of the cells.
    """

    title: str
    rows: Sequence[str]
    columns: Sequence[str]
    values: Mapping[tuple[str, str], float | None]
    marked: tuple[str, str] | None = None
    tips: Mapping[tuple[str, str], str] | None = None


def heat_maps(found: Sequence[HeatMap], *, label: str, columns: int = 3) -> str:
    """Draw maps side by side, numbers in percent; SVG text.

    Args:
        found: The maps; all have as many rows and columns.
        label: Label for screen readers.
        columns: Maps in a row.
    """
    map_width = LEFT + CELL_WIDE * max(len(heat_map.columns) for heat_map in found) + GAP
    map_height = ABOVE + CELL_HIGH * max(len(heat_map.rows) for heat_map in found) + GAP
    parts = []
    for map_index, heat_map in enumerate(found):
        left, top = (map_index % columns) * map_width, (map_index // columns) * map_height
        parts.append(f'<text x="{left + LEFT}" y="{top + 18}" class="name">{escape(heat_map.title)}</text>')
        for column, name in enumerate(heat_map.columns):
            x = left + LEFT + CELL_WIDE * (column + 0.5)
            parts.append(f'<text x="{x:.0f}" y="{top + ABOVE - 6}" text-anchor="middle">{escape(name)}</text>')
        for row_index, row in enumerate(heat_map.rows):
            y = top + ABOVE + CELL_HIGH * row_index
            parts.append(f'<text x="{left + LEFT - 6}" y="{y + 16}" text-anchor="end">{escape(row)}</text>')
            for column, name in enumerate(heat_map.columns):
                parts.append(_cell(heat_map, (row, name), left + LEFT + CELL_WIDE * column, y))
    rows = -(-len(found) // columns)
    return (
        f'<svg viewBox="0 0 {map_width * min(columns, len(found))} {map_height * rows}" role="img" '
        f'aria-label="{escape(label)}">{"".join(parts)}</svg>'
    )


def _cell(one: HeatMap, place: tuple[str, str], x: float, y: float) -> str:
    value = one.values.get(place)
    measured = value is not None and not math.isnan(value)
    colour = f"color-mix(in srgb,var(--crash) {70 * (1 - value):.0f}%,var(--card))" if measured else "none"  # type: ignore[operator]
    frame = ' stroke="var(--ink)" stroke-width="2"' if place == one.marked else ' stroke="var(--line)"'
    text = f"{100 * value:.0f}" if measured else "n/a"  # type: ignore[operator]
    tip = escape((one.tips or {}).get(place, ""))
    return (
        f'<g><title>{tip}</title><rect x="{x + 1}" y="{y + 1}" width="{CELL_WIDE - 2}" height="{CELL_HIGH - 2}" rx="3" '
        f'style="fill:{colour}"{frame}/><text x="{x + CELL_WIDE / 2}" y="{y + 16}" text-anchor="middle" '
        f'style="fill:var(--ink)">{text}</text></g>'
    )

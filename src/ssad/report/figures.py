"""Figures as inline SVG: panels of lines, heat maps, intervals by group, and a scatter plot of changes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from ssad.report.tables import TableCell

SERIES = 5  # colours of the style sheet, --s0 to --s4


def series_colour(number: int) -> str:
    """Return the colour of a series, which follows the style of the page."""
    return f"var(--s{number % SERIES})"


def element(name: str, content: str = "", /, **attributes: object) -> str:
    """Return an SVG element.

    Args:
        name: Name of the element.
        content: Escaped text or elements inside.
        attributes: Attributes in order; "_" stands for "-", "class_" for "class". Floats have one decimal, None is left
            out.
    """
    pairs = [(key.rstrip("_").replace("_", "-"), value) for key, value in attributes.items() if value is not None]
    texts = [f' {key}="{value:.1f}"' if isinstance(value, float) else f' {key}="{value}"' for key, value in pairs]
    return f"<{name}{''.join(texts)}>{content}</{name}>" if content else f"<{name}{''.join(texts)}/>"


def label_text(x: object, y: object, text: str, *, anchor: str | None = None, class_: str | None = None) -> str:
    """Return a text; anchor: end of it that stands at x, by default its start."""
    return element("text", escape(text), x=x, y=y, text_anchor=anchor, class_=class_)


def figure(elements: Sequence[str], label: str, **attributes: object) -> str:
    """Return a figure of its elements, with a label for screen readers."""
    return element("svg", "".join(elements), **attributes, role="img", aria_label=escape(label))


def dot(x: object, y: object, radius: int, colour: str, tip: str = "") -> str:
    """Return a point with its tool tip."""
    title = element("title", escape(tip)) if tip else ""
    return element("circle", title, cx=x, cy=y, r=radius, fill=colour)


@dataclass(frozen=True)
class CurvePoint:
    """A number of a line: its place along the axis, 0 to 1, the number, its tool tip, whether it is drawn hollow."""

    at: float
    cell: TableCell
    tip: str
    is_hollow: bool = False


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
    lines: Sequence[Sequence[CurvePoint]]


PANEL_WIDTH, PANEL_HEIGHT, PANEL_COLUMNS, PANEL_GAP = 178, 118, 4, 34


def panels(plots: Sequence[Panel], *, label: str, columns: int = PANEL_COLUMNS) -> str:
    """Draw small plots in rows, all in one scale from 0, a line a system, its interval as a band; as SVG text.

    Args:
        plots: The plots.
        label: Label for screen readers.
        columns: Plots in a row.
    """
    cells = [point.cell for panel in plots for line in panel.lines for point in line]
    upper_ends = [cell.mean if math.isnan(cell.high) else cell.high for cell in cells if not math.isnan(cell.mean)]
    top_percent = max(10.0, 10 * math.ceil(max(upper_ends, default=1.0) / 10))
    elements = []
    for panel_index, panel in enumerate(plots):
        left = 36 + (panel_index % columns) * (PANEL_WIDTH + PANEL_GAP)
        panel_top = 24 + (panel_index // columns) * (PANEL_HEIGHT + 46)

        def position(
            abscissa: float, value: float, left: int = left, placed_below: int = panel_top
        ) -> tuple[float, float]:
            return left + PANEL_WIDTH * abscissa, placed_below + PANEL_HEIGHT * (
                1 - min(max(value / top_percent, 0.0), 1.0)
            )

        elements.append(label_text(left, panel_top - 8, panel.title, class_="name"))
        for fraction in (0.0, 0.5, 1.0):
            y = panel_top + PANEL_HEIGHT * (1 - fraction)
            elements.append(element("line", x1=left, x2=left + PANEL_WIDTH, y1=y, y2=y, class_="grid"))
            elements.append(label_text(left - 5, y + 4, f"{top_percent * fraction:.0f}", anchor="end"))
        for at, name in panel.ticks:
            elements.append(label_text(left + PANEL_WIDTH * at, panel_top + PANEL_HEIGHT + 15, name, anchor="middle"))
        for index, line in enumerate(panel.lines):
            measured_points = [point for point in line if not math.isnan(point.cell.mean)]
            colour = series_colour(index)
            with_interval = [point for point in measured_points if not math.isnan(point.cell.low)]
            if with_interval:
                # The outline of the band: along the upper limits and back along the lower ones.
                band_points = [position(vertex.at, vertex.cell.high) for vertex in with_interval]
                band_points += [position(vertex.at, vertex.cell.low) for vertex in reversed(with_interval)]
                elements.append(element("polygon", points=_points(band_points), fill=colour, opacity=".16"))
            path = _points([position(vertex.at, vertex.cell.mean) for vertex in measured_points])
            elements.append(element("polyline", points=path, fill="none", stroke=colour, stroke_width=2))
            for point in measured_points:
                tip = f"{point.tip}: {point.cell.text} {point.cell.interval}"
                elements.append(dot(*position(point.at, point.cell.mean), 3, colour, tip))
    rows = -(-len(plots) // columns)
    view_box = f"{36 + columns * (PANEL_WIDTH + PANEL_GAP)} {rows * (PANEL_HEIGHT + 46) + 12}"
    return figure(elements, label, viewBox=f"0 0 {view_box}")


def _points(positions: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in positions)


@dataclass(frozen=True)
class Curve:
    """A line with a name.

    Attributes:
        name: Name in the legend.
        points: Its points, 0 to 100; those without a number are left out.
        colour: Colour of the line.
        dashes: Pattern of its dashes; None: it is solid.
    """

    name: str
    points: Sequence[CurvePoint]
    colour: str
    dashes: str | None = None


@dataclass(frozen=True)
class CurvePlot:
    """A plot of lines in percent.

    Attributes:
        title: Title above it.
        ticks: Places along the axis, 0 to 1, and their labels.
        curves: The lines.
        marks: Places along the axis with a vertical line, and its label.
    """

    title: str
    ticks: Sequence[tuple[float, str]]
    curves: Sequence[Curve]
    marks: Sequence[tuple[float, str]] = ()


CURVE_WIDTH, CURVE_HEIGHT, CURVE_GAP, CURVE_LEFT, CURVE_TOP, LEGEND_COLUMNS = 400, 240, 60, 40, 44, 3


def curve_plots(plots: Sequence[CurvePlot], *, label: str, axis: str = "") -> str:
    """Draw plots side by side, from 0 to 100 %, with intervals as bands, over one legend; as SVG text.

    Args:
        plots: The plots; all have the same curves.
        label: Label for screen readers.
        axis: Title of the horizontal axes.
    """
    elements: list[str] = []
    for number, plot in enumerate(plots):
        left = CURVE_LEFT + number * (CURVE_WIDTH + CURVE_GAP)
        elements += _curve_frame(plot, left, axis)
        for curve in plot.curves:
            elements += _curve_elements(curve, left)
    width = CURVE_LEFT + len(plots) * (CURVE_WIDTH + CURVE_GAP) - CURVE_GAP + 10
    curves = plots[0].curves if plots else ()
    column_width = (width - CURVE_LEFT) / LEGEND_COLUMNS
    for number, curve in enumerate(curves):
        x = CURVE_LEFT + column_width * (number % LEGEND_COLUMNS)
        y = CURVE_TOP + CURVE_HEIGHT + 58 + 18 * (number // LEGEND_COLUMNS)
        stroke = {"stroke": curve.colour, "stroke_width": 2, "stroke_dasharray": curve.dashes}
        elements.append(element("line", x1=x, x2=x + 24, y1=y - 4, y2=y - 4, **stroke))
        elements.append(label_text(x + 30, y, curve.name))
    legend_rows = -(-len(curves) // LEGEND_COLUMNS)
    height = CURVE_TOP + CURVE_HEIGHT + 52 + 18 * legend_rows
    return figure(elements, label, viewBox=f"0 0 {width} {height}")


def _curve_frame(plot: CurvePlot, left: float, axis: str) -> list[str]:
    """Return title, grid, ticks and marks of a plot."""
    elements = [label_text(left, 16, plot.title, class_="name")]
    bottom = CURVE_TOP + CURVE_HEIGHT
    for percent in (0, 25, 50, 75, 100):
        y = bottom - CURVE_HEIGHT * percent / 100
        elements.append(element("line", x1=left, x2=left + CURVE_WIDTH, y1=y, y2=y, class_="grid"))
        elements.append(label_text(left - 6, y + 4, f"{percent}", anchor="end"))
    for at, name in plot.ticks:
        elements.append(label_text(left + CURVE_WIDTH * at, bottom + 16, name, anchor="middle"))
    elements.append(label_text(left + CURVE_WIDTH / 2, bottom + 34, axis, anchor="middle"))
    for at, name in plot.marks:
        x = left + CURVE_WIDTH * at
        stroke = {"stroke": "var(--soft)", "stroke_dasharray": "2 3"}
        elements.append(element("line", x1=x, x2=x, y1=CURVE_TOP - 8, y2=bottom, **stroke))
        elements.append(label_text(x, CURVE_TOP - 12, name, anchor="middle"))
    return elements


def _curve_elements(curve: Curve, left: float) -> list[str]:
    """Return band, line and points of a curve."""

    def position(at: float, percent: float) -> tuple[float, float]:
        share = min(max(percent / 100.0, 0.0), 1.0)
        return left + CURVE_WIDTH * at, CURVE_TOP + CURVE_HEIGHT * (1.0 - share)

    measured = [point for point in curve.points if not math.isnan(point.cell.mean)]
    with_interval = [point for point in measured if not math.isnan(point.cell.low)]
    elements = []
    if with_interval:
        band = [position(point.at, point.cell.high) for point in with_interval]
        band += [position(point.at, point.cell.low) for point in reversed(with_interval)]
        elements.append(element("polygon", points=_points(band), fill=curve.colour, opacity=".13"))
    path = _points([position(point.at, point.cell.mean) for point in measured])
    stroke = {"stroke": curve.colour, "stroke_width": 2, "stroke_dasharray": curve.dashes}
    elements.append(element("polyline", points=path, fill="none", **stroke))
    for point in measured:
        x, y = position(point.at, point.cell.mean)
        tip = element("title", escape(f"{curve.name}, {point.tip}: {point.cell.text} {point.cell.interval}"))
        fill = "var(--card)" if point.is_hollow else curve.colour
        elements.append(element("circle", tip, cx=x, cy=y, r=4, fill=fill, stroke=curve.colour, stroke_width=2))
    return elements


@dataclass(frozen=True)
class HeatMap:
    """One map.

    Attributes:
        title: Title above it.
        rows: Labels at the left of each row, from the top.
        columns: Labels above each column.
        values: By row and column, 0 to 1; absent or None: not measured.
        marked: A cell with a frame.
        bracketed: Cells whose numbers stand in brackets.
        tips: Tool tips of the cells.
    """

    title: str
    rows: Sequence[str]
    columns: Sequence[str]
    values: Mapping[tuple[str, str], float | None]
    marked: tuple[str, str] | None = None
    tips: Mapping[tuple[str, str], str] | None = None
    bracketed: frozenset[tuple[str, str]] = frozenset()


CELL_WIDTH, CELL_HEIGHT, MAP_LEFT, MAP_TOP, MAP_GAP = 40, 24, 62, 42, 26


def heat_maps(maps: Sequence[HeatMap], *, label: str, columns: int = 3) -> str:
    """Draw maps side by side: numbers in percent in the cells of two axes, red where they are low; as SVG text.

    Args:
        maps: The maps; all have as many rows and columns.
        label: Label for screen readers.
        columns: Maps in a row.
    """
    map_width = MAP_LEFT + CELL_WIDTH * max(len(heat_map.columns) for heat_map in maps) + MAP_GAP
    map_height = MAP_TOP + CELL_HEIGHT * max(len(heat_map.rows) for heat_map in maps) + MAP_GAP
    elements = []
    for map_index, heat_map in enumerate(maps):
        left, map_top = (map_index % columns) * map_width, (map_index // columns) * map_height
        elements.append(label_text(left + MAP_LEFT, map_top + 18, heat_map.title, class_="name"))
        for column, name in enumerate(heat_map.columns):
            x = left + MAP_LEFT + CELL_WIDTH * column + CELL_WIDTH // 2
            elements.append(label_text(x, map_top + MAP_TOP - 6, name, anchor="middle"))
        for row_index, row in enumerate(heat_map.rows):
            y = map_top + MAP_TOP + CELL_HEIGHT * row_index
            elements.append(label_text(left + MAP_LEFT - 6, y + 16, row, anchor="end"))
            for column, name in enumerate(heat_map.columns):
                elements.append(_map_cell(heat_map, (row, name), left + MAP_LEFT + CELL_WIDTH * column, y))
    rows = -(-len(maps) // columns)
    return figure(elements, label, viewBox=f"0 0 {map_width * min(columns, len(maps))} {map_height * rows}")


def _map_cell(heat_map: HeatMap, position: tuple[str, str], x: int, y: int) -> str:
    value = heat_map.values.get(position)
    if value is None or math.isnan(value):
        colour, value_text = "none", "n/a"
    else:
        colour, value_text = (
            f"color-mix(in srgb,var(--crash) {70 * (1 - value):.0f}%,var(--card))",
            f"{100 * value:.0f}",
        )
    value_text = f"({value_text})" if position in heat_map.bracketed else value_text
    is_marked = position == heat_map.marked
    rectangle = {"x": x + 1, "y": y + 1, "width": CELL_WIDTH - 2, "height": CELL_HEIGHT - 2, "rx": 3}
    frame = {"stroke": "var(--ink)", "stroke_width": 2} if is_marked else {"stroke": "var(--line)"}
    text_style = {"text_anchor": "middle", "style": "fill:var(--ink)"}
    return element(
        "g",
        f"<title>{escape((heat_map.tips or {}).get(position, ''))}</title>"
        + element("rect", **rectangle, style=f"fill:{colour}", **frame)
        + element("text", value_text, x=x + CELL_WIDTH / 2, y=y + 16, **text_style),
    )


@dataclass(frozen=True)
class Interval:
    """A number with its interval: number of the series (for its colour), the number, and its tool tip."""

    series: int
    cell: TableCell
    tip: str


# names end at LABEL, the axis begins at LEFT and is WIDTH long: % of the figure's width, so that it fits any screen
LABEL, LEFT, WIDTH = 44, 47, 48
STEP, GROUP_GAP = 15, 12  # px


def interval_plot(groups: Sequence[tuple[str, Sequence[Interval]]], *, label: str) -> str:
    """Draw shares with their intervals in groups: intervals as bars, ranges as thin dashes; as SVG text.

    Args:
        groups: Title of each group, and its numbers, 0 to 1; empty groups are left out.
        label: Label for screen readers.
    """
    elements: list[str] = []
    y = 8.0
    for name, intervals in groups:
        if not intervals:
            continue
        elements.append(label_text(f"{LABEL}%", y + STEP * len(intervals) / 2 + 4, name, anchor="end"))
        for interval in intervals:
            cell, colour, row_y = interval.cell, series_colour(interval.series), y + STEP / 2
            if cell.interval:
                segment_ends = {"x1": f"{LEFT + WIDTH * cell.low:.2f}%", "x2": f"{LEFT + WIDTH * cell.high:.2f}%"}
                style = (
                    {"stroke_width": "1.5", "stroke_dasharray": "3 3"}
                    if cell.method == "range"
                    else {"stroke_width": "3", "stroke_linecap": "round", "opacity": ".45"}
                )
                elements.append(element("line", **segment_ends, y1=row_y, y2=row_y, stroke=colour, **style))
            if not math.isnan(cell.mean):
                elements.append(dot(f"{LEFT + WIDTH * cell.mean:.2f}%", row_y, 5, colour, interval.tip))
            y += STEP
        y += GROUP_GAP
    grid = []
    for tick in range(5):
        x = f"{LEFT + WIDTH * tick / 4}%"
        grid.append(element("line", x1=x, x2=x, y1=2, y2=y - 6, class_="grid"))
        grid.append(label_text(x, y + 12, f"{tick / 4:g}", anchor="middle"))
    return figure([*grid, *elements], label, height=f"{y + 22:.0f}")


@dataclass(frozen=True)
class MetricChange:
    """A point of a scatter plot: change along each axis with its interval, its name, its group and its tool tip."""

    x: TableCell
    y: TableCell
    name: str
    group: str
    tip: str


SIZE, MARGIN, TOP = 360, 46, 24  # pixels; TOP has room for the name of a point at the upper end
NAME_ROOM = (110.0, 13.0)  # pixels of a name


def change_plot(
    changes: Sequence[MetricChange], colours: Mapping[str, str], *, label: str, x_title: str, y_title: str
) -> str:
    """Draw changes of two metrics against each other, with their intervals; as SVG text, "" without a change.

    Points far from y = x are named first; others have no name where it is crowded.

    Args:
        changes: The points.
        colours: Group -> colour; the fourth of the style for others.
        label: Label for screen readers.
        x_title: Title of the horizontal axis.
        y_title: Title of the vertical axis.
    """
    if not changes:
        return ""
    left, right = _ends([value for change in changes for value in (change.x.mean, change.x.low, change.x.high)])
    bottom, top = _ends([value for change in changes for value in (change.y.mean, change.y.low, change.y.high)])

    def x(value: float) -> float:
        return MARGIN + SIZE * (min(max(value, left), right) - left) / (right - left)

    def y(value: float) -> float:
        return TOP + SIZE * (top - min(max(value, bottom), top)) / (top - bottom)

    def emphasis(tick: float) -> str | None:
        return "stroke-width:2" if tick == 0.0 else None

    elements = []
    for tick in _ticks(left, right):
        segment_ends = {"x1": x(tick), "x2": x(tick), "y1": TOP, "y2": SIZE + TOP}
        elements.append(element("line", **segment_ends, class_="grid", style=emphasis(tick)))
        elements.append(label_text(x(tick), SIZE + TOP + 16, f"{tick:g}", anchor="middle"))
    for tick in _ticks(bottom, top):
        segment_ends = {"x1": MARGIN, "x2": MARGIN + SIZE, "y1": y(tick), "y2": y(tick)}
        elements.append(element("line", **segment_ends, class_="grid", style=emphasis(tick)))
        elements.append(label_text(MARGIN - 6, y(tick) + 4, f"{tick:g}", anchor="end"))
    names: list[tuple[float, float]] = []
    for change in sorted(changes, key=lambda change: -abs(change.y.mean - change.x.mean)):
        colour = colours.get(change.group, series_colour(3))
        point_x, point_y = x(change.x.mean), y(change.y.mean)
        dashes = "2 3" if "range" in (change.x.method, change.y.method) else None
        for start_point, end_point in (
            ((x(change.x.low), point_y), (x(change.x.high), point_y)),
            ((point_x, y(change.y.low)), (point_x, y(change.y.high))),
        ):
            if not any(math.isnan(coordinate) for coordinate in (*start_point, *end_point)):
                segment_ends = {"x1": start_point[0], "y1": start_point[1], "x2": end_point[0], "y2": end_point[1]}
                elements.append(element("line", **segment_ends, stroke=colour, opacity=".5", stroke_dasharray=dashes))
        elements.append(dot(point_x, point_y, 4, colour, change.tip))
        if all(abs(point_x - at_x) > NAME_ROOM[0] or abs(point_y - at_y) > NAME_ROOM[1] for at_x, at_y in names):
            names.append((point_x, point_y))
            elements.append(label_text(point_x + 7, point_y - 6, change.name))
    for number, group in enumerate(dict.fromkeys(change.group for change in changes)):
        legend_y = 22 + 16 * number
        elements.append(dot(MARGIN + SIZE + 64, legend_y, 5, colours.get(group, series_colour(3))))
        elements.append(label_text(MARGIN + SIZE + 74, legend_y + 4, group))
    elements.append(label_text(MARGIN + SIZE / 2, SIZE + TOP + 34, x_title, anchor="middle"))
    rotation = f"rotate(-90 12 {TOP + SIZE / 2})"
    elements.append(element("text", escape(y_title), x=12, y=TOP + SIZE / 2, transform=rotation, text_anchor="middle"))
    return figure(elements, label, viewBox=f"0 0 {SIZE + MARGIN + 140} {SIZE + TOP + 42}")


def _ends(values: Sequence[float]) -> tuple[float, float]:
    """Return the ends of an axis in tenths, with 0 and some room; intervals may be missing."""
    finite_values = [value for value in values if not math.isnan(value)]
    # Changes of shares lie in [-1, 1].
    lower, upper = max(min(*finite_values, 0.0) - 0.05, -1.0), min(max(*finite_values, 0.1) + 0.05, 1.0)
    return math.floor(10.0 * lower) / 10.0, math.ceil(10.0 * upper) / 10.0


def _ticks(low: float, high: float) -> list[float]:
    """Return the numbers along an axis, one of which is 0."""
    step = 0.1 if high - low < 0.75 else 0.25
    return [round(index * step, 2) for index in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]

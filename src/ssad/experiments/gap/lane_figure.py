"""Figure of lane keeping: deviation from the middle of the lane along the route."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from ssad.report.figures import element, figure, label_text, series_colour

WIDTH, HEIGHT, LEFT, GAP = 620, 190, 44, 60  # px of a panel, and room for its labels
LEGEND = 16  # px of a row of the legend
LIMIT = 4.0  # m: a panel reaches no further
MARGIN = 0.6  # m above and below the lines of the lane
DOTS = ("", "7 3", "2 3", "9 3 2 3")  # dashes tell lines of one colour apart

Course = Mapping[str, Sequence[float]]
"""Distances `along`, `deviation` and `margin` of a drive, as `ssad.metrics.lane_keeping.lane_course` returns them."""


def course_plot(courses: Mapping[str, Mapping[str, Course]], *, label: str) -> str:
    """Return the SVG of a panel for each drive, with a line for each condition.

    Args:
        courses: Title of the panel -> label of the line -> its course; at least one.
        label: Label for screen readers.
    """
    elements: list[str] = []
    top = 22
    for title, lines in courses.items():
        elements += _panel(title, lines, top)
        top += HEIGHT + GAP + LEGEND * -(-len(lines) // 3)
    return figure(elements, label, viewBox=f"0 0 {LEFT + WIDTH + 16} {top}")


def _panel(title: str, lines: Mapping[str, Course], top: int) -> list[str]:
    """Return the elements of a panel whose plot begins at a height."""
    longest = max(lines.values(), key=lambda course: course["along"][-1])
    start, end = float(longest["along"][0]), max(float(longest["along"][-1]), float(longest["along"][0]) + 1.0)
    margin = max(longest["margin"])
    peak = max(abs(value) for course in lines.values() for value in course["deviation"])
    reach = min(max(peak, margin + MARGIN), LIMIT)

    def x(along: float) -> float:
        return LEFT + WIDTH * (along - start) / (end - start)

    def y(deviation: float) -> float:
        return top + 0.5 * HEIGHT * (1.0 - max(min(deviation / reach, 1.0), -1.0))

    elements = [label_text(LEFT, top - 8, title, class_="name")]
    for value in (-reach, 0.0, reach):
        elements.append(element("line", x1=LEFT, x2=LEFT + WIDTH, y1=y(value), y2=y(value), class_="grid"))
        elements.append(label_text(LEFT - 5, y(value) + 4, f"{value:+.1f}" if value else "0", anchor="end"))
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        along = start + share * (end - start)
        elements.append(label_text(x(along), top + HEIGHT + 15, f"{along:.0f} m", anchor="middle"))
    for side in (1.0, -1.0):
        edge = zip(longest["along"], longest["margin"], strict=True)
        points = _points([(x(along), y(side * width)) for along, width in edge])
        elements.append(element("polyline", points=points, fill="none", stroke="var(--soft)", stroke_dasharray="1 4"))
    for index, (name, course) in enumerate(lines.items()):
        colour, dashes = series_colour(index), DOTS[(index // 5) % len(DOTS)]
        places = zip(course["along"], course["deviation"], strict=True)
        points = _points([(x(along), y(value)) for along, value in places])
        tip = element("title", escape(name))
        elements.append(
            element(
                "polyline",
                tip,
                points=points,
                fill="none",
                stroke=colour,
                stroke_width=2,
                stroke_dasharray=dashes or None,
            )
        )
        row, column = divmod(index, 3)
        legend_x, legend_y = LEFT + column * WIDTH / 3, top + HEIGHT + 34 + LEGEND * row
        elements.append(
            element(
                "line",
                x1=legend_x,
                x2=legend_x + 18,
                y1=legend_y - 4.0,
                y2=legend_y - 4.0,
                stroke=colour,
                stroke_width=2,
                stroke_dasharray=dashes or None,
            )
        )
        elements.append(label_text(legend_x + 23, legend_y, name))
    return elements


def _points(places: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{column:.1f},{row:.1f}" for column, row in places)

"""Figures are well-formed SVG with escaped names; crowded points keep their dots and lose their names."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

from ssad.report.figures import (
    CURVE_HEIGHT,
    CURVE_LEFT,
    CURVE_TOP,
    CURVE_WIDTH,
    Curve,
    CurvePlot,
    CurvePoint,
    Interval,
    MetricChange,
    Panel,
    change_plot,
    curve_plots,
    element,
    interval_plot,
    panels,
)
from ssad.report.tables import TableCell

RANGE = TableCell(0.5, 0.25, 0.75, method="range")


def parsed(text: str) -> ET.Element:
    return ET.fromstring(text)


def test_an_element_has_its_attributes_in_order_and_leaves_out_none() -> None:
    made = element("line", x1=1.25, y1=2, stroke_width="3", class_="grid", style=None)
    assert made == '<line x1="1.2" y1="2" stroke-width="3" class="grid"/>'
    assert element("text", "a") == "<text>a</text>"


def test_panels_share_one_scale_and_leave_out_what_is_not_measured() -> None:
    points = [
        CurvePoint(0.0, TableCell(40.0, 35.0, 45.0), "a"),
        CurvePoint(0.5, TableCell(math.nan), "b"),
        CurvePoint(1.0, TableCell(12.0), "c"),
    ]
    figure = parsed(panels([Panel("x < y", [(0.0, "0")], [points])] * 2, label="a & b", columns=1))
    assert figure.attrib["aria-label"] == "a & b"
    assert [text.text for text in figure.iter("text") if text.attrib.get("class") == "name"] == ["x < y"] * 2
    assert {text.text for text in figure.iter("text")} >= {"0", "25", "50"}
    assert len(list(figure.iter("circle"))) == 4


def test_intervals_are_bars_and_ranges_are_dashes() -> None:
    groups = [
        ("g", [Interval(0, TableCell(0.5, 0.25, 0.75, method="beta"), "bar"), Interval(1, RANGE, "dash")]),
        ("h", []),
    ]
    figure = parsed(interval_plot(groups, label="l"))
    bars = [line for line in figure.iter("line") if line.attrib.get("class") != "grid"]
    assert [bar.attrib.get("stroke-dasharray") for bar in bars] == [None, "3 3"]
    assert [bar.attrib["stroke"] for bar in bars] == ["var(--s0)", "var(--s1)"]
    assert (bars[0].attrib["x1"], bars[0].attrib["x2"]) == ("59.00%", "83.00%")
    assert "h" not in [text.text for text in figure.iter("text")]


def test_crowded_points_have_no_names_but_tips() -> None:
    changes = [
        MetricChange(TableCell(0.1), RANGE, "near", "shift", "near: tip"),
        MetricChange(TableCell(0.1), TableCell(0.9), "far", "shift", "far: tip"),
        MetricChange(TableCell(0.1), TableCell(0.51), "hidden", "<other>", "hidden: tip"),
    ]
    figure = parsed(change_plot(changes, {"shift": "blue"}, label="l", x_title="x", y_title="y"))
    texts = [text.text for text in figure.iter("text")]
    assert "far" in texts
    assert ("near" in texts) + ("hidden" in texts) == 1
    assert "<other>" in texts, "the legend has every group"
    assert {title.text for title in figure.iter("title")} == {"near: tip", "far: tip", "hidden: tip"}
    at_the_top = MetricChange(TableCell(0.1), TableCell(1.0), "highest", "shift", "tip")
    figure = parsed(change_plot([at_the_top], {}, label="l", x_title="x", y_title="y"))
    (name,) = (text for text in figure.iter("text") if text.text == "highest")
    assert float(name.attrib["y"]) > 12, "the name is inside of the figure, which begins at 0"
    assert change_plot([], {}, label="l", x_title="x", y_title="y") == ""


def test_curves_stand_where_their_numbers_are() -> None:
    """Half way along the axis and up it; a hollow point has the colour of the page, a mark a line of its own."""
    middle_cell = TableCell(50.0, 25.0, 75.0)
    points = [CurvePoint(0.0, TableCell(0.0), "5 m"), CurvePoint(0.5, middle_cell, "20 m", is_hollow=True)]
    plot = CurvePlot("AP50, %", [(0.0, "5"), (1.0, "80")], [Curve("clean", points, "red")], [(0.25, "30 km/h")])
    svg = curve_plots([plot, plot], label="two", axis="distance, m")
    left, middle, bottom = CURVE_LEFT + CURVE_WIDTH / 2, CURVE_TOP + CURVE_HEIGHT / 2, CURVE_TOP + CURVE_HEIGHT
    assert f'points="{CURVE_LEFT:.1f},{bottom:.1f} {left:.1f},{middle:.1f}"' in svg
    assert f'cx="{left:.1f}" cy="{middle:.1f}" r="4" fill="var(--card)" stroke="red"' in svg
    assert svg.count("30 km/h") == 2
    assert svg.count(">clean<") == 1, "one legend"
    band = CURVE_TOP + CURVE_HEIGHT * 0.25
    assert f'points="{left:.1f},{band:.1f} {left:.1f},{CURVE_TOP + CURVE_HEIGHT * 0.75:.1f}"' in svg

"""Figure of lane keeping: a panel a drive, a line a condition, and the edges where the lane is left."""

from __future__ import annotations

from ssad.experiments.gap.lane_figure import course_plot

COURSE = {"along": [0.0, 2.0, 4.0], "deviation": [0.0, 0.1, -0.2], "margin": [0.8, 0.8, 0.8]}


def test_it_has_a_line_for_each_condition_and_names_them() -> None:
    other = COURSE | {"deviation": [0.0, 1.0, 9.0]}
    picture = course_plot({"lane keeper, road <1>": {"clean": COURSE, "dirt & more": other}}, label="Deviation")
    assert picture.startswith("<svg")
    assert picture.count("<polyline") == 4  # two conditions, and both edges
    assert "road &lt;1&gt;" in picture
    assert picture.count("dirt &amp; more") == 2
    assert "+4.0" in picture  # what lies further away is cut there
    # A line to the left lies above one to the right.
    lines = [part.split('"')[1] for part in picture.split("points=")[3:]]
    last = [float(points.split(" ")[-1].split(",")[1]) for points in (part for part in lines)]
    assert last[1] < last[0]


def test_many_conditions_have_dashes_of_their_own() -> None:
    lines = {f"condition {number}": COURSE for number in range(7)}
    picture = course_plot({"drive": lines}, label="Deviation")
    assert picture.count('stroke-dasharray="7 3"') == 4  # two lines and their places in the legend

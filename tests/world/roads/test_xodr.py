"""Classes of OpenDRIVE files that people bring: each comes in, with the lanes and links that it describes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.large_map import SPACING, TOWN, large_map
from benchmarks.opendrive_maps import integrated_centre
from ssad.core.errors import MapError
from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph, SignKind, load_graph
from ssad.core.types import LaneType
from ssad.world.roads import bake, import_map, load_town, town_xodr
from ssad.world.roads.lane_sampling import LaneSampler
from ssad.world.roads.xodr import read_network

WIDTH = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'


def lane(number: int, link: str = "", *, kind: str = "driving", shape: str = WIDTH, more: str = "") -> str:
    return f'<lane id="{number}" type="{kind}" {more}><link>{link}</link>{shape}</lane>'


def lanes(*numbers: int) -> str:
    return "".join(lane(number) for number in numbers)


def section(left: str = lanes(1), right: str = lanes(-1), s: float = 0.0) -> str:
    return (
        f'<laneSection s="{s:g}"><left>{left}</left><center><lane id="0" type="none"/></center>'
        f"<right>{right}</right></laneSection>"
    )


def road(
    number: int | str = 1,
    *,
    length: float = 100.0,
    x: float = 0.0,
    y: float = 0.0,
    heading: float = 0.0,
    shape: str = "<line/>",
    link: str = "",
    sections: str = "",
    junction: int | str = -1,
    more: str = "",
    offset: str = "",
    tail: str = "",
) -> str:
    return (
        f'<road length="{length:g}" id="{number}" junction="{junction}" {more}><link>{link}</link>'
        f'<type s="0" type="town"/><planView><geometry s="0" x="{x!r}" y="{y!r}" hdg="{heading!r}" length="{length:g}">'
        f"{shape}</geometry></planView>"
        f"<lanes>{offset}{sections or section()}</lanes>{tail}</road>"
    )


def town(tmp_path: Path, *parts: str, report: ImportReport | None = None, attributes: str = "") -> LaneGraph:
    path = tmp_path / "map.xodr"
    text = f'<OpenDRIVE {attributes}><header revMajor="1" revMinor="7"/>{"".join(parts)}</OpenDRIVE>'
    path.write_text(text, encoding="utf-8")
    return bake(path, report=report)


def rows(graph: LaneGraph) -> dict[tuple[int, int], int]:
    """Row of each lane by road and id, for roads of one section."""
    return {(int(r), int(n)): i for i, (r, n) in enumerate(zip(graph.road, graph.lane_id, strict=True))}


def links(graph: LaneGraph) -> set[tuple[tuple[int, int], tuple[int, int]]]:
    """Pairs of (road, lane) that follow each other."""
    names = {row: name for name, row in rows(graph).items()}
    return {(names[i], names[int(j)]) for i in range(graph.lane_count) for j in graph.successors(i)}


def ends(graph: LaneGraph, row: int) -> np.ndarray:
    """First and last point of a lane, flat."""
    part = graph.points(row)
    return graph.xy[[part.start, part.stop - 1]].astype(float).ravel()


@pytest.mark.parametrize(
    "shape",
    [
        "<line/>",
        '<arc curvature="0"/>',
        '<spiral curvStart="0" curvEnd="0"/>',
        '<paramPoly3 aU="0" bU="100" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0" pRange="normalized"/>',
        '<paramPoly3 aU="0" bU="100" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0"/>',
        '<paramPoly3 aU="0" bU="1" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0" pRange="arcLength"/>',
        '<paramPoly3 aU="0" bU="1" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0" pRange=" arclength"/>',
        '<poly3 a="0" b="0" c="0" d="0"/>',
    ],
)
def test_every_way_to_write_a_straight_road(tmp_path: Path, shape: str) -> None:
    graph = town(tmp_path, road(shape=shape))
    index = rows(graph)
    assert graph.lane_count == 2
    assert ends(graph, index[1, -1]) == pytest.approx([0, -1.75, 100, -1.75], abs=2e-3)
    assert ends(graph, index[1, 1]) == pytest.approx([100, 1.75, 0, 1.75], abs=2e-3)


def test_a_spiral_of_constant_curvature_is_an_arc(tmp_path: Path) -> None:
    arc = town(tmp_path, road(shape='<arc curvature="0.01"/>'))
    spiral = town(tmp_path, road(shape='<spiral curvStart="0.01" curvEnd="0.01"/>'))
    assert np.abs(arc.xy - spiral.xy).max() < 1e-4
    assert arc.length[rows(arc)[1, -1]] == pytest.approx(101.75, abs=0.01)


@pytest.mark.parametrize("place", ["root", "prefix", "road"])
def test_a_namespace(tmp_path: Path, place: str) -> None:
    """Elements of another namespace within `userData` are none of the map's."""
    other = '<userData><lane xmlns="http://other" id="5"/></userData>'
    text = f'<OpenDRIVE><header revMajor="1" revMinor="7"/>{road(tail=other)}</OpenDRIVE>'
    if place == "prefix":
        text = re.sub(r"<(/?)(?!lane xmlns)", r"<\1odr:", text)
        text = text.replace("<odr:OpenDRIVE", '<odr:OpenDRIVE xmlns:odr="http://www.opendrive.org"')
    else:
        tag = "<OpenDRIVE" if place == "root" else "<road"
        text = text.replace(tag, f'{tag} xmlns="http://www.opendrive.org"', 1)
    (tmp_path / "map.xodr").write_text(text, encoding="utf-8")
    assert bake(tmp_path / "map.xodr").lane_count == 2


def test_left_hand_traffic(tmp_path: Path) -> None:
    """In lanes, links, junctions, neighbours, markings and posts."""
    report = ImportReport("map")
    to_junction = '<{} elementType="junction" elementId="9"/>'
    between = (
        '<predecessor elementType="road" elementId="1" contactPoint="end"/>'
        '<successor elementType="road" elementId="3" contactPoint="start"/>'
    )
    mark = '<roadMark sOffset="0" type="{}"/>'
    marked = section(
        left=lane(1, shape=WIDTH + mark.format("solid")) + lane(2),
        right=lane(-1, shape=WIDTH + mark.format("broken")),
    )
    through = section(
        left=lane(1, '<predecessor id="1"/><successor id="1"/>'),
        right=lane(-1, '<predecessor id="-1"/><successor id="-1"/>'),
    )
    junction = (
        '<junction id="9"><connection id="0" incomingRoad="1" connectingRoad="2" contactPoint="start">'
        '<laneLink from="1" to="1"/></connection>'
        '<connection id="1" incomingRoad="3" connectingRoad="2" contactPoint="end">'
        '<laneLink from="-1" to="-1"/></connection></junction>'
    )
    graph = town(
        tmp_path,
        road(1, more='rule="LHT"', link=to_junction.format("successor"), sections=marked),
        road(2, x=100.0, length=20, more='rule="LHT"', link=between, sections=through, junction=9),
        road(3, x=120.0, more='rule="LHT"', link=to_junction.format("predecessor")),
        junction,
        report=report,
    )
    index = rows(graph)
    assert ends(graph, index[1, -1]) == pytest.approx([100, -1.75, 0, -1.75], abs=2e-3)
    assert ends(graph, index[1, 1]) == pytest.approx([0, 1.75, 100, 1.75], abs=2e-3)
    assert links(graph) == {((1, 1), (2, 1)), ((2, 1), (3, 1)), ((3, -1), (2, -1)), ((2, -1), (1, -1))}
    assert (graph.left[index[1, 1]], graph.right[index[1, 1]]) == (index[1, 2], index[1, -1])
    assert graph.is_same_direction(index[1, 1], index[1, 2])
    assert not graph.is_same_direction(index[1, 1], index[1, -1])
    assert (graph.left_marking[index[1, 1]], graph.right_marking[index[1, -1]]) == (2, 0)
    assert graph.left_marking[index[1, -1]] == 1
    assert graph.left_hand[0]
    assert not graph.turn_on_red[0]
    assert "rule of the road: left-hand traffic" in report.lines()


def test_a_link_to_a_road_that_is_missing_ends_there(tmp_path: Path) -> None:
    report = ImportReport("map")
    missing = '<successor elementType="road" elementId="77" contactPoint="start"/>'
    graph = town(tmp_path, road(link=missing), report=report)
    assert graph.lane_count == 2
    assert not links(graph)
    assert sum("road 1 to 77" in line for line in report.lines()) == 1


def test_junctions_of_which_parts_are_missing(tmp_path: Path) -> None:
    """An excerpt: what is there is linked, and what is not is named."""
    report = ImportReport("map")
    between = PREDECESSOR + '<successor elementType="road" elementId="44" contactPoint="start"/>'
    through = section("", lane(-1, '<predecessor id="-1"/><successor id="-1"/>'))
    connection = '<connection id="0" incomingRoad="{}" connectingRoad="{}" contactPoint="{}">{}</connection>'
    lane_link = '<laneLink from="{0}" to="-1"/>'
    junction = (
        connection.format(1, 2, "start", lane_link.format(-1))
        + connection.format(44, 2, "end", lane_link.format(1))
        + connection.format(1, 55, "start", lane_link.format(-1))
    )
    graph = town(
        tmp_path,
        road(1, link='<successor elementType="junction" elementId="9"/>'),
        road(2, x=100.0, length=20, junction=9, link=between, sections=through),
        road(3, y=50.0, junction=8, link='<successor elementType="junction" elementId="7"/>'),
        f'<junction id="9">{junction}</junction>',
        report=report,
    )
    assert links(graph) == {((1, -1), (2, -1))}
    assert report.doubts == {
        "a road is linked to a road that the map lacks; it ends there": ["road 2 to 44"],
        "a junction connects a road that the map lacks": ["junction 9, road 44", "junction 9, road 55"],
        "a road is linked to a junction that the map lacks; it ends there": ["road 3 to 7"],
        "a road belongs to a junction that the map lacks": ["road 3"],
    }


SUCCESSOR = '<successor elementType="road" elementId="2" contactPoint="start"/>'
PREDECESSOR = '<predecessor elementType="road" elementId="1" contactPoint="end"/>'


@pytest.mark.parametrize(
    "side", ["first", "second", "both", "one road alone", "the road of one, the lanes of the other"]
)
def test_links_on_either_side_count(tmp_path: Path, side: str) -> None:
    first = section(lane(1, '<successor id="1"/>'), lane(-1, '<successor id="-1"/>'))
    second = section(lane(1, '<predecessor id="1"/>'), lane(-1, '<predecessor id="-1"/>'))
    report = ImportReport("map")
    graph = town(
        tmp_path,
        road(1, link=SUCCESSOR, sections=section() if side.startswith(("second", "the road")) else first),
        road(
            2,
            x=100.0,
            link="" if side.startswith(("one road", "the road")) else PREDECESSOR,
            sections=section() if side == "first" else second,
        ),
        report=report,
    )
    assert links(graph) == {((1, -1), (2, -1)), ((2, 1), (1, 1))}
    assert not report.doubts


def test_a_lane_end_beside_an_unlinked_start_is_named(tmp_path: Path) -> None:
    report = ImportReport("map")
    graph = town(tmp_path, road(1), road(2, x=100.4), road(3, x=-101.0), report=report)
    assert not links(graph)
    places = report.doubts["a lane ends beside an unlinked start"]
    assert sorted(places) == [
        "road 1, section 0, lane -1 beside road 2, section 0, lane -1",
        "road 2, section 0, lane 1 beside road 1, section 0, lane 1",
    ]


def test_far_coordinates_shift_the_origin(tmp_path: Path, ssad_home: Path) -> None:
    report = ImportReport("map")
    graph = town(tmp_path, road(x=678123.25, y=5405678.5, heading=0.3), report=report)
    assert graph.origin.tolist() == [678123.0, 5405678.0]
    corner = graph.xy[graph.points(rows(graph)[1, -1]).start] + graph.origin
    assert corner == pytest.approx([678123.25 + 1.75 * np.sin(0.3), 5405678.5 - 1.75 * np.cos(0.3)], abs=0.01)
    assert "origin shifted to (678123, 5405678)" in report.lines()
    stored = import_map(tmp_path / "map.xodr", "Far", ssad_home)
    assert load_graph(stored).origin.tolist() == graph.origin.tolist()
    again = bake(stored.with_suffix(".xodr"))
    assert np.abs(again.xy - graph.xy).max() < 1e-3  # the stored map has the coordinates of the town
    assert again.origin == pytest.approx(graph.origin)


def test_a_header_tells_the_offset_to_its_projection(tmp_path: Path) -> None:
    path = tmp_path / "map.xodr"
    header = '<header revMajor="1" revMinor="6"><offset x="500000" y="100" z="0" hdg="0"/></header>'
    path.write_text(f"<OpenDRIVE>{header}{road()}</OpenDRIVE>", encoding="utf-8")
    graph = bake(path)
    assert graph.origin.tolist() == [500000.0, 100.0]
    assert graph.xy[:, 0].max() == pytest.approx(100.0, abs=0.01)


def test_a_direct_junction_where_roads_part_and_join(tmp_path: Path) -> None:
    """Lanes of both directions, several lanes a connection, and a ramp that comes from the other side."""
    to_junction = '<{} elementType="junction" elementId="9"/>'
    connections = "".join(
        f'<connection id="{source}{target}" incomingRoad="{source}" linkedRoad="{target}" contactPoint="{contact}">'
        + "".join(f'<laneLink from="{first}" to="{second}"/>' for first, second in lane_pairs)
        + "</connection>"
        for source, target, contact, lane_pairs in (
            (1, 2, "start", ((-1, -1), (-2, -2), (1, 1))),
            (1, 3, "start", ((-3, -1),)),
            (4, 1, "end", ((-1, 2),)),
        )
    )
    graph = town(
        tmp_path,
        road(1, length=50, link=to_junction.format("successor"), sections=section(lanes(1, 2), lanes(-1, -2, -3))),
        road(2, x=50.0, length=50, link=to_junction.format("predecessor"), sections=section(right=lanes(-1, -2))),
        road(3, x=50.0, y=-7, length=50, link=to_junction.format("predecessor"), sections=section("", lanes(-1))),
        road(
            4,
            x=100.0,
            y=3.5,
            heading=np.pi,
            length=50,
            link=to_junction.format("successor"),
            sections=section("", lanes(-1)),
        ),
        f'<junction id="9" type="direct">{connections}</junction>',
    )
    assert links(graph) == {
        ((1, -1), (2, -1)),
        ((1, -2), (2, -2)),
        ((2, 1), (1, 1)),
        ((1, -3), (3, -1)),
        ((4, -1), (1, 2)),
    }


def test_a_direct_junction(tmp_path: Path) -> None:
    left = road(
        1, length=50, link='<successor elementType="junction" elementId="9"/>', sections=section("", lanes(-1, -2))
    )
    after = '<predecessor elementType="junction" elementId="9"/>'
    others = [
        road(n, length=50, x=50.0, y=y, link=after, sections=section("", lanes(-1))) for n, y in ((2, 0.0), (3, -3.5))
    ]
    junction = '<junction id="9" type="direct">' + "".join(
        f'<connection id="{n}" incomingRoad="1" linkedRoad="{n}" contactPoint="start">'
        f'<laneLink from="{source}" to="-1"/></connection>'
        for n, source in ((2, -1), (3, -2))
    )
    graph = town(tmp_path, left, *others, junction + "</junction>")
    assert links(graph) == {((1, -1), (2, -1)), ((1, -2), (3, -1))}
    assert (graph.junction == -1).all()


def test_a_virtual_junction_joins_in_the_middle_of_a_road(tmp_path: Path) -> None:
    """A driveway leaves a main road at s = 40; traffic can stay on the road or turn off."""
    driveway = '<predecessor elementType="road" elementId="1" elementS="40" elementDir="+"/>'
    side = section("", lane(-1, '<predecessor id="-1"/>'))
    junction = (
        '<junction id="5" type="virtual" mainRoad="1" sStart="38" sEnd="45" orientation="+">'
        '<connection id="0" incomingRoad="1" connectingRoad="2" contactPoint="start"><laneLink from="-1" to="-1"/>'
        "</connection></junction>"
    )
    graph = town(
        tmp_path,
        road(1),
        road(2, x=40.0, length=20, shape='<arc curvature="-0.05"/>', link=driveway, sections=side, junction=5),
        junction,
    )
    parts = sorted(np.flatnonzero((graph.road == 1) & (graph.lane_id == -1)), key=lambda row: ends(graph, row)[0])
    assert [graph.length[row] for row in parts] == pytest.approx([40.0, 60.0], abs=0.01)
    turn = int(np.flatnonzero(graph.road == 2)[0])
    assert set(graph.successors(int(parts[0])).tolist()) == {int(parts[1]), turn}
    back = np.flatnonzero((graph.road == 1) & (graph.lane_id == 1))
    assert sum(len(graph.successors(int(row))) for row in back) == 1


def test_ids_that_are_text(tmp_path: Path) -> None:
    report = ImportReport("map")
    link = '<successor elementType="road" elementId="B street" contactPoint="start"/>'
    first = section("", lane(-1, '<successor id="-1"/>'))
    graph = town(
        tmp_path, road("A", link=link, sections=first), road("B street", x=100.0), road(4, y=50.0), report=report
    )
    assert sorted(set(graph.road.tolist())) == [4, 5, 6]
    assert links(graph) == {((5, -1), (6, -1))}
    assert any("'B street' is 6" in line for line in report.lines())


def test_a_lane_with_several_successors(tmp_path: Path) -> None:
    """One lane of 7 m becomes two of 3.5 m: it goes on, across a step of half a lane, and the report says so."""
    wide = WIDTH.replace("3.5", "7")
    first = section("", lane(-1, '<successor id="-1"/><successor id="-2"/>', shape=wide))
    report = ImportReport("map")
    graph = town(tmp_path, road(sections=first + section("", lanes(-1, -2), s=60.0)), report=report)
    assert sorted(graph.lane_id[graph.successors(0)].tolist()) == [-2, -1]
    assert "lanes are joined across a step aside" in report.notes


def test_linked_lanes_far_apart_are_named(tmp_path: Path) -> None:
    first = section("", lane(-1, '<successor id="-1"/>'))
    report = ImportReport("map")
    graph = town(tmp_path, road(1, link=SUCCESSOR, sections=first), road(2, x=110.0), report=report)
    assert not links(graph)
    assert report.doubts["linked lanes whose ends are more than 1 m apart are not joined"] == [
        "road 1, section 0, lane -1 to road 2, section 0, lane -1: 10.0 m"
    ]


def test_borders_lane_offset_and_tapers(tmp_path: Path) -> None:
    border = '<border sOffset="0" a="{}" b="0" c="0" d="0"/>'
    taper = '<width sOffset="0" a="2" b="0.02" c="0" d="0"/>'
    bordered = section("", lane(-1, shape=border.format(-3)) + lane(-2, shape=border.format(-7)))
    graph = town(
        tmp_path,
        road(1, sections=bordered, offset='<laneOffset s="50" a="0" b="0.1" c="0" d="0"/>'),
        road(2, y=90.0, sections=section("", lane(-1, shape=taper) + lanes(-2))),
    )
    index = rows(graph)
    assert graph.width[graph.points(index[1, -2])] == pytest.approx(4.0, abs=1e-5)
    assert ends(graph, index[1, -2]) == pytest.approx([0, -5, 100, 0], abs=2e-3)
    assert ends(graph, index[2, -2]) == pytest.approx([0, 90 - 3.75, 100, 90 - 5.75], abs=2e-3)
    yaw = graph.yaw[graph.points(index[2, -2])]
    assert yaw[len(yaw) // 2] == pytest.approx(np.arctan(-0.02), abs=1e-6)  # along the lane, not along the road
    assert graph.at(index[2, -1], 50.0)[3] == pytest.approx(3.0, abs=1e-3)


def test_heights_have_elevation_and_superelevation(tmp_path: Path) -> None:
    report = ImportReport("map")
    profile = (
        '<elevationProfile><elevation s="0" a="5" b="0.1" c="0" d="0"/></elevationProfile><lateralProfile>'
        '<superelevation s="0" a="0.05" b="0" c="0" d="0"/></lateralProfile>'
    )
    graph = town(tmp_path, road(tail=profile), report=report)
    row = rows(graph)[1, -1]
    assert graph.z[graph.points(row)][-1] == pytest.approx(15.0 - 1.75 * np.tan(0.05), abs=1e-3)
    assert ends(graph, row) == pytest.approx([0, -1.75, 100, -1.75], abs=2e-3)
    assert any(line.startswith("superelevation is kept in the heights") for line in report.lines())


def test_a_lane_may_run_the_other_way(tmp_path: Path) -> None:
    """OpenDRIVE 1.8: direction="reversed"."""
    graph = town(tmp_path, road(sections=section("", lanes(-1) + lane(-2, more='direction="reversed"'))))
    index = rows(graph)
    assert ends(graph, index[1, -2]) == pytest.approx([100, -5.25, 0, -5.25], abs=2e-3)
    assert not graph.is_same_direction(index[1, -1], index[1, -2])
    assert graph.left[index[1, -2]] == -1
    assert graph.right[index[1, -2]] == index[1, -1]


CROSSING = """<objects><object id="1" type="crosswalk" s="90" t="0" hdg="{hdg}"><outline>
<cornerLocal u="-2" v="-3.5"/><cornerLocal u="2" v="-3.5"/><cornerLocal u="2" v="3.5"/><cornerLocal u="-2" v="3.5"/>
<cornerLocal u="-2" v="-3.5"/></outline></object><object id="2" type="tree" s="5" t="9"/></objects>"""


def signal(kind: str, country: str = "", *, s: float = 50.0, more: str = "") -> str:
    return (
        f'<signal id="{kind}{s:g}" type="{kind}" country="{country}" s="{s:g}" t="-5" orientation="+" dynamic="no"'
        f' value="-1" {more}/>'
    )


def approach(tmp_path: Path, tail: str, report: ImportReport | None = None, *, speed: str = "") -> LaneGraph:
    """A road that leads into a junction of one way through."""
    between = '<predecessor elementType="road" elementId="1" contactPoint="end"/>'
    return town(
        tmp_path,
        road(
            1, link='<successor elementType="junction" elementId="9"/>', tail=tail, sections=section("", lanes(-1))
        ).replace('<type s="0" type="town"/>', speed),
        road(2, x=100.0, length=20, link=between, sections=section("", lane(-1, '<predecessor id="-1"/>')), junction=9),
        '<junction id="9"><connection id="0" incomingRoad="1" connectingRoad="2" contactPoint="start">'
        '<laneLink from="-1" to="-1"/></connection></junction>',
        report=report,
    )


@pytest.mark.parametrize(
    ("kind", "country", "meaning", "may_turn"),
    [
        ("206", "", SignKind.STOP, True),
        ("205", "OpenDRIVE", SignKind.YIELD, True),
        ("206", "DE", SignKind.STOP, False),
        ("R1-1", "USA", SignKind.STOP, True),
        ("R1-2", "us", SignKind.YIELD, True),
        ("601.1", "GB", SignKind.STOP, False),
    ],
)
def test_signs_by_country(tmp_path: Path, kind: str, country: str, meaning: SignKind, may_turn: bool) -> None:
    graph = approach(tmp_path, f"<signals>{signal(kind, country, s=98)}</signals>")
    assert graph.sign_kind.tolist() == [meaning]
    assert graph.sign_xy[0] == pytest.approx([98.0, -5.0], abs=1e-3)
    assert graph.rule_s[0] == pytest.approx(100.0, abs=0.01)
    assert graph.turn_on_red[0] == may_turn


def test_stop_lines_crosswalks_and_what_is_left_out(tmp_path: Path) -> None:
    report = ImportReport("map")
    sign = f"<signals>{signal('206', s=98)}{signal('101', 'SE')}</signals>"
    lines = f"<signals>{signal('206', s=98)}{signal('294', s=93).replace('-5', '-1.75')}</signals>"
    assert approach(tmp_path, lines).rule_s[0] == pytest.approx(93.0, abs=0.3)
    graph = approach(tmp_path, CROSSING.format(hdg=0) + sign, report)
    assert graph.rule_s[0] == pytest.approx(87.0, abs=0.3)  # a metre before the crosswalk
    assert sorted(graph.crosswalk(0).round(3).tolist()) == [[88, -3.5], [88, 3.5], [92, -3.5], [92, 3.5]]
    turned = approach(tmp_path, CROSSING.format(hdg=np.pi / 2) + sign)
    assert np.ptp(turned.crosswalk(0), axis=0) == pytest.approx([7.0, 4.0], abs=1e-3)
    said = report.lines()
    assert "not carried over: objects of type 'tree': road 1" in said
    assert "not carried over: signals of type '101' of country 'se': road 1" in [line.lower() for line in said]


def test_speed_limits_of_signs_hold_where_no_road_type_has_one(tmp_path: Path) -> None:
    sign = signal("274", s=0).replace('value="-1"', 'value="30"')
    tail = f"<signals>{sign}</signals>"
    assert approach(tmp_path, tail).speed_limit[0] == pytest.approx(30 / 3.6)
    miles = tail.replace("/></signals>", ' unit="mph"/></signals>')
    assert approach(tmp_path, miles).speed_limit[0] == pytest.approx(30 * 0.44704)
    typed = '<type s="0" type="town"><speed max="50" unit="km/h"/></type>'
    assert approach(tmp_path, tail, speed=typed).speed_limit[0] == pytest.approx(50 / 3.6)


def test_unknown_lane_types_are_named(tmp_path: Path) -> None:
    report = ImportReport("map")
    graph = town(tmp_path, road(sections=section("", lanes(-1) + lane(-2, kind="tram"))), report=report)
    assert graph.kind.tolist() == [LaneType.NONE, LaneType.DRIVING]
    assert "not carried over: lanes of type 'tram' are no road for traffic: road 1, lane -2" in report.lines()


def test_strict_names_the_first_doubt_and_counts_the_others() -> None:
    report = ImportReport("a.xodr", doubts={"odd": ["road 1", "road 2"], "odder": [""], "oddest": [""]})
    with pytest.raises(MapError, match=r"^a\.xodr: odd \(2 times\): road 1, road 2, and 2 other doubts; correct"):
        report.refuse_doubts(MapError)
    ImportReport("a.xodr", omissions={"trees": [""]}).refuse_doubts(MapError)


def test_a_page_shows_the_report_and_every_lane(tmp_path: Path, ssad_home: Path) -> None:
    town(tmp_path, road(1), road(2, x=100.2))
    import_map(tmp_path / "map.xodr", "A & B", ssad_home)
    page = (ssad_home / "imports" / "A & B.html").read_text(encoding="utf-8")
    assert "<h1>Import of A &amp; B</h1>" in page
    assert "a lane ends beside an unlinked start" in page
    driving = page.split('fill="#5d636b"')[1].split("/>")[0]
    assert driving.count("M") == 4  # a polygon for each lane
    assert page.count("<circle") == 8  # both ends of each lane


@pytest.mark.parametrize("wanted", [True, False])
def test_the_user_decides_on_turns_on_red(tmp_path: Path, ssad_home: Path, wanted: bool) -> None:
    town(tmp_path, road())
    stored = import_map(tmp_path / "map.xodr", "Own", ssad_home, turn_on_red=wanted)
    assert load_graph(stored).turn_on_red.tolist() == [wanted]


@pytest.mark.parametrize(
    "shape",
    [
        '<spiral curvStart="-0.01" curvEnd="0.03"/>',
        '<paramPoly3 aU="0" bU="40" cU="180" dU="-120" aV="0" bV="0" cV="20" dV="-12" pRange="normalized"/>',
        '<poly3 a="0" b="0" c="0.002" d="-0.00001"/>',
    ],
)
def test_centres_are_those_of_an_adaptive_quadrature(tmp_path: Path, shape: str) -> None:
    path = tmp_path / "map.xodr"
    path.write_text(f"<OpenDRIVE>{road(heading=0.7, shape=shape)}</OpenDRIVE>", encoding="utf-8")
    sampler = LaneSampler(read_network(path))
    samples = sampler.lanes([(1, 0, -1), (1, 0, 1)])
    for index in range(0, samples.first[1], 20):
        exact = integrated_centre(sampler, 1, float(samples.s[index]), samples.xy[index])
        assert samples.xy[index] == pytest.approx(exact, abs=1e-5)


def test_a_map_of_copies_has_the_lanes_of_each(tmp_path: Path) -> None:
    """The map that `benchmarks.large_map` measures is a map of separate towns, none of whose lanes is lost."""
    town_graph = load_town(TOWN)
    path = tmp_path / "copies.xodr"
    path.write_bytes(large_map(1.2 * len(town_xodr(TOWN))))
    graph = bake(path)
    assert graph.lane_count == 2 * town_graph.lane_count
    assert len(graph.succ) == 2 * len(town_graph.succ)
    assert np.ptp(graph.xy[:, 0]) == pytest.approx(np.ptp(town_graph.xy[:, 0]) + SPACING, abs=0.1)

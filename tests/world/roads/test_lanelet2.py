"""Lanelet2 maps: directions, links, neighbours, junctions, signals, signs, limits, coordinates, and bad input."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad
from helpers.lanelet_maps import MapWriter, crossing_map, straight

from ssad.core.errors import MapError
from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph, Marking, SignKind
from ssad.core.types import LaneType
from ssad.world.roads import bake, import_map, load_town
from ssad.world.roads.lanelet2 import Lanelet2Options, directions
from ssad.world.roads.projection import local, utm

KM_H = 1.0 / 3.6


def town(tmp_path: Path, road: MapWriter, report: ImportReport | None = None, **options: object) -> LaneGraph:
    asked = Lanelet2Options(**options) if options else None  # type: ignore[arg-type]
    return bake(road.write(tmp_path / "map.osm"), report=report, lanelet2=asked)


def ends(graph: LaneGraph, lane: int) -> list[list[float]]:
    points = graph.xy[graph.points(lane)]
    return np.round([points[0], points[-1]], 3).tolist()


# ---------------------------------------------------------------- shapes


def test_the_middle_of_the_bounds_is_the_lane(tmp_path: Path) -> None:
    road = MapWriter()
    road.lanelet([(0.0, 2.0, 1.0), (40.0, 3.0, 5.0)], [(0.0, -2.0, 1.0), (20.0, -2.5, 3.0), (40.0, -3.0, 5.0)])
    graph = town(tmp_path, road)
    assert ends(graph, 0) == [[0.0, 0.0], [40.0, 0.0]]
    assert graph.at(0, 20.0)[3] == pytest.approx(5.0, abs=0.02)
    assert graph.z[[0, -1]].tolist() == [1.0, 5.0]
    assert np.abs(graph.xy[:, 1]).max() < 0.01


def test_lines_may_run_either_way(tmp_path: Path) -> None:
    """The left bound is on the left of the traffic, whichever way its points are listed."""
    left, right = straight(0, 30, 2), straight(0, 30, -2)
    for first, second in ((left, right), (left[::-1], right), (left, right[::-1]), (left[::-1], right[::-1])):
        road = MapWriter()
        road.lanelet(first, second)
        assert ends(town(tmp_path, road), 0) == [[0.0, 0.0], [30.0, 0.0]]
        road = MapWriter()
        road.lanelet(second, first)
        assert ends(town(tmp_path, road), 0) == [[30.0, 0.0], [0.0, 0.0]]


def test_a_turn_around_a_small_island_keeps_its_direction() -> None:
    angles = np.linspace(-0.2, np.pi + 0.2, 9)
    outer = 4.0 * np.stack([np.cos(angles), np.sin(angles)], 1)
    loop = np.linspace(0.0, 2.0 * np.pi - 0.3, 7)
    island = 0.4 * np.stack([np.cos(loop), np.sin(loop)], 1)
    assert directions(island, outer) == (False, False)
    assert directions(island[::-1], outer[::-1]) != (False, False)


def test_the_centre_has_the_same_distance_from_both_bounds(tmp_path: Path) -> None:
    """In a lane that widens to one side by a slope of 8 m in 20 m."""
    road = MapWriter()
    road.lanelet(straight(0, 40, 2), [(0.0, -2.0), (20.0, -2.0), (40.0, -10.0)])
    graph = town(tmp_path, road)
    x, y = graph.xy[(graph.xy[:, 0] > 22.0) & (graph.xy[:, 0] < 36.0)].T
    slope = np.array([20.0, -8.0]) / np.hypot(20.0, 8.0)
    to_right = slope[0] * (y + 2.0) - slope[1] * (x - 20.0)
    assert len(x) > 5
    assert np.abs(0.5 * ((2.0 - y) - to_right)).max() < 0.05


def test_a_centre_line_of_the_file_is_taken(tmp_path: Path) -> None:
    road = MapWriter()
    members = [("left", road.way(straight(0, 30, 2))), ("right", road.way(straight(0, 30, -2)))]
    centre = road.way([(30.0, 0.0), (15.0, 0.7), (0.0, 0.0)])
    road.relation([*members, ("centerline", centre)], {"type": "lanelet", "subtype": "road"})
    assert town(tmp_path, road).at(0, 15.0)[1] == pytest.approx(0.7, abs=0.02)


# ---------------------------------------------------------------- links and roads


def two_way(**tags: str) -> MapWriter:
    """Two lanes to the east and one to the west above them, in two pieces each; the markings are dashed and solid."""
    road = MapWriter()
    road.way(straight(0, 50, 0), type="line_thin", subtype="dashed")
    road.way(straight(0, 50, 4), type="line_thin", subtype="solid")
    for x in (0.0, 50.0):
        road.lanelet(straight(x, x + 50, 0), straight(x, x + 50, -4), **tags)
        road.lanelet(straight(x, x + 50, 4), straight(x, x + 50, 0), **tags)
        road.lanelet(straight(x, x + 50, 4)[::-1], straight(x, x + 50, 8)[::-1], **tags)
    return road


def test_shared_points_link_lanes_and_shared_lines_make_neighbours(tmp_path: Path) -> None:
    graph = town(tmp_path, two_way())
    assert [graph.successors(lane).tolist() for lane in range(6)] == [[3], [4], [], [], [], [2]]
    assert graph.left[:3].tolist() == [1, 2, 1]
    assert graph.right[:3].tolist() == [-1, 0, -1]
    assert graph.left_marking[:3].tolist() == [Marking.BROKEN, Marking.SOLID, Marking.SOLID]
    assert graph.right_marking[1] == Marking.BROKEN
    assert graph.is_same_direction(0, 1)
    assert not graph.is_same_direction(1, 2)
    assert graph.lane_id[:3].tolist() == [-2, -1, 1]
    assert len(set(graph.road.tolist())) == 2


def test_points_in_one_place_link_lanes_too(tmp_path: Path) -> None:
    road, report = MapWriter(), ImportReport("map")
    road.lanelet(straight(0, 30, 2), straight(0, 30, -2))
    road.lanelet([(30.004, 2.0), (60.0, 2.0)], [(30.004, -2.0), (60.0, -2.0)])
    assert town(tmp_path, road, report).successors(0).tolist() == [1]
    assert "points of bounds within 0.01 m count as one (2 times)" in report.lines()


def test_a_gap_between_lanes_is_doubtful(tmp_path: Path) -> None:
    road, report = MapWriter(), ImportReport("map")
    road.lanelet(straight(0, 30, 2), straight(0, 30, -2))
    road.lanelet(straight(30.2, 60, 2), straight(30.2, 60, -2))
    assert town(tmp_path, road, report).successors(0).tolist() == []
    assert [line for line in report.lines() if line.startswith("doubtful: a lane ends beside an unlinked start")]


@pytest.mark.parametrize(
    ("tags", "left", "right"),
    [
        ({"type": "line_thin", "subtype": "dashed_solid"}, Marking.SOLID, Marking.BROKEN),
        ({"type": "line_thin", "subtype": "solid_dashed"}, Marking.BROKEN, Marking.SOLID),
        ({"type": "virtual", "lane_change": "yes"}, Marking.BROKEN, Marking.BROKEN),
        ({"type": "line_thin", "subtype": "solid", "lane_change:left": "yes"}, Marking.BROKEN, Marking.SOLID),
        ({"type": "line_thin", "subtype": "dashed", "lane_change": "no"}, Marking.SOLID, Marking.SOLID),
        ({"type": "curbstone", "subtype": "high"}, Marking.CURB, Marking.CURB),
    ],
)
def test_markings_are_seen_from_the_lane(tmp_path: Path, tags: dict[str, str], left: Marking, right: Marking) -> None:
    """Left: to the left of the lower lane; right: to the right of the upper lane, of one line."""
    for reverse in (False, True):
        road = MapWriter()
        line = straight(0, 30, 0)
        if reverse:  # the line runs against the traffic, so that its left and right change places
            swap = {
                "dashed_solid": "solid_dashed",
                "solid_dashed": "dashed_solid",
                "lane_change:left": "lane_change:right",
            }
            road.way(line[::-1], **{swap.get(key, key): swap.get(value, value) for key, value in tags.items()})
        else:
            road.way(line, **tags)
        road.lanelet(line, straight(0, 30, -4))
        road.lanelet(straight(0, 30, 4), line)
        graph = town(tmp_path, road)
        assert (graph.left_marking[0], graph.right_marking[1]) == (left, right)


# ---------------------------------------------------------------- rule of the road


def test_oncoming_lanes_tell_the_rule_of_the_road(tmp_path: Path) -> None:
    report = ImportReport("map")
    assert not town(tmp_path, two_way(), report).left_hand[0]
    assert "right-hand traffic: 4 of 4 oncoming lanes lie on the left" in report.lines()
    mirrored = MapWriter()
    mirrored.lanelet(straight(0, 50, 4), straight(0, 50, 0), region="de")
    mirrored.lanelet(straight(0, 50, -4)[::-1], straight(0, 50, 0)[::-1], region="de")
    report = ImportReport("map")
    graph = town(tmp_path, mirrored, report)
    assert graph.left_hand[0]
    assert not graph.turn_on_red[0]
    assert graph.lane_id.tolist() == [1, -1]
    assert "the region is 'de'" in next(iter(report.doubts))
    assert not town(tmp_path, mirrored, left_hand=False).left_hand[0]


def test_a_one_way_map_takes_the_rule_of_its_region(tmp_path: Path) -> None:
    for region, left_hand, on_red in (("jp-13", True, False), ("us", False, True), ("de", False, False)):
        road = MapWriter()
        road.lanelet(straight(0, 30, 2), straight(0, 30, -2), region=region)
        graph = town(tmp_path, road)
        assert (bool(graph.left_hand[0]), bool(graph.turn_on_red[0])) == (left_hand, on_red)


# ---------------------------------------------------------------- kinds and limits


@pytest.mark.parametrize(
    ("tags", "kind"),
    [
        ({"subtype": "highway"}, LaneType.DRIVING),
        ({"subtype": "bus_lane"}, LaneType.DRIVING),
        ({"subtype": "bicycle_lane"}, LaneType.BIKING),
        ({"subtype": "walkway"}, LaneType.SIDEWALK),
        ({"subtype": "road_shoulder", "participant:pedestrian": "yes"}, LaneType.SHOULDER),
        ({"subtype": "road", "participant:bicycle": "yes"}, LaneType.BIKING),
        ({"subtype": "walkway", "participant:vehicle:car": "yes"}, LaneType.DRIVING),
        ({"subtype": "road", "participant:vehicle": "no"}, LaneType.NONE),
        ({"subtype": "rail"}, LaneType.NONE),
    ],
)
def test_subtypes_and_participants_tell_the_use(tmp_path: Path, tags: dict[str, str], kind: LaneType) -> None:
    road, report = MapWriter(), ImportReport("map")
    road.lanelet(straight(0, 30, 2), straight(0, 30, -2))
    road.lanelet(straight(0, 30, 12), straight(0, 30, 8), **tags)
    assert town(tmp_path, road, report).kind.tolist() == [LaneType.DRIVING, kind]
    assert any("no road for traffic" in line for line in report.lines()) == (kind == LaneType.NONE)


def test_crosswalks_become_outlines(tmp_path: Path) -> None:
    road = MapWriter()
    road.lanelet(straight(0, 30, 2), straight(0, 30, -2))
    road.lanelet([(10.0, -3.0), (10.0, 3.0)], [(13.0, -3.0), (13.0, 3.0)], subtype="crosswalk")
    graph = town(tmp_path, road)
    assert graph.lane_count == 1
    assert sorted(graph.crosswalk(0).tolist()) == [[10.0, -3.0], [10.0, 3.0], [13.0, -3.0], [13.0, 3.0]]


@pytest.mark.parametrize(
    ("tags", "limit"),
    [
        ({"speed_limit": "30"}, 30 * KM_H),
        ({"speed_limit": "25 mph"}, 25 * 0.44704),
        ({"speed_limit": "8.5 m/s"}, 8.5),
        ({"speed_limit:vehicle": "70 km/h", "speed_limit": "30"}, 70 * KM_H),
        ({}, 50 * KM_H),
        ({"location": "nonurban"}, 100 * KM_H),
        ({"location": "nonurban", "region": "us"}, 55 * 0.44704),
        ({"subtype": "highway"}, 130 * KM_H),
        ({"subtype": "play_street"}, 7 * KM_H),
    ],
)
def test_speed_limits_by_tags_location_and_country(tmp_path: Path, tags: dict[str, str], limit: float) -> None:
    road = MapWriter()
    road.lanelet(straight(0, 30, 2), straight(0, 30, -2), **tags)
    assert town(tmp_path, road).speed_limit[0] == pytest.approx(limit)


@pytest.mark.parametrize(
    ("sign", "tags", "limit"),
    [
        ("de274-60", {}, 60 * KM_H),
        ("de274.1-30", {}, 30 * KM_H),
        ("usR2-1-45", {}, 45 * 0.44704),
        ("gb670V20", {}, 20 * 0.44704),
        ("", {"sign_type": "50kmh"}, 50 * KM_H),
        ("", {"sign_type": "20 mph"}, 20 * 0.44704),
        ("de274-60", {"sign_type": "de274-80"}, 80 * KM_H),
    ],
)
def test_speed_limits_of_regulatory_elements_go_first(
    tmp_path: Path, sign: str, tags: dict[str, str], limit: float
) -> None:
    road = MapWriter()
    post = road.way([(0.0, 5.0), (0.0, 6.0)], type="traffic_sign", subtype=sign)
    rule = road.rule("speed_limit", [("refers", post)], **tags)
    road.lanelet(straight(0, 30, 2), straight(0, 30, -2), rule, speed_limit="10")
    assert town(tmp_path, road).speed_limit[0] == pytest.approx(limit)


@pytest.mark.parametrize("text", ["-10", "fast", "0", "30 knots", "1e99"])
def test_a_speed_limit_that_cannot_be_read_is_doubtful(tmp_path: Path, text: str) -> None:
    road, report = MapWriter(), ImportReport("map")
    road.lanelet(straight(0, 30, 2), straight(0, 30, -2), speed_limit=text)
    assert town(tmp_path, road, report).speed_limit[0] == pytest.approx(50 * KM_H)
    assert list(report.doubts) == ["a speed limit cannot be read"]


# ---------------------------------------------------------------- junctions, signals, signs


def test_lanes_that_cross_form_a_junction_and_its_light_has_a_stop_line(tmp_path: Path) -> None:
    graph = town(tmp_path, crossing_map())
    assert graph.junction.tolist() == [-1, 1, -1, -1, 1, -1]
    real = np.flatnonzero(~graph.signal_virtual)
    light = int(graph.stop_signal[graph.stop_lane == 0][0])
    assert light in real
    assert graph.signal_xy[light].tolist() == [6.0, 3.5]
    assert graph.stop_s[graph.stop_lane == 0].tolist() == pytest.approx([28.0])
    assert graph.signal_phase[light] != graph.signal_phase[graph.stop_signal[graph.stop_lane == 3][0]]


def test_short_forks_form_a_junction_and_long_ones_do_not(tmp_path: Path) -> None:
    for length, junction in ((40.0, [-1, 1, 1]), (140.0, [-1, -1, -1])):
        road = MapWriter()
        road.lanelet(straight(-50, 0, 2), straight(-50, 0, -2))
        for y in (0.0, 12.0):
            road.lanelet([(0.0, 2.0), (length, y + 2.0)], [(0.0, -2.0), (length, y - 2.0)])
        graph = town(tmp_path, road)
        assert graph.junction.tolist() == junction
        assert graph.successors(0).tolist() == [1, 2]


def test_headings_have_no_step_where_lanes_follow_each_other(tmp_path: Path) -> None:
    road = MapWriter()
    road.lanelet(straight(0, 30, 2), straight(0, 30, -2))
    road.lanelet([(30.0, 2.0), (58.0, 12.0)], [(30.0, -2.0), (60.0, 8.0)])
    graph = town(tmp_path, road)
    end, start = graph.yaw[graph.points(0)][-1], graph.yaw[graph.points(1)][0]
    assert end == pytest.approx(start)
    assert 0.05 < end < 0.3


def test_right_of_way_of_one_turn_alone_makes_no_sign(tmp_path: Path) -> None:
    road, report = with_rule("right_of_way", "", "yield"), ImportReport("map")
    road.relations = [text.replace('role="yield"', 'role="of"') for text in road.relations]
    turn = road.lanelet([(-2.0, -10.0), (-10.0, -4.0)], [(2.0, -10.0), (-8.0, 0.0)])
    road.relations.append(
        f'<relation id="900"><member type="relation" ref="{turn}" role="yield"/>'
        '<tag k="type" v="regulatory_element"/><tag k="subtype" v="right_of_way"/></relation>'
    )
    graph = town(tmp_path, road, report)
    assert graph.junction[-1] >= 0
    assert graph.rule_lane.tolist() == []
    assert report.omissions["right of way of single turns, or at traffic lights"] == [f"lanelet {turn}"]


def test_lanes_at_other_heights_do_not_cross(tmp_path: Path) -> None:
    road = MapWriter()
    road.lanelet([(-30.0, 2.0, 6.0), (30.0, 2.0, 6.0)], [(-30.0, -2.0, 6.0), (30.0, -2.0, 6.0)])
    road.lanelet([(-2.0, -30.0, 0.0), (-2.0, 30.0, 0.0)], [(2.0, -30.0, 0.0), (2.0, 30.0, 0.0)])
    assert town(tmp_path, road).junction.tolist() == [-1, -1]


def with_rule(subtype: str, sign: str, role: str = "") -> MapWriter:
    """Two roads that cross; the northbound one has a stop or yield sign, or must yield."""
    road = MapWriter()
    post = road.way([(4.0, -12.0), (5.0, -12.0)], type="traffic_sign", subtype=sign)
    rule = road.count + 1 if role else road.rule(subtype, [("refers", post)])
    ahead = road.number() if role else 0
    road.lanelet(straight(-60, -10, 2), straight(-60, -10, -2))
    road.lanelet(straight(-10, 10, 2), straight(-10, 10, -2))
    north = road.lanelet([(-2.0, -60.0), (-2.0, -10.0)], [(2.0, -60.0), (2.0, -10.0)], rule)
    road.lanelet([(-2.0, -10.0), (-2.0, 10.0)], [(2.0, -10.0), (2.0, 10.0)])
    if role:
        road.relations.append(
            f'<relation id="{ahead}"><member type="relation" ref="{north}" role="{role}"/>'
            f'<tag k="type" v="regulatory_element"/><tag k="subtype" v="{subtype}"/></relation>'
        )
    return road


@pytest.mark.parametrize(
    ("road", "kind"),
    [
        (with_rule("traffic_sign", "de206"), SignKind.STOP),
        (with_rule("traffic_sign", "stop_sign"), SignKind.STOP),
        (with_rule("traffic_sign", "usR1-2"), SignKind.YIELD),
        (with_rule("right_of_way", "", "yield"), SignKind.YIELD),
        (with_rule("all_way_stop", "", "yield"), SignKind.STOP),
    ],
)
def test_signs_and_right_of_way_rule_the_approach(tmp_path: Path, road: MapWriter, kind: SignKind) -> None:
    graph = town(tmp_path, road)
    assert (graph.sign_kind.tolist(), graph.rule_lane.tolist()) == ([kind], [2])
    assert graph.rule_s.tolist() == pytest.approx([50.0])


def test_a_light_away_from_junctions_stops_its_lane(tmp_path: Path) -> None:
    road = MapWriter()
    line = road.way([(20.0, 2.0), (20.0, -2.0)], type="stop_line")
    light = road.rule("traffic_light", [("ref_line", line)])
    road.lanelet(straight(0, 50, 2), straight(0, 50, -2), light)
    graph = town(tmp_path, road)
    assert (graph.stop_lane.tolist(), graph.signal_junction.tolist()) == ([0], [-1])
    assert graph.stop_s.tolist() == pytest.approx([20.0])


# ---------------------------------------------------------------- coordinates


PLACE = (8.4321, 49.0123)


def in_degrees() -> MapWriter:
    road = MapWriter(local=False)
    x, y = PLACE
    road.lanelet([(x, y + 1e-5), (x + 1e-3, y + 1e-5)], [(x, y - 1e-5), (x + 1e-3, y - 1e-5)])
    return road


def test_degrees_are_projected_by_utm_and_the_origin_is_kept(tmp_path: Path) -> None:
    report = ImportReport("map")
    graph = town(tmp_path, in_degrees(), report)
    expected = utm(PLACE[1], PLACE[0]).project(np.array([PLACE[1]]), np.array([PLACE[0]]))[0]
    assert graph.xy[0] + graph.origin == pytest.approx(expected, abs=0.01)
    assert np.abs(graph.xy).max() < 100.0
    assert any(line.startswith("coordinates: UTM zone 32 north, shifted by (-4") for line in report.lines())


def test_a_stated_origin_is_the_origin(tmp_path: Path) -> None:
    graph = town(tmp_path, in_degrees(), origin=(PLACE[1], PLACE[0]))
    assert graph.xy[0] == pytest.approx([0.0, 0.0], abs=0.01)
    graph = town(tmp_path, in_degrees(), origin=(PLACE[1], PLACE[0]), projection="local")
    assert graph.xy[0] == pytest.approx([0.0, 0.0], abs=0.01)
    end = local(PLACE[1], PLACE[0]).project(np.array([PLACE[1]]), np.array([PLACE[0] + 1e-3]))[0]
    assert graph.xy[-1] == pytest.approx(end, abs=0.01)
    report = ImportReport("map")
    town(tmp_path, in_degrees(), report, origin=(48.0, 8.4))
    assert any("km from --origin" in doubt for doubt in report.doubts)


def test_local_coordinates_far_away_are_shifted(tmp_path: Path) -> None:
    road = MapWriter()
    road.lanelet([(80000.25, 43002.0), (80040.25, 43002.0)], [(80000.25, 42998.0), (80040.25, 42998.0)])
    graph = town(tmp_path, road)
    assert np.abs(graph.xy).max() < 30.0
    assert (graph.xy[0] + graph.origin).tolist() == [80000.25, 43000.0]


# ---------------------------------------------------------------- imports and bad input


def test_a_town_is_stored_without_the_opendrive_file_beside_the_map(tmp_path: Path, ssad_home: Path) -> None:
    crossing_map().write(tmp_path / "place.osm")
    (tmp_path / "place.xodr").write_text("<OpenDRIVE/>")
    import_map(tmp_path / "place.osm", None, ssad_home)
    assert load_town("place").lane_count == load_town(str(tmp_path / "place.osm")).lane_count == 6
    assert not (ssad_home / "towns" / "place.xodr").exists()
    assert "Lanelet2 map" in (ssad_home / "imports" / "place.html").read_text(encoding="utf-8")


def test_the_command_reports_in_80_columns_and_strict_refuses(tmp_path: Path, ssad_home: Path) -> None:
    two_way(one_way="no").write(tmp_path / "a.osm")
    done = ssad("import", "map", tmp_path / "a.osm", "--strict", "--right-hand")
    assert done.returncode == 0, done.stderr
    assert max(map(len, done.stdout.replace(str(tmp_path), "").splitlines())) <= 80
    two_way(one_way="maybe").write(tmp_path / "b.osm")
    done = ssad("import", "map", tmp_path / "b.osm", "--strict")
    assert done.returncode == 2
    assert re.fullmatch(r"error: .*one_way='maybe'.*without --strict\n", done.stderr)
    assert not (ssad_home / "towns" / "b.npz").exists()
    for words, problem in ((("--origin", "49"), "give latitude and longitude"), (("--projection", "x"), "choose utm")):
        done = ssad("import", "map", tmp_path / "a.osm", *words)
        assert (done.returncode, problem in done.stderr) == (2, True)


def test_deleted_elements_are_passed_over(tmp_path: Path) -> None:
    road = two_way()
    road.relations[0] = road.relations[0].replace("<relation ", '<relation action="delete" ')
    report = ImportReport("map")
    assert town(tmp_path, road, report).lane_count == 5
    assert "deleted relations are passed over" in report.lines()


def test_what_is_left_out_is_named(tmp_path: Path) -> None:
    road, report = two_way(one_way="no"), ImportReport("map")
    road.way([(0.0, 20.0), (9.0, 20.0)], type="fence")
    road.rule("detection_area", [])
    road.relation([], {"type": "multipolygon", "subtype": "parking"})
    town(tmp_path, road, report)
    lines = "\n".join(report.lines())
    for text in (
        "traffic in the second direction of lanelets that have two (6 times)",
        "lines of type 'fence' that bound no lanelet",
        "regulatory elements of subtype 'detection_area'",
        "areas: parking",
    ):
        assert f"not carried over: {text}" in lines


@pytest.mark.parametrize(
    ("pattern", "replacement", "doubt"),
    [
        (r'<way id="6">', '<way id="6000">', "a lanelet refers to a line that the map lacks; it is left out"),
        (r'role="right"', 'role="rite"', "a lanelet lacks a bound; it is left out"),
        (r'<nd ref="4"/>', "", "a bound has fewer than two points; the lanelet is left out"),
        (r'v="yes"', 'v="maybe"', "one_way='maybe' is neither yes nor no; yes is taken"),
    ],
)
def test_doubts_name_the_lanelet(tmp_path: Path, pattern: str, replacement: str, doubt: str) -> None:
    road = MapWriter()
    road.lanelet(straight(0, 30, 2), straight(0, 30, -2), one_way="yes")
    road.lanelet(straight(30, 60, 2), straight(30, 60, -2), one_way="yes")
    text = road.text()
    assert re.search(pattern, text)
    (tmp_path / "map.osm").write_text(re.sub(pattern, replacement, text, count=1), encoding="utf-8")
    report = ImportReport("map")
    bake(tmp_path / "map.osm", report=report)
    assert doubt in report.doubts
    with pytest.raises(MapError, match="without --strict"):
        report.refuse_doubts(MapError)


@pytest.mark.parametrize(
    ("pattern", "replacement", "problem"),
    [
        (
            r'<way id="[36]">',
            '<way id="99{}">',
            "way 3: no lanelet in it has a bound with points: the map lacks this line",
        ),
        (r'<nd ref="1"/>', '<nd ref="77"/>', "way 3, node 77: no lanelet in it has a shape: a line refers to a point"),
        (r'<nd ref="1"/>', "", "lanelet 7, way 3: no lanelet in it has a shape: a bound has fewer than two points"),
        (r'role="right"', 'role="rite"', "lanelet 7: no lanelet in it has a shape: a lanelet lacks a bound"),
    ],
)
def test_a_map_without_any_lanelet_names_the_element_at_fault(
    tmp_path: Path, pattern: str, replacement: str, problem: str
) -> None:
    road = MapWriter()
    road.lanelet(straight(0, 30, 2), straight(0, 30, -2))
    numbers = itertools.count()
    text = re.sub(pattern, lambda _: replacement.format(next(numbers)), road.text())
    assert text != road.text()
    (tmp_path / "map.osm").write_text(text, encoding="utf-8")
    with pytest.raises(MapError) as refused:
        bake(tmp_path / "map.osm")
    assert f"map.osm: {problem}" in str(refused.value)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("<osm>", "not valid XML"),
        ("<OpenDRIVE/>", "the root element is not <osm>"),
        ('<osm><way id="1"><tag k="highway" v="primary"/></way></osm>', "no lanelet in it"),
        ('<osm><relation id="1"><tag k="type" v="lanelet"/></relation></osm>', "no lanelet in it has a bound"),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path: Path, text: str, problem: str) -> None:
    (tmp_path / "map.osm").write_text(text)
    with pytest.raises(MapError, match=problem):
        bake(tmp_path / "map.osm")


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('v="30.0"', 'v="x"', "'x' is not a number"),
        ('v="30.0"', 'v="nan"', "not finite"),
        ('k="local_x" v="30.0"', 'k="other" v="30.0"', "neither latitude"),
        ('v="30.0"', 'v="9000000.0"', "from their middle"),
        ('<node id="2"', '<node id="1"', "two nodes have this id"),
        ('v="road"', 'v="walkway"', "no lanelet for vehicles"),
    ],
)
def test_broken_values_are_refused_in_one_line(tmp_path: Path, old: str, new: str, problem: str) -> None:
    road = MapWriter()
    road.lanelet(straight(0, 30, 2), straight(0, 30, -2))
    assert old in road.text()
    (tmp_path / "map.osm").write_text(road.text().replace(old, new))
    with pytest.raises(MapError, match=problem):
        bake(tmp_path / "map.osm")


def test_options_of_lanelet2_maps_are_refused_with_others(tmp_path: Path) -> None:
    (tmp_path / "map.xodr").write_text("<OpenDRIVE/>")
    with pytest.raises(MapError, match="for Lanelet2 maps"):
        bake(tmp_path / "map.xodr", lanelet2=Lanelet2Options(left_hand=True))

"""Baking: agreement with carla.Map, bad maps, imports."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from benchmarks.opendrive_maps import check_map
from ssad.core.errors import MapError
from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph, SignKind, are_equal
from ssad.core.types import LaneType
from ssad.world.roads import bake, import_map, load_graph, load_town, town_names
from ssad.world.roads.designs import generate_town
from ssad.world.roads.query import nearest_all, segments
from tests.world.roads.towns import IMPORTED, built_in, imported


def centre_distance(graph: LaneGraph, points: np.ndarray) -> np.ndarray:
    """Distance [n] of each point from the nearest driving centre line."""
    seg, _, _, _ = segments(graph, (LaneType.DRIVING,))
    order = np.argsort(seg[:, 0])
    a, d = seg[order, :2].astype(float), (seg[order, 2:] - seg[order, :2]).astype(float)
    reach = np.hypot(*d.T).max() + 1.0  # segments that begin further off are further off than a metre
    first, last = (np.searchsorted(a[:, 0], points[:, 0] + side) for side in (-reach, reach))
    least = []
    for p, i, j in zip(points, first, last, strict=True):
        start, way = a[i:j], d[i:j]
        t = np.clip(((p - start) * way).sum(1) / (way * way).sum(1), 0, 1)
        least.append(np.hypot(*(p - start - t[:, None] * way).T).min(initial=np.inf))
    return np.array(least)


def check_against_carla(graph: LaneGraph, text: str) -> None:
    carla = pytest.importorskip("carla", reason="the extra carla is not installed (no wheel for this Python)")
    road_map = carla.Map(graph.name, text)
    found = road_map.generate_waypoints(2.0)
    points = np.array([[w.transform.location.x, -w.transform.location.y] for w in found])
    assert len(points) > 300
    assert centre_distance(graph, points).max() < 0.05
    key = {
        (int(r), int(s), int(n)): i
        for i, (r, s, n) in enumerate(zip(graph.road, graph.section, graph.lane_id, strict=True))
    }
    # successors: what CARLA can drive into 0.5 m further on is this lane or one that we link
    checked = 0
    for begin, end in road_map.get_topology():
        one = key.get((begin.road_id, begin.section_id, begin.lane_id))
        two = key.get((end.road_id, end.section_id, end.lane_id))
        if one is None or two is None or graph.kind[two] != LaneType.DRIVING:
            continue
        x, y = end.transform.location.x, -end.transform.location.y
        a, b = graph.points(one).stop - 1, graph.points(two).start
        if np.hypot(*(graph.xy[a] - graph.xy[b])) < 0.5:
            assert two in graph.successors(one)
            assert np.hypot(graph.xy[b][0] - x, graph.xy[b][1] - y) < 0.5
            checked += 1
    assert checked > 30
    # direction of traffic, width and junctions agree
    tiny = 0
    for w in found[::7]:
        i = key.get((w.road_id, w.section_id, w.lane_id), -1)
        if i < 0:  # shorter than 0.1 m
            tiny += 1
            continue
        x, y = w.transform.location.x, -w.transform.location.y
        part = graph.points(i)
        k = part.start + int(np.hypot(graph.xy[part, 0] - x, graph.xy[part, 1] - y).argmin())
        yaw = -np.radians(w.transform.rotation.yaw)
        assert np.cos(yaw - graph.yaw[k]) > 0.8
        assert abs(w.lane_width - graph.width[k]) < 0.8  # tapers, up to a metre from a sample
        assert (graph.junction[i] >= 0) == w.is_junction
    assert tiny < 0.01 * len(found)


@pytest.mark.data
@pytest.mark.parametrize("name", IMPORTED)
def test_baked_lanes_are_where_carla_has_them(carla_home: Path, data_dir: Path, name: str) -> None:
    text = (data_dir / "maps" / f"{name}.xodr").read_text(encoding="utf-8")
    check_against_carla(imported(carla_home, name), text)


@pytest.mark.data
@pytest.mark.parametrize("name", IMPORTED)
def test_centres_of_carla_towns_are_carlas_to_a_millimetre(data_dir: Path, name: str) -> None:
    pytest.importorskip("carla", reason="the extra carla is not installed (no wheel for this Python)")
    result = check_map(data_dir / "maps" / f"{name}.xodr")
    assert result.distance is not None
    assert len(result.distance) > 5000
    assert not result.missing
    assert result.worst < 1e-3


@pytest.mark.parametrize("name", ["Twinford", "Crossgate", "ProvingGround"])
def test_own_towns_are_where_carla_has_them(name: str) -> None:
    check_against_carla(built_in(name), generate_town(name))


@pytest.mark.data
def test_facts_of_carla_towns(carla_home: Path) -> None:
    two = imported(carla_home, "Town02")
    assert (two.kind == LaneType.DRIVING).sum() == 88
    assert len(two.signal_phase) == 24
    assert not two.signal_virtual.any()
    assert np.unique(two.speed_limit[two.kind == LaneType.DRIVING]) == pytest.approx([25 * 0.44704])
    five = imported(carla_home, "Town05")
    assert five.signal_virtual.all()
    limits = np.unique(five.speed_limit[five.kind == LaneType.DRIVING])
    assert limits == pytest.approx(np.array([35, 55, 65]) * 0.44704, rel=1e-5)
    light = imported(carla_home, "Town_Safebench_Light")
    assert light.signal_virtual.all()
    assert len(np.unique(light.signal_junction)) == 12
    for graph in (two, five, light):
        driving = np.flatnonzero(graph.kind == LaneType.DRIVING)
        assert all(len(graph.successors(int(i))) > 0 for i in driving)


@pytest.mark.data
@pytest.mark.parametrize("name", IMPORTED)
def test_every_approach_of_a_signalled_junction_has_a_stop_line(carla_home: Path, name: str) -> None:
    graph = imported(carla_home, name)
    stopped = set(graph.stop_lane.tolist())
    signalled = set(graph.signal_junction.tolist())
    for lane in np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0)):
        enters = {int(graph.junction[n]) for n in graph.successors(int(lane)) if graph.kind[n] == 1} - {-1}
        if enters & signalled:
            assert int(lane) in stopped
    x, y, yaw = graph.signal_xy[:, 0], graph.signal_xy[:, 1], graph.signal_yaw
    for k, lane in zip(graph.stop_signal, graph.stop_lane, strict=True):
        stop = graph.at(int(lane), float(graph.length[lane]))
        assert np.hypot(x[k] - stop[0], y[k] - stop[1]) < 45.0
        assert np.cos(yaw[k] - stop[2]) > 0.7


def test_signs_of_a_map_are_known_by_what_they_name(tmp_path: Path) -> None:
    """A stop sign on its own approach, one that the connecting lanes refer to, paint on the road, and a sign that is
    turned to no lane of its road."""
    plain = bake(_map(tmp_path, SMALL), "plain")
    assert set(plain.sign_kind.tolist()) == {SignKind.STOP, SignKind.YIELD}
    where = dict(zip(plain.rule_sign.tolist(), plain.rule_lane.tolist(), strict=True))
    root = ElementTree.fromstring(SMALL)
    posts = [(road, post) for road in root.findall("road") for post in road.findall("signals/signal[@dynamic='no']")]
    assert len(posts) == len(plain.sign_kind)
    posts.sort(key=lambda pair: int(pair[1].get("id", "")))
    posts[0][1].set("name", "Stencil_STOP")
    posts[1][1].remove(posts[1][1].find("validity"))
    posts[2][1].set("orientation", "-" if posts[2][1].get("orientation") == "+" else "+")
    # the post stays where it is, the way behind the approach says whom it rules
    post = posts[3][1]
    post.remove(post.find("validity"))
    post.set("orientation", "-" if post.get("orientation") == "+" else "+")
    lane = int(plain.rule_lane[plain.rule_sign.tolist().index(3)])
    after = next(int(k) for k in plain.successors(lane) if plain.kind[k] == LaneType.DRIVING)
    way = next(r for r in root.findall("road") if r.get("id") == str(plain.road[after]))
    signals = ElementTree.SubElement(way, "signals")
    reference = ElementTree.SubElement(signals, "signalReference", s="0", t="0", orientation="+", id=post.get("id", ""))
    ElementTree.SubElement(reference, "validity", fromLane="-1", toLane="-1")
    changed = bake(_map(tmp_path, ElementTree.tostring(root, encoding="unicode")), "changed")
    ruled = set(changed.rule_lane.tolist())
    assert where[0] not in ruled, "paint is no sign"
    assert where[1] in ruled, "without a range of lanes, all of its direction"
    assert where[2] not in ruled, "its range and its direction leave none"
    assert where[3] in ruled, "the lane before the one that refers to it"
    for name in ("stop_lane", "stop_s", "signal_xy", "signal_virtual", "xy", "succ"):
        assert np.array_equal(getattr(changed, name), getattr(plain, name)), "signs change nothing that is driven by"


def test_junctions_without_lights_and_signs_are_controlled_where_it_is_asked_for(
    tmp_path: Path, ssad_home: Path
) -> None:
    """Junctions with lights, those with a sign, and the roads between them stay as the map has them."""
    root = ElementTree.fromstring(SMALL)
    for speed in root.iter("speed"):
        speed.set("max", "100")
        speed.set("unit", "km/h")
    posts = [(road, post) for road in root.findall("road") for post in road.findall("signals/signal[@dynamic='no']")]
    sign = min(post.get("id", "") for _, post in posts)
    for road, post in posts:
        if post.get("id") != sign:
            road.find("signals").remove(post)
    path = _map(tmp_path, ElementTree.tostring(root, encoding="unicode"))
    report = ImportReport("small")
    plain = load_graph(import_map(path, "small", ssad_home))
    slow = load_graph(import_map(path, "small", ssad_home, uncontrolled="slow", report=report))
    lit = load_graph(import_map(path, "small", ssad_home, uncontrolled="signals"))
    assert np.unique(plain.speed_limit) == pytest.approx([100.0 / 3.6])
    signed = {int(plain.junction[after]) for lane in plain.rule_lane for after in plain.successors(int(lane))} - {-1}
    uncontrolled = set(plain.signal_junction[plain.signal_virtual].tolist()) - signed
    assert len(signed) == 1
    assert len(uncontrolled) == 3
    across = np.isin(plain.junction, list(uncontrolled)) & (plain.kind == LaneType.DRIVING)
    assert slow.speed_limit[across] == pytest.approx(50.0 / 3.6)
    assert slow.speed_limit[~across] == pytest.approx(100.0 / 3.6)
    assert are_equal(replace(slow, speed_limit=plain.speed_limit), plain)
    assert report.notes["the speed limit across junctions without lights and signs is 50 km/h"] == [
        f"junction {junction}" for junction in sorted(uncontrolled)
    ]
    assert set(lit.signal_junction[lit.signal_virtual].tolist()) == signed
    assert are_equal(replace(lit, signal_virtual=plain.signal_virtual), slow)


def _map(folder: Path, text: str) -> Path:
    path = folder / "signs.xodr"
    path.write_text(text, encoding="utf-8")
    return path


SMALL = generate_town("Twinford")
BOMB = (
    '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x "ha"><!ENTITY y "&x;&x;&x;&x;&x;&x;&x;&x;&x;&x;">'
    '<!ENTITY z "&y;&y;&y;&y;&y;&y;&y;&y;&y;&y;">]><OpenDRIVE>&z;</OpenDRIVE>'
)
ROAD = (
    '<OpenDRIVE><header revMajor="1" revMinor="4"/><road id="1" length="10" junction="-1"><planView>'
    '<geometry s="0" x="0" y="0" hdg="0" length="10"><line/></geometry></planView><lanes><laneSection s="0">'
    '<center><lane id="0" type="none"/></center><right><lane id="-1" type="driving">'
    '<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right></laneSection></lanes></road></OpenDRIVE>'
)
BAD = {
    "empty": ("", "not valid XML"),
    "text": ("this is not a map", "not valid XML"),
    "binary": ("\x00\x01\x02" * 99, "not valid XML"),
    "truncated": (SMALL[: len(SMALL) // 2], "not valid XML"),
    "bomb": (BOMB, "refused"),
    "external": (BOMB.replace('"ha"', 'SYSTEM "file:///etc/passwd"'), "refused"),
    "root": ("<osm/>", "root element"),
    "no road": ("<OpenDRIVE/>", "no road"),
    "sidewalk": (SMALL.replace('type="driving"', 'type="sidewalk"'), "no drivable lane"),
    "nan": (ROAD.replace('x="0"', 'x="nan"'), "road 1: <geometry x='nan'>"),
    "inf": (ROAD.replace('hdg="0"', 'hdg="inf"'), "road 1: <geometry hdg='inf'>"),
    "far": (ROAD.replace('y="0"', 'y="1e30"'), "road 1: <geometry y='1e30'>"),
    "word": (ROAD.replace('a="3.5"', 'a="wide"'), "road 1: <width a='wide'> is not a number"),
    "long": (ROAD.replace('length="10"', 'length="900000"'), "road 1: length"),
    "no plan": (ROAD.replace("<planView>", "<planView/><old>").replace("</planView>", "</old>"), "no <geometry>"),
    "shape": (ROAD.replace("<line/>", "<clothoid/>"), "road 1: <geometry> holds clothoid"),
    "no section": (ROAD.replace("laneSection", "section"), "no <laneSection>"),
    "id": (ROAD.replace('id="-1"', 'id="one"'), "<lane id='one'> is not a whole number"),
    "no id": (ROAD.replace('road id="1"', "road"), "a road has no attribute 'id'"),
    "lanes": (
        ROAD.replace('length="10"', 'length="90000"').replace(
            "</right>", "".join(f'<lane id="-{n}" type="none"/>' for n in range(2, 60)) + "</right>"
        ),
        "m of lanes, the limit is",
    ),
    "turns": (ROAD.replace("<line/>", '<arc curvature="1e6"/>'), "turns by more than 200 rad"),
    "apart": (
        ROAD.replace(
            "</OpenDRIVE>", ROAD[ROAD.index("<road") :].replace('id="1"', 'id="2"').replace('x="0"', 'x="9e7"')
        ),
        "m from their middle",
    ),
    "two lanes": (ROAD.replace('<lane id="-1"', '<lane id="-1"/><lane id="-1"'), "lane -1 is there twice"),
    "twice": (ROAD.replace("</OpenDRIVE>", ROAD[ROAD.index("<road") :]), "two roads"),
    "start": (
        ROAD.replace('<geometry s="0"', '<geometry s="5"'),
        "road 1: its <geometry> elements do not begin at s=0",
    ),
    "speed": (
        ROAD.replace("<planView>", '<type s="0" type="town"><speed max="3" unit="knots"/></type><planView>'),
        "unit='knots'",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_maps_end_in_one_line(tmp_path: Path, name: str) -> None:
    text, message = BAD[name]
    path = tmp_path / "bad.xodr"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MapError) as caught:
        import_map(path, "Bad", tmp_path / "home")
    said = str(caught.value)
    assert message in said
    assert "bad.xodr" in said
    assert "\n" not in said
    assert not (tmp_path / "home").exists()


def test_the_small_map_of_the_table_is_good_before_it_is_broken(tmp_path: Path) -> None:
    path = tmp_path / "road.xodr"
    path.write_text(ROAD, encoding="utf-8")
    graph = bake(path)
    assert graph.name == "road"
    assert graph.lane_count == 1
    assert graph.length[0] == pytest.approx(10.0, abs=0.01)
    assert graph.xy[:, 1] == pytest.approx(-1.75)
    assert nearest_all(graph, (5.0, -1.75), (LaneType.DRIVING,))[2] == pytest.approx(-1.75, abs=1e-3)


def test_missing_map_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.xodr", tmp_path):
        with pytest.raises(MapError) as caught:
            bake(path)
        assert "\n" not in str(caught.value)


DOUBTFUL = {
    "lost lane": (
        ROAD.replace(
            "<planView>",
            '<link><successor elementType="road" elementId="1" contactPoint="start"/></link><planView>',
        ).replace('"driving">', '"driving"><link><successor id="-9"/></link>'),
        "a lane is linked to one that does not exist: road 1, lane -9",
    ),
    "lost road": (
        ROAD.replace("<planView>", '<link><successor elementType="road" elementId="7"/></link><planView>'),
        "a road is linked to a road that the map lacks; it ends there: road 1 to 7",
    ),
    "lost junction": (
        ROAD.replace("<planView>", '<link><successor elementType="junction" elementId="7"/></link><planView>'),
        "a road is linked to a junction that the map lacks; it ends there: road 1 to 7",
    ),
    "lost signal": (
        ROAD.replace("</road>", '<signals><signalReference id="77" s="5" t="0"/></signals></road>'),
        "a road refers to a signal that the map lacks: road 1, signal 77",
    ),
    "short plan": (ROAD.replace('length="10" j', 'length="12" j'), "road 1: 10.00, 12.00 m"),
    "other side": (ROAD.replace('lane id="-1"', 'lane id="1"'), "under <right>"),
}


@pytest.mark.parametrize("name", DOUBTFUL)
def test_doubtful_maps_come_in_with_a_line_or_are_refused(tmp_path: Path, name: str) -> None:
    text, line = DOUBTFUL[name]
    path = tmp_path / "doubtful.xodr"
    path.write_text(text, encoding="utf-8")
    report = ImportReport(str(path))
    import_map(path, "Doubtful", tmp_path / "home", report=report)
    assert [said for said in report.lines() if line in said and said.startswith("doubtful: ")]
    with pytest.raises(MapError, match="without --strict") as caught:
        import_map(path, "Strict", tmp_path / "home", strict=True)
    assert line in str(caught.value)
    assert not (tmp_path / "home" / "towns" / "Strict.npz").exists()


@pytest.mark.parametrize(
    "text",
    [
        ROAD.replace('<center><lane id="0" type="none"/></center>', ""),
        ROAD.replace(
            "<lanes>", '<elevationProfile><elevation s="9" a="0" b="0" c="0" d="0"/></elevationProfile><lanes>'
        ),
    ],
)
def test_maps_that_stop_carla_come_in(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plain.xodr"
    path.write_text(text, encoding="utf-8")
    report = ImportReport(str(path))
    assert bake(path, report=report).lane_count == 1
    assert not report.doubts


def test_maps_come_in_without_carla(tmp_path: Path) -> None:
    path = tmp_path / "road.xodr"
    path.write_text(ROAD, encoding="utf-8")
    program = (
        "import sys; sys.modules['carla'] = None; from ssad.cli import main; "
        f"sys.argv = ['ssad', 'import', 'map', {str(path)!r}]; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"SSAD_HOME": str(tmp_path / "home")},
    )
    assert done.returncode == 0, done.stderr
    assert "town road: 1 lane, " in done.stdout


def test_import_makes_a_town(tmp_path: Path, ssad_home: Path) -> None:
    path = tmp_path / "Some place.xodr"
    path.write_text(SMALL, encoding="utf-8")
    stored = import_map(path, "Elsewhere", ssad_home)
    assert stored == ssad_home / "towns" / "Elsewhere.npz"
    assert town_names()["Elsewhere"] == str(stored)
    graph = load_town("Elsewhere")
    assert graph.name == "Elsewhere"
    assert are_equal(graph, load_graph(stored))
    assert np.array_equal(graph.xy, load_town(str(path)).xy)
    assert sorted(p.name for p in stored.parent.iterdir()) == ["Elsewhere.npz", "Elsewhere.xodr"]
    for name in ("../x", "a/b", ".hidden"):
        with pytest.raises(MapError, match="cannot be the name"):
            import_map(path, name, ssad_home)

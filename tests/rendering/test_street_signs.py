"""Stop, yield and speed-limit signs of drives: where they stand, which way they look, what of them is labelled."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from ssad.core.geometry import in_polygon
from ssad.core.lane_graph import LaneGraph, SignKind
from ssad.core.rotations import upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F64, LaneType
from ssad.datasets.coco import coco_data
from ssad.recorders.target_images import CLASSES, is_facing, label_of
from ssad.recorders.target_recording import BEHIND
from ssad.rendering.bodies import make_body
from ssad.rendering.scene_objects import GroundOccupancy, SceneObjects, _add_signs
from ssad.rendering.street import cached_street
from ssad.rendering.street_signs import StreetSign, limit_signs_of_route, plate_and_post, street_signs
from ssad.world.roads import load_town


@functools.cache
def ground(town: str) -> tuple[LaneGraph, frozenset[tuple[int, int]]]:
    graph = load_town(town)
    return graph, frozenset(GroundOccupancy(cached_street(graph)).occupied_squares)


def clear_ground(town: str) -> GroundOccupancy:
    """What stands in a town's street, to be changed at will."""
    clear = GroundOccupancy.__new__(GroundOccupancy)
    clear.occupied_squares = set(ground(town)[1])
    return clear


def stand(town: str, *, many: bool, key: int = 0) -> list[StreetSign]:
    graph = ground(town)[0]
    way = graph.xy[graph.points(int(np.flatnonzero(graph.kind == LaneType.DRIVING)[0]))].astype(np.float64)
    return list(street_signs(graph, way, clear_ground(town), key=(key,), many=many, detail=0))


def nearest_lane(graph: LaneGraph, xy: F64) -> tuple[float, float]:
    """Distance to the nearest driving lane's middle less half its width, and that lane's heading."""
    lane = np.repeat(np.arange(graph.lane_count), np.diff(graph.offset))
    keep = (graph.kind[lane] == LaneType.DRIVING) & (graph.junction[lane] < 0)
    away = np.hypot(*(graph.xy[keep] - xy).T) - 0.5 * graph.width[keep]
    nearest = int(away.argmin())
    return float(away[nearest]), float(graph.yaw[keep][nearest])


@pytest.mark.parametrize("many", [False, True])
def test_signs_stand_beside_the_road_and_face_its_traffic(many: bool) -> None:
    graph = ground("Oldmarket")[0]
    found = stand("Oldmarket", many=many)
    assert len(found) > (40 if many else 3)
    for one in found:
        x, y, yaw, _ = one.pose
        away, heading = nearest_lane(graph, np.array([x, y]))
        assert 0.4 < away < 4.0
        assert np.cos(yaw - heading) < -0.9, "it looks at who comes"
    if many:
        kinds = [one.kind for one in found]
        assert 0.6 < kinds.count("stop_sign") / len(kinds) < 0.95


def test_signs_of_the_map_stand_where_it_says() -> None:
    graph = ground("Oldmarket")[0]
    found = stand("Oldmarket", many=False)
    for one in found:
        away = np.hypot(*(graph.sign_xy - one.pose[:2]).T)
        k = int(away.argmin())
        assert away[k] < 1.5
        assert one.style != "all_way", "at a T-junction the main road does not stop"
        assert one.kind == {SignKind.STOP: "stop_sign", SignKind.YIELD: "yield_sign"}[SignKind(int(graph.sign_kind[k]))]


def test_signs_keep_apart_and_depend_on_the_key_alone() -> None:
    one, again, other = (stand("Oldmarket", many=True, key=k) for k in (1, 1, 2))
    assert [(s.kind, s.style, s.size, s.pose) for s in one] == [(s.kind, s.style, s.size, s.pose) for s in again]
    assert [s.pose for s in one] != [s.pose for s in other]
    xy = np.array([s.pose[:2] for s in one])
    gap = np.hypot(*np.moveaxis(xy[:, None] - xy[None], -1, 0)) + 99.0 * np.eye(len(xy))
    assert gap.min() > 0.4


def test_where_something_stands_a_sign_moves_or_is_left_out() -> None:
    graph = ground("Oldmarket")[0]
    clear = clear_ground("Oldmarket")
    way = graph.sign_xy.astype(np.float64)
    free = list(street_signs(graph, way, clear_ground("Oldmarket"), key=(0,), many=False, detail=0))
    x, y, _, _ = free[0].pose
    clear.occupy(x, y, 0.0, 0.5, 0.5)
    x, y, _, _ = free[1].pose
    clear.occupy(x, y, 0.0, 8.0, 8.0)
    fewer = [one.pose[:2] for one in street_signs(graph, way, clear, key=(0,), many=False, detail=0)]
    assert len(fewer) == len(free) - 1
    assert free[0].pose[:2] not in fewer


def test_the_plate_is_labelled_and_the_post_is_not() -> None:
    graph = ground("Oldmarket")[0]
    cast = SceneObjects(0.1, ("signs",), detail=1)
    _add_signs(cast, graph, graph.sign_xy.astype(np.float64), clear_ground("Oldmarket"), many=False)
    plates, posts = cast.bodies[::2], cast.bodies[1::2]
    assert {body.kind for body in plates} == {"stop_sign", "yield_sign"}
    assert {body.kind for body in posts} == {""}
    for plate, post in zip(plates, posts, strict=True):
        low, high = cast.meshes[plate.meshes[0]].bounds()
        assert (high - low)[1:] == pytest.approx(plate.size[1], rel=0.15)
        assert low[2] > 1.8
        assert cast.meshes[post.meshes[0]].bounds()[0][2] == pytest.approx(0.0, abs=1e-6)
        assert np.array_equal(plate.track, post.track)
    kinds = {kind: label_of(kind) for kind in ("stop_sign", "yield_sign", "limit_sign", "", "car", "barrier")}
    assert kinds == {"stop_sign": 10, "yield_sign": None, "limit_sign": None, "": None, "car": 0, "barrier": 9}


def test_speed_limit_signs_show_the_limit_of_their_road_clear_of_roads_and_crossings() -> None:
    graph, limit_signs = ground("Oldmarket")[0], cached_street(load_town("Oldmarket")).limit_signs.astype(np.float64)
    assert len(limit_signs) > 20
    driving = graph.kind[np.repeat(np.arange(graph.lane_count), np.diff(graph.offset))] == LaneType.DRIVING
    limits = np.repeat(graph.speed_limit, np.diff(graph.offset))[driving]
    for x, y, yaw, _, limit in limit_signs:
        gaps = np.hypot(*(graph.xy[driving] - [x, y]).T) - 0.5 * graph.width[driving]
        assert gaps.min() > 0.6
        nearest = int(gaps.argmin())
        assert np.cos(graph.yaw[driving][nearest] - yaw) > 0.9
        assert limit == pytest.approx(3.6 * limits[nearest], abs=5.0)
        assert limit % 10 == 0
        for crossing in range(len(graph.crosswalk_offset) - 1):
            assert not in_polygon(np.array([[x, y]]), graph.crosswalk(crossing).astype(np.float64))[0]


def test_speed_limit_signs_change_no_other_sign() -> None:
    graph, rows = ground("Oldmarket")[0], cached_street(load_town("Oldmarket")).limit_signs
    way = graph.sign_xy.astype(np.float64)
    plain, limited = (
        list(street_signs(graph, way, clear_ground("Oldmarket"), key=(0,), many=True, detail=0, limit_signs=limits))
        for limits in (None, rows)
    )
    assert [(s.kind, s.style, s.pose) for s in limited[: len(plain)]] == [(s.kind, s.style, s.pose) for s in plain]
    limit_signs = limited[len(plain) :]
    assert limit_signs
    assert {(sign.kind, sign.style) for sign in limit_signs} == {("limit_sign", "30")}
    for sign in limit_signs:
        row = rows[np.hypot(*(rows[:, :2] - sign.pose[:2]).T).argmin()]
        assert np.cos(sign.pose[2] - row[2]) < -0.9, "it looks at who comes"


def test_speed_limit_signs_of_a_route_face_its_traffic_in_its_order() -> None:
    route = np.stack([np.arange(0.0, 100.0, 5.0), np.zeros(20)], 1)
    rows = np.array(
        [
            (70.0, -4.0, 0.0, 0.0, 50.0),
            (20.0, -4.0, 0.1, 0.0, 30.0),
            (40.0, 4.0, np.pi, 0.0, 80.0),
            (50, -30, 0, 0, 60),
        ],
        np.float32,
    )
    np.testing.assert_allclose(limit_signs_of_route(rows, route, within=12.0), [(20.0, 30.0), (70.0, 50.0)])
    assert limit_signs_of_route(rows[:0], route, within=12.0).shape == (0, 2)


def test_plate_and_post_make_up_the_body() -> None:
    whole = make_body("stop_sign", style="all_way", generator=generator("whole"))
    plate, post = plate_and_post(whole)
    assert len(plate.faces) + len(post.faces) == len(whole.faces)
    assert plate.panel_rectangle("face") == whole.panel_rectangle("face")
    plate.check()
    post.check()


def test_a_sign_is_read_from_the_front_alone() -> None:
    sign = upright_pose(4.0, -3.0, 2.0)

    def seen(degrees: float) -> bool:
        turn = 2.0 + np.radians(degrees)
        return is_facing(sign, np.array([4.0 + 9.0 * np.cos(turn), -3.0 + 9.0 * np.sin(turn), 1.6]))

    assert [seen(a) for a in (0, 60, -60, BEHIND - 1, 1 - BEHIND)] == [True] * 5
    assert [seen(a) for a in (BEHIND + 1, -BEHIND - 1, 120, 180)] == [False] * 4


def test_stop_sign_is_the_eleventh_category() -> None:
    data = coco_data(CLASSES, [], {})
    assert [c["id"] for c in data["categories"] if c["name"] == "stop_sign"] == [11]
    assert len(data["categories"]) == 11

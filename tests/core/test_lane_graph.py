"""The lane graph: its file, its look-ups by hand, and what contradicts itself is refused."""

from __future__ import annotations

import dataclasses
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import MapError
from ssad.core.lane_graph import LaneGraph, Marking, are_equal, load_graph, save_graph
from ssad.core.types import LaneType
from ssad.world.roads import load_town
from tests.world.worlds import straight_graph


def parts(graph: LaneGraph) -> dict[str, Any]:
    """What a graph is made from."""
    return {f.name: getattr(graph, f.name) for f in dataclasses.fields(graph) if f.init}


def test_a_place_on_a_lane_by_hand() -> None:
    """Eastwards along y = 0, westwards along y = 3.5; a point every 2 m."""
    graph = straight_graph(100.0)
    widths = graph.width.copy()
    widths[:3] = (3.0, 4.0, 6.0)
    graph = LaneGraph(**(parts(graph) | {"width": widths}))
    assert graph.lane_count == 3
    assert graph.length.tolist() == [100.0] * 3
    assert graph.at(0, 0.0) == (0.0, 0.0, 0.0, 3.0)
    assert graph.at(0, 0.5) == pytest.approx((0.5, 0.0, 0.0, 3.25))
    assert graph.at(0, 2.0) == pytest.approx((2.0, 0.0, 0.0, 4.0))
    assert graph.at(0, 3.5) == pytest.approx((3.5, 0.0, 0.0, 5.5))
    assert graph.at(0, 99.0) == pytest.approx((99.0, 0.0, 0.0, 3.5))
    assert graph.at(1, 30.0) == pytest.approx((70.0, 3.5, np.pi, 3.5))
    assert graph.at(1, -5.0) == pytest.approx((100.0, 3.5, np.pi, 3.5)), "held inside the lane"
    assert graph.at(0, 101.0) == pytest.approx((100.0, 0.0, 0.0, 3.5))
    assert graph.points(1) == slice(51, 102)


@pytest.mark.parametrize("name", ["Ringmere", "Twinford"])
def test_many_places_are_those_of_one_by_one_to_the_bit(name: str) -> None:
    graph, draws = load_town(name), np.random.default_rng(0)
    for lane in range(0, graph.lane_count, 3):
        points = graph.s[graph.points(lane)].astype(np.float64)
        s = np.concatenate([draws.uniform(-1.0, float(graph.length[lane]) + 1.0, 20), points])
        found = graph.along(lane, s)
        assert found.shape == (len(s), 4)
        assert [tuple(row) for row in found.tolist()] == [graph.at(lane, place) for place in s.tolist()], lane


def test_headings_turn_the_short_way() -> None:
    yaw = straight_graph().yaw.copy()
    yaw[:3] = (3.0, -3.0, 3.0)  # 0.28 rad to the left over pi, and back
    graph = LaneGraph(**(parts(straight_graph()) | {"yaw": yaw}))
    turn = 2 * np.pi - 6.0
    assert graph.at(0, 0.5)[2] == pytest.approx(3.0 + 0.25 * turn)
    assert graph.at(0, 2.5)[2] == pytest.approx(-3.0 - 0.25 * turn)


def test_lanes_of_one_road_and_one_sign_run_the_same_way() -> None:
    graph = LaneGraph(**(parts(straight_graph()) | {"lane_id": [-1, 1, -2]}))
    assert graph.is_same_direction(0, 2)
    assert not graph.is_same_direction(0, 1)
    assert not graph.is_same_direction(1, 2)
    apart = LaneGraph(**(parts(graph) | {"road": [0, 0, 5]}))
    assert not apart.is_same_direction(0, 2)
    middle = LaneGraph(**(parts(graph) | {"lane_id": [0, 0, -2]}))
    assert not middle.is_same_direction(0, 1), "the centre lane has no direction"


def test_links_are_known_from_both_ends() -> None:
    linked = {"succ_offset": [0, 2, 2, 3], "succ": [1, 2, 1]}
    graph = LaneGraph(**(parts(straight_graph()) | linked))
    assert [graph.successors(k).tolist() for k in range(3)] == [[1, 2], [], [1]]
    assert [graph.predecessors(k).tolist() for k in range(3)] == [[], [0, 2], [0]]


def test_crosswalks_by_number() -> None:
    corners = np.arange(14.0).reshape(7, 2)
    graph = LaneGraph(**(parts(straight_graph()) | {"crosswalk_offset": [0, 4, 7], "crosswalk_xy": corners}))
    assert graph.crosswalk(0).tolist() == corners[:4].tolist()
    assert graph.crosswalk(1).tolist() == corners[4:].tolist()


def test_markings_keep_their_numbers() -> None:
    """Towns on disk hold them."""
    assert [m.name for m in sorted(Marking)] == ["NONE", "BROKEN", "SOLID", "DOUBLE", "CURB", "OTHER"]
    assert [int(m) for m in Marking] == [0, 1, 2, 3, 4, 5]


def test_a_graph_keeps_its_own_copy_of_what_it_is_made_from() -> None:
    given = straight_graph().xy.copy()
    graph = LaneGraph(**(parts(straight_graph()) | {"xy": given}))
    given[0] = 77.0
    assert given.flags.writeable
    assert graph.xy[0].tolist() == [0.0, 0.0]
    assert graph.xy.dtype == np.float32
    again = LaneGraph(**parts(graph))
    assert again.xy is graph.xy, "what cannot change is not copied"


def test_file_round_trip_is_exact_and_deterministic(tmp_path: Path) -> None:
    graph = load_town("Twinford")
    save_graph(graph, tmp_path / "a.npz")
    again = load_graph(tmp_path / "a.npz")
    save_graph(again, tmp_path / "b.npz")
    assert are_equal(graph, again)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]


def test_rule_of_the_road_and_origin_are_stored_where_they_are_not_the_usual(tmp_path: Path) -> None:
    graph = load_town("Twinford")
    assert (graph.forward == (graph.lane_id < 0)).all()
    assert (graph.left_hand.tolist(), graph.turn_on_red.tolist(), graph.origin.tolist()) == (
        [False],
        [True],
        [0.0, 0.0],
    )
    changed = {"forward": graph.lane_id > 0, "left_hand": [True], "turn_on_red": [False], "origin": [5e5 + 0.25, 5e6]}
    save_graph(LaneGraph(**(parts(graph) | changed)), tmp_path / "left.npz")
    again = load_graph(tmp_path / "left.npz")
    for name, value in changed.items():
        assert np.array_equal(getattr(again, name), value), name
    save_graph(graph, tmp_path / "right.npz")
    with np.load(tmp_path / "right.npz") as data:
        assert not set(changed) & set(data.files)
    with pytest.raises(MapError, match="origin does not have 2 rows"):
        LaneGraph(**(parts(graph) | {"origin": [1.0]}))


def test_a_file_from_before_there_were_signs_has_none(tmp_path: Path) -> None:
    graph = load_town("Twinford")
    assert len(graph.sign_kind) > 0
    save_graph(graph, tmp_path / "new.npz")
    with np.load(tmp_path / "new.npz") as data:
        old = {name: data[name] for name in data.files if not name.startswith(("sign_", "rule_"))}
    np.savez(tmp_path / "old.npz", **old)
    again = load_graph(tmp_path / "old.npz")
    assert (len(again.sign_kind), again.sign_xy.shape, len(again.rule_lane)) == (0, (0, 2), 0)
    assert np.array_equal(again.xy, graph.xy)
    del old["stop_s"]
    np.savez(tmp_path / "torn.npz", **old)
    with pytest.raises(MapError, match="missing or unknown arrays: stop_s"):
        load_graph(tmp_path / "torn.npz")


def test_arrays_are_read_only() -> None:
    graph = load_town("Twinford")
    for part in dataclasses.fields(graph):
        value = getattr(graph, part.name)
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value.reshape(-1)[:1] = 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"xy": np.zeros((603, 3))}, "xy is not [n, 2]"),
        ({"signal_xy": np.zeros(2)}, "signal_xy is not [n, 2]"),
        ({"z": np.zeros(602)}, "z does not have 603 rows"),
        ({"road": [0, 0]}, "road does not have 3 rows"),
        ({"signal_phase": [1]}, "signal_phase does not have 0 rows"),
        ({"stop_s": [1.0]}, "stop_s does not have 0 rows"),
        ({"succ_offset": [0, 0, 0]}, "succ_offset does not partition"),
        ({"succ_offset": [0, 0, 0, 1]}, "succ_offset does not partition"),
        ({"offset": [1, 201, 402, 603]}, "offset does not partition"),
        ({"offset": [0, 402, 201, 603]}, "offset does not partition"),
        ({"crosswalk_offset": []}, "crosswalk_offset does not partition"),
        ({"offset": [0, 1, 402, 603]}, "a lane has fewer than two points"),
        ({"right": [3, -1, -1]}, "right points outside"),
        ({"stop_signal": [0], "stop_lane": [0], "stop_s": [1.0]}, "stop_signal points outside"),
        ({"kind": [7, 1, 1]}, "kind points outside"),
        ({"sign_xy": np.zeros(2)}, "sign_xy is not [n, 2]"),
        ({"sign_kind": [0]}, "sign_kind does not have 0 rows"),
        ({"sign_xy": [[0, 0]], "sign_yaw": [0], "sign_kind": [2]}, "sign_kind points outside"),
        ({"rule_sign": [0], "rule_lane": [0], "rule_s": [1.0]}, "rule_sign points outside"),
        ({"kind": [2, 3, 6]}, "it has no drivable lane"),
    ],
)
def test_what_contradicts_itself_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(MapError) as caught:
        LaneGraph(**(parts(straight_graph()) | changes))
    assert f"town 'Straight': {message}" in str(caught.value)
    assert "bake the map again" in str(caught.value)


def test_a_graph_without_lanes_is_refused() -> None:
    empty = {k: v[:0] for k, v in parts(straight_graph()).items() if isinstance(v, np.ndarray)}
    empty |= {k: np.zeros(1) for k in ("offset", "succ_offset", "crosswalk_offset")}
    with pytest.raises(MapError, match="it has no lane"):
        LaneGraph(name="Void", **empty)


def test_a_lane_may_begin_at_any_arc_length_of_the_one_before() -> None:
    """Arc length grows along each lane, not over them; two points are enough for a lane."""
    s = straight_graph().s.copy()
    s[201:402] += 1000.0
    LaneGraph(**(parts(straight_graph()) | {"s": s}))
    s[100] = s[99]
    with pytest.raises(MapError, match="s does not grow"):
        LaneGraph(**(parts(straight_graph()) | {"s": s}))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("succ", 10**6, "succ points outside"),
        ("left", -2, "left points outside"),
        ("xy", np.nan, "xy holds a number"),
        ("s", 0.0, "s does not grow"),
        ("offset", 3, "offset does not partition"),
        ("kind", 77, "kind points outside"),
        ("kind", LaneType.SIDEWALK, "no drivable lane"),
    ],
)
def test_contradictory_arrays_are_refused(field: str, value: float, message: str) -> None:
    graph = load_town("Twinford")
    wrong = np.full_like(getattr(graph, field), value)
    with pytest.raises(MapError, match=message):
        LaneGraph(**(parts(graph) | {field: wrong}))


def test_broken_files_are_refused_in_one_line(tmp_path: Path) -> None:
    good = tmp_path / "good.npz"
    save_graph(load_town("Twinford"), good)
    (tmp_path / "cut.npz").write_bytes(good.read_bytes()[:9000])
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "text.npz").write_text("not a town")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.savez(tmp_path / "pickle.npz", a=np.array([{}], dtype=object))
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xy.npy", bytes(80 * 2**20))
    for name in ("cut", "empty", "text", "other", "pickle", "bomb", "missing"):
        with pytest.raises(MapError) as caught:
            load_graph(tmp_path / f"{name}.npz")
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"header": None}, "not a baked town of format 1"),
        ({"header": np.array(["ssad-lane-graph 2", "Straight"])}, "not a baked town of format 1"),
        ({"header": np.array(["ssad-lane-graph 1"])}, "not a baked town of format 1"),
        ({"xy": None}, "missing or unknown arrays: xy"),
        ({"extra": np.zeros(1)}, "missing or unknown arrays: extra"),
        ({"kind": np.ones(3, np.int64)}, "array kind is int64"),
        ({"xy": np.zeros((603, 2))}, "array xy is float64"),
    ],
)
def test_other_files_are_refused_by_what_is_wrong(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    save_graph(straight_graph(), tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as stored:
        arrays = {k: v for k, v in (dict(stored) | changes).items() if v is not None}
    np.savez(tmp_path / "wrong.npz", **arrays)
    with pytest.raises(MapError) as caught:
        load_graph(tmp_path / "wrong.npz")
    assert f"wrong.npz: {message}; bake the map again" in str(caught.value)


def test_a_graph_equals_only_one_of_the_same_name_and_numbers() -> None:
    graph = straight_graph()
    assert are_equal(graph, straight_graph())
    assert not are_equal(graph, LaneGraph(**(parts(graph) | {"name": "Other"})))
    assert not are_equal(graph, LaneGraph(**(parts(graph) | {"speed_limit": [30.0, 30.0, 29.0]})))

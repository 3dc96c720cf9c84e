"""Nearest-lane queries against brute force and closed forms, and the lane graph's file."""

from __future__ import annotations

import dataclasses
import zipfile
from pathlib import Path

import numpy as np
import pytest
from roads.towns import BUILT_IN, IMPORTED, built_in, imported

from ssad.core.errors import MapError
from ssad.core.lane_graph import equal
from ssad.core.types import LaneType
from ssad.roads import LaneGraph, LaneQuery, load_graph, save_graph
from ssad.roads.query import DRIVABLE, MARGIN, segments


def brute(graph: LaneGraph, points: np.ndarray, types: tuple[LaneType, ...]) -> tuple[np.ndarray, ...]:
    """Least distance outside any strip, and for each point the lanes within 1e-3 m of it."""
    seg, half, lane, s = segments(graph, types)
    gaps, sets, along, side = [], [], [], []
    for p in points:
        a, d = seg[:, :2].astype(float), (seg[:, 2:] - seg[:, :2]).astype(float)
        t = np.clip(((p - a) * d).sum(1) / (d * d).sum(1), 0, 1)
        rest = p - a - t[:, None] * d
        gap = np.hypot(*rest.T) - (half[:, 0] * (1 - t) + half[:, 1] * t)
        best = gap <= gap.min() + 1e-3
        gaps.append(gap.min())
        sets.append(set(lane[best].tolist()))
        along.append(float((s + t * np.hypot(*d.T))[gap.argmin()]))
        side.append(float(np.hypot(*rest[gap.argmin()])))
    return np.array(gaps), sets, along, side


def check_against_brute(graph: LaneGraph, types: tuple[LaneType, ...], seed: int) -> None:
    rng = np.random.default_rng(seed)
    low, high = graph.xy.min(0) - 8, graph.xy.max(0) + 8
    anywhere = rng.uniform(low, high, (150, 2))
    near = graph.xy[rng.integers(len(graph.xy), size=250)] + rng.normal(0, 2.5, (250, 2))
    points = np.concatenate([anywhere, near]).astype(np.float32)
    lane, s, lateral, inside = LaneQuery(graph).nearest(points, types)
    gap, sets, along, side = brute(graph, points.astype(float), types)
    for i in range(len(points)):
        if gap[i] > MARGIN + 1e-3:
            assert lane[i] == -1
            assert not inside[i]
        elif gap[i] < MARGIN - 1e-3:
            assert lane[i] in sets[i]
            if len(sets[i]) == 1:
                # where two segments are as near to within 1e-3 m, they may differ by 0.1 m along the lane
                assert s[i] == pytest.approx(along[i], abs=0.1)
                assert abs(lateral[i]) == pytest.approx(side[i], abs=2e-3)
            if abs(gap[i]) > 1e-3:
                assert inside[i] == (gap[i] < 0)


@pytest.mark.parametrize("name", BUILT_IN)
@pytest.mark.parametrize("types", [DRIVABLE, (LaneType.SIDEWALK, LaneType.SHOULDER)])
def test_nearest_is_brute_force(name: str, types: tuple[LaneType, ...]) -> None:
    check_against_brute(built_in(name), types, seed=len(name))


@pytest.mark.data
@pytest.mark.parametrize("name", IMPORTED)
def test_nearest_is_brute_force_on_carla_towns(data_dir: Path, name: str) -> None:
    check_against_brute(imported(data_dir, name), DRIVABLE, seed=len(name))


@pytest.mark.parametrize("name", BUILT_IN)
def test_lane_points_are_inside_their_lane(name: str) -> None:
    graph = built_in(name)
    query = LaneQuery(graph)
    owner = np.repeat(np.arange(graph.lanes), np.diff(graph.offset))
    mine = (graph.kind[owner] == LaneType.DRIVING) & (graph.junction[owner] < 0)
    lane, s, lateral, inside = query.nearest(graph.xy[mine])
    assert inside.all()
    assert np.abs(lateral).max() < 1e-3
    # at a lane's ends the neighbour in the chain is as near
    away = (graph.s[mine] > 0.5) & (graph.s[mine] < graph.length[owner[mine]] - 0.5)
    assert (lane[away] == owner[mine][away]).all()
    assert np.abs(s - graph.s[mine])[away].max() < 1e-3
    assert not query.off_road(graph.xy[mine]).any()


def test_lateral_is_positive_to_the_left() -> None:
    graph = built_in("Twinford")
    lane = int(np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0))[0])
    x, y, yaw, width = graph.at(lane, 5.0)
    left = np.array([x - np.sin(yaw), y + np.cos(yaw)])
    found, s, lateral, inside = LaneQuery(graph).nearest(left)
    assert (found[0], inside[0]) == (lane, True)
    assert (s[0], lateral[0]) == pytest.approx((5.0, 1.0), abs=2e-3)
    assert width == pytest.approx(3.75)


def test_off_road_on_the_sidewalk_and_far_away() -> None:
    graph = built_in("Crossgate")
    walk = int(np.flatnonzero((graph.kind == LaneType.SIDEWALK) & (graph.junction < 0))[0])
    x, y, _, _ = graph.at(walk, 20.0)
    assert LaneQuery(graph).off_road([[x, y], [1e4, 1e4], [np.nan, 0.0]]).tolist() == [True, True, True]


def test_answers_do_not_depend_on_the_batch() -> None:
    graph = built_in("ProvingGround")
    query = LaneQuery(graph)
    points = np.random.default_rng(3).uniform(-20, 620, (20000, 2)).astype(np.float32)
    whole = query.nearest(points)
    for part in (slice(0, 1), slice(77, 300)):
        some = query.nearest(points[part])
        for a, b in zip(whole, some, strict=True):
            assert np.array_equal(a[part], b)


def test_file_round_trip_is_exact_and_deterministic(tmp_path: Path) -> None:
    graph = built_in("Twinford")
    save_graph(graph, tmp_path / "a.npz")
    again = load_graph(tmp_path / "a.npz")
    save_graph(again, tmp_path / "b.npz")
    assert equal(graph, again)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "b.npz"]


def test_arrays_are_read_only() -> None:
    graph = built_in("Twinford")
    for part in dataclasses.fields(graph):
        value = getattr(graph, part.name)
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value.reshape(-1)[:1] = 0


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
    graph = built_in("Twinford")
    wrong = np.full_like(getattr(graph, field), value)
    arrays = {f.name: getattr(graph, f.name) for f in dataclasses.fields(graph) if f.init}
    with pytest.raises(MapError, match=message):
        LaneGraph(**(arrays | {field: wrong}))


def test_broken_files_are_refused_in_one_line(tmp_path: Path) -> None:
    good = tmp_path / "good.npz"
    save_graph(built_in("Twinford"), good)
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

"""Nearest-lane queries against brute force and closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.quick import others_slow

from ssad.core.types import LaneType
from ssad.world.roads import LaneGraph, LaneQuery
from ssad.world.roads.query import DRIVABLE, MARGIN, segments
from tests.world.roads.towns import BUILT_IN, IMPORTED, built_in, imported


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


@pytest.mark.parametrize("name", others_slow(BUILT_IN, ["Twinford", "Ringmere"]))
@pytest.mark.parametrize("types", [DRIVABLE, (LaneType.SIDEWALK, LaneType.SHOULDER)])
def test_nearest_is_brute_force(name: str, types: tuple[LaneType, ...]) -> None:
    check_against_brute(built_in(name), types, seed=len(name))


@pytest.mark.data
@pytest.mark.parametrize("name", IMPORTED)
def test_nearest_is_brute_force_on_carla_towns(carla_home: Path, name: str) -> None:
    check_against_brute(imported(carla_home, name), DRIVABLE, seed=len(name))


@pytest.mark.parametrize("name", BUILT_IN)
def test_lane_points_are_inside_their_lane(name: str) -> None:
    graph = built_in(name)
    query = LaneQuery(graph)
    owner = np.repeat(np.arange(graph.lane_count), np.diff(graph.offset))
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

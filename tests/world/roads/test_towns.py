"""The towns that ship: what they promise."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from helpers.quick import others_slow

from ssad.core.errors import MapError, UnknownNameError
from ssad.core.lane_graph import SignKind
from ssad.core.rotations import wrap_angle
from ssad.core.types import LaneType
from ssad.world.roads import LaneGraph, bake, load_town, town_names
from ssad.world.roads.designs import DESIGNS as TOWNS
from ssad.world.roads.designs import generate_town
from ssad.world.roads.router import _level_position
from tests.world.roads.towns import BUILT_IN, TRACKS, built_in, check_is_same_town

INTERCHANGES = {2000, 12000}  # of Longreach


def driving(graph: LaneGraph) -> list[int]:
    return [int(i) for i in np.flatnonzero(graph.kind == LaneType.DRIVING)]


def reach(graph: LaneGraph, start: int, step: Callable[[int], list[int]]) -> set[int]:
    seen, queue = {start}, [start]
    while queue:
        for other in step(queue.pop()):
            if other not in seen and graph.kind[other] == LaneType.DRIVING:
                seen.add(other)
                queue.append(other)
    return seen


def beside(graph: LaneGraph, lane: int) -> list[int]:
    if graph.junction[lane] >= 0:
        return []
    return [n for n in (int(graph.left[lane]), int(graph.right[lane])) if n >= 0 and graph.is_same_direction(lane, n)]


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_lane_reaches_every_other(name: str) -> None:
    graph = built_in(name)
    lanes = driving(graph)
    ahead = reach(graph, lanes[0], lambda i: graph.successors(i).tolist() + beside(graph, i))
    back = reach(graph, lanes[0], lambda i: graph.predecessors(i).tolist() + beside(graph, i))
    assert ahead == back == set(lanes)
    assert all(len(graph.successors(i)) and len(graph.predecessors(i)) for i in lanes)


@pytest.mark.parametrize("name", [*BUILT_IN, *TRACKS])
def test_lanes_join_without_gap_or_kink(name: str) -> None:
    graph = built_in(name)
    links = 0
    for i in driving(graph):
        for j in graph.successors(i).tolist():
            a, b = graph.points(i).stop - 1, graph.points(j).start
            assert np.hypot(*(graph.xy[a] - graph.xy[b])) < 0.05
            assert abs(wrap_angle(graph.yaw[a] - graph.yaw[b])) < np.radians(1.0)
            assert abs(graph.width[a] - graph.width[b]) < 0.01
            links += 1
    assert links > (10 if name in TRACKS else 70)


@pytest.mark.parametrize("name", [*BUILT_IN, *TRACKS])
def test_turns_can_be_driven(name: str) -> None:
    graph = built_in(name)
    for i in driving(graph):
        part = graph.points(i)
        bend = np.abs(wrap_angle(np.diff(graph.yaw[part])))
        run = np.diff(graph.s[part])
        assert (run / np.maximum(bend, 1e-9)).min() > 5.5  # m, radius
        assert run.max() <= 2.001
        assert (run * bend / 8.0).max() < 0.02  # m, between chord and arc


@pytest.mark.parametrize("name", [*BUILT_IN, *TRACKS])
def test_neighbours_agree(name: str) -> None:
    graph = built_in(name)
    for i in range(graph.lane_count):
        left, right = int(graph.left[i]), int(graph.right[i])
        for other, side in ((left, 1.0), (right, -1.0)):
            if other < 0:
                continue
            same = graph.is_same_direction(i, other)
            back = graph.right[other] if (side > 0) == same else graph.left[other]
            assert back == i
            middle = float(graph.length[i]) / 2
            x, y, yaw, width = graph.at(i, middle)
            u, v, _, wide = graph.at(other, _level_position(graph, i, middle, other))
            lateral = -(u - x) * np.sin(yaw) + (v - y) * np.cos(yaw)
            assert lateral == pytest.approx(side * (width + wide) / 2, abs=0.05)


@pytest.mark.parametrize("name", BUILT_IN)
def test_signals_stop_every_approach(name: str) -> None:
    graph = built_in(name)
    stopped = dict(zip(graph.stop_lane.tolist(), graph.stop_s.tolist(), strict=True))
    for i in driving(graph):
        ahead = {int(graph.junction[j]) for j in graph.successors(i)}
        # at a motorway's interchange no ways meet, so that there is nothing to stop for
        if graph.junction[i] < 0 and ahead & set(graph.signal_junction.tolist()):
            assert graph.length[i] - 6.0 < stopped[i] <= graph.length[i]
    assert {int(j) for j in np.unique(graph.junction) if j >= 0} - set(graph.signal_junction.tolist()) <= (
        INTERCHANGES if name == "Longreach" else set()
    )
    real = np.flatnonzero(~graph.signal_virtual)
    assert len(real) >= 8
    for junction in np.unique(graph.signal_junction[real]):
        mine = graph.signal_junction == junction
        assert not graph.signal_virtual[mine].any()
        assert set(graph.signal_phase[mine].tolist()) == {0, 1}
        for phase in (0, 1):
            yaw = graph.signal_yaw[mine & (graph.signal_phase == phase)]
            assert np.abs(np.sin(yaw - yaw[0])).max() < 1e-3  # only arms that face each other are green together


@pytest.mark.parametrize("name", BUILT_IN)
def test_signs_stand_where_no_lights_are(name: str) -> None:
    """Beside the stop line on the right of the approach, at every junction of three arms or more without lights."""
    graph = built_in(name)
    assert len(graph.sign_kind) >= 4
    assert (graph.sign_kind == SignKind.STOP).any()
    signal_of = dict(zip(graph.stop_lane.tolist(), graph.stop_signal.tolist(), strict=True))
    signed = set()
    for sign, lane, s in zip(graph.rule_sign.tolist(), graph.rule_lane.tolist(), graph.rule_s.tolist(), strict=True):
        signal = signal_of[lane]
        assert graph.signal_virtual[signal]
        signed.add(int(graph.signal_junction[signal]))
        x, y, yaw, width = graph.at(lane, s)
        aside = graph.sign_xy[sign] - [x, y]
        assert abs(aside @ [np.cos(yaw), np.sin(yaw)]) < 1.0
        assert 0.5 * width < -aside @ [-np.sin(yaw), np.cos(yaw)] < 2.0 * width + 1.5
        assert np.cos(graph.sign_yaw[sign] - yaw) > 0.99
    assert set(graph.rule_sign.tolist()) == set(range(len(graph.sign_kind)))
    assert signed == set(graph.signal_junction[graph.signal_virtual].tolist())


@pytest.mark.parametrize("name", BUILT_IN)
def test_crosswalks_lie_beyond_the_stop_lines(name: str) -> None:
    graph = built_in(name)
    assert len(graph.crosswalk_offset) - 1 >= 20
    for k in range(len(graph.crosswalk_offset) - 1):
        area = graph.crosswalk(k)
        assert len(area) == 4
        sides = np.hypot(*(area - np.roll(area, 1, axis=0)).T)
        assert sorted(sides.tolist())[:2] == pytest.approx([3.0, 3.0], abs=0.01)


def test_proving_ground_has_room_for_every_scenario() -> None:
    graph = built_in("ProvingGround")
    street = (graph.kind == LaneType.DRIVING) & (graph.junction < 0)
    inner = street & (np.abs(graph.lane_id) == 1)
    opposite = graph.lane_id[graph.left[inner]] * graph.lane_id[inner]
    assert (graph.kind[graph.left[inner]] == LaneType.DRIVING).all()
    assert (opposite < 0).all()  # no median anywhere
    assert (graph.length[street] >= 150.0).all()
    two_lane = inner & (graph.kind[np.maximum(graph.right, 0)] == LaneType.SHOULDER)
    assert two_lane.sum() == 2
    for i in np.flatnonzero(two_lane):
        part = graph.points(int(i))
        straight = np.abs(wrap_angle(graph.yaw[part] - graph.yaw[part.start])) < 1e-3
        assert graph.s[part][straight].max() >= 180.0


@pytest.mark.parametrize("name", others_slow(BUILT_IN, ["Twinford", "Ringmere"]))
def test_the_shipped_town_is_what_the_code_writes(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"{name}.xodr"
    path.write_text(generate_town(name), encoding="utf-8")
    assert path.stat().st_size < 300_000
    check_is_same_town(bake(path, name), load_town(name))


def test_towns_by_name(ssad_home: Path) -> None:
    assert set(town_names()) == {*BUILT_IN, *TRACKS} == set(TOWNS)
    assert generate_town("Twinford") == generate_town("Twinford")
    for name in BUILT_IN:
        assert (files("ssad.world.roads.towns") / f"{name}.npz").read_bytes().__len__() < 300_000
    with pytest.raises(UnknownNameError, match="closest: Twinford"):
        load_town("Twinfrod")
    with pytest.raises(UnknownNameError):
        generate_town("Atlantis")
    for name in ("nowhere.npz", "nowhere/at/all", "nowhere.xodr"):
        with pytest.raises(MapError, match="no such file"):
            load_town(name)

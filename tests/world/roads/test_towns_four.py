"""The four towns for training and testing: the two newer ones keep all promises, the older ones have not changed."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from helpers.quick import others_slow

from benchmarks.make_scenario_sets import natural
from ssad.core.lane_graph import load_graph, save_graph
from ssad.core.rotations import wrap_angle
from ssad.core.safeio import npz_bytes
from ssad.core.seeding import generator
from ssad.core.types import ENDS, Controller, LaneType
from ssad.scenarios.dynamic import build_episode
from ssad.world.roads import LaneGraph, bake, random_route
from ssad.world.roads.designs import DESIGNS as TOWNS
from ssad.world.roads.designs import generate_town
from ssad.world.roads.library import BUILT_IN
from ssad.world.world import World
from tests.world.roads.towns import check_is_same_town

NEW = ("Oldmarket", "Larkhill")
FOUR = ("Twinford", "Crossgate", *NEW)
KEPT = {  # recorded results depend on them
    "Twinford": "533044dd4e79c8cdbabbd4c97c12ef3ddda1d451b5952ec4e1e83bd0057354fa",
    "Crossgate": "8c2d8f35e9db2e3c04ee2ace6021090489c55213e710f722441c7108ae43c05b",
    "ProvingGround": "46bcf023a518d2298b94e6cc8fb5399a61b17ab7685cca7280acdeac45f6eed9",
}


def baked(name: str) -> bytes:
    return (files("ssad.world.roads.towns") / f"{name}.npz").read_bytes()


@cache
def town(name: str) -> LaneGraph:
    return load_graph(str(files("ssad.world.roads.towns") / f"{name}.npz"))


def driving(graph: LaneGraph) -> list[int]:
    return np.flatnonzero(graph.kind == LaneType.DRIVING).tolist()


def reach(start: int, step: Callable[[int], list[int]], allowed: set[int]) -> set[int]:
    seen, queue = {start}, [start]
    while queue:
        for other in step(queue.pop()):
            if other in allowed and other not in seen:
                seen.add(other)
                queue.append(other)
    return seen


@pytest.mark.parametrize("name", KEPT)
def test_existing_towns_have_not_changed(name: str) -> None:
    """But for their signs, which are only seen."""
    with np.load(io.BytesIO(baked(name))) as data:
        arrays = {part: data[part] for part in data.files if not part.startswith(("sign_", "rule_"))}
    assert hashlib.sha256(npz_bytes(arrays)).hexdigest() == KEPT[name]


@pytest.mark.parametrize("name", others_slow(NEW, ["Oldmarket"]))
def test_the_shipped_file_is_small_and_what_the_code_writes(name: str, tmp_path: Path) -> None:
    assert len(baked(name)) < 200_000
    text = generate_town(name)
    assert text == generate_town(name)
    assert len(text) < 300_000
    path = tmp_path / f"{name}.xodr"
    path.write_text(text, encoding="utf-8")
    old = town(name)
    check_is_same_town(bake(path, name), old)
    save_graph(old, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == baked(name)


def test_towns_that_load_by_name_can_be_generated() -> None:
    assert tuple(TOWNS) == BUILT_IN


@pytest.mark.parametrize("name", NEW)
def test_every_lane_reaches_every_other(name: str) -> None:
    """By driving on alone, without a change of lanes: all streets have one lane a side."""
    graph = town(name)
    lanes = set(driving(graph))
    first = min(lanes)
    assert reach(first, lambda i: graph.successors(i).tolist(), lanes) == lanes
    assert reach(first, lambda i: graph.predecessors(i).tolist(), lanes) == lanes


@pytest.mark.parametrize("name", NEW)
def test_lanes_are_smooth(name: str) -> None:
    graph = town(name)
    for i in driving(graph):
        part = graph.points(i)
        bend, run = np.abs(wrap_angle(np.diff(graph.yaw[part]))), np.diff(graph.s[part])
        assert run.max() <= 2.001
        assert (run / np.maximum(bend, 1e-9)).min() > 5.5  # m, radius
        for j in graph.successors(i).tolist():
            a, b = part.stop - 1, graph.points(j).start
            assert np.hypot(*(graph.xy[a] - graph.xy[b])) < 0.05
            assert abs(wrap_angle(graph.yaw[a] - graph.yaw[b])) < np.radians(1.0)


@pytest.mark.parametrize("name", others_slow(NEW, ["Oldmarket"]))
def test_streets_do_not_overlap(name: str) -> None:
    """Lanes of different streets keep apart outside junctions."""
    graph = town(name)
    lane = np.repeat(np.arange(graph.lane_count), np.diff(graph.offset))
    street = (graph.junction[lane] < 0) & (graph.kind[lane] != LaneType.NONE)
    xy, road, half = graph.xy[street].astype(float), graph.road[lane[street]], 0.5 * graph.width[street]
    for k in range(0, len(xy), 500):
        part = slice(k, k + 500)
        gap = np.hypot(*np.moveaxis(xy[part, None] - xy[None], -1, 0)) - half[part, None] - half[None]
        assert gap[road[part, None] != road[None]].min() > 1.0


@pytest.mark.parametrize("name", NEW)
def test_signals_crosswalks_and_routes(name: str) -> None:
    graph = town(name)
    real = ~graph.signal_virtual
    assert real.sum() >= 8
    for junction in np.unique(graph.signal_junction[real]):
        assert set(graph.signal_phase[graph.signal_junction == junction].tolist()) == {0, 1}
    assert len(graph.crosswalk_offset) - 1 >= 20
    for k, lane in enumerate(driving(graph)):
        assert random_route(graph, lane, 1.0, 200.0, generator("four", name, k)).length > 198.0


def test_the_four_differ() -> None:
    """Shares of curved street, block lengths, crossroads and size set the towns apart."""
    curved, junctions, length = {}, {}, {}
    for name in FOUR:
        graph = town(name)
        lanes = [i for i in driving(graph) if graph.junction[i] < 0]
        turn = [np.abs(wrap_angle(np.diff(graph.yaw[graph.points(i)]))) > 1e-3 for i in lanes]
        curved[name] = float(np.concatenate(turn).mean())
        junctions[name] = len(np.unique(graph.junction)) - 1
        length[name] = float(np.median(graph.length[lanes]))
    assert curved["Crossgate"] < 0.5 * curved["Larkhill"]
    assert length["Oldmarket"] < 0.8 * length["Crossgate"]
    assert min(curved["Oldmarket"], curved["Larkhill"]) > curved["Twinford"]
    assert len(set(junctions.values())) >= 3


@pytest.mark.parametrize("name", others_slow(NEW, ["Oldmarket"]))
def test_natural_traffic_gets_through(name: str) -> None:
    graph = town(name)
    scenarios = [replace(s, traffic=None) for draw in range(0, 10, 4) for s in natural(graph, 8, draw)]
    world = World([build_episode(s, graph, seed=0) for s in scenarios], {name: graph}, ego=Controller.AUTOPILOT)
    touched = np.zeros(world.batch, bool)
    for _ in range(300):
        world.step()
        touched |= (world.array("touch") != 0).any(axis=1)
    assert not touched.any()
    assert (world.ended() != ENDS.index("collision")).all()
    assert world.array("ego.complete").mean() >= 95.0

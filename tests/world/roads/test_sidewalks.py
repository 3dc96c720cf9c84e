"""Sidewalks and crossings of towns: connected, on the sidewalks, and what walks over them do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.errors import RouteError
from ssad.core.geometry import in_polygon
from ssad.core.seeding import generator
from ssad.core.types import LaneType
from ssad.world.roads import LaneGraph, LaneQuery, load_town
from ssad.world.roads.sidewalks import GAP, SETBACK, SidewalkNetwork, sidewalk_network


def without_crosswalks(graph: LaneGraph) -> LaneGraph:
    return replace(graph, crosswalk_offset=np.zeros(1, np.int32), crosswalk_xy=np.zeros((0, 2), np.float32))


def check_ends(graph: LaneGraph, network: SidewalkNetwork) -> None:
    """Every edge begins and ends at its nodes, and crossings at sidewalks."""
    sidewalk_nodes = {node for edge in network.edges if edge.lane >= 0 for node in edge.nodes}
    for edge in network.edges:
        assert np.hypot(*(network.node_xy[list(edge.nodes)] - edge.xy[[0, -1]]).T).max() <= 1.0
        if edge.crossing >= 0:
            assert set(edge.nodes) <= sidewalk_nodes
            assert all(graph.kind[lane] == LaneType.DRIVING for lane in network.crossings[edge.crossing].lanes)


@pytest.mark.parametrize(("town", "lanes"), [("Twinford", 2), ("Crossgate", 4), ("Ringmere", 2)])
def test_each_crosswalk_leads_from_sidewalk_to_sidewalk(town: str, lanes: int) -> None:
    graph = load_town(town)
    network = sidewalk_network(graph)
    assert [crossing.crosswalk for crossing in network.crossings] == list(range(len(graph.crosswalk_offset) - 1))
    for index, crossing in enumerate(network.crossings):
        assert len(crossing.lanes) == lanes
        assert in_polygon(crossing.xy.mean(axis=0)[None], graph.crosswalk(index)).all()
    check_ends(graph, network)
    assert (network.component == 0).all()
    assert min(len(edges) for edges in network.edges_at) >= 2


def test_each_arm_of_a_junction_without_crosswalks_has_a_crossing() -> None:
    graph = without_crosswalks(load_town("Twinford"))
    network = sidewalk_network(graph)
    marked = sidewalk_network(load_town("Twinford"))
    assert {crossing.crosswalk for crossing in network.crossings} == {-1}
    assert {crossing.lanes for crossing in network.crossings} == {crossing.lanes for crossing in marked.crossings}
    assert len(network.crossings) == len(marked.crossings)
    corners = np.flatnonzero((graph.kind == LaneType.SIDEWALK) & (graph.junction >= 0))
    corner_ends = np.concatenate([graph.along(int(lane), [0.0, float(graph.length[lane])])[:, :2] for lane in corners])
    for crossing in network.crossings:
        setbacks = np.hypot(*(crossing.xy[:, None] - corner_ends[None]).transpose(2, 0, 1)).min(axis=1)
        assert np.abs(setbacks - SETBACK).max() < 0.1
    check_ends(graph, network)
    assert (network.component == 0).all()


def test_fast_roads_are_crossed_at_traffic_lights_alone() -> None:
    graph = without_crosswalks(load_town("Twinford"))
    fast = replace(graph, speed_limit=np.full_like(graph.speed_limit, 25.0))
    signalled = set(graph.stop_lane[~graph.signal_virtual[graph.stop_signal]].tolist())
    crossings = sidewalk_network(fast).crossings
    assert 0 < len(crossings) < len(sidewalk_network(graph).crossings)
    assert all(signalled & set(crossing.lanes) for crossing in crossings)


def test_corners_that_a_map_leaves_out_are_joined_without_crossing_a_lane() -> None:
    graph = load_town("Twinford")
    kind = np.array(graph.kind)
    kind[(kind == LaneType.SIDEWALK) & (graph.junction >= 0)] = LaneType.NONE
    network = sidewalk_network(replace(graph, kind=kind))
    corners = [edge for edge in network.edges if edge.lane < 0 and edge.crossing < 0]
    assert corners
    assert max(edge.length for edge in corners) <= GAP
    assert LaneQuery(graph).off_road(np.array([edge.xy.mean(axis=0) for edge in corners])).all()
    assert (network.component[[node for edge in corners for node in edge.nodes]] == 0).all()


def test_a_town_without_sidewalks_has_an_empty_network() -> None:
    network = sidewalk_network(load_town("HighSpeedTrack"))
    assert (len(network.node_xy), network.edges, network.crossings) == (0, (), ())


@pytest.mark.parametrize("offset", [0.0, 0.6, -0.6])
def test_a_walk_keeps_to_sidewalks_and_crossings(offset: float) -> None:
    graph = load_town("Twinford")
    network = sidewalk_network(graph)
    for number in range(8):
        walk = network.random_walk(number, 5.0, 200.0, generator("walk", number), crossing_share=0.7, offset=offset)
        route, points = walk.route, walk.route.xy.astype(float)
        assert len(points) == len(walk.crossing) == len(route.yaw) == 401
        steps = np.hypot(*np.diff(points, axis=0).T)
        assert 0.0 < steps.max() < 2.0 * route.spacing
        assert ((route.lane >= 0) != (walk.crossing >= 0)).all()
        for lane in np.unique(route.lane[route.lane >= 0]):
            line = graph.along(int(lane), np.linspace(0.0, float(graph.length[lane]), 400))[:, :2]
            beside = points[route.lane == lane]
            distance = np.hypot(*(beside[:, None] - line[None]).transpose(2, 0, 1)).min(axis=1)
            assert distance.max() <= 0.5 * float(graph.width[graph.points(int(lane))].max())


def test_walkers_take_crossings_as_often_as_they_are_asked_to() -> None:
    network = sidewalk_network(load_town("Twinford"))
    shares = [
        np.mean(
            [
                (network.random_walk(0, 0.0, 400.0, generator(number), crossing_share=share).crossing >= 0).mean()
                for number in range(6)
            ]
        )
        for share in (0.0, 0.5, 1.0)
    ]
    assert shares[0] == 0.0
    assert shares[0] < shares[1] < shares[2]


def test_a_walk_depends_on_its_generator_alone_and_may_run_backwards() -> None:
    network = sidewalk_network(load_town("Twinford"))
    first, again = (network.random_walk(0, 20.0, 100.0, generator("same")) for _ in range(2))
    assert np.array_equal(first.route.xy, again.route.xy)
    backwards = network.random_walk(0, 20.0, 100.0, generator("same"), reverse=True)
    assert np.hypot(*(backwards.route.xy[0] - first.route.xy[0])) <= 1.0
    assert (backwards.route.xy[4] - first.route.xy[4]) @ (first.route.xy[4] - first.route.xy[0]) < 0.0


def test_a_walk_turns_back_at_a_dead_end() -> None:
    network = sidewalk_network(load_town("Longreach"))
    dead_end = next(edge for edges in network.edges_at if len(edges) == 1 for edge in edges)
    edge = network.edges[dead_end]
    assert all(other.lane >= 0 or other.crossing >= 0 for other in network.edges)  # ramps lie between its dead ends
    at_start = len(network.edges_at[edge.nodes[0]]) == 1
    position = 1.0 if at_start else edge.length - 1.0
    walk = network.random_walk(dead_end, position, 2.0, generator("end"), reverse=at_start)
    assert (walk.route.lane == edge.lane).all()
    assert np.hypot(*(walk.route.xy[-1] - walk.route.xy[0])) < 0.5
    assert np.hypot(*(walk.route.xy[2] - walk.route.xy[0])) > 0.5


@pytest.mark.parametrize(("edge", "length", "problem"), [(999, 10.0, "edge 999"), (0, 0.1, "too short")])
def test_impossible_walks_say_what_to_change(edge: int, length: float, problem: str) -> None:
    with pytest.raises(RouteError, match=problem):
        sidewalk_network(load_town("Twinford")).random_walk(edge, 0.0, length, generator("walk"))

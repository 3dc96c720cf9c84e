"""Lanes made of driven paths."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.errors import MapError
from ssad.core.lane_graph import are_equal, load_graph, save_graph
from ssad.core.types import Pose
from ssad.world.roads import route_along
from ssad.world.roads.paths import graph_of_paths
from ssad.world.roads.query import nearest_all


def line(x0: float, x1: float, y: float, step: float = 0.4) -> np.ndarray:
    x = np.arange(0.0, abs(x1 - x0) + 1e-9, step) * np.sign(x1 - x0) + x0
    return np.stack([x, np.full(len(x), y)], 1)


def test_the_first_path_is_a_lane_from_end_to_end_and_longer(tmp_path) -> None:
    turn = np.linspace(0.0, np.pi / 2, 60)
    bend = np.stack([40.0 + 20.0 * np.sin(turn), 20.0 - 20.0 * np.cos(turn)], 1)
    path = np.concatenate([line(0.0, 40.0, 0.0), bend[1:]])
    graph = graph_of_paths("Bend", [path], speeds=[12.0])
    assert graph.lane_count == 1
    assert graph.length[0] == pytest.approx(5.0 + 40.0 + 10.0 * np.pi + 30.0, abs=1.5)
    assert graph.xy[0] == pytest.approx([-5.0, 0.0], abs=1e-3)
    assert graph.xy[-1] == pytest.approx([60.0, 50.0], abs=1.8)
    assert graph.yaw[[0, -1]] == pytest.approx([0.0, np.pi / 2], abs=0.1)
    assert (
        np.hypot(*(graph.xy[:, None] - path[None]).reshape(-1, 2).T).reshape(len(graph.xy), -1).min(1)[5:-30].max()
        < 0.3
    )
    route = route_along(graph, [Pose(0.0, 0.0), Pose(60.0, 20.0, np.pi / 2)])
    assert route.length == pytest.approx(40.0 + 10.0 * np.pi, abs=1.5)
    assert (route.lane == 0).all()
    assert (route.speed_limit == 12.0).all()
    assert (route.width == 3.5).all()
    save_graph(graph, tmp_path / "bend.npz")
    assert are_equal(load_graph(tmp_path / "bend.npz"), graph)


def test_other_paths_add_what_is_not_there_yet() -> None:
    own, ahead = line(0.0, 60.0, 0.0), line(30.0, 80.0, 0.8)
    oncoming, beside, short = line(60.0, 0.0, 3.4), line(0.0, 60.0, -3.5), line(0.0, 8.0, 20.0)
    assert graph_of_paths("A", [own, ahead], speeds=[8, 8]).lane_count == 1
    graph = graph_of_paths(
        "B", [own, ahead, oncoming, beside, oncoming + np.array([0, 0.5]), short], speeds=[8, 8, 9, 7, 8, 8]
    )
    assert graph.speed_limit.tolist() == [8, 9, 7]
    assert graph.yaw[graph.offset[:-1]] == pytest.approx([0.0, np.pi, 0.0])
    # who leaves the lane and drives on makes a lane from where he left it
    leaves = np.concatenate([line(0.0, 30.0, 0.0), np.array([30.0, 0.0]) + np.outer(np.arange(1, 60), [0.6, -0.4])])
    graph = graph_of_paths("C", [own, leaves], speeds=[8, 8])
    assert graph.lane_count == 2
    first = graph.xy[graph.offset[1]]
    assert -2.6 < first[1] <= -1.5
    lane, _, gap = nearest_all(graph, (50.0, -13.3), (1,))
    assert lane[np.argmin(gap)] == 1


def test_who_stands_trembles_or_goes_back_makes_no_kinks() -> None:
    noise = np.random.default_rng(0).normal(0.0, 0.02, (50, 2))
    path = np.concatenate(
        [line(0.0, 20.0, 0.0), np.array([20.0, 0.0]) + noise, line(20.0, 18.0, 0.0), line(20.4, 40.0, 0.0)]
    )
    graph = graph_of_paths("A", [path], speeds=[8.0])
    assert graph.length[0] == pytest.approx(75.0, abs=1.5)
    assert np.abs(graph.yaw).max() < 0.2
    with pytest.raises(MapError, match="less than 10 m"):
        graph_of_paths("A", [line(0.0, 5.0, 0.0), path], speeds=[8.0, 8.0])

"""Towns for the tests of roads: built-in ones, and CARLA's, as the fixture `carla_home` has imported them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from ssad.core.rotations import wrap_angle
from ssad.world.roads import LaneGraph, load_graph, load_town

BUILT_IN = ("Twinford", "Crossgate", "ProvingGround", "Oldmarket", "Larkhill", "Ringmere", "Longreach")
TRACKS = ("HighSpeedTrack",)  # without junctions
IMPORTED = ("Town_Safebench_Light", "Town02", "Town05")


@cache
def imported(home: Path, name: str) -> LaneGraph:
    return load_graph(home / "towns" / f"{name}.npz")


def built_in(name: str) -> LaneGraph:
    return load_town(name)


def polyline_distance(graph: LaneGraph, other: LaneGraph, lane: int) -> float:
    """Greatest distance of the points of a lane from its line in another graph."""
    points, line = (one.xy[one.points(lane)].astype(float) for one in (graph, other))
    start, way = line[:-1], np.diff(line, axis=0)
    offset = points[:, None] - start
    share = np.clip((offset * way).sum(-1) / (way * way).sum(-1), 0.0, 1.0)
    return float(np.hypot(*np.moveaxis(offset - share[..., None] * way, -1, 0)).min(1).max())


def check_is_same_town(new: LaneGraph, old: LaneGraph) -> None:
    """The same topology, and geometry within a millimetre, as where the shipped towns were baked through carla.Map.

    Where a chord may just be as long as it is, either end may have been chosen: what counts is the line. Headings in
    tapers are exact now, signal posts stand where the file says, not 0.25 m before it, and crosswalks are in the order
    of the file.
    """
    exact = ("kind", "road", "section", "lane_id", "junction", "left", "right", "left_marking")
    exact += ("right_marking", "succ_offset", "succ", "signal_junction", "signal_phase", "signal_virtual")
    exact += ("stop_signal", "stop_lane", "crosswalk_offset", "sign_kind", "rule_sign", "rule_lane", "forward")
    for name in exact:
        assert np.array_equal(getattr(new, name), getattr(old, name)), name
    limits = {"length": 1e-3, "speed_limit": 1e-4, "stop_s": 1e-3, "rule_s": 1e-3}
    limits |= {"signal_xy": 0.251, "sign_xy": 1e-3, "origin": 0.0}
    for lane in range(new.lane_count):
        for one, other in ((new, old), (old, new)):
            assert polyline_distance(one, other, lane) <= 1e-3, lane
            s = one.s[one.points(lane)]
            there, here = other.along(lane, s), one.along(lane, s)
            assert np.abs(here[:, 3] - there[:, 3]).max() <= 1e-3, lane
            assert np.abs(wrap_angle(here[:, 2] - there[:, 2])).max() <= 0.1, lane
    for name, limit in limits.items():
        assert np.abs(getattr(new, name) - getattr(old, name)).max(initial=0.0) <= limit, name
    for name, limit in (("signal_yaw", 1e-3), ("sign_yaw", 1e-3)):
        assert np.abs(wrap_angle(getattr(new, name) - getattr(old, name))).max(initial=0.0) <= limit, name
    middles = [
        sorted(graph.crosswalk(i).mean(0).round(2).tolist() for i in range(len(graph.crosswalk_offset) - 1))
        for graph in (new, old)
    ]
    assert middles[0] == middles[1]

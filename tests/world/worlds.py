"""A straight two-lane road made by hand, and episodes on it, for closed-form tests of the world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from ssad.core.lane_graph import LaneGraph, Marking
from ssad.core.types import (
    Controller,
    Episode,
    EpisodeAgent,
    EpisodeLimits,
    LaneType,
    Pose,
    Route,
    Scenario,
)

GPU = pytest.param("cuda:0", marks=pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device"))
DEVICES = ["cpu", GPU]


def straight_graph(length: float = 400.0, width: float = 3.5) -> LaneGraph:
    """Two lanes eastwards (y = 0) and westwards (y = 3.5), and a sidewalk south of them."""
    x = np.arange(0.0, length + 1.0, 2.0, dtype=np.float32)
    n = len(x)
    xy = np.concatenate(
        [
            np.stack([x, np.zeros(n)], 1),
            np.stack([x[::-1], np.full(n, width)], 1),
            np.stack([x, np.full(n, -2.75)], 1),
        ]
    ).astype(np.float32)
    yaw = np.concatenate([np.zeros(n), np.full(n, np.pi), np.zeros(n)]).astype(np.float32)
    i32 = lambda *v: np.array(v, np.int32)  # noqa: E731
    none = np.zeros(0, np.int32)
    return LaneGraph(
        name="Straight",
        xy=xy,
        z=np.zeros(3 * n, np.float32),
        yaw=yaw,
        width=np.concatenate([np.full(2 * n, width), np.full(n, 2.0)]).astype(np.float32),
        s=np.tile(x, 3).astype(np.float32),
        offset=i32(0, n, 2 * n, 3 * n),
        kind=np.array([LaneType.DRIVING, LaneType.DRIVING, LaneType.SIDEWALK], np.uint8),
        road=i32(0, 0, 0),
        section=i32(0, 0, 0),
        lane_id=i32(-1, 1, -2),
        junction=i32(-1, -1, -1),
        speed_limit=np.full(3, 30.0, np.float32),
        left=i32(1, 0, 0),
        right=i32(2, -1, -1),
        left_marking=np.zeros(3, np.uint8),
        right_marking=np.zeros(3, np.uint8),
        succ_offset=i32(0, 0, 0, 0),
        succ=none,
        signal_xy=np.zeros((0, 2), np.float32),
        signal_yaw=np.zeros(0, np.float32),
        signal_junction=none,
        signal_phase=none,
        signal_virtual=np.zeros(0, bool),
        stop_signal=none,
        stop_lane=none,
        stop_s=np.zeros(0, np.float32),
        crosswalk_offset=i32(0),
        crosswalk_xy=np.zeros((0, 2), np.float32),
    )


def line_route(x0: float, x1: float, y: float = 0.0, limit: float = 30.0) -> Route:
    """A straight route along x, one point a metre; backwards if x1 < x0."""
    n = int(abs(x1 - x0)) + 1
    x = np.linspace(x0, x1, n)
    yaw = 0.0 if x1 > x0 else np.pi
    return Route(
        xy=np.stack([x, np.full(n, y)], 1).astype(np.float32),
        yaw=np.full(n, yaw, np.float32),
        lane=np.full(n, 0 if x1 > x0 else 1, np.int32),
        speed_limit=np.full(n, limit, np.float32),
        width=np.full(n, 3.5, np.float32),
    )


def ego(x: float = 10.0, speed: float = 0.0, controller: Controller = Controller.EXTERNAL, **more) -> EpisodeAgent:
    """An ego on the eastbound lane with 200 m to go."""
    base = EpisodeAgent(
        name="ego",
        model="car",
        controller=controller,
        pose=Pose(x, 0.0, 0.0),
        speed=speed,
        target_speed=8.0,
        route=line_route(x, x + 200.0),
    )
    return replace(base, **more)


def episode(*agents: EpisodeAgent, key: str = "test", **more) -> Episode:
    """An episode on the straight road."""
    scenario = Scenario(name=key, type="Custom", town="Straight", route=(Pose(10, 0), Pose(210, 0)))
    base = Episode(key=key, scenario=scenario, town="Straight", agents=agents, limits=EpisodeLimits(max_steps=300))
    return replace(base, **more)


GRAPHS = {"Straight": straight_graph()}
NO_PASSING = {"Straight": replace(GRAPHS["Straight"], left_marking=np.full(3, Marking.SOLID, np.uint8))}

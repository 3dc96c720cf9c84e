"""The roundabouts of Ringmere and the motorway of Longreach: who yields, who drives where, and what stands there."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.lane_graph import SignKind
from ssad.core.rotations import wrap_angle
from ssad.core.seeding import generator
from ssad.core.types import Controller, Episode, EpisodeAgent, EpisodeLimits, LaneType, Pose, Route, Scenario
from ssad.recorders.drives import make_drive
from ssad.rendering.street.region import survey
from ssad.world.roads import LaneGraph, random_route, route_along
from ssad.world.world import World
from tests.world.roads.towns import built_in

RINGS = (((220.0, 170.0), 22.0), ((450.0, 170.0), 20.0))
MOTORWAY = 22.0  # m/s, a higher limit
LIMITS = EpisodeLimits(max_steps=10_000, max_time=1e4)


def agent(name: str, route: Route, speed: float, body: str = "car") -> EpisodeAgent:
    pose = Pose(float(route.xy[0, 0]), float(route.xy[0, 1]), float(route.yaw[0]))
    return EpisodeAgent(name, body, Controller.AUTOPILOT, pose, 0.6 * speed, speed, route=route)


def episode(graph: LaneGraph, agents: list[EpisodeAgent]) -> Episode:
    scenario = Scenario("traffic", "Custom", graph.name, (agents[0].pose, agents[0].pose), limits=LIMITS)
    return Episode("traffic", scenario, graph.name, tuple(agents), {}, 0.0, LIMITS)


def traffic(graph: LaneGraph, count: int, key: int) -> Episode:
    """Vehicles at random places, each on a random way."""
    draws = generator("roundabout motorway", graph.name, key)
    lanes = np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0) & (graph.length > 14.0))
    agents: list[EpisodeAgent] = []
    while len(agents) < count:
        lane = int(draws.choice(lanes))
        route = random_route(graph, lane, float(draws.uniform(5.0, graph.length[lane] - 5.0)), 900.0, draws)
        pose = route.xy[0]
        if all(np.hypot(*(pose - [a.pose.x, a.pose.y])) > 15.0 for a in agents):
            agents.append(agent(f"car {len(agents)}", route, float(route.speed_limit.max())))
    return episode(graph, agents)


@pytest.mark.parametrize(("place", "radius"), RINGS)
def test_a_ring_goes_round_and_its_arms_yield(place: tuple[float, float], radius: float) -> None:
    graph = built_in("Ringmere")
    middle = np.array(place)
    away = np.hypot(*(graph.xy - middle).T)
    ring = []
    for lane in np.flatnonzero(graph.kind == LaneType.DRIVING).tolist():
        part = graph.points(lane)
        if np.abs(away[part] - radius).max() < 0.05:
            ring.append(lane)
            x, y = (graph.xy[part] - middle).T
            turn = wrap_angle(np.arctan2(y, x) + 0.5 * np.pi - graph.yaw[part])
            assert np.abs(turn).max() < 0.02  # counterclockwise
    assert sum(float(graph.length[lane]) for lane in ring) == pytest.approx(2.0 * np.pi * radius, rel=0.01)
    ruled = dict(zip(graph.rule_lane.tolist(), graph.sign_kind[graph.rule_sign].tolist(), strict=True))
    entries = 0
    for lane in ring:
        assert lane not in ruled
        for other in graph.predecessors(lane).tolist():
            if other in ring:
                continue
            (street,) = graph.predecessors(other).tolist()
            assert ruled[street] == SignKind.YIELD
            entries += 1
    assert entries == (4 if radius == 22.0 else 3)


def test_who_enters_a_roundabout_waits_for_the_ring() -> None:
    """Whenever the vehicle on the ring comes, it hardly brakes for the one that enters, which goes in behind it.

    One that enters may stop with its nose on the ring (1 of the 21 starts): who is on the ring waits, then goes on.
    """
    graph = built_in("Ringmere")
    round_it = route_along(
        graph, [Pose(218.25, 300.0, -0.5 * np.pi), Pose(200.0, 161.0, -1.1), (222.0, 148.0), Pose(260.0, 168.25, 0.0)]
    )
    enter = route_along(graph, [Pose(150.0, 168.25, 0.0), (222.0, 148.0), Pose(260.0, 168.25, 0.0)])
    episodes = []
    for start in np.linspace(40.0, 140.0, 21).round().astype(int).tolist():
        columns = (getattr(round_it, name)[start:] for name in ("xy", "yaw", "lane", "speed_limit", "width"))
        episodes.append(episode(graph, [agent("enters", enter, 9.0), agent("ring", Route(*columns, spacing=1.0), 9.0)]))
    world = World(episodes, {"Ringmere": graph}, ego=Controller.AUTOPILOT)
    touched = np.zeros(world.batch, bool)
    close, kept = np.full(world.batch, np.inf), np.full(world.batch, np.inf)
    for _ in range(300):
        world.step()
        touched |= (world.array("touch") != 0).any(axis=1)
        pose, speed = world.array("pose"), world.array("speed")
        inside = np.hypot(pose[:, 1, 0] - 220.0, pose[:, 1, 1] - 170.0) < 23.0
        kept = np.where(inside, np.minimum(kept, speed[:, 1]), kept)
        close = np.minimum(close, np.hypot(*(pose[:, 0, :2] - pose[:, 1, :2]).T))
    assert not touched.any()
    assert close.min() < 9.0  # they do meet
    assert (kept > 5.0).sum() >= len(kept) - 2  # m/s: the bend of the ring alone allows 7.4
    assert world.array("ego.complete").min() == 100.0


def test_motorway_has_lanes_and_ramps() -> None:
    graph = built_in("Longreach")
    fast = np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0) & (graph.speed_limit > MOTORWAY))
    count = {}
    for lane in fast.tolist():
        assert graph.is_divided(lane)
        key = int(graph.road[lane]), bool(graph.lane_id[lane] > 0)
        count[key] = count.get(key, 0) + 1
    assert sorted(count.values()) == [2, 2, 2, 2, 3, 3]
    street = (graph.kind == LaneType.DRIVING) & (graph.junction < 0)
    ramps = [
        i for i in np.flatnonzero(street & ~np.isin(np.arange(graph.lane_count), fast)).tolist() if graph.is_divided(i)
    ]
    assert len(ramps) == 4
    joins = [bool(np.isin(graph.successors(int(graph.successors(i)[0])), fast).any()) for i in ramps]
    assert sum(joins) == 2  # two on, two off
    for lane in fast.tolist():
        route = random_route(graph, lane, 1.0, 800.0, generator("motorway", lane))
        assert route.length > 798.0


@pytest.mark.parametrize("scenes", [1, pytest.param(4, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["Ringmere", "Longreach"])
def test_traffic_gets_through(name: str, scenes: int) -> None:
    graph = built_in(name)
    world = World([traffic(graph, 45, k) for k in range(scenes)], {name: graph}, ego=Controller.AUTOPILOT)
    touched, moved = np.zeros((scenes, 45), bool), np.zeros((scenes, 45))
    for _ in range(600):
        last = world.array("pose").copy()
        world.step()
        touched |= world.array("touch") != 0
        assert (world.array("lane") >= 0).all()
        moved += np.hypot(*np.moveaxis(world.array("pose")[..., :2] - last[..., :2], -1, 0))
    assert not touched.any()
    assert moved.min() > 30.0
    assert moved.mean() > 300.0


def test_drives_on_a_motorway_are_fast_and_without_bicycles() -> None:
    graph = built_in("Longreach")
    drives = [make_drive(graph, key=("fast", k), seconds=10.0) for k in range(12)]
    on_motorway = [drive for drive in drives if drive.agents[0].route.speed_limit.max() > MOTORWAY]
    assert on_motorway
    for drive in drives:
        for one in drive.agents:
            fast = one.route.speed_limit.max() > MOTORWAY
            assert one.model != "bicycle" or not fast
            if one is drive.agents[0]:
                assert (one.target_speed > 12.0) == fast
    slow = make_drive(built_in("Crossgate"), key=("fast", 0), seconds=10.0)
    assert all(one.target_speed <= 11.0 for one in slow.agents)


def test_nothing_is_built_where_nobody_can_walk() -> None:
    """Islands of roundabouts, and ground between a motorway and its ramps where only these enclose it."""
    graph = built_in("Ringmere")
    ground = survey(graph)
    for place, radius in RINGS:
        column, row = np.round(np.array(place) - ground.origin).astype(int)
        far = round(radius - 8.0)
        assert not ground.inner[row - far : row + far, column - far : column + far].any()
        assert (ground.road[row - far : row + far, column - far : column + far] > 0.0).any()
    assert ground.inner.sum() > 50_000

"""The Autopilot among others: who goes first at a junction, and a whole set of natural traffic without trouble."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.quick import others_slow

from benchmarks.traffic import LENGTH, ROUTES, between_lanes, measure, town_routes, traffic, upper_limit
from ssad.core.types import ENDS, AgentKind, Controller, EpisodeAgent, Pose
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads import load_town
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode, line_route, straight_graph


def run(name: str, ego: Controller) -> World:
    scenario = load_scenarios(name)[0]
    town = load_town(scenario.town)
    episode = build_episode(scenario, town, seed=0)
    world = World([episode], {scenario.town: town}, ego=ego)
    while not world.ended()[0]:
        world.step()
    return world


@pytest.mark.parametrize(
    "name", ["RedlightRunning/00", "CrossingNegotiation/00", "UnprotectedLeftTurn/00", "RightTurn/00"]
)
def test_autopilot_gives_way_to_those_who_do_not(name: str) -> None:
    assert ENDS[run(name, Controller.FOLLOW).ended()[0]] == "collision"
    assert ENDS[run(name, Controller.AUTOPILOT).ended()[0]] == "complete"


@pytest.mark.parametrize(("name", "every"), [("natural-uniform", 1), ("natural", 3)])
def test_natural_traffic_hurts_nobody_and_gets_through(name: str, every: int) -> None:
    scenarios = load_scenarios(name)[::every]
    graphs = {s.town: load_town(s.town) for s in scenarios}
    world = World([build_episode(s, graphs[s.town], seed=0) for s in scenarios], graphs, ego=Controller.AUTOPILOT)
    touched = np.zeros(world.batch, bool)
    vehicles = world.state().kind != AgentKind.WALKER  # groups of walkers brush against each other
    for _ in range(300):
        world.step()
        touched |= ((world.array("touch") != 0) & vehicles).any(axis=1)
    assert (world.ended() == ENDS.index("collision")).mean() <= 0.02
    assert touched.mean() <= 0.02
    assert world.array("ego.complete").mean() >= 95.0
    moved = world.array("travelled")[world.state().kind > 0]
    assert np.median(moved) > 20.0  # not by standing still


@pytest.mark.parametrize(
    ("name", "green"),
    others_slow([("Oldmarket", False), ("Twinford", True), ("Crossgate", False)], [("Twinford", True)]),
)
def test_no_queue_stands_for_ever(name: str, green: bool) -> None:
    """Dense traffic of 40 vehicles for four minutes: every queue clears, nobody leaves the road."""
    graph = load_town(name)
    routes = town_routes(graph, ROUTES // 4, 2000.0)
    episodes = [traffic(graph, routes, 40, key=k, green=green) for k in range(3)]
    found = measure(graph, episodes, seconds=240.0)
    assert found["hours"] > 5.0
    assert not found["stuck"]
    assert not found["off_road"]
    assert len(found["contacts"]) <= 1


def test_one_of_two_that_stand_nose_to_nose_backs_out() -> None:
    """A scene in which two vehicles come to stand in each other's way; without the rule they stand for good."""
    graph = load_town("Oldmarket")
    scene = traffic(graph, town_routes(graph, ROUTES, LENGTH), 40, key=1001, green=False)
    found = measure(graph, [scene], seconds=150.0)
    assert not found["stuck"]
    assert not found["contacts"]


def test_a_motorcycle_does_not_wait_in_a_junction_for_good() -> None:
    """It stands in the middle of one, behind it a car: too little room to drive in, but enough to move up."""
    graph = load_town("Twinford")
    for route in town_routes(graph, 40, 300.0):
        inside = graph.junction[route.lane] >= 0
        begin = int(inside.argmax())
        leave = begin + int((~inside[begin:]).argmax())
        if np.cos(route.yaw[leave] - route.yaw[begin]) > 0.99:
            break
    at, stop = (begin + leave) // 2, leave + 5
    yaw = float(route.yaw[at])
    x, y = (route.xy[at] - 0.3 * np.array([np.cos(yaw), np.sin(yaw)])).tolist()
    rider = EpisodeAgent("rider", "motorcycle", Controller.AUTOPILOT, Pose(x, y, yaw), 0.0, 8.0, route=route)
    ahead = Pose(float(route.xy[stop, 0]), float(route.xy[stop, 1]), float(route.yaw[stop]))
    stands = ego(name="stands", controller=Controller.NONE, pose=ahead, route=None)
    scene = traffic(graph, [route], 1, key=0, green=True)
    world = World([replace(scene, agents=(rider, stands))], {graph.name: graph})
    moved = []
    for _ in range(600):
        world.step()
        moved.append(float(world.array("travelled")[0, 0]))
        assert not world.array("touch").any()
    assert moved[-1] - moved[350] > 1.5


@pytest.mark.slow
def test_who_has_no_room_behind_is_made_room_for() -> None:
    """Scenes in which the one of two that should back out stands before a queue: 17, 25 and 32 vehicles were stuck.

    Five minutes of traffic are chaotic, and another processor may drive them otherwise: one of the three may go wrong.
    """
    stuck = []
    for name, key in (("Crossgate", 47), ("Twinford", 128), ("Twinford", 176)):
        graph = load_town(name)
        scene = traffic(graph, town_routes(graph, ROUTES, LENGTH), 40, key=key, green=False)
        found = measure(graph, [scene], seconds=300.0)
        assert not found["contacts"]
        stuck.append(len(found["stuck"]))
    assert sorted(stuck)[1] <= 2


def test_a_vehicle_beyond_the_end_of_a_route_is_seen() -> None:
    parked = ego(x=300.0, controller=Controller.NONE)
    coming = ego(x=40.0, speed=8.0, controller=Controller.AUTOPILOT, name="coming", route=line_route(40.0, 120.0))
    stands = ego(x=123.0, controller=Controller.NONE, name="stands", model="bus", route=None)
    world = World([episode(parked, coming, stands)], GRAPHS)
    for _ in range(200):
        world.step()
        assert not world.array("touch").any()
    assert world.array("pose")[0, 1, 0] > 110.0


def test_upper_limit_of_a_count() -> None:
    """Values of the chi-squared tables."""
    for count, limit in ((0, 2.996), (1, 4.744), (10, 16.962), (25, 34.916)):
        assert upper_limit(count) == pytest.approx(limit, abs=2e-3)


def test_the_autopilot_gets_through_every_pre_crash_scenario() -> None:
    """It passes the parked car and the slow leader; a right turn on red works past a stop sign too, of which nothing is
    heard while a signal is lit."""
    episodes = [build_episode(s, load_town(s.town), seed=0) for s in load_scenarios("precrash")]
    graphs = {e.town: load_town(e.town) for e in episodes}
    world = World(episodes, graphs, ego=Controller.AUTOPILOT)
    while not world.ended().all():
        world.step()
    assert [ENDS[end] for end in world.ended()] == ["complete"] * len(episodes)


def test_a_gap_between_two_lanes_is_not_beside_the_road() -> None:
    graph = straight_graph()
    graph = replace(graph, width=graph.width - np.float32(0.02) * (graph.width > 3.0))
    assert between_lanes(graph, {"x": 100.0, "y": 1.75, "yaw": 0.1})
    assert not between_lanes(graph, {"x": 100.0, "y": 5.3, "yaw": 0.1})
    assert not between_lanes(graph, {"x": 100.0, "y": 5.3, "yaw": 1.6})

"""Stop signs: read from the map, obeyed by the Autopilot, and counted when they are run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.driving import Belief, Observation
from ssad.core.lane_graph import SignKind
from ssad.core.seeding import generator
from ssad.core.types import (
    ENDS,
    F32,
    Controller,
    Episode,
    EpisodeAgent,
    EpisodeLimits,
    Pose,
    Route,
    Scenario,
    SignalState,
)
from ssad.metrics import episode_metrics
from ssad.world.roads import LaneGraph, load_town, random_route
from ssad.world.rollout import rollout
from ssad.world.world import World

LIMITS = EpisodeLimits(max_steps=1000, max_time=1e3)


class Drives:
    """A system that the world drives itself."""

    name = "test"

    def __init__(self, controller: Controller) -> None:
        self.controller = controller


def stop_lanes(graph: LaneGraph) -> list[int]:
    return graph.rule_lane[graph.sign_kind[graph.rule_sign] == SignKind.STOP].tolist()


def past(graph: LaneGraph, lane: int) -> Route:
    """A way that begins 60 m at most before the line of a sign and goes on for 60 m."""
    start = max(float(graph.length[lane]) - 60.0, 1.0)
    length = float(graph.length[lane]) - start + 60.0
    return random_route(graph, lane, start, length, generator("past a sign", graph.name, lane))


def alone(graph: LaneGraph, route: Route, *, forced: dict[int, SignalState] | None = None) -> Episode:
    pose = Pose(float(route.xy[0, 0]), float(route.xy[0, 1]), float(route.yaw[0]))
    ego = EpisodeAgent("ego", "car", Controller.AUTOPILOT, pose, 5.0, 8.0, route=route)
    scenario = Scenario("sign", "Custom", graph.name, (pose, pose), limits=LIMITS)
    return Episode("sign", scenario, graph.name, (ego,), forced or {}, 1e6 if forced else 0.0, LIMITS)


@pytest.mark.parametrize("name", ["Oldmarket", "Larkhill", "Longreach"])
def test_stop_signs_are_obeyed_and_counted(name: str) -> None:
    """Every stop sign of a town: the Autopilot stops before its line, goes on, and who drives by is counted once."""
    graph = load_town(name)
    lanes = stop_lanes(graph)
    assert lanes
    routes = [past(graph, lane) for lane in lanes]
    episodes = [alone(graph, route) for route in routes]
    on = [
        {int(graph.rule_lane[k]) for k in np.flatnonzero(np.isin(graph.rule_lane, route.lane)).tolist()} & set(lanes)
        for route in routes
    ]
    obeyed = rollout(World(episodes, {name: graph}), Drives(Controller.AUTOPILOT))
    for trace, passed, lane in zip(obeyed, on, lanes, strict=True):
        assert trace.end == "complete"
        assert trace.stop_sign.sum() == 0
        assert episode_metrics(trace, stop_signs=True).stop_signs == 0
        s = float(graph.rule_s[graph.rule_lane.tolist().index(lane)])
        x, y, yaw, _ = graph.at(lane, s)
        front = (trace.x[:, 0] - x) * np.cos(yaw) + (trace.y[:, 0] - y) * np.sin(yaw) + 0.5 * trace.length[0]
        near = np.abs(trace.y[:, 0] - y) + np.abs(trace.x[:, 0] - x) < 30.0
        assert trace.speed[near & (front > -4.0) & (front < 0.5), 0].min() < 0.3
        assert (trace.speed[:, 0] < 0.3).sum() * trace.dt < 6.0 * len(passed)  # not for ever
    ignored = rollout(World(episodes, {name: graph}), Drives(Controller.FOLLOW))
    for trace, passed in zip(ignored, on, strict=True):
        assert trace.end == "complete"
        assert 1 <= trace.stop_sign.sum() <= len(passed)
        assert episode_metrics(trace, stop_signs=True).stop_signs == trace.stop_sign.sum()
    assert sum(int(trace.stop_sign.sum()) == len(passed) for trace, passed in zip(ignored, on, strict=True)) >= (
        0.8 * len(on)  # some ways end before the tail is over a second line
    )


def test_a_lit_signal_stands_above_a_stop_sign() -> None:
    graph = load_town("Larkhill")
    lane = stop_lanes(graph)[0]
    route = past(graph, lane)
    signal_of = dict(zip(graph.stop_lane.tolist(), graph.stop_signal.tolist(), strict=True))
    forced = {signal_of[i]: SignalState.GREEN for i in stop_lanes(graph)}
    (trace,) = rollout(World([alone(graph, route, forced=forced)], {"Larkhill": graph}), Drives(Controller.AUTOPILOT))
    assert trace.end == "complete"
    assert trace.stop_sign.sum() == 0
    assert trace.speed[20:, 0].min() > 1.0


class Reader:
    """The Autopilot that knows the truth, and of stop signs what it is told."""

    name = "reader"
    controller = Controller.AUTOPILOT
    sensors = ("truth",)

    def __init__(self, known: int) -> None:
        self.known = known

    def reset(self, episodes: list[Episode]) -> None: ...

    def act(self, view: Observation) -> F32:
        raise AssertionError

    def believe(self, view: Observation) -> Belief:
        known = np.full(len(view.scene), self.known, np.uint8)
        return replace(view.readings["truth"], stop_sign=known)


def test_who_does_not_know_of_a_stop_sign_drives_on() -> None:
    graph = load_town("Larkhill")
    episodes = [alone(graph, past(graph, lane)) for lane in stop_lanes(graph)[:3]]
    privileged = rollout(World(episodes, {"Larkhill": graph}), Drives(Controller.AUTOPILOT))
    told = rollout(World(episodes, {"Larkhill": graph}), Reader(1))
    untold = rollout(World(episodes, {"Larkhill": graph}), Reader(0))
    for one, same, other in zip(privileged, told, untold, strict=True):
        assert np.array_equal(one.x, same.x)
        assert np.array_equal(one.speed, same.speed)
        assert other.stop_sign.sum() >= 1


def test_background_traffic_stops_too_each_time_it_comes_by() -> None:
    """A vehicle that goes round a block stops at the same sign in every round."""
    graph = load_town("Larkhill")
    for lane in stop_lanes(graph):
        rounds = [random_route(graph, lane, 1.0, 1500.0, generator("rounds", lane, k)) for k in range(60)]
        visits = [int((np.diff(np.flatnonzero(route.lane == lane)) > 1).sum()) + 1 for route in rounds]
        if max(visits) >= 3:
            break
    route = rounds[int(np.argmax(visits))]
    pose = Pose(float(route.xy[0, 0]), float(route.xy[0, 1]), float(route.yaw[0]))
    ego = alone(graph, past(graph, stop_lanes(graph)[-1])).agents[0]
    parked = EpisodeAgent("ego", "car", Controller.NONE, ego.pose, route=ego.route)
    other = EpisodeAgent("other", "car", Controller.AUTOPILOT, pose, 5.0, 8.0, route=route)
    limits = EpisodeLimits(max_steps=5000, max_time=1e4)
    scenario = Scenario("rounds", "Custom", "Larkhill", (pose, pose), limits=limits)
    world = World([Episode("rounds", scenario, "Larkhill", (parked, other), {}, 0.0, limits)], {"Larkhill": graph})
    lines = set()
    for _ in range(3000):
        world.step()
        lines.add(int(world.array("halted")[0, 1]))
    assert world.ended()[0] == ENDS.index("")
    last = int(world.array("progress")[0, 1])
    ends = np.flatnonzero((route.lane[:-1] == lane) & (route.lane[1:] != lane))
    ends = ends[ends < last - 5]
    assert len(ends) >= 2
    for end in ends.tolist():
        assert min(abs(end - line) for line in lines) < 8

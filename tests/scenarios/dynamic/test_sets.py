"""The shipped sets: made by the generator, valid on their towns, dangerous and avoidable."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.crossing_traffic import crossings, schedule, scheduled_crossings
from benchmarks.make_scenario_sets import (
    CROSSING,
    LANE_TOWNS,
    NATURAL,
    NATURAL_TOWNS,
    PRECRASH_TOWN,
    TRAFFIC,
    TRAINING_TOWNS,
    crossing_draws,
    fixed,
    natural,
    precrash,
    training,
    unselected,
    with_crossing_traffic,
)
from ssad.core.geometry import obb_distance
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import (
    Controller,
    Episode,
    EpisodeAgent,
    LaneType,
    Phase,
    PhaseTrigger,
    Pose,
    Scenario,
    SignalState,
)
from ssad.scenarios.dynamic import PRECRASH, build_episode, load_scenarios, scenario_type
from ssad.scenarios.dynamic.sets import DATA
from ssad.scenarios.dynamic.yamlio import scenario_text
from ssad.world.models import model
from ssad.world.roads import LaneQuery, load_town
from ssad.world.rollout import rollout
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, line_route
from tests.world.worlds import episode as line_episode

SHIPPED = load_scenarios("precrash")
CHOSEN, UNSELECTED = load_scenarios("natural"), load_scenarios("natural-unselected")
UNIFORM = load_scenarios("natural-uniform")


@cache
def town(name: str) -> LaneGraph:
    return load_town(name)


@cache
def episode(name: str) -> Episode:
    (scenario,) = load_scenarios(name)
    return build_episode(scenario, town(scenario.town), seed=0)


def boxes(e: Episode) -> np.ndarray:
    rows = []
    for agent in e.agents:
        body = model(agent.model)
        rows.append((agent.pose.x, agent.pose.y, agent.pose.yaw, body.length, body.width))
    return np.array(rows)


def test_the_generator_makes_the_shipped_files() -> None:
    text = (DATA / "precrash.yaml").read_text()
    assert text == scenario_text(precrash(town(PRECRASH_TOWN))), "run python -m benchmarks.make_scenario_sets"


def test_the_generator_makes_the_natural_sets_of_a_town() -> None:
    """Of each route the first draw that crosses, then the second; the draws before it do not cross."""
    graph, chosen = town("Twinford"), [s for s in CHOSEN if s.town == "Twinford"]
    routes = natural(graph, NATURAL_TOWNS["Twinford"])
    assert [s for s in UNSELECTED if s.town == "Twinford"] == unselected({"Twinford": len(routes)}, len(routes))
    for scenario in chosen[:3]:
        (route,) = [s for s in routes if s.name[:-2] == scenario.name[:-2]]
        assert next(crossing_draws(route, graph)) == scenario
    assert {s.route for s in CHOSEN if s.town == "Twinford"} <= {s.route for s in routes}
    assert all(s == fixed(replace(s, traffic=None), int(s.name[-2:])) for s in CHOSEN)


@pytest.mark.slow
def test_the_generator_makes_the_natural_sets() -> None:
    assert list(CHOSEN) == with_crossing_traffic(NATURAL_TOWNS, NATURAL)
    assert list(UNSELECTED) == unselected(NATURAL_TOWNS, NATURAL)


def test_the_natural_sets_have_the_population_with_walkers_and_cyclists() -> None:
    assert len({s.route for s in CHOSEN}) >= 100
    assert len({s.route for s in UNSELECTED}) == len(CHOSEN) == len(UNSELECTED) == NATURAL
    trained = [s for name in ("training", "training-lanes") for s in load_scenarios(name)]
    for s in (*CHOSEN, *UNSELECTED, *(s for s in trained if s.type == "NaturalJunction")):
        assert s.traffic is not None
        assert replace(s.traffic, draw=None) == TRAFFIC
    assert all(s.traffic is not None and s.traffic.draw is not None for s in CHOSEN)
    assert TRAFFIC.drivers == "population"
    agents = [a for s in CHOSEN[::15] for a in episode(s.name).agents[1:]]
    assert all((a.driver is None) == (a.model == "walker") for a in agents)
    assert sum(a.model == "walker" for a in agents) > 100
    assert sum(a.model == "bicycle" for a in agents) > 10


def test_the_set_of_before_keeps_uniform_drivers() -> None:
    assert len(UNIFORM) == 150
    assert not {s.name for s in UNIFORM} & {s.name for s in (*CHOSEN, *UNSELECTED)}
    agents = [a for s in UNIFORM[::30] for a in episode(s.name).agents[1:]]
    assert len(agents) > 15
    assert all(a.driver is None and a.model not in ("walker", "bicycle") for a in agents)


def test_traffic_crosses_the_way_in_the_natural_set() -> None:
    """It was chosen by schedules; in the world nearly all of it comes, and far less in draws as they come."""
    counts, shares = [], []
    for scenarios in (CHOSEN[::12], UNSELECTED[::10]):
        graphs = {s.town: town(s.town) for s in scenarios}
        episodes = [build_episode(s, graphs[s.town], seed=3) for s in scenarios]
        counts.append(np.array([scheduled_crossings(e) for e in episodes]))
        shares.append((crossings(episodes, graphs) >= 1).mean())
    assert (counts[0] >= CROSSING).all()
    assert (counts[1] >= CROSSING).mean() < 0.5
    assert shares[0] > max(0.7, shares[1])


def test_who_crosses_the_way_is_counted_once_and_nobody_else() -> None:
    """The ego would be at x = 50 m after 6.6 s."""

    def actor(x: float, y: float, yaw: float) -> EpisodeAgent:
        phases = (Phase(8.0, PhaseTrigger("always")),)
        return EpisodeAgent(f"{x} {y}", "car", Controller.SCRIPT, Pose(x, y, yaw), 8.0, 8.0, phases=phases)

    def across(seconds: float) -> EpisodeAgent:
        return actor(50.0, -8.0 * seconds, math.pi / 2)

    def count(*others: EpisodeAgent) -> int:
        return int(crossings([line_episode(ego(), *others)], GRAPHS)[0])

    assert count(across(6.6)) == count(across(3.5)) == count(across(9.5)) == 1
    assert count(across(0.5)) == count(across(13.0)) == 0  # gone, or not yet there
    assert count(actor(30.0, 0.0, 0.0), actor(150.0, 3.5, math.pi)) == 0  # ahead of the ego, and on the other lane
    assert count(across(6.0), actor(30.0, 0.0, 0.0), across(8.5)) == 2


def test_schedules_cross_where_and_when_their_ways_do() -> None:
    """The ego, from rest, is at x = 50 m after 50 / 8 + 1.6 s."""

    def northwards(start: float, wake: float = 0.0, speed: float = 8.0) -> EpisodeAgent:
        way = line_route(start, start + 200.0)
        xy = np.stack([np.full(len(way.xy), 50.0, np.float32), way.xy[:, 0]], 1)
        route = replace(way, xy=xy, yaw=np.full(len(xy), math.pi / 2, np.float32))
        pose = Pose(50.0, start, math.pi / 2)
        return EpisodeAgent("x", "car", Controller.AUTOPILOT, pose, speed, 8.0, route=route, wake_distance=wake)

    def count(*others: EpisodeAgent) -> int:
        return scheduled_crossings(line_episode(ego(0.0, 0.0), *others))

    assert count(northwards(-8.0 * 7.8)) == count(northwards(-8.0 * 4.8)) == count(northwards(-8.0 * 11.0)) == 1
    assert count(northwards(-8.0 * 1.0), northwards(-8.0 * 14.0)) == 0  # gone, and not yet there
    assert count(northwards(-30.0, speed=0.0), northwards(-8.0 * 6.5)) == 2
    # it takes 6.6 s, and with the wake distance sets out once the ego is 9 m before the crossing, at 6.7 s
    assert count(northwards(-40.0, speed=0.0)) == 1
    assert count(northwards(-40.0, wake=41.0, speed=0.0)) == 0
    beside = EpisodeAgent("y", "car", Controller.AUTOPILOT, Pose(9.0, 0.0, 0.0), 8.0, 8.0, route=line_route(9.0, 300.0))
    assert count(beside) == 0


def test_a_schedule_slows_down_before_a_bend() -> None:
    """Radius 10 m, 2.5 m/s^2 to the side: 5 m/s; from 8 m/s with 2.5 m/s^2 that begins 7.8 m earlier."""
    way, turn = line_route(0.0, 120.0), np.clip((np.arange(121) - 60.0) / 10.0, 0.0, math.pi / 2)
    step = np.stack([np.cos(turn), np.sin(turn)], 1)
    route = replace(way, xy=np.cumsum(step, 0).astype(np.float32), yaw=turn.astype(np.float32))
    speed = np.hypot(*np.diff(schedule(route, 8.0, 8.0, 0.1)[:, :2], axis=0).T) / 0.1
    assert speed[:60].max() == pytest.approx(8.0, abs=0.01)
    assert speed.min() == pytest.approx(5.0, abs=0.1)
    assert 45.0 < np.cumsum(speed * 0.1)[np.flatnonzero(speed < 7.9)[0]] < 58.0
    slow = schedule(route, 0.0, 8.0, 0.1, acceleration=1.0)
    assert np.hypot(*(slow[20, :2] - slow[0, :2])) == pytest.approx(0.5 * 1.0 * 2.0**2, abs=0.15)


@pytest.mark.slow
def test_the_generator_makes_the_training_sets() -> None:
    for name, text in training().items():
        assert (DATA / name).read_text() == text, name


def test_nothing_is_tested_where_drivers_were_trained() -> None:
    trained, beside = load_scenarios("training"), load_scenarios("training-lanes")
    assert {s.town for s in trained} == set(TRAINING_TOWNS)
    assert {s.town for s in beside} == set(LANE_TOWNS)
    assert not {s.town for s in SHIPPED + CHOSEN + UNSELECTED} & {*TRAINING_TOWNS, *LANE_TOWNS}
    assert {s.type for s in trained} == {*PRECRASH, "NaturalJunction"}
    # a class names the scenarios that systems are tested on
    assert all(s.town == "ProvingGround" for kind in PRECRASH for s in load_scenarios(kind))


@pytest.mark.parametrize("name", [s.name for s in SHIPPED])
def test_conformance(name: str) -> None:
    e = episode(name)
    graph, kind = town(e.town), scenario_type(e.scenario.type)
    ego, *actors = e.agents
    assert (ego.model, ego.controller, ego.speed, ego.target_speed) == ("car", Controller.EXTERNAL, 0.0, 8.0)
    assert ego.route is not None
    route = ego.route.xy.astype(float)
    assert 85.0 <= ego.route.length <= kind.max_distance
    assert e.limits.max_distance == kind.max_distance
    assert (ego.route.lane >= 0).all()
    # nobody stands in anybody
    rows = boxes(e)
    for i in range(len(rows)):
        for j in range(i):
            assert obb_distance(rows[i], rows[j]) > 0.0
    # actors are on the road, or within two lane widths of it
    query = LaneQuery(graph)
    xy = rows[1:, :2].astype(np.float32)
    off = query.off_road(xy)
    for agent, is_off in zip(actors, off, strict=True):
        if model(agent.model).max_speed > 4.0 and agent.model != "bicycle":
            assert not is_off, agent.name
        near = np.hypot(
            *(
                graph.xy[np.repeat(graph.kind == LaneType.DRIVING, np.diff(graph.offset))]
                - (agent.pose.x, agent.pose.y)
            ).T
        )
        assert near.min() <= 2 * 3.5 + 0.5, agent.name
    # the trigger is reached on the way, and not at the start
    first = next(a for a in actors if a.phases)
    when = first.phases[0].when
    reference = actors[when.actor]
    assert when.kind == "ego_distance"
    gap = np.hypot(route[:, 0] - reference.pose.x, route[:, 1] - reference.pose.y)
    assert gap[0] > when.value
    assert gap.min() < when.value
    # every moving actor waits for it
    assert all(a.phases[0].when == when for a in actors if a.phases)
    # vehicles on lanes drive with or against the ego as their lane does
    for agent in actors:
        if agent.model in ("suv", "coupe", "compact"):
            lane, s, _, _ = query.nearest(np.array([[agent.pose.x, agent.pose.y]], np.float32))
            yaw = graph.at(int(lane[0]), float(s[0]))[2]
            assert abs(math.remainder(yaw - agent.pose.yaw, 2 * math.pi)) < 0.1


def test_signals_follow_the_plans() -> None:
    expected = {"RedlightRunning": {1, 3}, "UnprotectedLeftTurn": {3}, "RightTurn": {1, 3}, "CrossingNegotiation": {0}}
    for s in SHIPPED:
        forced = {int(v) for v in episode(s.name).signal_override.values()}
        assert forced == expected.get(s.type, set()), s.name
    # the ego of a right turn faces red and its partner green
    e = episode("RightTurn/00")
    graph, route = town(e.town), e.agents[0].route
    assert route is not None
    on_route = np.isin(graph.stop_lane, route.lane)
    own = [int(k) for k in graph.stop_signal[on_route] if int(k) in e.signal_override]
    assert own
    assert all(e.signal_override[k] == SignalState.RED for k in own)


def test_an_ego_that_does_not_react_is_hit_in_all_32() -> None:
    class Follow:
        name, controller = "follow", Controller.FOLLOW

        def reset(self, episodes: object) -> None: ...

        def act(self, view: object) -> np.ndarray:
            raise AssertionError("the world drives it")

    graphs = {"ProvingGround": town("ProvingGround")}
    for speed in (8.0, 9.0, 10.0):
        episodes = [build_episode(replace(s, target_speed=speed), graphs["ProvingGround"], seed=0) for s in SHIPPED]
        ends = {t.key.split("@")[0]: t.end for t in rollout(World(episodes, graphs), Follow())}
        assert {name for name, end in ends.items() if end != "collision"} == set(), f"at {speed} m/s"


def test_routes_differ() -> None:
    for kind in PRECRASH:
        starts = [s.route[0] for s in SHIPPED if s.type == kind]
        for i, a in enumerate(starts):
            assert all(math.hypot(a.x - b.x, a.y - b.y) > 5.0 for b in starts[:i])


@pytest.mark.parametrize("name", [s.name for s in CHOSEN[::5]])
def test_natural_episodes(name: str) -> None:
    e = episode(name)
    graph = town(e.town)
    route = e.agents[0].route
    assert route is not None
    assert 50.0 <= route.length <= 100.0
    assert len({int(j) for j in graph.junction[route.lane] if j >= 0}) == 1
    assert 2 <= sum(a.controller == Controller.AUTOPILOT for a in e.agents[1:]) <= 20
    rows = boxes(e)
    for i in range(1, len(rows)):
        assert (obb_distance(rows[i], rows[:i]) > 0.0).all()
    assert (e.limits.max_steps, e.limits.max_time) == (300, 60.0)
    real = set(np.flatnonzero(~graph.signal_virtual).tolist())
    assert set(e.signal_override) == real
    assert set(e.signal_override.values()) <= {SignalState.GREEN}


def test_turns_are_mixed() -> None:
    """In every town as draws come; few vehicles cross the way of who turns right."""

    def turns(scenarios: list[Scenario]) -> list[int]:
        angles = [math.remainder(s.route[-1].yaw - s.route[0].yaw, 2 * math.pi) for s in scenarios]
        return [sum(a > 0.7 for a in angles), sum(abs(a) <= 0.7 for a in angles), sum(a < -0.7 for a in angles)]

    for name in NATURAL_TOWNS:
        assert min(turns([s for s in UNSELECTED if s.town == name])) >= 10, name
    assert min(turns(list(CHOSEN))[:2]) >= 20
    assert turns(list(CHOSEN))[2] >= 5


def test_repetitions_share_the_route_and_differ_in_traffic() -> None:
    first = CHOSEN[0]
    second = next(s for s in CHOSEN[1:] if s.name.split("/")[1] == first.name.split("/")[1])
    assert first.route == second.route
    assert [a.pose for a in episode(first.name).agents[1:]] != [a.pose for a in episode(second.name).agents[1:]]


def strip(e: Episode) -> list[tuple[object, ...]]:
    return [(a.name, a.model, a.pose, a.target_speed, a.phases, a.route and a.route.xy.tobytes()) for a in e.agents]


@pytest.mark.parametrize("scenario", [SHIPPED[0], SHIPPED[20], UNSELECTED[3]], ids=lambda s: s.name)
def test_episodes_depend_on_scenario_and_seed_alone(scenario: Scenario) -> None:
    graph = town(scenario.town)
    once, again = (build_episode(scenario, graph, seed=5) for _ in range(2))
    assert strip(once) == strip(again)
    assert once.key == again.key
    assert once.key != build_episode(scenario, graph, seed=6).key
    if scenario.type == "NaturalJunction":
        assert strip(once) != strip(build_episode(scenario, graph, seed=6))
    else:
        assert strip(once) == strip(build_episode(scenario, graph, seed=6))

"""The shipped sets: made by the generator, valid on their towns, dangerous and avoidable."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.quick import others_slow

from benchmarks.crossing_traffic import crossings
from benchmarks.make_scenario_sets import (
    CROSSING,
    LANE_TOWNS,
    NATURAL_TOWNS,
    PRECRASH_TOWN,
    TRAINING_TOWNS,
    draws,
    precrash,
    training,
    unselected,
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
from tests.world.worlds import GRAPHS, ego
from tests.world.worlds import episode as line_episode

SHIPPED = load_scenarios("precrash")
NATURAL, UNSELECTED = load_scenarios("natural"), load_scenarios("natural-unselected")


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


@pytest.mark.parametrize("name", others_slow(NATURAL_TOWNS, ["Twinford"]))
def test_the_generator_makes_the_routes_and_draws_of_natural_traffic(name: str) -> None:
    routes = NATURAL_TOWNS[name]
    assert [s for s in UNSELECTED if s.town == name] == unselected({name: routes})
    for scenario in load_scenarios(f"natural-{name.lower()}"):
        assert scenario in draws(town(name), routes, int(scenario.name[-2:]))


def test_vehicles_cross_the_way_in_the_natural_set() -> None:
    """It was chosen by that; the draws that come as they come have far fewer of them."""
    counts = []
    for scenarios in (NATURAL[::12], UNSELECTED[::5]):
        graphs = {s.town: town(s.town) for s in scenarios}
        counts.append(crossings([build_episode(s, graphs[s.town], seed=3) for s in scenarios], graphs))
    assert (counts[0] >= CROSSING).mean() > 0.9
    assert (counts[1] >= CROSSING).mean() < 0.5


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


@pytest.mark.slow
def test_the_generator_makes_the_training_sets() -> None:
    for name, text in training().items():
        assert (DATA / name).read_text() == text, name


def test_nothing_is_tested_where_drivers_were_trained() -> None:
    trained, beside = load_scenarios("training"), load_scenarios("training-lanes")
    assert {s.town for s in trained} == set(TRAINING_TOWNS)
    assert {s.town for s in beside} == set(LANE_TOWNS)
    assert not {s.town for s in SHIPPED + NATURAL + UNSELECTED} & {*TRAINING_TOWNS, *LANE_TOWNS}
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


@pytest.mark.parametrize("name", [s.name for s in NATURAL[::5]])
def test_natural_episodes(name: str) -> None:
    e = episode(name)
    graph = town(e.town)
    route = e.agents[0].route
    assert route is not None
    assert 50.0 <= route.length <= 100.0
    assert len({int(j) for j in graph.junction[route.lane] if j >= 0}) == 1
    assert 2 <= len(e.agents) - 1 <= 18
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
    assert min(turns(list(NATURAL))[:2]) >= 20


def test_repetitions_share_the_route_and_differ_in_traffic() -> None:
    first = NATURAL[0]
    second = next(s for s in NATURAL[1:] if s.name.split("/")[1] == first.name.split("/")[1])
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

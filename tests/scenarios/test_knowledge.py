"""Where the scenario classes put their actors, against numbers worked out by hand on a known crossroads."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import ConfigError, RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import (
    Actor,
    Condition,
    Controller,
    EpisodeAgent,
    Phase,
    Pose,
    Route,
    Scenario,
    SignalPlan,
    SignalState,
)
from ssad.scenarios.dynamic import PRECRASH, SCENARIOS, parameter_box, scenario_type
from ssad.scenarios.dynamic.episode import forced_signals
from ssad.scenarios.dynamic.knowledge._meeting import ego_times, time_to_cover
from ssad.scenarios.dynamic.knowledge._placing import polyline_route
from ssad.world.models import model


def scenario(kind: str, **changes: Any) -> Scenario:
    return replace(Scenario("test", kind, "Crossroads", (Pose(0, 0), Pose(1, 0))), **changes)


def build(s: Scenario, graph: LaneGraph, route: Route, seed: int = 0) -> list[EpisodeAgent]:
    return list(scenario_type(s.type).build(s, graph, route, np.random.default_rng(seed)))


def at(agent: EpisodeAgent) -> tuple[float, float, float]:
    return pytest.approx((agent.pose.x, agent.pose.y, agent.pose.yaw), abs=1e-3)


def test_walker_stands_one_lane_right_of_the_outer_lane_and_faces_the_road(crossroads: LaneGraph, routes: Any) -> None:
    s = scenario("StraightObstacle", trigger=Pose(1.75, -80.0, math.pi / 2))
    walker, blocker = build(s, crossroads, routes.straight)
    # one lane is crossed (the shoulder is narrower than 2 m): 45 + 1.5 m on, one lane width right of x = 5.25
    assert at(walker) == (5.25 + 3.5, -80.0 + 46.5, -math.pi)
    assert at(blocker) == (1.75 + 0.9 * 7.0, -80.0 + 0.9 * 46.5, 0.0)
    assert walker.phases == (Phase(2.5, Condition("ego_distance", 20.0, 0)),)
    assert (walker.model, walker.controller) == ("walker", Controller.SCRIPT)
    assert (blocker.model, blocker.controller, blocker.phases) == ("vending_machine", Controller.NONE, ())


def test_walker_stops_at_the_junction(crossroads: LaneGraph, routes: Any) -> None:
    s = scenario("StraightObstacle", trigger=Pose(1.75, -30.0, math.pi / 2))
    assert build(s, crossroads, routes.straight)[0].pose.y == pytest.approx(-15.0, abs=1e-3)


def test_walker_parameters(crossroads: LaneGraph, routes: Any) -> None:
    values = {
        "lateral": 0.5,
        "yaw": 0.3,
        "start_distance": 40.0,
        "walker_speed": 1.0,
        "trigger_distance": 30.0,
    }
    s = scenario("StraightObstacle", trigger=Pose(5.25, -80.0, math.pi / 2), parameters=values)
    walker, _ = build(s, crossroads, routes.straight_outer)
    assert at(walker) == (5.25 + 1.75, -40.0, -math.pi + 0.3)
    assert walker.phases == (Phase(1.0, Condition("ego_distance", 30.0, 0)),)


def test_cyclist_stands_right_of_the_exit_road_after_a_left_turn(crossroads: LaneGraph, routes: Any) -> None:
    (cyclist,) = build(scenario("TurningObstacle"), crossroads, routes.left)
    # westwards; 8 m on, one lane to the right and so 1 m more, one lane width right of y = 5.25
    assert at(cyclist) == (-15.0 - 9.0, 5.25 + 3.5, -math.pi / 2)
    assert cyclist.phases == (Phase(10.0, Condition("ego_distance", 20.0, 0)),)


def test_leader_and_neighbour(crossroads: LaneGraph, routes: Any) -> None:
    s = scenario("LaneChanging", trigger=Pose(5.25, -80.0, math.pi / 2))
    leader, neighbour = build(s, crossroads, routes.straight_outer)
    assert at(leader) == (5.25, -45.0, math.pi / 2)
    assert at(neighbour) == (1.75, -44.0, math.pi / 2)
    start = Phase(12.0, Condition("ego_distance", 35.0, 0))
    assert leader.phases == (start, Phase(2.0, Condition("travelled", 5.0)))
    assert neighbour.phases == (start,)
    assert leader.route is neighbour.route is None


def test_parked_and_oncoming_car(crossroads: LaneGraph, routes: Any) -> None:
    s = scenario("VehiclePassing", trigger=Pose(1.75, -84.0, math.pi / 2), parameters={"distance": 40.0, "gap": 25.0})
    parked, oncoming = build(s, crossroads, routes.straight)
    assert at(parked) == (1.75, -44.0, math.pi / 2)
    assert at(oncoming) == (-1.75, -19.0, -math.pi / 2)
    assert parked.controller == Controller.NONE
    assert oncoming.phases == (Phase(8.0, Condition("ego_distance", 45.0, 0)),)


def test_a_missing_left_lane_is_an_error(crossroads: LaneGraph, routes: Any) -> None:
    graph = replace(crossroads, left=np.full(crossroads.lanes, -1, np.int32))
    for kind in ("LaneChanging", "VehiclePassing"):
        with pytest.raises(RouteError, match="needs a lane to the left"):
            build(scenario(kind), graph, routes.straight)


JUNCTION = {
    "RedlightRunning": ("straight", 10.0, 35.0, 2, True),
    "UnprotectedLeftTurn": ("left", 12.0, 45.0, 1, False),
    "RightTurn": ("right", 12.0, 35.0, 2, True),
    "CrossingNegotiation": ("straight", 10.0, 35.0, 2, True),
}


@pytest.mark.parametrize("kind", JUNCTION)
def test_a_given_place_is_kept(kind: str, crossroads: LaneGraph, routes: Any) -> None:
    way, speed, trigger, _, waits = JUNCTION[kind]
    s = scenario(kind, placements=(Pose(-20.0, -1.75, 0.0),), parameters={"longitudinal": 2.0})
    (car,) = build(s, crossroads, getattr(routes, way))
    assert at(car) == (-18.0, -1.75, 0.0)
    assert car.route is None
    expected = (Phase(0.0 if waits else speed, Condition("ego_distance", trigger, 0)),)
    assert car.phases == expected + ((Phase(speed, Condition("ego_speed", 0.5)),) if waits else ())


@pytest.mark.parametrize("kind", JUNCTION)
def test_a_computed_place_lets_the_car_meet_the_ego(kind: str, crossroads: LaneGraph, routes: Any) -> None:
    way, speed, trigger, arm, _ = JUNCTION[kind]
    route: Route = getattr(routes, way)
    (car,) = build(scenario(kind), crossroads, route)
    heading = {1: -math.pi / 2, 2: 0.0}[arm]
    assert car.pose.yaw == pytest.approx(heading, abs=1e-3)
    ahead = np.array([math.cos(heading), math.sin(heading)])
    start = np.array([car.pose.x, car.pose.y])
    assert start @ ahead < -15.0  # before the junction
    # the ego along its route, the car at full throttle from the moment it is triggered
    times = ego_times(route)
    xy = route.xy.astype(float)
    triggered = int(np.flatnonzero(np.hypot(*(xy - start).T) < trigger)[0])
    assert triggered > 10
    gaps = []
    for i in range(triggered, len(xy)):
        t = float(times[i] - times[triggered])
        ramp = speed / model("coupe").max_accel
        gone = 0.5 * model("coupe").max_accel * min(t, ramp) ** 2 + speed * max(t - ramp, 0.0)
        gaps.append(float(np.hypot(*(xy[i] - start - gone * ahead))))
    assert min(gaps) < 2.0


def test_no_approach_is_an_error(crossroads: LaneGraph, routes: Any) -> None:
    before = replace(
        routes.straight,
        **{name: getattr(routes.straight, name)[:40] for name in ("xy", "yaw", "lane", "speed_limit", "width")},
    )
    with pytest.raises(RouteError, match="passes no junction"):
        build(scenario("RedlightRunning"), crossroads, before)


def test_a_trigger_off_the_route_is_an_error(crossroads: LaneGraph, routes: Any) -> None:
    with pytest.raises(RouteError, match="off the route"):
        build(scenario("StraightObstacle", trigger=Pose(40.0, -40.0)), crossroads, routes.straight)


def test_time_to_cover_is_that_of_uniform_acceleration() -> None:
    assert time_to_cover(8.0, 10.0, 4.0) == pytest.approx(2.0)  # still accelerating
    assert time_to_cover(12.5 + 20.0, 10.0, 4.0) == pytest.approx(2.5 + 2.0)


def test_the_assumed_ego_keeps_9_m_s_and_slows_down_for_bends() -> None:
    straight = polyline_route(np.array([[0.0, 0.0], [90.0, 0.0]]))
    assert ego_times(straight)[-1] == pytest.approx(10.0)
    angle = np.linspace(0.0, 3.0, 400)
    circle = polyline_route(10.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    assert ego_times(circle)[20] - ego_times(circle)[10] == pytest.approx(10.0 / 5.0, rel=0.02)  # sqrt(2.5 * 10)


def test_signals_of_the_ego_and_of_the_others(crossroads: LaneGraph, routes: Any) -> None:
    red, green, off = SignalState.RED, SignalState.GREEN, SignalState.OFF
    assert forced_signals(crossroads, routes.straight, scenario_type("RedlightRunning").signals) == {
        0: red, 1: red, 2: red, 3: green,
    }  # fmt: skip
    assert forced_signals(crossroads, routes.right, scenario_type("RightTurn").signals)[3] == red
    assert set(forced_signals(crossroads, routes.left, SignalPlan("off", "off")).values()) == {off}
    assert forced_signals(crossroads, routes.left, SignalPlan()) == {}
    # virtual signals stay off where all the signals that a map has turn green
    green_plan = scenario_type("NaturalJunction").signals
    assert forced_signals(crossroads, routes.straight, green_plan, whole_town=True) == {}
    real = replace(crossroads, signal_virtual=np.zeros(4, bool))
    assert set(forced_signals(real, routes.straight, green_plan, whole_town=True).values()) == {green}


def test_custom_actors_are_taken_as_written(crossroads: LaneGraph, routes: Any) -> None:
    phases = (Phase(3.0, Condition("time", 2.0)),)
    actors = (
        Actor("dog", "walker", Pose(4.0, -50.0, 1.0), phases, path=((4.0, -50.0), (4.0, -45.0), (0.0, -45.0))),
        Actor("cone", "cone", Pose(2.0, -40.0)),
    )
    dog, cone = build(scenario("Custom", actors=actors), crossroads, routes.straight)
    assert (dog.pose, dog.phases, dog.controller) == (Pose(4.0, -50.0, 1.0), phases, Controller.SCRIPT)
    assert dog.route is not None
    assert dog.route.length == pytest.approx(9.0)
    assert (cone.controller, cone.route) == (Controller.NONE, None)


def test_a_path_is_sampled_every_metre() -> None:
    route = polyline_route(np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 0.0], [3.0, 2.5]]))
    assert np.allclose(route.xy, [[0, 0], [1, 0], [2, 0], [3, 0], [3, 1], [3, 2]])
    assert np.allclose(route.yaw, [0, 0, 0, np.pi / 2, np.pi / 2, np.pi / 2])
    with pytest.raises(RouteError, match="too short"):
        polyline_route(np.array([[0.0, 0.0], [0.5, 0.0]]))


def test_parameter_boxes_hold_safebench_defaults_inside_their_ranges() -> None:
    assert len(PRECRASH) == 8
    for name in SCENARIOS:
        for parameter in parameter_box(name).values():
            assert parameter.low <= parameter.default <= parameter.high
    assert parameter_box("RedlightRunning")["speed"].default == 10.0
    with pytest.raises(ConfigError, match="outside"):
        scenario_type("RightTurn").values({"speed": 20.0})
    with pytest.raises(ConfigError, match="no such parameter"):
        scenario_type("RightTurn").values({"sped": 12.0})

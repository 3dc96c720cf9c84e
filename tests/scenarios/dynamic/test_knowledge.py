"""Where the scenario classes put their actors, against numbers worked out by hand on a known crossroads."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import ConfigError, RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import (
    Actor,
    Controller,
    EpisodeAgent,
    LaneType,
    Phase,
    PhaseTrigger,
    Pose,
    Route,
    Scenario,
    SignalPlan,
    SignalState,
)
from ssad.interchange.scenario_parts import plan_of
from ssad.scenarios.dynamic import (
    PRECRASH,
    SCENARIOS,
    Parameter,
    ScenarioType,
    build_episode,
    load_scenarios,
    parameter_box,
    scenario_type,
)
from ssad.scenarios.dynamic.episode import forced_signals, near_side_turns
from ssad.scenarios.dynamic.knowledge._junction import FROM_LEFT, FROM_RIGHT, ONCOMING
from ssad.scenarios.dynamic.knowledge._meeting import ego_times, meeting_place, time_to_cover
from ssad.scenarios.dynamic.knowledge._placing import (
    LanePosition,
    adjacent_place,
    bending_route,
    junction_span,
    lane_path,
    make_drive_phase,
    place_ahead,
    polyline_route,
    project,
    scripted_agent,
    standing_agent,
    straightest_successor,
    to_outermost,
    trigger_index,
    trigger_place,
    turn_of,
    width_at,
)
from ssad.world.models import model
from ssad.world.roads import load_town, route_along

from .conftest import lane_of


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
    assert walker.phases == (Phase(2.5, PhaseTrigger("ego_distance", 20.0, 0)),)
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
    assert walker.phases == (Phase(1.0, PhaseTrigger("ego_distance", 30.0, 0)),)


def test_cyclist_stands_right_of_the_exit_road_after_a_left_turn(crossroads: LaneGraph, routes: Any) -> None:
    (cyclist,) = build(scenario("TurningObstacle"), crossroads, routes.left)
    # westwards; 8 m on, one lane to the right and so 1 m more, one lane width right of y = 5.25
    assert at(cyclist) == (-15.0 - 9.0, 5.25 + 3.5, -math.pi / 2)
    assert cyclist.phases == (Phase(10.0, PhaseTrigger("ego_distance", 20.0, 0)),)


def test_leader_and_neighbour(crossroads: LaneGraph, routes: Any) -> None:
    s = scenario("LaneChanging", trigger=Pose(5.25, -80.0, math.pi / 2))
    leader, neighbour = build(s, crossroads, routes.straight_outer)
    assert at(leader) == (5.25, -45.0, math.pi / 2)
    assert at(neighbour) == (1.75, -44.0, math.pi / 2)
    start = Phase(12.0, PhaseTrigger("ego_distance", 35.0, 0))
    assert leader.phases == (start, Phase(2.0, PhaseTrigger("travelled", 5.0)))
    assert neighbour.phases == (start,)
    assert leader.route is neighbour.route is None


def test_parked_and_oncoming_car(crossroads: LaneGraph, routes: Any) -> None:
    s = scenario("VehiclePassing", trigger=Pose(1.75, -84.0, math.pi / 2), parameters={"distance": 40.0, "gap": 25.0})
    parked, oncoming = build(s, crossroads, routes.straight)
    assert at(parked) == (1.75, -44.0, math.pi / 2)
    assert at(oncoming) == (-1.75, -19.0, -math.pi / 2)
    assert parked.controller == Controller.NONE
    assert oncoming.phases == (Phase(8.0, PhaseTrigger("ego_distance", 45.0, 0)),)


def test_a_missing_left_lane_is_an_error(crossroads: LaneGraph, routes: Any) -> None:
    graph = replace(crossroads, left=np.full(crossroads.lane_count, -1, np.int32))
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
    expected = (Phase(0.0 if waits else speed, PhaseTrigger("ego_distance", trigger, 0)),)
    assert car.phases == expected + ((Phase(speed, PhaseTrigger("ego_speed", 0.5)),) if waits else ())


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
    assert time_to_cover(0.5, 10.0, 4.0) == pytest.approx(0.5)
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
        0: red,
        1: red,
        2: red,
        3: green,
    }
    assert forced_signals(crossroads, routes.right, scenario_type("RightTurn").signals)[3] == red
    assert set(forced_signals(crossroads, routes.left, SignalPlan("off", "off")).values()) == {off}
    assert forced_signals(crossroads, routes.left, SignalPlan()) == {}
    # virtual signals stay off where all the signals that a map has turn green
    green_plan = scenario_type("NaturalJunction").signals
    assert forced_signals(crossroads, routes.straight, green_plan, whole_town=True) == {}
    real = replace(crossroads, signal_virtual=np.zeros(4, bool))
    assert set(forced_signals(real, routes.straight, green_plan, whole_town=True).values()) == {green}


def two_junctions(graph: LaneGraph, *, first_turns: bool) -> Route:
    """A route straight on at one junction, or turning right there, and right at the next."""
    turns = {}
    for lane in np.flatnonzero((graph.junction >= 0) & (graph.kind == LaneType.DRIVING)).tolist():
        part = graph.points(lane)
        turns[lane] = float(wrap_angle(graph.yaw[part.stop - 1] - graph.yaw[part.start]))
    return next(
        candidate
        for first, angle in turns.items()
        if (angle < -1.0 if first_turns else abs(angle) < 0.2)
        for between in graph.successors(first).tolist()
        for right in graph.successors(between).tolist()
        if turns.get(right, 0.0) < -1.0 and graph.junction[right] != graph.junction[first]
        for candidate in [
            route_along(
                graph,
                [
                    Pose(*graph.at(int(graph.predecessors(first)[0]), 5.0)[:3]),
                    Pose(*graph.at(between, 0.5 * float(graph.length[between]))[:3]),
                    Pose(*graph.at(int(graph.successors(right)[0]), 5.0)[:3]),
                ],
            )
        ]
    )


def forced_junctions(graph: LaneGraph, route: Route, plan: SignalPlan, trigger: Pose | None = None) -> set[int]:
    return {int(graph.signal_junction[signal]) for signal in forced_signals(graph, route, plan, trigger=trigger)}


def test_red_is_forced_only_where_the_ego_turns_to_the_near_side() -> None:
    graph = load_town("Twinford")
    route = two_junctions(graph, first_turns=False)
    on_route = np.unique(graph.junction[route.lane[route.lane >= 0]])
    turned_at = near_side_turns(graph, route)
    assert len(turned_at) == 1
    assert len(on_route[on_route >= 0]) == 2
    plan = SignalPlan("red", "green")
    states = forced_signals(graph, route, plan)
    assert {int(graph.signal_junction[signal]) for signal in states} == turned_at
    assert sorted(set(states.values())) == sorted({SignalState.RED, SignalState.GREEN})
    mirrored = replace(graph, left_hand=np.array([True]))
    assert near_side_turns(mirrored, route) == set()
    assert forced_junctions(mirrored, route, plan) == set(on_route.tolist()) - {-1}
    elsewhere = forced_signals(graph, route, replace(plan, elsewhere="green"))
    assert elsewhere.items() >= states.items()
    added = {signal: state for signal, state in elsewhere.items() if signal not in states}
    assert {int(graph.signal_junction[signal]) for signal in added} == set(on_route.tolist()) - {-1} - turned_at
    assert set(added.values()) == {SignalState.RED, SignalState.GREEN}
    assert plan_of(graph, route, elsewhere, 60.0) == replace(plan, elsewhere="green")


def test_of_two_turns_red_is_forced_at_the_one_that_follows_the_trigger() -> None:
    graph = load_town("Twinford")
    route = two_junctions(graph, first_turns=True)
    junction = np.where(route.lane >= 0, graph.junction[np.maximum(route.lane, 0)], -1)
    first, second = list(dict.fromkeys(junction[junction >= 0].tolist()))
    plan = SignalPlan("red", "green")
    assert forced_junctions(graph, route, plan) == {first, second}
    last_of_first = int(np.flatnonzero(junction == first)[-1])
    before, between = Pose(*route.xy[0].tolist()), Pose(*route.xy[last_of_first + 3].tolist())
    assert forced_junctions(graph, route, plan, before) == {first}
    assert forced_junctions(graph, route, plan, between) == {second}
    assert forced_junctions(graph, route, plan, Pose(*route.xy[-1].tolist())) == {first, second}


def test_a_town_that_forbids_turns_on_red_has_no_right_turn_on_red() -> None:
    scenario = load_scenarios("RightTurn/00")[0]
    town = replace(load_town(scenario.town), turn_on_red=np.array([False]))
    with pytest.raises(RouteError, match="turns on red, which town"):
        build_episode(scenario, town, seed=0)


def test_custom_actors_are_taken_as_written(crossroads: LaneGraph, routes: Any) -> None:
    phases = (Phase(3.0, PhaseTrigger("time", 2.0)),)
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


# ---------------------------------------------------------------- where two cars meet


def turned(route: Route, angle: float, index: slice = slice(None)) -> Route:
    """The route with other headings at some of its points; what an ego needs for it is the same if all are turned."""
    yaw = route.yaw.copy()
    yaw[index] += np.float32(angle)
    return replace(route, yaw=yaw)


def meet(graph: LaneGraph, route: Route, *sides: float) -> LanePosition:
    return meeting_place(
        graph, scenario("RedlightRunning"), route, sides=sides, trigger_distance=35.0, speed=10.0, body="coupe"
    )


ARM_OF_SIDE = {FROM_LEFT: 12, FROM_RIGHT: 10, ONCOMING: 11}


@pytest.mark.parametrize("side", ARM_OF_SIDE)
def test_an_approach_may_be_40_degrees_off_its_side(side: float, crossroads: LaneGraph, routes: Any) -> None:
    # oncoming traffic crosses the path of a left turn alone
    route = routes.left if side == ONCOMING else routes.straight
    for angle in (-39.0, 39.0):
        place = meet(crossroads, turned(route, math.radians(angle)), side)
        assert crossroads.road[place.lane] == ARM_OF_SIDE[side]
    for angle in (-41.0, 41.0):
        with pytest.raises(RouteError, match="no lane into junction 0 crosses the ego's route; give placements"):
            meet(crossroads, turned(route, math.radians(angle)), side)


def test_the_side_is_seen_from_just_before_the_junction(crossroads: LaneGraph, routes: Any) -> None:
    enter = 70
    assert crossroads.junction[routes.straight.lane[enter - 1 : enter + 1]].tolist() == [-1, 0]
    with pytest.raises(RouteError):
        meet(crossroads, turned(routes.straight, 1.0, slice(enter - 1, enter)), FROM_LEFT)
    for near in (enter - 2, enter):
        assert meet(crossroads, turned(routes.straight, 1.0, slice(near, near + 1)), FROM_LEFT)


def test_the_first_side_with_an_approach_wins(crossroads: LaneGraph, routes: Any) -> None:
    first, second = (meet(crossroads, routes.straight, *sides) for sides in ((FROM_LEFT, FROM_RIGHT), (FROM_RIGHT,)))
    assert (crossroads.road[first.lane], crossroads.road[second.lane]) == (12, 10)
    assert meet(crossroads, routes.straight, ONCOMING, FROM_RIGHT) == second


def test_only_cars_that_go_straight_on_are_met(crossroads: LaneGraph, routes: Any) -> None:
    through = np.flatnonzero((crossroads.junction == 0) & (crossroads.road == 122))

    def bent(angle: float) -> LaneGraph:
        yaw = crossroads.yaw.copy()
        yaw[crossroads.offset[through + 1] - 1] += np.float32(angle)
        return replace(crossroads, yaw=yaw)

    assert meet(bent(math.radians(34.5)), routes.straight, FROM_LEFT) == meet(crossroads, routes.straight, FROM_LEFT)
    with pytest.raises(RouteError, match="crosses"):
        meet(bent(math.radians(35.5)), routes.straight, FROM_LEFT)


@pytest.mark.parametrize(("speed", "trigger"), [(10.0, 35.0), (5.0, 35.0), (15.0, 50.0), (8.0, 25.0)])
def test_of_all_places_the_one_with_the_least_wait_is_taken(
    speed: float, trigger: float, crossroads: LaneGraph, routes: Any
) -> None:
    route = routes.straight
    found = meeting_place(
        crossroads,
        scenario("RedlightRunning"),
        route,
        sides=(FROM_LEFT,),
        trigger_distance=trigger,
        speed=speed,
        body="coupe",
    )
    # the car comes along y = -1.75 or -5.25 and the ego along x = 1.75: they meet at (1.75, y)
    times, xy = ego_times(route), route.xy.astype(float)

    def wait(place: LanePosition) -> float:
        x, y = crossroads.at(place.lane, place.s)[:2]
        off = np.hypot(xy[:, 0] - x, xy[:, 1] - y)
        start = int(np.argmax(off < trigger))
        if start == 0:  # never, or from the beginning
            return math.inf
        conflict = int(np.argmin(np.abs(xy[:, 1] - y)))
        return abs(time_to_cover(1.75 - x, speed, model("coupe").max_accel) - float(times[conflict] - times[start]))

    lanes = [lane_of(crossroads, 12, k) for k in (1, 2)]
    every = [wait(LanePosition(lane, s)) for lane in lanes for s in np.arange(70.0, 99.5, 0.5)]
    # points of the route are 1 m apart, so the place where they meet is known to half a metre
    assert wait(found) < min(every) + 0.12


def test_signals_of_a_junction_that_the_route_does_not_pass(crossroads: LaneGraph, routes: Any) -> None:
    before = Route(
        **{name: getattr(routes.straight, name)[:40] for name in ("xy", "yaw", "lane", "speed_limit", "width")}
    )
    plan = SignalPlan("red", "green")
    assert forced_signals(crossroads, before, plan) == {}
    real = replace(crossroads, signal_virtual=np.array([False, False, True, False]))
    green = dict.fromkeys((0, 1, 3), SignalState.GREEN)
    assert forced_signals(real, before, plan, whole_town=True) == green
    assert forced_signals(real, routes.straight, plan, whole_town=True) == green | {3: SignalState.RED}
    lost = replace(routes.straight, lane=np.where(np.arange(len(routes.straight.lane)) < 40, -1, routes.straight.lane))
    assert forced_signals(crossroads, lost, plan) == forced_signals(crossroads, routes.straight, plan)


# ---------------------------------------------------------------- arithmetic on lanes


def test_lanes_of_the_ego_from_the_south(crossroads: LaneGraph) -> None:
    inner, outer = lane_of(crossroads, 13, 1), lane_of(crossroads, 13, 2)
    assert inner == 0
    assert adjacent_place(crossroads, LanePosition(outer, 30.0), "left") == LanePosition(inner, pytest.approx(30.0))
    assert adjacent_place(crossroads, LanePosition(inner, 30.0), "right") == LanePosition(outer, pytest.approx(30.0))
    opposite = adjacent_place(crossroads, LanePosition(inner, 30.0), "left")
    assert opposite == LanePosition(lane_of(crossroads, 13, -1), pytest.approx(70.0))
    assert adjacent_place(crossroads, LanePosition(lane_of(crossroads, 13, 3), 30.0), "right") is None
    assert width_at(crossroads, LanePosition(inner, 30.0)) == 3.5


@pytest.mark.parametrize(("at", "s"), [((2.0, -85.25), 29.75), ((9.0, -200.0), 0.0), ((0.0, 40.0), 100.0)])
def test_a_point_is_projected_onto_its_lane(at: tuple[float, float], s: float, crossroads: LaneGraph) -> None:
    assert project(crossroads, 0, *at) == LanePosition(0, pytest.approx(s, abs=1e-4))


def test_a_point_is_projected_onto_a_bend(crossroads: LaneGraph) -> None:
    lane = lane_of(crossroads, 133, -1)
    for s in (0.3, 7.0, float(crossroads.length[lane]) - 0.2):
        x, y, yaw, _ = crossroads.at(lane, s)
        aside = project(crossroads, lane, x - 0.1 * math.sin(yaw), y + 0.1 * math.cos(yaw))
        assert aside.s == pytest.approx(s, abs=0.05)


def test_turns_at_the_crossroads(crossroads: LaneGraph) -> None:
    turns = {road: turn_of(crossroads, lane_of(crossroads, road, k)) for road, k in ((132, -1), (133, -1), (131, -2))}
    assert turns == pytest.approx({132: 0.0, 133: math.pi / 2, 131: -math.pi / 2}, abs=0.12)
    assert straightest_successor(crossroads, 0) == lane_of(crossroads, 132, -1)
    assert straightest_successor(crossroads, lane_of(crossroads, 11, -1)) is None
    # where no lane for cars goes on, another one does
    kind = crossroads.kind.copy()
    kind[lane_of(crossroads, 132, -1)] = LaneType.BIKING
    assert straightest_successor(replace(crossroads, kind=kind), 0) == lane_of(crossroads, 133, -1)
    kind[lane_of(crossroads, 133, -1)] = LaneType.BIKING
    assert straightest_successor(replace(crossroads, kind=kind), 0) == lane_of(crossroads, 132, -1)


def test_places_ahead(crossroads: LaneGraph) -> None:
    inside, after = lane_of(crossroads, 132, -1), lane_of(crossroads, 11, -1)
    assert place_ahead(crossroads, LanePosition(0, 60.0), 40.0) == LanePosition(0, 100.0)
    assert place_ahead(crossroads, LanePosition(0, 60.0), 45.0) == LanePosition(inside, 5.0)
    assert place_ahead(crossroads, LanePosition(0, 60.0), 75.0) == LanePosition(after, 5.0)
    assert place_ahead(crossroads, LanePosition(0, 60.0), 500.0) == LanePosition(after, 100.0)  # the end of the road
    assert place_ahead(crossroads, LanePosition(0, 60.0), 75.0, stop_at_junction=True) == LanePosition(0, 100.0)
    # one who is in the junction leaves it
    assert place_ahead(crossroads, LanePosition(inside, 20.0), 15.0, stop_at_junction=True) == LanePosition(after, 5.0)


def test_a_lanes_path_goes_on_over_the_lanes_that_follow(crossroads: LaneGraph) -> None:
    for start, distance in ((60.25, 20.0), (60.25, 60.0), (99.96, 110.0)):
        path = lane_path(crossroads, LanePosition(0, start), distance)
        assert np.allclose(path[:, 0], 1.75)
        assert path[0, 1] == pytest.approx(start - 115.0, abs=1e-4)
        steps = np.diff(path[:, 1])
        assert ((steps >= 0.0) & (steps <= 1.05)).all()
        # the last point is the last one of the lane not beyond the distance; where lanes join, one point more or less
        assert start - 115.0 + distance - 1.1 < path[-1, 1] <= start - 115.0 + distance + 1e-3
    assert lane_path(crossroads, LanePosition(0, 60.0), 500.0)[-1, 1] == pytest.approx(115.0)  # the end of the road


def test_only_a_path_that_bends_is_followed(crossroads: LaneGraph, routes: Any) -> None:
    assert bending_route(crossroads, LanePosition(0, 20.0)) is None
    bend = bending_route(crossroads, LanePosition(lane_of(crossroads, 133, -1), 0.0))
    assert bend is not None
    assert np.allclose(bend.xy[0], (1.75, -15.0), atol=1e-3)
    assert np.allclose(bend.xy[-1], (-115.0, 1.75), atol=1.1)

    def straying(by: float) -> LaneGraph:
        xy = crossroads.xy.copy()
        xy[80, 0] += by
        return replace(crossroads, xy=xy)

    for by, bends in ((0.25, False), (-0.25, False), (0.35, True), (-0.35, True)):
        assert (bending_route(straying(by), LanePosition(0, 20.0)) is not None) == bends
    assert bending_route(crossroads, LanePosition(lane_of(crossroads, 11, -1), 99.5)) is None  # no road is left to bend


def test_a_path_off_the_lane_graph() -> None:
    route = polyline_route(np.array([[0.0, 0.0], [1.0, 0.0]]))  # as short as it may be
    assert np.allclose(route.xy, [[0, 0], [1, 0]])
    assert route.lane.tolist() == [-1, -1]
    assert (route.speed_limit.tolist(), route.width.tolist(), route.spacing) == ([50.0] * 2, [3.5] * 2, 1.0)
    wide = polyline_route(np.array([[0.0, 0.0], [5.0, 0.0]]), spacing=2.0)
    assert np.allclose(wide.xy[:, 0], [0, 2, 4])
    with pytest.raises(RouteError, match=r"a path of 0\.00 m is too short; give it at least 1 m"):
        polyline_route(np.array([[2.0, 2.0], [2.0, 2.0]]))


def test_the_outermost_lane(crossroads: LaneGraph) -> None:
    both, inner, outer = (LaneType.DRIVING, LaneType.SHOULDER), 0, lane_of(crossroads, 13, 2)
    place, crossed = to_outermost(crossroads, LanePosition(inner, 30.0), kinds=both)
    assert (place, crossed) == (LanePosition(outer, pytest.approx(30.0)), 1)
    assert to_outermost(crossroads, LanePosition(inner, 30.0), kinds=(LaneType.SHOULDER,)) == (
        LanePosition(inner, 30.0),
        0,
    )

    def with_shoulders(width: float) -> LaneGraph:
        wide = np.repeat(crossroads.kind == LaneType.SHOULDER, np.diff(crossroads.offset))
        return replace(crossroads, width=np.where(wide, np.float32(width), crossroads.width))

    # a shoulder of up to 2 m is none, a wider one is where cars park
    assert to_outermost(with_shoulders(2.0), LanePosition(inner, 30.0), kinds=both)[1] == 1
    place, crossed = to_outermost(with_shoulders(2.1), LanePosition(inner, 30.0), kinds=both)
    assert (place.lane, crossed) == (lane_of(crossroads, 13, 3), 2)
    assert to_outermost(with_shoulders(2.1), LanePosition(inner, 30.0), kinds=(LaneType.DRIVING,))[1] == 1


# ---------------------------------------------------------------- the trigger and the junction


def test_the_trigger_is_a_point_of_the_route(crossroads: LaneGraph, routes: Any) -> None:
    route: Route = routes.straight
    assert trigger_index(scenario("RightTurn"), route) == 30
    short = Route(**{name: getattr(route, name)[:20] for name in ("xy", "yaw", "lane", "speed_limit", "width")})
    assert trigger_index(scenario("RightTurn"), short) == 19
    assert trigger_index(scenario("RightTurn"), replace(route, spacing=2.0)) == 15
    near = scenario("RightTurn", trigger=Pose(1.75 + 4.9, -80.0))
    assert trigger_index(near, route) == 5
    with pytest.raises(RouteError, match=r"the trigger is 5\.1 m off the route; put it on the route"):
        trigger_index(scenario("RightTurn", trigger=Pose(1.75 + 5.1, -80.0)), route)
    place = trigger_place(crossroads, near, route)
    assert place == LanePosition(0, pytest.approx(35.0, abs=1e-3))
    lost = replace(route, lane=np.full_like(route.lane, -1))
    with pytest.raises(RouteError, match="no lane under the route at 5 m"):
        trigger_place(crossroads, near, lost)


def test_the_junction_after_the_trigger(crossroads: LaneGraph, routes: Any) -> None:
    route: Route = routes.straight
    assert junction_span(crossroads, scenario("RightTurn"), route) == (70, 100)
    # a trigger in the junction: the rest of it; one behind it: none
    inside = scenario("RightTurn", trigger=Pose(1.75, 5.0))
    assert junction_span(crossroads, inside, route) == (90, 100)
    with pytest.raises(RouteError, match="passes no junction after its trigger"):
        junction_span(crossroads, scenario("RightTurn", trigger=Pose(1.75, 25.0)), route)
    ends = Route(**{name: getattr(route, name)[:80] for name in ("xy", "yaw", "lane", "speed_limit", "width")})
    assert junction_span(crossroads, scenario("RightTurn"), ends) == (70, 79)
    # points off the lane graph are in no junction
    lane = route.lane.copy()
    lane[:75] = lane[90:] = -1
    assert junction_span(crossroads, scenario("RightTurn"), replace(route, lane=lane)) == (75, 90)


# ---------------------------------------------------------------- the actors


def test_a_car_in_a_junction_takes_its_shift_along_the_lane(crossroads: LaneGraph, routes: Any) -> None:
    (car,) = build(scenario("RedlightRunning"), crossroads, routes.straight)
    (further,) = build(scenario("RedlightRunning", parameters={"longitudinal": 3.5}), crossroads, routes.straight)
    assert (further.pose.x - car.pose.x, further.pose.y) == pytest.approx((3.5, car.pose.y), abs=1e-3)


def test_the_cyclists_parameters(crossroads: LaneGraph, routes: Any) -> None:
    values = {"yaw": 0.4, "longitudinal": -2.0, "lateral": 1.5, "exit_distance": 12.0, "speed": 5.0}
    (cyclist,) = build(scenario("TurningObstacle", parameters=values), crossroads, routes.left)
    # 12 m on and 1 m for the lane crossed, 2 m back; 1.5 lane widths right of y = 5.25
    assert at(cyclist) == (-15.0 - 11.0, 5.25 + 1.5 * 3.5, -math.pi / 2 + 0.4)
    assert (cyclist.model, cyclist.phases[0].speed) == ("bicycle", 5.0)
    # an ego that turns from one outer lane into another crosses none
    (cyclist,) = build(scenario("TurningObstacle"), crossroads, routes.right)
    assert at(cyclist) == (15.0 + 8.0, -5.25 - 3.5, math.pi / 2)


def test_a_walker_whose_road_begins_in_a_junction_leaves_it(crossroads: LaneGraph, routes: Any) -> None:
    s = scenario("StraightObstacle", trigger=Pose(5.25, -10.0, math.pi / 2))
    walker, _ = build(s, crossroads, routes.straight_outer)
    assert walker.pose.y == pytest.approx(-10.0 + 45.0, abs=1e-3)


def test_agents_that_wait_and_agents_that_stand(crossroads: LaneGraph) -> None:
    pose = Pose(1.0, 2.0, 0.5)
    agent = scripted_agent(
        "a", "car", pose, [make_drive_phase(3.0, 20.0), make_drive_phase(7.0, 20.0), make_drive_phase(5.0, 20.0)]
    )
    assert (agent.target_speed, agent.speed, agent.pose) == (7.0, 0.0, pose)
    still = standing_agent("b", "cone", pose)
    assert (still.target_speed, still.controller, still.phases) == (0.0, Controller.NONE, ())


def test_only_actors_with_phases_and_an_engine_move(crossroads: LaneGraph, routes: Any) -> None:
    phases = (Phase(3.0), Phase(1.0))
    actors = (
        Actor("car", "car", Pose(0, 0), phases),
        Actor("parked", "car", Pose(9, 0)),
        Actor("cone", "cone", Pose(0, 9), phases),
    )
    car, parked, cone = build(scenario("Custom", actors=actors), crossroads, routes.straight)
    assert [a.controller for a in (car, parked, cone)] == [Controller.SCRIPT, Controller.NONE, Controller.NONE]
    assert [a.target_speed for a in (car, parked, cone)] == [3.0, 0.0, 3.0]


def test_what_a_parameter_allows() -> None:
    number = Parameter("length", 1.0, 3.0, 2.0, "m", "a length", 2.0)
    assert number.problem(1.0) is number.problem(3.0) is None
    assert number.problem(0.9) == "0.9 is outside 1 to 3 m (a length)"
    assert number.problem(math.nan) == "nan is outside 1 to 3 m (a length)"
    without_end = Parameter("count", 0.0, math.inf, 0.0, "", "a count")
    assert without_end.problem(1e9) is None
    assert without_end.problem(math.inf) == "inf is outside 0 to inf (a count)"
    assert Parameter("a", 1.0, 1.0, 1.0, "m", "fixed").spread == 0.0
    for default in (0.9, 3.1):
        with pytest.raises(ValueError, match=r"default .* outside \[1\.0, 3\.0\]"):
            Parameter("length", 1.0, 3.0, default, "m", "")
    with pytest.raises(ValueError, match=r"spread 2\.1 outside \[0, 2\.0\]"):
        Parameter("length", 1.0, 3.0, 2.0, "m", "", 2.1)


def test_a_class_has_its_own_parameters_and_those_of_the_start() -> None:
    kind = ScenarioType("A", "a", "a", lambda s, g, r, n: [], (Parameter("height", 1.0, 9.0, 5.0, "m", ""),))
    assert list(kind.box) == ["height", "ego_speed", "ego_longitudinal", "ego_lateral", "ego_heading"]
    assert kind.values({"height": 2}) == {
        "height": 2.0,
        "ego_speed": 0.0,
        "ego_longitudinal": 0.0,
        "ego_lateral": 0.0,
        "ego_heading": 0.0,
    }
    assert (kind.max_distance, kind.whole_town, kind.traffic) == (1.0e9, False, None)
    assert {name: scenario_type(name).max_distance for name in SCENARIOS} == {
        "StraightObstacle": 150.0,
        "TurningObstacle": 180.0,
        "LaneChanging": 200.0,
        "VehiclePassing": 200.0,
        "RedlightRunning": 150.0,
        "UnprotectedLeftTurn": 150.0,
        "RightTurn": 150.0,
        "CrossingNegotiation": 150.0,
        "NaturalJunction": 1.0e9,
        "FreeDrive": 1.0e9,
    }

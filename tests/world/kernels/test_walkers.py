"""Walkers of natural traffic on a street made by hand, in closed form, and in a town: nobody is run over."""

from __future__ import annotations

import itertools
import math
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import (
    F64,
    AgentKind,
    Controller,
    DriverStyle,
    Episode,
    EpisodeAgent,
    LaneType,
    Pose,
    Route,
    SignalState,
    TrafficPlan,
    WalkCrossing,
    WalkStyle,
)
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.kernels.data import WalkStatus
from ssad.world.kernels.walkers import lets_cross
from ssad.world.roads import load_town
from ssad.world.roads.crossings import road_crossings
from ssad.world.roads.sidewalks import sidewalk_network
from ssad.world.walkers import passings
from ssad.world.world import World
from tests.world.worlds import ego, episode, line_route, straight_graph

AT = 200.0  # m, x of the crossing
START = -8.0  # m, y where walkers' ways begin
SOUTH, NORTH = -1.75, 5.25  # m, y of the kerbs
SPEED = 1.25  # m/s of walkers
CALM = DriverStyle(time_gap=1.5, standstill_gap=2.0, acceleration=1.5, deceleration=1.8, jerk=2.5, reaction_time=0.5)


def street(*, marked: bool = True) -> LaneGraph:
    """The straight road with a sidewalk on its other side too, and a crossing from one to the other at x = 200."""
    road = straight_graph()
    count = int(road.offset[1])
    x = road.xy[:count, 0]
    corners = [[AT - 1.5, SOUTH], [AT + 1.5, SOUTH], [AT + 1.5, NORTH], [AT - 1.5, NORTH]]
    graph = replace(
        road,
        name="Street",
        xy=np.concatenate([road.xy, np.stack([x, np.full(count, 6.25)], 1)]).astype(np.float32),
        z=np.zeros(4 * count, np.float32),
        yaw=np.append(road.yaw, np.zeros(count, np.float32)),
        width=np.append(road.width, np.full(count, 2.0, np.float32)),
        s=np.append(road.s, x),
        offset=np.append(road.offset, 4 * count).astype(np.int32),
        kind=np.append(road.kind, LaneType.SIDEWALK).astype(np.uint8),
        road=np.zeros(4, np.int32),
        section=np.zeros(4, np.int32),
        lane_id=np.array([-1, 1, -2, 2], np.int32),
        forward=np.array([True, False, True, True]),
        junction=np.full(4, -1, np.int32),
        speed_limit=np.full(4, 30.0, np.float32),
        left=np.array([1, 0, 0, 1], np.int32),
        right=np.array([2, 3, -1, -1], np.int32),
        left_marking=np.zeros(4, np.uint8),
        right_marking=np.zeros(4, np.uint8),
        succ_offset=np.zeros(5, np.int32),
        crosswalk_offset=np.array([0, 4], np.int32),
        crosswalk_xy=np.array(corners, np.float32),
    )
    if not marked:
        network = sidewalk_network(graph)
        crossing = replace(network.crossings[0], crosswalk=-1)
        graph.cache["sidewalks"] = replace(network, crossings=(crossing,))
    return graph


ZEBRA, UNMARKED = street(), street(marked=False)


def walker(number: int = 1, *, x: float = AT, y: float = -2.45, walks: bool = True, **style: Any) -> EpisodeAgent:
    """A walker on its way north over the crossing, or eastwards along the sidewalk."""
    if not walks:
        route = line_route(x, x + 150.0, -2.75)
        pose = Pose(x, -2.75, 0.0)
        crossings: tuple[WalkCrossing, ...] = ()
    else:
        count = 40
        ys = START + np.arange(count)
        route = Route(
            np.stack([np.full(count, x), ys], 1).astype(np.float32),
            np.full(count, 0.5 * math.pi, np.float32),
            np.full(count, -1, np.int32),
            np.full(count, 4.0, np.float32),
            np.full(count, 2.0, np.float32),
        )
        pose = Pose(x, y, 0.5 * math.pi)
        forward = bool(sidewalk_network(ZEBRA).crossings[0].xy[1, 1] > 0.0)
        crossings = (WalkCrossing(0, SOUTH - 0.7 - START, SOUTH - START, NORTH - START, forward),)
    walk = WalkStyle(crossings, **{"margin": 2.0, "room": 0.7, **style})
    return EpisodeAgent(f"walker {number}", "walker", Controller.SCRIPT, pose, 0.0, SPEED, route=route, walk=walk)


def car(
    front: float, speed: float, controller: Controller = Controller.FOLLOW, driver: DriverStyle | None = None
) -> EpisodeAgent:
    """A car on the eastbound lane with its front that far before the crossing's near edge."""
    x = AT - 1.5 - front - 2.45
    agent = EpisodeAgent("car", "car", controller, Pose(x, 0.0, 0.0), speed, speed, driver=driver)
    return replace(agent, route=line_route(x, x + 350.0 if x < 40.0 else 390.0))


def scene(graph: LaneGraph, *agents: EpisodeAgent) -> Episode:
    """An ego that stands far away, and the agents."""
    far = replace(ego(0.0), pose=Pose(380.0, 3.5, math.pi), speed=0.0, controller=Controller.NONE)
    far = replace(far, route=line_route(380.0, 10.0, 3.5))
    return replace(episode(far, *agents), town=graph.name)


class Drive:
    """Recorded steps of a scene: pose [T, A, 3], speed, acceleration, walk status [T, A]."""

    def __init__(self, graph: LaneGraph, *agents: EpisodeAgent, seconds: float) -> None:
        self.world = World([scene(graph, *agents)], {graph.name: graph})
        rows: list[list[Any]] = []
        self.touched = 0
        for _ in range(round(10 * seconds)):
            self.world.step()
            self.touched |= int(self.world.array("touch")[0].any())
            rows.append([self.world.array(name)[0].copy() for name in ("pose", "speed", "accel", "walk.status")])
        self.pose, self.speed, self.accel, self.status = (np.array(column) for column in zip(*rows, strict=True))

    def entered(self, agent: int) -> float:
        """Time at which a walker enters the road, s; infinite if it does not."""
        on_road = self.pose[:, agent, 1] > SOUTH
        return 0.1 * (int(on_road.argmax()) + 1) if on_road.any() else math.inf


def test_the_street_has_one_crossing_with_its_kerbs() -> None:
    (crossing,) = sidewalk_network(ZEBRA).crossings
    (road,) = road_crossings(ZEBRA)
    assert crossing.crosswalk == 0
    assert road.kerbs == pytest.approx((1.0, 8.0), abs=0.11)
    assert road.traffic == ()


def test_a_route_passes_a_crossing_where_it_lies_across() -> None:
    path = np.stack([np.arange(100.0), np.full(100, 2.0), np.zeros(100), np.zeros(100)], 1).astype(np.float32)
    rule = np.tile(np.array([10.0, 1e6, 1e6, 0.0], np.float32), (100, 1))
    ends = np.array([[[50.5, -5.0], [50.5, 5.0]], [[80.0, 20.0], [80.0, 30.0]]])
    rows = passings(path, rule, ends, np.array([[1.0, 9.0]] * 2), np.array([1.5, 1.5]))
    ((low, high, place, crossing, turns),) = rows
    assert (low, high, place) == pytest.approx((49.0, 52.0, 7.0), abs=1e-6)
    assert (crossing, turns) == (0, 0)
    rule[40:46, 2:] = 0.0, 1.0  # a turn to the near side ends 4 m before it
    assert passings(path, rule, ends, np.array([[1.0, 9.0]] * 2), np.array([1.5, 1.5]))[0][4] == 1


@pytest.mark.parametrize("margin", [1.0, 3.0])
def test_a_walker_accepts_the_gap_in_which_it_crosses_with_its_margin(margin: float) -> None:
    """HCM 2010: the time to leave the way of the vehicle, and a margin; the vehicle may gain 0.8 m/s^2 meanwhile."""
    speed = 10.0
    way = -SOUTH + 0.7 + 0.85 + 1.03  # from where it waits until its middle is 0.85 m beyond the car's side
    gap = 0.7 + way / SPEED + margin
    distance = speed * gap + 0.4 * gap * gap
    for factor, accepts in ((0.93, False), (1.07, True)):
        drive = Drive(UNMARKED, walker(margin=margin), car(factor * distance, speed), seconds=gap + 6.0)
        passed = 0.1 * int((drive.pose[:, 2, 0] > AT).argmax())
        assert (drive.entered(1) < passed) == accepts
        assert not drive.touched
        assert math.isfinite(drive.entered(1))


@wp.kernel(enable_backward=False)
def ask(rows: wp.array2d(dtype=wp.float32), answers: wp.array(dtype=wp.int32)):
    row = wp.tid()
    place = wp.vec4(rows[row, 0], rows[row, 1], 0.0, 0.0)
    answers[row] = 0
    if lets_cross(
        place, rows[row, 2], rows[row, 3], rows[row, 4], rows[row, 5], rows[row, 6], 1.25, 0.5, 2.0, int(rows[row, 7])
    ):
        answers[row] = 1


@pytest.mark.parametrize(
    ("values", "answer"),
    [
        # m to the front, m until the rear has left; speed, acceleration, s of rest; m to enter and leave; has to yield
        ((12.0, 20.0, 10.0, -5.0, 0.0, 0.5, 4.5, 1), False),  # brakes, but could not stop with 3 m/s^2
        ((25.0, 33.0, 8.0, 0.0, 0.0, 0.5, 4.5, 1), True),  # can stop with 2 m/s^2
        ((25.0, 33.0, 8.0, 0.0, 0.0, 0.5, 4.5, 0), False),  # does not have to, and the gap of 2.8 s is too short
        ((12.0, 20.0, 6.0, -1.8, 0.0, 0.5, 4.5, 1), True),  # slows down and will stop before it
        ((66.0, 74.0, 8.0, 0.0, 0.0, 0.5, 4.5, 0), True),  # it may come in 6.3 s; crossing takes 4.1 s, and 2 s more
        ((0.2, 8.0, 0.0, 0.0, 9.0, 0.5, 4.5, 1), False),  # stands on the crossing
        ((0.2, 4.0, 5.0, 0.0, 0.0, 6.0, 10.0, 1), True),  # leaves it before the walker comes
        ((5.0, 12.0, 10.0, 0.0, 0.0, 6.0, 10.0, 1), True),  # too fast to stop, and past 2 s before
        ((5.0, 12.0, 10.0, 0.0, 0.0, 2.0, 6.0, 1), False),
        ((5.0, 12.0, 0.0, 0.0, 0.2, 0.5, 4.5, 0), False),  # has only just stopped
        ((5.0, 12.0, 0.0, 0.0, 2.0, 0.5, 4.5, 0), True),
        ((5.0, 12.0, 10.0, 0.0, 0.0, -4.0, -0.5, 1), True),  # the walker is beyond its way
    ],
)
def test_a_vehicle_lets_a_walker_enter_the_road(values: tuple[float, ...], answer: bool) -> None:
    answers = wp.zeros(1, dtype=wp.int32, device="cpu")
    rows = wp.array(np.array([values], np.float32), dtype=wp.float32, device="cpu")
    wp.launch(ask, 1, [rows, answers], device="cpu")
    assert bool(answers.numpy()[0]) == answer


def test_nobody_steps_in_front_of_a_vehicle_that_cannot_stop() -> None:
    for distance in (4.0, 10.0, 16.0):  # from 10 m/s it would have to brake with more than 3 m/s^2
        drive = Drive(ZEBRA, walker(), car(distance, 10.0), seconds=8.0)
        left = 0.1 * int((drive.pose[:, 2, 0] - 2.45 > AT).argmax())
        assert left - 0.3 < drive.entered(1) < left + 2.0
        assert not drive.touched


@pytest.mark.parametrize("driver", [None, CALM])
def test_vehicles_stop_before_a_crosswalk_for_whoever_waits(driver: DriverStyle | None) -> None:
    drive = Drive(ZEBRA, walker(y=-4.0), car(45.0, 9.0, Controller.AUTOPILOT, driver), seconds=25.0)
    front = drive.pose[:, 2, 0] + 2.45
    on_road = (drive.pose[:, 1, 1] > SOUTH) & (drive.pose[:, 1, 1] < 1.5)
    assert on_road.any()
    assert (front[on_road] < AT - 1.5).all()
    assert drive.speed[:, 2].min() < 7.0
    assert drive.accel[:, 2].min() > -4.0
    assert not drive.touched
    assert front[-1] > AT + 10.0  # and it goes on


def test_without_a_crosswalk_who_waits_stops_nobody() -> None:
    drive = Drive(UNMARKED, walker(), car(30.0, 9.0, Controller.AUTOPILOT, CALM), seconds=6.0)
    assert drive.speed[:, 2].min() > 8.0
    assert drive.entered(1) > 0.1 * int((drive.pose[:, 2, 0] > AT).argmax())


def test_walkers_on_the_sidewalk_change_nothing_for_vehicles() -> None:
    passing = car(60.0, 9.0, Controller.AUTOPILOT, CALM)
    along = Drive(ZEBRA, passing, walker(x=AT - 20.0, walks=False), seconds=10.0)
    alone = World([scene(ZEBRA, passing)], {"Street": ZEBRA})
    for step in range(100):
        alone.step()
        assert alone.array("speed")[0, 1] == along.speed[step, 1]


def test_a_walker_waits_before_a_vehicle_that_blocks_the_crossing() -> None:
    blocking = EpisodeAgent("car", "car", Controller.NONE, Pose(AT, 0.0, 0.0))
    drive = Drive(ZEBRA, walker(), blocking, seconds=10.0)
    assert math.isinf(drive.entered(1))
    assert not drive.touched


@pytest.mark.parametrize("driver", [None, CALM])
def test_a_vehicle_with_its_nose_on_the_crossing_lets_who_crosses_pass(driver: DriverStyle | None) -> None:
    standing = replace(car(-1.3, 0.0, Controller.AUTOPILOT, driver), target_speed=9.0)
    drive = Drive(ZEBRA, walker(y=3.5 - 5.0), standing, seconds=15.0)
    assert not drive.touched
    assert drive.pose[-1, 1, 1] > NORTH
    assert drive.pose[-1, 2, 0] > AT + 10.0


def test_a_group_waits_and_crosses_together() -> None:
    group = [
        walker(1, x=AT - 0.35, depth=1.0),
        walker(2, x=AT + 0.35, group="walker 1"),
        walker(3, x=AT - 0.35, y=-3.45, group="walker 1", row=1.0),
    ]
    drive = Drive(ZEBRA, *group, car(15.0, 10.0), seconds=12.0)
    left = 0.1 * int((drive.pose[:, 4, 0] - 2.45 > AT).argmax())
    times = [drive.entered(agent) for agent in (1, 2, 3)]
    assert min(times) > left - 0.3
    assert abs(times[1] - times[0]) < 0.35
    assert times[2] - times[0] == pytest.approx(1.0 / SPEED, abs=0.4)


def test_walkers_who_meet_pass_each_other_without_touching() -> None:
    first = walker(1, x=100.0, walks=False)
    assert first.route is not None
    back = line_route(115.0, 10.0, -2.75)
    second = replace(walker(2, x=115.0, walks=False), route=back, pose=Pose(115.0, -2.75, math.pi))
    drive = Drive(ZEBRA, first, second, seconds=12.0)
    assert drive.pose[-1, 1, 0] > 110.0
    assert drive.pose[-1, 2, 0] < 105.0
    assert not drive.touched
    assert np.abs(drive.pose[:, 1:, 1] + 2.75).max() < 0.7


def test_a_faster_walker_passes_a_slower_one() -> None:
    slow = replace(walker(1, x=100.0, walks=False), target_speed=0.7)
    fast = replace(walker(2, x=97.0, walks=False), target_speed=1.6)
    drive = Drive(ZEBRA, slow, fast, seconds=15.0)
    assert drive.pose[-1, 2, 0] > drive.pose[-1, 1, 0] + 1.0
    assert not drive.touched


def test_a_walker_without_a_route_or_with_an_unknown_group_is_refused() -> None:
    with pytest.raises(ConfigError, match="walker 1 needs a route"):
        World([scene(ZEBRA, replace(walker(), route=None))], {"Street": ZEBRA})
    with pytest.raises(ConfigError, match="no walker 'nobody'"):
        World([scene(ZEBRA, walker(group="nobody"))], {"Street": ZEBRA})


# --- in a town ------------------------------------------------------------------------------------------------------

TOWN = load_town("Twinford")


@pytest.fixture(scope="module")
def crowd() -> tuple[Episode, list[dict[str, Any]], World]:
    """Natural traffic with many walkers for 100 s; everything a test asks for, step by step."""
    scenario = load_scenarios("natural")[0]
    plan = replace(scenario.traffic or TrafficPlan(), walkers=30, cyclists=4, drivers="population", wake_distance=0.0)
    limits = replace(scenario.limits, max_steps=10**5, max_time=1e5, contact="count")
    built = build_episode(replace(scenario, traffic=plan, limits=limits), TOWN, seed=11)
    # the ego stands, so that the episode goes on, and signals follow their programmes
    standing = replace(built.agents[0], controller=Controller.NONE)
    built = replace(built, agents=(standing, *built.agents[1:]), signal_override={})
    world = World([built], {TOWN.name: TOWN})
    names = ("pose", "speed", "accel", "walk.status", "walk.stage", "walk.rail", "touch")
    steps = []
    for _ in range(1000):
        world.step()
        steps.append({name: world.array(name)[0].copy() for name in names} | {"light": world.state().signal[0].copy()})
    return built, steps, world


def crossing_walkers(built: Episode, steps: list[dict[str, Any]]) -> list[tuple[int, int, WalkCrossing]]:
    """Return the step, the agent and the crossing of every walker that enters a road."""
    entries = []
    for agent, walking in enumerate(built.agents):
        for number, crossing in enumerate(walking.walk.crossings if walking.walk else ()):
            place = np.array([step["walk.rail"][agent, 0] for step in steps])
            at_stage = np.array([step["walk.stage"][agent] for step in steps]) == number
            on_road = at_stage & (place > crossing.kerb)
            if on_road.any():
                entries.append((int(on_road.argmax()), agent, crossing))
    return entries


def test_walkers_cross_while_the_traffic_that_they_cross_has_red(crowd: Any) -> None:
    built, steps, _ = crowd
    at_signals = 0
    for step, agent, crossing in crossing_walkers(built, steps):
        road = road_crossings(TOWN)[crossing.crossing]
        for part in road.traffic:
            way = part.high - road.kerbs[0] if crossing.forward else road.kerbs[1] - part.low
            beyond = np.array([other["walk.rail"][agent, 0] > crossing.kerb + way for other in steps[step:]])
            until = step + int(beyond.argmax()) if beyond.any() else len(steps)
            # vehicles need some time after green to come there
            lights = [other["light"][part.signal] for other in steps[step : until - round(10 * part.seconds)]]
            assert all(light == SignalState.RED for light in lights)
            assert steps[step]["light"][part.signal] == SignalState.RED
        at_signals += bool(road.traffic)
    assert at_signals >= 2


def test_nobody_is_touched_and_nobody_is_stuck_in_a_town(crowd: Any) -> None:
    built, steps, world = crowd
    kinds = world.state().kind[0]
    walkers = sum(1 << int(agent) for agent in np.flatnonzero(kinds == AgentKind.WALKER))
    vehicles = np.flatnonzero((kinds != AgentKind.WALKER) & (kinds != AgentKind.NONE))
    assert not any(int(step["touch"][vehicle]) & walkers for step in steps for vehicle in vehicles)
    entries = crossing_walkers(built, steps)
    assert len(entries) >= 8
    assert sum(agent.walk is not None for agent in built.agents) == 30
    assert (world.array("walk.waited")[0] < 60.0).all()


def test_walkers_stay_on_pavements_and_crossings(crowd: Any) -> None:
    built, steps, _ = crowd
    network = sidewalk_network(TOWN)
    line = np.concatenate([np.linspace(a, b, 30) for edge in network.edges for a, b in itertools.pairwise(edge.xy)])
    agents = [agent for agent, walking in enumerate(built.agents) if walking.walk]
    for step in steps[::100]:
        places: F64 = step["pose"][agents, :2].astype(np.float64)
        assert np.hypot(*(places[:, None] - line[None]).transpose(2, 0, 1)).min(1).max() < 2.0


def test_a_world_with_walkers_copies_and_a_scene_without_them_keeps_its_hash() -> None:
    with_walkers = scene(ZEBRA, walker(), car(30.0, 9.0, Controller.AUTOPILOT))
    without = scene(ZEBRA, car(30.0, 9.0, Controller.AUTOPILOT))
    both, alone = (World(list(part), {"Street": ZEBRA}) for part in ((with_walkers, without), (without,)))
    for _ in range(20):
        both.step()
        alone.step()
    assert both.hashes()[1] == alone.hashes()[0]
    copy = pickle.loads(pickle.dumps(both))
    saved = both.snapshot()
    for _ in range(20):
        both.step()
        copy.step()
    assert both.hashes() == copy.hashes()
    both.restore(saved)
    for _ in range(20):
        both.step()
    assert both.hashes() == copy.hashes()
    both.reset()
    assert both.array("walk.status").max() == WalkStatus.PAVEMENT
    with pytest.raises(ConfigError, match="only one of them has"):
        alone.restore(saved)

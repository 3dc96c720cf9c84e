"""The world against closed forms, its protocol, and bad input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.types import ENDS, Controller, Episode, EpisodeAgent, EpisodeLimits, Phase, PhaseTrigger, Pose
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.check import check_simulator
from ssad.world.episode_arrays import LONGEST
from ssad.world.models import MODELS
from ssad.world.roads import load_town
from ssad.world.world import World
from tests.world.worlds import DEVICES, GRAPHS, NO_PASSING, ego, episode, line_route


def run(world: World, steps: int, action=(0.0, 0.0, 0.0)) -> None:
    for _ in range(steps):
        world.step(np.tile(np.array(action, np.float32), (world.batch, 1)))


def test_full_throttle_is_uniform_acceleration() -> None:
    world = World([episode(ego())], GRAPHS)
    run(world, 20, (1.0, 0.0, 0.0))
    a = MODELS["car"].max_accel
    assert world.array("speed")[0, 0] == pytest.approx(a * 2.0, rel=1e-5)
    assert world.array("pose")[0, 0, 0] == pytest.approx(10.0 + 0.5 * a * 4.0, rel=1e-5)


def test_full_brake_stops_where_it_must_and_stays() -> None:
    world = World([episode(ego(speed=16.0))], GRAPHS)
    run(world, 25, (0.0, 1.0, 0.0))
    assert world.array("speed")[0, 0] == 0.0
    stop = 10.0 + 16.0**2 / (2 * MODELS["car"].max_brake)
    assert world.array("pose")[0, 0, 0] == pytest.approx(stop, abs=0.05)


@settings(max_examples=15, deadline=None)
@given(steer=st.floats(0.05, 0.4), speed=st.floats(1.0, 4.0))
def test_constant_steer_drives_the_bicycle_models_circle(steer: float, speed: float) -> None:
    car = MODELS["car"]
    wide = EpisodeLimits(max_steps=10_000, max_time=1e6)
    world = World([episode(ego(speed=speed), limits=wide)], GRAPHS, substeps=8)
    run(world, 10, (0.0, 0.0, steer))  # past the turning of the wheel
    slip = np.arctan(0.5 * np.tan(steer * car.max_steer))
    radius = 0.5 * car.wheelbase / np.sin(slip)
    x, y, yaw = (float(v) for v in world.array("pose")[0, 0])
    centre = np.array([x - radius * np.sin(yaw + slip), y + radius * np.cos(yaw + slip)])
    for _ in range(20):
        run(world, 1, (0.0, 0.0, steer))
        at = world.array("pose")[0, 0, :2]
        assert np.hypot(*(at - centre)) == pytest.approx(radius, rel=5e-3)


def test_lateral_acceleration_is_bounded_by_grip() -> None:
    world = World([episode(ego(speed=20.0))], GRAPHS)
    yaw = 0.0
    for _ in range(10):
        run(world, 1, (0.0, 0.0, 1.0))
        now = float(world.array("pose")[0, 0, 2])
        rate = (now - yaw) / 0.1
        yaw = now
        assert abs(rate) * float(world.array("speed")[0, 0]) <= 7.0 * 1.01


def test_reverse_is_limited() -> None:
    world = World([episode(ego(x=100.0))], GRAPHS)
    run(world, 60, (1.0, 0.0, 0.0, 1.0))
    assert world.array("speed")[0, 0] == pytest.approx(-5.0)
    assert world.array("pose")[0, 0, 0] < 100.0


def test_follower_keeps_lane_and_speed_and_hits_what_stands_there() -> None:
    prop = EpisodeAgent("box", "vending_machine", Controller.NONE, Pose(60.0, 0.0, 0.0))
    world = World([episode(ego(controller=Controller.FOLLOW), prop)], GRAPHS)
    for _ in range(150):
        world.step()
        if world.ended()[0]:
            break
    assert ENDS[world.ended()[0]] == "collision"
    assert world.array("ego.contact")[0] == 8  # static
    assert world.array("ego.contact_agent")[0] == 1
    front = world.array("pose")[0, 0, 0] + MODELS["car"].length / 2
    assert front == pytest.approx(60.0 - MODELS["vending_machine"].length / 2, abs=0.9)


@pytest.mark.parametrize(("model", "bit"), [("car", 1), ("walker", 2), ("bicycle", 4), ("cone", 8)])
def test_contact_kinds(model: str, bit: int) -> None:
    other = EpisodeAgent("x", model, Controller.NONE, Pose(20.0, 0.0, 0.3))
    world = World([episode(ego(speed=10.0), other)], GRAPHS)
    run(world, 10)
    assert world.array("ego.contact")[0] == bit


def test_fast_crossing_is_not_tunnelled() -> None:
    """A walker-sized box crossed at 40 m/s relative speed is noticed by the half-way check at the latest."""
    other = EpisodeAgent("x", "car", Controller.NONE, Pose(30.0, 0.0, np.pi), speed=0.0)
    for shift in np.linspace(0.0, 4.0, 9):
        world = World([episode(ego(x=10.0 + float(shift), speed=40.0), other)], GRAPHS)
        run(world, 6)
        assert ENDS[world.ended()[0]] == "collision"


def test_autopilot_stops_behind_a_standing_car_and_follows_a_slow_one() -> None:
    standing = EpisodeAgent("s", "car", Controller.NONE, Pose(80.0, 0.0, 0.0))
    slow = EpisodeAgent("m", "car", Controller.FOLLOW, Pose(40.0, 0.0, 0.0), 3.0, 3.0, route=line_route(40.0, 390.0))
    world = World(
        [
            episode(ego(controller=Controller.AUTOPILOT), standing),
            episode(ego(controller=Controller.AUTOPILOT), slow),
        ],
        NO_PASSING,
    )
    for _ in range(250):
        world.step()
    assert list(world.ended()) == [0, 0]
    assert world.array("speed")[0, 0] < 0.1
    gap = 80.0 - world.array("pose")[0, 0, 0] - MODELS["car"].length
    assert 1.0 < gap < 5.0
    assert world.array("speed")[1, 0] == pytest.approx(3.0, abs=0.2)


def test_autopilot_lets_a_walker_cross_that_the_blind_follower_hits() -> None:
    walker = EpisodeAgent(
        "w",
        "walker",
        Controller.SCRIPT,
        Pose(60.0, -6.0, np.pi / 2),
        phases=(Phase(2.5, PhaseTrigger("ego_distance", 20.0, 0)),),
    )
    both = [
        episode(ego(speed=8.0, controller=Controller.AUTOPILOT), walker),
        episode(ego(speed=8.0, controller=Controller.FOLLOW), walker),
    ]
    world = World(both, GRAPHS)
    for _ in range(300):
        world.step()
    assert ENDS[world.ended()[0]] == "complete"
    assert ENDS[world.ended()[1]] == "collision"
    assert world.array("ego.contact")[1] == 2


def test_phases_are_latched_and_in_order() -> None:
    phases = (
        Phase(6.0, PhaseTrigger("ego_distance", 35.0, 0)),
        Phase(2.0, PhaseTrigger("travelled", 5.0)),
        Phase(0.0, PhaseTrigger("time", 8.0)),
    )
    lead = EpisodeAgent("a", "suv", Controller.SCRIPT, Pose(60.0, 0.0, 0.0), phases=phases)
    world = World([episode(ego(controller=Controller.FOLLOW, target_speed=4.0, speed=4.0), lead)], GRAPHS)
    seen = []
    for _ in range(100):
        world.step()
        seen.append((int(world.array("phase")[0, 1]), float(world.array("speed")[0, 1])))
    order = [p for p, _ in seen]
    assert order == sorted(order)
    assert order[0] == 0
    assert order[-1] == 3
    begun = order.index(1)
    ego_x = 10.0 + 4.0 * 0.1 * begun
    assert 60.0 - ego_x < 35.0 + 0.5
    assert seen[-1][1] == 0.0


@pytest.mark.parametrize("device", DEVICES)
def test_a_phase_waits_after_the_one_before_it(device: str) -> None:
    """However late that one begins: in a batch, from a snapshot and after a reset; its count is in the hash."""

    def scene(speed: float, *waits: float) -> Episode:
        phases = (
            Phase(3.0, PhaseTrigger("ego_distance", 35.0, 0)),
            *(Phase(1.0 + k, PhaseTrigger("after", wait)) for k, wait in enumerate(waits)),
        )
        lead = EpisodeAgent("a", "suv", Controller.SCRIPT, Pose(60.0, 0.0, 0.0), phases=phases)
        return episode(ego(controller=Controller.FOLLOW, target_speed=speed, speed=speed), lead)

    def begun(world: World, steps: int) -> tuple[list[list[int]], list[list[str]]]:
        phases, hashes = [], []
        for _ in range(steps):
            world.step()
            phases.append(world.array("phase")[:, 1].tolist())
            hashes.append(world.hashes())
        return phases, hashes

    scenes = [scene(4.0, 2.0, 1.5), scene(8.0, 2.0, 1.5), scene(8.0, 0.0, 3.0), scene(8.0)]
    world = World(scenes, GRAPHS, device=device)
    start = world.hashes()
    phases, hashes = begun(world, 100)
    firsts = []
    for b, waits in enumerate(((2.0, 1.5), (2.0, 1.5), (0.0, 3.0), ())):
        order = [row[b] for row in phases]
        at = [next(k for k, n in enumerate(order) if n >= wanted) for wanted in range(1, 2 + len(waits))]
        assert np.diff(at).tolist() == [round(10 * wait) for wait in waits]
        firsts.append(at[0])
    assert firsts[0] > firsts[1] + 10
    assert firsts[1] == firsts[2] == firsts[3]
    for b in range(4):  # alone as in the batch
        alone = World(scenes[b : b + 1], GRAPHS, device=device)
        assert [row[0] for row in begun(alone, 100)[1]] == [row[b] for row in hashes]
    world.reset()
    assert world.hashes() == start
    middle = firsts[1] + 8
    assert begun(world, middle)[1] == hashes[:middle]
    kept = world.snapshot()
    assert (world.array("script.begun")[:, 0] > 0).tolist() == [False, True, True, True]
    other = World(scenes, GRAPHS, device=device)
    other.restore(kept)
    assert begun(other, 40)[1] == hashes[middle : middle + 40]
    other.restore(kept)
    other.put("script.begun", world.array("script.begun") + 1)
    assert [a != b for a, b in zip(other.hashes(), world.hashes(), strict=True)] == [True] * 4


def test_a_first_phase_waits_after_the_start() -> None:
    waits = (Phase(2.0, PhaseTrigger("after", 1.2)),)
    lead = EpisodeAgent("a", "suv", Controller.SCRIPT, Pose(60.0, 0.0, 0.0), phases=waits)
    timed = replace(lead, phases=(Phase(2.0, PhaseTrigger("time", 1.2)),))
    world = World([episode(ego(), one) for one in (lead, timed)], GRAPHS)
    for _ in range(40):
        world.step()
        first, second = world.hashes()
        assert first == second
    assert world.array("phase")[:, 1].tolist() == [1, 1]


def test_sleeping_traffic_wakes_near_the_ego() -> None:
    other = EpisodeAgent(
        "t",
        "car",
        Controller.AUTOPILOT,
        Pose(120.0, 0.0, 0.0),
        target_speed=6.0,
        route=line_route(120.0, 390.0),
        wake_distance=50.0,
    )
    world = World([episode(ego(controller=Controller.FOLLOW, speed=8.0), other)], GRAPHS)
    for _ in range(120):
        asleep = world.array("active")[0, 1] == 1
        gap = abs(world.array("pose")[0, 1, 0] - world.array("pose")[0, 0, 0])
        assert asleep == (gap >= 50.0)
        world.step()
        if not asleep:
            break
    run(world, 20)
    assert world.array("speed")[0, 1] > 1.0


def test_off_road_and_route_distance() -> None:
    world = World([episode(ego(speed=5.0))], GRAPHS)
    run(world, 15, (0.2, 0.0, -0.3))
    y = float(world.array("pose")[0, 0, 1])
    assert y < -1.75
    assert world.array("ego.off_road")[0] == 1
    assert world.array("ego.route_distance")[0] == pytest.approx(abs(y), abs=0.15)


def test_limits_end_an_episode() -> None:
    cases = {
        "max_steps": EpisodeLimits(max_steps=7),
        "max_time": EpisodeLimits(max_time=0.5),
        "max_distance": EpisodeLimits(max_distance=3.0),
    }
    world = World([episode(ego(speed=8.0), limits=limit) for limit in cases.values()], GRAPHS)
    run(world, 10)
    assert [ENDS[k] for k in world.ended()] == list(cases)
    assert list(world.array("step")) == [7, 5, 4]


def bank() -> list:
    walker = EpisodeAgent(
        "w",
        "walker",
        Controller.SCRIPT,
        Pose(40.0, -4.0, np.pi / 2),
        phases=(Phase(1.5, PhaseTrigger("ego_speed", 2.0)),),
    )
    traffic = EpisodeAgent(
        "t",
        "truck",
        Controller.AUTOPILOT,
        Pose(100.0, 3.5, np.pi),
        4.0,
        8.0,
        route=line_route(100.0, 5.0, 3.5),
    )
    return [
        episode(ego(speed=5.0), key="a"),
        episode(ego(), walker, key="b"),
        episode(ego(speed=7.0), traffic, walker, key="c"),
        episode(ego(x=30.0), traffic, key="d", limits=EpisodeLimits(max_steps=20)),
    ]


def test_world_keeps_its_promises() -> None:
    episodes = bank()
    check_simulator(lambda assign: World(episodes, GRAPHS, assign=assign), episodes=len(episodes))


def test_check_simulator_catches_a_world_that_depends_on_its_batch() -> None:
    episodes = bank()

    class Leaky(World):
        def step(self, actions=None) -> None:
            super().step(actions)
            self.array("speed")[...] += np.float32(1e-3 * self.batch)

    with pytest.raises(AssertionError, match="a scene alone gives the bits"):
        check_simulator(lambda assign: Leaky(episodes, GRAPHS, assign=assign), episodes=len(episodes))


def test_bad_episodes_are_refused() -> None:
    with pytest.raises(ConfigError, match="route"):
        World([episode(ego(route=None))], GRAPHS)
    with pytest.raises(UnknownNameError, match="closest"):
        World([episode(ego(model="caar"))], GRAPHS)
    with pytest.raises(ConfigError, match="at least one"):
        World([], GRAPHS)
    many = [EpisodeAgent(f"p{k}", "cone", Controller.NONE, Pose(k, -3.0)) for k in range(64)]
    with pytest.raises(ConfigError, match="at most 63"):
        World([episode(ego(), *many)], GRAPHS)
    with pytest.raises(ConfigError, match="assigned"):
        World([episode(ego())], GRAPHS, assign=[1])


def test_follower_keeps_its_route_without_wobble() -> None:
    """On a real route with a bend: no steering on the straight, little change of it in the bend, near the path."""
    scenario = load_scenarios("TurningObstacle/00")[0]
    town = load_town(scenario.town)
    one = build_episode(scenario, town, seed=0)
    alone = replace(one, agents=one.agents[:1])
    world = World([alone], {scenario.town: town}, ego=Controller.FOLLOW)
    steer, lateral = [], []
    route = one.agents[0].route
    assert route is not None
    while not world.ended()[0]:
        world.step()
        steer.append(float(world.array("control")[0, 0, 2]))
        x, y, _ = (float(v) for v in world.array("pose")[0, 0])
        k = int(np.argmin(np.hypot(route.xy[:, 0] - x, route.xy[:, 1] - y)))
        c, s = np.cos(route.yaw[k]), np.sin(route.yaw[k])
        lateral.append(-s * (x - route.xy[k, 0]) + c * (y - route.xy[k, 1]))
    assert ENDS[world.ended()[0]] == "complete"
    assert np.abs(lateral).max() < 0.4
    turning = np.abs(steer) > 0.02
    first = int(np.argmax(turning))
    assert np.abs(steer[: first - 5]).max() < 1e-3
    # a limit cycle of the steering would swing by tenths from step to step
    assert np.abs(np.diff(steer, n=2)).max() < 0.12


def test_no_model_is_longer_than_every_episode_reckons_with() -> None:
    assert max(m.length for m in MODELS.values()) / 2 <= LONGEST


def test_where_turns_on_red_are_forbidden_the_autopilot_waits_and_a_turn_counts_as_run() -> None:
    scenario = load_scenarios("RightTurn/00")[0]
    town = load_town(scenario.town)
    one = build_episode(scenario, town, seed=0)
    alone = replace(one, agents=one.agents[:1])
    towns = {allowed: replace(town, turn_on_red=np.array([allowed])) for allowed in (True, False)}
    worlds = {
        allowed: World([alone], {scenario.town: graph}, ego=Controller.AUTOPILOT) for allowed, graph in towns.items()
    }
    while not worlds[True].ended()[0]:
        for world in worlds.values():
            world.step()
    assert not worlds[False].ended()[0]
    assert worlds[False].array("speed")[0, 0] < 0.1
    travelled = worlds[False].array("travelled")[0, 0]
    # Forbidden once the ego has begun to turn: its tail crosses the line on red.
    world = World([alone], {scenario.town: town}, ego=Controller.AUTOPILOT)
    counted = 0
    while not world.ended()[0]:
        world.step()
        counted += int(world.array("ego.red_light")[0] == 1)
        if world.array("travelled")[0, 0] > travelled + 2.0:
            grid = world.bank.roads.grid
            values = grid.numpy()
            values[:, 3] = 0.0
            grid.assign(values)
    assert counted == 1


@pytest.mark.parametrize(("system", "runs"), [(Controller.AUTOPILOT, 0), (Controller.FOLLOW, 1)])
def test_right_turn_on_red_counts_as_run_only_without_a_stop(system: Controller, runs: int) -> None:
    scenario = load_scenarios("RightTurn/00")[0]
    town = load_town(scenario.town)
    one = build_episode(scenario, town, seed=0)
    alone = replace(one, agents=one.agents[:1])
    world = World([alone], {scenario.town: town}, ego=system)
    counted, slowest = 0, 99.0
    while not world.ended()[0]:
        world.step()
        counted += int(world.array("ego.red_light")[0] == 1)
        if world.array("step")[0] > 20:
            slowest = min(slowest, float(world.array("speed")[0, 0]))
    assert ENDS[world.ended()[0]] == "complete"
    assert counted == runs
    assert (slowest < 0.3) == (system == Controller.AUTOPILOT)

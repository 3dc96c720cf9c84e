"""Scripted agents drive as written: speeds, accelerations, jerk, lane changes, triggers and meetings in closed form."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from world.worlds import DEVICES, GRAPHS, ego, episode

from ssad.core.errors import ConfigError
from ssad.core.triggers import trigger_groups
from ssad.core.types import (
    Arrival,
    Body,
    Controller,
    Episode,
    EpisodeAgent,
    EpisodeLimits,
    Gap,
    LateralPhase,
    Phase,
    PhaseTrigger,
    Pose,
    Route,
)
from ssad.world.check import check_simulator
from ssad.world.scripts import straight_route
from ssad.world.world import World

DT = 0.1
ON = EpisodeLimits(max_steps=2000, max_time=200.0, contact="count")


def scripted(name: str, x: float, y: float = 0.0, *, speed: float = 0.0, model: str = "car", **more) -> EpisodeAgent:
    """A scripted agent that drives eastwards from x, y."""
    return EpisodeAgent(name, model, Controller.SCRIPT, Pose(x, y), speed=speed, **more)


def drive(episodes: Sequence[Episode], steps: int) -> dict[str, np.ndarray]:
    """Return poses [T, B, A, 3], speeds and accelerations [T, B, A] at the start and after each step."""
    world = World(episodes, GRAPHS)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("pose", "speed", "accel")}
    for step in range(steps + 1):
        if step:
            world.step()
        for name, values in rows.items():
            values.append(world.array(name).copy())
    return {name: np.stack(values) for name, values in rows.items()} | {"begun": world.array("script.begun").copy()}


# ---------------------------------------------------------------- speeds

TIME_1 = PhaseTrigger("time", 1.0)
SPEEDS = {
    "holds": ((Phase(3.0),), 0.0),
    "brakes 2": ((Phase(0.0, TIME_1, acceleration=-2.0),), 20.0),
    "brakes 4": ((Phase(0.0, TIME_1, acceleration=4.0),), 20.0),
    "brakes 6": ((Phase(0.0, TIME_1, acceleration=-6.0),), 20.0),
    "jerk": (
        (Phase(15.0, acceleration=3.0, jerk=2.0), Phase(5.0, PhaseTrigger("time", 1.6), acceleration=3.0, jerk=2.0)),
        10.0,
    ),
    "small": ((Phase(10.1, jerk=2.0),), 10.0),
    "sinusoidal": ((Phase(15.0, shape="sinusoidal", duration=4.0),), 10.0),
    "cubic": ((Phase(4.0, shape="cubic", acceleration=3.0),), 10.0),
    "linear": ((Phase(15.0, TIME_1, duration=2.5),), 10.0),
    "distance": ((Phase(4.0, shape="sinusoidal", distance=35.0),), 10.0),
    "step": ((Phase(7.0, TIME_1, shape="step"),), 10.0),
    "slower": ((Phase(-2.0, reference="brakes 2", continuous=True),), 20.0),
    "half": ((Phase(0.5, TIME_1, reference="linear", factor=True),), 0.0),
}


@pytest.fixture(scope="module")
def speeds() -> dict[str, np.ndarray]:
    """Speeds [T] of all cases, 0.1 s apart."""
    agents = [
        scripted(name, 50.0, 10.0 * (number + 2), speed=speed, phases=phases)
        for number, (name, (phases, speed)) in enumerate(SPEEDS.items())
    ]
    agents.append(scripted("walker", 50.0, -20.0, model="walker", phases=(Phase(1.4), Phase(0.5, TIME_1))))
    result = drive([episode(ego(), *agents, limits=ON)], 120)
    return {agent.name: result["speed"][:, 0, number + 1] for number, agent in enumerate(agents)}


def test_a_speed_is_held_without_oscillation(speeds: dict[str, np.ndarray]) -> None:
    reached = int(np.flatnonzero(speeds["holds"] >= 2.95)[0])
    assert reached == 9  # 3.5 m/s^2 of the car
    np.testing.assert_allclose(speeds["holds"][reached:], 3.0, atol=0.05)
    assert np.ptp(speeds["holds"][reached + 1 :]) == 0.0
    np.testing.assert_allclose(speeds["walker"][1:11], 1.4, atol=1e-5)
    np.testing.assert_allclose(speeds["walker"][11:], 0.5, atol=1e-5)


@pytest.mark.parametrize("braking", [2.0, 4.0, 6.0])
def test_a_lead_brakes_as_stated(speeds: dict[str, np.ndarray], braking: float) -> None:
    speed = speeds[f"brakes {braking:g}"]
    np.testing.assert_array_equal(speed[:11], 20.0)
    steps = round(20.0 / braking / DT)
    np.testing.assert_allclose(np.diff(speed)[10 : 10 + steps - 1] / DT, -braking, rtol=0.02)
    np.testing.assert_array_equal(speed[11 + steps :], 0.0)


@pytest.mark.parametrize("name", ["jerk", "small"])
def test_jerk_stays_within_its_limit(speeds: dict[str, np.ndarray], name: str) -> None:
    """The speed is reached all the same, and in the shortest time: both limits are used."""
    speed = speeds[name].astype(np.float64)
    acceleration = np.diff(speed, prepend=speed[0]) / DT
    assert np.abs(np.diff(acceleration)).max() / DT <= 2.0 * 1.01
    assert np.abs(acceleration).max() <= 3.0 * 1.01
    last = SPEEDS[name][0][-1].speed
    assert last is not None
    np.testing.assert_allclose(speed[-10:], last, atol=1e-3)
    if name == "jerk":
        # up by the jerk to 3 m/s^2, at 1.6 s (12.55 m/s) turned round in 3 s, held, and taken back over 2.25 m/s
        held = 4.6 + (12.55 - 2.25 - 5.0) / 3.0
        fine = np.arange(12001) * 1e-3
        rates = np.interp(fine, [0.0, 1.5, 1.6, 4.6, held, held + 1.5], [0.0, 3.0, 3.0, -3.0, -3.0, 0.0])
        course = 10.0 + np.append(0.0, np.cumsum(0.5 * (rates[1:] + rates[:-1]))) * 1e-3
        np.testing.assert_allclose(speed, course[::100][: len(speed)], atol=2e-3)


# ---------------------------------------------------------------- distances

SLOWER = Phase(8.0, PhaseTrigger("time", 12.0), acceleration=2.0)
FASTER = Phase(14.0, PhaseTrigger("time", 20.0), acceleration=2.0)
WITHIN = {"max_acceleration": 2.0, "max_deceleration": 3.0}
# place at the start, speed there, gap, whether it is continuous; the leader starts at 150 m with 15 m/s
GAPS = {
    "far": (20.0, 20.0, Gap(20.0, **WITHIN), True),
    "near": (140.0, 15.0, Gap(40.0, max_speed=16.0, **WITHIN), True),
    "free": (110.0, 15.0, Gap(20.0, free_space=True), True),
    "headway": (115.0, 15.0, Gap(2.0, time=1.5, **WITHIN), True),
    "ahead": (160.0, 15.0, Gap(20.0, side="any"), True),
    "once": (110.0, 15.0, Gap(20.0), False),
}


@pytest.fixture(scope="module")
def gaps() -> dict[str, np.ndarray]:
    """Distance to the leader, speed and speed of the leader [T, 3] of all cases, 0.1 s apart."""
    agents = []
    for number, (name, (place, speed, gap, continuous)) in enumerate(GAPS.items()):
        y = 10.0 * (number + 2)
        changes = (SLOWER, FASTER) if name not in ("far", "near") else ()
        agents.append(scripted(f"leader {name}", 150.0, y, speed=15.0, phases=changes))
        kept = Phase(gap=replace(gap, reference=f"leader {name}"), continuous=continuous, name="gap")
        stop = Phase(2.0, PhaseTrigger("phase_end", phase="gap", delay=3.0))
        phases = (kept,) if continuous else (kept, stop)
        agents.append(scripted(name, place, y, speed=speed, phases=phases))
    result = drive([episode(ego(), *agents, limits=ON)], 300)
    place, speed = result["pose"][:, 0, 1:, 0].astype(np.float64), result["speed"][:, 0, 1:].astype(np.float64)
    return {
        name: np.stack([place[:, row] - place[:, row + 1], speed[:, row + 1], speed[:, row]], 1)
        for row, name in zip(range(0, len(agents), 2), GAPS, strict=True)
    }


@pytest.mark.parametrize(("name", "target", "max_speed"), [("far", 20.0, 40.0), ("near", 40.0, 16.0)])
def test_a_gap_is_reached_without_overshoot(
    gaps: dict[str, np.ndarray], name: str, target: float, max_speed: float
) -> None:
    """Full acceleration, full deceleration from r^2 = 2 a (e - a T^2 / 2) on, and e falls to 9/11 in a step at last."""
    gap, speed, leader = gaps[name].T
    rates = np.diff(speed) / DT
    assert rates.min() >= -3.0 - 1e-3
    assert rates.max() <= 2.0 + 1e-3
    assert speed.max() <= max_speed + 1e-3
    error, closing = gap - target, speed - leader
    assert np.sign(error[0]) * error.min(initial=0.0, where=np.sign(error) != np.sign(error[0])) >= -2e-3
    assert np.sign(error[0]) * error[-1] == pytest.approx(0.0, abs=2e-3)
    if name == "far":
        braking = np.flatnonzero(rates < -2.9)
        np.testing.assert_allclose(closing[braking] ** 2, 6.0 * (error[braking] - 0.375), rtol=0.02)
        tail = np.flatnonzero(np.abs(error) < 0.5)[:8]
        np.testing.assert_allclose(error[tail[1:]] / error[tail[:-1]], 0.45 / 0.55, rtol=0.02)


def test_a_gap_is_held_behind_a_leader_that_changes_its_speed(gaps: dict[str, np.ndarray]) -> None:
    for name, target in (("free", 20.0 + 4.9), ("ahead", -20.0)):
        assert gaps[name][110:, 0] == pytest.approx(target, abs=0.05), name
        assert np.ptp(gaps[name][110:, 2]) == pytest.approx(7.0, abs=0.01)
    gap, speed, _ = gaps["headway"].T
    # its errors fall to 37 % in the headway and 0.5 s, which is 7 s after the leader's last change
    for step, leader in ((119, 15.0), (300, 14.0)):
        assert gap[step] == pytest.approx(2.0 + 1.5 * leader, abs=0.2), step
        assert speed[step] == pytest.approx(leader, abs=0.1)


def test_a_gap_that_is_not_continuous_ends(gaps: dict[str, np.ndarray]) -> None:
    """Once it is reached the actor keeps its speed, and phases that wait for the end begin."""
    gap, speed, _ = gaps["once"].T
    reached = int(np.flatnonzero(np.abs(gap - 20.0) < 0.02)[0])
    np.testing.assert_allclose(speed[reached + 2 : reached + 28], 15.0, atol=0.01)
    assert int(np.flatnonzero(speed < 14.0)[0]) == pytest.approx(reached + 32, abs=3)
    assert speed[-1] == pytest.approx(2.0)


def test_only_full_braking_depends_on_the_brakes_and_the_road() -> None:
    """50 km/h: v^2 / 2a + v t / 2 with a build-up time t; a stated deceleration is driven whatever they allow."""
    speed, slow = 50.0 / 3.6, Body(brake_build_up=0.3)
    full, stated = (Phase(0.0),), (Phase(0.0, acceleration=9.5),)
    agents = [
        scripted(f"{number}", 50.0, 10.0 * (number + 2), speed=speed, phases=phases, body=body)
        for number, (phases, body) in enumerate([(full, Body()), (full, slow), (stated, slow)])
    ]
    dry, ice = (episode(ego(), *agents, limits=ON, friction=friction) for friction in (0.9, 0.3))
    result = drive([dry, ice], 70)
    way = result["pose"][-1, :, 1:, 0] - 50.0
    dry_way, icy_way = speed**2 / (2.0 * 8.0), speed**2 / (2.0 * 0.3 * 9.81)
    stated_way = speed**2 / (2.0 * 9.5)
    np.testing.assert_allclose(way[0], [dry_way, dry_way + 0.3 * speed / 2.0, stated_way], rtol=0.02)
    np.testing.assert_allclose(way[1, [0, 2]], [icy_way, stated_way], rtol=0.02)


def test_courses_follow_their_formulae(speeds: dict[str, np.ndarray]) -> None:
    time = np.arange(len(speeds["linear"])) * DT
    sinusoidal = 10.0 + 2.5 * (1.0 - np.cos(np.pi * np.clip(time / 4.0, 0.0, 1.0)))
    np.testing.assert_allclose(speeds["sinusoidal"], sinusoidal, atol=1e-4)
    np.testing.assert_allclose(speeds["linear"], 10.0 + 2.0 * np.clip(time - 1.0, 0.0, 2.5), atol=1e-4)
    share = np.clip(time / (1.5 * 6.0 / 3.0), 0.0, 1.0)  # the greatest rate is 1.5 times the mean
    np.testing.assert_allclose(speeds["cubic"], 10.0 - 6.0 * share**2 * (3.0 - 2.0 * share), atol=1e-4)
    np.testing.assert_allclose(speeds["step"], np.where(time > 1.0, 7.0, 10.0), atol=1e-5)
    reached = int(np.flatnonzero(speeds["distance"] <= 4.0)[0])
    way = DT * (speeds["distance"][:reached] + speeds["distance"][1 : reached + 1]).sum() / 2
    assert way == pytest.approx(35.0, abs=0.05)


def test_speeds_relative_to_another_agent(speeds: dict[str, np.ndarray]) -> None:
    lead, follower = speeds["brakes 2"], speeds["slower"]
    # it follows the speed of one step before
    np.testing.assert_allclose(follower[12:100], np.maximum(lead[11:99] - 2.0, 0.0), atol=1e-3)
    assert speeds["half"][-1] == pytest.approx(0.5 * 10.0, abs=1e-4)  # of the speed at its start, not of 15 m/s


# ---------------------------------------------------------------- lateral phases


def bend(radius: float) -> Route:
    """A left bend of 90 degrees and the given radius, one point a metre, from (0, -100) eastwards."""
    angle = np.arange(int(radius * np.pi / 2)) / radius
    xy = np.stack([radius * np.sin(angle), -100.0 + radius * (1.0 - np.cos(angle))], 1)
    count = len(xy)
    return Route(
        xy.astype(np.float32),
        angle.astype(np.float32),
        np.full(count, -1, np.int32),
        np.full(count, 50.0, np.float32),
        np.full(count, 3.5, np.float32),
    )


def swerving(name: str, y: float, speed: float, route: Route, *phases: tuple[LateralPhase, float]) -> EpisodeAgent:
    """An agent with lateral phases and where they lead."""
    start = Pose(float(route.xy[0, 0]), float(route.xy[0, 1]), float(route.yaw[0]))
    return EpisodeAgent(
        name,
        "car",
        Controller.SCRIPT,
        start,
        speed=speed,
        route=route,
        lateral=tuple(phase for phase, _ in phases),
        lateral_targets=tuple(np.full(len(route.xy), target, np.float32) for _, target in phases),
    )


def test_lane_changes_end_where_and_when_they_are_told() -> None:
    straights = [straight_route(Pose(50.0, 20.0 * k, 0.0), 300.0) for k in range(1, 6)]
    agents = [
        swerving("duration", 20.0, 20.0, straights[0], (LateralPhase(1, when=TIME_1, duration=2.5), 3.5)),
        swerving("distance", 40.0, 20.0, straights[1], (LateralPhase(-1, shape="linear", distance=40.0), -3.5)),
        swerving("rate", 60.0, 20.0, straights[2], (LateralPhase(1, shape="cubic", rate=1.0), 3.0)),
        swerving("bend", 80.0, 10.0, bend(60.0), (LateralPhase(1, duration=3.0), 3.5)),
        swerving(
            "overridden",
            100.0,
            20.0,
            straights[4],
            (LateralPhase(1, duration=4.0), 3.5),
            (LateralPhase(-1, duration=2.0, when=PhaseTrigger("time", 2.0)), 0.0),
        ),
    ]
    result = drive([episode(ego(), *agents, limits=ON)], 90)
    time = np.arange(91) * DT
    left = {agent.name: result["pose"][:, 0, k + 1, 1] - agent.pose.y for k, agent in enumerate(agents)}
    share = np.clip((time - 1.0) / 2.5, 0.0, 1.0)
    np.testing.assert_allclose(left["duration"], 1.75 * (1.0 - np.cos(np.pi * share)), atol=2e-3)
    np.testing.assert_allclose(result["speed"][:, 0, 1], 20.0)
    assert abs(result["pose"][-1, 0, 1, 2]) < 1e-4
    along = result["pose"][:, 0, 2, 0] - 50.0
    np.testing.assert_allclose(left["distance"], -3.5 * np.clip(along / 40.0, 0.0, 1.0), atol=2e-2)
    share = np.clip(time / (1.5 * 3.0 / 1.0), 0.0, 1.0)
    np.testing.assert_allclose(left["rate"], 3.0 * share**2 * (3.0 - 2.0 * share), atol=2e-3)
    assert np.abs(np.diff(left["rate"])).max() / DT == pytest.approx(1.0, abs=0.01)
    # 3.5 m to the left of a left bend is a smaller circle about the same centre
    radius = np.hypot(result["pose"][:, 0, 4, 0], result["pose"][:, 0, 4, 1] + 40.0)
    expected = 60.0 - 1.75 * (1.0 - np.cos(np.pi * np.clip(time / 3.0, 0.0, 1.0)))
    np.testing.assert_allclose(radius[:85], expected[:85], atol=0.02)
    travelled = np.hypot(*np.diff(result["pose"][:85, 0, 4, :2], axis=0).T).sum()
    assert travelled == pytest.approx(84.0, abs=0.1)
    middle = 1.75 * (1.0 - np.cos(np.pi / 2))
    back = middle - 0.5 * middle * (1.0 - np.cos(np.pi * np.clip((time - 2.0) / 2.0, 0.0, 1.0)))
    np.testing.assert_allclose(left["overridden"][20:], back[20:], atol=2e-3)


def test_walkers_follow_a_path_that_bends() -> None:
    """They do not steer; on a straight path they go straight on from where they stand."""
    walker = scripted("w", 0.0, -100.0, model="walker", phases=(Phase(2.0),), route=bend(20.0))
    aside = scripted(
        "s", 0.0, -150.5, model="walker", phases=(Phase(2.0),), route=straight_route(Pose(0.0, -150.0), 90.0)
    )
    result = drive([episode(ego(), walker, aside, limits=ON)], 120)
    place = result["pose"][:, 0, 1]
    np.testing.assert_allclose(np.hypot(place[:, 0], place[:, 1] + 80.0), 20.0, atol=0.02)
    travelled = DT * 2.0 * np.arange(1, 121) - 0.1  # the first step begins at rest
    np.testing.assert_allclose(place[1:, 2], travelled / 20.0, atol=0.03)
    np.testing.assert_allclose(result["pose"][-1, 0, 2], [23.9, -150.5, 0.0], atol=0.02)


# ---------------------------------------------------------------- triggers

# The ego drives at 10 m/s from x = 10, the lead at 4 m/s from x = 100 (both 4.9 m long): gap 90 - 6 t.
# From 2 s on the lead brakes by 1 m/s^2 to 2 m/s (until 4 s).
LEAD = scripted(
    "lead",
    100.0,
    speed=4.0,
    phases=(
        Phase(2.0, PhaseTrigger("time", 2.0), name="brakes", acceleration=-1.0),
        Phase(0.0, PhaseTrigger("phase_end", phase="brakes", delay=1.0), name="stops", acceleration=-2.0),
    ),
)


def gap(time: float) -> float:
    """Distance of the centres of the ego and the lead, m."""
    speed_lost = np.clip(time - 2.0, 0.0, 2.0)
    braking = 4.0 * time - 0.5 * speed_lost**2 - 2.0 * max(time - 4.0, 0.0)
    stopping = np.clip(time - 5.0, 0.0, 1.0)
    return 90.0 + braking - stopping**2 - 2.0 * max(time - 6.0, 0.0) - 10.0 * time


def first(holds) -> int:
    """First step at whose start something holds."""
    return next(step for step in range(200) if holds(step * DT))


def lead_speed(time: float) -> float:
    return 4.0 - np.clip(time - 2.0, 0.0, 2.0) - 2.0 * np.clip(time - 5.0, 0.0, 1.0)


APART = {"agent": "ego", "reference": "lead"}
TRIGGERS = {
    "distance": (PhaseTrigger("distance", 80.05, **APART), first(lambda t: gap(t) < 80.05)),
    "free space": (PhaseTrigger("distance", 80.05, free_space=True, **APART), first(lambda t: gap(t) - 4.9 < 80.05)),
    "road": (PhaseTrigger("distance", 80.05, measure="road", **APART), first(lambda t: gap(t) < 80.05)),
    "above": (PhaseTrigger("distance", 80.05, rule="above", edge="falling", **APART), first(lambda t: gap(t) < 80.05)),
    "lateral": (
        PhaseTrigger("distance", 30.05, agent="", reference="ego", measure="lateral", rule="above"),
        0,
    ),
    "ttc": (
        PhaseTrigger("time_to_collision", 10.05, **APART),
        first(lambda t: gap(t) / (10.0 - lead_speed(t)) < 10.05),
    ),
    "ttc free": (
        PhaseTrigger("time_to_collision", 10.05, free_space=True, measure="road", **APART),
        first(lambda t: (gap(t) - 4.9) / (10.0 - lead_speed(t)) < 10.05),
    ),
    "headway": (PhaseTrigger("time_headway", 7.03, **APART), first(lambda t: gap(t) / 10.0 < 7.03)),
    "point": (PhaseTrigger("distance", 20.05, agent="ego", position=(60.0, 0.0)), 30),
    "position": (PhaseTrigger("position", 5.05, agent="ego", position=(60.0, 0.0)), 45),
    "travelled": (PhaseTrigger("travelled", 30.5, agent="ego"), 31),
    "time": (PhaseTrigger("time", 2.5), 25),
    "delay": (PhaseTrigger("time", 2.5, delay=1.2), 37),
    "long delay": (PhaseTrigger("travelled", 30.5, agent="ego", delay=6.0), 91),
    "slow": (PhaseTrigger("speed", 3.05, agent="lead", rule="below"), first(lambda t: lead_speed(t) < 3.05)),
    "difference": (
        PhaseTrigger("relative_speed", 7.05, **APART),
        first(lambda t: 10.0 - lead_speed(t) > 7.05),
    ),
    "braking": (PhaseTrigger("acceleration", -0.5, agent="lead", rule="below"), 21),
    "braking ends": (PhaseTrigger("acceleration", -0.5, agent="lead", rule="below", edge="falling"), 41),
    "begun": (PhaseTrigger("phase_start", agent="lead", phase="brakes"), 20),
    "ended": (PhaseTrigger("phase_end", agent="lead", phase="brakes"), 40),
    "edge": (PhaseTrigger("phase_end", agent="lead", phase="brakes", edge="both", delay=0.5), 45),
    "stops": (PhaseTrigger("phase_start", agent="lead", phase="stops"), 50),
    "stands": (PhaseTrigger("standstill", 1.5, agent="lead"), 75),
    "stood": (PhaseTrigger("standstill", 1.5, agent="lead", edge="rising", delay=1.0), 85),
    "all": (PhaseTrigger(all=(PhaseTrigger("time", 2.5), PhaseTrigger("travelled", 40.5, agent="ego"))), 41),
    "any": (
        PhaseTrigger(
            any=(
                PhaseTrigger("time", 6.0),
                PhaseTrigger(all=(PhaseTrigger("time", 1.0), PhaseTrigger("speed", 3.55, agent="lead", rule="below"))),
            )
        ),
        25,
    ),
    "never together": (
        PhaseTrigger(
            all=(
                PhaseTrigger("time", 1.0, edge="rising"),
                PhaseTrigger("time", 2.0, edge="rising"),
            )
        ),
        None,
    ),
    "first edge": (PhaseTrigger("speed", 5.0, agent="ego", edge="rising"), None),
}


def watchers(*, anytime: bool = False) -> list[EpisodeAgent]:
    """Agents far from the road, each with one trigger."""
    return [
        scripted(
            f"watch {number}", 20.0 + 6.0 * (number % 20), -40.0 - 5.0 * (number // 20), phases=(Phase(1.0, trigger),)
        )
        for number, (trigger, _) in enumerate(TRIGGERS.values())
    ]


def trigger_scene() -> Episode:
    return episode(
        ego(speed=10.0, controller=Controller.SCRIPT),
        LEAD,
        *watchers(),
        limits=replace(ON, max_steps=120),
        key="triggers",
    )


@pytest.mark.parametrize("device", DEVICES)
def test_triggers_fire_in_the_step_of_the_closed_form(device: str) -> None:
    world = World([trigger_scene()], GRAPHS, device=device)
    for _ in range(110):
        world.step()
    begun = (world.array("script.begun")[0, len(LEAD.phases) :] - 1).tolist()
    assert dict(zip(TRIGGERS, begun, strict=True)) == {
        name: -1 if step is None else step for name, (_, step) in TRIGGERS.items()
    }


def test_groups_of_conditions() -> None:
    a, b, c, d = (PhaseTrigger("time", float(value)) for value in range(1, 5))
    assert trigger_groups(a) == ((a,),)
    assert trigger_groups(PhaseTrigger(any=(a, PhaseTrigger(all=(b, c))))) == ((a,), (b, c))
    assert trigger_groups(replace(a, all=(b,), any=(c, d))) == ((a, b, c), (a, b, d))
    assert trigger_groups(PhaseTrigger()) == ((PhaseTrigger(),),)
    with pytest.raises(ConfigError, match="more than 64 ways"):
        trigger_groups(PhaseTrigger(all=tuple(PhaseTrigger(any=(a, b, c)) for _ in range(4))))


def test_a_phase_begins_in_order_unless_it_may_begin_at_any_time() -> None:
    late, soon = PhaseTrigger("time", 3.0), PhaseTrigger("time", 1.0)
    orders = [
        scripted("order", 50.0, 20.0, phases=(Phase(4.0, late), Phase(2.0, soon))),
        scripted("any", 50.0, 40.0, phases=(Phase(4.0, late), Phase(2.0, soon, anytime=True))),
    ]
    result = drive([episode(ego(), *orders, limits=ON)], 60)
    assert (result["begun"][0] - 1).tolist() == [30, 30, 30, 10]
    # of two that begin together the last in the list runs; of two at different times the later one
    np.testing.assert_allclose(result["speed"][-1, 0, 1:], [2.0, 4.0], atol=1e-4)
    assert result["speed"][25, 0, 2] == pytest.approx(2.0, abs=1e-4)


# ---------------------------------------------------------------- meetings


@pytest.mark.parametrize("final_speed", [None, 5.0, 0.0])
def test_two_agents_arrive_together(final_speed: float | None) -> None:
    """The ego, 100 m away at 12.5 m/s, and an actor 60 m from its own point; also where the ego slows down."""
    meeting = Arrival((110.0, -30.0), (110.0, 0.0))
    other = scripted("meets", 50.0, -30.0, speed=4.0, phases=(Phase(final_speed, arrival=meeting),))
    steady = ego(speed=12.5, controller=Controller.SCRIPT)
    slowing = replace(steady, phases=(Phase(8.0, PhaseTrigger("time", 2.0), acceleration=1.5),))
    result = drive([episode(steady, other, limits=ON), episode(slowing, other, limits=ON)], 140)
    for scene in range(2):
        x = result["pose"][:, scene, :, 0]
        arrivals = [float(np.interp(110.0, x[:, agent], np.arange(len(x)))) for agent in (0, 1)]
        if final_speed == 0.0:  # it stands at its point
            arrivals[1] = float(np.flatnonzero(x[:, 1] > 110.0 - 0.3)[0])
            assert abs(x[-1, 1] - 110.0) < 0.3
            assert abs(arrivals[1] - arrivals[0]) < 10
        else:
            assert abs(arrivals[1] - arrivals[0]) < 1.0
        if final_speed is not None:
            at_point = result["speed"][round(arrivals[0]), scene, 1]
            assert at_point == pytest.approx(final_speed, abs=0.3)
            assert result["speed"][-1, scene, 1] == pytest.approx(final_speed, abs=1e-3)


def test_a_meeting_point_lies_on_the_path() -> None:
    other = scripted("meets", 50.0, -30.0, phases=(Phase(arrival=Arrival((110.0, -30.0), (110.0, 9.0))),))
    with pytest.raises(ConfigError, match=r"agent ego: the meeting point \(110, 9\) is 9.0 m off its path"):
        World([episode(ego(), other)], GRAPHS)


# ---------------------------------------------------------------- state


def busy_episode(key: str = "busy", speed: float = 10.0) -> Episode:
    """An episode in which all kinds of script state change in the first seconds."""
    route = straight_route(Pose(50.0, 20.0), 100.0)
    swerve = swerving("swerve", 20.0, speed, route, (LateralPhase(1, duration=2.0), 3.5))
    delayed = scripted(
        "delayed",
        50.0,
        40.0,
        speed=2.0,
        phases=(
            Phase(4.0, PhaseTrigger("speed", 5.0, agent="ego", delay=0.6), jerk=2.0, name="first"),
            Phase(2.0, PhaseTrigger("phase_end", phase="first")),
        ),
    )
    return episode(ego(speed=speed, controller=Controller.SCRIPT), swerve, delayed, key=key, limits=ON)


def test_scripts_keep_the_promises_of_a_simulator() -> None:
    episodes = [busy_episode(), episode(ego(speed=5.0), key="plain"), busy_episode("slow", 6.0)]
    check_simulator(lambda assign: World(episodes, GRAPHS, assign=assign), episodes=len(episodes))


def test_copies_and_snapshots_of_scripts_continue_to_the_bit() -> None:
    world = World([busy_episode(), trigger_scene()], GRAPHS)
    start = world.hashes()
    for _ in range(13):
        world.step()
    saved, copies = world.snapshot(), (copy.deepcopy(world), pickle.loads(pickle.dumps(world)))
    middle = world.hashes()
    for _ in range(30):
        world.step()
        for other in copies:
            other.step()
    assert copies[0].hashes() == copies[1].hashes() == world.hashes() != middle
    end = world.hashes()
    world.restore(saved)
    assert world.hashes() == middle
    for _ in range(30):
        world.step()
    assert world.hashes() == end
    world.reset()
    assert world.hashes() == start
    # every array counts
    for name in ("begun", "ended", "history", "running", "course", "swerve", "rail"):
        world.restore(saved)
        world.put(f"script.{name}", world.array(f"script.{name}") + 1)
        assert world.hashes()[0] != middle[0], name


def test_a_scene_without_scripts_has_the_same_hash_beside_one_that_has_them() -> None:
    plain = episode(ego(speed=5.0, controller=Controller.FOLLOW), key="plain")
    alone, beside = World([plain], GRAPHS), World([plain, busy_episode()], GRAPHS)
    for _ in range(10):
        alone.step()
        beside.step()
    assert alone.hashes() == beside.hashes()[:1]
    with pytest.raises(ConfigError, match="only one of them has script"):
        alone.restore(beside.snapshot())


def test_names_that_nothing_has_are_refused() -> None:
    for trigger, message in (
        (PhaseTrigger("distance", 5.0, reference="bus"), "there is no agent 'bus'; there are: ego, a"),
        (PhaseTrigger("phase_end", phase="gone"), "agent number 1 has no phase 'gone'"),
    ):
        with pytest.raises(ConfigError, match=message):
            World([episode(ego(), scripted("a", 50.0, phases=(Phase(1.0, trigger),)))], GRAPHS)
    half_built = swerving("a", 0.0, 1.0, straight_route(Pose(50.0, 20.0), 50.0), (LateralPhase(1), 3.5))
    with pytest.raises(ConfigError, match="1 lateral phases, 0 targets"):
        World([episode(ego(), replace(half_built, lateral_targets=()))], GRAPHS)
    with pytest.raises(ConfigError, match="lateral phases need a route"):
        World([episode(ego(), replace(half_built, route=None))], GRAPHS)


def test_a_script_goes_on_where_another_driver_has_left_its_agent() -> None:
    route = straight_route(Pose(50.0, 20.0), 200.0)
    agent = swerving("a", 20.0, 10.0, route, (LateralPhase(1, duration=2.0, when=PhaseTrigger("time", 4.0)), 3.5))
    world = World([episode(ego(), agent, limits=ON)], GRAPHS)
    controls = np.zeros((1, 2, 4))
    controls[:, 1, 1] = 0.5
    taken = np.array([[False, True]])
    for step in range(70):
        if step == 10:
            world.take(taken, Controller.EXTERNAL)
        if step == 20:
            world.take(taken, None)
        before = world.array("pose")[0, 1].copy()
        world.step(controls)
        moved = float(np.hypot(*(world.array("pose")[0, 1] - before)[:2]))
        assert moved <= 1.01, step  # a script that went on from its own place would jump
    assert world.array("pose")[0, 1, 1] == pytest.approx(23.5, abs=1e-3)

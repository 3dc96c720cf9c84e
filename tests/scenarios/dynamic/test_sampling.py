"""Draws of a scenario: without spread nothing changes, with it every seed is a dangerous episode of its own."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import math
import runpy
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import ConfigError, RouteError
from ssad.core.geometry import obb_distance
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import generator
from ssad.core.types import Actor, Body, Episode, Phase, PhaseTrigger, Pose, Route, Scenario
from ssad.scenarios.dynamic import (
    PRECRASH,
    Parameter,
    ScenarioType,
    build_episode,
    load_scenarios,
    read_scenarios,
    sample_parameters,
    sampling_ranges,
    save_scenarios,
    scenario_type,
)
from ssad.scenarios.dynamic.episode import _pose_beside_route
from ssad.scenarios.dynamic.knowledge import _meeting
from ssad.scenarios.dynamic.knowledge._caching import cached_by_identity
from ssad.scenarios.dynamic.knowledge._placing import polyline_route, trigger_index
from ssad.world.models import model
from ssad.world.roads import load_town

ROOT = Path(__file__).parents[3]
SHIPPED = load_scenarios("precrash")
NATURAL = load_scenarios("natural")
CUSTOM = Scenario(
    "test/van",
    "Custom",
    "ProvingGround",
    (Pose(217.0, -5.25), Pose(317.0, -5.25)),
    actors=(Actor("van", "van", Pose(260.0, -5.25), (Phase(6.0, PhaseTrigger("ego_distance", 25.0)),)),),
)


@cache
def measured() -> dict[str, Any]:
    """What the benchmark's script defines."""
    return runpy.run_path(str(ROOT / "benchmarks" / "scenario_sampling.py"))


def build(scenario: Scenario, seed: int, spread: float = 1.0) -> Episode:
    return build_episode(scenario, load_town(scenario.town), seed=seed, spread=spread)


# ---------------------------------------------------------------- the nominal case

# Episodes as the code made them before there was a spread (commit 3189f35): `fingerprint` of all episodes of a set.
NOMINAL = {
    "StraightObstacle": "18be3d333c2f7777",
    "TurningObstacle": "dbdc98bf6b10a9d9",
    "LaneChanging": "50bbcc5aee95f621",
    "VehiclePassing": "bfe33b60d26b1d3b",
    "RedlightRunning": "90105aa187eeffbc",
    "UnprotectedLeftTurn": "6cfe9665207bc890",
    "RightTurn": "fb5f85d61ff3ebf0",
    "CrossingNegotiation": "f4ed21be4d96be32",
    "Twinford": "47bf0c7fbe96f182",
    "Crossgate": "d7c04513b86ace73",
}


# fields that came later: at their defaults they change nothing
LATER = {"trajectory": (), "contact": "end", "policy": "", "draw": None, "lateral": (), "lateral_targets": ()}
LATER |= {"acceleration": None, "jerk": None, "shape": "linear", "duration": None, "distance": None, "arrival": None}
LATER |= {"name": "", "reference": "", "factor": False, "continuous": False, "anytime": False, "agent": "", "phase": ""}
LATER |= {"position": None, "rule": "", "edge": "none", "delay": 0.0, "free_space": False, "measure": "straight"}
LATER |= {"all": (), "any": (), "gap": None}
LATER |= {"impact": None, "declared": {}, "expressions": {}, "constraints": ()}
LATER |= {"body": Body(), "ego_body": Body(), "ego_model": "car", "friction": Scenario.friction, "heights": ()}
LATER |= {"elsewhere": "program", "driver": None, "drivers": "uniform", "errors": 0.0, "walkers": 0, "cyclists": 0}
LATER |= {"walk": None}
# ten draws of traffic on so many junction routes of a town, as the set `natural` then was
ROUTES = {"Twinford": 7, "Crossgate": 8}


def feed(digest: Any, value: object) -> None:
    """Add a value to a hash: numbers to a millionth, so that the last digits of a processor's sine do not count."""
    if isinstance(value, np.ndarray):
        digest.update(str((value.dtype, value.shape)).encode())
        digest.update((np.round(value.astype(np.float64), 6) + 0.0).tobytes())
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if field.name in LATER and getattr(value, field.name) == LATER[field.name]:
                continue
            digest.update(f"{field.name}=".encode())
            feed(digest, getattr(value, field.name))
    elif isinstance(value, Mapping):
        feed(digest, sorted(value.items()))
    elif isinstance(value, (tuple, list)):
        for item in value:
            feed(digest, item)
        digest.update(b";")
    elif isinstance(value, float):
        digest.update(f"{round(value, 6) + 0.0},".encode())
    else:
        digest.update(f"{value!r},".encode())


def fingerprint(episodes: list[Episode]) -> str:
    digest = hashlib.sha256()
    for episode in episodes:
        feed(digest, episode)
    return digest.hexdigest()[:16]


@pytest.mark.parametrize("name", NOMINAL)
def test_without_spread_the_episodes_are_what_they_were(name: str) -> None:
    if name in ROUTES:
        every = {s.name: s for s in load_scenarios("natural-unselected")}
        routes = [f"{name}_{i:02d}" for i in range(ROUTES[name])]
        scenarios = [
            dataclasses.replace(
                every[f"natural-unselected/{route}/00"], name=f"natural/{route}/{k:02d}", seed=k, traffic=None
            )
            for route in routes
            for k in range(10)
        ]
    else:
        scenarios = list(load_scenarios(name))
    episodes = [build_episode(s, load_town(s.town), seed=0) for s in scenarios]
    assert fingerprint(episodes) == NOMINAL[name]


@pytest.mark.parametrize("scenario", [SHIPPED[0], NATURAL[0]], ids=lambda s: s.name)
def test_no_spread_is_the_default(scenario: Scenario) -> None:
    nominal = build_episode(scenario, load_town(scenario.town), seed=4)
    assert fingerprint([build(scenario, 4, spread=0.0)]) == fingerprint([nominal])
    assert fingerprint([build(scenario, 4)]) != fingerprint([nominal])
    assert nominal.scenario.parameters == scenario.parameters


# ---------------------------------------------------------------- the draws


def test_the_box_lies_around_the_scenarios_own_values_and_inside_the_limits() -> None:
    scenario = Scenario(
        "a",
        "StraightObstacle",
        "T",
        (Pose(0, 0), Pose(1, 0)),
        parameters={"trigger_distance": 16.0, "walker_speed": 1.0, "ego_lateral": 0.2},
        target_speed=10.0,
    )
    ranges = sampling_ranges(scenario)
    box = scenario_type(scenario.type).box
    assert set(ranges) == {*box, "target_speed"}
    assert ranges["trigger_distance"] == (15.0, 18.0)  # 16 +- 2, not below 15
    assert ranges["walker_speed"] == pytest.approx((0.55, 1.45))
    assert ranges["start_distance"] == (42.0, 48.0)
    assert ranges["lateral"] == (0.85, 1.0)
    assert ranges["ego_lateral"] == pytest.approx((-0.175, 0.575))
    assert ranges["ego_longitudinal"] == (0.0, 4.0)
    assert ranges["target_speed"] == (8.75, 11.25)
    assert sampling_ranges(scenario, spread=2.0)["start_distance"] == (39.0, 51.0)
    assert sampling_ranges(scenario, spread=0.0) == {}
    wide = sampling_ranges(scenario, spread=1.0e6)
    assert all(wide[name] == (box[name].low, box[name].high) for name in box)
    assert wide["target_speed"] == (1.0, 60.0)
    for spread in (-0.1, math.nan, math.inf):
        with pytest.raises(ConfigError, match=r"spread .* is not valid"):
            sampling_ranges(scenario, spread=spread)
        with pytest.raises(ConfigError, match=r"spread .* is not valid"):
            build(SHIPPED[0], 0, spread=spread)


@pytest.mark.parametrize("kind", PRECRASH)
def test_draws_fill_the_box_evenly(kind: str) -> None:
    (scenario, *_) = load_scenarios(kind)
    draws = [sample_parameters(scenario, generator("test", k)) for k in range(400)]
    ranges = sampling_ranges(scenario)
    assert set(ranges) >= {"trigger_distance", "ego_speed", "ego_lateral", "ego_heading", "target_speed"}
    columns = []
    for name, (low, high) in ranges.items():
        values = [d.target_speed if name == "target_speed" else d.parameters[name] for d in draws]
        assert low <= min(values) < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < max(values) <= high
        columns.append(np.subtract(values, low) / (high - low))
    shares = np.array(columns)
    assert np.allclose(shares.mean(axis=1), 0.5, atol=0.07)
    assert np.allclose(shares.std(axis=1), 1.0 / math.sqrt(12.0), atol=0.03)
    # each number is drawn for itself
    assert np.abs(np.corrcoef(shares) - np.eye(len(shares))).max() < 0.25
    assert {(d.name, d.town, d.route, d.signals, d.seed) for d in draws} == {
        (scenario.name, scenario.town, scenario.route, scenario.signals, scenario.seed)
    }


def test_what_has_no_spread_is_kept() -> None:
    (scenario,) = load_scenarios("TurningObstacle/00")
    shifted = dataclasses.replace(scenario, parameters={**scenario.parameters, "longitudinal": 2.0})
    assert sample_parameters(shifted, generator("test")).parameters["longitudinal"] == 2.0
    assert sample_parameters(shifted, generator("test"), spread=0.0) == shifted


def test_a_draw_is_the_same_everywhere() -> None:
    (scenario,) = load_scenarios("RightTurn/00")
    drawn = build(scenario, 7).scenario
    assert drawn.parameters == pytest.approx(
        {
            "trigger_distance": 35.972973619,
            "speed": 12.488395077,
            "longitudinal": 0.725879497,
            "ego_speed": 0.577529987,
            "ego_longitudinal": 1.023869727,
            "ego_lateral": -0.180276523,
            "ego_heading": -0.016329455,
        },
        abs=1e-8,
    )
    assert drawn.target_speed == pytest.approx(7.580674734, abs=1e-8)


@pytest.mark.parametrize("scenario", [*SHIPPED[::4], NATURAL[3], CUSTOM], ids=lambda s: s.name)
def test_a_draw_can_be_saved_and_replayed(scenario: Scenario, tmp_path: Path) -> None:
    first, second = (build(scenario, seed) for seed in (1, 2))
    save_scenarios(tmp_path / "draw.yaml", first.scenario)
    (saved,) = read_scenarios(tmp_path / "draw.yaml")
    assert fingerprint([build(saved, 1, spread=0.0)]) == fingerprint([first])
    # in any order, and nothing is shared by two seeds, two scenarios or two spreads
    assert fingerprint([build(scenario, 2)]) == fingerprint([second])
    assert fingerprint([build(scenario, 1)]) == fingerprint([first])
    other = build(dataclasses.replace(scenario, name="other"), 1)
    little = build(scenario, 1, spread=0.5)
    starts = [(e.agents[0].pose, e.agents[0].speed, e.agents[0].target_speed) for e in (first, second, other, little)]
    assert len(set(starts)) == 4
    assert len({e.key for e in (first, second, other, little)}) == 4


def test_only_the_ego_differs_where_the_actors_are_not_a_classs() -> None:
    for scenario in (CUSTOM, NATURAL[5]):
        nominal, drawn = build(scenario, 3, spread=0.0), build(scenario, 3)
        assert fingerprint([dataclasses.replace(nominal, agents=nominal.agents[1:], key="", scenario=scenario)]) == (
            fingerprint([dataclasses.replace(drawn, agents=drawn.agents[1:], key="", scenario=scenario)])
        )
        assert nominal.agents[0] != drawn.agents[0]


def test_the_ego_starts_where_its_parameters_say() -> None:
    values = {"ego_speed": 1.5, "ego_longitudinal": 2.5, "ego_lateral": 0.5, "ego_heading": 0.1}
    scenario = dataclasses.replace(SHIPPED[0], parameters=values, target_speed=9.0)
    ego = build(scenario, 0, spread=0.0).agents[0]
    assert (ego.speed, ego.target_speed) == (1.5, 9.0)
    assert (ego.pose.x, ego.pose.y, ego.pose.yaw) == pytest.approx((219.5, -4.75, 0.1))  # the route runs east
    # half way between two points of a bend, on its chord
    bend = Route(
        np.array([[0, 0], [1, 0], [1, 1]], np.float32),
        np.array([3.0, -3.0, -2.0], np.float32),
        np.zeros(3, np.int32),
        np.ones(3, np.float32),
        np.ones(3, np.float32),
    )
    pose = _pose_beside_route(bend, 0.5, 0.0, 0.0)
    assert (pose.x, pose.y, abs(pose.yaw)) == pytest.approx((0.5, 0.0, math.pi), abs=1e-6)
    assert _pose_beside_route(bend, 99.0, 0.0, 0.0) == Pose(1.0, 1.0, -2.0)
    # nominally just the route's first point: pi as a float32 is more than pi, and stays so
    west = dataclasses.replace(bend, yaw=np.full(3, np.pi, np.float32))
    assert _pose_beside_route(west, 0.0, 0.0, 0.0).yaw == float(np.float32(np.pi))


def boxes(episode: Episode) -> np.ndarray:
    rows = []
    for agent in episode.agents:
        body = model(agent.model)
        rows.append((agent.pose.x, agent.pose.y, agent.pose.yaw, body.length, body.width))
    return np.array(rows)


@pytest.mark.parametrize("name", [*PRECRASH, "natural"])
def test_nobody_starts_in_contact_and_the_ego_starts_in_its_lane(name: str) -> None:
    scenarios = load_scenarios(name) if name in PRECRASH else NATURAL[::15]
    for scenario, seed in itertools.product(scenarios, range(6 if name in PRECRASH else 1)):
        episode = build(scenario, seed)
        rows = boxes(episode)
        for first, second in itertools.combinations(rows, 2):
            assert obb_distance(first, second) > 0.0, (scenario.name, seed)
        route = episode.agents[0].route
        assert route is not None
        off = rows[0, :2] - route.xy[:6].astype(float)
        near = int(np.argmin(np.hypot(*off.T)))
        beside = abs(off[near] @ (-math.sin(route.yaw[near]), math.cos(route.yaw[near])))
        turn = abs(math.remainder(rows[0, 2] - float(route.yaw[near]), math.tau))
        body = model("car")
        assert beside + 0.5 * body.width + 0.5 * body.length * turn < 0.5 * float(route.width[near])
        if name in PRECRASH:  # the scenario begins later
            actors = episode.agents[1:]
            when = next(a for a in actors if a.phases).phases[0].when
            reference = actors[when.actor].pose
            assert math.hypot(rows[0, 0] - reference.x, rows[0, 1] - reference.y) > when.value


def test_a_draw_without_room_is_drawn_again() -> None:
    def with_cone(x: float) -> Scenario:
        return dataclasses.replace(CUSTOM, actors=(Actor("cone", "cone", Pose(x, -5.25)),))

    front, half = 217.0 + 0.5 * model("car").length, 0.5 * model("cone").length
    tight = with_cone(front + half + 2.0)  # of the 4 m that the ego may be ahead, two are free
    again = 0
    for seed in range(12):
        episode = build(tight, seed)
        assert obb_distance(*boxes(episode)) > 0.0
        random = generator("scenario", tight.name, tight.seed, seed, "spread", 0)
        again += episode.scenario.parameters != sample_parameters(tight, random).parameters
    assert again > 2
    blocked = with_cone(front + half + 1e-4)
    assert obb_distance(*boxes(build(blocked, 0, spread=0.0))) > 0.0
    with pytest.raises(RouteError, match=r"cone stands in the ego .*the last of 8 draws with seed 0 and spread 1;"):
        build(blocked, 0)


def test_actors_that_are_drawn_into_each_other_are_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = scenario_type("LaneChanging")

    def crowded(scenario: Scenario, *rest: Any) -> Any:
        leader, neighbour = kind.build(scenario, *rest)
        near = scenario.parameters.get("gap", 1.0) > 1.0
        return leader, dataclasses.replace(neighbour, pose=leader.pose) if near else neighbour

    monkeypatch.setattr(
        "ssad.scenarios.dynamic.episode.scenario_type", lambda name: dataclasses.replace(kind, build=crowded)
    )
    (scenario,) = load_scenarios("LaneChanging/00")
    gaps = [build(scenario, seed).scenario.parameters["gap"] for seed in range(6)]
    assert max(gaps) <= 1.0


def test_parameters_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="spread"):
        Parameter("a", 0.0, 1.0, 0.5, "m", "", 1.5)
    with pytest.raises(ValueError, match="spread"):
        Parameter("a", 0.0, 1.0, 0.5, "m", "", -0.1)
    with pytest.raises(ValueError, match="twice"):
        ScenarioType("A", "a", "a", lambda s, g, r, n: [], (Parameter("ego_speed", 0.0, 1.0, 0.5, "m/s", ""),))


# ---------------------------------------------------------------- what is worked out once


def test_a_second_draw_searches_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    scenarios = [s for s in SHIPPED if s.type in ("UnprotectedLeftTurn", "StraightObstacle")]
    before = [build(s, 0) for s in scenarios]

    def never(*arguments: object, **options: object) -> None:
        raise AssertionError("searched again")

    monkeypatch.setattr(_meeting, "_best_start", never)
    monkeypatch.setattr("ssad.world.roads.route_along", never)
    for scenario, first in zip(scenarios, before, strict=True):
        second = build(scenario, 1)
        assert second.agents[0].route is first.agents[0].route
        with pytest.raises(AssertionError, match="again"):  # another road is another question
            build(dataclasses.replace(scenario, route=scenario.route[::-1]), 1)


def test_what_episodes_share_cannot_be_changed() -> None:
    episode = build(SHIPPED[0], 0)
    route = episode.agents[0].route
    assert route is not None
    for values in (route.xy, route.yaw, route.lane, route.speed_limit, route.width):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0
    (scenario,) = load_scenarios("RightTurn/00")
    signals = build(scenario, 0).signal_override
    assert signals is not build(scenario, 0).signal_override
    assert signals


def test_answers_are_kept_by_map_and_route(crossroads: LaneGraph, routes: Any) -> None:
    calls = []

    @cached_by_identity(2)
    def ask(graph: LaneGraph, route: Route, number: int) -> int:
        calls.append((graph, route, number))
        if number < 0:
            raise RouteError("no")
        return number + len(route.xy)

    assert ask(crossroads, routes.left, 1) == ask(crossroads, routes.left, 1) == 1 + len(routes.left.xy)
    assert len(calls) == 1
    copy = dataclasses.replace(routes.left)  # equal, but nobody can tell without comparing every number
    assert ask(crossroads, copy, 1) == 1 + len(copy.xy)
    assert ask(dataclasses.replace(crossroads), routes.left, 1) == 1 + len(routes.left.xy)
    assert len(calls) == 3
    ask(crossroads, routes.left, 1)  # of the two that are kept, neither is this one
    assert len(calls) == 4
    for _ in range(2):
        with pytest.raises(RouteError):
            ask(crossroads, routes.left, -1)
    assert len(calls) == 6
    with pytest.raises(TypeError, match="by position"):
        ask(crossroads, routes.left, number=1)


@pytest.mark.parametrize("length", [0.5, 100_001.0, 1e300])
def test_a_path_of_an_actor_has_a_plausible_length(length: float) -> None:
    with pytest.raises(RouteError, match=r"too short|too long"):
        polyline_route(np.array([[0.0, 0.0], [length, 0.0]]))


def test_the_trigger_is_found_on_the_route_that_is_asked_about() -> None:
    east = polyline_route(np.array([[0.0, 0.0], [50.0, 0.0]]))
    later = polyline_route(np.array([[10.0, 0.0], [50.0, 0.0]]))
    scenario = dataclasses.replace(CUSTOM, trigger=Pose(20.0, 0.0))
    assert (trigger_index(scenario, east), trigger_index(scenario, later)) == (20, 10)


# ---------------------------------------------------------------- what comes of it


def check_danger(seeds: int) -> dict[str, Any]:
    """Every seed another motion, no contact at the start, and the blind follower hit in most draws of every class."""
    rates: dict[str, Any] = measured()["danger"](seeds)
    assert list(rates) == list(PRECRASH)
    for name, systems in rates.items():
        for system, row in systems.items():
            assert row["motions"] == [seeds] * 4, (name, system)
            assert row["contact_at_start"] == 0, (name, system)
        assert systems["blind"]["nominal"] == 1.0, name
        assert systems["blind"]["drawn"] > 0.6, name
        assert systems["autopilot"]["drawn"] < 0.2, name
    return rates


def test_every_seed_is_a_dangerous_episode_of_its_own() -> None:
    check_danger(3)


@pytest.mark.slow
def test_the_page_says_how_dangerous_the_draws_are() -> None:
    rates = check_danger(50)
    page = (ROOT / "docs" / "results" / "traffic.md").read_text()
    for name, systems in rates.items():
        row = next(line for line in page.splitlines() if line.startswith(f"| {name} |") and line.count("|") == 6)
        told = [float(cell) for cell in row.strip("|").split("|")[1:]]
        now = [systems[s][case] for s in ("blind", "autopilot") for case in ("nominal", "drawn")]
        assert told == pytest.approx(now, abs=0.03), name  # a processor's last digits may turn a near miss

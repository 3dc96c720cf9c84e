"""Careful drivers at the wheel: they keep their route, stop for what they see, and are drivers like any other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.traces import first_difference
from ssad.core.types import Controller, EpisodeAgent, EpisodeLimits, EpisodeTrace, Phase, Pose, SignalState
from ssad.drivers import make_system
from ssad.drivers.careful import careful_model
from ssad.drivers.careful.driver import Careful
from ssad.drivers.careful.sight import Path
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.models import model
from ssad.world.roads.library import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode, line_route

SYSTEMS = ("careful-cc", "careful-reg157", "careful-rss", "careful-fsm")


@pytest.mark.parametrize("name", SYSTEMS)
def test_they_stop_behind_who_stands_and_go_their_way_else(name: str) -> None:
    car = EpisodeAgent("car", "car", Controller.NONE, Pose(100.0, 0.0, 0.0))
    beside = EpisodeAgent("beside", "car", Controller.NONE, Pose(60.0, 3.5, 0.0))
    blocked, free = rollout(
        World([episode(ego(speed=8.0), car, key="a"), episode(ego(speed=8.0), beside, key="b")], GRAPHS),
        make_system(name),
    )
    assert blocked.end != "collision"
    assert blocked.x[-1, 0] > 85.0
    assert blocked.speed[-1, 0] < 0.5
    assert free.end == "complete"


def car_in_front(x: float, speed: float, controller: Controller = Controller.FOLLOW) -> EpisodeAgent:
    """A car in the lane of the ego, `x` m along it."""
    phases = (Phase(speed),) if controller == Controller.SCRIPT else ()
    route = line_route(x, 395.0)
    return EpisodeAgent(
        "lead", "car", controller, Pose(x, 0.0, 0.0), speed=speed, target_speed=speed, route=route, phases=phases
    )


def stopping_car(x: float, speed: float, brake: float) -> EpisodeAgent:
    """A car that brakes after a second and then stands."""
    times = np.arange(0.0, 40.0, 0.2)
    braking_time = np.clip(times - 1.0, 0.0, speed / brake)
    distance = speed * np.minimum(times, 1.0) + speed * braking_time - 0.5 * brake * braking_time**2
    rows = tuple((float(t), x + float(d), 0.0, 0.0) for t, d in zip(times, distance, strict=True))
    return EpisodeAgent("lead", "car", Controller.TRAJECTORY, Pose(x, 0.0, 0.0), trajectory=rows)


def gaps(trace: EpisodeTrace) -> np.ndarray:
    return trace.x[:, 1] - trace.x[:, 0] - model("car").length


@pytest.mark.parametrize("name", SYSTEMS)
def test_they_keep_their_gap_behind_slower_standing_and_braking_cars(name: str) -> None:
    careful = careful_model(name.removeprefix("careful-"))
    following_gap = lambda speed: float(careful.following_gap(np.array(speed)))  # noqa: E731
    start = 10.0 + model("car").length
    slower = {
        f"{speed:g} behind {lead:g}": episode(
            ego(speed=speed, target_speed=speed), car_in_front(80.0, lead), key=f"{speed} behind {lead}"
        )
        for speed, lead in ((8.0, 3.0), (15.0, 5.0), (5.0, 1.0), (12.0, 9.0))
    }
    # "3 m/s" of a script is between 2.2 and 3.4 m/s
    scripted = episode(ego(speed=8.0), car_in_front(80.0, 3.0, Controller.SCRIPT), key="script")
    standing = [
        episode(ego(speed=speed, target_speed=speed), car_in_front(90.0, 0.0, Controller.NONE), key=f"standing {speed}")
        for speed in (3.0, 8.0, 15.0)
    ]
    braking = [
        episode(
            ego(speed=speed, target_speed=speed),
            stopping_car(start + following_gap(speed), speed, brake),
            key=f"braking {speed} {brake}",
        )
        for speed, brake in ((8.0, 4.0), (12.0, 6.0), (15.0, 8.0))
    ]
    episodes = [*slower.values(), scripted, *standing, *braking]
    traces = dict(zip([one.key for one in episodes], rollout(World(episodes, GRAPHS), make_system(name)), strict=True))
    for key, trace in traces.items():
        assert not trace.contact.any(), key
        assert gaps(trace).min() > 2.5, key
    for one in slower.values():
        lead = one.agents[1].speed
        assert gaps(traces[one.key]).min() > 0.9 * following_gap(lead), one.key
    for one in standing:
        # it comes near and stands
        assert gaps(traces[one.key])[-1] < 5.0, one.key
        assert traces[one.key].speed[-1, 0] < 0.1, one.key


@pytest.mark.parametrize("name", SYSTEMS)
def test_they_do_not_brake_at_a_safe_gap_and_open_one_that_is_too_small(name: str) -> None:
    gap = float(careful_model(name.removeprefix("careful-")).following_gap(np.array(8.0)))
    start = 10.0 + model("car").length
    safe = episode(ego(speed=8.0), car_in_front(start + gap + 0.5, 8.0), key="safe")
    near = episode(ego(speed=8.0), car_in_front(start + 4.0, 8.0), key="near")
    safe_trace, near_trace = rollout(World([safe, near], GRAPHS), make_system(name))
    assert not safe_trace.brake.any()
    assert safe_trace.speed[:, 0] == pytest.approx(np.full(len(safe_trace.x), 8.0), abs=0.05)
    assert gaps(near_trace)[-1] > 0.95 * gap
    assert gaps(near_trace).min() > 3.5


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_witness_follows_only_whom_its_model_has_braked_for(name: str) -> None:
    """A grade judges the model, so a driver that takes over at a danger has no anticipation of its own."""
    careful = careful_model(name.removeprefix("careful-"))
    scene = [episode(ego(speed=8.0), car_in_front(60.0, 3.0), key="lead", limits=EpisodeLimits(max_steps=200))]
    (driven,) = rollout(World(scene, GRAPHS), Careful(careful.name))
    (graded,) = rollout(World(scene, GRAPHS), Careful(careful.name, keep_speed=True))
    gap_at_braking = lambda trace: gaps(trace)[trace.speed[:, 0] < 7.7].max()  # noqa: E731
    assert gap_at_braking(driven) > gap_at_braking(graded) + 5.0
    assert not graded.contact.any()
    # it does not speed up again towards the car in front
    assert graded.speed[-50:, 0].max() < 3.3
    assert gaps(graded)[-1] > 0.9 * max(float(careful.following_gap(np.array(3.0))), 3.0)


def test_they_keep_a_route_with_bends_and_stop_for_red() -> None:
    town = load_town("Crossgate")
    scenario = load_scenarios("natural/Crossgate_00/00")[0]
    one = build_episode(scenario, town, seed=0)
    lamps = range(len(town.signal_phase))
    alone = replace(one, agents=one.agents[:1], override_until=1e6)
    green = replace(alone, signal_override=dict.fromkeys(lamps, SignalState.GREEN), key="green")
    red = replace(alone, signal_override=dict.fromkeys(lamps, SignalState.RED), key="red")
    free, held = rollout(World([green, red], {town.name: town}), make_system("careful-cc"))
    assert free.end == "complete"
    assert not free.off_road.any()
    assert free.route_distance.max() < 1.5
    assert held.red_light.sum() == 0
    assert held.driven[-1] < 0.8 * free.driven[-1]


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_scene_is_driven_alone_as_in_a_batch_and_again_the_same(name: str) -> None:
    cars = [EpisodeAgent(f"c{k}", "car", Controller.NONE, Pose(30.0 + 12.0 * k, 0.5 * k, 0.0)) for k in range(3)]
    crowd = [episode(ego(speed=8.0), car, key=car.name, limits=EpisodeLimits(max_steps=60)) for car in cars]
    driver = make_system(name)
    together = rollout(World(crowd, GRAPHS), driver)
    for one, trace in zip(crowd, together, strict=True):
        assert first_difference(rollout(World([one], GRAPHS), driver)[0], trace) is None


def test_places_are_found_along_a_bent_path() -> None:
    turn = np.stack([np.minimum(np.arange(1.0, 41), 20.0), np.maximum(np.arange(1.0, 41) - 20.0, 0.0)], 1)
    path = Path(turn[None])
    s, left, heading = path.project(np.array([[[10.0, 1.0], [18.0, 10.0], [-5.0, -2.0], [20.0, 60.0]]]))
    here, _, _ = path.project(np.zeros((1, 1, 2)))
    assert s[0] - here[0, 0] == pytest.approx([10.0, 30.0, -5.0, 80.0])
    assert left[0] == pytest.approx([1.0, 2.0, -2.0, 0.0])
    assert heading[0] == pytest.approx([0.0, np.pi / 2, 0.0, np.pi / 2])
    assert path.at(here[:, 0] + 30.0, np.array([2.0]))[0] == pytest.approx([18.0, 10.0])

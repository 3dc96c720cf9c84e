"""Careful drivers at the wheel: they keep their route, stop for what they see, and are drivers like any other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.traces import first_difference
from ssad.core.types import Controller, EpisodeAgent, EpisodeLimits, Pose, SignalState
from ssad.drivers import make_system
from ssad.drivers.careful.sight import Path
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads.library import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode

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

"""A driver with a period of its own, such as an agent of the leaderboard at 20 Hz, gets it everywhere or is refused."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.generators import Proposal
from ssad.core.types import Controller, Episode, EpisodeLimits
from ssad.experiments.how_often.failure_rate import ChanceEpisode
from ssad.interchange.export import _with_trajectories
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.scenarios.dynamic.generate import Trials
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

STEPS = 5  # of 0.1 s


@dataclass
class Metronome:
    """Notes when it is asked, every 0.05 s, and drives straight on."""

    name: str = "metronome"
    controller: Controller = Controller.EXTERNAL
    period: float = 0.05
    times: list[float] = field(default_factory=list)

    def reset(self, episodes: Any) -> None:
        self.times.clear()

    def act(self, view: Any) -> Any:
        self.times.append(float(view.time[0]))
        return np.tile(np.float32([0.5, 0.0, 0.0]), (len(view.scene), 1))


@pytest.fixture
def episode() -> Episode:
    scenario = load_scenarios("StraightObstacle/00")[0]
    short = replace(scenario, limits=EpisodeLimits(max_steps=STEPS))
    return build_episode(short, load_town(scenario.town), seed=0)


def check_times(driver: Metronome) -> None:
    assert driver.times == pytest.approx(np.arange(2 * STEPS) / 20)


def test_searches_ask_it_twenty_times_a_second(episode: Episode) -> None:
    driver = Metronome()
    trials = Trials(lambda: driver)
    base = trials.base(episode.scenario, load_town(episode.town), seed=0)
    check_times(driver)
    assert (base.trace.dt, len(base.trace.x)) == (0.1, STEPS + 1)
    adversary = SimpleNamespace(name="adversary", controller=Controller.FOLLOW)
    with pytest.raises(ConfigError, match=r"metronome decides every 0\.05 s, and learned adversaries every 0\.1 s"):
        trials.run([(base, Proposal(episode.scenario, drivers={1: adversary}))])  # type: ignore[dict-item]


def test_collision_rates_are_those_of_its_period(episode: Episode) -> None:
    driver = Metronome()
    chance = ChanceEpisode(episode, load_town(episode.town), driver, {"accel": 1.0}, "cpu", 0)
    hours, _ = chance.usual(1)
    check_times(driver)
    assert hours * 3600.0 == pytest.approx(0.1 * STEPS)
    trace = chance.run_again({"keys": {"0": "7"}, "means": []})
    check_times(driver)
    assert (trace.dt, len(trace.x)) == (0.1, STEPS + 1)


def test_an_export_drives_with_its_period(episode: Episode, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Metronome()
    moving = build_episode(
        replace(load_scenarios("VehiclePassing/00")[0], limits=EpisodeLimits(max_steps=STEPS)),
        load_town("ProvingGround"),
        seed=0,
    )
    monkeypatch.setattr("ssad.drivers.make_system", lambda name: driver)
    _, is_changed = _with_trajectories(moving, load_town(moving.town), "metronome")
    assert is_changed
    check_times(driver)


def test_a_simulator_with_longer_steps_refuses_it(episode: Episode, tmp_path: Path) -> None:
    world = World([episode], {episode.town: load_town(episode.town)})
    with pytest.raises(ConfigError, match=r"metronome decides every 0\.05 s, and World has steps of 0\.1 s") as refusal:
        rollout(world, Metronome())
    assert "\n" not in str(refusal.value)

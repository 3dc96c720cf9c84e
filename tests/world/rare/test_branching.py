"""Drivers with a memory: Monte Carlo is right for all, splitting for those that save it, and refused to the others."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import memory_drivers

from ssad.core.driving import Branching, Driver, Observation
from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.core.types import F32, Controller, Episode
from ssad.drivers import make_system
from ssad.drivers.belief import DegradedBelief
from ssad.metrics.rare_events import RareEstimate
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.noise import Keys, Noise
from ssad.world.rare.branching import branch_obstacle
from ssad.world.rare.brute import monte_carlo
from ssad.world.rare.process import WorldProcess
from ssad.world.rare.splitting import Splitting, splitting
from ssad.world.roads import load_town
from ssad.world.rollout import Loop
from ssad.world.world import World
from tests.helpers.walk import Walk

NOISE = Noise(accel=2.0, accel_time=1.5, stretches=3)
(SCENARIO,) = load_scenarios("lane-traffic/05")
GRAPHS = {SCENARIO.town: load_town(SCENARIO.town)}
EPISODE = build_episode(SCENARIO, GRAPHS[SCENARIO.town], seed=0)


def process(driver: Driver, batch: int, noise: Noise = NOISE, **settings: Any) -> WorldProcess:
    world = World([EPISODE], GRAPHS, assign=np.zeros(batch, int), noise=noise)
    return WorldProcess(Loop(world, {0: driver}, **settings))


def counted(driver: Driver) -> tuple[RareEstimate, Keys]:
    *_, result = monte_carlo(process(driver, 500), generator("counted"), episodes=1000)
    return result


def split(driver: Driver) -> Splitting:
    return splitting(process(driver, 200), generator("split"), repeats=10)


@pytest.fixture(scope="module")
def clock_split() -> Splitting:
    """The estimate for the driver that has no memory, and drives like those that have one."""
    return split(memory_drivers.Clock())


def test_monte_carlo_of_a_hidden_counter_is_that_of_the_clock_which_it_counts() -> None:
    truth, keys = counted(memory_drivers.Clock())
    assert truth.events > 20
    hidden, hidden_keys = counted(memory_drivers.Hidden())
    assert hidden == truth
    np.testing.assert_array_equal(hidden_keys, keys)
    # one by one, outside of a process
    for key, collides in ((keys[0], True), (np.uint64(0), False)):
        world = World([EPISODE], GRAPHS, noise=NOISE)
        loop = Loop(world, {0: memory_drivers.Hidden()})
        loop.reset()
        world.rekey(np.array([key], np.uint64))
        while not world.ended()[0]:
            loop.step()
        assert (world.state().contact[0] > 0) == collides


def test_a_memory_that_is_saved_is_split_like_none_and_agrees_with_monte_carlo(clock_split: Splitting) -> None:
    saved = split(memory_drivers.Saved())
    np.testing.assert_array_equal(saved.estimates, clock_split.estimates)
    estimate, (plain, _) = saved.estimate(), counted(memory_drivers.Saved())
    assert 0.0 < estimate.low < plain.high
    assert plain.low < estimate.high


@pytest.mark.parametrize(
    ("driver", "reason"),
    [
        (memory_drivers.Hidden, r"hidden has no methods snapshot\(\) and restore\(states\), so splitting"),
        (memory_drivers.Forgetful, "forgetful: 60 of 60 episodes went another way"),
        (memory_drivers.Undeclared, "undeclared: .* went another way from a restored snapshot, the first in step 3"),
        (memory_drivers.Shared, "shared: .* went another way"),
        (memory_drivers.Seeded, "seeded: .* went another way"),
        (memory_drivers.Dice, "dice: .* went another way"),
        (memory_drivers.Global, "global: .* went another way"),
        (memory_drivers.Rattled, "rattled: .* went another way"),
    ],
)
def test_a_memory_that_is_not_saved_is_refused_in_a_line(driver: type[Driver], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as refused:
        splitting(process(driver(), 60), generator("refused"), repeats=10)
    assert "\n" not in str(refused.value)
    assert "set methods=[monte-carlo]" in str(refused.value)


class Tiring(Walk):
    """A walk that goes on in longer steps once it is high, and does not save that it was."""

    name, external = "tiring", True

    def reset(self, keys: np.ndarray) -> None:
        super().reset(keys)
        self.tired = np.zeros(self.batch, bool)

    def step(self) -> None:
        self.means = np.where(self.tired[:, None], 1.0, np.zeros((self.batch, self.width)))
        super().step()
        self.tired |= self.at > 0.8 * self.height


def test_a_memory_that_shows_only_near_failures_is_refused_after_the_last_level() -> None:
    """None of the first episodes comes so near that the first test could notice it."""
    walk = Tiring(100, 20.0, steps=20)
    with pytest.raises(ConfigError, match=r"tiring: \d+ of 100 branched episodes end otherwise"):
        splitting(walk, generator("tiring"), repeats=1)
    walk.external = False
    assert splitting(walk, generator("tiring"), repeats=1).failed.any()


def test_a_test_of_branches_changes_no_estimate() -> None:
    plain = splitting(Walk(100, 9.26, steps=6), generator("same"), repeats=2)
    tested_walk = Walk(100, 9.26, steps=6)
    tested_walk.external = True
    tested = splitting(tested_walk, generator("same"), repeats=2)
    np.testing.assert_array_equal(tested.estimates, plain.estimates)
    np.testing.assert_array_equal(tested.keys, plain.keys)
    assert tested.work.sum() == pytest.approx(tested_walk.work())
    assert tested.work.sum() > plain.work.sum()


def test_the_careful_drivers_save_what_they_remember() -> None:
    driver = make_system("careful-fsm")
    assert isinstance(driver, Branching)
    rows = process(driver, 16)
    splitting(rows, generator("careful"), repeats=2)
    memory = rows.snapshot()
    assert (memory["driver.0.since"] > 0.0).any(), "it counts the time since it noticed a vehicle in front"
    assert memory["driver.0.follows"].shape == memory["driver.0.brake"].shape


def test_the_drivers_of_the_guide_branch() -> None:
    page = (Path(__file__).parents[3] / "docs" / "how-to" / "measure-failure-rates.md").read_text()
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)
    assert names["Mine"]().snapshot() == {}
    drowsy = names["Drowsy"]()
    drowsy.name, drowsy.controller = "drowsy", Controller.EXTERNAL
    rows = process(drowsy, 16)
    splitting(rows, generator("guide"), repeats=2)
    assert rows.snapshot()["driver.0.count"].any()


def test_learned_drivers_say_that_they_remember_nothing() -> None:
    pytest.importorskip("torch")
    rows = process(make_system("ppo"), 8)
    splitting(rows, generator("learned"), repeats=2)
    assert not any(name.startswith("driver.") for name in rows.snapshot())


class Malformed(memory_drivers.Saved):
    """Returns snapshots of a wrong form."""

    name = "malformed"

    def __init__(self, form: str) -> None:
        self.form, self.calls = form, 0

    def snapshot(self) -> Any:
        self.calls += 1
        return {
            "list": [self.count],
            "rows": {"count": self.count[:-1]},
            "number": {"count": 3},
            "objects": {"count": np.full(len(self.count), None)},
            "shape": {"count": np.zeros((len(self.count), self.calls))},
            "names": {"count": self.count} | ({"late": self.count} if self.calls > 3 else {}),
        }[self.form]


@pytest.mark.parametrize(
    ("form", "reason"),
    [
        ("list", "a list; expected arrays by name"),
        ("rows", r"\['count'\] has shape \(3,\) .* a row for each of the 4 episodes"),
        ("number", r"\['count'\] has shape \(\)"),
        ("objects", "type object; expected numbers"),
        ("shape", r"\['count'\] changed its shape or type in an episode; make it in reset\(\)"),
        ("names", r"\['late'\] changed"),
    ],
)
def test_snapshots_of_a_wrong_form_are_refused(form: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=f"malformed: snapshot.*{reason}"):
        splitting(process(Malformed(form), 4), generator("form"), repeats=2)


def test_a_driver_with_a_belief_is_run_and_not_branched() -> None:
    """A belief that misses nothing is the truth, so the failures are those of the Autopilot."""
    noise = Noise(accel=2.0, accel_time=1.5, lapse=0.4, choice_time=2.0, stretches=3)
    keys = generator("belief keys").integers(0, 2**64, 60, dtype=np.uint64)
    ends = []
    for driver in (make_system("autopilot"), DegradedBelief(missed=0.0)):
        rows = process(driver, 60, noise)
        rows.reset(keys)
        ends.append(rows.run())
    np.testing.assert_array_equal(ends[1], ends[0])
    assert ends[0].any()
    with pytest.raises(ConfigError, match=r"degraded plans over a belief.*methods=\[monte-carlo\]"):
        splitting(rows, generator("belief"), repeats=2)


def test_what_a_driver_draws_hangs_on_the_key_and_not_on_the_row() -> None:
    rows = process(DegradedBelief(missed=0.5, noise=1.0), 4, Noise())
    rows.reset(np.array([5, 6, 5, 6], np.uint64))
    for _ in range(20):
        rows.step()
    poses = rows.world.array("pose")[:, 0]
    np.testing.assert_array_equal(poses[:2], poses[2:])
    assert (poses[0] != poses[1]).any()


def test_a_sensor_with_a_history_keeps_episodes_from_branching() -> None:
    class Looker(memory_drivers.Saved):
        name, sensors = "looker", ("eye",)

    class Eye:
        def follow(self, simulator: Any) -> None: ...

        def __call__(self, simulator: Any, agents: Any) -> Any:
            return np.zeros(len(agents))

    assert branch_obstacle(Looker(), ["other"]) == ""
    with pytest.raises(ConfigError, match="looker reads eye, whose history no snapshot holds"):
        splitting(process(Looker(), 4, sensors={"eye": Eye()}), generator("eye"), repeats=2)


def test_the_name_of_a_system_keeps_its_methods() -> None:
    saved = make_system("helpers.memory_drivers:Saved")
    saved.reset([EPISODE] * 2)
    assert isinstance(saved, Branching)
    saved.restore({"count": np.array([3, 4])})
    np.testing.assert_array_equal(saved.snapshot()["count"], [3, 4])
    assert not isinstance(make_system("helpers.memory_drivers:Hidden"), Branching)


def test_two_drivers_with_memories_are_saved_side_by_side() -> None:
    class Brakes:
        """Another agent's driver: goes, and brakes in every third step."""

        name, controller = "brakes", Controller.EXTERNAL

        def reset(self, episodes: Sequence[Episode]) -> None:
            self.count = np.zeros((len(episodes), 2), int)

        def snapshot(self) -> Mapping[str, Any]:
            return {"count": self.count}

        def restore(self, states: Mapping[str, Any]) -> None:
            self.count = states["count"]

        def act(self, view: Observation) -> F32:
            self.count[view.scene] += 1
            brake = self.count[view.scene, 0] % 3 == 0
            return np.stack([~brake * 0.2, brake * 0.2, 0.0 * brake], 1).astype(np.float32)

    world = World([EPISODE], GRAPHS, assign=np.zeros(20, int), noise=NOISE)
    rows = WorldProcess(Loop(world, {0: memory_drivers.Saved(), 1: Brakes()}))
    splitting(rows, generator("two"), repeats=2)
    states = rows.snapshot()
    assert states["driver.0.count"].shape == (20,)
    assert states["driver.1.count"].shape == (20, 2)
    assert rows.name == "saved and brakes"

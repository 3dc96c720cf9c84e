"""The one loop: drivers for any agent, takeovers in the middle of an episode, and what they see there."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from ssad.core.driving import LaneRelation, WorldState
from ssad.core.errors import ConfigError
from ssad.core.traces import trace_hash
from ssad.core.types import Contact, Controller, EpisodeAgent, EpisodeLimits, Pose
from ssad.drivers.builtin import Autopilot, Blind
from ssad.world.check import WorldCheckError, check_driver
from ssad.world.rollout import Loop, rollout
from ssad.world.world import World
from tests.world.test_world import bank
from tests.world.worlds import DEVICES, GRAPHS, ego, episode, line_route


class Pusher:
    """Goes ahead and steers as its agent's number says; looks at others, so that its bits depend on what it sees."""

    name = "pusher"
    controller = Controller.EXTERNAL

    def reset(self, episodes) -> None: ...

    def act(self, view):
        near = ((view.others[..., 6] > 0) & (np.abs(view.others[..., 0]) < 10.0)).sum(1) / 40.0
        return np.stack([0.5 + near, 0 * near, 0.02 * view.agent + 0.01 * near], 1).astype(np.float32)


@dataclass(frozen=True)
class Between:
    """Everybody but the ego and what cannot move, from one time to another, in scenes of even speed of the ego."""

    begin: float
    end: float

    def __call__(self, state: WorldState) -> np.ndarray:
        mask = state.active & (state.kind > 0) & (state.kind < 7)
        mask &= ((state.time >= self.begin - 1e-6) & (state.time < self.end - 1e-6))[:, None]
        mask[:, 0] = False
        return mask


def crowd() -> list:
    """The bank of the world's tests, with a cyclist in the way in some."""
    cyclist = EpisodeAgent(
        "b", "bicycle", Controller.FOLLOW, Pose(60.0, 0.0, 0.0), 3.0, 3.0, route=line_route(60.0, 300.0)
    )
    return [replace(e, agents=(*e.agents, cyclist)) if k % 2 else e for k, e in enumerate(bank())]


def drive(assign, device: str, *, steps: int = 60, drivers=None) -> list[list[str]]:
    """Hashes of each step."""
    episodes = crowd()
    world = World(episodes, GRAPHS, assign=assign, ego=Controller.AUTOPILOT, device=device)
    loop = Loop(world, drivers if drivers is not None else {Between(1.0, 3.0): Pusher()})
    loop.reset()
    out = []
    for _ in range(steps):
        loop.step()
        out.append(world.hashes())
    return out


@pytest.mark.parametrize("device", DEVICES)
def test_takeovers_do_not_depend_on_batch_or_order(device: str) -> None:
    order = [0, 1, 2, 3]
    told = drive(order, device)
    assert [row[::-1] for row in drive(order[::-1], device)] == told
    wide = drive([k % 4 for k in range(64)], device)
    assert all(row == [short[k % 4] for k in range(64)] for row, short in zip(wide, told, strict=True))
    for k in order:
        assert [row[0] for row in drive([k], device)] == [row[k] for row in told]
    untouched = drive(order, device, drivers={})
    assert untouched[:10] != told[:11]
    assert [a[0] == b[0] for a, b in zip(untouched, told, strict=True)] == [True] * 60  # nobody to take over there
    assert untouched[-1][2] != told[-1][2]


@pytest.mark.parametrize("device", DEVICES)
def test_a_takeover_in_one_scene_leaves_the_others_to_the_bit(device: str) -> None:
    class OnlyThird(Between):
        def __call__(self, state):
            return super().__call__(state) & (np.arange(len(state.time)) == 2)[:, None]

    told = drive([0, 1, 2, 3], device, drivers={})
    with_one = drive([0, 1, 2, 3], device, drivers={OnlyThird(1.0, 3.0): Pusher()})
    for k in range(4):
        same = [a[k] == b[k] for a, b in zip(told, with_one, strict=True)]
        assert all(same) == (k != 2)


@pytest.mark.parametrize("device", DEVICES)
def test_a_snapshot_in_the_middle_of_a_takeover_continues_to_the_bit(device: str) -> None:
    world = World(crowd(), GRAPHS, ego=Controller.AUTOPILOT, device=device)
    loop = Loop(world, {Between(1.0, 3.0): Pusher()})
    loop.reset()
    for _ in range(20):
        loop.step()
    kept = world.snapshot()
    assert (world.array("policy") == 0).sum() >= 3

    def rest() -> list[list[str]]:
        out = []
        for _ in range(30):
            loop.step()
            out.append(world.hashes())
        return out

    first = rest()
    world.restore(kept)
    assert rest() == first
    other = World(crowd(), GRAPHS, ego=Controller.AUTOPILOT, device=device)
    other.restore(kept)
    loop = Loop(other, {Between(1.0, 3.0): Pusher()})
    for hashes in first:
        loop.step()
        assert other.hashes() == hashes


def test_controllers_and_policies_are_in_the_hash() -> None:
    world = World(bank(), GRAPHS)
    before = world.hashes()
    mask = np.zeros((world.batch, world.agents), bool)
    mask[2, 1] = True
    world.take(mask, Controller.EXTERNAL, policy=4)
    after = world.hashes()
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, True, False, True]
    world.take(mask, Controller.EXTERNAL, policy=5)
    assert world.hashes()[2] != after[2]
    world.take(mask, None)
    assert world.hashes() == before


def test_who_is_given_back_goes_on_with_its_own_route() -> None:
    """A truck that a driver pushed along is the Autopilot's again, at its own speed, where it then is."""
    truck = EpisodeAgent(
        "t", "truck", Controller.AUTOPILOT, Pose(100.0, 3.5, np.pi), 4.0, 4.0, route=line_route(100.0, 5.0, 3.5)
    )
    world = World([episode(ego(controller=Controller.NONE), truck)], GRAPHS)

    class Fast:
        name, controller = "fast", Controller.EXTERNAL

        def reset(self, episodes): ...

        def act(self, view):
            return np.tile(np.array([1.0, 0.0, 0.0], np.float32), (len(view.agent), 1))

    loop = Loop(world, {Between(1.0, 6.0): Fast()})
    loop.reset()
    speeds = []
    for _ in range(100):
        loop.step()
        speeds.append(float(world.array("speed")[0, 1]))
    assert max(speeds) > 9.0
    assert speeds[-1] == pytest.approx(4.0, abs=0.3)
    assert abs(float(world.array("pose")[0, 1, 1]) - 3.5) < 0.3


def test_who_is_given_back_far_ahead_finds_its_place() -> None:
    """Placed 60 m down its route, further than a step's search reaches."""
    car = EpisodeAgent("c", "car", Controller.AUTOPILOT, Pose(30.0, 0.0), 5.0, 5.0, route=line_route(30.0, 230.0))
    world = World([episode(ego(controller=Controller.NONE), car)], GRAPHS)
    mask = np.array([[False, True]])
    world.take(mask, Controller.PLACED)
    world.place(np.array([[[0, 0, 0, 0], [90.0, 0.0, 0.0, 5.0]]], np.float32))
    world.step()
    np.testing.assert_allclose(world.array("pose")[0, 1], [90.0, 0.0, 0.0])
    assert world.array("travelled")[0, 1] == pytest.approx(60.0)
    world.take(mask, None)
    assert world.array("progress")[0, 1] == 60
    with pytest.raises(ConfigError, match="places"):
        world.place(np.full((1, 2, 4), np.nan))


def test_an_agent_can_be_removed() -> None:
    world = World(bank(), GRAPHS)
    mask = np.zeros((world.batch, world.agents), bool)
    mask[2, 1] = True
    world.remove(mask)
    assert world.state().active[:, 1].tolist() == [False, True, False, True]
    world.reset([2])
    assert world.state().active[2, 1]


def test_a_walker_can_be_steered() -> None:
    walker = EpisodeAgent("w", "walker", Controller.NONE, Pose(40.0, -6.0, 0.0))

    class Turner:
        name, controller = "turner", Controller.EXTERNAL

        def reset(self, episodes): ...

        def act(self, view):
            return np.tile(np.array([0.5, 0.0, 0.5], np.float32), (len(view.agent), 1))

    world = World([episode(ego(controller=Controller.NONE), walker)], GRAPHS)
    loop = Loop(world, {1: Turner()})
    loop.reset()
    for _ in range(10):
        loop.step()
    assert world.array("speed")[0, 1] == pytest.approx(2.0)
    assert world.array("pose")[0, 1, 2] == pytest.approx(np.pi / 2, abs=1e-4)


def test_a_sleeper_wakes_when_it_is_taken_over() -> None:
    asleep = EpisodeAgent(
        "t", "car", Controller.AUTOPILOT, Pose(200.0, 0.0), route=line_route(200, 300), wake_distance=9
    )
    world = World([episode(ego(), asleep)], GRAPHS)
    assert world.array("active")[0, 1] == 1
    world.take(np.array([[False, True]]), Controller.EXTERNAL)
    assert world.array("active")[0, 1] == 2


def test_two_drivers_in_one_scene_see_each_their_own() -> None:
    seen: dict[str, np.ndarray] = {}

    class Looker(Pusher):
        def __init__(self, name: str) -> None:
            self.name = name

        def act(self, view):
            seen.setdefault(self.name, view.pose.copy())
            return super().act(view)

    other = EpisodeAgent("o", "car", Controller.NONE, Pose(50.0, 3.5, np.pi), route=line_route(50.0, 5.0, 3.5))
    rollout(World([episode(ego(), other)], GRAPHS), {0: Looker("ego"), 1: Looker("other")})
    np.testing.assert_allclose(seen["ego"], [[10.0, 0.0, 0.0]])
    np.testing.assert_allclose(seen["other"], [[50.0, 3.5, np.pi]], rtol=1e-6)


def test_views_of_any_agent_mirror_each_other_and_name_lanes() -> None:
    found = {}

    class Looker(Pusher):
        def act(self, view):
            found.setdefault("view", view)
            return super().act(view)

    behind = EpisodeAgent("b", "car", Controller.NONE, Pose(30.0, 0.0), route=line_route(30.0, 200.0))
    beside = EpisodeAgent("o", "car", Controller.NONE, Pose(50.0, 3.5, np.pi), route=line_route(50.0, 5.0, 3.5))
    everybody = lambda state: state.active  # noqa: E731
    world = World([episode(ego(), behind, beside)], GRAPHS)
    loop = Loop(world, {everybody: Looker()})
    loop.reset()
    world.step()  # lanes are known after a step
    loop.step()
    view = found["view"]
    assert view.agent.tolist() == [0, 1, 2]
    np.testing.assert_allclose(view.others[0, :2, 0], [20.0, 40.0], atol=1e-4)
    np.testing.assert_allclose(view.others[1, :2, 0], [-20.0, 20.0], atol=1e-4)
    assert view.others_lane[0, :3].tolist() == [LaneRelation.SAME, LaneRelation.LEFT, LaneRelation.ELSEWHERE]
    assert view.others_lane[2, :2].tolist() == [LaneRelation.LEFT, LaneRelation.LEFT]
    assert view.readings == {}


def test_built_in_drivers_take_any_seat() -> None:
    second = EpisodeAgent("o", "car", Controller.NONE, Pose(40.0, 0.0), route=line_route(40.0, 300.0), target_speed=5.0)
    world = World([episode(ego(controller=Controller.NONE), second)], GRAPHS)
    trace = rollout(world, {0: Autopilot(), 1: Blind()})[0]
    assert trace.end == "complete"
    assert trace.speed[60, 1] == pytest.approx(10.0, abs=0.1)  # Blind brings its own target speed
    assert trace.speed[60, 0] == pytest.approx(8.0, abs=0.3)


def test_contacts_end_count_or_remove_as_the_scenario_says() -> None:
    box = EpisodeAgent("box", "cone", Controller.NONE, Pose(30.0, 0.0))
    policies = ("end", "count", "remove")
    episodes = [
        episode(ego(controller=Controller.FOLLOW, speed=8.0), box, key=p, limits=EpisodeLimits(contact=p))
        for p in policies
    ]
    ends, counts, present = [], [], []
    for trace in rollout(World(episodes, GRAPHS), {}):
        ends.append(trace.end)
        counts.append(int((trace.contact == Contact.STATIC).sum()))
        present.append(bool(trace.active[-1, 1]))
    assert ends == ["collision", "complete", "complete"]
    assert counts == [1, 1, 1]
    assert present == [True, True, False]


def test_what_a_driver_does_wrong_is_named() -> None:
    class Wrong(Pusher):
        def __init__(self, shape=(1, 3), value=0.0, sensors=()) -> None:
            self.shape, self.value, self.sensors = shape, value, sensors

        def act(self, view):
            return np.full(self.shape, self.value, np.float32)

    one = World([episode(ego())], GRAPHS)
    with pytest.raises(ConfigError, match=r"shape \(1, 2\), expected \(1, 3\)"):
        rollout(one, Wrong((1, 2)))
    with pytest.raises(ConfigError, match="not finite"):
        rollout(one, Wrong(value=np.nan))
    with pytest.raises(ConfigError, match="no agent 7"):
        rollout(one, {7: Wrong()})
    with pytest.raises(ConfigError, match="known: safebench"):
        rollout(one, Wrong(sensors=("sonar",)))


class Darker:
    """Scales pictures by a number of its generator."""

    def __init__(self) -> None:
        self.truths: list[WorldState] = []

    def apply(self, frames, victim, truth, generators):
        self.truths.append(truth)
        return frames * np.array([g.random() for g in generators], np.float32)[:, None, None, None]


def test_sensors_are_read_for_who_asks_and_pictures_are_perturbed() -> None:
    calls, shown = [], []

    def camera(simulator, agents):
        calls.append(len(agents))
        return np.ones((len(agents), 1, 2, 2), np.float32)

    class Watcher(Pusher):
        sensors = ("camera",)

        def act(self, view):
            shown.append(view.readings["camera"][:, 0, 0, 0].copy())
            return super().act(view)

    short = [replace(e, limits=EpisodeLimits(max_steps=3)) for e in bank()]
    rollout(World(short, GRAPHS), Pusher(), sensors={"camera": camera})
    assert calls == []
    rollout(World(short, GRAPHS), Watcher(), sensors={"camera": camera}, perturbation=Darker())
    assert calls == [4, 4, 4]
    together, shown[:] = np.array(shown), []
    assert len(np.unique(together)) == together.size
    rollout(World(short[1:2], GRAPHS), Watcher(), sensors={"camera": camera}, perturbation=Darker())
    np.testing.assert_array_equal(np.array(shown)[:, 0], together[:, 1])
    shown[:] = []
    by_name = {"camera": Darker()}
    rollout(World(short[1:2], GRAPHS), Watcher(), sensors={"camera": camera}, perturbation=by_name)
    np.testing.assert_array_equal(np.array(shown)[:, 0], together[:, 1])
    rollout(World(short[1:2], GRAPHS), Watcher(), sensors={"camera": camera}, perturbation={"rear": Darker()})
    assert (np.array(shown[-3:]) == 1.0).all(), "another sensor is attacked"
    shown[:] = []
    everybody = lambda state: state.active  # noqa: E731
    rollout(World(short[1:2], GRAPHS), {everybody: Watcher()}, sensors={"camera": camera}, perturbation=Darker())
    assert len(np.unique(np.concatenate(shown))) == 2 * 3  # a number of its own for every agent and step


def make_world(assign):
    return World(crowd(), GRAPHS, assign=assign)


class Steady(Pusher):
    """Pushes less from step to step, and saves what step it is."""

    def reset(self, episodes):
        self.count = np.zeros(len(episodes), np.float32)

    def act(self, view):
        self.count[view.scene] += 1
        return super().act(view) / self.count[view.scene, None]

    def snapshot(self):
        return {"count": self.count}

    def restore(self, states):
        self.count = states["count"]


@pytest.mark.parametrize("make", [Pusher, Autopilot, Blind, Steady])
def test_drivers_keep_their_promises(make) -> None:
    check_driver(make, make_world, episodes=4)


class Forgetful(Pusher):
    def __init__(self) -> None:
        self.steps = 0

    def act(self, view):
        self.steps += 1
        return super().act(view) * np.float32(1.0 / self.steps)


class Averaging(Pusher):
    def act(self, view):
        return super().act(view) * np.float32(view.speed.max() / 20.0)


class Wild(Pusher):
    def act(self, view):
        return super().act(view) * np.float32(3.0)


class Lossy(Steady):
    def restore(self, states): ...


class Narrow(Steady):
    def snapshot(self):
        return {"count": self.count[:1]}


@pytest.mark.parametrize(
    ("make", "promise"),
    [
        (Forgetful, "reset makes it forget"),
        (Averaging, "alone"),
        (Wild, "in range"),
        (Lossy, "a restored snapshot continues as before"),
        (Narrow, "a row for each episode"),
    ],
)
def test_check_driver_names_the_broken_promise(make, promise) -> None:
    with pytest.raises(WorldCheckError, match=promise):
        check_driver(make, make_world, episodes=4)


def test_the_examples_of_the_page_run() -> None:
    folder = Path(__file__).parents[2] / "docs" / "how-to"
    text = "".join((folder / f"{page}.md").read_text() for page in ("drive-agents", "plan-over-beliefs"))
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(block, names)
        assert len(names["traces"]) == 4
    assert all(trace.driven[-1] > 20.0 for trace in names["traces"])
    assert names["seen"].driven[-1] > 2.0  # neither is it dark nor has the ego come close to anything
    assert names["frames"].shape == (2, 3, 192, 320)


def test_traces_do_not_depend_on_what_else_is_in_the_batch() -> None:
    drivers = {0: Pusher(), Between(1.0, 3.0): Pusher()}
    told = [trace_hash(t) for t in rollout(make_world([0, 1, 2, 3]), drivers)]
    assert [trace_hash(rollout(make_world([k]), drivers)[0]) for k in range(4)] == told

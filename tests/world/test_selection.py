"""FREA's choice of adversaries: who is chosen, who is let go, and that what it remembers is part of the state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.types import Controller, EpisodeAgent, EpisodeLimits, Pose
from ssad.world.rollout import Loop
from ssad.world.selection import FreaSelection, Note
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode, line_route


def car(x: float, y: float = 0.0, yaw: float = 0.0, speed: float = 0.0, **more) -> EpisodeAgent:
    """A car on the road; those on the other lane drive west."""
    west = y > 1.0
    route = line_route(x, 5.0 if west else 390.0, y)
    return EpisodeAgent(
        "car", "car", Controller.AUTOPILOT, Pose(x, y, np.pi if west else yaw), speed, speed, route=route, **more
    )


def chosen(*agents: EpisodeAgent, graphs=GRAPHS, **settings) -> list[int]:
    """Whom the selection takes, the ego at x = 100, in the scene's first choice."""
    world = World([episode(ego(100.0, 0.0), *(replace(agent, controller=Controller.NONE) for agent in agents))], graphs)
    assert not FreaSelection(**settings)(world.state()).agents.any()
    world.step()
    world.step()
    return np.flatnonzero(FreaSelection(**settings)(world.state()).agents[0]).tolist()


def test_the_nearest_that_can_interact_is_chosen() -> None:
    assert chosen(car(120.0), car(112.0), car(80.0)) == [2]
    assert chosen(car(126.0)) == []  # farther than 25 m
    assert chosen(car(90.0)) == [1]  # behind, but it goes the ego's way
    assert chosen(replace(car(112.0), model="walker"), car(120.0)) == [2]


def test_the_opposite_lane_counts_inside_junctions_alone() -> None:
    junction = {"Straight": replace(GRAPHS["Straight"], junction=np.zeros(3, np.int32))}
    assert chosen(car(112.0, 3.5)) == []
    assert chosen(car(112.0, 3.5), graphs=junction) == [1]
    assert chosen(car(88.0, 3.5), graphs=junction) == []  # it has passed the ego and drives away
    assert chosen(car(98.0, 3.5), graphs=junction) == [1]  # nearer than the ego is long


class Pusher:
    """Drives straight on with a given throttle."""

    name, controller = "pusher", Controller.EXTERNAL

    def __init__(self, throttle: float, brake: float = 0.0, steer: float = 0.0) -> None:
        self.control = np.array([throttle, brake, steer], np.float32)

    def reset(self, episodes) -> None: ...

    def act(self, view):
        return np.tile(self.control, (len(view.agent), 1))


def loop_of(*agents: EpisodeAgent, driver: Pusher, speed: float = 8.0, batch: int = 1, **settings) -> Loop:
    world = World(
        [
            episode(
                ego(100.0, speed, Controller.FOLLOW, target_speed=speed), *agents, limits=EpisodeLimits(max_steps=400)
            )
        ],
        GRAPHS,
        assign=[0] * batch,
    )
    loop = Loop(world, {FreaSelection(**settings): driver})
    loop.reset()
    return loop


def notes(loop: Loop) -> list[int]:
    return loop.simulator.state().note[0].tolist()


def test_who_reaches_the_goal_is_let_go_for_good() -> None:
    """A car 15 m ahead brakes until the ego's goal, 6.5 m before it, comes up to it."""
    loop = loop_of(car(115.0, speed=8.0), driver=Pusher(0.0, 0.3))
    seen = []
    for _ in range(40):
        loop.step()
        seen.append((notes(loop)[1], int(loop.simulator.state().policy[0, 1])))
    assert seen[2] == (Note.CHOSEN, 0)
    assert seen[-1] == (Note.ARRIVED, -1)
    first = seen.index((Note.ARRIVED, -1))
    assert all(row == (Note.ARRIVED, -1) for row in seen[first:])


def test_who_touches_another_leaves_the_scene() -> None:
    kept = {}
    for remove in (True, False):
        loop = loop_of(car(110.0, speed=9.0), car(124.0, speed=0.0), driver=Pusher(1.0), speed=2.0, remove=remove)
        for _ in range(30):
            loop.step()
        state = loop.simulator.state()
        kept[remove] = bool(state.active[0, 1])
        assert notes(loop)[1] == Note.ARRIVED
        assert state.policy[0, 1] == -1
    assert kept == {True: False, False: True}


def test_a_second_adversary_comes_a_choice_later() -> None:
    loop = loop_of(
        car(110.0, speed=5.0), car(116.5, speed=5.0), car(123.0, speed=5.0), driver=Pusher(0.2), speed=5.0, count=2
    )
    counts = []
    for _ in range(6):
        loop.step()
        counts.append(int((np.array(notes(loop)) == Note.CHOSEN).sum()))
    assert counts == [0, 0, 1, 1, 2, 2]
    assert notes(loop)[1:] == [Note.CHOSEN, Note.CHOSEN, 0]


@pytest.mark.parametrize(("blocked", "taken"), [("ahead", [1]), ("behind", [3])])
def test_who_has_reached_the_goal_blocks_others(blocked: str, taken: list[int]) -> None:
    """Car 2 has reached the goal, car 3 stands 6 m before it and nearer to the ego than car 1, 20 m behind car 2."""
    cars = [replace(car(x), controller=Controller.NONE) for x in (86.0, 106.0, 112.0)]
    world = World([episode(ego(100.0, 0.0), *cars)], GRAPHS)
    note = np.zeros((1, 4), np.int32)
    note[0, 2] = Note.ARRIVED
    world.keep_note(note)
    world.step()
    world.step()
    assert np.flatnonzero(FreaSelection(blocked=blocked)(world.state()).agents[0]).tolist() == taken


def test_who_is_right_behind_one_that_has_reached_the_goal_is_blocked_by_intent_alone() -> None:
    cars = [replace(car(x), controller=Controller.NONE) for x in (112.0, 120.0)]
    world = World([episode(ego(100.0, 0.0), *cars)], GRAPHS)
    note = np.zeros((1, 3), np.int32)
    note[0, 2] = Note.ARRIVED
    world.keep_note(note)
    world.step()
    world.step()
    assert FreaSelection(blocked="ahead")(world.state()).agents[0, 1]
    assert not FreaSelection(blocked="behind")(world.state()).agents.any()


def test_its_memory_is_in_hashes_and_snapshots_and_ends_with_the_scene() -> None:
    loop = loop_of(car(115.0, speed=8.0), car(122.0, speed=8.0), driver=Pusher(0.0, 0.3), batch=3)
    world = loop.simulator
    for _ in range(25):
        loop.step()
    assert world.state().note.any()
    before = world.hashes()
    assert before == [before[0]] * 3
    kept = world.snapshot()
    world.keep_note(np.zeros((3, 3), np.int32))
    assert all(a != b for a, b in zip(before, world.hashes(), strict=True))
    world.restore(kept)

    def rest() -> list[list[str]]:
        out = []
        for _ in range(25):
            loop.step()
            out.append(world.hashes())
        return out

    first = rest()
    world.restore(kept)
    assert rest() == first
    loop.reset([1])
    assert [bool(row.any()) for row in world.state().note] == [True, False, True]


def test_a_simulator_without_notes_is_named() -> None:
    world = World([episode(ego(), car(20.0))], GRAPHS)
    with pytest.raises(ConfigError, match="keeps no notes"):
        FreaSelection()(replace(world.state(), note=None))

"""Who could have avoided an adversary, judged when it touches the ego."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.driving import WorldState
from ssad.core.types import Controller, EpisodeAgent, Pose
from ssad.drivers.careful import careful_model
from ssad.training.hindsight import Hindsight
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode

SIDE, LONG = 3.5, 4.9  # m to the next lane, and of a car
BOTH = np.array([[0, 1]], np.int32)
STEPS = 40


def moves(x: float, y: float = 0.0, speed: float = 0.0, turn: float = 0.0, until: int = STEPS) -> np.ndarray:
    """Rows of x, y, yaw and speed every 0.1 s, the last at x, y; it heads along the road up to step `until`."""
    t = np.arange(STEPS + 1)
    yaw = np.where(t > until, turn, 0.0)
    step = 0.1 * speed * np.stack([np.cos(yaw), np.sin(yaw)], 1)
    way = np.cumsum(step, 0)
    return np.column_stack([x + (way - way[-1])[:, 0], y + (way - way[-1])[:, 1], yaw, np.full(len(t), speed)])


def played(own: np.ndarray, other: np.ndarray, bend: float | None = None) -> tuple[Hindsight, WorldState]:
    """Both as they are told to move, remembered; the ego's route makes a sharp bend about x = `bend`."""
    world = World([episode(ego(), EpisodeAgent("other", "car", Controller.NONE, Pose(60.0, 0.0)))], GRAPHS)
    base, memory = world.state(), Hindsight(1, world.agents)
    if bend is not None:
        path = base.roads.path.copy()
        path[np.abs(path[:, 0] - bend) < 0.6, 1] += 1.0
        base = replace(base, roads=replace(base.roads, path=path))
    state = base
    for mine, its in zip(own, other, strict=True):
        rows = np.stack([mine, its])[None].astype(np.float32)
        point = np.maximum(rows[..., 0] - 10.0, 0.0).astype(np.int32)
        state = replace(base, pose=rows[..., :3], speed=rows[..., 3], progress=point)
        memory.record(state)
    return memory, state


BRAKES = moves(60.0, speed=8.0)
BRAKES[:, 3] = np.maximum(8.0 - 6.0 * 0.1 * np.arange(-STEPS + 20, 21).clip(0), 0.5)
BRAKES[:, 0] = 60.0 + np.cumsum(0.1 * BRAKES[:, 3]) - 0.1 * BRAKES[:, 3].sum()


@pytest.mark.parametrize(
    ("own", "other", "avoided"),
    [
        (moves(60.0, speed=10.0), moves(60.0 + LONG), True),  # it has stood there all the time
        (moves(60.0, speed=10.0), moves(63.4, 0.0, 2.0, np.pi / 2, -1), True),  # crosses slowly
        (moves(60.0, speed=10.0), moves(63.4, 0.0, 12.0, np.pi / 2, -1), False),  # crosses fast
        (moves(60.0, speed=10.0), moves(62.0, 1.9, 10.0, -0.6, STEPS - 3), False),  # turns in 0.3 s before, beside it
        (moves(60.0, speed=10.0), moves(60.0 + LONG, 0.0, -9.0), False),  # comes along the ego's own lane
        (moves(60.0), moves(60.0 - LONG, speed=9.0), False),  # runs into an ego that stands
        (BRAKES, moves(60.0 - LONG, speed=8.0), True),  # keeps its speed behind an ego that brakes for nothing
    ],
    ids=[
        "ahead",
        "crosses slowly",
        "crosses fast",
        "turns in late",
        "head on",
        "from behind",
        "behind one that brakes",
    ],
)
def test_what_the_driver_of_regulation_157_avoids(own: np.ndarray, other: np.ndarray, avoided: bool) -> None:
    memory, state = played(own, other)
    assert memory.is_avoidable(state, BOTH).tolist() == [avoided]


@pytest.mark.parametrize("lead", [3.0, 5.0, 7.0])
def test_the_human_stays_behind_a_slower_car_it_has_braked_for(lead: float) -> None:
    memory, state = played(moves(60.0, speed=8.0), moves(60.0 + LONG, speed=lead))
    memory.model = careful_model("cc")
    assert memory.is_avoidable(state, BOTH).tolist() == [True]


@pytest.mark.parametrize(("bend", "avoided"), [(None, False), (54.0, True), (85.0, False), (15.0, False)])
def test_it_slows_down_for_bends_on_its_way(bend: float | None, avoided: bool) -> None:
    memory, state = played(moves(60.0, speed=10.0), moves(63.4, 0.0, 12.0, np.pi / 2, -1), bend)
    assert memory.is_avoidable(state, BOTH).tolist() == [avoided]


def test_a_scene_that_starts_again_remembers_nothing() -> None:
    own, other = moves(60.0, speed=10.0), moves(60.0 + LONG)
    memory, state = played(own, other)
    memory.forget([0])
    memory.record(state)
    assert not memory.is_avoidable(state, BOTH)[0]


def test_scenes_do_not_depend_on_each_other() -> None:
    pairs = [(moves(60.0, speed=10.0), moves(60.0 + LONG)), (moves(60.0), moves(60.0 - LONG, speed=9.0))]
    alone = [memory.is_avoidable(state, BOTH)[0] for memory, state in (played(*pair) for pair in pairs)]
    world = World(
        [episode(ego(), EpisodeAgent("o", "car", Controller.NONE, Pose(60.0, 0.0)), key=k) for k in "ab"], GRAPHS
    )
    memory, state = Hindsight(2, world.agents), world.state()
    for rows in zip(*(np.stack(pair, 1) for pair in pairs), strict=True):
        now = np.stack(rows).astype(np.float32)
        point = np.maximum(now[..., 0] - 10.0, 0.0).astype(np.int32)
        state = replace(state, pose=now[..., :3], speed=now[..., 3], progress=point)
        memory.record(state)
    assert memory.is_avoidable(state, np.array([[0, 1], [1, 1]], np.int32)).tolist() == alone == [True, False]

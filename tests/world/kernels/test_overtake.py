"""Lane changes of the Autopilot: who is passed and who is not, on hand-made straight roads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import (
    ENDS,
    Controller,
    Episode,
    EpisodeAgent,
    EpisodeLimits,
    LaneType,
    Phase,
    PhaseTrigger,
    Pose,
    SignalState,
)
from ssad.world.world import World
from tests.world.worlds import GRAPHS, NO_PASSING, ego, episode, line_route, straight_graph

LONG = EpisodeLimits(max_steps=600)


def drive(scene: Episode, graphs: dict[str, LaneGraph], seconds: float = 50.0) -> dict[str, np.ndarray]:
    """Pose and speed of everybody in every step; nobody may touch anybody."""
    world = World([scene], graphs)
    pose, speed, signal = [], [], []
    for _ in range(int(seconds * 10)):
        world.step()
        assert not world.array("touch").any()
        pose.append(world.array("pose")[0].copy())
        speed.append(world.array("speed")[0].copy())
        signal.append(world.array("seen.change")[0, :, 0].copy())
    return {"pose": np.array(pose), "speed": np.array(speed), "signal": np.array(signal), "end": world.ended()}


def parked(x: float, y: float = 0.0, name: str = "parked") -> EpisodeAgent:
    return ego(x=x, controller=Controller.NONE, name=name, model="compact", route=None, pose=Pose(x, y, 0.0))


def autopilot(x: float = 10.0, *, to: float = 300.0, **more) -> EpisodeAgent:
    return ego(x=x, speed=8.0, controller=Controller.AUTOPILOT, route=line_route(x, to), **more)


def steady(name: str, x: float, y: float, speed: float, yaw: float = 0.0) -> EpisodeAgent:
    """Drives straight on at one speed and sees nobody."""
    return EpisodeAgent(
        name,
        "car",
        Controller.SCRIPT,
        Pose(x, y, yaw),
        speed,
        speed,
        (Phase(speed),),
        line_route(x, x + (1.0 if yaw == 0.0 else -1.0) * 390.0, y),
    )


def two_lanes(ends: float = 400.0) -> LaneGraph:
    """The straight road with a second eastbound lane (y = 3.5) in place of the westbound one, as far as `ends`."""
    road = straight_graph()
    x = np.arange(0.0, 401.0, 2.0, dtype=np.float32)
    left = x[x <= ends]
    first, second = x[x <= ends], x[x >= ends]
    parts = [(first, 0.0), (left, 3.5)] + ([(second, 0.0)] if len(second) > 1 else [])
    points = [len(xs) for xs, _ in parts]
    offset = np.concatenate([[0], np.cumsum(points)])
    count, total = len(parts), int(offset[-1])
    i32 = lambda *v: np.array(v, np.int32)  # noqa: E731
    return replace(
        road,
        xy=np.concatenate([np.stack([xs, np.full(len(xs), y)], 1) for xs, y in parts]).astype(np.float32),
        z=np.zeros(total, np.float32),
        yaw=np.zeros(total, np.float32),
        width=np.full(total, 3.5, np.float32),
        s=np.concatenate([xs - xs[0] for xs, _ in parts]).astype(np.float32),
        offset=offset.astype(np.int32),
        kind=np.full(count, LaneType.DRIVING, np.uint8),
        road=i32(0, 0, 1)[:count],
        section=i32(0, 0, 0)[:count],
        lane_id=i32(-2, -1, -1)[:count],
        forward=np.zeros(0, bool),  # made anew from the lanes
        junction=i32(-1, -1, -1)[:count],
        speed_limit=np.full(count, 30.0, np.float32),
        left=i32(1, -1, -1)[:count],
        right=i32(-1, 0, -1)[:count],
        left_marking=np.zeros(count, np.uint8),
        right_marking=np.zeros(count, np.uint8),
        succ_offset=i32(0, 1, 1, 1) if count == 3 else i32(0, 0, 0),
        succ=i32(2) if count == 3 else i32(),
    )


def on_two_lanes(agent: EpisodeAgent, ends: float) -> EpisodeAgent:
    """The agent with a route that knows that its lane goes on as lane 2 where the left one ends."""
    assert agent.route is not None
    lane = np.where(agent.route.xy[:, 0] <= ends, 0, 2).astype(np.int32)
    return replace(agent, route=replace(agent.route, lane=lane))


def test_a_parked_car_is_passed_on_a_free_oncoming_lane() -> None:
    found = drive(episode(autopilot(), parked(80.0), limits=LONG), GRAPHS)
    x, y = found["pose"][:, 0, 0], found["pose"][:, 0, 1]
    assert ENDS[found["end"][0]] == "complete"
    assert y[np.abs(x - 80.0) < 1.0].min() > 2.5
    assert np.abs(y[x < 45.0]).max() < 0.2
    assert np.abs(y[x > 125.0]).max() < 0.2
    # it signals left, later right, and neither beside the car nor on its own lane
    signal = found["signal"][:, 0]
    assert (signal[(y > 0.3) & (x < 65.0)] == 1).all()
    assert (signal[(y > 0.3) & (y < 3.0) & (x > 95.0)] == -1).all()
    assert (signal[(x < 40.0) | (x > 130.0)] == 0).all()


def test_who_comes_towards_it_goes_first() -> None:
    coming = steady("coming", 170.0, 3.5, 8.0, yaw=np.pi)
    found = drive(episode(autopilot(), parked(80.0), coming, limits=LONG), GRAPHS)
    x, y = found["pose"][:, 0, 0], found["pose"][:, 0, 1]
    meets = found["pose"][:, 2, 0] < x
    assert np.abs(y[~meets]).max() < 0.5  # in its lane until the other is past
    assert ENDS[found["end"][0]] == "complete"
    assert y.max() > 3.0


def test_it_does_not_pass_where_the_line_may_not_be_crossed() -> None:
    found = drive(episode(autopilot(), parked(80.0), limits=LONG), NO_PASSING)
    assert np.abs(found["pose"][:, 0, 1]).max() < 0.2
    assert found["speed"][-1, 0] == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("cars", [1, 3, 8])
def test_a_queue_before_a_red_light_is_not_passed(cars: int) -> None:
    """Nor is who has stood in it for long."""
    line = 250.0
    road = replace(
        straight_graph(),
        signal_xy=np.array([[line, -3.0]], np.float32),
        signal_yaw=np.zeros(1, np.float32),
        signal_junction=np.array([0], np.int32),
        signal_phase=np.array([0], np.int32),
        signal_virtual=np.array([False]),
        stop_signal=np.array([0], np.int32),
        stop_lane=np.array([0], np.int32),
        stop_s=np.array([line], np.float32),
    )
    queue = [autopilot(line - 5.0 - 8.0 * k, to=390.0, name=f"car {k}") for k in range(cars)]
    queue = [replace(agent, speed=0.0) for agent in queue]
    scene = episode(autopilot(to=390.0), *queue, signal_override={0: SignalState.RED}, limits=LONG)
    found = drive(scene, {"Straight": road}, seconds=55.0)
    assert np.abs(found["pose"][:, :, 1]).max() < 0.3
    assert not found["signal"].any()
    assert found["pose"][-1, 0, 0] > line - 25.0 - 9.0 * cars  # it has come up to them


@pytest.mark.parametrize("behind", [15.0, 4.0])
def test_no_lane_change_begins_before_a_fast_car(behind: float) -> None:
    """A car from behind on the left that is much faster goes first; one that is slow does not matter."""
    slow = steady("slow", 70.0, 0.0, 3.0)
    other = steady("other", 11.0, 3.5, behind)
    found = drive(episode(autopilot(x=40.0, to=390.0), slow, other, limits=LONG), {"Straight": two_lanes()}, 20.0)
    assert found["pose"][:, 0, 1].max() > 3.0  # it does pass
    begins = int(np.argmax(found["signal"][:, 0] == 1))
    ahead = found["pose"][begins, 2, 0] - found["pose"][begins, 0, 0]
    if behind > 10.0:
        assert ahead > 0.0
    else:
        assert ahead < -10.0


@pytest.mark.parametrize("ends", [100.0, 170.0, 300.0])
def test_it_is_back_in_its_lane_where_the_other_ends(ends: float) -> None:
    """Whether or not there was room to pass: nobody drives on beyond the end of a lane."""
    slow = steady("slow", 60.0, 0.0, 3.0)
    scene = episode(on_two_lanes(autopilot(to=390.0), ends), slow, limits=LONG)
    found = drive(scene, {"Straight": two_lanes(ends)})
    x, y = found["pose"][:, 0, 0], found["pose"][:, 0, 1]
    assert np.abs(y[x > ends - 5.0]).max(initial=0.0) < 0.3
    assert (y.max() > 3.0) == (ends > 120.0)


def test_it_waits_at_the_end_of_a_lane_until_there_is_a_gap() -> None:
    """A column of cars in its own lane lets nobody in: it stops before the end, and follows the last of them."""
    ends = 200.0
    column = [steady(f"car {k}", 124.0 - 9.0 * k, 0.0, 4.0) for k in range(12)]
    passing = on_two_lanes(autopilot(x=75.0, to=390.0), ends)
    world = World([episode(passing, *column, limits=LONG)], {"Straight": two_lanes(ends)})
    world.put("pose", np.where(np.arange(13)[None, :, None] == 0, np.float32([75.0, 3.5, 0.0]), world.array("pose")))
    world.put("shift", np.where(np.arange(13)[None, :, None] == 0, np.float32([0.0, 1.0, 1.0, 1.0]), 0.0))
    least = 100.0
    for _ in range(500):
        world.step()
        assert not world.array("touch").any()
        x, y, _ = world.array("pose")[0, 0]
        least = min(least, float(world.array("speed")[0, 0]))
        assert x < ends or abs(y) < 0.3
    assert least < 1.0
    assert world.array("pose")[0, 0, 0] > ends


def test_lane_changes_are_the_same_in_any_batch_and_after_a_restore() -> None:
    coming = steady("coming", 170.0, 3.5, 8.0, yaw=np.pi)
    scenes = [
        episode(autopilot(), parked(80.0), limits=LONG, key="free"),
        episode(autopilot(), parked(80.0), coming, limits=LONG, key="coming"),
        episode(autopilot(x=12.0), parked(70.0), parked(90.0, name="second"), limits=LONG, key="two"),
    ]
    world = World(scenes, GRAPHS)
    mirrored = World(scenes, GRAPHS, assign=[2, 1, 0, 1])
    alone = [World([scene], GRAPHS) for scene in scenes]
    middle = None
    changing = 0
    for step in range(300):
        for one in (world, mirrored, *alone):
            one.step()
        changing += int((world.array("seen.change") != 0).any())
        if middle is None and (world.array("seen.change") != 0).any() and step > 5:
            middle = (step, world.snapshot())
    assert changing > 50
    hashes = world.hashes()
    assert hashes == [one.hashes()[0] for one in alone]
    assert [hashes[k] for k in (2, 1, 0, 1)] == mirrored.hashes()
    assert middle is not None
    again = World(scenes, GRAPHS)
    again.restore(middle[1])
    for _ in range(middle[0] + 1, 300):
        again.step()
    assert again.hashes() == hashes


def test_who_is_taken_over_while_passing_changes_no_lane_any_more() -> None:
    """Whoever drives it goes where it likes; given back, it returns to its own lane."""
    world = World([episode(autopilot(), parked(80.0), limits=LONG)], GRAPHS)
    while world.array("pose")[0, 0, 1] < 3.3:
        world.step()
    mine = np.array([[True, False]])
    world.take(mine, Controller.EXTERNAL)
    for _ in range(30):
        world.step(np.array([[0.2, 0.0, 0.0]]))
    assert world.array("pose")[0, 0, 1] > 3.0
    assert not world.array("shift").any()
    assert not world.array("seen.change").any()
    world.take(mine, None)
    for _ in range(60):
        world.step()
        assert not world.array("touch").any()
    assert abs(world.array("pose")[0, 0, 1]) < 0.3


@pytest.mark.parametrize("back", [True, False])
def test_a_pass_on_the_oncoming_lane_is_broken_off_when_somebody_comes(back: bool) -> None:
    """Who comes is slow and far away when the pass begins, and fast soon afterwards; it sees nobody."""
    coming = steady("coming", 190.0, 3.5, 1.0, yaw=np.pi)
    fast = Phase(14.0, when=PhaseTrigger("time", 4.5 if back else 6.5))
    coming = replace(coming, phases=(*coming.phases, fast))
    found = drive(episode(autopilot(), parked(80.0), coming, limits=LONG), GRAPHS)
    x, y = found["pose"][:, 0, 0], found["pose"][:, 0, 1]
    before = found["pose"][:, 2, 0] > x
    assert y[before].max() > 0.5  # it had begun
    beside = before & (np.abs(x - 80.0) < 4.0)
    assert beside.any() == (not back)
    assert ENDS[found["end"][0]] == "complete"


def test_a_creeping_leader_is_passed_even_where_the_ego_has_closed_up() -> None:
    """The lane beside begins to be usable only when the ego follows at its small distance."""
    leader = steady("leader", 25.0, 0.0, 2.0)
    follower = replace(autopilot(16.0), speed=2.0)
    beside = steady("beside", 17.0, 3.5, 2.0)  # holds the lane beside for a while, then speeds away
    beside = replace(beside, phases=(Phase(2.0), Phase(12.0, PhaseTrigger("time", value=12.0))))
    found = drive(episode(follower, leader, beside, limits=LONG), {"Straight": two_lanes()})
    x, y, speed = found["pose"][:, 0, 0], found["pose"][:, 0, 1], found["speed"][:, 0]
    assert np.abs(y[:115]).max() < 0.5
    assert speed[100:115] == pytest.approx(2.0, abs=0.15)
    assert (x > found["pose"][:, 1, 0])[-1]
    assert ENDS[found["end"][0]] == "complete"

"""Braking, grip and bodies of single agents against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.types import Body, Contact, Controller, EpisodeAgent, EpisodeLimits, Pose
from ssad.world.models import GRAVITY, GRIP, MODELS
from ssad.world.rollout import rollout
from ssad.world.world import World
from tests.world.worlds import GRAPHS, NO_PASSING, ego, episode

SPEED = 50.0 / 3.6  # m/s


class Pedals:
    """Driver that holds throttle, brake and steering in each scene."""

    name = "pedals"
    controller = Controller.EXTERNAL

    def __init__(self, *controls: tuple[float, float, float]) -> None:
        self.controls = np.array(controls, np.float32)

    def reset(self, episodes) -> None:
        """Hold the pedals in any episode."""

    def act(self, view) -> np.ndarray:
        """Return the same controls at every step."""
        return self.controls[view.scene]


def stopping_distances(*cases: tuple[float, float, Body]) -> list[float]:
    """Return the way from 50 km/h to a standstill for each brake pedal, friction and body."""
    limits = EpisodeLimits(max_steps=150)
    egos = [ego(speed=SPEED, body=body) for _, _, body in cases]
    episodes = [
        episode(one, friction=friction, limits=limits, key=str(number))
        for number, (one, (_, friction, _)) in enumerate(zip(egos, cases, strict=True))
    ]
    traces = rollout(World(episodes, GRAPHS), Pedals(*((0.0, brake, 0.0) for brake, _, _ in cases)))
    assert all(trace.speed[-1, 0] == 0.0 for trace in traces)
    return [float(trace.x[-1, 0] - trace.x[0, 0]) for trace in traces]


def test_full_braking_stops_after_the_way_of_build_up_and_braking() -> None:
    cases = [(deceleration, build_up) for deceleration in (4.0, 8.0) for build_up in (0.0, 0.15, 0.4)]
    ways = stopping_distances(*((1.0, 0.9, Body(max_brake=brake, brake_build_up=time)) for brake, time in cases))
    expected = [SPEED**2 / (2.0 * deceleration) + 0.5 * SPEED * build_up for deceleration, build_up in cases]
    assert ways == pytest.approx(expected, rel=0.02)


def test_half_a_brake_builds_up_in_the_same_time() -> None:
    (way,) = stopping_distances((0.5, 0.9, Body(max_brake=8.0, brake_build_up=0.4)))
    assert way == pytest.approx(SPEED**2 / 8.0 + 0.5 * SPEED * 0.4, rel=0.02)


def test_a_slippery_surface_limits_braking_and_leaves_gentle_braking_alone() -> None:
    gentle = 1.5 / MODELS["car"].max_brake
    full_slippery, full_wet, slippery, dry = stopping_distances(
        (1.0, 0.2, Body()), (1.0, 0.5, Body()), (gentle, 0.2, Body()), (gentle, 0.9, Body())
    )
    assert full_slippery == pytest.approx(SPEED**2 / (2.0 * 0.2 * GRAVITY), rel=0.02)
    assert full_wet == pytest.approx(SPEED**2 / (2.0 * 0.5 * GRAVITY), rel=0.02)
    assert slippery == dry


def test_released_brakes_act_no_longer_and_build_up_anew() -> None:
    world = World([episode(ego(speed=20.0, body=Body(brake_build_up=0.4)))], GRAPHS)
    speeds = []
    for brake in (1.0, 1.0, 0.0, 0.0, 1.0):
        world.step(np.array([[0.0, brake, 0.0]], np.float32))
        speeds.append(float(world.array("speed")[0, 0]))
    first_loss = 20.0 - speeds[0]
    assert speeds[1] == speeds[2] == speeds[3]
    assert speeds[3] - speeds[4] == pytest.approx(first_loss, rel=1e-4)
    world.reset()
    world.step(np.array([[0.0, 1.0, 0.0]], np.float32))
    assert float(world.array("speed")[0, 0]) == speeds[0]  # a restart forgets the brakes


@pytest.mark.parametrize("friction", [0.3, 0.9])
def test_lateral_acceleration_is_proportional_to_friction(friction: float) -> None:
    world = World([episode(ego(speed=20.0), friction=friction)], GRAPHS)
    yaw = []
    for _ in range(12):
        world.step(np.array([[0.0, 0.0, 0.5]], np.float32))
        yaw.append(float(world.array("pose")[0, 0, 2]))
    assert (yaw[-1] - yaw[-2]) / 0.1 * 20.0 == pytest.approx(GRIP * friction / 0.9, rel=1e-3)


def test_default_surface_and_brakes_change_no_bit() -> None:
    limits = EpisodeLimits(max_steps=30)
    bodies = (Body(), Body(max_brake=MODELS["car"].max_brake, brake_build_up=0.0))
    episodes = [episode(ego(speed=15.0, body=body), limits=limits, key=str(body)) for body in bodies]
    plain, stated = rollout(World(episodes, GRAPHS), Pedals(*[(0.0, 0.7, 0.2)] * 2))
    for name in ("x", "y", "yaw", "speed"):
        assert getattr(plain, name).tobytes() == getattr(stated, name).tobytes()


def test_contacts_and_traces_use_the_stated_size() -> None:
    block = EpisodeAgent(
        "block", "car", Controller.NONE, Pose(60.0, 0.0), body=Body(length=20.0, width=2.5, height=4.0)
    )
    limited = ego(speed=10.0, body=Body(length=3.0))
    trace = rollout(World([episode(limited, block)], GRAPHS), Pedals((0.1, 0.0, 0.0)))[0]
    assert trace.contact[-1] == Contact.VEHICLE
    assert 60.0 - 10.0 - 1.5 - 1.2 < trace.x[-1, 0] < 60.0 - 10.0 - 1.5 + 1.2
    assert trace.length.tolist() == [3.0, 20.0]
    assert trace.width[1] == 2.5
    assert trace.heights == pytest.approx((MODELS["car"].height, 4.0))


def test_sizes_of_models_leave_no_heights_in_a_trace() -> None:
    short = episode(ego(speed=10.0, body=Body(max_brake=3.0)), limits=EpisodeLimits(max_steps=2))
    assert rollout(World([short], GRAPHS), Pedals((0.0, 1.0, 0.0)))[0].heights == ()


def test_the_autopilot_keeps_its_distance_from_the_end_of_any_body() -> None:
    driver, lengths = ego(controller=Controller.AUTOPILOT), (4.9, 18.0)
    queues = [
        EpisodeAgent("queue", "truck", Controller.NONE, Pose(80.0, 0.0), body=Body(length=length)) for length in lengths
    ]
    episodes = [episode(driver, queue, key=str(queue.body)) for queue in queues]
    for length, trace in zip(lengths, rollout(World(episodes, NO_PASSING), Autopilot()), strict=True):
        gap = 80.0 - 0.5 * length - 0.5 * MODELS["car"].length - trace.x[-1, 0]
        assert 1.0 < gap < 4.0


class Autopilot(Pedals):
    """The world's own driver."""

    controller = Controller.AUTOPILOT

    def __init__(self) -> None:
        super().__init__((0.0, 0.0, 0.0))

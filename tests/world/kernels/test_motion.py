"""Braking, grip and bodies of single agents against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.types import Body, Contact, Controller, EpisodeAgent, Pose
from ssad.world.models import GRAVITY, GRIP, MODELS
from ssad.world.rollout import rollout
from ssad.world.world import World
from tests.world.worlds import GRAPHS, NO_PASSING, ego, episode

KMH = 1.0 / 3.6


class Pedals:
    """Driver that holds throttle, brake and steering."""

    name = "pedals"
    controller = Controller.EXTERNAL

    def __init__(self, throttle: float, brake: float, steer: float = 0.0) -> None:
        self.controls = np.array([throttle, brake, steer], np.float32)

    def reset(self, episodes) -> None:
        """Hold the pedals in any episode."""

    def act(self, view) -> np.ndarray:
        """Return the same controls at every step."""
        return np.tile(self.controls, (len(view.scene), 1))


def stopping_distance(brake: float = 1.0, *, speed: float = 50.0 * KMH, friction: float = 0.9, **limits) -> float:
    world = World([episode(ego(speed=speed, body=Body(**limits)), friction=friction)], GRAPHS)
    trace = rollout(world, Pedals(0.0, brake))[0]
    assert trace.speed[-1, 0] == 0.0
    return float(trace.x[-1, 0] - trace.x[0, 0])


@pytest.mark.parametrize("build_up", [0.0, 0.15, 0.4])
@pytest.mark.parametrize("deceleration", [4.0, 8.0])
def test_full_braking_stops_after_the_way_of_build_up_and_braking(build_up: float, deceleration: float) -> None:
    speed = 50.0 * KMH
    expected = speed**2 / (2.0 * deceleration) + 0.5 * speed * build_up
    travelled = stopping_distance(max_brake=deceleration, brake_build_up=build_up)
    assert travelled == pytest.approx(expected, rel=0.02)


def test_half_a_brake_builds_up_in_the_same_time() -> None:
    speed = 50.0 * KMH
    travelled = stopping_distance(0.5, max_brake=8.0, brake_build_up=0.4)
    assert travelled == pytest.approx(speed**2 / 8.0 + 0.5 * speed * 0.4, rel=0.02)


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


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_a_slippery_surface_limits_braking_and_leaves_gentle_braking_alone(friction: float) -> None:
    speed = 50.0 * KMH
    assert stopping_distance(friction=friction) == pytest.approx(speed**2 / (2.0 * friction * GRAVITY), rel=0.02)
    gentle = 0.5 * friction * GRAVITY / MODELS["car"].max_brake
    assert stopping_distance(gentle, friction=friction) == stopping_distance(gentle)


@pytest.mark.parametrize("friction", [0.3, 0.9])
def test_lateral_acceleration_is_proportional_to_friction(friction: float) -> None:
    world = World([episode(ego(speed=20.0), friction=friction)], GRAPHS)
    yaw = []
    for _ in range(12):
        world.step(np.array([[0.0, 0.0, 0.5]], np.float32))
        yaw.append(float(world.array("pose")[0, 0, 2]))
    assert (yaw[-1] - yaw[-2]) / 0.1 * 20.0 == pytest.approx(GRIP * friction / 0.9, rel=1e-3)


def test_default_surface_and_brakes_change_no_bit() -> None:
    plain, stated = (
        rollout(World([episode(ego(speed=15.0, body=body))], GRAPHS), Pedals(0.0, 0.7, 0.2))[0]
        for body in (Body(), Body(max_brake=MODELS["car"].max_brake, brake_build_up=0.0))
    )
    for name in ("x", "y", "yaw", "speed"):
        assert getattr(plain, name).tobytes() == getattr(stated, name).tobytes()


def test_contacts_and_traces_use_the_stated_size() -> None:
    block = EpisodeAgent(
        "block", "car", Controller.NONE, Pose(60.0, 0.0), body=Body(length=20.0, width=2.5, height=4.0)
    )
    limited = ego(speed=10.0, body=Body(length=3.0))
    trace = rollout(World([episode(limited, block)], GRAPHS), Pedals(0.1, 0.0))[0]
    assert trace.contact[-1] == Contact.VEHICLE
    assert 60.0 - 10.0 - 1.5 - 1.2 < trace.x[-1, 0] < 60.0 - 10.0 - 1.5 + 1.2
    assert trace.length.tolist() == [3.0, 20.0]
    assert trace.width[1] == 2.5
    assert trace.heights == pytest.approx((MODELS["car"].height, 4.0))


def test_sizes_of_models_leave_no_heights_in_a_trace() -> None:
    limited = ego(speed=10.0, body=Body(max_brake=3.0))
    assert rollout(World([episode(limited)], GRAPHS), Pedals(0.0, 1.0))[0].heights == ()


@pytest.mark.parametrize("length", [4.9, 18.0])
def test_the_autopilot_keeps_its_distance_from_the_end_of_any_body(length: float) -> None:
    queue = EpisodeAgent("queue", "truck", Controller.NONE, Pose(80.0, 0.0), body=Body(length=length))
    driver = ego(controller=Controller.AUTOPILOT)
    trace = rollout(World([episode(driver, queue)], NO_PASSING), Autopilot())[0]
    gap = 80.0 - 0.5 * length - 0.5 * MODELS["car"].length - trace.x[-1, 0]
    assert 1.0 < gap < 4.0


class Autopilot(Pedals):
    """The world's own driver."""

    controller = Controller.AUTOPILOT

    def __init__(self) -> None:
        super().__init__(0.0, 0.0)

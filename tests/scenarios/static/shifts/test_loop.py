"""Shifts in the camera of a drive: strong and steady over time, and their own in each drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad import World, build_episode, load_scenarios, load_town, make_system
from ssad.core.frames import Camera
from ssad.rendering.onboard import Onboard
from ssad.scenarios.static.shifts import ShiftSpec
from ssad.scenarios.static.shifts.loop import ShiftedCamera, boxes_of
from ssad.world.rollout import Loop


def test_fog_hides_the_same_at_all_times_and_noise_is_new_in_each_picture() -> None:
    scenario = load_scenarios("StraightObstacle")[0]
    town = load_town(scenario.town)
    episode = build_episode(scenario, town, seed=0)
    world = World([episode, replace(episode, key="other")], {town.name: town})
    world.reset()
    agents = np.array([[0, 0], [1, 0]], np.int32)
    camera = Onboard().camera(Camera.typical(96, 54))
    eyes = {name: ShiftedCamera(camera, ShiftSpec(name, 5)) for name in ("fog", "gaussian")}
    clear = camera(world, agents).astype(float)
    first = {name: one(world, agents).astype(float) for name, one in eyes.items()}
    for name, pictures in first.items():
        assert np.abs(pictures - clear).mean() > 8.0, name
        assert not np.array_equal(pictures[0], pictures[1]), name  # each drive has its own
    # nobody has moved: the same moment looks the same, whoever asks in whichever batch
    for name in eyes:
        alone = ShiftedCamera(camera, ShiftSpec(name, 5))(world, agents[1:])
        np.testing.assert_array_equal(alone[0], first[name][1])
    road = (slice(None), slice(None), slice(24, 30))  # far ahead the fog keeps its contrast low at all times
    spread = [first["fog"][0][:, 24:30].std()]
    for _ in range(10):
        world.step()
    spread.append(eyes["fog"](world, agents).astype(float)[0][:, 24:30].std())
    assert max(spread) < 0.5 * clear[road][0].std()


@pytest.fixture(scope="module")
def following() -> tuple[World, np.ndarray]:
    """Two drives behind others, who move."""
    scenario = load_scenarios("LaneChanging")[0]
    town = load_town(scenario.town)
    episode = build_episode(scenario, town, seed=0)
    loop = Loop(World([episode, replace(episode, key="other")], {town.name: town}), {0: make_system("autopilot")})
    loop.reset()
    for _ in range(45):
        loop.step()
    world = loop.simulator
    assert isinstance(world, World)
    return world, np.array([[0, 0], [1, 0]], np.int32)


@pytest.mark.parametrize("name", ["scale", "shear", "rotation", "anomaly"])
def test_objects_are_changed_or_added_and_the_rest_of_the_picture_stays(following, name: str) -> None:
    world, agents = following
    camera = Onboard().camera(Camera.typical(192, 108))
    clear, plain = camera(world, agents), ShiftedCamera(camera, ShiftSpec(name, 0))(world, agents)
    np.testing.assert_array_equal(plain, clear)
    eyes = ShiftedCamera(camera, ShiftSpec(name, 5))
    shown = eyes(world, agents)
    changed = (shown != clear).any(1)
    assert (changed.mean((1, 2)) < 0.3).all()
    assert (changed.sum((1, 2)) > 20).all()
    assert not changed[:, :12].any()  # the sky
    np.testing.assert_array_equal(ShiftedCamera(camera, ShiftSpec(name, 5))(world, agents[1:])[0], shown[1])
    assert not np.array_equal(shown[0], shown[1])  # drawn anew for each drive


def test_the_boxes_of_objects_are_where_they_are_and_move_as_they_do(following) -> None:
    world, agents = following
    onboard, state = Onboard(), world.state()
    boxes, own = boxes_of(onboard.agent_views(world, agents)[1], state.speed[1])
    np.testing.assert_allclose(boxes.centre[:, :2], state.pose[1, 1:, :2])
    np.testing.assert_allclose(boxes.size_lwh[:, :2], state.size[1, 1:], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(boxes.velocity, axis=1), np.abs(state.speed[1, 1:]), atol=1e-5)
    np.testing.assert_allclose(own[:2] @ [np.cos(state.pose[1, 0, 2]), np.sin(state.pose[1, 0, 2])], state.speed[1, 0])
    assert state.speed[1, 0] > 1.0


def test_anomalies_stand_still_in_the_world(following) -> None:
    world, agents = following
    eyes = ShiftedCamera(Onboard().camera(Camera.typical(192, 108)), ShiftSpec("anomaly", 3))
    eyes(world, agents[:1])
    (first,) = eyes._contexts.values()
    world.step()
    eyes(world, agents[:1])
    (second,) = eyes._contexts.values()
    assert first is second
    assert first.objects
    route = world.episodes[0].agents[0].route.xy
    places = np.array([one.place[:2] for one in first.objects])
    away = np.hypot(*np.moveaxis(route[:, None] - places, -1, 0)).min(0)
    assert away.min() > 1.0  # beside the way, which the ego itself needs
    assert np.median(away) < 8.0  # some stand beyond its end

"""Shifts in the camera of a drive: strong and steady over time, and their own in each drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad import World, build_episode, load_scenarios, load_town
from ssad.core.errors import UnknownNameError
from ssad.core.frames import Camera
from ssad.recording.loop_sensors import Onboard
from ssad.recording.loop_shifts import LOOP_SHIFTS, ShiftedCamera
from ssad.scenarios.static.shifts import ShiftSpec


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


def test_what_moves_objects_is_not_for_the_loop() -> None:
    assert {"fog", "rain", "snow", "sunlight", "overexposure"} <= set(LOOP_SHIFTS)
    with pytest.raises(UnknownNameError, match="fog"):
        ShiftedCamera(Onboard().camera(Camera.typical(96, 54)), ShiftSpec("scale", 3))

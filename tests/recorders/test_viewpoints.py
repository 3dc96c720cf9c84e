"""What stands between a camera and its target."""

from __future__ import annotations

import numpy as np

from ssad.core.rotations import upright_pose
from ssad.recorders.viewpoints import Viewpoint, between, look_at
from ssad.rendering.camera.render import SceneWeather
from ssad.rendering.camera.scene import SceneObject
from ssad.rendering.scene_objects import ObjectBody, PlacedObject


def body(length: float, width: float) -> ObjectBody:
    track = np.zeros((1, 4)), np.ones(1, bool), np.zeros(1)
    return ObjectBody(1, "car", "sedan", (length, width, 1.4), (0.5, 0.5, 0.5), (0,), *track)


def placed(x: float, y: float, yaw: float = 0.0) -> PlacedObject:
    pose = upright_pose(x, y, yaw, 0.0)
    return PlacedObject(body(4.0, 1.8), pose, 0.0, SceneObject(0, pose))


def test_objects_in_the_way_to_the_target_are_told_from_those_beside_and_behind_it() -> None:
    """The camera looks along x at a target 1.8 m wide, whose rear is 38 m away."""
    camera = look_at(np.array([0.0, 0.0, 2.0]), np.array([40.0, 0.0, 0.8]))
    viewpoint = Viewpoint(0.0, camera, upright_pose(40.0, 0.0, 0.0, 0.0), SceneWeather(), {})
    objects = [placed(20.0, 0.0), placed(20.0, 1.7), placed(20.0, 1.9), placed(20.0, 2.5, np.pi / 2), placed(41.0, 0.0)]
    found = between(body(4.0, 1.8), viewpoint, objects)
    assert found.tolist() == [True, True, False, True, False]
    assert between(body(4.0, 1.8), viewpoint, []).tolist() == []

"""Edits of the street: their place on the route, bodies, signs, lamps and decals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.photometry import per_lux
from ssad.rendering.camera.render import SceneWeather, View
from ssad.rendering.camera.scene import SceneObject, TextureDecal, TextureLayer
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.sensor_suite import SensorSuite
from ssad.rendering.street_edit import StreetEdit, route_pose
from ssad.scenarios.static.physical.street.phantom import screen_mesh

ROUTE = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 20.0)])
SCREEN = screen_mesh()


def test_a_place_on_the_route() -> None:
    pose = route_pose(ROUTE, 15.0, 2.0)
    np.testing.assert_allclose(pose[:2, 3], (8.0, 5.0), atol=1e-12)  # to the left of the way north
    np.testing.assert_allclose(pose[:3, 0], (0.0, 1.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(route_pose(ROUTE, 99.0)[:2, 3], (10.0, 20.0))


def test_decals_and_lamps_stand_at_the_place_in_units_of_the_hour() -> None:
    decal = TextureDecal(0, np.eye(4), (1.0, 2.0))
    edit = SceneEdit(lamps=(SceneLamp(np.eye(4), 600.0),), decals=(decal,), textures={0: torch.ones(3, 2, 2)})
    head_lamp = SceneLamp(np.eye(4), 60.0)
    street = StreetEdit(edit, (15.0, 0.0), head_lamps=(head_lamp,))
    weather = SceneWeather(-0.3)
    view = View(Camera.typical(64, 32), np.eye(4), weather=weather)
    heads = np.array([(5.0, 0.0, 4.0, 0.5 * np.pi), (500.0, 0.0, 4.0, 0.0)])
    changed = street.on(view, ROUTE, heads)
    assert len(changed.decals) == 1
    np.testing.assert_allclose(changed.decals[0].pose[:2, 3], (10.0, 5.0), atol=1e-12)
    assert [lamp.power for lamp in changed.lamps] == pytest.approx([600.0 * per_lux(weather), 60.0 * per_lux(weather)])
    np.testing.assert_allclose(changed.lamps[1].pose[:3, 3], (5.0, 0.0, 4.0))
    assert view.lamps == ()


def test_bodies_are_added_and_signs_are_replaced_or_gone() -> None:
    street = StreetEdit(
        place=(5.0, -2.0), bodies=((SCREEN, np.eye(4)),), signs={"stop_sign": None, "yield_sign": SCREEN}
    )
    keys = list(street.meshes())
    assert len(keys) == 2
    index = {key: 70 + number for number, key in enumerate(keys)}
    objects = (SceneObject(3, np.eye(4)), SceneObject(4, np.eye(4)), SceneObject(3, np.eye(4), tag=5))
    changed = street.objects(objects, ROUTE, index, {3: "stop_sign", 4: "yield_sign"})
    assert [entry.mesh for entry in changed] == [71, 3, 70]  # agents with the number of a sign's mesh stay
    np.testing.assert_allclose(changed[-1].pose[:2, 3], (5.0, -2.0))


def test_signs_of_one_limit_change_before_those_of_every_limit() -> None:
    street = StreetEdit(signs={"limit_sign:30": None, "limit_sign": SCREEN})
    (key,) = street.meshes()
    kinds = {1: "limit_sign:30", 2: "limit_sign:50", 3: "yield_sign"}
    changed = street.objects(tuple(SceneObject(mesh, np.eye(4)) for mesh in kinds), ROUTE, {key: 9}, kinds)
    assert [entry.mesh for entry in changed] == [9, 3]


def test_what_is_refused() -> None:
    with pytest.raises(ConfigError, match="layers and cards need a target"):
        StreetEdit(SceneEdit(layers=(TextureLayer(0),), textures={0: torch.ones(3, 1, 1)}))
    with pytest.raises(ConfigError, match="a distance along the route from 0"):
        StreetEdit(place=(-1.0, 0.0))
    suite = SensorSuite().with_street_edit(StreetEdit())
    with pytest.raises(ConfigError, match="one texture or light at a time"):
        suite.with_street_edit(StreetEdit())
    assert replace(suite, street_edit=None).with_street_edit(StreetEdit()).street_edit is not None

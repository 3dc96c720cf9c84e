"""Phantoms: their pictures, their light, and the control of the same light."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.rendering.sensor_suite import SensorSuite
from ssad.scenarios.static.physical.street.phantom import LEAK, LUMENS, PICTURES, SCREEN_HEIGHT, Phantom, screen_mesh


@pytest.mark.parametrize("picture", list(PICTURES))
def test_a_picture_is_a_body_before_black(picture: str) -> None:
    light = Phantom(picture).light()
    assert light.min() >= LEAK - 1e-6
    assert light.max() <= 1.0
    dark = (light.amax(0) <= 2.0 * LEAK).float().mean()
    assert 0.15 < float(dark) < 0.9
    width, height = PICTURES[picture][2]
    assert light.shape[2] / light.shape[1] == pytest.approx(width / height, rel=0.05)
    if picture == "stop-sign":
        assert float(light[0].mean()) > 2.0 * float(light[2].mean())  # red


def test_the_control_has_the_light_of_the_person_without_a_shape() -> None:
    person, blank = Phantom("person"), Phantom("blank")
    assert blank.light().shape == person.light().shape
    np.testing.assert_allclose(blank.light().mean((1, 2)), person.light().mean((1, 2)), rtol=1e-4)
    assert float(blank.light().std((1, 2)).max()) < 1e-6
    assert blank.size == person.size


@pytest.mark.parametrize("onto", ["road", "screen"])
def test_the_projector_lights_the_stated_size(onto: str) -> None:
    phantom = Phantom("stop-sign", onto=onto, lumens=2000.0)
    (lamp,) = phantom.edit().lamps
    width, height = phantom.size
    place = np.array([0.0, 0.0, 0.0 if onto == "road" else 0.5 * SCREEN_HEIGHT])
    reach = float(np.linalg.norm(lamp.pose[:3, 3] - place))
    assert (2.0 * reach * lamp.spread[0], 2.0 * reach * lamp.spread[1]) == pytest.approx((width, height))
    np.testing.assert_allclose(lamp.pose[:3, 2], (place - lamp.pose[:3, 3]) / reach, atol=1e-9)
    assert lamp.power == 2000.0
    assert len(phantom.street_edit().bodies) == (onto == "screen")


def test_the_screen_faces_who_comes_along_the_road() -> None:
    mesh = screen_mesh()
    corners = mesh.corners()
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = corners[..., 0].max(1) < 1e-6
    assert (normals[front] @ [-1.0, 0.0, 0.0] > 0.0).all()
    assert mesh.bounds()[1][2] == pytest.approx(SCREEN_HEIGHT)


def test_it_shines_at_its_hour_with_the_power_of_its_severity() -> None:
    suite = Phantom(severity=1).in_loop(SensorSuite(), target=0, victim=None, seed=0)
    assert suite.weather.sun_height < 0.0
    assert suite.street_edit is not None
    assert Phantom(severity=5).flux == LUMENS[4]
    assert Phantom(hour="recorded").in_loop(SensorSuite(), target=0, victim=None, seed=0).weather.sun_height > 0.0


def test_what_is_refused() -> None:
    for settings in ({"picture": "ghost"}, {"onto": "cloud"}, {"hour": "tea"}):
        with pytest.raises(UnknownNameError):
            Phantom(**settings)
    with pytest.raises(ConfigError, match="0 to 1e6 lumens"):
        Phantom(lumens=-1.0)
    with pytest.raises(ConfigError, match="no screen"):
        Phantom(onto="screen").on_target(None)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="no screen"):
        Phantom(onto="screen").on_scene(None, None)  # type: ignore[arg-type]

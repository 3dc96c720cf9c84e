"""Light into the lens: its illuminance, its veil in closed form, and where it appears."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.images import decode_srgb
from ssad.rendering.sensor_suite import SensorSuite
from ssad.scenarios.static.physical.street.lens_light import (
    CORE,
    DARKEST,
    GLARE,
    LASER_EFFICACY,
    WHITE,
    LensLight,
    full_scale,
)

CAMERA = Camera.typical(160, 96)
DARK = np.full((96, 160, 3), 20, np.uint8)
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def test_illuminance_is_the_flux_over_the_area_of_the_beam() -> None:
    light = LensLight(power=0.005, beam=0.001)
    assert light.lux(30.0) == pytest.approx(0.005 * LASER_EFFICACY / (np.pi * (0.002 + 30.0 * np.tan(0.001)) ** 2))
    torch = LensLight(source="torch", power=1000.0, beam=0.1)
    assert torch.lux(20.0) == pytest.approx(1000.0 / (np.pi * (0.002 + 20.0 * np.tan(0.1)) ** 2))
    assert LensLight(severity=5).lumens == pytest.approx(1e4 * LensLight(severity=1).lumens)


def test_the_veil_follows_the_equation_of_glare() -> None:
    light, scale = LensLight(source="torch", power=100.0, scatter=2.0), 50.0
    middle = np.array([80.5, 48.5])
    veil = light.veil(CAMERA, middle, 20.0, scale) @ LUMINANCE
    for columns in (10, 60):
        # The source is half a pixel from the optical axis; rays have their exact angle.
        rays = [np.array([column / (0.79 * 160), 0.5 / (0.79 * 160), 1.0]) for column in (0.5, 0.5 + columns)]
        first, second = (ray / np.linalg.norm(ray) for ray in rays)
        angle = np.degrees(np.arccos(first @ second))
        expected = 2.0 * GLARE * light.lux(20.0) / (angle**2 + CORE**2) / scale
        assert veil[48, 80 + columns] == pytest.approx(expected, rel=1e-4)
    doubled = LensLight(source="torch", power=200.0, scatter=2.0).veil(CAMERA, middle, 20.0, scale) @ LUMINANCE
    np.testing.assert_allclose(doubled, 2.0 * veil, rtol=1e-5)


def test_it_shines_from_its_place_and_not_from_behind_or_without_power() -> None:
    light, scale = LensLight(power=0.05, scatter=1.0), full_scale(-0.3)
    place = np.array([30.0, 0.0, 1.5])
    lit = light.shine(DARK, CAMERA, np.eye(4), place, scale)
    dim = LensLight(power=5e-8).shine(DARK, CAMERA, np.eye(4), place, scale)
    peak = np.unravel_index(int(decode_srgb(dim)[..., 1].argmax()), dim.shape[:2])
    assert np.hypot(peak[0] - 48, peak[1] - 80) < 3
    assert light.shine(DARK, CAMERA, np.eye(4), np.array([-30.0, 0.0, 1.5]), scale) is DARK
    np.testing.assert_array_equal(LensLight(power=0.0).shine(DARK, CAMERA, np.eye(4), place, scale), DARK)
    # By day the sensor is exposed for more light.
    by_day = light.shine(DARK, CAMERA, np.eye(4), place, full_scale(0.9))
    assert decode_srgb(by_day).mean() < decode_srgb(lit).mean()
    assert full_scale(-0.5) == pytest.approx(WHITE * DARKEST / np.pi)


def test_what_is_refused() -> None:
    with pytest.raises(ConfigError, match="choose laser or torch"):
        LensLight("candle")
    for settings in ({"aim": 1.5}, {"power": -1.0}, {"beam": 0.0}, {"severity": 6}):
        with pytest.raises(ConfigError, match="severity 1 to 5"):
            LensLight(**settings)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="needs a camera"):
        LensLight().in_loop(SensorSuite(), target=0, victim=None, seed=0)

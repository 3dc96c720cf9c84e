"""Lumen on the renderer's scale."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.rendering.camera.photometry import illuminance, per_lux
from ssad.rendering.camera.render import SceneWeather


@pytest.mark.parametrize(("degrees", "lux"), [(90, 128_800), (0, 759), (-6, 3.4), (-12, 0.0081)])
def test_illuminance_is_that_of_the_circular(degrees: float, lux: float) -> None:
    assert illuminance(float(np.radians(degrees))) == pytest.approx(lux, rel=0.02)


def test_the_lower_the_sun_the_more_a_lamp_counts() -> None:
    heights = np.radians(np.linspace(90, -30, 121))
    light = np.array([illuminance(h) for h in heights])
    assert (np.diff(light) <= 1e-9).all()
    for degrees in (20.0, 5.0, -0.8, -5.0, -12.0):
        above, below = (illuminance(float(np.radians(degrees + step))) for step in (1e-3, -1e-3))
        assert above == pytest.approx(below, rel=0.1), "the pieces meet"
    scale = [per_lux(SceneWeather(float(np.radians(degrees)))) for degrees in (60, 20, 5, 0, -4, -8, -20)]
    assert sorted(scale) == scale
    assert scale[-1] == pytest.approx(1 / 60)
    assert scale[0] < 1e-4, "by day a lux is next to nothing"
    assert per_lux(SceneWeather(-0.3, clouds=0.9, fog=0.02)) == scale[-1]

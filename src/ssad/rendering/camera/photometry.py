"""Photometry of lamps: lumen on the renderer's scale, by day and by night.

The renderer compresses the range of daylight: its noon is about 200 times as bright as its night, the real one a
billion times. In an image, only the ratio of a lamp to the ambient light counts. So a lamp is scaled as the sun and
the sky of the hour are, and at night as the lamps of street and vehicles.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ssad.rendering.camera.lamps import NIGHT_LUX
from ssad.rendering.camera.render import SceneWeather, scene_light

# lowest altitude of the sun in degrees -> coefficients of the logarithm of its illuminance
_CLEAR = (
    (20.0, (3.74, 3.97, -4.07, 1.47)),
    (5.0, (3.05, 13.28, -45.98, 64.33)),
    (-0.8, (2.88, 22.26, -207.64, 1034.30)),
    (-5.0, (2.88, 21.81, -258.11, -858.36)),
    (-12.0, (2.70, 12.17, -431.69, -1899.83)),
)


def illuminance(sun_height: float) -> float:
    """Return the illuminance of level ground by sun and clear sky, lux.

    Below an elevation of -12 degrees it stays constant.

    Args:
        sun_height: Elevation of the sun, rad.

    Source: Janiczek and DeYoung, Computer programs for sun and moon illuminance (US Naval Observatory Circular
    171, 1987): a cubic of the altitude over 90 degrees, in five pieces.
    """
    degrees = float(np.clip(np.degrees(sun_height), -12.0, 90.0))
    terms = next(coefficients for lowest, coefficients in _CLEAR if degrees >= lowest)
    return float(10.0 ** np.polynomial.polynomial.polyval(degrees / 90.0, np.array(terms)))


def per_lux(weather: SceneWeather) -> float:
    """Return the irradiance over pi of one lux in an image.

    Args:
        weather: Weather of the image; only the height of its sun counts.
    """
    return _per_lux(weather.sun_height)


@lru_cache(maxsize=64)
def _per_lux(sun_height: float) -> float:
    (sun, colour, zenith, horizon, *_), _ = scene_light(SceneWeather(sun_height, clouds=0.0))
    # The same weights of zenith and horizon as in the shading of level ground.
    level = np.mean(colour) * max(sun[2], 0.0) + 0.65 * np.mean(zenith) + 0.35 * np.mean(horizon)
    return min(float(level) / illuminance(sun_height), NIGHT_LUX)

"""Lamps in lumen: how much light of a real lamp is on the renderer's scale, by day and by night.

The renderer compresses the range of daylight: its noon is some 200 times as bright as its night, the real one a billion
times. What counts for a picture is how bright a lamp is beside the light that is there. So a lamp is scaled as the sun
and the sky of its hour are, and by night as the lamps of street and vehicles.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ssad.rendering.camera.render import Weather, light_of

NIGHT_LUX = 1.0 / 60.0  # irradiance over pi of one lux by night, on which the lamps of street and vehicles are built
# least altitude of the sun in degrees -> coefficients of the logarithm of its illuminance
_CLEAR = (
    (20.0, (3.74, 3.97, -4.07, 1.47)),
    (5.0, (3.05, 13.28, -45.98, 64.33)),
    (-0.8, (2.88, 22.26, -207.64, 1034.30)),
    (-5.0, (2.88, 21.81, -258.11, -858.36)),
    (-12.0, (2.70, 12.17, -431.69, -1899.83)),
)


def illuminance(sun_height: float) -> float:
    """Illuminance of level ground by sun and clear sky, lux; from 12 degrees below the horizon on that of there.

    Args:
        sun_height: Elevation of the sun, rad.

    Source: Janiczek and DeYoung, Computer programs for sun and moon illuminance (US Naval Observatory Circular 171,
    1987): a cubic of the altitude over 90 degrees, in five pieces.
    """
    degrees = float(np.clip(np.degrees(sun_height), -12.0, 90.0))
    terms = next(found for least, found in _CLEAR if degrees >= least)
    return float(10.0 ** np.polynomial.polynomial.polyval(degrees / 90.0, np.array(terms)))


def per_lux(weather: Weather) -> float:
    """Irradiance over pi that one lux is in a picture.

    Args:
        weather: Of the picture; the height of its sun alone counts.
    """
    return _per_lux(weather.sun_height)


@lru_cache(maxsize=64)
def _per_lux(sun_height: float) -> float:
    (sun, colour, zenith, horizon, *_), _ = light_of(Weather(sun_height, clouds=0.0))
    level = np.mean(colour) * max(sun[2], 0.0) + 0.65 * np.mean(zenith) + 0.35 * np.mean(horizon)
    return min(float(level) / illuminance(sun_height), NIGHT_LUX)

"""Weather at a stated hour: height and direction of the sun, and the night."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssad.core.errors import unknown_name
from ssad.rendering.camera.render import SceneWeather

HOURS: Final = ("recorded", "noon", "low_sun", "sun_behind", "night")
SUN: Final = {"noon": 1.0, "low_sun": 0.25, "sun_behind": 0.5, "night": -0.3}  # height of the sun, rad
ASIDE: Final = 0.3  # rad from straight behind the target to a sun that is behind it


def at_hour(weather: SceneWeather, hour: str, heading: float | None = None) -> SceneWeather:
    """Return a weather at an hour: clear and dry, with the sun in its recorded direction; recorded: unchanged.

    Args:
        weather: Recorded weather.
        hour: See `HOURS`; sun_behind: the sun shines on the target's rear.
        heading: Heading of the target, rad; None: the sun keeps its direction.

    Raises:
        UnknownNameError: There is no such hour.
    """
    if hour not in HOURS:
        raise unknown_name("hour", hour, HOURS)
    if hour == "recorded":
        return weather
    sun_heading = weather.sun_heading
    if hour == "sun_behind" and heading is not None:
        # A little to the side, not straight behind the target.
        sun_heading = heading + np.pi + ASIDE
    return SceneWeather(SUN[hour], float(sun_heading), min(weather.clouds, 0.3), turn=weather.turn)

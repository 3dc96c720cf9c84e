"""Weather at a stated hour: the height of the sun, where it stands, and the night."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssad.core.errors import unknown_name
from ssad.rendering.camera.render import Weather

HOURS: Final = ("recorded", "noon", "low_sun", "sun_behind", "night")
SUN: Final = {"noon": 1.0, "low_sun": 0.25, "sun_behind": 0.5, "night": -0.3}  # height of the sun, rad
ASIDE: Final = 0.3  # rad from straight behind the target to a sun that is behind it


def at_hour(weather: Weather, hour: str, heading: float | None = None) -> Weather:
    """A weather at an hour: clear and dry, with the sun where it was to the side; recorded: as it was.

    Args:
        weather: As it was.
        hour: See `HOURS`; sun_behind: the sun shines on the target's rear.
        heading: Of the target, rad; None: the sun stays where it was to the side.

    Raises:
        UnknownNameError: There is no such hour.
    """
    if hour not in HOURS:
        raise unknown_name("hour", hour, HOURS)
    if hour == "recorded":
        return weather
    side = weather.sun_heading
    if hour == "sun_behind" and heading is not None:
        side = heading + np.pi + ASIDE
    return Weather(SUN[hour], float(side), min(weather.clouds, 0.3), turn=weather.turn)

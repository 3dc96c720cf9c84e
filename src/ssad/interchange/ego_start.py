"""Start of an ego beside its route, as the parameters that every scenario class has."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ssad.core.import_report import ImportReport
from ssad.core.rotations import wrap_angle
from ssad.core.types import Pose, Route
from ssad.scenarios.dynamic import CUSTOM, parameter_box

_STATED: Final = {
    "ego_speed": ("speed", "m/s", 0.05),
    "ego_longitudinal": ("distance along its route", "m", 0.5),
    "ego_lateral": ("distance to the left of its route", "m", 0.05),
    "ego_heading": ("turn to the left of its route", "rad", 0.02),
}
"""Meaning of each parameter, its unit, and the deviation that is reported."""


def start_parameters(
    route: Route, pose: Pose, speed: float, *, digits: int, report: ImportReport | None = None
) -> dict[str, float]:
    """Return the parameters of the ego's start, each clipped to its range; zeros are left out.

    Args:
        route: The ego's route.
        pose: Start pose of the ego.
        speed: Start speed, m/s.
        digits: Number of decimals.
        report: Filled with a doubt for each value that its range cuts.

    Returns:
        Name of the parameter -> value.
    """
    # Only the first points: a later part of the route may pass nearby again.
    nearest = int(np.argmin(np.hypot(route.xy[:12, 0] - pose.x, route.xy[:12, 1] - pose.y)))
    yaw = float(route.yaw[nearest])
    dx, dy = pose.x - float(route.xy[nearest, 0]), pose.y - float(route.xy[nearest, 1])
    values = {
        "ego_speed": speed,
        "ego_longitudinal": nearest * route.spacing + dx * math.cos(yaw) + dy * math.sin(yaw),
        "ego_lateral": -dx * math.sin(yaw) + dy * math.cos(yaw),
        "ego_heading": float(wrap_angle(pose.yaw - yaw)),
    }
    ranges = parameter_box(CUSTOM)
    clipped = {name: round(float(np.clip(number, *ranges[name].limits)), digits) for name, number in values.items()}
    for name, (meaning, unit, tolerance) in _STATED.items():
        if report is not None and abs(clipped[name] - values[name]) > tolerance:
            report.doubt(f"the ego starts with a {meaning} of {clipped[name]:g} {unit}, not {values[name]:.4g} {unit}")
    return {name: value for name, value in clipped.items() if value != 0.0}

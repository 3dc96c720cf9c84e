"""Start of an ego beside its route, as the parameters that every scenario class has."""

from __future__ import annotations

import math

import numpy as np

from ssad.core.rotations import wrap_angle
from ssad.core.types import Pose, Route
from ssad.scenarios.dynamic import CUSTOM, parameter_box


def start_parameters(route: Route, pose: Pose, speed: float, *, digits: int) -> dict[str, float]:
    """Return the parameters of the ego's start, each clipped to its range; zeros are left out.

    Args:
        route: The ego's route.
        pose: Start pose of the ego.
        speed: Start speed, m/s.
        digits: Number of decimals.

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
    return {name: value for name, value in clipped.items() if value != 0.0}

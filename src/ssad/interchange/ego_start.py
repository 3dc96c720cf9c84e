"""How an ego starts beside its route, as the parameters that every scenario class has."""

from __future__ import annotations

import math

import numpy as np

from ssad.core.rotations import wrap_angle
from ssad.core.types import Pose, Route
from ssad.scenarios.dynamic import CUSTOM, parameter_box


def start_parameters(route: Route, pose: Pose, speed: float, *, digits: int) -> dict[str, float]:
    """Parameters of the ego's start, each held to its range; those that are 0 are left out.

    Args:
        route: The ego's route.
        pose: Where the ego starts.
        speed: How fast, m/s.
        digits: Decimals that are kept.

    Returns:
        Name of the parameter -> value.
    """
    near = int(np.argmin(np.hypot(route.xy[:12, 0] - pose.x, route.xy[:12, 1] - pose.y)))
    yaw = float(route.yaw[near])
    dx, dy = pose.x - float(route.xy[near, 0]), pose.y - float(route.xy[near, 1])
    wanted = {
        "ego_speed": speed,
        "ego_longitudinal": near * route.spacing + dx * math.cos(yaw) + dy * math.sin(yaw),
        "ego_lateral": -dx * math.sin(yaw) + dy * math.cos(yaw),
        "ego_heading": float(wrap_angle(pose.yaw - yaw)),
    }
    box = parameter_box(CUSTOM)
    clipped = {name: round(float(np.clip(v, box[name].low, box[name].high)), digits) for name, v in wanted.items()}
    return {name: value for name, value in clipped.items() if value != 0.0}

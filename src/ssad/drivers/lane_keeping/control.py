"""Speed and steering of the lane keeper: pure pursuit of the lane, and distance to what drives in it."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssad.core.driving import Belief, Observation
from ssad.core.perception import PerceivedLane
from ssad.core.types import F64, AgentKind, SignalState

PREVIEW: Final = (4.0, 0.45)  # m and s: constant part and time gap of the distance to the pursued point
LATERAL_ACCELERATION: Final = 2.5  # m/s^2, in bends
MAX_ACCELERATION: Final = 1.5  # m/s^2
COMFORT: Final = 2.0  # m/s^2, comfortable deceleration
MAX_DECELERATION: Final = 8.0  # m/s^2, for an obstacle
HEADWAY: Final = 1.5  # s to the vehicle in front
STANDSTILL: Final = 3.0  # m to the vehicle in front at rest
RESPONSE: Final = 0.8  # s, time constant with which the speed follows
PATH_MARGIN: Final = 0.3  # m to either side of the ego's body that belong to its path
REACH: Final = 80.0  # m ahead within which objects and stop lines count


def pursuit_curvature(lane: PerceivedLane, speed: float) -> float:
    """Return the curvature of the circle through a point of the lane's middle ahead, 1/m, positive to the left.

    Pure pursuit (Coulter, CMU-RI-TR-92-01, 1992). On a circular lane it is the curvature of the lane.
    """
    distance = PREVIEW[0] + PREVIEW[1] * max(speed, 0.0)
    lateral = lane.middle(distance)
    return 2.0 * lateral / (distance * distance + lateral * lateral)


def steer_for(curvature: float, wheelbase: float, lock: float) -> float:
    """Return the steering, -1 to 1, with which the centre of a body drives along a curvature.

    Args:
        curvature: 1/m, positive to the left.
        wheelbase: m.
        lock: Angle of the front wheels at full lock, rad.
    """
    # The kinematic bicycle about the middle of its wheelbase: sin(slip) = curvature x wheelbase / 2.
    slip_sine = float(np.clip(0.5 * curvature * wheelbase, -0.9, 0.9))
    wheel_angle = np.arctan(2.0 * slip_sine / np.sqrt(1.0 - slip_sine * slip_sine))
    return float(np.clip(wheel_angle / lock, -1.0, 1.0))


def bend_speed(lane: PerceivedLane) -> float:
    """Return the speed at which the bend of a lane takes `LATERAL_ACCELERATION`, m/s."""
    return float(np.sqrt(LATERAL_ACCELERATION / max(abs(lane.curvature), 1e-4)))


def following_acceleration(view: Observation, belief: Belief, row: int, lane: PerceivedLane, size: F64) -> float:
    """Return the acceleration that keeps the distance to the nearest believed object in the lane, m/s^2.

    It is the interaction term of the Intelligent Driver Model (Treiber et al., Phys. Rev. E 62, 2000).

    Args:
        view: Observation.
        belief: Believed objects.
        row: Row of the ego in both.
        lane: The lane that the ego keeps.
        size: Length and width of the ego, m.

    Returns:
        inf where nothing is in the lane.
    """
    is_object = belief.kind[row] != AgentKind.NONE
    object_poses = belief.pose[row][is_object].astype(np.float64)
    ego_x, ego_y, ego_yaw = view.pose[row].astype(np.float64).tolist()
    offset = object_poses[:, :2] - [ego_x, ego_y]
    distance_ahead = offset[:, 0] * np.cos(ego_yaw) + offset[:, 1] * np.sin(ego_yaw)
    lateral_offset = offset[:, 1] * np.cos(ego_yaw) - offset[:, 0] * np.sin(ego_yaw)
    object_length, object_width = belief.size[row][is_object].astype(np.float64).T
    relative_yaw = object_poses[:, 2] - ego_yaw
    half_length = 0.5 * (object_length * np.abs(np.cos(relative_yaw)) + object_width * np.abs(np.sin(relative_yaw)))
    half_width = 0.5 * (object_length * np.abs(np.sin(relative_yaw)) + object_width * np.abs(np.cos(relative_yaw)))
    lane_middle = lane.offset + lane.heading * distance_ahead + 0.5 * lane.curvature * distance_ahead**2
    reach_aside = half_width + 0.5 * size[1] + PATH_MARGIN
    is_in_path = (distance_ahead > 0.0) & (distance_ahead < REACH)
    is_in_path &= np.abs(lateral_offset - lane_middle) < reach_aside
    if not is_in_path.any():
        return float("inf")
    free_gap = np.maximum((distance_ahead - half_length)[is_in_path] - 0.5 * size[0], 0.1)
    ego_speed = float(view.speed[row])
    closing_speed = ego_speed - belief.speed[row][is_object].astype(np.float64)[is_in_path] * np.cos(
        relative_yaw[is_in_path]
    )
    desired_gap = STANDSTILL + np.maximum(
        ego_speed * HEADWAY + ego_speed * closing_speed / (2.0 * np.sqrt(MAX_ACCELERATION * COMFORT)), 0.0
    )
    return float((MAX_ACCELERATION * (1.0 - (desired_gap / free_gap) ** 2)).min())


def line_acceleration(view: Observation, row: int, half_length: float) -> float:
    """Return the acceleration that stops the ego at the line of a red light, m/s^2; inf if it need not stop."""
    state, distance = view.signal[row].astype(np.float64).tolist()
    room = distance - half_length - 1.0
    if state not in (SignalState.RED, SignalState.YELLOW) or not -2.0 < room < REACH:
        return float("inf")
    required = float(view.speed[row]) ** 2 / (2.0 * max(room, 0.3))
    if state == SignalState.YELLOW and required > COMFORT:
        return float("inf")
    return -max(required, COMFORT) if required > 0.5 * COMFORT or room < 2.0 else float("inf")

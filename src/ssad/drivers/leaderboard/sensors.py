"""Sensors of CARLA leaderboard agents: mounting, fields of view, and readings in CARLA's frames.

CARLA: x forward, y right, z up, yaw clockwise, degrees. Source: the leaderboard's agent_wrapper.py and
sensor_interface.py (LiDAR of 64 channels from -30 to 10 degrees, 85 m, 600,000 points a second, of which 45 % are
lost; radar of 1,500 points a second, 100 m); for GNSS: CARLA's Mercator projection about latitude 0; for depth: its
sensor reference (24 bits over 1000 m).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import F32, F64, U8
from ssad.rendering.lidar import Lidar

RADIUS: Final = 6378137.0  # m, of the earth in CARLA's projection
CAMERA: Final = "sensor.camera.rgb"
DEPTH: Final = "sensor.camera.depth"
SEMANTIC: Final = "sensor.camera.semantic_segmentation"
LIDAR: Final = "sensor.lidar.ray_cast"
RADAR: Final = "sensor.other.radar"
MAP: Final = "sensor.opendrive_map"
LIMITS: Final[Mapping[str, int]] = {
    CAMERA: 8,
    DEPTH: 8,
    SEMANTIC: 8,
    LIDAR: 2,
    RADAR: 4,
    "sensor.other.gnss": 1,
    "sensor.other.imu": 1,
    MAP: 1,
    "sensor.speedometer": 1,
}
"""Kinds of sensors -> how many of one an agent may have. Depth and semantic cameras are for agents outside of
the competition."""
DEPTH_RANGE: Final = 1000.0  # m
TURNS: Final = 10.0  # of a LiDAR in a second
_ROUNDING: Final = 1e-4  # turns
_FADE: Final = 0.004  # 1/m by which the intensity of a LiDAR's points falls
_RANGE, _REACH = 85.0, 100.0  # m, of LiDAR and radar
_RIGHT: Final = np.array(
    [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
)  # x right, y forward -> x forward, y left


def check_sensors(sensors: Any, location: str) -> list[dict[str, Any]]:
    """Validate the result of an agent's `sensors`. ConfigError for sensors that no leaderboard allows."""
    if not isinstance(sensors, Sequence):
        raise ConfigError(f"{location}: its sensors() must give a list, not {type(sensors).__name__}")
    accepted: list[dict[str, Any]] = []
    for specification in sensors:
        kind: Any = specification.get("type") if isinstance(specification, dict) else specification
        if not isinstance(specification, dict) or "id" not in specification or kind not in LIMITS:
            raise ConfigError(f"{location}: it asks for the sensor {str(kind)[:60]}; there are: {', '.join(LIMITS)}")
        if any(specification["id"] == earlier["id"] for earlier in accepted):
            raise ConfigError(f"{location}: two of its sensors have the id '{str(specification['id'])[:60]}'")
        accepted.append(specification)
        if sum(earlier["type"] == kind for earlier in accepted) > LIMITS[kind]:
            raise ConfigError(f"{location}: it asks for more than {LIMITS[kind]} sensors {kind}")
    return accepted


def geolocation(x: float, y: float) -> tuple[float, float, float]:
    """Return latitude and longitude, degrees, and altitude, m, of a point x m east and y m north of (0, 0)."""
    latitude = 360.0 * math.atan(math.exp(y / RADIUS)) / math.pi - 90.0
    return latitude, math.degrees(x / RADIUS), 0.0


def number(specification: Mapping[str, Any], key: str, default: float, minimum: float, maximum: float) -> float:
    """A number of a sensor. ConfigError if it is none, or outside its range."""
    try:
        value = float(specification.get(key, default))
    except (TypeError, ValueError):
        raise ConfigError(
            f"sensor '{specification['id']}': {key} is not a number: {str(specification[key])[:40]}"
        ) from None
    if not minimum <= value <= maximum:
        raise ConfigError(f"sensor '{specification['id']}': {key} is {value:g}, outside {minimum:g} to {maximum:g}")
    return value


def sensor_pose(specification: Mapping[str, Any], axes: F64) -> F64:
    """Sensor to car [4, 4], from the middle of the car's base, of a sensor whose own frame has these axes [3, 3]."""
    roll, pitch, yaw = (
        math.radians(number(specification, key, 0.0, -720.0, 720.0)) for key in ("roll", "pitch", "yaw")
    )

    def rotation(axis: int, angle: float) -> F64:
        cosine, sine = math.cos(angle), math.sin(angle)
        first, second = [index for index in range(3) if index != axis]
        matrix = np.eye(3)
        matrix[first, first], matrix[first, second], matrix[second, first], matrix[second, second] = (
            cosine,
            -sine,
            sine,
            cosine,
        )
        return matrix

    # CARLA: yaw clockwise seen from above, pitch upwards, roll clockwise seen from behind
    pose = np.eye(4)
    pose[:3, :3] = rotation(2, -yaw) @ rotation(1, pitch) @ rotation(0, roll) @ axes
    x, y, z = (number(specification, key, 0.0, -100.0, 100.0) for key in ("x", "y", "z"))
    # CARLA's y axis points to the right.
    pose[:3, 3] = x, 0.0 - y, z
    return pose


def camera_of(specification: Mapping[str, Any]) -> Camera:
    """A camera of an agent."""
    width, height = (int(number(specification, key, size, 1, 4096)) for key, size in (("width", 800), ("height", 600)))
    focal = 0.5 * width / math.tan(0.5 * math.radians(number(specification, "fov", 100.0, 1.0, 170.0)))
    intrinsic = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return Camera(width, height, intrinsic, sensor_pose(specification, axes), channel=str(specification["id"]))


def lidar_of(specification: Mapping[str, Any]) -> Lidar:
    """The LiDAR that a leaderboard gives its agents: a whole turn a step."""
    elevations = np.deg2rad(np.linspace(-30.0, 10.0, 64))
    pose = sensor_pose(specification, _RIGHT)
    return Lidar(elevations, 937, pose, _RANGE, noise=0.0, period=0.1, blind=0.1, lost=0.45, faint=0.0)


def radar_of(specification: Mapping[str, Any]) -> Lidar:
    """The rays of a radar: 12 times 12, evenly over its field."""
    horizontal, vertical = (
        math.radians(number(specification, f"{key}_fov", 30.0, 0.1, 170.0)) for key in ("horizontal", "vertical")
    )
    elevations: F64 = (np.arange(12, dtype=np.float64) + 0.5) * (vertical / 12) - 0.5 * vertical
    pose = sensor_pose(specification, _RIGHT)
    return Lidar(elevations, 12, pose, _REACH, noise=0.0, period=0.1, blind=0.1, lost=0.0, faint=0.0, width=horizontal)


def encode_depth(depth: F32) -> U8:
    """Return CARLA's image of depths [H, W], m: BGRA, 24 bits over 1000 m of which red are the lowest [H, W, 4]."""
    levels = np.rint(np.clip(depth.astype(np.float64) / DEPTH_RANGE, 0.0, 1.0) * (256**3 - 1)).astype(np.uint32)
    image = np.full((*depth.shape, 4), 255, np.uint8)
    for channel, shift in ((2, 0), (1, 8), (0, 16)):
        image[..., channel] = (levels >> shift) & 255
    return image


def encode_classes(labels: U8) -> U8:
    """Return CARLA's image of classes [H, W]: BGRA, the class in red [H, W, 4]."""
    image = np.zeros((*labels.shape, 4), np.uint8)
    image[..., 2], image[..., 3] = labels, 255
    return image


def fired_points(points: F32, start: float, end: float) -> F32:
    """Return the points of a turn [P, 4] that a LiDAR fires from one time to another, s: it turns ten times a second.

    It turns clockwise and looks ahead at time 0. At 20 Hz every reading is half a turn, right and left by turns.
    """
    share = (end - start) * TURNS
    if share > 1.0 - _ROUNDING:
        return points
    # Rounding moves the bounds of a reading, but never both of two that follow each other.
    first = math.remainder(round(start * TURNS / _ROUNDING) * _ROUNDING, 1.0)
    turned = np.arctan2(points[:, 1], points[:, 0]) / math.tau
    return points[(turned - first) % 1.0 < round(share / _ROUNDING) * _ROUNDING]


def carla_points(points: F32) -> F32:
    """Convert points [., 5] of the world's LiDAR to CARLA's [P, 4]: x forward, y right, z up, m, and intensity."""
    returns = points[points[:, 4] >= 0.0]
    distance = np.linalg.norm(returns[:, :3], axis=1)
    return np.column_stack([returns[:, 1], returns[:, 0], returns[:, 2], np.exp(-_FADE * distance)]).astype(np.float32)

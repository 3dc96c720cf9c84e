"""Types that hosted agents import from `carla`, `agents` and `leaderboard` where these are not installed.

Source of the interface: CARLA's Python API, its agents.navigation.local_planner, and the leaderboard's
autoagents/autonomous_agent.py and utils/route_manipulation.py.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from typing import Any, Final

SPACING: Final = 200.0  # m between the plan points that the base class of leaderboard 2 keeps; in 1.0 it was 50 m


class RoadOption(enum.IntEnum):
    """Command of the plan at a point, as in CARLA's agents.navigation.local_planner."""

    VOID = -1
    LEFT = 1
    RIGHT = 2
    STRAIGHT = 3
    LANEFOLLOW = 4
    CHANGELANELEFT = 5
    CHANGELANERIGHT = 6


class Track(enum.Enum):
    """Permitted inputs of an agent, as in the leaderboard."""

    SENSORS = "SENSORS"
    MAP = "MAP"
    SENSORS_QUALIFIER = "SENSORS_QUALIFIER"
    MAP_QUALIFIER = "MAP_QUALIFIER"


class TrafficLightState(enum.IntEnum):
    """State of a traffic light, as carla.TrafficLightState."""

    Red = 0
    Yellow = 1
    Green = 2
    Off = 3
    Unknown = 4


class CarlaLaneType(enum.IntFlag):
    """Kinds of lanes, as carla.LaneType."""

    NONE = 1
    Driving = 2
    Shoulder = 8
    Sidewalk = 32
    Any = -2


def downsample_route(route: Sequence[Any], sample_factor: float) -> list[int]:
    """Return the indices of the points of a plan that the leaderboard keeps.

    They are the first and the last, every point of a lane change, those where the command changes, and one after
    each `sample_factor` metres.

    Args:
        route: Pairs of carla.Transform and `RoadOption`.
        sample_factor: Distance, m.
    """
    lane_changes = {int(RoadOption.CHANGELANELEFT), int(RoadOption.CHANGELANERIGHT)}
    indices: list[int] = []
    distance = 0.0
    for index, (transform, option) in enumerate(route):
        previous = int(route[index - 1][1]) if index else None
        is_change = int(option) != previous and previous not in lane_changes
        if index in (0, len(route) - 1) or int(option) in lane_changes or is_change or distance > sample_factor:
            indices.append(index)
            distance = 0.0
        else:
            distance += transform.location.distance(route[index - 1][0].location)
    return indices


class AutonomousAgent:
    """Base class of agents where the package `leaderboard` is not installed."""

    def __init__(self, carla_host: str = "", carla_port: int = 0, debug: bool = False) -> None:
        self.track = Track.SENSORS
        self._global_plan: Any = None
        self._global_plan_world_coord: Any = None
        self.sensor_interface = None
        self.wallclock_t0 = None

    def set_global_plan(self, global_plan_gps: Sequence[Any], global_plan_world_coord: Sequence[Any]) -> None:
        """Keep the points of the plan that `downsample_route` keeps."""
        indices = downsample_route(global_plan_world_coord, SPACING)
        self._global_plan = [global_plan_gps[index] for index in indices]
        self._global_plan_world_coord = [global_plan_world_coord[index] for index in indices]

    def setup(self, path_to_conf_file: str) -> None:
        """Prepare the agent; to be overridden."""

    def sensors(self) -> list[dict[str, Any]]:
        """Return the sensors of the agent; to be overridden."""
        return []

    def destroy(self) -> None:
        """Clean up; to be overridden."""

    @staticmethod
    def get_ros_version() -> int:
        """Return -1: the agent does not use ROS."""
        return -1


class VehicleControl:
    """Control command of an agent where `carla` is not installed."""

    def __init__(  # noqa: PLR0917
        self,
        throttle: float = 0.0,
        steer: float = 0.0,
        brake: float = 0.0,
        hand_brake: bool = False,
        reverse: bool = False,
        manual_gear_shift: bool = False,
        gear: int = 0,
    ) -> None:
        self.throttle, self.steer, self.brake = throttle, steer, brake
        self.hand_brake, self.reverse = hand_brake, reverse
        self.manual_gear_shift, self.gear = manual_gear_shift, gear


class Vector3D:
    """Vector in CARLA's frame where `carla` is not installed."""

    def __init__(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> None:
        self.x, self.y, self.z = x, y, z

    def __add__(self, other: Any) -> Any:
        return type(self)(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: Any) -> Any:
        return type(self)(self.x - other.x, self.y - other.y, self.z - other.z)

    def __mul__(self, factor: float) -> Any:
        return type(self)(self.x * factor, self.y * factor, self.z * factor)

    def length(self) -> float:
        """Return the Euclidean length."""
        return math.sqrt(self.x**2 + self.y**2 + self.z**2)

    def dot(self, other: Any) -> float:
        """Return the scalar product."""
        return float(self.x * other.x + self.y * other.y + self.z * other.z)


class Location(Vector3D):
    """Position in CARLA's frame where `carla` is not installed."""

    def distance(self, other: Any) -> float:
        """Return the Euclidean distance to another location."""
        return math.dist((self.x, self.y, self.z), (other.x, other.y, other.z))


class Rotation:
    """Rotation in CARLA's frame, degrees, where `carla` is not installed."""

    def __init__(self, pitch: float = 0.0, yaw: float = 0.0, roll: float = 0.0) -> None:
        self.pitch, self.yaw, self.roll = pitch, yaw, roll

    def get_forward_vector(self) -> Vector3D:
        """Return the unit vector ahead."""
        pitch, yaw = math.radians(self.pitch), math.radians(self.yaw)
        return Vector3D(math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch))


class Transform:
    """Position and rotation where `carla` is not installed."""

    def __init__(self, location: Location | None = None, rotation: Rotation | None = None) -> None:
        self.location, self.rotation = location or Location(), rotation or Rotation()

    def get_forward_vector(self) -> Vector3D:
        """Return the unit vector ahead."""
        return self.rotation.get_forward_vector()


class BoundingBox:
    """Box of an actor where `carla` is not installed: centre and half sizes, m."""

    def __init__(self, location: Location | None = None, extent: Vector3D | None = None) -> None:
        self.location, self.extent = location or Location(), extent or Vector3D()


CARLA_TYPES: Final = {
    "VehicleControl": VehicleControl,
    "Vector3D": Vector3D,
    "Location": Location,
    "Rotation": Rotation,
    "Transform": Transform,
    "BoundingBox": BoundingBox,
    "TrafficLightState": TrafficLightState,
    "LaneType": CarlaLaneType,
}
"""Types that stand in for those of `carla`, by their name there."""

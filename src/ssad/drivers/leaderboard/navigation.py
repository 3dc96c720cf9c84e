"""Planners, controllers and geometry of CARLA's `agents` where these are not installed.

Source of interface and numbers: CARLA's PythonAPI agents.navigation.local_planner, behavior_agent and controller,
agents.tools.misc, and the leaderboard's utils/route_manipulation.py.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

from ssad.core.errors import ConfigError
from ssad.core.rotations import wrap_scalar
from ssad.drivers.leaderboard.basic_agent import BRAKE, STEER, THROTTLE, BasicAgent, PidController
from ssad.drivers.leaderboard.road_map import GlobalRoutePlanner, TownMap, Waypoint
from ssad.drivers.leaderboard.scene import CarlaDataProvider, HostedWorld, SceneActor
from ssad.drivers.leaderboard.sensors import geolocation

BEHAVIORS: Final = {"cautious": (40.0, 6.0), "normal": (50.0, 3.0), "aggressive": (70.0, 1.0)}
"""Highest speed and margin below the speed limit, km/h."""
STEER_CHANGE: Final = 0.1  # most that the steering changes in a step


class LocalPlanner:
    """Follower of a plan that looks at no other vehicle and no light.

    Args:
        vehicle: The ego.
        opt_dict: `target_speed`, km/h; others have no effect.
        map_inst: Map; None: that of the vehicle's world.
    """

    def __init__(
        self, vehicle: SceneActor, opt_dict: Mapping[str, Any] | None = None, map_inst: TownMap | None = None
    ) -> None:
        options = {**(opt_dict or {}), "ignore_traffic_lights": True, "ignore_vehicles": True}
        self._agent = BasicAgent(vehicle, opt_dict=options, map_inst=map_inst)

    def set_speed(self, speed: float) -> None:
        """Set the target speed, km/h."""
        self._agent.set_target_speed(speed)

    def follow_speed_limits(self, value: bool = True) -> None:
        """Take the speed limit of the lane for the target speed."""
        self._agent.follow_speed_limits(value)

    def set_global_plan(
        self,
        current_plan: Sequence[tuple[Any, Any]],
        stop_waypoint_creation: bool = True,
        clean_queue: bool = True,
    ) -> None:
        """Follow a plan of waypoints and commands; without `clean_queue` after the present one."""
        self._agent.set_global_plan(current_plan, stop_waypoint_creation, clean_queue)

    def get_plan(self) -> list[tuple[Waypoint, Any]]:
        """Return what is left of the plan."""
        return self._agent.plan

    def get_incoming_waypoint_and_direction(self, steps: int = 3) -> tuple[Waypoint | None, Any]:
        """Return the waypoint and the command some points ahead; of a shorter plan its last, of none None and VOID."""
        plan = self._agent.plan
        if not plan:
            return None, sys.modules["agents.navigation.local_planner"].RoadOption.VOID
        return plan[min(steps, len(plan) - 1)]

    def done(self) -> bool:
        """Return whether the plan is driven."""
        return self._agent.done()

    def run_step(self, debug: bool = False) -> Any:
        """Return carla.VehicleControl for the next step."""
        return self._agent.run_step(debug)


class BehaviorAgent(BasicAgent):
    """`BasicAgent` with a speed below the limit by its temper: cautious, normal or aggressive."""

    def __init__(self, vehicle: SceneActor, behavior: str = "normal", *arguments: Any, **options: Any) -> None:
        if behavior not in BEHAVIORS:
            raise ConfigError(f"BehaviorAgent: behavior '{behavior}' is none of {', '.join(BEHAVIORS)}")
        super().__init__(vehicle, BEHAVIORS[behavior][0], *arguments, **options)
        self._behavior = behavior

    def run_step(self, debug: bool = False) -> Any:
        """Return carla.VehicleControl for the next step."""
        highest, margin = BEHAVIORS[self._behavior]
        self.set_target_speed(min(highest, max(self._scene.actors[0].get_speed_limit() - margin, 0.0)))
        return super().run_step(debug)


class VehiclePIDController:
    """PID controllers of steering and pedals towards a waypoint.

    Args:
        vehicle: The vehicle.
        args_lateral: Gains `K_P`, `K_I`, `K_D` of the steering, and the time `dt` of a step, s.
        args_longitudinal: The same of the pedals.
        offset: m to the right of the waypoint that is aimed at.
        max_throttle: Limit.
        max_brake: Limit.
        max_steering: Limit.
    """

    def __init__(  # noqa: PLR0917
        self,
        vehicle: SceneActor,
        args_lateral: Mapping[str, float],
        args_longitudinal: Mapping[str, float],
        offset: float = 0.0,
        max_throttle: float = THROTTLE,
        max_brake: float = BRAKE,
        max_steering: float = STEER,
    ) -> None:
        self._vehicle, self._offset = vehicle, offset
        self._limits = max_throttle, max_brake, max_steering
        self._steering, self._pedals = _controller(args_lateral), _controller(args_longitudinal)
        self._steer = 0.0

    def run_step(self, target_speed: float, waypoint: Any) -> Any:
        """Return carla.VehicleControl towards a waypoint at a speed in km/h."""
        vehicle = self._vehicle.scene.actors[0] if self._vehicle.role else self._vehicle
        throttle, brake, steering = self._limits
        x, y, yaw = vehicle.pose
        location, heading = waypoint.transform.location, math.radians(waypoint.transform.rotation.yaw)
        aim_x = location.x - self._offset * math.sin(heading)
        aim_y = location.y + self._offset * math.cos(heading)
        steer = self._steering(-wrap_scalar(math.atan2(-aim_y - y, aim_x - x) - yaw))
        steer = max(self._steer - STEER_CHANGE, min(self._steer + STEER_CHANGE, steer))
        self._steer = max(-steering, min(steering, steer))
        pedal = self._pedals(target_speed - 3.6 * vehicle.speed)
        control = sys.modules["carla"].VehicleControl()
        control.steer = self._steer
        control.throttle = max(0.0, min(throttle, pedal))
        control.brake = max(0.0, min(brake, -pedal))
        return control


def _controller(gains: Mapping[str, float]) -> PidController:
    return PidController((gains.get("K_P", 1.0), gains.get("K_I", 0.0), gains.get("K_D", 0.0)), gains.get("dt", 0.03))


# ---------------------------------------------------------------- agents.tools.misc


def get_speed(vehicle: Any) -> float:
    """Return the speed of a vehicle, km/h."""
    velocity = vehicle.get_velocity()
    return 3.6 * math.sqrt(velocity.x**2 + velocity.y**2 + velocity.z**2)


def compute_distance(location_1: Any, location_2: Any) -> float:
    """Return the distance of two locations, m; the source adds a machine epsilon, so it is never 0."""
    return float(location_1.distance(location_2)) + sys.float_info.epsilon


def vector(location_1: Any, location_2: Any) -> list[float]:
    """Return the unit vector [x, y, z] from one location to another."""
    difference = [getattr(location_2, axis) - getattr(location_1, axis) for axis in "xyz"]
    norm = math.hypot(*difference) + sys.float_info.epsilon
    return [component / norm for component in difference]


def positive(num: float) -> float:
    """Return a number, or 0 for a negative one."""
    return max(num, 0.0)


def distance_vehicle(waypoint: Any, vehicle_transform: Any) -> float:
    """Return the distance of a waypoint from a vehicle in the plane, m."""
    place, location = waypoint.transform.location, vehicle_transform.location
    return math.hypot(place.x - location.x, place.y - location.y)


def is_within_distance(
    target_transform: Any,
    reference_transform: Any,
    max_distance: float,
    angle_interval: Sequence[float] | None = None,
) -> bool:
    """Return whether a target is within a distance, m, and, if given, an interval of angles from ahead, degrees."""
    target, reference = target_transform.location, reference_transform.location
    distance = math.hypot(target.x - reference.x, target.y - reference.y)
    if distance < 0.001 or distance > max_distance:
        return distance < 0.001
    if not angle_interval:
        return True
    _, angle = compute_magnitude_angle(target, reference, reference_transform.rotation.yaw)
    return bool(angle_interval[0] < angle < angle_interval[1])


def compute_magnitude_angle(target_location: Any, current_location: Any, orientation: float) -> tuple[float, float]:
    """Return the distance of a location in the plane, m, and its angle from a heading, degrees from 0 to 180."""
    across, along = target_location.y - current_location.y, target_location.x - current_location.x
    angle = abs(math.degrees(wrap_scalar(math.atan2(across, along) - math.radians(orientation))))
    return math.hypot(along, across), angle


def draw_waypoints(world: Any, waypoints: Sequence[Any], z: float = 0.5) -> None:
    """Draw nothing: there is no server."""


# ---------------------------------------------------------------- leaderboard.utils.route_manipulation


def location_route_to_gps(route: Sequence[Any], lat_ref: float = 0.0, lon_ref: float = 0.0) -> list[Any]:
    """Return pairs of latitude, longitude and height by name, and the command, of a plan of transforms."""
    return [(_gps(transform.location), option) for transform, option in route]


def interpolate_trajectory(*arguments: Any, **options: Any) -> tuple[list[Any], list[Any]]:
    """Return a plan along the lanes through locations: by coordinates of GNSS, and by transform, each with commands.

    Arguments are the locations and the distance of two points, 1 m if left out; in leaderboard 1.0 the world comes
    first.

    Raises:
        RouteError: No path leads from one location to the next.
    """
    given = [value for value in arguments if not isinstance(value, HostedWorld)]
    locations = options.get("waypoints_trajectory", given[0] if given else ())
    spacing = float(options.get("hop_resolution", given[1] if len(given) > 1 else 1.0))
    planner = GlobalRoutePlanner(CarlaDataProvider.get_map(), spacing)
    route = [
        (waypoint.transform, option)
        for start, end in pairwise(locations)
        for waypoint, option in planner.trace_route(start, end)
    ]
    return location_route_to_gps(route), route


def _gps(location: Any) -> dict[str, float]:
    latitude, longitude, _ = geolocation(location.x, -location.y)
    return {"lat": latitude, "lon": longitude, "z": location.z}

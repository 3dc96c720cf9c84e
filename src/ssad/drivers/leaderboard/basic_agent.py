"""BasicAgent of CARLA where its `agents` are not installed: it follows a plan, and stops for vehicles and red lights.

Source of interface and numbers: CARLA's PythonAPI agents.navigation.basic_agent and local_planner (PID gains, limits
of throttle, brake and steering, distances at which it stops).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Final

from ssad.core.errors import ConfigError
from ssad.core.rotations import wrap_scalar
from ssad.drivers.leaderboard.road_map import GlobalRoutePlanner, TownMap, Waypoint
from ssad.drivers.leaderboard.scene import STEP, HostedScene, SceneActor

STEERING: Final = (1.95, 0.05, 0.2)  # proportional, integral and derivative gain
PEDALS: Final = (1.0, 0.05, 0.0)
MEMORY: Final = 10  # errors that the integral spans
THROTTLE, BRAKE, EMERGENCY, STEER = 0.75, 0.3, 0.5, 0.8  # limits
NEAR: Final = 5.0  # m to a vehicle or a stop line at which it stops, and 1 m more for each m/s
LANE: Final = 1.5  # m beside the plan within which a vehicle is in the way
LOOK_AHEAD: Final = 3.0  # m to the point that it steers to, and half a metre more for each m/s


class PidController:
    """PID controller with a short memory.

    Args:
        gains: Proportional, integral and derivative gain.
        step: Time between two errors, s.
    """

    def __init__(self, gains: tuple[float, float, float], step: float = STEP) -> None:
        self._gains, self._step = gains, step
        self._errors: list[float] = []

    def __call__(self, error: float) -> float:
        """Return the command for an error."""
        self._errors = [*self._errors[1 - MEMORY :], error]
        change = (self._errors[-1] - self._errors[-2]) / self._step if len(self._errors) > 1 else 0.0
        proportional, integral, derivative = self._gains
        return proportional * error + integral * sum(self._errors) * self._step + derivative * change


class BasicAgent:
    """Agent that drives a vehicle along a plan.

    Args:
        vehicle: The ego, from `CarlaDataProvider.get_hero_actor()` or the world's actors.
        target_speed: km/h.
        opt_dict: `ignore_traffic_lights`, `ignore_vehicles`, `ignore_stop_signs`, `target_speed`; others have no
            effect.
        map_inst: Map; None: that of the vehicle's world.
        grp_inst: Planner of routes; None: one with points 2 m apart.
    """

    def __init__(
        self,
        vehicle: SceneActor,
        target_speed: float = 20.0,
        opt_dict: Mapping[str, Any] | None = None,
        map_inst: TownMap | None = None,
        grp_inst: GlobalRoutePlanner | None = None,
    ) -> None:
        if not getattr(vehicle, "role", ""):
            raise ConfigError("BasicAgent drives the ego alone: CarlaDataProvider.get_hero_actor()")
        options = dict(opt_dict or {})
        self._scene: HostedScene = vehicle.scene
        self._map = map_inst or vehicle.get_world().get_map()
        self._planner = grp_inst or GlobalRoutePlanner(self._map, 2.0)
        self._target_speed = float(options.get("target_speed", target_speed))
        self._ignores_lights = bool(options.get("ignore_traffic_lights", False))
        self._ignores_vehicles = bool(options.get("ignore_vehicles", False))
        self._follows_limits = False
        self._plan: list[tuple[Waypoint, Any]] = []
        self._steering, self._pedals = PidController(STEERING), PidController(PEDALS)

    def set_target_speed(self, speed: float) -> None:
        """Set the target speed, km/h."""
        self._target_speed, self._follows_limits = float(speed), False

    def follow_speed_limits(self, value: bool = True) -> None:
        """Take the speed limit of the lane for the target speed."""
        self._follows_limits = value

    def ignore_traffic_lights(self, active: bool = True) -> None:
        """Drive on at red lights."""
        self._ignores_lights = active

    def ignore_vehicles(self, active: bool = True) -> None:
        """Drive on behind vehicles."""
        self._ignores_vehicles = active

    def ignore_stop_signs(self, active: bool = True) -> None:
        """Do nothing: it never stops at stop signs, like CARLA's."""

    def get_global_planner(self) -> GlobalRoutePlanner:
        """Return the planner of routes."""
        return self._planner

    def trace_route(self, start_waypoint: Any, end_waypoint: Any) -> list[tuple[Waypoint, Any]]:
        """Return the plan from one waypoint to another."""
        return self._planner.trace_route(start_waypoint.transform.location, end_waypoint.transform.location)

    def set_destination(self, end_location: Any, start_location: Any = None) -> None:
        """Plan a route from a location, or from where the vehicle is. RouteError if there is none."""
        start = start_location or self._scene.actors[0].get_transform()
        self._plan = self._planner.trace_route(start, end_location)

    def set_global_plan(
        self, plan: Sequence[tuple[Any, Any]], stop_waypoint_creation: bool = True, clean_queue: bool = True
    ) -> None:
        """Follow a plan of waypoints and commands; without `clean_queue` after the present one."""
        self._plan = [*([] if clean_queue else self._plan), *plan]

    @property
    def plan(self) -> list[tuple[Waypoint, Any]]:
        """Return the rest of the plan."""
        return self._plan

    def done(self) -> bool:
        """Return whether the plan is driven."""
        return not self._plan

    def run_step(self, debug: bool = False) -> Any:
        """Return carla.VehicleControl for the next step."""
        hero = self._scene.actors[0]
        x, y, yaw = hero.pose
        reach = LOOK_AHEAD + 0.5 * abs(hero.speed)
        # The plan begins at the first point that is not yet passed.
        while self._plan and self._distance_ahead(self._plan[0][0], hero) < 0.0:
            self._plan.pop(0)
        control = sys.modules["carla"].VehicleControl()
        if not self._plan or self._is_blocked(hero) or self._is_red(hero):
            control.brake = EMERGENCY
            return control
        aims = [entry for entry in self._plan if self._distance_ahead(entry[0], hero) >= reach]
        location = (aims[0] if aims else self._plan[-1])[0].transform.location
        bearing = math.atan2(-location.y - y, location.x - x)
        # Steering to the right is positive.
        steer = self._steering(-wrap_scalar(bearing - yaw))
        target = hero.get_speed_limit() if self._follows_limits else self._target_speed
        pedal = self._pedals(target - 3.6 * hero.speed)
        control.steer = max(-STEER, min(STEER, steer))
        control.throttle = max(0.0, min(THROTTLE, pedal))
        control.brake = max(0.0, min(BRAKE, -pedal))
        return control

    @staticmethod
    def _distance_ahead(waypoint: Waypoint, hero: SceneActor) -> float:
        x, y, yaw = hero.pose
        location = waypoint.transform.location
        return float((location.x - x) * math.cos(yaw) + (-location.y - y) * math.sin(yaw))

    def _is_red(self, hero: SceneActor) -> bool:
        if self._ignores_lights:
            return False
        red = hero.get_traffic_light_state() == sys.modules["carla"].TrafficLightState.Red
        return bool(red and self._scene.signal[1] < NEAR + abs(hero.speed))

    def _is_blocked(self, hero: SceneActor) -> bool:
        if self._ignores_vehicles:
            return False
        reach = NEAR + abs(hero.speed) + 0.5 * hero.size[0]
        path = [waypoint.transform.location for waypoint, _ in self._plan[: int(reach) + 1]]
        for other in self._scene.actors[1:]:
            if not other.type_id.startswith("vehicle"):
                continue
            location = other.get_location()
            gap = hero.get_location().distance(location) - 0.5 * other.size[0]
            beside = min((place.distance(location) for place in path), default=math.inf)
            if gap < reach and beside < LANE:
                return True
        return False

"""CARLA leaderboard agents as driving systems: `setup`, `sensors`, `run_step`, without CARLA.

`--set systems=[leaderboard:FILE.py]` takes the class that FILE's `get_entry_point` names; a second colon
introduces the path passed to `setup`. Where the packages `leaderboard`, `agents` and `carla` are not installed,
minimal stand-ins provide the names that agents need.

Each episode has its own agent. Agents receive (number of the step, data) by id of the sensor. Frames are
CARLA's, left-handed: y to the right, yaw clockwise. Source of the interface: the leaderboard's
autoagents/autonomous_agent.py and its pages on sensors.
"""

from __future__ import annotations

import enum
import hashlib
import importlib.util
import math
import sys
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssad.core.driving import Observation
from ssad.core.errors import ConfigError, FormatError
from ssad.core.frames import Camera
from ssad.core.lane_graph import LaneGraph
from ssad.core.registry import describe
from ssad.core.rotations import wrap_angle
from ssad.core.safeio import read_bytes
from ssad.core.types import F32, F64, Controller, Episode, Route
from ssad.drivers.leaderboard_sensors import (
    CAMERA,
    LIDAR,
    MAP,
    RADAR,
    camera_of,
    carla_points,
    check_sensors,
    geolocation,
    lidar_of,
    radar_of,
)
from ssad.rendering.lidar import Lidar
from ssad.world.roads import load_town, town_xodr

GRAVITY: Final = 9.81  # m/s^2
STEP: Final = 0.1  # s
TURN: Final = math.radians(30.0)  # a path through a junction that turns less counts as straight
APART: Final = 50.0  # m between the plan points that the base class keeps


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


class AutonomousAgent:
    """Base class of agents where the package `leaderboard` is not installed."""

    def __init__(self, carla_host: str = "", carla_port: int = 0, debug: bool = False) -> None:
        self.track = Track.SENSORS
        self._global_plan: Any = None
        self._global_plan_world_coord: Any = None
        self.sensor_interface = None
        self.wallclock_t0 = None

    def set_global_plan(self, global_plan_gps: Sequence[Any], global_plan_world_coord: Sequence[Any]) -> None:
        """Keep a point of the plan every 50 m, and where the command changes."""
        indices, last_index = [0], 0
        for index in range(1, len(global_plan_gps)):
            if (
                index == len(global_plan_gps) - 1
                or index - last_index >= APART
                or global_plan_gps[index][1] != global_plan_gps[index - 1][1]
            ):
                indices.append(index)
                last_index = index
        self._global_plan = [global_plan_gps[index] for index in indices]
        self._global_plan_world_coord = [global_plan_world_coord[index] for index in indices]

    def setup(self, path_to_conf_file: str) -> None:
        """Prepare the agent; to be overridden."""

    def sensors(self) -> list[dict[str, Any]]:
        """Return the sensors of the agent; to be overridden."""
        return []

    def destroy(self) -> None:
        """Clean up; to be overridden."""


class Leaderboard:
    """`Driver` adapter of a leaderboard agent.

    Args:
        path: File of the agent, optionally followed by a colon and the argument of `setup`.

    Raises:
        ConfigError: The file has no agent, fails to import, or requests an unknown sensor.
    """

    name = "leaderboard"
    controller = Controller.EXTERNAL

    def __init__(self, path: str) -> None:
        file, _, self._config = path.partition(":")
        self.path = Path(file)
        try:
            source = read_bytes(self.path)
        except FormatError as error:
            raise ConfigError(f"system 'leaderboard:{path}': {error}") from None
        self.version = hashlib.sha256(source + self._config.encode()).hexdigest()
        self._agent_class = self._load_agent_class(path)
        self._specifications = self._sensors()
        self.cameras: Mapping[str, Camera] = {
            specification["id"]: camera_of(specification)
            for specification in self._specifications
            if specification["type"] == CAMERA
        }
        self.lidars: Mapping[str, Lidar] = {
            specification["id"]: lidar_of(specification)
            for specification in self._specifications
            if specification["type"] == LIDAR
        }
        self.radars: Mapping[str, Lidar] = {
            specification["id"]: radar_of(specification)
            for specification in self._specifications
            if specification["type"] == RADAR
        }
        self.sensors = (*self.cameras, *self.lidars, *self.radars)
        self._agents: list[Any] = []
        self._last_headings: dict[int, tuple[float, float]] = {}
        self._maps: list[str] = []

    def _load_agent_class(self, path: str) -> type:
        _install_stand_ins()
        spec = importlib.util.spec_from_file_location(f"leaderboard_agent_{self.version[:12]}", self.path)
        if spec is None or spec.loader is None:
            raise ConfigError(f"system 'leaderboard:{path}': expected the path of a Python file")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        previous_path = list(sys.path)
        # Agents import their own modules relative to their folder.
        sys.path.insert(0, str(self.path.resolve().parent))
        try:
            spec.loader.exec_module(module)
        except Exception as error:
            raise ConfigError(f"system 'leaderboard:{path}': importing it failed: {describe(error)}") from error
        finally:
            sys.path[:] = previous_path
        class_name = getattr(module, "get_entry_point", lambda: "")()
        agent_class = getattr(module, str(class_name), None)
        if not isinstance(agent_class, type) or not callable(getattr(agent_class, "run_step", None)):
            raise ConfigError(f"system 'leaderboard:{path}': its get_entry_point() names no class with run_step")
        return agent_class

    def _make_agent(self) -> Any:
        """Make and set up an agent. Leaderboard 2.0 constructs from host and port, 1.0 from the configuration."""
        try:
            try:
                agent = self._agent_class("localhost", 2000)
            except TypeError:
                return self._agent_class(self._config)
            agent.setup(self._config)
        except Exception as error:
            raise ConfigError(f"system 'leaderboard:{self.path}': setup failed: {describe(error)}") from error
        return agent

    def _sensors(self) -> list[dict[str, Any]]:
        """Return the validated sensor specifications of an agent."""
        agent, location = self._make_agent(), f"system 'leaderboard:{self.path}'"
        try:
            specifications = agent.sensors()
        except Exception as error:
            raise ConfigError(f"{location}: sensors() failed: {describe(error)}") from error
        return check_sensors(specifications, location)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Make a new agent for each episode, with the plan of its route."""
        for agent in self._agents:
            getattr(agent, "destroy", lambda: None)()
        self._agents, self._last_headings = [], {}
        wants_map = any(specification["type"] == MAP for specification in self._specifications)
        self._maps = [town_xodr(episode.town) if wants_map else "" for episode in episodes]
        for episode in episodes:
            agent = self._make_agent()
            agent.sensors()  # some agents initialise themselves in sensors()
            route = episode.agents[0].route
            assert route is not None
            gps_plan, world_plan = _global_plan(route, load_town(episode.town))
            agent.set_global_plan(gps_plan, world_plan)
            self._agents.append(agent)

    def act(self, view: Observation) -> F32:
        """Return the controls of each row's agent."""
        controls = np.zeros((len(view.scene), 4), np.float32)
        for row, scene in enumerate(view.scene.tolist()):
            if view.done[row]:
                continue
            control = self._agents[scene].run_step(self._agent_input(view, row), float(view.time[row]))
            controls[row] = control.throttle, control.brake, -control.steer, bool(getattr(control, "reverse", False))
            if getattr(control, "hand_brake", False):
                controls[row, :2] = 0.0, 1.0
        return controls

    def _agent_input(self, view: Observation, row: int) -> dict[str, tuple[int, Any]]:
        time, yaw = float(view.time[row]), float(view.pose[row, 2])
        step = round(time / STEP)
        readings: dict[str, tuple[int, Any]] = {}
        for specification in self._specifications:
            sensor_type = specification["type"]
            value: Any
            if sensor_type == CAMERA:
                image = view.readings[specification["id"]][row]
                alpha = np.full((1, *image.shape[1:]), 255, np.uint8)
                # CARLA delivers BGRA.
                value = np.concatenate([image[::-1], alpha]).transpose(1, 2, 0).copy()
            elif sensor_type == LIDAR:
                value = carla_points(view.readings[specification["id"]][row])
            elif sensor_type == RADAR:
                returns = view.readings[specification["id"]][row]
                value = returns[returns[:, 0] > 0.0]
            elif sensor_type == "sensor.other.gnss":
                value = np.array(geolocation(float(view.pose[row, 0]), float(view.pose[row, 1])))
            elif sensor_type == "sensor.other.imu":
                value = self._imu(view, row, yaw)
            elif sensor_type == "sensor.speedometer":
                value = {"speed": float(view.speed[row])}
            else:
                value = {"opendrive": self._maps[int(view.scene[row])]}
            readings[str(specification["id"])] = (step, value)
        self._last_headings[int(view.scene[row])] = (time, yaw)
        return readings

    def _imu(self, view: Observation, row: int, yaw: float) -> F64:
        """Return accelerations and rates [6], and the compass: clockwise from north, rad."""
        last_time, last_yaw = self._last_headings.get(int(view.scene[row]), (float(view.time[row]), yaw))
        elapsed = float(view.time[row]) - last_time
        yaw_rate = float(wrap_angle(yaw - last_yaw)) / elapsed if elapsed > 0.0 else 0.0
        compass = (0.5 * math.pi - yaw) % math.tau
        lateral = -float(view.speed[row]) * yaw_rate
        return np.array([float(view.accel[row]), lateral, GRAVITY, 0.0, 0.0, -yaw_rate, compass])


def _global_plan(route: Route, graph: LaneGraph) -> tuple[list[Any], list[Any]]:
    """Return the plan of a route, a point per metre: geographic and as CARLA's transforms, with `RoadOption`."""
    import carla

    in_junction = (route.lane >= 0) & (graph.junction[route.lane] >= 0)
    options = np.full(len(route.xy), int(RoadOption.LANEFOLLOW))
    entries = np.flatnonzero(in_junction & ~np.concatenate([[False], in_junction[:-1]]))
    for entry in entries.tolist():
        exits = np.flatnonzero(~in_junction[entry:])
        exit_index = entry + int(exits[0]) if len(exits) else len(in_junction) - 1
        turn = float(wrap_angle(float(route.yaw[exit_index] - route.yaw[entry])))
        command = RoadOption.LEFT if turn > TURN else RoadOption.RIGHT if turn < -TURN else RoadOption.STRAIGHT
        options[entry : exit_index + 1] = int(command)
    gps_plan, world_plan = [], []
    for (x, y), yaw, option in zip(route.xy.tolist(), route.yaw.tolist(), options.tolist(), strict=True):
        latitude, longitude, z = geolocation(x, y)
        gps_plan.append(({"lat": latitude, "lon": longitude, "z": z}, _road_option(option)))
        transform = carla.Transform(carla.Location(x=x, y=-y, z=z), carla.Rotation(yaw=-math.degrees(yaw)))
        world_plan.append((transform, _road_option(option)))
    return gps_plan, world_plan


def _road_option(value: int) -> Any:
    return sys.modules["agents.navigation.local_planner"].RoadOption(value)


def _install_stand_ins() -> None:
    """Put our few names where packages that agents import are not installed."""

    def offer(name: str, **content: Any) -> None:
        parts = name.split(".")
        try:
            importlib.import_module(name)
        except ImportError:
            for k in range(1, len(parts) + 1):
                module = sys.modules.setdefault(".".join(parts[:k]), types.ModuleType(".".join(parts[:k])))
                if k > 1:
                    setattr(sys.modules[".".join(parts[: k - 1])], parts[k - 1], module)
            vars(sys.modules[name]).update(content)

    offer("leaderboard.autoagents.autonomous_agent", AutonomousAgent=AutonomousAgent, Track=Track)
    offer("agents.navigation.local_planner", RoadOption=RoadOption)
    offer("carla", **{kind.__name__: kind for kind in (VehicleControl, Location, Rotation, Transform)})


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


class Location:
    """Position in CARLA's frame where `carla` is not installed."""

    def __init__(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> None:
        self.x, self.y, self.z = x, y, z


class Rotation:
    """Rotation in CARLA's frame, degrees, where `carla` is not installed."""

    def __init__(self, pitch: float = 0.0, yaw: float = 0.0, roll: float = 0.0) -> None:
        self.pitch, self.yaw, self.roll = pitch, yaw, roll


class Transform:
    """Position and rotation where `carla` is not installed."""

    def __init__(self, location: Location | None = None, rotation: Rotation | None = None) -> None:
        self.location, self.rotation = location or Location(), rotation or Rotation()

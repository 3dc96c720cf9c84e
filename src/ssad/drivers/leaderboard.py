"""A driving agent of the CARLA leaderboard as a driving system: `setup`, `sensors`, `run_step`, without CARLA.

`--set systems=[leaderboard:FILE.py]` takes the class that FILE's `get_entry_point` names; after a second colon stands
the path that `setup` gets. Where the packages `leaderboard`, `agents` and `carla` are not installed, the few names that
agents need of them are put in their places.

Each episode has an agent of its own. What agents are told, by id of the sensor: (number of the step, data). Frames are
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
    checked,
    cloud,
    geolocation,
    lidar_of,
    radar_of,
)
from ssad.rendering.lidar import Lidar
from ssad.world.roads import load_town, town_xodr

GRAVITY: Final = 9.81  # m/s^2
STEP: Final = 0.1  # s
TURN: Final = math.radians(30.0)  # a way through a junction that turns less goes straight on
APART: Final = 50.0  # m between points of the plan that the base class keeps


class RoadOption(enum.IntEnum):
    """What the plan says at a point, as in CARLA's agents.navigation.local_planner."""

    VOID = -1
    LEFT = 1
    RIGHT = 2
    STRAIGHT = 3
    LANEFOLLOW = 4
    CHANGELANELEFT = 5
    CHANGELANERIGHT = 6


class Track(enum.Enum):
    """What an agent may use, as in the leaderboard."""

    SENSORS = "SENSORS"
    MAP = "MAP"
    SENSORS_QUALIFIER = "SENSORS_QUALIFIER"
    MAP_QUALIFIER = "MAP_QUALIFIER"


class AutonomousAgent:
    """The base class of agents where the package `leaderboard` is not installed."""

    def __init__(self, carla_host: str = "", carla_port: int = 0, debug: bool = False) -> None:
        self.track = Track.SENSORS
        self._global_plan: Any = None
        self._global_plan_world_coord: Any = None
        self.sensor_interface = None
        self.wallclock_t0 = None

    def set_global_plan(self, global_plan_gps: Sequence[Any], global_plan_world_coord: Sequence[Any]) -> None:
        """Keep a point of the plan every 50 m, and where what it says changes."""
        kept, last = [0], 0
        for k in range(1, len(global_plan_gps)):
            if k == len(global_plan_gps) - 1 or k - last >= APART or global_plan_gps[k][1] != global_plan_gps[k - 1][1]:
                kept.append(k)
                last = k
        self._global_plan = [global_plan_gps[k] for k in kept]
        self._global_plan_world_coord = [global_plan_world_coord[k] for k in kept]

    def setup(self, path_to_conf_file: str) -> None:
        """Prepare; for agents to fill."""

    def sensors(self) -> list[dict[str, Any]]:
        """The sensors that it needs; for agents to fill."""
        return []

    def destroy(self) -> None:
        """Clean up; for agents to fill."""


class Leaderboard:
    """A `Driver` over an agent of the leaderboard.

    Args:
        path: File of the agent, and after a colon what its `setup` gets.

    Raises:
        ConfigError: The file has no agent, it does not import, or it asks for a sensor that is not there.
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
        self._class = self._load(path)
        self._asked = self._sensors()
        self.cameras: Mapping[str, Camera] = {i["id"]: camera_of(i) for i in self._asked if i["type"] == CAMERA}
        self.lidars: Mapping[str, Lidar] = {i["id"]: lidar_of(i) for i in self._asked if i["type"] == LIDAR}
        self.radars: Mapping[str, Lidar] = {i["id"]: radar_of(i) for i in self._asked if i["type"] == RADAR}
        self.sensors = (*self.cameras, *self.lidars, *self.radars)
        self._agents: list[Any] = []
        self._last: dict[int, tuple[float, float]] = {}
        self._maps: list[str] = []

    def _load(self, path: str) -> type:
        _stand_in()
        spec = importlib.util.spec_from_file_location(f"leaderboard_agent_{self.version[:12]}", self.path)
        if spec is None or spec.loader is None:
            raise ConfigError(f"system 'leaderboard:{path}': expected the path of a Python file")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        before = list(sys.path)
        sys.path.insert(0, str(self.path.resolve().parent))
        try:
            spec.loader.exec_module(module)
        except Exception as error:
            raise ConfigError(f"system 'leaderboard:{path}': importing it failed: {describe(error)}") from error
        finally:
            sys.path[:] = before
        named = getattr(module, "get_entry_point", lambda: "")()
        found = getattr(module, str(named), None)
        if not isinstance(found, type) or not callable(getattr(found, "run_step", None)):
            raise ConfigError(f"system 'leaderboard:{path}': its get_entry_point() names no class with run_step")
        return found

    def _agent(self) -> Any:
        """A new agent, set up. Leaderboard 2.0 makes one of a host and a port, 1.0 of its configuration."""
        try:
            try:
                agent = self._class("localhost", 2000)
            except TypeError:
                return self._class(self._config)
            agent.setup(self._config)
        except Exception as error:
            raise ConfigError(f"system 'leaderboard:{self.path}': setup failed: {describe(error)}") from error
        return agent

    def _sensors(self) -> list[dict[str, Any]]:
        """What an agent asks for."""
        agent, where = self._agent(), f"system 'leaderboard:{self.path}'"
        try:
            told = agent.sensors()
        except Exception as error:
            raise ConfigError(f"{where}: sensors() failed: {describe(error)}") from error
        return checked(told, where)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """A new agent for each episode, with the plan of its route."""
        for agent in self._agents:
            getattr(agent, "destroy", lambda: None)()
        self._agents, self._last = [], {}
        wants_map = any(item["type"] == MAP for item in self._asked)
        self._maps = [town_xodr(episode.town) if wants_map else "" for episode in episodes]
        for episode in episodes:
            agent = self._agent()
            agent.sensors()  # some prepare themselves there
            route = episode.agents[0].route
            assert route is not None
            gps, world = _plan(route, load_town(episode.town))
            agent.set_global_plan(gps, world)
            self._agents.append(agent)

    def act(self, view: Observation) -> F32:
        """The controls of each row's agent."""
        out = np.zeros((len(view.scene), 4), np.float32)
        for row, scene in enumerate(view.scene.tolist()):
            if view.done[row]:
                continue
            told = self._agents[scene].run_step(self._input(view, row), float(view.time[row]))
            out[row] = told.throttle, told.brake, -told.steer, bool(getattr(told, "reverse", False))
            if getattr(told, "hand_brake", False):
                out[row, :2] = 0.0, 1.0
        return out

    def _input(self, view: Observation, row: int) -> dict[str, tuple[int, Any]]:
        time, yaw = float(view.time[row]), float(view.pose[row, 2])
        step = round(time / STEP)
        data: dict[str, tuple[int, Any]] = {}
        for item in self._asked:
            kind = item["type"]
            value: Any
            if kind == CAMERA:
                picture = view.readings[item["id"]][row]
                alpha = np.full((1, *picture.shape[1:]), 255, np.uint8)
                value = np.concatenate([picture[::-1], alpha]).transpose(1, 2, 0).copy()
            elif kind == LIDAR:
                value = cloud(view.readings[item["id"]][row])
            elif kind == RADAR:
                seen = view.readings[item["id"]][row]
                value = seen[seen[:, 0] > 0.0]
            elif kind == "sensor.other.gnss":
                value = np.array(geolocation(float(view.pose[row, 0]), float(view.pose[row, 1])))
            elif kind == "sensor.other.imu":
                value = self._imu(view, row, yaw)
            elif kind == "sensor.speedometer":
                value = {"speed": float(view.speed[row])}
            else:
                value = {"opendrive": self._maps[int(view.scene[row])]}
            data[str(item["id"])] = (step, value)
        self._last[int(view.scene[row])] = (time, yaw)
        return data

    def _imu(self, view: Observation, row: int, yaw: float) -> F64:
        """Accelerations and rates [6], and the compass: clockwise from north, rad."""
        time, before = self._last.get(int(view.scene[row]), (float(view.time[row]), yaw))
        passed = float(view.time[row]) - time
        rate = float(wrap_angle(yaw - before)) / passed if passed > 0.0 else 0.0
        compass = (0.5 * math.pi - yaw) % math.tau
        across = -float(view.speed[row]) * rate
        return np.array([float(view.accel[row]), across, GRAVITY, 0.0, 0.0, -rate, compass])


def _plan(route: Route, graph: LaneGraph) -> tuple[list[Any], list[Any]]:
    """The plan of a route, a point a metre: geographic places, and CARLA's transforms, each with its `RoadOption`."""
    import carla

    inside = (route.lane >= 0) & (graph.junction[route.lane] >= 0)
    options = np.full(len(route.xy), int(RoadOption.LANEFOLLOW))
    begins = np.flatnonzero(inside & ~np.concatenate([[False], inside[:-1]]))
    for first in begins.tolist():
        rest = np.flatnonzero(~inside[first:])
        last = first + int(rest[0]) if len(rest) else len(inside) - 1
        turned = float(wrap_angle(float(route.yaw[last] - route.yaw[first])))
        told = RoadOption.LEFT if turned > TURN else RoadOption.RIGHT if turned < -TURN else RoadOption.STRAIGHT
        options[first : last + 1] = int(told)
    gps, world = [], []
    for (x, y), yaw, option in zip(route.xy.tolist(), route.yaw.tolist(), options.tolist(), strict=True):
        latitude, longitude, z = geolocation(x, y)
        gps.append(({"lat": latitude, "lon": longitude, "z": z}, _option(option)))
        place = carla.Transform(carla.Location(x=x, y=-y, z=z), carla.Rotation(yaw=-math.degrees(yaw)))
        world.append((place, _option(option)))
    return gps, world


def _option(value: int) -> Any:
    return sys.modules["agents.navigation.local_planner"].RoadOption(value)


def _stand_in() -> None:
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
    """What an agent answers where `carla` is not installed."""

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
    """A place in CARLA's frame where `carla` is not installed."""

    def __init__(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> None:
        self.x, self.y, self.z = x, y, z


class Rotation:
    """A rotation in CARLA's frame, degrees, where `carla` is not installed."""

    def __init__(self, pitch: float = 0.0, yaw: float = 0.0, roll: float = 0.0) -> None:
        self.pitch, self.yaw, self.roll = pitch, yaw, roll


class Transform:
    """A place and a rotation where `carla` is not installed."""

    def __init__(self, location: Location | None = None, rotation: Rotation | None = None) -> None:
        self.location, self.rotation = location or Location(), rotation or Rotation()

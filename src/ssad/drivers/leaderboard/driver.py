"""CARLA leaderboard agents as driving systems: `setup`, `sensors`, `run_step`, without CARLA.

`--set systems=[leaderboard:FILE.py]` takes the class that FILE's `get_entry_point` names; a second colon
introduces the path passed to `setup`. Where the packages `leaderboard`, `srunner`, `agents` and `carla` are not
installed, stand-ins provide the names that agents need.

Each episode has its own agent; with `?share=true` the agents of a batch share their networks. Agents receive (number
of the step, data) by id of the sensor. Frames are CARLA's, left-handed: y to the right, yaw clockwise. Source of the
interface: the leaderboard's autoagents/autonomous_agent.py, agent_wrapper.py and leaderboard_evaluator.py (20 Hz, the
plan before `setup`, noise of GNSS and IMU).
"""

from __future__ import annotations

import copy
import hashlib
import importlib.util
import math
import sys
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
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, Controller, Episode, Route
from ssad.drivers.leaderboard.carla_types import AutonomousAgent
from ssad.drivers.leaderboard.road_map import OPTIONS, TownMap, road_options, transform_of
from ssad.drivers.leaderboard.scene import STEP, CarlaDataProvider, HostedScene
from ssad.drivers.leaderboard.sensors import (
    CAMERA,
    DEPTH,
    LIDAR,
    MAP,
    RADAR,
    SEMANTIC,
    camera_of,
    carla_points,
    check_sensors,
    encode_classes,
    encode_depth,
    fired_points,
    geolocation,
    lidar_of,
    number,
    radar_of,
)
from ssad.drivers.leaderboard.stand_ins import install_stand_ins
from ssad.rendering.lidar import Lidar
from ssad.world.roads import load_town, town_xodr

GRAVITY: Final = 9.81  # m/s^2
GNSS_NOISE: Final = (5e-6, 5e-6, 5e-6)  # standard deviations of latitude and longitude, degrees, and altitude, m
IMU_NOISE: Final = (1e-3, 1e-3, 1.5e-2, 1e-3, 1e-3, 1e-3, 0.0)  # accelerations m/s^2, rates rad/s, compass rad


class Leaderboard:
    """`Driver` adapter of a leaderboard agent.

    Args:
        path: File of the agent, optionally followed by a colon and the argument of `setup`.
        share: Whether `setup` runs once, and the agents of all episodes are copies of that one with the same networks
            (`torch.nn.Module`). A network that remembers something from step to step must not be shared.

    Raises:
        ConfigError: The file has no agent, fails to import, or requests an unknown sensor; with `share` it cannot be
            copied.
    """

    name = "leaderboard"
    controller = Controller.EXTERNAL
    period = STEP

    def __init__(self, path: str, *, share: bool = False) -> None:
        if not isinstance(share, bool):
            raise ConfigError(f"system 'leaderboard:{path}': share is true or false, not {share}")
        file, _, self._config = path.partition(":")
        self.path = Path(file)
        try:
            source = read_bytes(self.path)
        except FormatError as error:
            raise ConfigError(f"system 'leaderboard:{path}': {error}") from None
        self.version = hashlib.sha256(source + self._config.encode()).hexdigest()
        self._agent_class = self._load_agent_class(path)
        template = self._make_agent()
        self._specifications = self._sensors(template)
        self._template: Any = template if share else None
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
        self.depth_cameras: Mapping[str, Camera] = {
            specification["id"]: camera_of(specification)
            for specification in self._specifications
            if specification["type"] == DEPTH
        }
        self.semantic_cameras: Mapping[str, Camera] = {
            specification["id"]: camera_of(specification)
            for specification in self._specifications
            if specification["type"] == SEMANTIC
        }
        self.sensors = (*self.cameras, *self.depth_cameras, *self.semantic_cameras, *self.lidars, *self.radars)
        self._agents: list[Any] = []
        self._episodes: list[Episode] = []
        self._scenes: list[HostedScene] = []
        self._last_headings: dict[int, tuple[float, float]] = {}
        self._maps: list[str] = []

    def _load_agent_class(self, path: str) -> type:
        spec = importlib.util.spec_from_file_location(f"leaderboard_agent_{self.version[:12]}", self.path)
        if spec is None or spec.loader is None:
            raise ConfigError(f"system 'leaderboard:{path}': expected the path of a Python file")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        previous_path = list(sys.path)
        # Agents import their own modules relative to their folder.
        sys.path.insert(0, str(self.path.resolve().parent))
        try:
            install_stand_ins()
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

    def _make_agent(self, plan: tuple[list[Any], list[Any]] | None = None) -> Any:
        """Make an agent, give it its plan and set it up, in the order of the leaderboard.

        Leaderboard 2.0 constructs from host and port, 1.0 from the configuration, which sets the agent up.
        """
        try:
            try:
                agent = self._agent_class("localhost", 2000)
            except TypeError:
                agent = self._agent_class(self._config)
                if plan is not None:
                    agent.set_global_plan(*plan)
                if isinstance(agent, AutonomousAgent):
                    agent.setup(self._config)
                return agent
            if plan is not None:
                agent.set_global_plan(*plan)
            agent.setup(self._config)
        except Exception as error:
            raise ConfigError(f"system 'leaderboard:{self.path}': setup failed: {describe(error)}") from error
        return agent

    def _copy_agent(self, plan: tuple[list[Any], list[Any]]) -> Any:
        """Return a copy of the agent that was set up, with the same networks and a plan of its own."""
        try:
            agent: Any = copy.deepcopy(self._template, {id(network): network for network in _networks(self._template)})
        except Exception as error:
            raise ConfigError(
                f"system 'leaderboard:{self.path}': share=true: it cannot be copied: {describe(error)}; leave share out"
            ) from error
        agent.set_global_plan(*plan)
        return agent

    def _sensors(self, agent: Any) -> list[dict[str, Any]]:
        """Return the validated sensor specifications of an agent."""
        location = f"system 'leaderboard:{self.path}'"
        try:
            specifications = agent.sensors()
        except Exception as error:
            raise ConfigError(f"{location}: sensors() failed: {describe(error)}") from error
        return check_sensors(specifications, location)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Make an agent for each episode, with the plan of its route."""
        for agent in self._agents:
            getattr(agent, "destroy", lambda: None)()
        self._agents, self._scenes, self._last_headings = [], [], {}
        self._episodes = list(episodes)
        wants_map = any(specification["type"] == MAP for specification in self._specifications)
        self._maps = [town_xodr(episode.town) if wants_map else "" for episode in episodes]
        town_maps = {town: TownMap(load_town(town)) for town in {episode.town for episode in episodes}}
        for episode in episodes:
            route = episode.agents[0].route
            assert route is not None
            town_map = town_maps[episode.town]
            plan = _global_plan(route, town_map.graph)
            scene = HostedScene(town_map, route, plan[1])
            CarlaDataProvider.enter(scene)
            try:
                agent = self._make_agent(plan) if self._template is None else self._copy_agent(plan)
                agent.sensors()  # some agents initialise themselves in sensors()
            finally:
                CarlaDataProvider.enter(None)
            self._scenes.append(scene)
            self._agents.append(agent)

    def act(self, view: Observation) -> F32:
        """Return the controls of each row's agent."""
        controls = np.zeros((len(view.scene), 4), np.float32)
        for row, scene in enumerate(view.scene.tolist()):
            if view.done[row]:
                continue
            self._scenes[scene].observe(view, row)
            CarlaDataProvider.enter(self._scenes[scene])
            try:
                control = self._agents[scene].run_step(self._agent_input(view, row), float(view.time[row]))
            finally:
                CarlaDataProvider.enter(None)
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
            elif sensor_type == DEPTH:
                value = encode_depth(view.readings[specification["id"]][row])
            elif sensor_type == SEMANTIC:
                value = encode_classes(view.readings[specification["id"]][row])
            elif sensor_type == LIDAR:
                points = carla_points(view.readings[specification["id"]][row])
                value = fired_points(points, time - self._elapsed(view, row), time)
            elif sensor_type == RADAR:
                returns = view.readings[specification["id"]][row]
                value = returns[returns[:, 0] > 0.0]
            elif sensor_type == "sensor.other.gnss":
                noise = self._noise(view, row, GNSS_NOISE, "gnss")
                value = np.array(_position(specification, view.pose[row])) + noise
            elif sensor_type == "sensor.other.imu":
                value = self._imu(view, row, yaw) + self._noise(view, row, IMU_NOISE, "imu")
            elif sensor_type == "sensor.speedometer":
                value = {"speed": float(view.speed[row])}
            else:
                value = {"opendrive": self._maps[int(view.scene[row])]}
            readings[str(specification["id"])] = (step, value)
        self._last_headings[int(view.scene[row])] = (time, yaw)
        return readings

    def _elapsed(self, view: Observation, row: int) -> float:
        """Return the time since the agent was last asked, s; at the start its period."""
        time = float(view.time[row])
        last_time, _ = self._last_headings.get(int(view.scene[row]), (time - self.period, 0.0))
        return time - last_time

    def _noise(self, view: Observation, row: int, deviations: Sequence[float], sensor: str) -> F64:
        """Return the noise of a reading, which depends on the episode and the time alone."""
        episode, step = self._episodes[int(view.scene[row])], round(float(view.time[row]) / STEP)
        random = generator("leaderboard noise", sensor, episode.key, episode.seed, step)
        return np.asarray(deviations) * random.standard_normal(len(deviations))

    def _imu(self, view: Observation, row: int, yaw: float) -> F64:
        """Return accelerations and rates [6], and the compass: clockwise from north, rad."""
        _, last_yaw = self._last_headings.get(int(view.scene[row]), (0.0, yaw))
        yaw_rate = float(wrap_angle(yaw - last_yaw)) / self._elapsed(view, row)
        compass = (0.5 * math.pi - yaw) % math.tau
        lateral = -float(view.speed[row]) * yaw_rate
        return np.array([float(view.accel[row]), lateral, GRAVITY, 0.0, 0.0, -yaw_rate, compass])


def _position(specification: Mapping[str, Any], pose: F32) -> tuple[float, float, float]:
    """Return latitude and longitude, degrees, and altitude, m, of a sensor on a car with this pose."""
    x, y, yaw = (float(value) for value in pose)
    ahead, right, z = (number(specification, key, 0.0, -100.0, 100.0) for key in ("x", "y", "z"))
    east = x + ahead * math.cos(yaw) + right * math.sin(yaw)
    north = y + ahead * math.sin(yaw) - right * math.cos(yaw)
    latitude, longitude, _ = geolocation(east, north)
    return latitude, longitude, z


def _networks(root: Any) -> list[Any]:
    """Return the networks (`torch.nn.Module`) that an agent holds, in attributes, lists and mappings at any depth."""
    torch = sys.modules.get("torch")
    if torch is None:
        return []
    networks, visited, waiting = [], set(), [root]
    while waiting:
        value = waiting.pop()
        if id(value) in visited:
            continue
        visited.add(id(value))
        if isinstance(value, torch.nn.Module):
            networks.append(value)
        elif isinstance(value, Mapping):
            waiting.extend(value.values())
        elif isinstance(value, list | tuple | set):
            waiting.extend(value)
        elif not isinstance(value, type) and hasattr(value, "__dict__"):
            waiting.extend(vars(value).values())
    return networks


def _global_plan(route: Route, graph: LaneGraph) -> tuple[list[Any], list[Any]]:
    """Return the plan of a route, a point per metre: geographic and as CARLA's transforms, with `RoadOption`."""
    command_type = sys.modules[OPTIONS].RoadOption
    commands = [command_type(option) for option in road_options(route, graph).tolist()]
    gps_plan, world_plan = [], []
    for (x, y), yaw, command in zip(route.xy.tolist(), route.yaw.tolist(), commands, strict=True):
        latitude, longitude, z = geolocation(x, y)
        gps_plan.append(({"lat": latitude, "lon": longitude, "z": z}, command))
        world_plan.append((transform_of(x, y, yaw, z), command))
    return gps_plan, world_plan

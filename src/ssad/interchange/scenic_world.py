"""The embedded world as a simulator of Scenic 3: actions of its driving library move the world's bodies.

Vehicles are controlled by throttle, brake and steering, with the dynamics that all drivers here have; walkers follow
their commanded heading and speed. Scenic's headings count from north, the world's from east. Needs the extra
`scenic`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scenic.core.simulators import SimulationCreationError
from scenic.core.vectors import Vector
from scenic.domains.driving.simulators import DrivingSimulation, DrivingSimulator

from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import AgentKind, Controller, Episode, EpisodeAgent, EpisodeLimits, Model, Pose, Route, Scenario
from ssad.simulators.carla.blueprints import nearest_model
from ssad.world.episode_arrays import MAX_AGENTS
from ssad.world.models import MODELS
from ssad.world.roads import load_town
from ssad.world.world import World

STEP: Final = 0.1  # s
_QUARTER = 0.5 * math.pi
_FAR = 9000.0  # m from the ego to a route that it never reaches: the program itself decides when it ends
_MOVES = (AgentKind.WALKER, AgentKind.PROP)  # kinds that are placed, not driven


@dataclass
class Pedals:
    """Controls of a vehicle; each keeps its value until it is set again. steer: positive to the left."""

    throttle: float = 0.0
    brake: float = 0.0
    steer: float = 0.0
    handbrake: bool = False
    reverse: bool = False


@dataclass
class _Body:
    """An object of Scenic in the world: its model, its controls, and the commanded motion of a walker."""

    name: str
    model: Model
    nearest: str
    pose: Pose
    speed: float
    pedals: Pedals
    heading: float  # rad, of a walker's way
    pace: float  # m/s
    yaw_change: float = 0.0  # rad/s


class ScenicWorld(DrivingSimulator):  # type: ignore[misc]
    """A Scenic simulator that runs the embedded world."""

    def __init__(self, map_file: str, timestep: float = STEP) -> None:
        super().__init__()
        if abs(float(timestep) - STEP) > 1e-9:
            raise SimulationCreationError(f"a step has {STEP} s here, not {timestep}")
        self.graph = load_town(Path(map_file).stem)

    def createSimulation(self, scene: Any, *, timestep: float | None, **options: Any) -> ScenicDrive:
        """Create a simulation of a scene."""
        if timestep is not None and abs(timestep - STEP) > 1e-9:
            raise SimulationCreationError(f"a step has {STEP} s here, not {timestep}")
        return ScenicDrive(scene, self.graph, timestep=STEP, **options)


class ScenicDrive(DrivingSimulation):  # type: ignore[misc]
    """One scene in the world.

    Attributes:
        names: Names of the bodies, the ego first.
        models: Nearest model of each body.
        rows: [T, A, 4] x, y, yaw and speed of each body at every step.
    """

    def __init__(self, scene: Any, graph: LaneGraph, **options: Any) -> None:
        self.graph = graph
        self._bodies: dict[int, _Body] = {}
        self._world: World | None = None
        self.rows: list[np.ndarray[Any, Any]] = []
        super().__init__(scene, **options)

    # ------------------------------------------------------------ interface to Scenic

    def setup(self) -> None:
        """Create all objects, and the world with them."""
        super().setup()
        if len(self._bodies) > MAX_AGENTS:
            raise SimulationCreationError(f"{len(self._bodies)} objects, at most {MAX_AGENTS}")
        bodies = list(self._bodies.values())
        agents = [
            EpisodeAgent(
                body.name,
                body.name,
                Controller.PLACED if body.model.kind in _MOVES else Controller.EXTERNAL,
                body.pose,
                speed=body.speed,
                route=_nowhere(body.pose) if index == 0 else None,
            )
            for index, body in enumerate(bodies)
        ]
        limits = EpisodeLimits(max_steps=100_000, max_time=1e9, contact="count")
        town = self.graph.name
        scenario = Scenario("scenic", "Custom", town, (bodies[0].pose, bodies[0].pose))
        episode = Episode("scenic", scenario, town, tuple(agents), limits=limits)
        self._world = World([episode], {town: self.graph}, models={body.name: body.model for body in bodies})
        self._read()

    def createObjectInSimulator(self, obj: Any) -> None:
        """Store an object for `setup`; objects that appear during the simulation are refused."""
        if self._world is not None:
            raise SimulationCreationError(f"{type(obj).__name__}: objects cannot appear while a simulation runs")
        category = getattr(obj, "category", "prop")
        nearest = nearest_model(category, (float(obj.length), float(obj.width)))
        assert nearest is not None, category
        nearest_body = MODELS[nearest]
        name_number = 1 + sum(body.name.startswith(f"{type(obj).__name__}-") for body in self._bodies.values())
        name = "ego" if not self._bodies else f"{type(obj).__name__}-{name_number}"
        wheelbase = nearest_body.wheelbase / nearest_body.length * float(obj.length)
        model = Model(
            name,
            nearest_body.kind,
            float(obj.length),
            float(obj.width),
            float(obj.height),
            wheelbase,
            nearest_body.max_steer,
            nearest_body.max_accel,
            nearest_body.max_brake,
            nearest_body.max_speed,
        )
        yaw = float(wrap_angle(float(obj.heading) + _QUARTER))
        velocity = np.array([float(obj.velocity.x), float(obj.velocity.y)])
        forward_speed = float(velocity @ (math.cos(yaw), math.sin(yaw)))
        speed = forward_speed if nearest_body.kind not in _MOVES else float(np.hypot(*velocity))
        pose = Pose(float(obj.position.x), float(obj.position.y), yaw)
        heading = math.atan2(velocity[1], velocity[0]) if speed and nearest_body.kind in _MOVES else yaw
        self._bodies[id(obj._dynamicProxy)] = _Body(name, model, nearest, pose, speed, Pedals(), heading, speed)

    def step(self) -> None:
        """Advance the world by one step."""
        assert self._world is not None
        body_count = len(self._bodies)
        controls, placements = np.zeros((1, body_count, 4), np.float32), np.zeros((1, body_count, 4), np.float32)
        for index, body in enumerate(self._bodies.values()):
            pedals = body.pedals
            brake = 1.0 if pedals.handbrake else pedals.brake
            controls[0, index] = pedals.throttle, brake, pedals.steer, float(pedals.reverse)
            travel = STEP * body.pace
            x, y = body.pose.x + travel * math.cos(body.heading), body.pose.y + travel * math.sin(body.heading)
            # Vehicles get a placement too; the world ignores it, since their controller is external.
            placements[0, index] = x, y, body.heading if body.pace else body.pose.yaw, body.pace
        self._world.place(placements)
        self._world.step(controls)
        self._read()

    def getProperties(self, obj: Any, properties: Any) -> dict[str, Any]:
        """Return the position and motion of an object."""
        body = self._body(obj)
        yaw = body.pose.yaw
        heading = float(wrap_angle(yaw - _QUARTER))
        local_yaw, _, _ = obj.parentOrientation.globalToLocalAngles(heading, 0, 0)
        direction = body.heading if body.model.kind in _MOVES else yaw
        state: dict[str, Any] = {
            "position": Vector(body.pose.x, body.pose.y, 0.0),
            "yaw": local_yaw,
            "pitch": 0,
            "roll": 0,
            "velocity": Vector(body.speed * math.cos(direction), body.speed * math.sin(direction), 0.0),
            "speed": abs(body.speed),
            "angularSpeed": body.yaw_change,
            "angularVelocity": Vector(0.0, 0.0, body.yaw_change),
        }
        if "elevation" in properties:
            state["elevation"] = 0.0
        return state

    # ------------------------------------------------------------ interface to the world model

    def pedals(self, obj: Any) -> Pedals:
        """Return the controls of a vehicle."""
        return self._body(obj).pedals

    def walk(self, obj: Any, *, heading: float | None = None, speed: float | None = None) -> None:
        """Set the direction (Scenic's heading, rad) or the speed, m/s, of a walker."""
        body = self._body(obj)
        body.heading = body.heading if heading is None else float(wrap_angle(float(heading) + _QUARTER))
        body.pace = body.pace if speed is None else min(float(speed), body.model.max_speed)

    def put_position(self, obj: Any, place: Any) -> None:
        """Move an object to another position at once."""
        assert self._world is not None
        body = self._body(obj)
        body.pose = Pose(float(place[0]), float(place[1]), body.pose.yaw)
        poses = self._world.array("pose").copy()
        poses[0, self._number(obj), :2] = body.pose.x, body.pose.y
        self._world.put("pose", poses)

    def put_velocity(self, obj: Any, velocity: Any) -> None:
        """Set the velocity of an object at once; a vehicle keeps its heading."""
        assert self._world is not None
        body, (velocity_x, velocity_y) = self._body(obj), (float(velocity[0]), float(velocity[1]))
        if body.model.kind in _MOVES:
            body.pace = math.hypot(velocity_x, velocity_y)
            body.heading = math.atan2(velocity_y, velocity_x) if body.pace else body.heading
            return
        speeds = self._world.array("speed").copy()
        speeds[0, self._number(obj)] = velocity_x * math.cos(body.pose.yaw) + velocity_y * math.sin(body.pose.yaw)
        self._world.put("speed", speeds)

    # ------------------------------------------------------------ internals

    @property
    def names(self) -> list[str]:
        """Names of the bodies."""
        return [body.name for body in self._bodies.values()]

    @property
    def models(self) -> list[str]:
        """Nearest model of each body."""
        return [body.nearest for body in self._bodies.values()]

    @property
    def sizes(self) -> list[tuple[float, float]]:
        """Length and width of the bodies, m."""
        return [(body.model.length, body.model.width) for body in self._bodies.values()]

    def _body(self, obj: Any) -> _Body:
        return self._bodies[id(obj._dynamicProxy)]

    def _number(self, obj: Any) -> int:
        return list(self._bodies).index(id(obj._dynamicProxy))

    def _read(self) -> None:
        """Copy the state of the world into the bodies."""
        assert self._world is not None
        state = self._world.state()
        for index, body in enumerate(self._bodies.values()):
            x, y, yaw = state.pose[0, index].tolist()
            body.yaw_change = float(wrap_angle(yaw - body.pose.yaw)) / STEP if self.rows else 0.0
            body.pose, body.speed = Pose(x, y, yaw), float(state.speed[0, index])
        self.rows.append(np.column_stack([state.pose[0], state.speed[0]]).astype(np.float64))


def _nowhere(pose: Pose) -> Route:
    """Return a route that its owner never reaches."""
    xy = np.array([[pose.x + _FAR + point_index, pose.y] for point_index in range(3)], np.float32)
    return Route(
        xy=xy,
        yaw=np.zeros(3, np.float32),
        lane=np.full(3, -1, np.int32),
        speed_limit=np.full(3, 30.0, np.float32),
        width=np.full(3, 3.5, np.float32),
    )

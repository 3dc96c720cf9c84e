"""The scene of a hosted agent, as `CarlaDataProvider` and `GameTime` of `srunner` tell it.

It holds what the agent's `Observation` holds: the ego, the 16 nearest agents within 60 m, and the next signal of its
route. There is no server: nothing can be spawned, moved or changed. Source of the interface: scenario_runner's
scenariomanager/carla_data_provider.py and timer.py, and carla.World, carla.Vehicle.
"""

from __future__ import annotations

import fnmatch
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from ssad.core.driving import Observation
from ssad.core.errors import ConfigError
from ssad.core.types import AgentKind, Route, SignalState
from ssad.drivers.leaderboard.road_map import GlobalRoutePlanner, TownMap, transform_of

STEP: Final = 0.05  # s between two questions to an agent
HERO: Final = 1  # id of the ego
STOPPING: Final = 10.0  # m to the stop line within which the ego counts as being at a traffic light
_HEIGHT: Final = 0.75  # m, half the height that boxes are given
_TYPES: Final = {
    AgentKind.WALKER: "walker.pedestrian",
    AgentKind.PROP: "static.prop",
}
_LIGHTS: Final = {SignalState.RED: "Red", SignalState.YELLOW: "Yellow", SignalState.GREEN: "Green"}


class NoServerError(ConfigError, AttributeError):
    """A hosted agent asks for what only a CARLA server has."""


@dataclass(frozen=True)
class SceneActor:
    """Actor of a scene at one step, as carla.Vehicle or carla.Walker.

    Attributes:
        id: Number; those of others hold for one step.
        type_id: Such as "vehicle.car".
        pose: x, y, yaw in the world frame, m, rad.
        speed: Speed along its heading, m/s.
        size: Length and width, m.
        acceleration: Along its heading, m/s^2.
        scene: Its scene.
        role: "hero" or "".
    """

    id: int
    type_id: str
    pose: tuple[float, float, float]
    speed: float
    size: tuple[float, float]
    acceleration: float
    scene: HostedScene
    role: str = ""

    is_alive = True

    @property
    def attributes(self) -> dict[str, str]:
        """Attributes of its blueprint: the role alone."""
        return {"role_name": self.role}

    @property
    def bounding_box(self) -> Any:
        """carla.BoundingBox about its centre."""
        carla = sys.modules["carla"]
        extent = carla.Vector3D(0.5 * self.size[0], 0.5 * self.size[1], _HEIGHT)
        return carla.BoundingBox(carla.Location(z=_HEIGHT), extent)

    def get_transform(self) -> Any:
        """Return carla.Transform."""
        return transform_of(*self.pose)

    def get_location(self) -> Any:
        """Return carla.Location."""
        return self.get_transform().location

    def get_velocity(self) -> Any:
        """Return carla.Vector3D, m/s."""
        return self._along(self.speed)

    def get_acceleration(self) -> Any:
        """Return carla.Vector3D, m/s^2."""
        return self._along(self.acceleration)

    def get_world(self) -> HostedWorld:
        """Return the world."""
        return self.scene.world

    def get_speed_limit(self) -> float:
        """Return the speed limit under it, km/h; 30 where there is no lane."""
        waypoint = self.scene.town_map.get_waypoint(self.get_location())
        return 3.6 * float(self.scene.town_map.graph.speed_limit[waypoint.lane]) if waypoint else 30.0

    def get_traffic_light_state(self) -> Any:
        """Return carla.TrafficLightState of the ego's next signal; Green without one, as CARLA has it."""
        state, _ = self.scene.signal if self.role else (SignalState.OFF, math.inf)
        return getattr(sys.modules["carla"].TrafficLightState, _LIGHTS.get(SignalState(state), "Green"))

    def is_at_traffic_light(self) -> bool:
        """Return whether the ego is within 10 m before the stop line of a signal."""
        return bool(self.role) and self.scene.signal[1] < STOPPING

    def __getattr__(self, name: str) -> Any:
        raise NoServerError(f"carla.Actor.{name} needs a CARLA server; hosted agents read pose, speed, size and role")

    def _along(self, value: float) -> Any:
        yaw = self.pose[2]
        return sys.modules["carla"].Vector3D(value * math.cos(yaw), -value * math.sin(yaw), 0.0)


class ActorList(Sequence[SceneActor]):
    """Actors of a scene, as carla.ActorList."""

    def __init__(self, actors: Sequence[SceneActor]) -> None:
        self._actors = tuple(actors)

    def filter(self, wildcard_pattern: str) -> ActorList:
        """Return the actors whose type matches a pattern such as "vehicle.*"."""
        return ActorList([actor for actor in self._actors if fnmatch.fnmatchcase(actor.type_id, wildcard_pattern)])

    def find(self, actor_id: int) -> SceneActor | None:
        """Return the actor with an id, or None."""
        return next((actor for actor in self._actors if actor.id == actor_id), None)

    def __getitem__(self, index: Any) -> Any:
        return self._actors[index]

    def __len__(self) -> int:
        return len(self._actors)

    def __iter__(self) -> Iterator[SceneActor]:
        return iter(self._actors)


class HostedWorld:
    """World of a scene, as carla.World, for reading."""

    def __init__(self, scene: HostedScene) -> None:
        self._scene = scene

    def get_actors(self, actor_ids: Sequence[int] | None = None) -> ActorList:
        """Return the ego and the agents near it, or those with these ids."""
        actors = self._scene.actors
        return ActorList([actor for actor in actors if actor_ids is None or actor.id in actor_ids])

    def get_map(self) -> TownMap:
        """Return the map."""
        return self._scene.town_map

    def get_settings(self) -> Any:
        """Return settings: synchronous, with steps of 0.05 s."""
        return SimpleNamespace(synchronous_mode=True, fixed_delta_seconds=STEP, no_rendering_mode=False)

    def get_snapshot(self) -> Any:
        """Return frame and time of the step."""
        timestamp = SimpleNamespace(
            frame=self._scene.frame, elapsed_seconds=self._scene.time, delta_seconds=STEP, platform_timestamp=0.0
        )
        return SimpleNamespace(frame=self._scene.frame, timestamp=timestamp)

    def __getattr__(self, name: str) -> Any:
        # `hasattr` of an agent must still work, so that this is an AttributeError too.
        raise NoServerError(f"carla.World.{name} needs a CARLA server; hosted agents read get_actors and get_map")


class HostedScene:
    """Scene of one episode: what is constant, and the latest observation.

    Attributes:
        town_map: Map of its town.
        route: Route of the ego.
        world: The scene as carla.World.
        actors: The ego, and the agents near it.
        signal: State of the ego's next signal (`SignalState`), and metres to its stop line.
        frame: Number of the step, of 0.05 s.
        time: s since the episode began.
    """

    def __init__(self, town_map: TownMap, route: Route, plan: Sequence[Any]) -> None:
        self.town_map, self.route, self.plan = town_map, route, plan
        self.world = HostedWorld(self)
        self.planner = GlobalRoutePlanner(town_map, 2.0)
        x, y = route.xy[0].tolist()
        self.actors: tuple[SceneActor, ...] = (self._hero((x, y, float(route.yaw[0])), 0.0, 0.0, (4.5, 1.9)),)
        self.signal: tuple[int, float] = int(SignalState.OFF), math.inf
        self.frame, self.time = 0, 0.0

    def observe(self, view: Observation, row: int) -> None:
        """Take over a row of an observation."""
        self.time = float(view.time[row])
        self.frame = round(self.time / STEP)
        x, y, yaw = (float(value) for value in view.pose[row])
        speed, acceleration = float(view.speed[row]), float(view.accel[row])
        actors = [self._hero((x, y, yaw), speed, acceleration, self.actors[0].size)]
        for number, values in enumerate(np.asarray(view.others[row], np.float64).tolist()):
            ahead, left, turn, other_speed, length, width, kind = values
            if int(kind) != AgentKind.NONE:
                pose = (
                    x + ahead * math.cos(yaw) - left * math.sin(yaw),
                    y + ahead * math.sin(yaw) + left * math.cos(yaw),
                    yaw + turn,
                )
                type_id = _TYPES.get(AgentKind(int(kind)), f"vehicle.{AgentKind(int(kind)).name.lower()}")
                actors.append(SceneActor(HERO + 1 + number, type_id, pose, other_speed, (length, width), 0.0, self))
        self.actors = tuple(actors)
        self.signal = int(view.signal[row, 0]), float(view.signal[row, 1])

    def _hero(
        self, pose: tuple[float, float, float], speed: float, acceleration: float, size: tuple[float, float]
    ) -> SceneActor:
        return SceneActor(HERO, "vehicle.car", pose, speed, size, acceleration, self, role="hero")


class _Provider(type):
    """Type of `CarlaDataProvider`: what it does not offer is refused in a line."""

    def __getattr__(cls, name: str) -> Any:
        raise NoServerError(f"{cls.__name__}.{name} has no stand-in: it needs a CARLA server")


class CarlaDataProvider(metaclass=_Provider):
    """Access to the scene of the agent that is being asked, as in srunner.scenariomanager.carla_data_provider."""

    _scene: HostedScene | None = None

    @classmethod
    def enter(cls, scene: HostedScene | None) -> None:
        """Make a scene the current one: that of the agent which is asked next."""
        cls._scene = scene

    @classmethod
    def scene(cls) -> HostedScene:
        """Return the current scene. ConfigError outside of an episode."""
        if cls._scene is None:
            raise ConfigError("CarlaDataProvider: there is no scene yet; ask in run_step, or in setup of an episode")
        return cls._scene

    @classmethod
    def get_world(cls) -> HostedWorld:
        """Return the world."""
        return cls.scene().world

    @classmethod
    def get_map(cls, world: Any = None) -> TownMap:
        """Return the map."""
        return cls.scene().town_map

    @classmethod
    def get_global_route_planner(cls) -> GlobalRoutePlanner:
        """Return a planner with points 2 m apart."""
        return cls.scene().planner

    @classmethod
    def get_ego_route(cls) -> Sequence[Any]:
        """Return the plan: pairs of carla.Transform and `RoadOption`, a metre apart."""
        return cls.scene().plan

    @classmethod
    def get_hero_actor(cls) -> SceneActor:
        """Return the ego."""
        return cls.scene().actors[0]

    @classmethod
    def get_all_actors(cls) -> ActorList:
        """Return the ego and the agents near it."""
        return cls.get_world().get_actors()

    @classmethod
    def get_actors(cls) -> list[tuple[int, SceneActor]]:
        """Return pairs of id and actor."""
        return [(actor.id, actor) for actor in cls.scene().actors]

    @classmethod
    def get_actor_by_id(cls, actor_id: int) -> SceneActor | None:
        """Return the actor with an id, or None."""
        return cls.get_all_actors().find(actor_id)

    @classmethod
    def get_actor_by_name(cls, role_name: str) -> SceneActor | None:
        """Return the actor with a role, or None."""
        return next((actor for actor in cls.scene().actors if actor.role == role_name), None)

    @staticmethod
    def get_velocity(actor: SceneActor) -> float:
        """Return the absolute speed of an actor, m/s."""
        return abs(actor.speed)

    @staticmethod
    def get_location(actor: SceneActor) -> Any:
        """Return carla.Location of an actor."""
        return actor.get_location()

    @staticmethod
    def get_transform(actor: SceneActor) -> Any:
        """Return carla.Transform of an actor."""
        return actor.get_transform()

    @staticmethod
    def is_sync_mode() -> bool:
        """Return True: the world waits for the agent."""
        return True

    @staticmethod
    def get_traffic_manager_port() -> int:
        """Return CARLA's default port; nothing listens there."""
        return 8000

    @staticmethod
    def get_random_seed() -> int:
        """Return scenario_runner's seed."""
        return 2000

    @staticmethod
    def get_client() -> Any:
        """Raise ConfigError: there is no CARLA server."""
        raise ConfigError("CarlaDataProvider.get_client needs a CARLA server; hosted agents drive without one")


class GameTime:
    """Time of the scene of the agent that is being asked, as in srunner.scenariomanager.timer."""

    @staticmethod
    def get_time() -> float:
        """Return s since the episode began."""
        return CarlaDataProvider.scene().time

    @staticmethod
    def get_carla_time() -> float:
        """Return s since the episode began."""
        return CarlaDataProvider.scene().time

    @staticmethod
    def get_frame() -> int:
        """Return the number of the step."""
        return CarlaDataProvider.scene().frame

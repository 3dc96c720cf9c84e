"""A stand-in of CARLA's client interface over SSAD's own world: what `ssad.interchange.carla` uses of it, no more.

Every name and argument here is checked against the stubs of the real wheel (tests/interchange/test_carla.py). Bodies
with physics move as those of `ssad.world`, so that an episode must go as in the embedded world. The server's maps are
SSAD's towns. Frames are CARLA's: left-handed, degrees.

FAULT, or the environment variable CARLA_STAND_IN_FAULT, makes it fail: "World.tick:12" raises at the 12th call of that
method and at all calls after it; "version", "roads" and "nothing" are said where they are used.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from ssad.core.types import AgentKind, Controller, Episode, EpisodeAgent, Limits, Pose, Route, Scenario
from ssad.interchange.bodies import MODEL_OF
from ssad.roads import load_town, town_signals, town_xodr
from ssad.roads.library import BUILT_IN
from ssad.world.models import MODELS
from ssad.world.world import World as Engine

FAULT = ""
CALLS: Counter[str] = Counter()


def fault() -> str:
    return FAULT or os.environ.get("CARLA_STAND_IN_FAULT", "")


def _remote(name: str) -> None:
    CALLS[name] += 1
    what, _, number = fault().partition(":")
    if what == name and CALLS[name] >= int(number or 1):
        raise RuntimeError("time-out of 20000ms while waiting for the simulator, make sure the simulator is ready")


class Vector3D:
    def __init__(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> None:
        self.x, self.y, self.z = float(x), float(y), float(z)


class Location(Vector3D):
    pass


class Rotation:
    def __init__(self, pitch: float = 0.0, yaw: float = 0.0, roll: float = 0.0) -> None:
        self.pitch, self.yaw, self.roll = float(pitch), float(yaw), float(roll)


class Transform:
    def __init__(self, location: Location | None = None, rotation: Rotation | None = None) -> None:
        self.location, self.rotation = location or Location(), rotation or Rotation()


class BoundingBox:
    def __init__(self, location: Location, extent: Vector3D) -> None:
        self.location, self.extent = location, extent


@dataclass
class VehicleControl:
    throttle: float = 0.0
    steer: float = 0.0
    brake: float = 0.0
    hand_brake: bool = False
    reverse: bool = False


@dataclass
class WalkerControl:
    direction: Vector3D = field(default_factory=lambda: Vector3D(1.0))
    speed: float = 0.0
    jump: bool = False


@dataclass
class OpendriveGenerationParameters:
    vertex_distance: float = 2.0
    max_road_length: float = 50.0
    wall_height: float = 1.0
    additional_width: float = 0.6
    smooth_junctions: bool = True
    enable_mesh_visibility: bool = True


class WeatherParameters:
    ClearNoon = "ClearNoon"


class TrafficLightState(IntEnum):
    Red = 0
    Yellow = 1
    Green = 2
    Off = 3


@dataclass
class WorldSettings:
    synchronous_mode: bool = False
    fixed_delta_seconds: float = 0.0
    substepping: bool = True
    max_substep_delta_time: float = 0.01
    max_substeps: int = 10
    no_rendering_mode: bool = False


class ActorBlueprint:
    def __init__(self, name: str) -> None:
        self.id = name

    def has_attribute(self, id: str) -> bool:
        return id == "role_name"

    def set_attribute(self, id: str, value: str) -> None:
        assert id == "role_name"


class BlueprintLibrary:
    def find(self, id: str) -> ActorBlueprint:
        if id not in MODEL_OF and id != "sensor.other.collision":
            raise IndexError(f"blueprint '{id}' not found")
        return ActorBlueprint(id)


class Actor:
    def __init__(self, world: World, number: int, blueprint: ActorBlueprint, transform: Transform) -> None:
        self._world, self.id, self.type_id = world, number, blueprint.id
        self._pose = (transform.location.x, -transform.location.y, -math.radians(transform.rotation.yaw))
        self._start_speed, self._wheel, self._physics, self._alive = 0.0, 0.0, True, True
        self._velocity = (0.0, 0.0)
        self._order = np.zeros(4, np.float32)

    @property
    def bounding_box(self) -> BoundingBox:
        body = MODELS[MODEL_OF[self.type_id]]
        half = Vector3D(0.5 * body.length, 0.5 * body.width, 0.5 * body.height)
        return BoundingBox(Location(0.0, 0.0, 0.5 * body.height), half)

    def destroy(self) -> bool:
        _remote("Actor.destroy")
        self._world._actors.pop(self.id, None)
        self._world._engine = None
        return True

    def set_simulate_physics(self, enabled: bool = True) -> None:
        _remote("Actor.set_simulate_physics")
        self._physics, self._world._engine = enabled, None

    def set_transform(self, transform: Transform) -> None:
        _remote("Actor.set_transform")
        self._pose = (transform.location.x, -transform.location.y, -math.radians(transform.rotation.yaw))

    def set_target_velocity(self, velocity: Vector3D) -> None:
        _remote("Actor.set_target_velocity")
        self._start_speed = math.hypot(velocity.x, velocity.y)
        self._world._engine = None


class Vehicle(Actor):
    def apply_control(self, control: VehicleControl) -> None:
        _remote("Vehicle.apply_control")
        assert not control.hand_brake
        assert 0.0 <= control.throttle <= 1.0
        assert 0.0 <= control.brake <= 1.0
        self._order[:] = control.throttle, control.brake, -control.steer, control.reverse


class Walker(Actor):
    def apply_control(self, control: WalkerControl) -> None:
        _remote("Walker.apply_control")
        turn = math.remainder(math.atan2(-control.direction.y, control.direction.x) - self._pose[2], math.tau)
        self._order[:] = control.speed / MODELS["walker"].max_speed, 0.0, turn / (math.pi * 0.1), 0.0


@dataclass
class CollisionEvent:
    actor: Actor
    other_actor: Actor


class Sensor(Actor):
    _callback = None

    def listen(self, callback) -> None:
        _remote("Sensor.listen")
        self._callback = callback

    def stop(self) -> None:
        _remote("Sensor.stop")
        self._callback = None


class TrafficLight:
    def __init__(self) -> None:
        self._state = None

    def set_state(self, state: TrafficLightState) -> None:
        _remote("TrafficLight.set_state")
        self._state = TrafficLightState(state)


class ActorSnapshot:
    def __init__(self, actor: Actor) -> None:
        self._actor = actor

    def get_transform(self) -> Transform:
        x, y, yaw = self._actor._pose
        return Transform(Location(x, -y, 0.0), Rotation(0.0, -math.degrees(yaw), 0.0))

    def get_velocity(self) -> Vector3D:
        return Vector3D(self._actor._velocity[0], -self._actor._velocity[1], 0.0)


class WorldSnapshot:
    def __init__(self, actors: dict[int, Actor]) -> None:
        self._actors = dict(actors)

    def find(self, actor_id: int) -> ActorSnapshot | None:
        return ActorSnapshot(self._actors[actor_id]) if actor_id in self._actors else None


class Map:
    def __init__(self, town: str) -> None:
        self.name = town

    def to_opendrive(self) -> str:
        text = town_xodr(self.name)
        return text.replace('length="', 'length="9') if fault() == "roads" else text


class World:
    def __init__(self, town: str) -> None:
        self.id = len(CALLS) + CALLS["Client.load_world"] + CALLS["Client.generate_opendrive_world"]
        self._town, self._settings = town, WorldSettings()
        self._actors: dict[int, Actor] = {}
        self._engine: Engine | None = None
        self._bodies: list[Actor] = []
        self._last, self._frozen = 100, False
        self._lights = {name: TrafficLight() for name in town_signals(town).values()}

    def get_map(self) -> Map:
        _remote("World.get_map")
        return Map(self._town)

    def get_settings(self) -> WorldSettings:
        _remote("World.get_settings")
        return WorldSettings(**vars(self._settings))

    def apply_settings(self, world_settings: WorldSettings) -> int:
        _remote("World.apply_settings")
        self._settings = world_settings
        return 0

    def freeze_all_traffic_lights(self, frozen: bool) -> None:
        _remote("World.freeze_all_traffic_lights")
        self._frozen = frozen

    def set_weather(self, weather: str) -> None:
        _remote("World.set_weather")

    def get_blueprint_library(self) -> BlueprintLibrary:
        _remote("World.get_blueprint_library")
        return BlueprintLibrary()

    def get_traffic_light_from_opendrive_id(self, traffic_light_id: str) -> TrafficLight | None:
        _remote("World.get_traffic_light_from_opendrive_id")
        return self._lights.get(traffic_light_id)

    def spawn_actor(self, blueprint: ActorBlueprint, transform: Transform, attach_to: Actor | None = None) -> Actor:
        _remote("World.spawn_actor")
        self._last += 1
        kinds = {"vehicle": Vehicle, "walker": Walker, "sensor": Sensor}
        actor = kinds.get(blueprint.id.partition(".")[0], Actor)(self, self._last, blueprint, transform)
        actor._parent = attach_to
        self._actors[actor.id] = actor
        self._engine = None
        return actor

    def try_spawn_actor(self, blueprint: ActorBlueprint, transform: Transform) -> Actor | None:
        _remote("World.try_spawn_actor")
        return None if fault() == "nothing" else self.spawn_actor(blueprint, transform)

    def get_snapshot(self) -> WorldSnapshot:
        _remote("World.get_snapshot")
        return WorldSnapshot(self._actors)

    def tick(self, seconds: float = 10.0) -> int:
        _remote("World.tick")
        assert self._settings.synchronous_mode
        assert self._frozen
        if self._engine is None:
            self._build()
        engine, bodies = self._engine, self._bodies
        order = np.stack([body._order for body in bodies])[None]
        places = np.zeros((1, engine.agents, 4), np.float32)
        for i, body in enumerate(bodies):
            places[0, i, :3] = body._pose
        engine.place(places)
        engine.step(order)
        pose, speed, wheel = (engine.array(name)[0] for name in ("pose", "speed", "wheel"))
        for i, body in enumerate(bodies):
            body._pose, body._wheel, body._start_speed = tuple(pose[i].tolist()), float(wheel[i]), float(speed[i])
            yaw = body._pose[2]
            body._velocity = (body._start_speed * math.cos(yaw), body._start_speed * math.sin(yaw))
        touch = engine.array("touch")[0]
        for sensor in [actor for actor in self._actors.values() if isinstance(actor, Sensor)]:
            me = bodies.index(sensor._parent)
            for j, other in enumerate(bodies):
                if sensor._callback is not None and int(touch[me]) >> j & 1:
                    sensor._callback(CollisionEvent(sensor._parent, other))
        return CALLS["World.tick"]

    def _build(self) -> None:
        """An engine of those who are there now, where and as fast as they are."""
        self._bodies = [actor for actor in self._actors.values() if not isinstance(actor, Sensor)]
        away = np.stack([np.arange(10) + 9.0e4, np.zeros(10)], 1).astype(np.float32)
        zero = np.zeros(10, np.float32)
        nowhere = Route(away, zero, np.full(10, -1, np.int32), zero + 10, zero + 3)
        agents = []
        for body in self._bodies:
            name = MODEL_OF[body.type_id]
            moves = body._physics and MODELS[name].kind != AgentKind.PROP
            who = Controller.EXTERNAL if moves else Controller.PLACED
            agents.append(EpisodeAgent(str(body.id), name, who, Pose(*body._pose), body._start_speed, route=nowhere))
        limits = Limits(max_steps=10**6, max_time=1e6, contact="count")
        scenario = Scenario("stand-in", "Custom", self._town, (Pose(0, 0), Pose(1, 0)))
        episode = Episode("stand-in", scenario, self._town, tuple(agents), limits=limits)
        self._engine = Engine([episode], {self._town: load_town(self._town)})
        wheel = np.zeros((1, self._engine.agents), np.float32)
        wheel[0, : len(agents)] = [body._wheel for body in self._bodies]
        self._engine.put("wheel", wheel)


SERVERS: dict[tuple[str, int], World] = {}


class Client:
    def __init__(self, host: str = "127.0.0.1", port: int = 2000, worker_threads: int = 0) -> None:
        self._key = (host, port)

    def set_timeout(self, second: float) -> None:
        assert second > 0.0

    def get_client_version(self) -> str:
        return "0.9.16"

    def get_server_version(self) -> str:
        _remote("Client.get_server_version")
        return "0.9.15" if fault() == "version" else "0.9.16"

    def get_available_maps(self) -> list[str]:
        _remote("Client.get_available_maps")
        return ["/Game/Carla/Maps/Town01", "/Game/Carla/Maps/ProvingGround"]

    def get_world(self) -> World:
        _remote("Client.get_world")
        return SERVERS.setdefault(self._key, World("Twinford"))

    def load_world(self, map_name: str) -> World:
        _remote("Client.load_world")
        SERVERS[self._key] = World(map_name)
        return SERVERS[self._key]

    def generate_opendrive_world(
        self, opendrive: str, parameters: OpendriveGenerationParameters | None = None
    ) -> World:
        _remote("Client.generate_opendrive_world")
        town = next(name for name in BUILT_IN if town_xodr(name) == opendrive)
        SERVERS[self._key] = World(town)
        return SERVERS[self._key]

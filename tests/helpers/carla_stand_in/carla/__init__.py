"""A stand-in of CARLA's client interface over SSAD's own world: what `ssad.simulators.carla` uses of it, no more.

Every name and argument here is checked against the stubs of the real wheel (tests/simulators/test_carla.py). Bodies
with physics move as those of `ssad.world`, so that an episode must go as in the embedded world. The server's maps are
SSAD's towns. Frames are CARLA's: left-handed, degrees.

FAULT, or the environment variable CARLA_STAND_IN_FAULT, makes it fail: "World.tick:12" raises at the 12th call of that
method and at all calls after it; "version", "roads", "nothing", "silent sensors", "broken sensors" and "gone SENSOR"
are said where they are used.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from ssad.core.lane_graph import Marking
from ssad.core.types import AgentKind, Controller, Episode, EpisodeAgent, EpisodeLimits, LaneType, Pose, Route, Scenario
from ssad.simulators.carla.blueprints import MODEL_OF
from ssad.world.models import MODELS
from ssad.world.roads import load_town, route_along, town_signals, town_xodr
from ssad.world.roads.library import BUILT_IN
from ssad.world.roads.query import LaneQuery
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
    HardRainNoon = "HardRainNoon"


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


ATTRIBUTES = {
    "sensor.camera.rgb": {"image_size_x", "image_size_y", "fov"},
    "sensor.lidar.ray_cast": {
        "channels",
        "range",
        "points_per_second",
        "rotation_frequency",
        "upper_fov",
        "lower_fov",
        "horizontal_fov",
        "noise_stddev",
        "dropoff_general_rate",
    },
    "sensor.other.radar": {"horizontal_fov", "vertical_fov", "points_per_second", "range"},
    "sensor.other.collision": set(),
    "sensor.other.lane_invasion": set(),
}


class ActorBlueprint:
    def __init__(self, name: str) -> None:
        self.id, self._told = name, {}

    def has_attribute(self, id: str) -> bool:
        return id in ATTRIBUTES.get(self.id, {"role_name"})

    def set_attribute(self, id: str, value: str) -> None:
        assert self.has_attribute(id), id
        assert isinstance(value, str)
        self._told[id] = value


class BlueprintLibrary:
    def find(self, id: str) -> ActorBlueprint:
        if id not in MODEL_OF and id not in ATTRIBUTES:
            raise IndexError(f"blueprint '{id}' not found")
        return ActorBlueprint(id)


class Actor:
    def __init__(self, world: World, number: int, blueprint: ActorBlueprint, transform: Transform) -> None:
        self._world, self.id, self.type_id = world, number, blueprint.id
        self._pose = (transform.location.x, -transform.location.y, -math.radians(transform.rotation.yaw))
        self._start_speed, self._wheel, self._physics, self._alive = 0.0, 0.0, True, True
        self._velocity = (0.0, 0.0)
        self._order = np.zeros(4, np.float32)
        self._told, self._place = dict(blueprint._told), transform
        self._path, self._speed = None, None  # of the Traffic Manager

    @property
    def bounding_box(self) -> BoundingBox:
        body = MODELS[MODEL_OF[self.type_id]]
        half = Vector3D(0.5 * body.length, 0.5 * body.width, 0.5 * body.height)
        return BoundingBox(Location(0.0, 0.0, 0.5 * body.height), half)

    @property
    def is_alive(self) -> bool:
        return self.id in self._world._actors

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

    def set_autopilot(self, enabled: bool = True, port: int = 8000) -> None:
        _remote("Vehicle.set_autopilot")
        assert port == 8000
        self._path, self._world._engine = () if enabled else None, None


class Walker(Actor):
    def apply_control(self, control: WalkerControl) -> None:
        _remote("Walker.apply_control")
        turn = math.remainder(math.atan2(-control.direction.y, control.direction.x) - self._pose[2], math.tau)
        self._order[:] = control.speed / MODELS["walker"].max_speed, 0.0, turn / (math.pi * 0.1), 0.0


@dataclass
class CollisionEvent:
    actor: Actor
    other_actor: Actor


class LaneMarkingType(IntEnum):
    Other = 0
    Broken = 1
    Solid = 2
    SolidSolid = 3
    Curb = 9

    def __str__(self) -> str:
        return self.name


MARKINGS = {Marking.BROKEN: "Broken", Marking.SOLID: "Solid", Marking.DOUBLE: "SolidSolid", Marking.CURB: "Curb"}


class LaneMarking:
    def __init__(self, type: LaneMarkingType) -> None:
        self.type = type


class SensorData:
    def __init__(self, frame: int) -> None:
        self.frame = frame


class LaneInvasionEvent(SensorData):
    def __init__(self, frame: int, actor: Actor, crossed_lane_markings: list[LaneMarking]) -> None:
        super().__init__(frame)
        self.actor, self.crossed_lane_markings = actor, crossed_lane_markings


class Image(SensorData):
    def __init__(self, frame: int, pixels: np.ndarray) -> None:
        super().__init__(frame)
        self.height, self.width, self.raw_data = *pixels.shape[:2], pixels.astype(np.uint8).tobytes()


class LidarMeasurement(SensorData):
    def __init__(self, frame: int, points: np.ndarray) -> None:
        super().__init__(frame)
        self.raw_data = points.astype(np.float32).tobytes()


class RadarMeasurement(SensorData):
    def __init__(self, frame: int, points: np.ndarray) -> None:
        super().__init__(frame)
        self.raw_data = points.astype(np.float32).tobytes()


def _axes(rotation: Rotation) -> np.ndarray:
    """Forward, right and up of a rotation of Unreal's, in its left-handed frame, as columns."""
    p, y, r = (math.radians(v) for v in (rotation.pitch, rotation.yaw, rotation.roll))
    cp, sp, cy, sy, cr, sr = math.cos(p), math.sin(p), math.cos(y), math.sin(y), math.cos(r), math.sin(r)
    return np.array(
        [
            [cp * cy, sr * sp * cy - cr * sy, -(cr * sp * cy + sr * sy)],
            [cp * sy, sr * sp * sy + cr * cy, cy * sr - cr * sp * sy],
            [sp, -sr * cp, cr * cp],
        ]
    )


class Sensor(Actor):
    _callback = None
    _lanes = None

    def _cross(self, frame: int) -> LaneInvasionEvent | None:
        """The markings that corners of the body have crossed since the last frame; none in junctions."""
        x, y, yaw = self._parent._pose
        half = self._parent.bounding_box.extent
        at = [(a * half.x, b * half.y) for a in (-1, 1) for b in (-1, 1)]
        c, s = math.cos(yaw), math.sin(yaw)
        corners = [(x + c * u - s * v, y + s * u + c * v) for u, v in at]
        graph = load_town(self._world._town)
        lanes = LaneQuery(graph).nearest(np.array(corners, np.float32), tuple(LaneType)).lane.tolist()
        before, self._lanes = self._lanes, lanes
        found = []
        for old, new in zip(before or lanes, lanes, strict=True):
            if old == new or min(old, new) < 0 or max(graph.junction[[old, new]]) >= 0:
                continue
            for side, marking in ((graph.left, graph.left_marking), (graph.right, graph.right_marking)):
                if side[old] == new:
                    found.append(LaneMarking(LaneMarkingType[MARKINGS.get(Marking(int(marking[old])), "Other")]))
        return LaneInvasionEvent(frame, self._parent, found) if found else None

    def _rays(self) -> np.ndarray:
        """Directions [..., 3] in the sensor's frame: x forward, y right, z up."""
        told = {key: float(value) for key, value in self._told.items()}
        if self.type_id == "sensor.camera.rgb":
            w, h = int(told["image_size_x"]), int(told["image_size_y"])
            f = 0.5 * w / math.tan(0.5 * math.radians(told["fov"]))
            u, v = np.meshgrid((np.arange(w) + 0.5 - 0.5 * w) / f, (np.arange(h) + 0.5 - 0.5 * h) / f)
            rays = np.stack([np.ones_like(u), u, -v], -1)
            return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        wide = math.radians(told["horizontal_fov"])
        if self.type_id == "sensor.lidar.ray_cast":
            assert told["rotation_frequency"] == 1.0 / self._world._settings.fixed_delta_seconds
            up = np.radians(np.linspace(told["lower_fov"], told["upper_fov"], int(told["channels"])))
        else:
            high = math.radians(told["vertical_fov"])
            up = (np.arange(12) + 0.5) * high / 12 - 0.5 * high
        count = round(told["points_per_second"] * 0.1 / len(up))
        turn = (np.arange(count) + 0.5) * wide / count - 0.5 * wide
        up, turn = np.meshgrid(up, turn, indexing="ij")
        return np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)], -1)

    def _measure(self, frame: int) -> SensorData | None:
        """Boxes on a plane."""
        camera = self.type_id == "sensor.camera.rgb"
        if camera and self._world._settings.no_rendering_mode:
            return None
        rays = self._rays()
        x, y, yaw = self._parent._pose
        car = _axes(Rotation(yaw=-math.degrees(yaw)))
        turn = car @ _axes(self._place.rotation)
        at = self._place.location
        eye = np.array([x, -y, 0.0]) + car @ (at.x, at.y, at.z)
        ways = (rays.reshape(-1, 3) @ turn.T) * (1.0, -1.0, 1.0)  # right-handed from here on
        away, who = _cast(eye * (1.0, -1.0, 1.0), ways, [b for b in self._world._bodies if b is not self._parent])
        if camera:
            colours = np.array([[250, 0, 0, 255], [0, 100, 0, 255], [0, 0, 200, 255]])  # BGRA: sky, ground, bodies
            kind = np.where(np.isinf(away), 0, np.where(who < 0, 1, 2))
            return Image(frame, colours[kind].reshape(*rays.shape[:2], 4))
        seen = away < float(self._told["range"])
        points = rays.reshape(-1, 3)[seen] * away[seen, None]
        if self.type_id == "sensor.lidar.ray_cast":
            return LidarMeasurement(frame, np.column_stack([points, np.exp(-0.004 * away[seen])]))
        others = [b for b in self._world._bodies if b is not self._parent]
        moves = np.array([*(b._velocity for b in others), (0.0, 0.0)]).reshape(-1, 2)[who[seen]]
        along = ((moves - self._parent._velocity) * ways[seen, :2]).sum(1)
        up, across = np.arcsin(rays.reshape(-1, 3)[seen, 2]), np.arctan2(points[:, 1], points[:, 0])
        return RadarMeasurement(frame, np.column_stack([along, across, up, away[seen]]))

    def listen(self, callback) -> None:
        _remote("Sensor.listen")
        self._callback = callback

    def stop(self) -> None:
        _remote("Sensor.stop")
        self._callback = None


def _cast(eye: np.ndarray, ways: np.ndarray, bodies: list[Actor]) -> tuple[np.ndarray, np.ndarray]:
    """How far rays [N, 3] go until they meet a body or the ground, and which body: -1 none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.where(ways[:, 2] < 0.0, -eye[2] / ways[:, 2], np.inf)
        who = np.full(len(ways), -1)
        for k, body in enumerate(bodies):
            x, y, yaw = body._pose
            half = body.bounding_box.extent
            c, s = math.cos(yaw), math.sin(yaw)
            turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            start, way = turn @ (eye - (x, y, half.z)), ways @ turn.T
            size = np.array([half.x, half.y, half.z])
            one, other = (-size - start) / way, (size - start) / way
            enter, leave = np.minimum(one, other).max(1), np.maximum(one, other).min(1)
            hit = (enter < leave) & (enter > 0.0) & (enter < away)
            away, who = np.where(hit, enter, away), np.where(hit, k, who)
    return away, who


class TrafficManager:
    def set_synchronous_mode(self, mode_switch: bool = True) -> None:
        _remote("TrafficManager.set_synchronous_mode")
        CALLS["synchronous managers"] += 1 if mode_switch else -1

    def set_random_device_seed(self, value: int) -> None:
        _remote("TrafficManager.set_random_device_seed")
        assert isinstance(value, int)

    def set_desired_speed(self, actor: Actor, speed: float) -> None:
        _remote("TrafficManager.set_desired_speed")
        actor._speed = speed / 3.6

    def auto_lane_change(self, actor: Actor, enable: bool) -> None:
        _remote("TrafficManager.auto_lane_change")

    def set_path(self, actor: Actor, path: list[Location]) -> None:
        _remote("TrafficManager.set_path")
        actor._path, actor._world._engine = tuple((p.x, -p.y) for p in path), None


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
        self._weather = weather

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
        frame = CALLS["World.tick"]
        for sensor in [actor for actor in self._actors.values() if isinstance(actor, Sensor)]:
            if fault() == f"gone {sensor.type_id}" and CALLS["World.tick"] == 9:
                del self._actors[sensor.id]
            elif sensor.type_id == "sensor.other.lane_invasion":
                event = sensor._cross(frame)
                if event is not None and sensor._callback is not None:
                    sensor._callback(event)
                continue
            elif sensor.type_id != "sensor.other.collision":
                data = None if fault() == "silent sensors" else sensor._measure(frame)
                if data is not None and sensor._callback is not None:
                    if fault() == "broken sensors":
                        data.raw_data = data.raw_data[:-3]
                    sensor._callback(data)
                continue
            me = bodies.index(sensor._parent)
            for j, other in enumerate(bodies):
                if sensor._callback is not None and int(touch[me]) >> j & 1:
                    sensor._callback(CollisionEvent(sensor._parent, other))
        return frame

    def _ahead(self, body: Actor) -> list[tuple[float, float]]:
        """What of the path of the Traffic Manager lies before a body."""
        x, y, yaw = body._pose
        far = [math.hypot(px - x, py - y) for px, py in body._path]
        near = far.index(min(far))
        px, py = body._path[near]
        behind = (px - x) * math.cos(yaw) + (py - y) * math.sin(yaw) < 0.0
        return list(body._path[near + behind :]) or [(x + 5 * math.cos(yaw), y + 5 * math.sin(yaw))]

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
            who, way, speed = Controller.EXTERNAL if moves else Controller.PLACED, nowhere, 8.0
            if body._path:
                who, speed = Controller.AUTOPILOT, body._speed
                way = route_along(load_town(self._town), [Pose(*body._pose), *self._ahead(body)])
            agents.append(EpisodeAgent(str(body.id), name, who, Pose(*body._pose), body._start_speed, speed, route=way))
        limits = EpisodeLimits(max_steps=10**6, max_time=1e6, contact="count")
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

    def get_trafficmanager(self, client_connection: int = 8000) -> TrafficManager:
        _remote("Client.get_trafficmanager")
        assert client_connection == 8000
        return TrafficManager()

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

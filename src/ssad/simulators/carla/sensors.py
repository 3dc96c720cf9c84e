"""CARLA's own cameras, LiDARs and radars on the ego, with the readings that drivers get from SSAD's.

A camera of CARLA is a pinhole whose axis meets the middle of the picture: of one that is not so, a larger picture is
taken and cut out. Frames: those of a `Camera` and of a `Lidar` here; CARLA's are left-handed, its angles degrees.
Facts: carla.readthedocs.io, 0.9.16, sensors reference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from queue import Empty, Queue
from typing import TYPE_CHECKING, Final, TypeVar, cast

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import F32, F64, I32, U8
from ssad.rendering.lidar import Lidar

if TYPE_CHECKING:
    import carla

T = TypeVar("T")
SQUARE: Final = 1e-3  # share by which the focal lengths of a camera may differ
EVEN: Final = 1e-6  # rad by which the steps between beams may differ
_CAMERA_AXES: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x right, y down
_LIDAR_AXES: Final = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # x right, y forward


@dataclass(frozen=True)
class Eye:
    """A sensor that CARLA is asked for.

    Attributes:
        kind: Its blueprint.
        attributes: What the blueprint is set to.
        place: Sensor to car [4, 4], its frame x forward, y left, z up.
        read: Bytes of a measurement -> the reading of one agent.
        empty: The reading where the episode has ended.
    """

    kind: str
    attributes: Mapping[str, str]
    place: F64
    read: Callable[[bytes], F32 | U8]
    empty: F32 | U8


def camera_eye(camera: Camera) -> Eye:
    """A camera. ConfigError where its pixels are not square."""
    (fx, skew, cx), (_, fy, cy), _ = np.asarray(camera.intrinsic, np.float64).tolist()
    if abs(fx - fy) > SQUARE * fx or skew:
        raise ConfigError(f"camera '{camera.channel}': CARLA has no camera whose pixels are not square")
    half = max(cx, camera.width - cx), max(cy, camera.height - cy)
    wide, high = (2 * math.ceil(one - 1e-9) for one in half)
    left, top = round(0.5 * wide - cx), round(0.5 * high - cy)
    shape = (3, camera.height, camera.width)

    def read(raw: bytes) -> U8:
        whole = np.frombuffer(raw, np.uint8).reshape(high, wide, 4)
        part = whole[top : top + camera.height, left : left + camera.width, 2::-1]
        return np.ascontiguousarray(part.transpose(2, 0, 1))

    told = {"image_size_x": wide, "image_size_y": high, "fov": math.degrees(2.0 * math.atan(0.5 * wide / fx))}
    return Eye("sensor.camera.rgb", _words(told), _place(camera.to_ego, _CAMERA_AXES), read, np.zeros(shape, np.uint8))


def lidar_eye(lidar: Lidar, dt: float) -> Eye:
    """A LiDAR that turns once a step. ConfigError where its beams are not evenly spaced."""
    beams = np.asarray(lidar.beams, np.float64)
    step = float(np.diff(beams).mean()) if len(beams) > 1 else 1.0
    if len(beams) > 1 and np.abs(np.diff(beams) - step).max() > EVEN:
        raise ConfigError("CARLA has no LiDAR whose beams are not evenly spaced")
    room = len(beams) * lidar.azimuths
    empty = np.zeros((room, 5), np.float32)
    empty[:, 4] = -1.0

    def read(raw: bytes) -> F32:
        seen = np.frombuffer(raw, np.float32).reshape(-1, 4)[:room]
        out = empty.copy()
        out[: len(seen), 0], out[: len(seen), 1], out[: len(seen), 2] = seen[:, 1], seen[:, 0], seen[:, 2]
        up = np.arctan2(seen[:, 2], np.hypot(seen[:, 0], seen[:, 1]))
        out[: len(seen), 3] = np.rint(255.0 * seen[:, 3])
        out[: len(seen), 4] = np.clip(np.rint((up - beams[0]) / step), 0, len(beams) - 1)
        return out

    told = {
        "channels": len(beams),
        "range": lidar.reach,
        "points_per_second": round(room / dt),
        "rotation_frequency": 1 / dt,
        "upper_fov": math.degrees(beams[-1]),
        "lower_fov": math.degrees(beams[0]),
        "horizontal_fov": min(math.degrees(lidar.width), 360.0),
        "noise_stddev": lidar.noise,
        "dropoff_general_rate": lidar.lost,
    }
    return Eye("sensor.lidar.ray_cast", _words(told), _place(lidar.to_ego, _LIDAR_AXES), read, empty)


def radar_eye(radar: Lidar, dt: float) -> Eye:
    """A radar, of rays as `ssad.rendering.radar` has them."""
    room = len(radar.beams) * radar.azimuths
    high = float(np.ptp(radar.beams)) * (1.0 + 1.0 / max(len(radar.beams) - 1, 1))
    empty = np.zeros((room, 4), np.float32)

    def read(raw: bytes) -> F32:
        seen = np.frombuffer(raw, np.float32).reshape(-1, 4)[:room, ::-1]  # velocity, azimuth, altitude, depth
        out = empty.copy()
        out[: len(seen)] = seen
        return out

    told = {
        "horizontal_fov": math.degrees(radar.width),
        "vertical_fov": math.degrees(high),
        "range": radar.reach,
        "points_per_second": round(room / dt),
    }
    return Eye("sensor.other.radar", _words(told), _place(radar.to_ego, _LIDAR_AXES), read, empty)


def _words(told: Mapping[str, float]) -> dict[str, str]:
    return {name: repr(value) for name, value in told.items()}


def _place(to_ego: F64, axes: F64) -> F64:
    """Sensor to car of a frame of x forward, y left, z up, from one of these axes."""
    place = np.array(to_ego, np.float64)
    place[:3, :3] = place[:3, :3] @ axes.T
    return place


def angles_of(place: F64) -> tuple[float, float, float]:
    """CARLA's roll, pitch and yaw, degrees, of a rotation of x forward, y left, z up."""
    forward, right, up = place[:3, 0], -place[:3, 1], place[:3, 2]
    yaw = math.atan2(-forward[1], forward[0])
    pitch = math.atan2(forward[2], math.hypot(forward[0], forward[1]))
    return math.degrees(math.atan2(-right[2], up[2])), math.degrees(pitch), math.degrees(yaw)


@dataclass
class Carried:
    """The sensors that the ego of an episode carries.

    Attributes:
        eyes: By name.
        timeout: s that a reading may take.
        where: Which server, for messages.
    """

    eyes: Mapping[str, Eye]
    timeout: float
    where: str
    _sensors: list[carla.Sensor] = field(default_factory=list)
    _came: dict[str, Queue[tuple[int, bytes]]] = field(default_factory=dict)
    _seen: dict[str, tuple[int, F32 | U8]] = field(default_factory=dict)

    def attach(self, world: carla.World, body: carla.Actor, middle: float) -> None:
        """Spawn them on a body whose centre lies so far ahead of its origin, m."""
        import carla

        library = world.get_blueprint_library()
        for name, eye in self.eyes.items():
            blueprint = library.find(eye.kind)
            for key, value in eye.attributes.items():
                blueprint.set_attribute(key, value)
            roll, pitch, yaw = angles_of(eye.place)
            x, y, z = eye.place[:3, 3].tolist()
            place = carla.Transform(
                carla.Location(x=x + middle, y=0.0 - y, z=z), carla.Rotation(pitch=pitch, yaw=yaw, roll=roll)
            )
            sensor = cast("carla.Sensor", world.spawn_actor(blueprint, place, attach_to=body))
            came: Queue[tuple[int, bytes]] = Queue()
            self._came[name] = came
            sensor.listen(_into(came))
            self._sensors.append(sensor)

    def detach(self) -> None:
        """Take them out."""
        sensors, self._sensors = self._sensors, []
        self._came, self._seen = {}, {}
        for sensor in sensors:
            stop: Callable[[], object] = sensor.stop  # the stubs do not say what it gives
            stop()
            sensor.destroy()

    def reading(self, name: str, frame: int) -> F32 | U8:
        """What a sensor saw in a frame. ConfigError where CARLA does not send it in time."""
        seen = self._seen.get(name)
        if seen is not None and seen[0] == frame:
            return seen[1]
        while True:
            try:
                at, raw = self._came[name].get(timeout=self.timeout)
            except (Empty, KeyError):
                raise ConfigError(f"{self.where}: its sensor '{name}' sends nothing of frame {frame}") from None
            if at == frame:
                break
        try:
            value = self.eyes[name].read(raw)
        except ValueError as error:
            raise ConfigError(f"{self.where}: its sensor '{name}' sends something else: {error}") from None
        self._seen[name] = frame, value
        return value


def _into(came: Queue[tuple[int, bytes]]) -> Callable[[carla.Image | carla.LidarMeasurement], None]:
    def take(data: carla.Image | carla.LidarMeasurement) -> None:
        came.put((data.frame, bytes(data.raw_data)))

    return take


def eyes_of(sensors: Mapping[str, Camera | tuple[str, Lidar]], dt: float) -> dict[str, Eye]:
    """CARLA's sensors for cameras, and for LiDARs and radars beside the word "lidar" or "radar", by name."""
    found = {}
    for name, one in sensors.items():
        if isinstance(one, Camera):
            found[name] = camera_eye(one)
        else:
            found[name] = lidar_eye(one[1], dt) if one[0] == "lidar" else radar_eye(one[1], dt)
    return found


class Own:
    """One of CARLA's sensors as a sensor of `ssad.world.rollout.rollout`; the simulator must carry it."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, simulator: object, agents: I32) -> F32 | U8:
        """Readings [N, ...] of egos [N, 2]."""
        found = [simulator.seen(self.name, row) for row in agents.tolist()]  # type: ignore[attr-defined]
        return np.stack(found)

"""CARLA's own cameras, LiDARs and radars on the ego, with readings in the format of SSAD's sensors.

A camera of CARLA is a pinhole whose axis meets the centre of the image; for any other camera a larger image is taken
and cropped. Frames: those of a `Camera` and of a `Lidar` here; CARLA's are left-handed, its angles in degrees.
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
from ssad.core.frames import Camera, DepthCamera, SemanticCamera
from ssad.core.types import F32, F64, I32, U8
from ssad.rendering.lidar import Lidar

if TYPE_CHECKING:
    import carla

T = TypeVar("T")
SQUARE: Final = 1e-3  # relative difference of a camera's focal lengths
EVEN: Final = 1e-6  # rad, difference between the steps of beams
_CAMERA_AXES: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x right, y down
_LIDAR_AXES: Final = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # x right, y forward


@dataclass(frozen=True)
class SensorBlueprint:
    """A sensor to be spawned in CARLA.

    Attributes:
        kind: Name of its blueprint.
        attributes: Attributes of the blueprint.
        place: Sensor to car [4, 4]; its frame is x forward, y left, z up.
        read: Bytes of a measurement -> the reading of one agent.
        empty: The reading once the episode has ended.
    """

    kind: str
    attributes: Mapping[str, str]
    place: F64
    read: Callable[[bytes], F32 | U8]
    empty: F32 | U8


def camera_blueprint(camera: Camera) -> SensorBlueprint:
    """Describe a camera. ConfigError if its pixels are not square."""
    (fx, skew, cx), (_, fy, cy), _ = np.asarray(camera.intrinsic, np.float64).tolist()
    if abs(fx - fy) > SQUARE * fx or skew:
        raise ConfigError(f"camera '{camera.channel}': CARLA has no camera whose pixels are not square")
    # The smallest centred image that contains the wanted one; even, so that its centre is a pixel corner.
    half_extents = max(cx, camera.width - cx), max(cy, camera.height - cy)
    full_width, full_height = (2 * math.ceil(extent - 1e-9) for extent in half_extents)
    left, top = round(0.5 * full_width - cx), round(0.5 * full_height - cy)
    shape = (3, camera.height, camera.width)

    def read(raw: bytes) -> U8:
        full_image = np.frombuffer(raw, np.uint8).reshape(full_height, full_width, 4)
        cropped = full_image[top : top + camera.height, left : left + camera.width, 2::-1]
        return np.ascontiguousarray(cropped.transpose(2, 0, 1))

    attributes = {
        "image_size_x": full_width,
        "image_size_y": full_height,
        "fov": math.degrees(2.0 * math.atan(0.5 * full_width / fx)),
    }
    return SensorBlueprint(
        "sensor.camera.rgb",
        _attribute_strings(attributes),
        _sensor_pose(camera.to_ego, _CAMERA_AXES),
        read,
        np.zeros(shape, np.uint8),
    )


def lidar_blueprint(lidar: Lidar, dt: float) -> SensorBlueprint:
    """Describe a LiDAR that turns once per step. ConfigError if its beams are not evenly spaced."""
    beams = np.asarray(lidar.beams, np.float64)
    beam_step = float(np.diff(beams).mean()) if len(beams) > 1 else 1.0
    if len(beams) > 1 and np.abs(np.diff(beams) - beam_step).max() > EVEN:
        raise ConfigError("CARLA has no LiDAR whose beams are not evenly spaced")
    point_count = len(beams) * lidar.azimuths
    empty = np.zeros((point_count, 5), np.float32)
    empty[:, 4] = -1.0

    def read(raw: bytes) -> F32:
        returns = np.frombuffer(raw, np.float32).reshape(-1, 4)[:point_count]
        reading = empty.copy()
        reading[: len(returns), 0], reading[: len(returns), 1], reading[: len(returns), 2] = (
            returns[:, 1],
            returns[:, 0],
            returns[:, 2],
        )
        elevation = np.arctan2(returns[:, 2], np.hypot(returns[:, 0], returns[:, 1]))
        reading[: len(returns), 3] = np.rint(255.0 * returns[:, 3])
        reading[: len(returns), 4] = np.clip(np.rint((elevation - beams[0]) / beam_step), 0, len(beams) - 1)
        return reading

    attributes = {
        "channels": len(beams),
        "range": lidar.reach,
        "points_per_second": round(point_count / dt),
        "rotation_frequency": 1 / dt,
        "upper_fov": math.degrees(beams[-1]),
        "lower_fov": math.degrees(beams[0]),
        "horizontal_fov": min(math.degrees(lidar.width), 360.0),
        "noise_stddev": lidar.noise,
        "dropoff_general_rate": lidar.lost,
    }
    return SensorBlueprint(
        "sensor.lidar.ray_cast", _attribute_strings(attributes), _sensor_pose(lidar.to_ego, _LIDAR_AXES), read, empty
    )


def radar_blueprint(radar: Lidar, dt: float) -> SensorBlueprint:
    """Describe a radar with the rays of `ssad.rendering.radar`."""
    point_count = len(radar.beams) * radar.azimuths
    vertical_angle = float(np.ptp(radar.beams)) * (1.0 + 1.0 / max(len(radar.beams) - 1, 1))
    empty = np.zeros((point_count, 4), np.float32)

    def read(raw: bytes) -> F32:
        returns = np.frombuffer(raw, np.float32).reshape(-1, 4)[
            :point_count, ::-1
        ]  # velocity, azimuth, altitude, depth
        reading = empty.copy()
        reading[: len(returns)] = returns
        return reading

    attributes = {
        "horizontal_fov": math.degrees(radar.width),
        "vertical_fov": math.degrees(vertical_angle),
        "range": radar.reach,
        "points_per_second": round(point_count / dt),
    }
    return SensorBlueprint(
        "sensor.other.radar", _attribute_strings(attributes), _sensor_pose(radar.to_ego, _LIDAR_AXES), read, empty
    )


def _attribute_strings(attributes: Mapping[str, float]) -> dict[str, str]:
    return {name: repr(value) for name, value in attributes.items()}


def _sensor_pose(to_ego: F64, axes: F64) -> F64:
    """Return sensor to car of a frame of x forward, y left, z up, given the sensor's own axes."""
    pose = np.array(to_ego, np.float64)
    pose[:3, :3] = pose[:3, :3] @ axes.T
    return pose


def carla_angles(place: F64) -> tuple[float, float, float]:
    """Return CARLA's roll, pitch and yaw, degrees, of a rotation in a frame of x forward, y left, z up."""
    forward, right, up = place[:3, 0], -place[:3, 1], place[:3, 2]
    yaw = math.atan2(-forward[1], forward[0])
    pitch = math.atan2(forward[2], math.hypot(forward[0], forward[1]))
    return math.degrees(math.atan2(-right[2], up[2])), math.degrees(pitch), math.degrees(yaw)


@dataclass
class EgoSensors:
    """The sensors on the ego of an episode.

    Attributes:
        blueprints: Sensors by name.
        timeout: Time limit of a reading, s.
        server_name: Name of the server, for messages.
    """

    blueprints: Mapping[str, SensorBlueprint]
    timeout: float
    server_name: str
    _sensors: list[carla.Sensor] = field(default_factory=list)
    _queues: dict[str, Queue[tuple[int, bytes]]] = field(default_factory=dict)
    _latest_readings: dict[str, tuple[int, F32 | U8]] = field(default_factory=dict)

    def attach(self, world: carla.World, body: carla.Actor, middle: float) -> None:
        """Spawn them on a body whose centre lies so far ahead of its origin, m."""
        import carla

        library = world.get_blueprint_library()
        for name, description in self.blueprints.items():
            blueprint = library.find(description.kind)
            for key, value in description.attributes.items():
                blueprint.set_attribute(key, value)
            roll, pitch, yaw = carla_angles(description.place)
            x, y, z = description.place[:3, 3].tolist()
            transform = carla.Transform(
                carla.Location(x=x + middle, y=0.0 - y, z=z), carla.Rotation(pitch=pitch, yaw=yaw, roll=roll)
            )
            sensor = cast("carla.Sensor", world.spawn_actor(blueprint, transform, attach_to=body))
            measurements: Queue[tuple[int, bytes]] = Queue()
            self._queues[name] = measurements
            sensor.listen(_enqueue_into(measurements))
            self._sensors.append(sensor)

    def detach(self) -> None:
        """Remove the sensors."""
        sensors, self._sensors = self._sensors, []
        self._queues, self._latest_readings = {}, {}
        for sensor in sensors:
            stop: Callable[[], object] = sensor.stop  # the stubs do not declare its return type
            stop()
            sensor.destroy()

    def reading(self, name: str, frame: int) -> F32 | U8:
        """Return the reading of a sensor in a frame. ConfigError if CARLA does not send it in time."""
        cached = self._latest_readings.get(name)
        if cached is not None and cached[0] == frame:
            return cached[1]
        while True:
            try:
                # Measurements of earlier frames that were never read are skipped.
                measured_frame, encoded = self._queues[name].get(timeout=self.timeout)
            except (Empty, KeyError):
                raise ConfigError(f"{self.server_name}: its sensor '{name}' sends nothing of frame {frame}") from None
            if measured_frame == frame:
                break
        try:
            value = self.blueprints[name].read(encoded)
        except ValueError as error:
            raise ConfigError(f"{self.server_name}: its sensor '{name}' sends something else: {error}") from None
        self._latest_readings[name] = frame, value
        return value


def _enqueue_into(queue: Queue[tuple[int, bytes]]) -> Callable[[carla.Image | carla.LidarMeasurement], None]:
    def enqueue(data: carla.Image | carla.LidarMeasurement) -> None:
        queue.put((data.frame, bytes(data.raw_data)))

    return enqueue


def sensor_blueprints(
    sensors: Mapping[str, Camera | DepthCamera | SemanticCamera | tuple[str, Lidar]], dt: float
) -> dict[str, SensorBlueprint]:
    """Return CARLA's sensors by name, for cameras, and for LiDARs and radars paired with "lidar" or "radar".

    Raises:
        ConfigError: A depth or semantic camera is asked for; SSAD reads none from CARLA.
    """
    blueprints = {}
    for name, sensor in sensors.items():
        if isinstance(sensor, Camera):
            blueprints[name] = camera_blueprint(sensor)
        elif isinstance(sensor, DepthCamera | SemanticCamera):
            raise ConfigError(
                f"sensor '{name}': depth and semantic cameras are not read from CARLA; leave sensors=carla out"
            )
        else:
            blueprints[name] = (
                lidar_blueprint(sensor[1], dt) if sensor[0] == "lidar" else radar_blueprint(sensor[1], dt)
            )
    return blueprints


class CarlaSensor:
    """One of CARLA's sensors as a sensor of `ssad.world.rollout.rollout`; the simulator must carry it."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, simulator: object, egos: I32) -> F32 | U8:
        """Return the readings [N, ...] of egos [N, 2]."""
        readings = [simulator.sensor_reading(self.name, row) for row in egos.tolist()]  # type: ignore[attr-defined]
        return np.stack(readings)

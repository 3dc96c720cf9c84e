"""A tiny nuScenes data set drawn in code: a street, six cameras, a LiDAR, boxes. For tests, examples and first steps.

It holds everything that the schema has (sweeps, calibrations, poses, attributes, visibility, point counts), takes
a second or two to make, and gives the same bytes for the same arguments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssad.core.images import encode_jpeg
from ssad.core.nuscenes_names import CAMERAS, LIDAR, visibility_token
from ssad.core.rotations import quaternion_product, yaw_to_quaternion
from ssad.core.seeding import generator
from ssad.core.types import F32
from ssad.datasets.nuscenes.block_street import BlockObject, ego_place, make_street
from ssad.datasets.nuscenes.drawing import BlockStreet, BlockView, Light
from ssad.datasets.nuscenes.files import points_bytes
from ssad.datasets.nuscenes.schema import Vector
from ssad.datasets.nuscenes.writer import NuScenesWriter

# place on the ego (m), yaw (degrees), focal length and principal point at 1600 x 900: about those of the real cars
RIG: Final[dict[str, tuple[Vector, float, float, float, float]]] = {
    "CAM_FRONT": ((1.70, 0.02, 1.50), 0.0, 1266.4, 816.3, 491.5),
    "CAM_FRONT_RIGHT": ((1.55, -0.49, 1.50), -55.0, 1260.8, 807.9, 495.3),
    "CAM_BACK_RIGHT": ((1.01, -0.48, 1.50), -110.0, 1259.5, 807.3, 501.2),
    "CAM_BACK": ((0.03, 0.0, 1.50), 180.0, 809.2, 829.2, 481.8),
    "CAM_BACK_LEFT": ((1.04, 0.48, 1.50), 110.0, 1256.7, 792.1, 492.8),
    "CAM_FRONT_LEFT": ((1.52, 0.49, 1.50), 55.0, 1272.6, 826.6, 479.8),
}
LIDAR_PLACE: Final[Vector] = (0.94, 0.0, 1.84)
LIDAR_YAW: Final = -math.pi / 2  # its y axis points forward
AHEAD: Final = (0.5, -0.5, 0.5, -0.5)  # rotation of an upright camera that looks along x
STEP_US: Final = 500_000  # between key frames
ANNOTATED: Final = 55.0  # m from the ego
_START_US: Final = 1_600_000_000_000_000
_CAMERA_DELAY_US: Final = 1_000  # from a camera to the next; the LiDAR and the boxes have the sample's time


def make_tiny(
    root: Path,
    *,
    scenes: int = 2,
    samples: int = 3,
    sweeps: int = 1,
    size: tuple[int, int] = (800, 450),
    seed: int = 0,
    version: str = "v1.0-mini",
) -> Path:
    """Draw a data set into `root` and return it.

    samples: key frames a scene, half a second apart; sweeps: frames of every sensor between two key frames; size:
    width and height of the images in pixels. The first two scenes are those of mini_val. ValueError for counts below
    one (sweeps: zero); StoreError when the folder cannot be written.
    """
    if min(scenes, samples, *size) < 1 or sweeps < 0:
        raise ValueError("scenes, samples and size must be at least 1, sweeps at least 0")
    root = Path(root)
    with NuScenesWriter(root, version) as writer:
        for number in range(scenes):
            _write_scene(writer, number, samples=samples, sweeps=sweeps, size=size, seed=seed)
    return root


@dataclass(frozen=True)
class _Drive:
    """A scene being written: its street, and the street's place in the global frame."""

    writer: NuScenesWriter
    street: BlockStreet
    scene: str
    start_us: int
    origin: tuple[float, float]
    heading: float

    def point(self, x: float, y: float, z: float) -> Vector:
        """A point of the street in the global frame."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return self.origin[0] + cos * x - sin * y, self.origin[1] + sin * x + cos * y, z

    def add(self, channel: str, offset_us: int, data: bytes, *, sample: str | None, size: tuple[int, int]) -> None:
        """A file of a sensor, with the ego's pose at its time."""
        x, y, yaw = ego_place(offset_us * 1e-6)
        self.writer.add_sensor_frame(
            self.scene,
            channel,
            timestamp_us=self.start_us + offset_us,
            data=data,
            ego_translation=self.point(x, y, 0.0),
            ego_rotation=tuple(yaw_to_quaternion(yaw + self.heading)),
            sample=sample,
            size=size,
        )

    def annotate(self, sample: str, instances: dict[str, str], seconds: float, *, points: F32, seen: Any) -> None:
        """Boxes of what is near; seen [N, 2]: pixels seen and of the whole outline, over all cameras."""
        ego = ego_place(seconds)
        for thing, (visible, whole) in zip(self.street.things, seen, strict=True):
            x, y, yaw = thing.at(seconds)
            if math.hypot(x - ego[0], y - ego[1]) > ANNOTATED:
                continue
            share = visible / whole if whole else 0.0
            self.writer.add_annotation(
                sample,
                instances[thing.key],
                translation=self.point(x, y, thing.size[2] / 2),
                size=thing.size,
                rotation=tuple(yaw_to_quaternion(yaw + self.heading)),
                visibility=visibility_token(share),
                attributes=(thing.attribute,) if thing.attribute else (),
                lidar_points=_count_inside(points, thing, seconds),
            )


def _write_scene(
    writer: NuScenesWriter, number: int, *, samples: int, sweeps: int, size: tuple[int, int], seed: int
) -> None:
    random = generator(seed, "tiny", number)
    heading = float(random.uniform(-math.pi, math.pi))
    origin = (float(random.uniform(300, 900)), float(random.uniform(800, 1600)))
    things, buildings = make_street(random, seconds=samples * STEP_US * 1e-6)
    scene = writer.add_scene(description=f"A drawn street with {len(things)} objects")
    _mount(writer, scene, size)
    instances = {thing.key: writer.add_instance(scene, thing.key, category=thing.category) for thing in things}
    street = BlockStreet(things, buildings, _light(random), random)
    drive = _Drive(writer, street, scene, _START_US + number * 3_600_000_000, origin, heading)
    for tick in range((samples - 1) * (sweeps + 1) + 1):
        offset = tick * STEP_US // (sweeps + 1)
        sample = writer.add_sample(scene, drive.start_us + offset) if tick % (sweeps + 1) == 0 else None
        seen = np.zeros((len(things), 2), np.int64)
        for order, channel in enumerate(CAMERAS):
            time = offset + order * _CAMERA_DELAY_US
            image, counts = street.picture(_view(channel, time * 1e-6, size), time * 1e-6)
            seen += np.array(counts)
            drive.add(channel, time, encode_jpeg(image, 80), sample=sample, size=size)
        points = _sweep(street, offset * 1e-6)
        drive.add(LIDAR, offset, points_bytes(points), sample=sample, size=(0, 0))
        if sample is not None:
            drive.annotate(sample, instances, offset * 1e-6, points=points, seen=seen)


def _mount(writer: NuScenesWriter, scene: str, size: tuple[int, int]) -> None:
    """The rig's calibration for images of this size; the focal length goes with the width."""
    share = size[0] / 1600.0
    for channel, (place, yaw, focal, cx, cy) in RIG.items():
        matrix = ((focal * share, 0, cx * share), (0, focal * share, cy * size[1] / 900.0), (0, 0, 1))
        rotation = tuple(quaternion_product(yaw_to_quaternion(math.radians(yaw)), AHEAD))
        writer.add_sensor(scene, channel, modality="camera", translation=place, rotation=rotation, intrinsic=matrix)
    turn = tuple(yaw_to_quaternion(LIDAR_YAW))
    writer.add_sensor(scene, LIDAR, modality="lidar", translation=LIDAR_PLACE, rotation=turn)


def _count_inside(points: F32, thing: BlockObject, seconds: float) -> int:
    """Points of a sweep within the box of a thing."""
    ex, ey, eyaw = ego_place(seconds)
    x, y, yaw = thing.at(seconds)
    lx, ly = ex + math.cos(eyaw) * LIDAR_PLACE[0], ey + math.sin(eyaw) * LIDAR_PLACE[0]
    turn = eyaw + LIDAR_YAW
    px = lx + math.cos(turn) * points[:, 0] - math.sin(turn) * points[:, 1] - x
    py = ly + math.sin(turn) * points[:, 0] + math.cos(turn) * points[:, 1] - y
    along, across = math.cos(yaw) * px + math.sin(yaw) * py, -math.sin(yaw) * px + math.cos(yaw) * py
    height = points[:, 2] + LIDAR_PLACE[2]
    width, length, tall = thing.size
    inside = (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2) & (height >= 0.0) & (height <= tall)
    return int(np.count_nonzero(inside))


def _view(channel: str, seconds: float, size: tuple[int, int]) -> BlockView:
    """A camera of the rig in the street frame."""
    (forward, left, up), degrees, focal, cx, cy = RIG[channel]
    x, y, yaw = ego_place(seconds)
    share = size[0] / 1600.0
    return BlockView(
        x=x + math.cos(yaw) * forward - math.sin(yaw) * left,
        y=y + math.sin(yaw) * forward + math.cos(yaw) * left,
        z=up,
        yaw=yaw + math.radians(degrees),
        focal=focal * share,
        cx=cx * share,
        cy=cy * size[1] / 900.0,
        width=size[0],
        height=size[1],
    )


def _sweep(street: BlockStreet, seconds: float) -> F32:
    x, y, yaw = ego_place(seconds)
    forward, _, up = LIDAR_PLACE
    origin = (x + math.cos(yaw) * forward, y + math.sin(yaw) * forward, up)
    return street.sweep(origin, yaw + LIDAR_YAW, seconds)


def _light(random: np.random.Generator) -> Light:
    azimuth, height = random.uniform(-math.pi, math.pi), random.uniform(0.5, 0.9)
    flat = math.sqrt(1 - height * height)
    strength = float(random.uniform(0.88, 1.05))
    return Light(
        direction=(flat * math.cos(azimuth), flat * math.sin(azimuth), height),
        sky=(104, 148, 204),
        haze=(196, 206, 216),
        strength=strength,
    )

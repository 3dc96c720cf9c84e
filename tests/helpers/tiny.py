"""A tiny data set in the nuScenes schema: an empty street with a few boxes, seen by six cameras and a LiDAR."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ssad.core.boxes import WorldBoxes
from ssad.core.frames import Camera
from ssad.core.images import encode_jpeg
from ssad.core.nuscenes_names import LIDAR
from ssad.core.rotations import matrix_to_quaternion, upright_pose, yaw_to_quaternion
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, U8
from ssad.datasets.nuscenes.files import points_bytes
from ssad.datasets.nuscenes.writer import NuScenesWriter
from ssad.rendering.camera.rig import RIG, rig_camera
from ssad.rendering.lidar import HDL32E, points_in_boxes

START_US = 1_600_000_000_000_000
STEP_US = 500_000  # from one key frame to the next
CAMERA_DELAY_US = 1_000  # from a camera to the next; the LiDAR and the boxes have the sample's time
EGO_SPEED = 7.0  # m/s


@dataclass(frozen=True)
class Thing:
    """A box on the street (x along it, y to the left, m): where it starts, its speed (m/s), length, width, height."""

    category: str
    attribute: str
    start: tuple[float, float]
    speed: float
    size: tuple[float, float, float]
    colour: tuple[int, int, int]


THINGS = (
    Thing("vehicle.car", "vehicle.moving", (14.0, 0.3), 7.5, (4.4, 1.8, 1.5), (190, 40, 40)),
    Thing("vehicle.car", "vehicle.moving", (34.0, 3.6), -8.0, (4.6, 1.9, 1.5), (40, 110, 60)),
    Thing("vehicle.car", "vehicle.parked", (9.0, -4.2), 0.0, (4.2, 1.8, 1.6), (60, 70, 160)),
    Thing("vehicle.car", "vehicle.parked", (-9.0, 4.4), 0.0, (4.3, 1.8, 1.5), (200, 200, 190)),
    Thing("vehicle.truck", "vehicle.parked", (22.0, 6.8), 0.0, (7.5, 2.5, 3.2), (220, 215, 200)),
    Thing("human.pedestrian.adult", "pedestrian.moving", (11.0, 6.0), 1.4, (0.7, 0.7, 1.8), (30, 30, 120)),
    Thing("human.pedestrian.adult", "pedestrian.standing", (16.0, -6.5), 0.0, (0.7, 0.7, 1.7), (240, 210, 60)),
    Thing("vehicle.bicycle", "cycle.with_rider", (-7.0, -2.6), 4.0, (1.8, 0.6, 1.6), (90, 40, 30)),
    Thing("movable_object.trafficcone", "", (7.5, 2.9), 0.0, (0.4, 0.4, 0.8), (235, 120, 30)),
)


def make_tiny(
    root: Path,
    *,
    scenes: int = 2,
    samples: int = 3,
    sweeps: int = 1,
    size: tuple[int, int] = (320, 180),
) -> Path:
    """Draws a data set into `root` and returns it; the same arguments give the same bytes.

    Args:
        root: Its folder.
        scenes: How many there are; the first two are those of mini_val.
        samples: Key frames of a scene, half a second apart.
        sweeps: Frames of every sensor between two key frames.
        size: Width and height of the pictures in pixels, 16:9.
    """
    with NuScenesWriter(root) as writer:
        for number in range(scenes):
            _write_scene(writer, number, samples=samples, sweeps=sweeps, size=size)
    return root


def _write_scene(writer: NuScenesWriter, number: int, *, samples: int, sweeps: int, size: tuple[int, int]) -> None:
    random = generator("tiny", number)
    heading = float(random.uniform(-np.pi, np.pi))
    street = upright_pose(float(random.uniform(300, 900)), float(random.uniform(800, 1600)), heading)
    ahead = random.uniform(-1.0, 1.0, len(THINGS))
    grain = random.normal(0.0, 6.0, (size[1], size[0], 3))
    scene, start_us = writer.add_scene(), START_US + number * 3_600_000_000
    cameras = [rig_camera(channel, size[0]) for channel in RIG]
    for camera in cameras:
        writer.add_sensor(
            scene,
            camera.channel,
            modality="camera",
            translation=camera.to_ego[:3, 3],
            rotation=matrix_to_quaternion(camera.to_ego[:3, :3]),
            intrinsic=camera.intrinsic,
        )
    to_ego = HDL32E.to_ego
    rotation = matrix_to_quaternion(to_ego[:3, :3])
    writer.add_sensor(scene, LIDAR, modality="lidar", translation=to_ego[:3, 3], rotation=rotation)
    instances = [writer.add_instance(scene, str(n), category=thing.category) for n, thing in enumerate(THINGS)]
    for tick in range((samples - 1) * (sweeps + 1) + 1):
        offset = tick * STEP_US // (sweeps + 1)
        sample = writer.add_sample(scene, start_us + offset) if tick % (sweeps + 1) == 0 else None
        boxes = boxes_at(offset, ahead)
        points = sweep(boxes, ego_pose(offset) @ to_ego)
        files = [(LIDAR, 0, points_bytes(points), (0, 0))]
        for order, camera in enumerate(cameras):
            late = order * CAMERA_DELAY_US
            picture = draw(boxes_at(offset + late, ahead), camera, ego_pose(offset + late) @ camera.to_ego, grain)
            files.append((camera.channel, late, encode_jpeg(picture, 80), size))
        for channel, late, data, pixels in files:
            place = (street @ ego_pose(offset + late))[:3, 3]
            writer.add_sensor_frame(
                scene,
                channel,
                timestamp_us=start_us + offset + late,
                data=data,
                ego_translation=place,
                ego_rotation=yaw_to_quaternion(heading),
                sample=sample,
                size=pixels,
            )
        if sample is None:
            continue
        place = ego_pose(offset) @ to_ego
        counts = points_in_boxes(points[:, :3] @ place[:3, :3].T + place[:3, 3], boxes)
        for n, thing in enumerate(THINGS):
            turn = float(np.pi * (thing.speed < 0)) + heading
            writer.add_annotation(
                sample,
                instances[n],
                translation=(street @ [*boxes.centre[n], 1.0])[:3],
                size=boxes.size_wlh[n],
                rotation=yaw_to_quaternion(turn),
                attributes=(thing.attribute,) if thing.attribute else (),
                lidar_points=int(counts[n]),
            )


def ego_pose(offset_us: int) -> F64:
    """Pose [4, 4] of the ego on the street."""
    return upright_pose(EGO_SPEED * offset_us * 1e-6, -1.7, 0.0)


def boxes_at(offset_us: int, ahead: F64) -> WorldBoxes:
    """The boxes on the street; ahead [N]: how far each starts from its usual place, m."""
    sizes = np.array([thing.size for thing in THINGS])
    speed = np.array([thing.speed for thing in THINGS])
    place = np.array([thing.start for thing in THINGS])
    along = place[:, 0] + ahead + speed * offset_us * 1e-6
    centre = np.stack([along, place[:, 1] - 1.7, sizes[:, 2] / 2], axis=1)
    rotation = yaw_to_quaternion(np.pi * (speed < 0))
    return WorldBoxes(centre, sizes, rotation, np.stack([speed, 0 * speed, 0 * speed], axis=1))


def draw(boxes: WorldBoxes, camera: Camera, to_street: F64, grain: F64) -> U8:
    """The picture [H, W, 3] of a camera: sky, a road with marks, and the outlines of the boxes, far ones first."""
    image = np.empty((camera.height, camera.width, 3))
    horizon = round(camera.intrinsic[1, 2])
    image[:horizon] = np.linspace((110, 150, 210), (215, 222, 230), horizon)[:, None]
    rows = np.arange(horizon, camera.height)[:, None] + 0.5
    across = np.arange(camera.width) + 0.5 - camera.intrinsic[0, 2]
    depth = to_street[2, 3] * camera.intrinsic[1, 1] / np.maximum(rows - camera.intrinsic[1, 2], 0.5)
    ray = np.stack([across * depth / camera.intrinsic[0, 0], to_street[2, 3] + 0 * across * depth, depth + 0 * across])
    ground = np.einsum("ij,jvu->ivu", to_street[:2, :3], ray) + to_street[:2, 3, None, None]
    marked = (np.abs(ground[1]) < 0.15) & (ground[0] % 6.0 < 3.0) | (np.abs(np.abs(ground[1]) - 5.5) < 0.15)
    image[horizon:] = np.where(marked[..., None], 220.0, 95.0)
    picture = np.clip(image + grain, 0, 255).astype(np.uint8)
    to_camera = np.linalg.inv(to_street)
    corners = boxes.corners() @ to_camera[:3, :3].T + to_camera[:3, 3]
    for n in np.argsort(-corners[:, :, 2].mean(axis=1), kind="stable"):
        if corners[n, :, 2].min() < 0.3:
            continue
        pixels = (corners[n] @ camera.intrinsic.T)[:, :2] / corners[n][:, 2:]
        hull = cv2.convexHull(np.clip(pixels, -30000, 30000).astype(np.float32))
        cv2.fillConvexPoly(picture, np.floor(hull).astype(np.int32), THINGS[n].colour, cv2.LINE_AA)
    return picture


def sweep(boxes: WorldBoxes, to_street: F64, *, columns: int = 360) -> F32:
    """One turn [P, 5] of a LiDAR with 32 beams in its own frame: x, y, z (m), brightness, ring."""
    azimuth = np.linspace(0.0, 2 * np.pi, columns, endpoint=False)
    elevation = np.radians(np.linspace(-30.0, 10.0, 32))
    ring, column = (grid.ravel() for grid in np.meshgrid(np.arange(32), np.arange(columns), indexing="ij"))
    level = np.cos(elevation[ring])
    local = np.stack([level * np.cos(azimuth[column]), level * np.sin(azimuth[column]), np.sin(elevation[ring])], -1)
    direction, origin = local @ to_street[:3, :3].T, to_street[:3, 3]
    direction = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    ground = np.where(direction[:, 2] < 0, -origin[2] / direction[:, 2], np.inf)
    # all boxes stand along the street: a ray is in one from its last entry of a slab to its first exit
    half = boxes.size_lwh / 2
    sides = [(boxes.centre + sign * half - origin) / direction[:, None] for sign in (-1, 1)]
    entry, leave = np.minimum(*sides).max(axis=2), np.maximum(*sides).min(axis=2)
    met = np.where((entry > 0) & (entry < leave), entry, np.inf).min(axis=1)
    length = np.minimum(ground, met + 1e-3)
    seen = length < 80.0
    brightness = np.where(met < ground, 120.0, 20.0)
    return np.column_stack([local[seen] * length[seen, None], brightness[seen], ring[seen]]).astype(np.float32)

"""Camera poses that look at a target, and tests for a free line of sight between the two.

The camera follows 20 m behind on the target's own route, or stands anywhere around it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ssad.core.frames import Camera
from ssad.core.geometry import obb_distance
from ssad.core.rotations import upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, I32, Bool, EpisodeTrace
from ssad.recorders.nuscenes import ego_at
from ssad.rendering.camera.render import PLAIN, SceneWeather, View, render
from ssad.rendering.camera.scene import RenderScene
from ssad.rendering.scene_objects import ObjectBody, PlacedObject

AIM: Final = 0.8  # m above the road: the middle of a car
MIN_CAMERA_HEIGHT: Final = 1.6  # m, the lowest camera of an orbit
MIN_TRAVEL: Final = 1.0  # m that a target drives at least from one picture to the next
STANDING_SPEED: Final = 1.0  # m/s: slower, a target stands
PROBE: Final = 9  # pixels a side of a look back
CAR_EYE: Final = (1.2, 2.0)  # m above the road: cameras of cars

Place = tuple[float, float, float, float, float]  # x, y, yaw, z, height of what is looked at


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """One image to take.

    Attributes:
        time: Time in the drive, s.
        camera: Pose [4, 4], x right, y down, z forward.
        target: Pose [4, 4].
        weather: Weather and hour.
        description: Distance, m from the target's middle; azimuth, degrees from its front to its left; elevation,
            degrees.
    """

    time: float
    camera: F64
    target: F64
    weather: SceneWeather
    description: dict[str, Any]


def look_at(position: F64, point: F64) -> F64:
    """Return the pose [4, 4] of an upright camera at `position` that looks at `point`.

    The point must not be straight above or below. The axes of the pose are x right, y down, z forward.
    """
    z = (point - position) / np.linalg.norm(point - position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], -1)
    pose[:3, 3] = position
    return pose


def polar(position: F64, target: F64) -> dict[str, float]:
    """Return distance, azimuth and elevation of an eye [3] about the middle of a target of pose [4, 4]."""
    forward, left, height = target[:3, :3].T @ (position - target[:3, 3] - [0.0, 0.0, AIM])
    ground_distance = float(np.hypot(forward, left))
    return {
        "distance": round(float(np.hypot(ground_distance, height)), 2),
        "azimuth": round(float(np.degrees(np.arctan2(left, forward))) % 360.0, 1),
        "elevation": round(float(np.degrees(np.arctan2(height, ground_distance))), 1),
    }


def weather_name(weather: SceneWeather) -> str:
    """Return the name of a drawn weather."""
    if weather.sun_height < 0.0:
        return "night"
    if weather.fog > 0.0 or weather.wet > 0.0:
        return "fog" if weather.fog > 0.0 else "wet"
    if weather.sun_height <= 0.3:
        return "low sun"
    return "overcast" if weather.clouds >= 0.85 else "day"


def following_viewpoints(
    trace: EpisodeTrace, weather: SceneWeather, *, behind: float, height: float, count: int, rng: np.random.Generator
) -> list[Viewpoint]:
    """Every shot of a drive from `behind` m of way behind the driving target, where the target was then, at `height`.

    They are at least `MIN_TRAVEL` m of way apart, and none is taken while the target stands. The first `count` are
    spread over the drive and in its order; the others follow at random.
    """
    travelled = trace.driven.astype(np.float64)
    steps: list[int] = []
    for step in np.flatnonzero((travelled > behind + 0.5) & (trace.speed[:, 0] > STANDING_SPEED)).tolist():
        if not steps or travelled[step] - travelled[steps[-1]] >= MIN_TRAVEL:
            steps.append(step)
    spread_indices = np.unique(np.linspace(0, len(steps) - 1, count).round().astype(int)) if steps else np.zeros(0, int)
    other_indices = rng.permutation(np.setdiff1d(np.arange(len(steps)), spread_indices))
    viewpoints = []
    for step in np.array(steps, int)[np.concatenate([spread_indices, other_indices]).astype(int)].tolist():
        camera_step = float(np.interp(travelled[step] - behind, travelled[: step + 1], np.arange(step + 1)))
        target = ego_at(trace, step * trace.dt)
        camera_position = ego_at(trace, camera_step * trace.dt)[:3, 3] + [0.0, 0.0, height]
        camera_pose = look_at(camera_position, target[:3, 3] + [0.0, 0.0, AIM])
        annotation = polar(camera_position, target) | {"way": round(float(travelled[step]), 2)}
        viewpoints.append(Viewpoint(step * trace.dt, camera_pose, target, weather, annotation))
    return viewpoints


def orbiting_viewpoints(
    trace: EpisodeTrace, weather: SceneWeather, cell: tuple[float, float, float], rng: np.random.Generator
) -> Iterator[Viewpoint]:
    """Without end: shots of one cell (distance m, azimuth and elevation in degrees) at random moments of a drive.

    The camera is nowhere lower than `MIN_CAMERA_HEIGHT`; the target is not quite in the middle of the picture.
    """
    distance, azimuth, elevation = cell
    azimuth_rad = np.radians(azimuth)
    height = max(distance * float(np.sin(np.radians(elevation))), MIN_CAMERA_HEIGHT - AIM)
    ground_distance = float(np.sqrt(max(distance**2 - height**2, 0.01)))
    annotation = {"distance": distance, "azimuth": azimuth, "elevation": elevation}
    while True:
        time = float(rng.uniform(0.5, (len(trace.x) - 2) * trace.dt))
        target = ego_at(trace, time)
        middle = target[:3, 3] + [0.0, 0.0, AIM]
        camera_position = middle + target[:3, :3] @ np.array(
            [ground_distance * np.cos(azimuth_rad), ground_distance * np.sin(azimuth_rad), height]
        )
        aim_point = middle + rng.normal(0, 0.04 * distance, 3).clip(-0.08 * distance, 0.08 * distance) * [1, 1, 0.4]
        yield Viewpoint(time, look_at(camera_position, aim_point), target, weather, annotation)


def sign_viewpoints(
    places: Sequence[Place],
    seconds: float,
    weather: SceneWeather,
    cell: tuple[float, float],
    rng: np.random.Generator,
) -> Iterator[Viewpoint]:
    """Without end: shots of a sign that stands at one place after another, as a car's camera sees it.

    Args:
        places: x, y, yaw (of the way it faces), z of its foot, and the height of the middle of its plate, m.
        seconds: Length of the drive.
        weather: Of the shots.
        cell: Distance (m) from the middle of the plate, azimuth (degrees) from its front to its left.
        rng: Of place, time, height of the camera, and where the sign lies in the picture.

    Yields:
        Shots; elevation is that of the camera about the middle of the plate.
    """
    distance, azimuth = cell
    while True:
        time = float(rng.uniform(0.5, seconds - 0.5))
        x, y, yaw, z, plate_height = places[int(rng.integers(len(places)))]
        target = upright_pose(x, y, yaw, z)
        height = float(rng.uniform(*CAR_EYE))
        aim_offset = rng.normal(0, 0.1 * distance, 3).clip(-0.2 * distance, 0.2 * distance) * [1, 1, 0.5]
        middle = target[:3, 3] + [0.0, 0.0, plate_height]
        height_difference = height - middle[2]
        ground_distance = float(np.sqrt(distance**2 - height_difference**2))
        direction = yaw + np.radians(azimuth)
        camera_position = middle + np.array(
            [ground_distance * np.cos(direction), ground_distance * np.sin(direction), height_difference]
        )
        annotation = {
            "distance": distance,
            "azimuth": azimuth % 360.0,
            "elevation": round(float(np.degrees(np.arctan2(height_difference, ground_distance))), 1),
        }
        yield Viewpoint(time, look_at(camera_position, middle + aim_offset), target, weather, annotation)


def shuffled_cells(numbers: range, count: int, *, key: tuple[object, ...]) -> list[int]:
    """Return the cell of each image by number: all `count` cells in random order before any is repeated."""
    permutations = [
        generator("clips cells", *key, round_index).permutation(count)
        for round_index in range(numbers.stop // count + 1)
    ]
    # It depends on the numbers of the images alone, so that parts can be recorded in any order.
    return [int(permutations[number // count][number % count]) for number in numbers]


def has_room(target: ObjectBody, viewpoint: Viewpoint, nearby_objects: Sequence[PlacedObject]) -> bool:
    """Return whether no object stands in the target or at the camera."""
    camera_position = viewpoint.camera[:3, 3]
    if not nearby_objects:
        return True
    yaws = [
        np.arctan2(pose[1, 0], pose[0, 0]) for pose in (viewpoint.target, *(placed.pose for placed in nearby_objects))
    ]
    boxes = np.array(
        [
            (*placed.pose[:2, 3], yaw, *placed.body.size[:2])
            for placed, yaw in zip(nearby_objects, yaws[1:], strict=True)
        ]
    )
    target_box = np.array([*viewpoint.target[:2, 3], yaws[0], *target.size[:2]])
    is_tall = np.array(
        [placed.pose[2, 3] + placed.body.size[2] + 0.3 > camera_position[2] for placed in nearby_objects]
    )
    camera_distance = obb_distance(np.array([camera_position[0], camera_position[1], 0.0, 0.1, 0.1]), boxes)
    return bool((obb_distance(target_box, boxes) > 0.1).all() and (camera_distance[is_tall] > 0.6).all())


def between(target: ObjectBody, viewpoint: Viewpoint, nearby_objects: Sequence[PlacedObject]) -> Bool:
    """Return whether each object stands between camera and target, [N]: it would hide some of the target's width."""
    way = viewpoint.target[:2, 3] - viewpoint.camera[:2, 3]
    direction = way / np.hypot(*way)
    length = float(np.hypot(*way)) - target.size[0] / 2
    if not nearby_objects or length <= 0.0:
        return np.zeros(len(nearby_objects), np.bool_)
    corridor = np.array(
        [
            *(viewpoint.camera[:2, 3] + 0.5 * length * direction),
            np.arctan2(direction[1], direction[0]),
            length,
            target.size[1],
        ]
    )
    boxes = np.array(
        [
            (*placed.pose[:2, 3], np.arctan2(placed.pose[1, 0], placed.pose[0, 0]), *placed.body.size[:2])
            for placed in nearby_objects
        ]
    )
    return np.asarray(obb_distance(corridor, boxes) <= 0.0)


def has_free_sight(scene: RenderScene, viewpoints: Sequence[Viewpoint], *, batch: int, height: float = 2 * AIM) -> Bool:
    """Return whether nothing of the street lies between target (at a height, m) and camera, [N]: as the target sees it.

    A camera inside a house sees out of it, for walls have one side; who looks at it from outside sees the wall.
    """
    camera = Camera(PROBE, PROBE, np.array([[200.0, 0, PROBE / 2], [0, 200.0, PROBE / 2], [0, 0, 1]]))
    is_free = []
    for batch_start in range(0, len(viewpoints), batch):
        views, distances = [], []
        for viewpoint in viewpoints[batch_start : batch_start + batch]:
            target_point, camera_position = viewpoint.target[:3, 3] + [0.0, 0.0, height], viewpoint.camera[:3, 3]
            distances.append(float(np.linalg.norm(camera_position - target_point)))
            # thick air: objects far beyond the camera need not be drawn
            views.append(
                View(camera, look_at(target_point, camera_position), (), SceneWeather(fog=6.0 / (distances[-1] + 20.0)))
            )
        depth_maps = render(scene, views, scale=1, quality=PLAIN, linear=False).depth
        is_free += [
            bool((depth_map >= distance + 0.3).all()) for depth_map, distance in zip(depth_maps, distances, strict=True)
        ]
    return np.array(is_free, bool)


def near_share(view: View, depth: F32, tag: I32, *, max_distance: float) -> float:
    """Share of a picture's pixels [H, W] that the street covers near the camera.

    Within so many m of it, and without the ground: from half a metre above the road.
    """
    # Every fourth pixel in both directions is enough for a share.
    rows, columns = slice(2, None, 4), slice(2, None, 4)
    is_near = (tag[rows, columns] == 0) & (depth[rows, columns] < max_distance)
    if not is_near.any():
        return 0.0
    intrinsic = view.camera.intrinsic
    y, x = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]] + 0.5
    ray = np.stack(
        [(x - intrinsic[0, 2]) / intrinsic[0, 0], (y - intrinsic[1, 2]) / intrinsic[1, 1], np.ones_like(x)], -1
    )[rows, columns]
    ray_length = np.where(is_near, depth[rows, columns], 0.0)
    height = (ray @ view.pose[2, :3]) * ray_length + view.pose[2, 3]
    return float((is_near & (height > 0.5)).mean())

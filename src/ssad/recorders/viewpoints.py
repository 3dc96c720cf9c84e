"""Where a camera stands that looks at a target car, and whether anything but air lies between the two.

It follows 20 m behind on the target's own way, or stands anywhere around it.
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
from ssad.rendering.camera.render import PLAIN, View, Weather, render
from ssad.rendering.camera.scene import Scene
from ssad.rendering.scene_objects import ObjectBody, PlacedObject

AIM: Final = 0.8  # m above the road: the middle of a car
EYE: Final = 1.6  # m, the lowest camera of an orbit
MOVED: Final = 1.0  # m that a target drives at least from one picture to the next
SLOW: Final = 1.0  # m/s: slower, a target stands
PROBE: Final = 9  # pixels a side of a look back
CAR_EYE: Final = (1.2, 2.0)  # m above the road: cameras of cars

Place = tuple[float, float, float, float, float]  # x, y, yaw, z, height of what is looked at


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """One picture to take.

    Attributes:
        time: s.
        camera: Pose [4, 4], x right, y down, z forward.
        target: Pose [4, 4].
        weather: Weather and hour.
        about: Distance, m from the target's middle; azimuth, degrees from its front to its left; elevation, degrees.
    """

    time: float
    camera: F64
    target: F64
    weather: Weather
    about: dict[str, Any]


def look_at(eye: F64, point: F64) -> F64:
    """Pose [4, 4] of an upright camera at `eye` that looks at `point`, which is not straight above or below.

    Its axes are x right, y down, z forward.
    """
    z = (point - eye) / np.linalg.norm(point - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], -1)
    pose[:3, 3] = eye
    return pose


def polar(eye: F64, target: F64) -> dict[str, float]:
    """Distance, azimuth and elevation of an eye [3] about the middle of a target of pose [4, 4]."""
    ahead, left, up = target[:3, :3].T @ (eye - target[:3, 3] - [0.0, 0.0, AIM])
    flat = float(np.hypot(ahead, left))
    return {
        "distance": round(float(np.hypot(flat, up)), 2),
        "azimuth": round(float(np.degrees(np.arctan2(left, ahead))) % 360.0, 1),
        "elevation": round(float(np.degrees(np.arctan2(up, flat))), 1),
    }


def weather_name(weather: Weather) -> str:
    """What a drawn weather is called."""
    if weather.sun_height < 0.0:
        return "night"
    if weather.fog > 0.0 or weather.wet > 0.0:
        return "fog" if weather.fog > 0.0 else "wet"
    if weather.sun_height <= 0.3:
        return "low sun"
    return "overcast" if weather.clouds >= 0.85 else "day"


def follow(
    trace: EpisodeTrace, weather: Weather, *, behind: float, height: float, count: int, draws: np.random.Generator
) -> list[Viewpoint]:
    """Every shot of a drive from `behind` m of way behind the driving target, where the target was then, at `height`.

    Shots are at least `MOVED` m of way apart, and none is taken while the target stands. The first `count` are spread
    over the drive and in its order; the others follow at random.
    """
    driven = trace.driven.astype(np.float64)
    steps: list[int] = []
    for t in np.flatnonzero((driven > behind + 0.5) & (trace.speed[:, 0] > SLOW)).tolist():
        if not steps or driven[t] - driven[steps[-1]] >= MOVED:
            steps.append(t)
    spread = np.unique(np.linspace(0, len(steps) - 1, count).round().astype(int)) if steps else np.zeros(0, int)
    rest = draws.permutation(np.setdiff1d(np.arange(len(steps)), spread))
    found = []
    for t in np.array(steps, int)[np.concatenate([spread, rest]).astype(int)].tolist():
        before = float(np.interp(driven[t] - behind, driven[: t + 1], np.arange(t + 1)))
        target = ego_at(trace, t * trace.dt)
        eye = ego_at(trace, before * trace.dt)[:3, 3] + [0.0, 0.0, height]
        pose = look_at(eye, target[:3, 3] + [0.0, 0.0, AIM])
        about = polar(eye, target) | {"way": round(float(driven[t]), 2)}
        found.append(Viewpoint(t * trace.dt, pose, target, weather, about))
    return found


def orbit(
    trace: EpisodeTrace, weather: Weather, cell: tuple[float, float, float], draws: np.random.Generator
) -> Iterator[Viewpoint]:
    """Without end: shots of one cell (distance m, azimuth and elevation in degrees) at random moments of a drive.

    The camera is nowhere lower than `EYE`; the target is not quite in the middle of the picture.
    """
    distance, azimuth, elevation = cell
    turn = np.radians(azimuth)
    up = max(distance * float(np.sin(np.radians(elevation))), EYE - AIM)
    flat = float(np.sqrt(max(distance**2 - up**2, 0.01)))
    about = {"distance": distance, "azimuth": azimuth, "elevation": elevation}
    while True:
        time = float(draws.uniform(0.5, (len(trace.x) - 2) * trace.dt))
        target = ego_at(trace, time)
        middle = target[:3, 3] + [0.0, 0.0, AIM]
        eye = middle + target[:3, :3] @ np.array([flat * np.cos(turn), flat * np.sin(turn), up])
        aim = middle + draws.normal(0, 0.04 * distance, 3).clip(-0.08 * distance, 0.08 * distance) * [1, 1, 0.4]
        yield Viewpoint(time, look_at(eye, aim), target, weather, about)


def orbit_sign(
    places: Sequence[Place], seconds: float, weather: Weather, cell: tuple[float, float], draws: np.random.Generator
) -> Iterator[Viewpoint]:
    """Without end: shots of a sign that stands at one place after another, as a car's camera sees it.

    Args:
        places: x, y, yaw (of the way it faces), z of its foot, and the height of the middle of its plate, m.
        seconds: Length of the drive.
        weather: Of the shots.
        cell: Distance (m) from the middle of the plate, azimuth (degrees) from its front to its left.
        draws: Of place, time, height of the camera, and where the sign lies in the picture.

    Yields:
        Shots; elevation is that of the camera about the middle of the plate.
    """
    distance, azimuth = cell
    while True:
        time = float(draws.uniform(0.5, seconds - 0.5))
        x, y, yaw, z, tall = places[int(draws.integers(len(places)))]
        target = upright_pose(x, y, yaw, z)
        height = float(draws.uniform(*CAR_EYE))
        aside = draws.normal(0, 0.1 * distance, 3).clip(-0.2 * distance, 0.2 * distance) * [1, 1, 0.5]
        middle = target[:3, 3] + [0.0, 0.0, tall]
        up = height - middle[2]
        flat = float(np.sqrt(distance**2 - up**2))
        turn = yaw + np.radians(azimuth)
        eye = middle + np.array([flat * np.cos(turn), flat * np.sin(turn), up])
        about = {
            "distance": distance,
            "azimuth": azimuth % 360.0,
            "elevation": round(float(np.degrees(np.arctan2(up, flat))), 1),
        }
        yield Viewpoint(time, look_at(eye, middle + aside), target, weather, about)


def turn_of(numbers: range, count: int, *, key: tuple[object, ...]) -> list[int]:
    """Which of `count` cells pictures show, by number: each cell once, in random order, before any comes again."""
    orders = [generator("clips cells", *key, turn).permutation(count) for turn in range(numbers.stop // count + 1)]
    return [int(orders[n // count][n % count]) for n in numbers]


def has_room(target: ObjectBody, shot: Viewpoint, around: Sequence[PlacedObject]) -> bool:
    """Whether nobody stands in the target or where the camera is."""
    eye = shot.camera[:3, 3]
    if not around:
        return True
    yaw = [np.arctan2(pose[1, 0], pose[0, 0]) for pose in (shot.target, *(s.pose for s in around))]
    boxes = np.array([(*s.pose[:2, 3], turn, *s.body.size[:2]) for s, turn in zip(around, yaw[1:], strict=True)])
    own = np.array([*shot.target[:2, 3], yaw[0], *target.size[:2]])
    low = np.array([s.pose[2, 3] + s.body.size[2] + 0.3 > eye[2] for s in around])
    beside = obb_distance(np.array([eye[0], eye[1], 0.0, 0.1, 0.1]), boxes)
    return bool((obb_distance(own, boxes) > 0.1).all() and (beside[low] > 0.6).all())


def free_sight(stage: Scene, shots: Sequence[Viewpoint], *, at_once: int, height: float = 2 * AIM) -> Bool:
    """Whether nothing of the street lies between target (at a height, m) and camera, [N]: as the target sees it.

    A camera inside a house sees out of it, for walls have one side; who looks at it from outside sees the wall.
    """
    camera = Camera(PROBE, PROBE, np.array([[200.0, 0, PROBE / 2], [0, 200.0, PROBE / 2], [0, 0, 1]]))
    free = []
    for k in range(0, len(shots), at_once):
        views, away = [], []
        for shot in shots[k : k + at_once]:
            start, eye = shot.target[:3, 3] + [0.0, 0.0, height], shot.camera[:3, 3]
            away.append(float(np.linalg.norm(eye - start)))
            # thick air: what lies far beyond the camera need not be drawn
            views.append(View(camera, look_at(start, eye), (), Weather(fog=6.0 / (away[-1] + 20.0))))
        depth = render(stage, views, scale=1, quality=PLAIN, linear=False).depth
        free += [bool((d >= a + 0.3).all()) for d, a in zip(depth, away, strict=True)]
    return np.array(free, bool)


def near_share(view: View, depth: F32, tag: I32, *, within: float) -> float:
    """Share of a picture's pixels [H, W] that the street covers near the camera.

    Within so many m of it, and without the ground: from half a metre above the road.
    """
    rows, columns = slice(2, None, 4), slice(2, None, 4)
    near = (tag[rows, columns] == 0) & (depth[rows, columns] < within)
    if not near.any():
        return 0.0
    k = view.camera.intrinsic
    y, x = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]] + 0.5
    ray = np.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], np.ones_like(x)], -1)[rows, columns]
    away = np.where(near, depth[rows, columns], 0.0)
    height = (ray @ view.pose[2, :3]) * away + view.pose[2, 3]
    return float((near & (height > 0.5)).mean())

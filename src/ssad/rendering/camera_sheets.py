"""Pictures of the camera for the report: who can be seen, in which weather, at which hour, and the six-camera rig."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ssad.core.frames import FORWARD, Camera
from ssad.core.images import captioned, save_picture
from ssad.core.machine import quiet_warp
from ssad.core.rotations import upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F64, U8, LaneType
from ssad.rendering.bodies import BODIES, draw_paint, make_body
from ssad.rendering.bodies.actor_bodies import BODY_CATEGORIES, class_of
from ssad.rendering.camera.lamps import own_lamps
from ssad.rendering.camera.render import View, Weather, render
from ssad.rendering.camera.rig import RIG, rig_camera
from ssad.rendering.camera.scene import Scene, Thing
from ssad.rendering.meshes.mesh import Material, Mesh, build
from ssad.rendering.street import cached_street
from ssad.world.roads import load_town

# styles of a kind of body that the sheet of classes shows, where they are not its first three
SHOWN = {"trailer": ("box", "tank", "utility"), "barrier": ("jersey", "fence", "water")}
WEATHERS = {
    "clear, noon": Weather(1.0, 0.9, 0.2),
    "overcast": Weather(0.7, 0.9, 1.0),
    "low sun": Weather(0.14, 2.6, 0.25),
    "fog": Weather(0.6, 0.9, 0.9, fog=0.02),
    "wet road": Weather(0.5, 3.5, 0.95, wet=1.0),
    "night": Weather(-0.2, 0.0, 0.4),
}


def _floor() -> Mesh:
    """Something to stand on."""
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 60.0
    ground = Material("asphalt", (0.16, 0.16, 0.165), gloss=0.1)
    return build(
        vertices, np.array([[0, 1, 2], [0, 2, 3]]), materials=(ground,), uv=vertices[[[0, 1, 2], [0, 2, 3]]][..., :2]
    )


def class_sheet(width: int = 240) -> U8:
    """The ten classes, one row each kind of body."""
    meshes, cells = [_floor()], []
    for kind in BODY_CATEGORIES:
        for style in SHOWN.get(kind, tuple(BODIES[kind].styles)[:3]):
            meshes.append(make_body(kind, style=style, generator=generator("gallery", kind, style)))
            cells.append((f"{class_of(kind)}: {style}".replace("_", " "), len(meshes) - 1))
    stage = Scene(None, meshes)
    camera = Camera.typical(width * 2, width * 3 // 2)
    views = []
    for number, (_, mesh) in enumerate(cells):
        low, high = meshes[mesh].bounds()
        away = 1.15 * float(np.linalg.norm(high - low)) + 0.6
        yaw = np.radians(-145.0)
        pose = upright_pose(np.cos(yaw + np.pi) * away, np.sin(yaw + np.pi) * away, yaw, 0.45 * away)
        tilt = np.arctan2(0.45 * away - high[2] / 2, away)
        turn = np.array([[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]])
        pose[:3, :3] = pose[:3, :3] @ FORWARD[:3, :3] @ turn
        paint = draw_paint(generator("gallery paint", number))
        views.append(
            View(camera, pose, (Thing(0, np.eye(4)), Thing(mesh, np.eye(4), paint, 1)), Weather(0.8, -1.9, 0.4))
        )
    picture = render(stage, views, scale=3)
    panels = [captioned(image, text, width) for image, (text, _) in zip(picture.image, cells, strict=True)]
    while len(panels) % 6:
        panels.append(np.full_like(panels[0], 255))
    return np.vstack([np.hstack(panels[k : k + 6]) for k in range(0, len(panels), 6)])


def street_scene(town: str = "Twinford") -> tuple[Scene, F64, tuple[Thing, ...]]:
    """A street with traffic: the stage, the pose of the ego, and what stands around it."""
    graph, street = load_town(town), cached_street(town)
    kinds = ("car", "car", "truck", "car", "motorcycle", "car", "bus", "bicycle", "car", "pedestrian")
    meshes = [make_body(kind, generator=generator("gallery street", k)) for k, kind in enumerate(kinds)]
    lanes = [k for k in range(len(graph.kind)) if graph.kind[k] == LaneType.DRIVING and graph.junction[k] < 0]
    start = next(k for k in lanes if graph.s[graph.offset[k + 1] - 1] > 50)
    first = int(graph.offset[start] + 8)
    ego = upright_pose(float(graph.xy[first, 0]), float(graph.xy[first, 1]), float(graph.yaw[first]))
    draws, things = generator("gallery street"), []
    spots = [i for k in lanes for i in range(graph.offset[k] + 2, graph.offset[k + 1], 13)]
    poses = [upright_pose(float(graph.xy[i, 0]), float(graph.xy[i, 1]), float(graph.yaw[i])) for i in spots]
    poses += [upright_pose(float(q[0]), float(q[1]), float(q[2])) for q in street.parking]
    for number, pose in enumerate(poses):
        if 8 < np.hypot(*(pose[:2, 3] - ego[:2, 3])) < 110 and draws.random() < 0.7:
            walker = number % len(kinds) == len(kinds) - 1
            mesh = number % (len(kinds) - 1) if number < len(spots) else (0, 1, 3, 5)[number % 4]
            aside = walker and number < len(spots)  # on the sidewalk
            where = pose @ upright_pose(0.0, -4.2, 0.3) if aside else pose
            things.append(Thing(len(kinds) - 1 if aside else mesh, where, draw_paint(draws), number + 1))
    return Scene(street, meshes), ego, tuple(things)


def weather_sheet(width: int = 480) -> U8:
    """One street in six weathers and hours."""
    stage, ego, things = street_scene()
    camera = rig_camera("CAM_FRONT", 960)
    views = [
        View(camera, ego @ camera.to_ego, things, weather, lamps=own_lamps(ego, weather))
        for weather in WEATHERS.values()
    ]
    images = [render(stage, [view]).image[0] for view in views]
    panels = [captioned(image, name, width) for image, name in zip(images, WEATHERS, strict=True)]
    return np.vstack([np.hstack(panels[k : k + 3]) for k in range(0, len(panels), 3)])


def rig_sheet(width: int = 480) -> U8:
    """The six cameras of the nuScenes rig at one moment."""
    stage, ego, things = street_scene("Crossgate")
    cameras = [rig_camera(channel, 960) for channel in RIG]
    images = [render(stage, [View(c, ego @ c.to_ego, things, Weather(0.8, 2.2, 0.3))]).image[0] for c in cameras]
    panels = [captioned(image, c.channel, width) for image, c in zip(images, cameras, strict=True)]
    return np.vstack([np.hstack(panels[k : k + 3]) for k in range(0, len(panels), 3)])


def write_gallery(folder: Path) -> dict[str, str]:
    """Writes what is missing of the gallery; file name -> caption. StoreError."""
    quiet_warp()
    cv2.setNumThreads(1)
    sheets = {
        "camera-classes.jpg": ("The ten nuScenes classes as the camera knows them.", class_sheet),
        "camera-weather.jpg": ("One street in six weathers and hours.", weather_sheet),
        "camera-rig.jpg": ("The six cameras of the nuScenes rig at one moment.", rig_sheet),
    }
    for name, (_, make) in sheets.items():
        if not (folder / name).is_file():
            save_picture(folder / name, make())
    return {name: caption for name, (caption, _) in sheets.items()}

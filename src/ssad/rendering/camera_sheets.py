"""Sheets of camera images for the report: classes, weathers, hours and the six-camera rig."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ssad.core.frames import FORWARD, Camera
from ssad.core.images import add_caption, save_picture
from ssad.core.machine import start_warp_quietly
from ssad.core.rotations import upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F64, U8, LaneType
from ssad.rendering.bodies import BODIES, draw_paint, make_body
from ssad.rendering.bodies.actor_bodies import BODY_CATEGORIES, class_of, towing_vehicle
from ssad.rendering.bodies.parts import as_point
from ssad.rendering.camera.lamps import own_lamps
from ssad.rendering.camera.render import SceneWeather, View, render
from ssad.rendering.camera.rig import RIG, rig_camera
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.meshes.mesh import Material, Mesh, build
from ssad.rendering.street import cached_street
from ssad.world.roads import load_town

# styles of a kind of body that the sheet of classes shows, where they are not its first three
SHOWN = {"trailer": ("box", "tank", "utility"), "barrier": ("jersey", "fence", "water")}
WEATHERS = {
    "clear, noon": SceneWeather(1.0, 0.9, 0.2),
    "overcast": SceneWeather(0.7, 0.9, 1.0),
    "low sun": SceneWeather(0.14, 2.6, 0.25),
    "fog": SceneWeather(0.6, 0.9, 0.9, fog=0.02),
    "wet road": SceneWeather(0.5, 3.5, 0.95, wet=1.0),
    "night": SceneWeather(-0.2, 0.0, 0.4),
}


def _floor() -> Mesh:
    """Return a square of asphalt, 120 m a side, under the bodies."""
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 60.0
    ground = Material("asphalt", (0.16, 0.16, 0.165), gloss=0.1)
    return build(
        vertices, np.array([[0, 1, 2], [0, 2, 3]]), materials=(ground,), uv=vertices[[[0, 1, 2], [0, 2, 3]]][..., :2]
    )


def class_sheet(width: int = 240) -> U8:
    """Render the ten classes, one row for each kind of body."""
    meshes, captions = [_floor()], []
    towing: dict[int, SceneObject] = {}  # vehicle before a trailer, by the number of the trailer
    for kind in BODY_CATEGORIES:
        for style in SHOWN.get(kind, tuple(BODIES[kind].styles)[:3]):
            meshes.append(make_body(kind, style=style, generator=generator("gallery", kind, style)))
            captions.append((f"{class_of(kind)}: {style}".replace("_", " "), len(meshes) - 1))
            if kind == "trailer":
                lower, upper = meshes[-1].bounds()
                vehicle = towing_vehicle(style, as_point(upper - lower))
                body_draws = generator("gallery", vehicle.kind, vehicle.style)
                meshes.append(make_body(vehicle.kind, style=vehicle.style, size=vehicle.size, generator=body_draws))
                towing[len(meshes) - 2] = SceneObject(len(meshes) - 1, upright_pose(vehicle.ahead, 0.0, 0.0))
    scene = RenderScene(None, meshes)
    camera = Camera.typical(width * 2, width * 3 // 2)
    views = []
    for index, (_, mesh_index) in enumerate(captions):
        lower, upper = meshes[mesh_index].bounds()
        # The distance grows with the body, so that a cone and a bus fill their panels alike.
        camera_distance = 1.15 * float(np.linalg.norm(upper - lower)) + 0.6
        yaw = np.radians(-145.0)
        pose = upright_pose(
            np.cos(yaw + np.pi) * camera_distance, np.sin(yaw + np.pi) * camera_distance, yaw, 0.45 * camera_distance
        )
        tilt = np.arctan2(0.45 * camera_distance - upper[2] / 2, camera_distance)
        tilt_rotation = np.array([[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]])
        pose[:3, :3] = pose[:3, :3] @ FORWARD[:3, :3] @ tilt_rotation
        paint = draw_paint(generator("gallery paint", index))
        vehicles = (towing[mesh_index],) if mesh_index in towing else ()
        views.append(
            View(
                camera,
                pose,
                (SceneObject(0, np.eye(4)), SceneObject(mesh_index, np.eye(4), paint, 1), *vehicles),
                SceneWeather(0.8, -1.9, 0.4),
            )
        )
    rendering = render(scene, views, scale=3)
    panels = [add_caption(image, caption, width) for image, (caption, _) in zip(rendering.image, captions, strict=True)]
    # White panels complete the last row of six.
    while len(panels) % 6:
        panels.append(np.full_like(panels[0], 255))
    return np.vstack([np.hstack(panels[start : start + 6]) for start in range(0, len(panels), 6)])


def street_scene(town: str = "Twinford") -> tuple[RenderScene, F64, tuple[SceneObject, ...]]:
    """Build a street with traffic.

    Returns:
        The scene, the pose [4, 4] of the ego, and the objects around it.
    """
    graph, street = load_town(town), cached_street(town)
    kinds = ("car", "car", "truck", "car", "motorcycle", "car", "bus", "bicycle", "car", "pedestrian")
    meshes = [make_body(kind, generator=generator("gallery street", index)) for index, kind in enumerate(kinds)]
    road_lanes = [
        index for index in range(len(graph.kind)) if graph.kind[index] == LaneType.DRIVING and graph.junction[index] < 0
    ]
    # More than 50 m of lane leave room for traffic ahead of the ego.
    start = next(index for index in road_lanes if graph.s[graph.offset[index + 1] - 1] > 50)
    start_vertex = int(graph.offset[start] + 8)
    ego = upright_pose(
        float(graph.xy[start_vertex, 0]), float(graph.xy[start_vertex, 1]), float(graph.yaw[start_vertex])
    )
    rng, scene_objects = generator("gallery street"), []
    lane_vertices = [
        vertex for index in road_lanes for vertex in range(graph.offset[index] + 2, graph.offset[index + 1], 13)
    ]
    poses = [
        upright_pose(float(graph.xy[vertex, 0]), float(graph.xy[vertex, 1]), float(graph.yaw[vertex]))
        for vertex in lane_vertices
    ]
    poses += [
        upright_pose(float(parking_place[0]), float(parking_place[1]), float(parking_place[2]))
        for parking_place in street.parking
    ]
    for place_index, pose in enumerate(poses):
        if 8 < np.hypot(*(pose[:2, 3] - ego[:2, 3])) < 110 and rng.random() < 0.7:
            plays_walker = place_index % len(kinds) == len(kinds) - 1
            mesh_index = (
                place_index % (len(kinds) - 1) if place_index < len(lane_vertices) else (0, 1, 3, 5)[place_index % 4]
            )
            on_sidewalk = plays_walker and place_index < len(lane_vertices)  # on the sidewalk
            placement = pose @ upright_pose(0.0, -4.2, 0.3) if on_sidewalk else pose
            scene_objects.append(
                SceneObject(len(kinds) - 1 if on_sidewalk else mesh_index, placement, draw_paint(rng), place_index + 1)
            )
    return RenderScene(street, meshes), ego, tuple(scene_objects)


def weather_sheet(width: int = 480) -> U8:
    """Render one street in six weathers and hours."""
    scene, ego, scene_objects = street_scene()
    camera = rig_camera("CAM_FRONT", 960)
    views = [
        View(camera, ego @ camera.to_ego, scene_objects, weather, lamps=own_lamps(ego, weather))
        for weather in WEATHERS.values()
    ]
    images = [render(scene, [view]).image[0] for view in views]
    panels = [add_caption(image, name, width) for image, name in zip(images, WEATHERS, strict=True)]
    return np.vstack([np.hstack(panels[start : start + 3]) for start in range(0, len(panels), 3)])


def rig_sheet(width: int = 480) -> U8:
    """Render the six cameras of the nuScenes rig at one moment."""
    scene, ego, scene_objects = street_scene("Crossgate")
    cameras = [rig_camera(channel, 960) for channel in RIG]
    images = [
        render(scene, [View(camera, ego @ camera.to_ego, scene_objects, SceneWeather(0.8, 2.2, 0.3))]).image[0]
        for camera in cameras
    ]
    panels = [add_caption(image, camera.channel, width) for image, camera in zip(images, cameras, strict=True)]
    return np.vstack([np.hstack(panels[start : start + 3]) for start in range(0, len(panels), 3)])


def write_gallery(folder: Path) -> dict[str, str]:
    """Write the missing sheets of the gallery.

    Returns:
        Captions by file name.

    Raises:
        StoreError: A file cannot be written.
    """
    start_warp_quietly()
    cv2.setNumThreads(1)
    sheets = {
        "camera-classes.jpg": ("The ten nuScenes classes as the camera knows them.", class_sheet),
        "camera-weather.jpg": ("One street in six weathers and hours.", weather_sheet),
        "camera-rig.jpg": ("The six cameras of the nuScenes rig at one moment.", rig_sheet),
    }
    for name, (_, render_sheet) in sheets.items():
        if not (folder / name).is_file():
            save_picture(folder / name, render_sheet())
    return {name: caption for name, (caption, _) in sheets.items()}

"""`ssad show`: a page for browsing a data set in the nuScenes schema: pictures with boxes, and LiDAR from above."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np

from ssad.core.errors import ConfigError, SSADError
from ssad.core.images import save_picture
from ssad.core.nuscenes_names import CATEGORY_TO_CLASS
from ssad.core.rotations import quaternion_to_matrix
from ssad.core.safeio import make_folder, write_atomic
from ssad.core.types import F64, U8
from ssad.core.wording import counted
from ssad.datasets.drawing import draw_edges
from ssad.datasets.nuscenes.camera_truth import boxes_in_picture
from ssad.datasets.nuscenes.files import read_frame_image, read_frame_points
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import Annotations, SceneData, SensorFrame

WIDTH, VIEW_RANGE, VIEW_SIZE = (
    640,
    50.0,
    640,
)  # width of a picture, pixels; range of the view from above, m, and its size, pixels
BOX, GROUND, EGO = (255, 170, 30), (15, 19, 26), (96, 165, 250)
ORDER = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT")
MIN_HEIGHT, MAX_HEIGHT = -0.5, 3.0  # m above the road: the ends of the colours of LiDAR points

STYLE = """:root{color-scheme:light dark}
body{font:15px/1.5 system-ui,sans-serif;margin:0 auto;padding:0 16px 40px;max-width:1400px}
h1{font-size:24px;overflow-wrap:anywhere}h2{font-size:18px;margin-top:36px}p,figcaption{color:GrayText}
nav{display:flex;flex-wrap:wrap;gap:6px 14px}.grid{display:grid;grid-template-columns:repeat(3,1fr);gap:6px}
figure{margin:0}img{width:100%;height:auto;display:block;border-radius:6px}.above{max-width:640px;margin-top:6px}
@media(max-width:700px){.grid{grid-template-columns:1fr}}
"""
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ name }}</title><style>{{ style }}</style></head><body>
<h1>{{ name }}</h1>
<p>Version {{ version }}: {{ total }} scenes, of which {{ scenes|length }} are shown, {{ per }} moments of each at most.
Boxes are those of the annotation table, the ten classes of the detection task in the pictures and everything from
above, where a line points ahead and points are coloured by their height.</p>
<nav>{% for s in scenes %}<a href="#s{{ loop.index }}">{{ s.name }}</a>{% endfor %}</nav>
{% for s in scenes %}
<h2 id="s{{ loop.index }}">{{ s.name }}</h2>
<p>{{ s.about }}{% if s.counts %} Objects: {% for k, v in s.counts %}{{ k }} {{ v }}{{ ", " if not loop.last }}{% endfor %}.{% endif %}</p>
{% for m in s.moments %}
<p>{{ m.title }}</p>
<div class="grid">{% for p in m.pictures %}<figure><img loading="lazy" src="pictures/{{ p.file }}" alt="{{ p.title }}" width="{{ p.size[0] }}" height="{{ p.size[1] }}"><figcaption>{{ p.title }}</figcaption></figure>{% endfor %}</div>
{% if m.above %}<figure class="above"><img loading="lazy" src="pictures/{{ m.above }}" alt="LiDAR from above" width="{{ side }}" height="{{ side }}"><figcaption>LiDAR from above, {{ reach }} m to each side</figcaption></figure>{% endif %}
{% endfor %}{% endfor %}
</body></html>
"""  # noqa: E501


def write_page(
    data: NuScenes,
    out: Path,
    *,
    scenes: Sequence[str] = (),
    moments: int = 3,
    progress: Callable[[int, int], None] = lambda completed, total: None,
) -> Path:
    """Write OUT/index.html and its pictures.

    Args:
        data: The data set.
        out: Output folder.
        scenes: Names of the scenes; none: the first ten.
        moments: Largest number of samples shown of each scene, spread over its length.
        progress: Called with the number of finished scenes and of all scenes.

    Returns:
        Path of the page.

    Raises:
        ConfigError: A scene does not exist.
        FormatError: The tables are broken. An unreadable picture or sweep is named on the page instead.
        StoreError: A file cannot be written.
    """
    names = list(scenes) or [scene.name for scene in data.scenes()][:10]
    make_folder(out / "pictures")
    scene_entries = []
    for index, name in enumerate(names):
        scene_entries.append(_write_scene(data.root, data.scene(name), out / "pictures", moments))
        progress(index + 1, len(names))
    page = (
        jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
        .from_string(PAGE)
        .render(
            name=data.root.name,
            style=STYLE,
            version=data.version,
            total=len(data.scenes()),
            scenes=scene_entries,
            per=moments,
            side=VIEW_SIZE,
            reach=f"{VIEW_RANGE:.0f}",
        )
    )
    write_atomic(out / "index.html", page)
    return out / "index.html"


def _write_scene(root: Path, scene: SceneData, folder: Path, moments: int) -> dict[str, Any]:
    """Write the pictures of a scene, and return its entry of the page."""
    sample_indices = np.unique(
        np.linspace(0, len(scene.samples) - 1, min(moments, len(scene.samples))).round().astype(int)
    )
    # The counts are those of the whole scene, not only of the samples shown.
    counts: Counter[str] = Counter()
    for sample in scene.samples:
        counts.update(
            CATEGORY_TO_CLASS.get(category) or category for category in scene.annotations(sample.token).category
        )
    moment_entries = []
    for sample_index in sample_indices:
        token = scene.samples[sample_index].token
        boxes = scene.annotations(token)
        frames = {frame.channel: frame for frame in scene.frames if frame.sample_token == token and frame.key_frame}
        file_stem = f"{re.sub(r'[^A-Za-z0-9_-]', '-', scene.record.name)}-{sample_index:03d}"
        pictures = []
        for channel in [*ORDER, *sorted(set(frames) - set(ORDER))]:
            if channel in frames and frames[channel].modality == "camera":
                pictures.append(
                    _write_camera_image(root, frames[channel], boxes, folder / f"{file_stem}-{channel}.jpg")
                )
        lidar = next((frame for frame in frames.values() if frame.modality == "lidar"), None)
        view_name = ""
        if lidar is not None:
            view_name = f"{file_stem}-above.jpg"
            save_picture(folder / view_name, draw_top_view(root, lidar, boxes))
        seconds = (scene.samples[sample_index].timestamp - scene.samples[0].timestamp) / 1e6
        moment_entries.append(
            {"title": f"{seconds:.1f} s, {counted(len(boxes), 'box')}", "pictures": pictures, "above": view_name}
        )
    description = scene.record.description.rstrip(". ")
    summary = f"{description}. {counted(len(scene.samples), 'sample')}.".lstrip(". ")
    return {"name": scene.record.name, "about": summary, "counts": counts.most_common(), "moments": moment_entries}


def _write_camera_image(root: Path, frame: SensorFrame, annotations: Annotations, path: Path) -> dict[str, Any]:
    """A picture with its boxes; one that cannot be read says why."""
    title = frame.channel
    try:
        image = read_frame_image(root, frame)
    except SSADError as error:
        image, title = np.zeros((WIDTH * 9 // 16, WIDTH, 3), np.uint8), f"{title}: {error}"
    scale = WIDTH / image.shape[1]
    canvas: U8 = np.asarray(cv2.resize(image, (WIDTH, round(image.shape[0] * scale)), interpolation=cv2.INTER_AREA))
    rows, _, world_to_camera = boxes_in_picture(frame, annotations, require_points=False)
    corners = annotations.take(rows).corners() @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    draw_edges(canvas, corners, np.asarray(frame.intrinsic, np.float64), scale, colour=BOX, width=1)
    save_picture(path, canvas)
    return {"file": path.name, "title": title, "size": (canvas.shape[1], canvas.shape[0])}


def draw_top_view(root: Path, lidar: SensorFrame, annotations: Annotations) -> U8:
    """LiDAR points and boxes around the ego, which looks up; points are coloured by their height.

    Args:
        root: The nuScenes root.
        lidar: A sweep.
        annotations: Boxes of its sample.

    Returns:
        Picture [VIEW_SIZE, VIEW_SIZE, 3], RGB.
    """
    canvas: U8 = np.full((VIEW_SIZE, VIEW_SIZE, 3), GROUND, np.uint8)
    try:
        sensor_points = read_frame_points(root, lidar)[:, :3].astype(np.float64)
    except SSADError:
        sensor_points = np.zeros((0, 3))
    draw_points(canvas, sensor_points @ lidar.sensor_to_ego[:3, :3].T + lidar.sensor_to_ego[:3, 3])
    world_to_ego = np.linalg.inv(lidar.ego_to_world)
    if len(annotations):
        axes = world_to_ego[:3, :3] @ quaternion_to_matrix(annotations.rotation)
        centres = annotations.centre @ world_to_ego[:3, :3].T + world_to_ego[:3, 3]
        half_size = 0.5 * annotations.size_lwh
        corner_signs = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
        corners = centres[:, None] + np.einsum("nij,nkj->nki", axes, corner_signs * half_size[:, None])
        front = centres + np.einsum("nij,nj->ni", axes, half_size * (1, 0, 0))
        # OpenCV takes fixed-point coordinates: 4 fractional bits, hence the factor 16.
        for outline, centre_pixel, front_pixel in zip(
            _to_pixels(corners), _to_pixels(centres), _to_pixels(front), strict=True
        ):
            cv2.polylines(canvas, [np.round(outline * 16).astype(np.int32)], True, BOX, 1, cv2.LINE_AA, 4)
            endpoints = [
                tuple(int(coordinate) for coordinate in np.round(pixel * 16)) for pixel in (centre_pixel, front_pixel)
            ]
            cv2.line(canvas, endpoints[0], endpoints[1], BOX, 1, cv2.LINE_AA, 4)
    cv2.drawMarker(canvas, (VIEW_SIZE // 2, VIEW_SIZE // 2), EGO, cv2.MARKER_TRIANGLE_UP, 14, 2)
    return canvas


def draw_points(canvas: U8, points: F64, *, road_height: float = 0.0) -> None:
    """Draw points from above, coloured by their height.

    Args:
        canvas: Picture [VIEW_SIZE, VIEW_SIZE, 3], RGB, which is changed; x points up and y to the left.
        points: [P, 3], m.
        road_height: z of the road, m.
    """
    points = points[(np.abs(points[:, :2]) < VIEW_RANGE).all(1)]
    height_levels = np.clip((points[:, 2] - road_height - MIN_HEIGHT) / (MAX_HEIGHT - MIN_HEIGHT), 0, 1) * 255
    if len(points):
        pixels = np.clip(_to_pixels(points), 0, VIEW_SIZE - 1).astype(int)
        colours = cv2.applyColorMap(height_levels.astype(np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)
        canvas[pixels[:, 1], pixels[:, 0]] = colours[:, 0, ::-1]


def _to_pixels(points: F64) -> F64:
    """Convert points of the ego frame (x forward, y left) to pixels (x forward is up)."""
    pixels = VIEW_SIZE / 2 - np.asarray(points)[..., :2] * (VIEW_SIZE / 2 / VIEW_RANGE)
    return np.asarray(pixels[..., ::-1], np.float64)


def check_scenes(data: NuScenes, names: Sequence[str]) -> None:
    """Raise ConfigError for a data set without scenes, or for an unknown scene name, before anything is written."""
    if not data.scenes():
        raise ConfigError(f"{data.root / data.version}: it has no scene")
    for name in names:
        data.scene(name)

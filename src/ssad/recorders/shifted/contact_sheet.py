"""Contact sheets: one image under all shifts, and every shift at all severities.

The image is a camera image of a dataset, whose boxes, pose and LiDAR are known, or any image of the user's own,
with a typical camera; its objects then are boxes that the user names in the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ssad.core.boxes import TrackedBoxes
from ssad.core.columns import concatenate
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera, Frame, SceneContext, camera_to_world
from ssad.core.images import add_caption, read_image, save_picture
from ssad.core.machine import start_warp_quietly
from ssad.core.types import U8
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.scenarios.static.shifts import SEVERITIES, SHIFTS, Calibration, ShiftSpec, shift_images, viewing_direction
from ssad.scenarios.static.shifts.scene_shifter import SceneShifter
from ssad.scenarios.static.shifts.sun import choose_sun


def box_at(camera: Camera, rectangle: Sequence[float]) -> TrackedBoxes:
    """Return a 3D box for a rectangle in the image of a level camera.

    The box stands on the road at the lower edge of the rectangle, faces the camera, and its depth is 1.6 times its
    width.

    Args:
        camera: The camera; it must look horizontally.
        rectangle: x0, y0, x1, y1 in pixels.

    Returns:
        One box, which drives away slightly to the left.

    Raises:
        ConfigError: The rectangle is narrower or lower than 4 pixels, or does not end below the horizon.
    """
    x0, y0, x1, y1 = map(float, rectangle)
    intrinsic = camera.intrinsic
    height = float(camera.to_ego[2, 3])
    slope = (y1 - intrinsic[1, 2]) / intrinsic[1, 1]
    if x1 - x0 < 4 or y1 - y0 < 4 or slope < 0.005:
        raise ConfigError(f"box {x0:g},{y0:g},{x1:g},{y1:g}: it must end below the horizon (y = {intrinsic[1, 2]:.0f})")
    near_depth = height / slope
    width, box_height = (x1 - x0) / intrinsic[0, 0] * near_depth, (y1 - y0) / intrinsic[1, 1] * near_depth
    depth = 1.6 * width
    lateral = ((x0 + x1) / 2 - intrinsic[0, 2]) / intrinsic[0, 0] * near_depth
    centre = camera.to_ego @ np.array([lateral, height - box_height / 2, near_depth + depth / 2, 1.0])
    size_lwh = np.array([[depth, width, box_height]])
    rotation = np.array([[1.0, 0, 0, 0]])
    # drives away a little to the left, so that there is something to blur
    velocity = np.array([[2.0, 4.0, 0.0]])
    return TrackedBoxes(centre[None, :3], size_lwh, rotation, velocity, (f"box {x0:g},{y0:g}",), np.ones(1))


def assumed_frame(image: U8, rectangles: Sequence[Sequence[float]] = ()) -> Frame:
    """Return the assumed frame of a user's image [H, W, 3]."""
    camera = Camera.typical(image.shape[1], image.shape[0])
    boxes_list = [box_at(camera, rectangle) for rectangle in rectangles]
    frame = Frame(camera, "picture", "picture", 3.0)
    if not boxes_list:
        return frame
    return replace(frame, boxes=concatenate(boxes_list))


def pick_frame(
    data: NuScenes, *, channel: str = "CAM_FRONT", scene: str | None = None, seed: int = 0
) -> tuple[U8, Frame, SceneContext]:
    """The key frame of a camera that shows most boxes in full.

    Args:
        data: The dataset.
        channel: Name of the camera.
        scene: Name of the scene; None: the first.
        seed: Seed of the sun's position.

    Returns:
        Image [H, W, 3], its frame, and its scene.

    Raises:
        ConfigError: There is no such scene or camera.
    """
    scene_data = data.scene(data.scenes()[0].token if scene is None else scene)
    shifter = SceneShifter(data.root, scene_data, ShiftSpec("scale", 3))
    frames = [candidate for candidate in scene_data.frames if candidate.channel == channel and candidate.key_frame]
    if not frames:
        channels = sorted({candidate.channel for candidate in scene_data.frames if candidate.modality == "camera"})
        raise ConfigError(f"{data.root}: no camera {channel}; there are: {', '.join(channels)}")
    best_frame = max(frames, key=lambda candidate: _total_box_height(shifter.camera_frame(candidate)))
    fog_shifter = SceneShifter(data.root, scene_data, ShiftSpec("fog", 3))
    camera_view = shifter.camera_frame(best_frame)
    lidar_frame, image = fog_shifter.camera_frame(best_frame), shifter.read(best_frame)
    # the sun stands over the ego's heading by default; here, over the view of this camera
    context = replace(fog_shifter.context, heading=viewing_direction(camera_view))
    context = replace(context, sun=choose_sun(ShiftSpec("sunlight", 3, seed), context, [(lidar_frame, image)]))
    return image, replace(camera_view, points=lidar_frame.points, depth=lidar_frame.depth), context


def _total_box_height(frame: Frame) -> float:
    """Return the sum of the apparent heights of the boxes, in pixels, at most 300 each."""
    world_to_camera = np.linalg.inv(camera_to_world(frame))
    centres = frame.boxes.centre @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    intrinsic = frame.camera.intrinsic
    depth = np.maximum(centres[:, 2], 0.1)
    columns, rows = (
        intrinsic[0, 0] * centres[:, 0] / depth + intrinsic[0, 2],
        intrinsic[1, 1] * centres[:, 1] / depth + intrinsic[1, 2],
    )
    is_inside = (
        (centres[:, 2] > 4) & (columns > 0) & (columns < frame.camera.width) & (rows > 0) & (rows < frame.camera.height)
    )
    return float(np.minimum(intrinsic[1, 1] * frame.boxes.size_lwh[:, 2] / depth, 300)[is_inside].sum())


def contact_sheet(
    image: U8,
    frame: Frame,
    *,
    context: SceneContext | None = None,
    severity: int = 3,
    seed: int = 0,
    calibration: Calibration = "physical",
    shifts: Sequence[str] = tuple(SHIFTS),
    width: int = 480,
) -> U8:
    """The clean picture and the shifts in three columns, as in the paper's figure of all 11: [rows, columns, 3]."""
    panels = [add_caption(image, "clean", width)]
    for name in shifts:
        spec = ShiftSpec(name, severity, seed, calibration)
        panels.append(add_caption(*_shift_with_caption(image, frame, spec, context), width))
    panels += [np.full_like(panels[0], 255)] * (-len(panels) % 3)
    return np.vstack([np.hstack(panels[start : start + 3]) for start in range(0, len(panels), 3)])


def severity_sheet(
    image: U8,
    frame: Frame,
    *,
    context: SceneContext | None = None,
    seed: int = 0,
    calibration: Calibration = "physical",
    shifts: Sequence[str] = tuple(SHIFTS),
    width: int = 300,
) -> U8:
    """Draw one row per shift, severities 1 to 5 from left to right."""
    rows = []
    for name in shifts:
        specs = [ShiftSpec(name, severity, seed, calibration) for severity in SEVERITIES]
        cells = [_shift_with_caption(image, frame, spec, context) for spec in specs]
        captioned_cells = [
            (panel, text or f"{name} {spec.severity}") for (panel, text), spec in zip(cells, specs, strict=True)
        ]
        rows.append(np.hstack([add_caption(panel, text, width) for panel, text in captioned_cells]))
    return np.vstack(rows)


def _shift_with_caption(image: U8, frame: Frame, spec: ShiftSpec, context: SceneContext | None) -> tuple[U8, str]:
    """Return a shifted image and its caption, which states why a shift was not applied."""
    contexts = {context.scene: context} if context is not None else None
    shifted_image, applied = shift_images(image, frame, spec, contexts=contexts)
    caption = f"{spec.name.replace('_', ' ')} {spec.severity}"
    if not applied[0].applied:
        reason = next(iter(applied[0].skipped), "no 3D boxes in this picture")
        caption += f": not applied ({reason})"
    return shifted_image, caption


def write_sheets(
    source: Path,
    out: Path,
    *,
    version: str | None = None,
    channel: str = "CAM_FRONT",
    scene: str | None = None,
    boxes: Sequence[Sequence[float]] = (),
    severity: int = 3,
    seed: int = 0,
    calibration: Calibration = "physical",
    shifts: Sequence[str] = tuple(SHIFTS),
) -> tuple[Path, Path]:
    """Both sheets of a picture or of a nuScenes folder: OUT, and beside it OUT with "-severities" in its name."""
    start_warp_quietly()
    context: SceneContext | None = None
    if source.is_dir():
        image, frame, context = pick_frame(NuScenes(source, version), channel=channel, scene=scene, seed=seed)
    else:
        image = read_image(source)
        frame = assumed_frame(image, boxes)
    severities_path = out.with_name(f"{out.stem}-severities{out.suffix}")
    sheet = contact_sheet(
        image, frame, context=context, severity=severity, seed=seed, calibration=calibration, shifts=shifts
    )
    save_picture(out, sheet)
    severities_image = severity_sheet(image, frame, context=context, seed=seed, calibration=calibration, shifts=shifts)
    save_picture(severities_path, severities_image)
    return out, severities_path


def parse_box(text: str) -> tuple[float, ...]:
    """Parse four numbers from the text x0,y0,x1,y1.

    Raises:
        ConfigError: The text has another form.
    """
    try:
        numbers = tuple(float(number_text) for number_text in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 4 or not np.isfinite(numbers).all():
        raise ConfigError(f"--box {text}: expected x0,y0,x1,y1 in pixels")
    return numbers

"""Contact sheets: one picture under all shifts, and every shift at all severities.

For a camera image of a dataset, whose boxes, pose and LiDAR are known, or for any picture of the user's own, for which
a typical camera is assumed; objects then are boxes that the user names in the picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ssad.core.boxes import TrackedBoxes
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera, Frame, SceneContext, camera_to_world
from ssad.core.images import captioned, read_image, save_picture
from ssad.core.machine import quiet_warp
from ssad.core.types import U8
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.scenarios.static.shifts import SEVERITIES, SHIFTS, Calibration, ShiftSpec, shift_images, viewing_direction
from ssad.scenarios.static.shifts.scene_shifter import SceneShifter
from ssad.scenarios.static.shifts.sun import choose_sun


def box_at(camera: Camera, rectangle: Sequence[float]) -> TrackedBoxes:
    """A 3D box for a rectangle in the picture of a level camera.

    The box stands on the road where the rectangle ends, faces the camera, and its depth is 1.6 times its width.

    Args:
        camera: The camera; it must look horizontally.
        rectangle: x0, y0, x1, y1 in pixels.

    Returns:
        One box, which drives away slightly to the left.

    Raises:
        ConfigError: The rectangle is narrower or lower than 4 pixels, or does not end below the horizon.
    """
    x0, y0, x1, y1 = map(float, rectangle)
    k = camera.intrinsic
    height = float(camera.to_ego[2, 3])
    drop = (y1 - k[1, 2]) / k[1, 1]
    if x1 - x0 < 4 or y1 - y0 < 4 or drop < 0.005:
        raise ConfigError(f"box {x0:g},{y0:g},{x1:g},{y1:g}: it must end below the horizon (y = {k[1, 2]:.0f})")
    near = height / drop
    wide, tall = (x1 - x0) / k[0, 0] * near, (y1 - y0) / k[1, 1] * near
    deep = 1.6 * wide
    across = ((x0 + x1) / 2 - k[0, 2]) / k[0, 0] * near
    place = camera.to_ego @ np.array([across, height - tall / 2, near + deep / 2, 1.0])
    size_lwh = np.array([[deep, wide, tall]])
    rotation = np.array([[1.0, 0, 0, 0]])
    # drives away a little to the left, so that there is something to blur
    velocity = np.array([[2.0, 4.0, 0.0]])
    return TrackedBoxes(place[None, :3], size_lwh, rotation, velocity, (f"box {x0:g},{y0:g}",), np.ones(1))


def own_frame(image: U8, rectangles: Sequence[Sequence[float]] = ()) -> Frame:
    """What is assumed of a picture [H, W, 3] of the user's own."""
    camera = Camera.typical(image.shape[1], image.shape[0])
    found = [box_at(camera, rectangle) for rectangle in rectangles]
    frame = Frame(camera, "picture", "picture", 3.0)
    if not found:
        return frame
    columns = {
        n: np.concatenate([getattr(b, n) for b in found]) for n in ("centre", "size_lwh", "rotation", "velocity")
    }
    boxes = TrackedBoxes(**columns, instance=tuple(b.instance[0] for b in found), visible=np.ones(len(found)))
    return replace(frame, boxes=boxes)


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
    chosen = data.scene(data.scenes()[0].token if scene is None else scene)
    shifter = SceneShifter(data.root, chosen, ShiftSpec("scale", 3))
    frames = [f for f in chosen.frames if f.channel == channel and f.key_frame]
    if not frames:
        known = sorted({f.channel for f in chosen.frames if f.modality == "camera"})
        raise ConfigError(f"{data.root}: no camera {channel}; there are: {', '.join(known)}")
    best = max(frames, key=lambda f: _in_view(shifter.camera_frame(f)))
    weather = SceneShifter(data.root, chosen, ShiftSpec("fog", 3))
    view = shifter.camera_frame(best)
    seen, image = weather.camera_frame(best), shifter.read(best)
    # the sun stands over where the ego goes; here, over what this camera sees
    context = replace(weather.context, heading=viewing_direction(view))
    context = replace(context, sun=choose_sun(ShiftSpec("sunlight", 3, seed), context, [(seen, image)]))
    return image, replace(view, points=seen.points, depth=seen.depth), context


def _in_view(frame: Frame) -> float:
    """How much there is to see of the boxes: the sum of their apparent heights, in pixels, at most 300 each."""
    local = np.linalg.inv(camera_to_world(frame))
    points = frame.boxes.centre @ local[:3, :3].T + local[:3, 3]
    k = frame.camera.intrinsic
    z = np.maximum(points[:, 2], 0.1)
    x, y = k[0, 0] * points[:, 0] / z + k[0, 2], k[1, 1] * points[:, 1] / z + k[1, 2]
    inside = (points[:, 2] > 4) & (x > 0) & (x < frame.camera.width) & (y > 0) & (y < frame.camera.height)
    return float(np.minimum(k[1, 1] * frame.boxes.size_lwh[:, 2] / z, 300)[inside].sum())


def contact_sheet(
    image: U8,
    frame: Frame,
    *,
    context: SceneContext | None = None,
    severity: int = 3,
    seed: int = 0,
    calibration: Calibration = "physical",
    width: int = 480,
) -> U8:
    """The clean picture and the 11 shifts, 12 panels in three columns as in the paper's figure: [rows, columns, 3]."""
    panels = [captioned(image, "clean", width)]
    for name in SHIFTS:
        spec = ShiftSpec(name, severity, seed, calibration)
        panels.append(captioned(*_shifted(image, frame, spec, context), width))
    return np.vstack([np.hstack(panels[k : k + 3]) for k in range(0, len(panels), 3)])


def severity_sheet(
    image: U8,
    frame: Frame,
    *,
    context: SceneContext | None = None,
    seed: int = 0,
    calibration: Calibration = "physical",
    width: int = 300,
) -> U8:
    """One row a shift, severities 1 to 5 from left to right."""
    rows = []
    for name in SHIFTS:
        specs = [ShiftSpec(name, severity, seed, calibration) for severity in SEVERITIES]
        cells = [_shifted(image, frame, spec, context) for spec in specs]
        named = [
            (picture, text or f"{name} {spec.severity}") for (picture, text), spec in zip(cells, specs, strict=True)
        ]
        rows.append(np.hstack([captioned(picture, text, width) for picture, text in named]))
    return np.vstack(rows)


def _shifted(image: U8, frame: Frame, spec: ShiftSpec, context: SceneContext | None) -> tuple[U8, str]:
    """A shifted picture and its caption; a shift that did nothing says why."""
    contexts = {context.scene: context} if context is not None else None
    out, done = shift_images(image, frame, spec, contexts=contexts)
    caption = f"{spec.name.replace('_', ' ')} {spec.severity}"
    if not done[0].applied:
        reason = next(iter(done[0].skipped), "no 3D boxes in this picture")
        caption += f": not applied ({reason})"
    return out, caption


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
) -> tuple[Path, Path]:
    """Both sheets of a picture or of a nuScenes folder: OUT, and beside it OUT with "-severities" in its name."""
    quiet_warp()
    context: SceneContext | None = None
    if source.is_dir():
        image, frame, context = pick_frame(NuScenes(source, version), channel=channel, scene=scene, seed=seed)
    else:
        image = read_image(source)
        frame = own_frame(image, boxes)
    second = out.with_name(f"{out.stem}-severities{out.suffix}")
    sheet = contact_sheet(image, frame, context=context, severity=severity, seed=seed, calibration=calibration)
    save_picture(out, sheet)
    save_picture(second, severity_sheet(image, frame, context=context, seed=seed, calibration=calibration))
    return out, second


def parse_box(text: str) -> tuple[float, ...]:
    """Four numbers from the text x0,y0,x1,y1.

    Raises:
        ConfigError: The text is something else.
    """
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) != 4 or not np.isfinite(found).all():
        raise ConfigError(f"--box {text}: expected x0,y0,x1,y1 in pixels")
    return found

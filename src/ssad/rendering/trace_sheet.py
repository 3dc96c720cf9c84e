"""An episode from the ego's camera, beside the view from above: from its recorded trace alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssad.core.frames import Camera
from ssad.core.images import add_caption
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import upright_pose
from ssad.core.types import F64, U8, EpisodeTrace
from ssad.rendering.camera.render import View, render
from ssad.rendering.episode_scene import agent_poses
from ssad.rendering.onboard import DAY, Onboard


def make_overhead_camera(pose: F64, height: float, width: int, image_height: int) -> tuple[Camera, F64]:
    """A camera over a place, looking straight down, the driving direction up."""
    focal = 1.2 * image_height
    camera = Camera(width, image_height, np.array([[focal, 0, width / 2], [0, focal, image_height / 2], [0, 0, 1]]))
    downward = np.eye(4)
    downward[:3, :3] = np.array([[0, -1, 0], [-1, 0, 0], [0, 0, -1]], float)
    # 8 m ahead of the ego: the road in front matters more than the road behind.
    downward[:3, 3] = [8.0, 0, height]
    return camera, pose @ downward


def moments(trace: EpisodeTrace) -> list[int]:
    """Return three steps worth showing.

    They are 3 s and 1.2 s before the first contact and the contact itself; without one they are spread over the
    drive.
    """
    last_step = len(trace.x) - 1
    contact_steps = np.flatnonzero(trace.contact)
    if len(contact_steps):
        return [max(int(contact_steps[0] - seconds / trace.dt), 0) for seconds in (3.0, 1.2, 0.0)]
    return [last_step // 4, last_step // 2, 3 * last_step // 4]


def onboard_sheet(trace: EpisodeTrace, graph: LaneGraph, *, width: int = 640) -> U8:
    """Render three moments, the camera on the left, the view from above on the right."""
    camera_model = Camera.typical(width, width * 9 // 16)
    onboard = Onboard()
    steps = moments(trace)
    front_images = onboard.camera(camera_model).of_trace(trace, graph, steps=steps)
    town, all_moments = onboard.town(graph), agent_poses(trace)
    appearance = town.appearance_of_trace(trace)
    rows = []
    for step, front_image in zip(steps, front_images, strict=True):
        pose = upright_pose(float(trace.x[step, 0]), float(trace.y[step, 0]), float(trace.yaw[step, 0]))
        overhead_camera, overhead_pose = make_overhead_camera(pose, 42.0, camera_model.width, camera_model.height)
        scene_objects = (
            *town.objects(appearance, all_moments[step]),
            *town.lights(appearance, all_moments[step], pose[:2, 3]),
        )
        top_image = render(town.scene, [View(overhead_camera, overhead_pose, scene_objects, DAY)]).image[0]
        text = f"{step * trace.dt:.1f} s, {trace.speed[step, 0]:.1f} m/s"
        left = add_caption(np.ascontiguousarray(np.moveaxis(front_image, 0, -1)), text, width)
        rows.append(np.hstack([left, add_caption(top_image, "from above", width)]))
    return np.vstack(rows)


def pick_trace(folder: Path) -> Path | None:
    """Return the recorded trace of a collision of the run, of any episode if there is none; None without traces.

    Collisions with walkers come first.
    """
    from ssad.core.folders import path_inside
    from ssad.core.jsonl import read_lines

    candidates = []
    for record in read_lines(folder / "results.jsonl"):
        trace = record.get("artefacts", {}).get("trace", "")
        if trace and path_inside(folder, trace).is_file():
            collided = bool(record.get("metrics", {}).get("collision"))
            hit_walker = bool(record.get("metrics", {}).get("collisions_walker"))
            # False sorts first; the names make the choice independent of the order of the records.
            candidates.append(
                (not collided, not hit_walker, str(record["spec"]["scenario"]["name"]), record["system"], trace)
            )
    return folder / min(candidates)[-1] if candidates else None

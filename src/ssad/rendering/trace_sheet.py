"""An episode as the ego's camera sees it, beside the view from above: from its recorded trace alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssad.core.frames import Camera
from ssad.core.images import captioned
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import upright_pose
from ssad.core.types import F64, U8, EpisodeTrace
from ssad.rendering.camera.render import View, render
from ssad.rendering.episode_scene import moments_of
from ssad.rendering.onboard import DAY, Onboard


def above(pose: F64, height: float, width: int, tall: int) -> tuple[Camera, F64]:
    """A camera over a place, looking straight down, the driving direction up."""
    focal = 1.2 * tall
    camera = Camera(width, tall, np.array([[focal, 0, width / 2], [0, focal, tall / 2], [0, 0, 1]]))
    down = np.eye(4)
    down[:3, :3] = np.array([[0, -1, 0], [-1, 0, 0], [0, 0, -1]], float)
    down[:3, 3] = [8.0, 0, height]
    return camera, pose @ down


def moments(trace: EpisodeTrace) -> list[int]:
    """Three steps worth seeing: 3 s and 1.2 s before the first contact, and the contact; else spread over the drive."""
    last = len(trace.x) - 1
    hits = np.flatnonzero(trace.contact)
    if len(hits):
        return [max(int(hits[0] - seconds / trace.dt), 0) for seconds in (3.0, 1.2, 0.0)]
    return [last // 4, last // 2, 3 * last // 4]


def onboard_sheet(trace: EpisodeTrace, graph: LaneGraph, *, width: int = 640) -> U8:
    """Three moments, camera left, view from above right."""
    front = Camera.typical(width, width * 9 // 16)
    onboard = Onboard()
    steps = moments(trace)
    ahead = onboard.camera(front).of_trace(trace, graph, steps=steps)
    town, at = onboard.town(graph), moments_of(trace)
    looks = town.looks_of_trace(trace)
    rows = []
    for step, seen in zip(steps, ahead, strict=True):
        pose = upright_pose(float(trace.x[step, 0]), float(trace.y[step, 0]), float(trace.yaw[step, 0]))
        over, over_pose = above(pose, 42.0, front.width, front.height)
        things = (*town.things(looks, at[step]), *town.lights(looks, at[step], pose[:2, 3]))
        top = render(town.scene, [View(over, over_pose, things, DAY)]).image[0]
        text = f"{step * trace.dt:.1f} s, {trace.speed[step, 0]:.1f} m/s"
        left = captioned(np.ascontiguousarray(np.moveaxis(seen, 0, -1)), text, width)
        rows.append(np.hstack([left, captioned(top, "from above", width)]))
    return np.vstack(rows)


def pick_trace(folder: Path) -> Path | None:
    """The recording of a collision of the run, with a walker if there is one; any recording if nobody collides."""
    from ssad.core.jsonl import read_lines

    found = []
    for record in read_lines(folder / "results.jsonl"):
        trace = record.get("artefacts", {}).get("trace", "")
        if trace and (folder / trace).is_file():
            hit = bool(record.get("metrics", {}).get("collision"))
            walker = bool(record.get("metrics", {}).get("collisions_walker"))
            found.append((not hit, not walker, str(record["spec"]["scenario"]["name"]), record["system"], trace))
    return folder / min(found)[-1] if found else None

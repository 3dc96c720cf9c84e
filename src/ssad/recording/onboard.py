"""An episode as the ego's camera sees it, beside the view from above: from its recorded trace alone."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from ssad.assets.actor_bodies import ACTOR_BODIES, plain_body
from ssad.assets.bodies import draw_paint, make_body
from ssad.assets.mesh import Mesh, merge
from ssad.assets.street import cached_street
from ssad.camera.render import View, Weather, render
from ssad.camera.scene import Scene, Thing
from ssad.core.frames import FORWARD, Camera
from ssad.core.images import captioned
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F64, U8, EpisodeTrace
from ssad.recording.scene_objects import Clear
from ssad.recording.street_signs import street_signs
from ssad.world.models import MODELS


@lru_cache(maxsize=256)
def body_of(model: str, key: int) -> Mesh:
    """The body that plays a model of the world, of its size. UnknownNameError."""
    size = MODELS[model].length, MODELS[model].width, MODELS[model].height
    if model not in ACTOR_BODIES:
        return plain_body(size)
    kind, styles = ACTOR_BODIES[model]
    return make_body(kind, style=styles[0], size=size, generator=generator("body", model, key))


def cast(trace: EpisodeTrace) -> list[Mesh]:
    """A body for each agent."""
    return [body_of(model, a) for a, model in enumerate(trace.models)]


def things_at(trace: EpisodeTrace, step: int, *, ego: bool) -> tuple[Thing, ...]:
    """Who stands where at a step; the mesh and tag of agent a are a and a + 1."""
    found = []
    for a in range(0 if ego else 1, len(trace.models)):
        if trace.active[step, a]:
            pose = upright_pose(float(trace.x[step, a]), float(trace.y[step, a]), float(trace.yaw[step, a]))
            found.append(Thing(a, pose, draw_paint(generator("paint", trace.key, a)), a + 1))
    return tuple(found)


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
    street, bodies = cached_street(graph), cast(trace)
    way = np.stack([trace.x[:, 0], trace.y[:, 0]], -1).astype(np.float64)
    found = street_signs(graph, way, Clear(street), key=(trace.key,), many=False, detail=1)
    signs = [(merge([one.plate, one.post]), one.pose) for one in found]
    standing = tuple(Thing(len(bodies) + n, upright_pose(*pose)) for n, (_, pose) in enumerate(signs))
    stage = Scene(street, [*bodies, *(mesh for mesh, _ in signs)])
    front = Camera.typical(width, width * 9 // 16)
    rows = []
    for step in moments(trace):
        pose = upright_pose(float(trace.x[step, 0]), float(trace.y[step, 0]), float(trace.yaw[step, 0]))
        over, over_pose = above(pose, 42.0, front.width, front.height)
        weather = Weather(0.9, 2.2, 0.3)
        ahead = View(front, pose @ FORWARD, (*things_at(trace, step, ego=False), *standing), weather)
        seen = render(stage, [ahead]).image[0]
        top = render(stage, [View(over, over_pose, (*things_at(trace, step, ego=True), *standing), weather)]).image[0]
        text = f"{step * trace.dt:.1f} s, {trace.speed[step, 0]:.1f} m/s"
        rows.append(np.hstack([captioned(seen, text, width), captioned(top, "from above", width)]))
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

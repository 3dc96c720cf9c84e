"""`ssad record --clips`: pictures of a target car for 2D detection, with COCO annotations.

drive: a camera follows the target on its own way, 20 m behind, as in the paper; orbit: views of a standing target over
distance, azimuth and elevation. Recorded in parts as `ssad.bench.record` does: any number of processes, any stop.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np

from ssad import safeio
from ssad.bench.cast import Cast, make_cast
from ssad.bench.coco import coco_data
from ssad.bench.drives import make_drive
from ssad.bench.execute import quiet_warp
from ssad.bench.record import HELD_OUT, NOISE, draw_weather, drive, ego_at, link, run_parts
from ssad.camera.bodies import draw_paint, draw_size, draw_style, make_body
from ssad.camera.labels import label_picture
from ssad.camera.render import View, Weather, render
from ssad.camera.stage import Stage, Thing
from ssad.camera.street import cached_street
from ssad.datasets.nuscenes.files import encode_jpeg
from ssad.detections import CLASSES_3D
from ssad.errors import ConfigError
from ssad.frames import Camera
from ssad.roads import load_town, town_names
from ssad.seeding import digest, generator
from ssad.types import F64, EpisodeTrace

CLASSES: Final = CLASSES_3D
_LABEL = {"construction": "construction_vehicle"}
IMAGES: Final = {"Twinford": 600, "Crossgate": 400, "Oldmarket": 400, "Larkhill": 400}
EACH: Final = 25  # pictures of a part
TARGET: Final = 1_000_000  # its tag
SMALL, HIDDEN = 8.0, 0.25  # px of a side, visible share: below, an object is crowd
SEEN: Final = 0.6  # least visible share of the target
PART: Final = "part.json"


@dataclass(frozen=True, slots=True)
class Clips:
    """What to record. images: town -> how many pictures; mode; size: pixels a side; style: of the target car (None:
    any); behind, height: m of the following camera; distances (m), azimuths, elevations (degrees) of the orbit."""

    out: Path
    images: tuple[tuple[str, int], ...] = tuple(IMAGES.items())
    held_out: tuple[str, ...] = HELD_OUT
    mode: Literal["drive", "orbit"] = "drive"
    size: int = 640
    style: str | None = None
    behind: float = 20.0
    height: float = 2.0
    distances: tuple[float, ...] = (5.0, 10.0, 15.0, 20.0, 30.0)
    azimuths: tuple[float, ...] = (0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0)
    elevations: tuple[float, ...] = (4.0, 15.0, 30.0)
    seed: int = 0
    quality: int = 92
    device: str = "cpu"

    def __post_init__(self) -> None:
        for town, count in self.images:
            if town not in town_names():
                raise ConfigError(f"unknown town '{town}' (see: ssad list towns)")
            if count < 1:
                raise ConfigError(f"{town}: {count} pictures; ask for one or more")
        if not self.images or self.mode not in ("drive", "orbit"):
            raise ConfigError("name a town to record, and drive or orbit")
        if self.size < 64 or not 3.0 <= self.behind <= 60.0 or not 0.5 <= self.height <= 30.0:
            raise ConfigError("size: from 64 pixels; behind: 3 to 60 m; height: 0.5 to 30 m")
        if not (self.distances and self.azimuths and self.elevations) or min(self.distances) < 3.0:
            raise ConfigError("an orbit needs distances of 3 m or more, azimuths and elevations")

    def identity(self) -> dict[str, Any]:
        """What decides the bytes."""
        return {
            "clips": self.mode, "images": [list(pair) for pair in self.images], "held_out": list(self.held_out),
            "size": self.size, "style": self.style, "behind": self.behind, "height": self.height,
            "distances": list(self.distances), "azimuths": list(self.azimuths), "elevations": list(self.elevations),
            "seed": self.seed, "quality": self.quality, "device": self.device,
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class Shot:
    """One picture to take: time s, pose of the camera and of the target [4, 4], what is known about it."""

    time: float
    camera: F64
    target: F64
    weather: Weather
    about: dict[str, Any]


def pair_images(towns: Sequence[str], images: Sequence[str]) -> tuple[tuple[str, int], ...]:
    """Towns with their numbers of pictures; one number stands for all. ConfigError."""
    try:
        counts = [int(text) for text in images]
    except ValueError:
        raise ConfigError(f"--images {','.join(images)}: expected whole numbers with commas between them") from None
    counts = counts * len(towns) if len(counts) == 1 else counts
    if len(counts) != len(towns):
        raise ConfigError(f"--images: {len(counts)} numbers for {len(towns)} towns; give one for each, or one for all")
    return tuple(zip(towns, counts, strict=True))


def look_at(eye: F64, point: F64) -> F64:
    """Pose [4, 4] of an upright camera (x right, y down, z forward) at `eye` that looks at `point`."""
    z = (point - eye) / np.linalg.norm(point - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], -1)
    pose[:3, 3] = eye
    return pose


def _follow(clips: Clips, trace: EpisodeTrace, weather: Weather) -> Iterator[Shot]:
    """Shots from behind the driving target, at least 1 m of way apart, spread over the drive."""
    driven = trace.driven.astype(np.float64)
    usable = np.flatnonzero((driven > clips.behind + 1.0) & (trace.speed[:, 0] > 1.0))
    step = max(1.0, (driven[usable[-1]] - driven[usable[0]]) / (1.6 * EACH)) if len(usable) else 1.0
    last = -1e9
    for t in usable.tolist():
        if driven[t] - last < step:
            continue
        last = driven[t]
        before = float(np.interp(driven[t] - clips.behind, driven[: t + 1], np.arange(t + 1)))
        target = ego_at(trace, t * trace.dt)
        eye = ego_at(trace, before * trace.dt)[:3, 3] + [0.0, 0.0, clips.height]
        away = float(np.hypot(*(eye[:2] - target[:2, 3])))
        pose = look_at(eye, target[:3, 3] + [0.0, 0.0, 0.8])
        yield Shot(t * trace.dt, pose, target, weather, {"distance": round(away, 2), "azimuth": 180.0})


def _orbit(clips: Clips, trace: EpisodeTrace, weather: Weather, key: tuple[object, ...]) -> Iterator[Shot]:
    """Shots of the target from all around, at moments of the drive."""
    draws = generator("clips orbit", *key)
    cells = [(d, a, e) for d in clips.distances for a in clips.azimuths for e in clips.elevations]
    for n in range(8 * EACH):
        distance, azimuth, elevation = cells[int(draws.integers(len(cells)))]
        time = float(draws.uniform(0.5, (len(trace.x) - 2) * trace.dt))
        target = ego_at(trace, time)
        up, turn = np.radians(elevation), np.radians(azimuth)
        local = np.array([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), 0.0]) * distance
        eye = target[:3, :3] @ local + target[:3, 3] + [0.0, 0.0, 0.8 + distance * np.sin(up)]
        eye[2] = max(eye[2], 1.2)
        aim = target[:3, 3] + [0.0, 0.0, 0.7] + draws.normal(0, 0.05 * distance, 3) * [1, 1, 0.4]
        about = {"distance": distance, "azimuth": azimuth, "elevation": elevation, "cell": n}
        yield Shot(time, look_at(eye, aim), target, weather, about)


def _part(task: tuple[Clips, str, int, int, str]) -> str:
    """Takes `count` pictures of one drive; the part's name."""
    clips, town, number, count, name = task
    folder = clips.out / ".parts" / name
    if (folder / PART).is_file():
        return name
    shutil.rmtree(folder, ignore_errors=True)
    quiet_warp()
    cv2.setNumThreads(1)
    rows: list[dict[str, Any]] = []
    skipped = 0
    for attempt in range(20):
        key = (clips.seed, clips.mode, town, number, attempt)
        shots, stage, cast, target = _prepare(clips, town, key)
        for shot in shots:
            if len(rows) == count:
                break
            row = _take(clips, shot, stage, cast, target, f"{name}-{len(rows):03d}", folder, seed=key)
            skipped += row is None
            rows += [row | {"town": town}] if row is not None else []
        if len(rows) == count:
            break
    safeio.write_atomic(folder / PART, safeio.dump_json({"name": name, "images": rows, "skipped": skipped}) + "\n")
    return name


def _prepare(clips: Clips, town: str, key: tuple[object, ...]) -> tuple[list[Shot], Stage, Cast, tuple[int, Any]]:
    """Shots of a drive, the stage, who is there, and the mesh and paint of the target."""
    graph, street = load_town(town), cached_street(town)
    trace = drive(make_drive(graph, key=("clips", *key), seconds=24.0), graph)
    cast = make_cast(trace, graph, street, key=key)
    own = generator("clips target", *key)
    style = clips.style or draw_style("car", generator=own)
    size = draw_size("car", style, generator=own)
    mesh = cast.mesh(
        make_body("car", style=style, size=(min(size[0], 4.9), min(size[1], 2.06), size[2]), generator=own)
    )
    weather = draw_weather(("clips", *key))
    shots = list(_follow(clips, trace, weather) if clips.mode == "drive" else _orbit(clips, trace, weather, key))
    return shots, Stage(street, cast.meshes, device=clips.device), cast, (mesh, draw_paint(own))


def _take(  # noqa: PLR0917
    clips: Clips, shot: Shot, stage: Stage, cast: Cast, target: tuple[int, Any], name: str, folder: Path, *,
    seed: tuple[object, ...],
) -> dict[str, Any] | None:  # fmt: skip
    """Renders, labels and writes one picture; None if the target cannot be seen well enough in it."""
    around = cast.at(shot.time, shot.camera[:2, 3], 150.0)
    if any(np.hypot(*(s.pose[:2, 3] - shot.camera[:2, 3])) < 0.6 * s.body.size[0] + 0.4 for s in around):
        return None  # the camera would stand in somebody
    things = (Thing(target[0], shot.target, target[1], TARGET), *(s.thing for s in around))
    focal = 1.1 * clips.size
    middle = (clips.size - 1) / 2
    camera = Camera(clips.size, clips.size, np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]]))
    view = View(camera, shot.camera, things, shot.weather, NOISE, int(digest("clips noise", *seed, name)[:7], 16))
    picture = render(stage, [view], linear=False)
    labels = label_picture(stage, view, picture)
    rows = np.flatnonzero(labels.tag == TARGET)
    if not len(rows) or labels.share[rows[0]] < SEEN or (labels.box[rows[0], 2:] - labels.box[rows[0], :2]).min() < 12:
        return None
    body = {s.body.tag: s.body for s in around}
    objects = []
    for n, tag in enumerate(labels.tag.tolist()):
        kind = "car" if tag == TARGET else body[tag].kind if tag in body else ""
        if not kind:
            continue
        box = labels.box[n]
        crowd = min(box[2] - box[0], box[3] - box[1]) < SMALL or labels.share[n] < HIDDEN
        objects.append(
            {"label": CLASSES.index(_LABEL.get(kind, kind)), "box": [float(v) for v in box],
             "pixels": int(labels.pixels[n]), "crowd": bool(crowd), "visible": round(float(labels.share[n]), 3),
             "target": tag == TARGET}
        )  # fmt: skip
    safeio.write_atomic(folder / f"{name}.jpg", encode_jpeg(picture.image[0], clips.quality, "420"))
    return {
        "file_name": f"{name}.jpg", "width": clips.size, "height": clips.size, "weather": repr(shot.weather),
        "time": round(shot.time, 3), "intrinsic": camera.intrinsic.tolist(), "pose": shot.camera.round(4).tolist(),
        "target_pose": shot.target.round(4).tolist(), "objects": objects, **shot.about,
    }  # fmt: skip


def record_clips(
    clips: Clips, *, workers: int | None = None, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Takes all pictures and writes annotations/{train,test,all}.json; the folder. StoreError."""
    tasks = []
    for town, count in clips.images:
        for number, start in enumerate(range(0, count, EACH)):
            name = f"{clips.mode}-{town.lower()}-{number:03d}"
            tasks.append((clips, town, number, min(EACH, count - start), name))
    run_parts(clips.out, clips.identity(), _part, tasks, workers=workers, progress=progress)
    splits: dict[str, list[dict[str, Any]]] = {"train": [], "test": [], "all": []}
    skipped = 0
    for _, town, _, _, name in tasks:
        part = safeio.read_json(clips.out / ".parts" / name / PART)
        skipped += int(part["skipped"])
        for row in part["images"]:
            link(clips.out / ".parts" / name / row["file_name"], clips.out / "images" / row["file_name"])
        splits["all"] += part["images"]
        splits["test" if town in clips.held_out else "train"] += part["images"]
    for split, rows in splits.items():
        about = {"recording": clips.identity(), "split": split, "skipped_of_all": skipped}
        page = safeio.dump_json(coco_data(CLASSES, rows, about)) + "\n"
        safeio.write_atomic(clips.out / "annotations" / f"{split}.json", page)
    return clips.out

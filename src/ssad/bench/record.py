"""`ssad record`: drives in the world, seen by the nuScenes rig, as a data set in the nuScenes schema.

One scene is one unit of work: its files and a page of what is in it are written to OUT/.parts; when all scenes are
there, the tables are made of the pages in a fixed order and the files move to their places. So a run can be stopped
at any moment and gone on with, and the bytes do not depend on the number of processes.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from ssad import safeio
from ssad.bench.execute import quiet_warp
from ssad.bench.gallery import RIG, place, rig_camera
from ssad.bench.onboard import BODY, body_of
from ssad.camera.bodies import draw_paint, draw_size, draw_style, make_body
from ssad.camera.labels import visibility_token, visible_share
from ssad.camera.lidar import HDL32E, points_in_boxes, sweep
from ssad.camera.mesh import Mesh
from ssad.camera.render import View, Weather, render
from ssad.camera.stage import Stage, Thing
from ssad.camera.street import cached_street
from ssad.datasets.nuscenes.files import encode_jpeg, points_bytes
from ssad.datasets.nuscenes.writer import NuScenesWriter
from ssad.errors import ConfigError, StoreError
from ssad.frames import Boxes3D, Camera
from ssad.roads import load_town, town_names
from ssad.roads.graph import LaneGraph
from ssad.scenarios.dynamic import build_episode
from ssad.scenarios.dynamic.make_sets import natural
from ssad.scenarios.dynamic.yamlio import scenario_text
from ssad.seeding import digest, generator
from ssad.types import F64, U8, EpisodeTrace, LaneType
from ssad.world.models import MODELS

TOWNS: Final = ("Twinford", "Crossgate", "Oldmarket", "Larkhill")
HELD_OUT: Final = ("Oldmarket", "Larkhill")
KEY: Final = 5  # steps of the world (0.1 s) from one key frame to the next
START: Final = 1_600_000_000_000_000  # us
REACH: Final = 80.0  # m within which things are annotated
PART: Final = "part.json"
CATEGORY: Final = {
    "car": "vehicle.car", "truck": "vehicle.truck", "bus": "vehicle.bus.rigid", "trailer": "vehicle.trailer",
    "construction": "vehicle.construction", "motorcycle": "vehicle.motorcycle", "bicycle": "vehicle.bicycle",
    "pedestrian": "human.pedestrian.adult", "traffic_cone": "movable_object.trafficcone",
    "barrier": "movable_object.barrier",
}  # fmt: skip
# what stands on parking places, and how often
PARKED: Final = {"car": 12.0, "truck": 1.2, "trailer": 1.5, "construction": 1.5, "motorcycle": 1.5, "bicycle": 1.5}


@dataclass(frozen=True, slots=True)
class Recording:
    """What to record. scenes: of each town; seconds: of each scene; width: of the pictures (16:9); sweeps: frames
    between key frames that are written too (0 to 4); quality: of JPEG files. ConfigError for what cannot be."""

    out: Path
    towns: tuple[str, ...] = TOWNS
    held_out: tuple[str, ...] = HELD_OUT
    scenes: int = 2
    seconds: float = 20.0
    width: int = 1600
    sweeps: int = 0
    seed: int = 0
    quality: int = 90
    version: str = "v1.0-ssad"

    def __post_init__(self) -> None:
        for town in self.towns:
            if town not in town_names():
                raise ConfigError(f"unknown town '{town}' (see: ssad list towns)")
        if not self.towns or self.scenes < 1:
            raise ConfigError("nothing to record: name a town, and one scene or more")
        if self.width < 64 or self.width % 16 or not 0 <= self.sweeps < KEY or self.seconds < 0.5:
            raise ConfigError("width: a multiple of 16 from 64; sweeps: 0 to 4; seconds: at least 0.5")

    def identity(self) -> dict[str, Any]:
        """What decides the bytes."""
        return {
            "towns": list(self.towns), "held_out": list(self.held_out), "scenes": self.scenes, "seconds": self.seconds,
            "width": self.width, "sweeps": self.sweeps, "seed": self.seed, "quality": self.quality,
            "version": self.version,
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class Prop:
    """Something that stands still: kind, mesh number, pose, size (length, width, height), attributes."""

    kind: str
    mesh: int
    pose: F64
    size: tuple[float, float, float]
    attributes: tuple[str, ...]


@dataclass(slots=True)
class _Cast:
    """Bodies of a scene: those of the agents first, then the props."""

    meshes: list[Mesh] = field(default_factory=list)
    props: list[Prop] = field(default_factory=list)


def _weather(key: tuple[object, ...]) -> Weather:
    """Weather and hour of a scene: mostly day, some dusk and night, some fog and wet roads."""
    draws = generator("record weather", *key)
    kind = draws.choice(["day", "overcast", "low", "fog", "wet", "night"], p=[0.36, 0.2, 0.16, 0.08, 0.1, 0.1])
    heading, turn = float(draws.uniform(-np.pi, np.pi)), float(draws.uniform(0, 50))
    high = float(draws.uniform(0.4, 1.2))
    found = {
        "day": Weather(high, heading, float(draws.uniform(0.05, 0.6)), turn=turn),
        "overcast": Weather(high, heading, float(draws.uniform(0.85, 1.0)), turn=turn),
        "low": Weather(float(draws.uniform(0.1, 0.3)), heading, float(draws.uniform(0.0, 0.5)), turn=turn),
        "fog": Weather(high, heading, 0.9, fog=float(draws.uniform(0.006, 0.025)), turn=turn),
        "wet": Weather(high, heading, 0.95, wet=float(draws.uniform(0.4, 1.0)), turn=turn),
        "night": Weather(float(draws.uniform(-0.3, -0.05)), heading, float(draws.uniform(0, 0.9)), turn=turn),
    }
    return found[str(kind)]


def _props(cast: _Cast, graph: LaneGraph, street: Any, trace: EpisodeTrace, key: tuple[object, ...]) -> None:
    """Parked vehicles, people on sidewalks, cones and barriers along the route; none on a road."""
    draws = generator("record props", *key)
    route = np.stack([trace.x[:, 0], trace.y[:, 0]], -1)[::10]

    def near(x: float, y: float, reach: float) -> bool:
        return bool(np.hypot(route[:, 0] - x, route[:, 1] - y).min() < reach)

    def add(kind: str, pose: F64, style: str | None, attributes: tuple[str, ...]) -> None:
        number = len(cast.meshes)
        own = generator("record prop", *key, number)
        chosen = style or draw_style(kind, generator=own)
        size = draw_size(kind, chosen, generator=own)
        if kind == "car" and size[0] > 5.3:
            size = (5.3, size[1], size[2])
        cast.meshes.append(make_body(kind, style=chosen, size=size, generator=own, detail=1))
        cast.props.append(Prop(kind, number, pose, size, attributes))

    kinds, share = list(PARKED), np.array(list(PARKED.values()))
    last: list[F64] = []
    for x, y, yaw in np.asarray(street.parking, float):
        if not near(x, y, 45.0) or draws.random() > 0.45:
            continue
        kind = str(draws.choice(kinds, p=share / share.sum()))
        reach = {"car": 5.6, "truck": 10.0, "trailer": 14.5, "construction": 9.0}.get(kind, 3.0)
        if last and min(float(np.hypot(*(q - [x, y]))) for q in last) < reach:
            continue
        last.append(np.array([x, y]))
        parked = ("cycle.without_rider",) if kind in ("motorcycle", "bicycle") else ("vehicle.parked",)
        add(kind, place(x, y, yaw), "parked" if kind in ("motorcycle", "bicycle") else None, parked)
        if kind == "construction":  # fenced off
            for dx in (-5.5, 5.5):
                add("traffic_cone", place(x, y, yaw) @ place(dx, 0.6, 0.0), None, ())
    walks = np.flatnonzero(graph.kind == LaneType.SIDEWALK)
    spots = [int(i) for k in walks for i in range(int(graph.offset[k]) + 1, int(graph.offset[k + 1]), 7)]
    for i in spots:
        x, y, yaw = float(graph.xy[i, 0]), float(graph.xy[i, 1]), float(graph.yaw[i])
        if not near(x, y, 35.0):
            continue
        pick = draws.random()
        if pick < 0.14:
            add("pedestrian", place(x, y, yaw + draws.uniform(-3, 3), 0.12), "standing", ("pedestrian.standing",))
        elif pick < 0.18:
            add("traffic_cone", place(x, y, yaw, 0.12), None, ())
        elif pick < 0.23:
            add("barrier", place(x, y, yaw + np.pi / 2, 0.12), None, ())


def _agent_boxes(
    trace: EpisodeTrace, step: int
) -> list[tuple[int, F64, tuple[float, float, float], str, tuple[str, ...]]]:
    """Agents but the ego at a step: number, pose, size (length, width, height), category, attributes."""
    found: list[tuple[int, F64, tuple[float, float, float], str, tuple[str, ...]]] = []
    for a in range(1, len(trace.models)):
        model = MODELS[trace.models[a]]
        if not trace.active[step, a] or (trace.models[a] not in BODY and trace.models[a] != "barrier"):
            continue
        kind = BODY.get(trace.models[a], ("barrier", ""))[0]
        moving = abs(float(trace.speed[step, a])) > 0.3
        attribute = {
            "pedestrian": "pedestrian.moving" if moving else "pedestrian.standing",
            "motorcycle": "cycle.with_rider", "bicycle": "cycle.with_rider",
        }.get(kind, "vehicle.moving" if moving else "vehicle.stopped")  # fmt: skip
        pose = place(float(trace.x[step, a]), float(trace.y[step, a]), float(trace.yaw[step, a]))
        attributes = () if kind in ("traffic_cone", "barrier") else (attribute,)
        found.append((a, pose, (model.length, model.width, model.height), CATEGORY[kind], attributes))
    return found


def _quaternion(matrix: F64) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a rotation."""
    m = matrix
    w = np.sqrt(max(0.0, 1 + m[0, 0] + m[1, 1] + m[2, 2])) / 2
    x = np.copysign(np.sqrt(max(0.0, 1 + m[0, 0] - m[1, 1] - m[2, 2])) / 2, m[2, 1] - m[1, 2])
    y = np.copysign(np.sqrt(max(0.0, 1 - m[0, 0] + m[1, 1] - m[2, 2])) / 2, m[0, 2] - m[2, 0])
    z = np.copysign(np.sqrt(max(0.0, 1 - m[0, 0] - m[1, 1] + m[2, 2])) / 2, m[1, 0] - m[0, 1])
    return float(w), float(x), float(y), float(z)


def depth_bytes(depth: Any) -> bytes:
    """A depth map [H, W] at a quarter of the resolution, 16-bit PNG: 64 a metre, 65535 for the sky."""
    small = np.asarray(depth, np.float64)[2::4, 2::4]
    values = np.where(np.isfinite(small), np.minimum(np.rint(small * 64), 65534), 65535).astype(np.uint16)
    return bytes(cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def _scene(task: tuple[Recording, str, int, str]) -> str:
    """Records one scene into its part; its name. What is there already is left alone."""
    recording, town, number, name = task
    folder = recording.out / ".parts" / name
    if (folder / PART).is_file():
        return name
    shutil.rmtree(folder, ignore_errors=True)
    quiet_warp()
    cv2.setNumThreads(1)
    key = (recording.seed, town, number)
    graph, street = load_town(town), cached_street(town)
    drives = natural(graph, max(recording.scenes, 1), 1)
    scenario = drives[number % len(drives)]
    trace = _drive(scenario, graph, int(digest("record", *key)[:6], 16))
    steps = min(int(recording.seconds / trace.dt), len(trace.x) - 1)
    cast = _Cast([body_of(m, int(digest("agent", *key, a)[:6], 16)) for a, m in enumerate(trace.models)])
    _props(cast, graph, street, trace, key)
    stage = Stage(street, cast.meshes)
    weather = _weather(key)
    cameras = [rig_camera(channel, recording.width) for channel in RIG]
    samples: list[dict[str, Any]] = []
    files = _Files(folder, recording.quality)
    spacing = max(1, KEY // (recording.sweeps + 1))
    for step in range(steps + 1):
        on_key = step % KEY == 0
        if not on_key and (step % spacing or step % KEY > spacing * recording.sweeps):
            continue
        ego = place(float(trace.x[step, 0]), float(trace.y[step, 0]), float(trace.yaw[step, 0]))
        agents = _agent_boxes(trace, step)
        things = [Thing(a, pose, draw_paint(generator("paint", *key, a)), a) for a, pose, _, _, _ in agents]
        first = len(trace.models)
        for p, prop in enumerate(cast.props):
            if np.hypot(*(prop.pose[:2, 3] - ego[:2, 3])) < 140:
                things.append(Thing(prop.mesh, prop.pose, draw_paint(generator("paint", *key, -1, p)), first + p))
        moment = START + number * 100_000_000 + round(step * trace.dt * 1e6)
        shares: dict[int, float] = {}
        for camera in cameras:
            view = View(camera, ego @ camera.to_ego, tuple(things), weather)
            picture = render(stage, [view])
            if on_key:
                for tag, share in visible_share(stage, view, picture).items():
                    shares[tag] = max(shares.get(tag, 0.0), share)
            files.picture(camera, picture.image[0], picture.depth[0], moment=moment, on_key=on_key, ego=ego)
        points, _ = sweep(stage, HDL32E, ego, things, key=("lidar", *key, step))
        files.cloud(points, moment=moment, on_key=on_key, ego=ego)
        if on_key:
            everything = [
                *agents,
                *((first + p, q.pose, q.size, CATEGORY[q.kind], q.attributes) for p, q in enumerate(cast.props)),
            ]
            samples.append({"time": moment, "boxes": _annotate(everything, ego, points, shares)})
    part = {
        "name": name, "town": town, "scenario": scenario_text([scenario]), "samples": samples, "frames": files.rows,
        "weather": repr(weather), "sensors": _sensors(cameras),
    }  # fmt: skip
    safeio.write_atomic(folder / PART, safeio.dump_json(part) + "\n")
    return name


def _drive(scenario: Any, graph: LaneGraph, seed: int) -> EpisodeTrace:
    """The Autopilot drives a scenario."""
    from ssad.agents import make_system
    from ssad.world.rollout import rollout

    return rollout([build_episode(scenario, graph, seed=seed)], {graph.name: graph}, make_system("autopilot"))[0]


@dataclass(slots=True)
class _Files:
    """Files of a scene's part, and the rows that say what they are."""

    folder: Path
    quality: int
    rows: list[dict[str, Any]] = field(default_factory=list)

    def picture(self, camera: Camera, image: U8, depth: Any, *, moment: int, on_key: bool, ego: F64) -> None:
        """One picture and its depth map."""
        name = f"{camera.channel}_{moment}"
        safeio.write_atomic(self.folder / f"{name}.jpg", encode_jpeg(image, self.quality, "420"))
        safeio.write_atomic(self.folder / f"{name}.depth.png", depth_bytes(depth))
        size = [camera.width, camera.height]
        row = {"channel": camera.channel, "time": moment, "key": on_key, "file": f"{name}.jpg", "size": size}
        self.rows.append(row | {"ego": ego.tolist()})

    def cloud(self, points: Any, *, moment: int, on_key: bool, ego: F64) -> None:
        """One sweep."""
        name = f"LIDAR_TOP_{moment}.pcd.bin"
        safeio.write_atomic(self.folder / name, points_bytes(points))
        row = {"channel": "LIDAR_TOP", "time": moment, "key": on_key, "file": name, "size": [0, 0]}
        self.rows.append(row | {"ego": ego.tolist()})


def _annotate(everything: list[Any], ego: F64, points: Any, shares: dict[int, float]) -> list[dict[str, Any]]:
    """Boxes within reach that are seen by a camera or hit by the LiDAR."""
    near = [e for e in everything if np.hypot(*(e[1][:2, 3] - ego[:2, 3])) < REACH]
    if not near:
        return []
    centre = np.array([e[1][:3, 3] + [0, 0, e[2][2] / 2] for e in near])
    size = np.array([[e[2][1], e[2][0], e[2][2]] for e in near])
    rotation = np.array([_quaternion(e[1][:3, :3]) for e in near])
    boxes = Boxes3D(tuple(str(e[0]) for e in near), centre, size, rotation, np.zeros_like(centre), np.ones(len(near)))
    pose = ego @ HDL32E.to_ego
    world = np.asarray(points[:, :3], np.float64) @ pose[:3, :3].T + pose[:3, 3]
    counts = points_in_boxes(world, boxes)
    found = []
    for n, (tag, _, _, category, attributes) in enumerate(near):
        share = shares.get(tag, 0.0)
        if counts[n] or share > 0:
            found.append(
                {"tag": tag, "category": category, "attributes": list(attributes), "centre": centre[n].tolist(),
                 "size": size[n].tolist(), "rotation": list(rotation[n]), "points": int(counts[n]),
                 "visibility": visibility_token(share)}
            )  # fmt: skip
    return found


def _sensors(cameras: list[Camera]) -> list[dict[str, Any]]:
    rows = [
        {"channel": c.channel, "modality": "camera", "pose": c.to_ego.tolist(), "intrinsic": c.intrinsic.tolist()}
        for c in cameras
    ]
    return [*rows, {"channel": "LIDAR_TOP", "modality": "lidar", "pose": HDL32E.to_ego.tolist(), "intrinsic": []}]


def record_nuscenes(
    recording: Recording, *, workers: int | None = None, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Records all scenes and writes the tables; the root of the data set. Run again to go on. StoreError."""
    out = recording.out
    safeio.make_folder(out / ".parts")
    page = out / ".parts" / "recording.json"
    if page.is_file():
        if safeio.read_json(page) != recording.identity():
            raise StoreError(f"{out}: holds another recording; choose another folder")
    else:
        safeio.write_atomic(page, safeio.dump_json(recording.identity(), indent=1) + "\n")
    if (out / recording.version / "sample.json").is_file():
        return out
    tasks = [
        (recording, town, number, f"scene-{town.lower()}-{number:03d}")
        for town in recording.towns
        for number in range(recording.scenes)
    ]
    count = min(workers or os.cpu_count() or 1, len(tasks))
    if count <= 1:
        for done, task in enumerate(tasks, 1):
            _scene(task)
            if progress:
                progress(done, len(tasks))
    else:
        with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
            futures = [pool.submit(_scene, task) for task in tasks]
            try:
                for done, future in enumerate(as_completed(futures), 1):
                    future.result()
                    if progress:
                        progress(done, len(tasks))
            except BrokenProcessPool:
                raise StoreError("a worker died (out of memory?); run the same command again to go on") from None
            except BaseException:
                for future in futures:
                    future.cancel()
                raise
    _merge(recording, [task[3] for task in tasks])
    return out


def _merge(recording: Recording, names: list[str]) -> None:
    """Tables from the parts, files to their places."""
    out = recording.out
    splits: dict[str, list[str]] = {"train": [], "val": [], "all": []}
    with NuScenesWriter(out, recording.version) as writer:
        for name in names:
            folder = out / ".parts" / name
            part = safeio.read_json(folder / PART)
            scene = writer.add_scene(name, description=f"{part['town']}, {part['weather']}")
            splits["val" if part["town"] in recording.held_out else "train"].append(name)
            splits["all"].append(name)
            for sensor in part["sensors"]:
                pose = np.array(sensor["pose"])
                writer.add_sensor(
                    scene, sensor["channel"], modality=sensor["modality"], translation=tuple(pose[:3, 3]),
                    rotation=_quaternion(pose[:3, :3]), intrinsic=sensor["intrinsic"],
                )  # fmt: skip
            times = {}
            for sample in part["samples"]:
                times[sample["time"]] = writer.add_sample(scene, sample["time"])
            for frame in part["frames"]:
                ego = np.array(frame["ego"])
                token = writer.add_sensor_frame(
                    scene, frame["channel"], timestamp_us=frame["time"], data=folder / frame["file"],
                    ego_translation=tuple(ego[:3, 3]), ego_rotation=_quaternion(ego[:3, :3]),
                    sample=times[frame["time"]] if frame["key"] else None, size=tuple(frame["size"]),
                )  # fmt: skip
                depth = folder / f"{frame['file'].removesuffix('.jpg')}.depth.png"
                if depth.is_file():
                    _link(depth, out / "depth" / frame["channel"] / f"{token}.png")
            known: dict[int, str] = {}
            for sample in part["samples"]:
                for box in sample["boxes"]:
                    if box["tag"] not in known:
                        known[box["tag"]] = writer.add_instance(scene, f"thing-{box['tag']}", category=box["category"])
                    writer.add_annotation(
                        times[sample["time"]], known[box["tag"]], translation=box["centre"], size=box["size"],
                        rotation=box["rotation"], visibility=box["visibility"], attributes=box["attributes"],
                        lidar_points=box["points"],
                    )  # fmt: skip
        for split, members in splits.items():
            writer.set_split(split, members)


def _link(source: Path, target: Path) -> None:
    """A hard link, or a copy where that cannot be. StoreError."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if not target.exists():
            try:
                os.link(source, target)
            except OSError:
                shutil.copyfile(source, target)
    except OSError as error:
        raise StoreError(f"{target}: cannot be written: {error.strerror or error}") from None

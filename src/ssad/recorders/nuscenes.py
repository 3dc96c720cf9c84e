"""`ssad record`: drives in the world, seen by the nuScenes rig, as a data set in the nuScenes schema.

One scene is one unit of work: its files and a page of what is in it are written to OUT/.parts; when all scenes are
there, the tables are made of the pages in a fixed order and the files move to their places. So a run can be stopped
at any moment and gone on with, and the bytes do not depend on the number of processes.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from ssad.core import safeio
from ssad.core.boxes import WorldBoxes
from ssad.core.errors import ConfigError, StoreError
from ssad.core.frames import Camera
from ssad.core.images import encode_jpeg
from ssad.core.lane_graph import LaneGraph
from ssad.core.machine import quiet_warp
from ssad.core.nuscenes_names import visibility_token
from ssad.core.rotations import matrix_to_quaternion, upright_pose, wrap_angle
from ssad.core.seeding import digest, generator
from ssad.core.types import F64, U8, Episode, EpisodeTrace
from ssad.datasets.nuscenes.files import points_bytes
from ssad.datasets.nuscenes.writer import NuScenesWriter, place_file
from ssad.engine.pool import Pool, open_pool, run_all
from ssad.engine.store import locked
from ssad.recorders.drives import check_streets, drive_street, make_drive
from ssad.rendering.bodies.actor_bodies import BODY_CATEGORIES
from ssad.rendering.camera.labels import visible_share
from ssad.rendering.camera.lamps import own_lamps
from ssad.rendering.camera.render import View, Weather, render
from ssad.rendering.camera.rig import RIG, rig_camera
from ssad.rendering.camera.scene import Scene
from ssad.rendering.camera.sensor import SENSOR
from ssad.rendering.lidar import HDL32E, points_in_boxes, sweep
from ssad.rendering.scene_objects import PlacedObject, SceneObjects, place_objects
from ssad.rendering.street.model import Street
from ssad.world.roads import is_town, load_town

TOWNS: Final = ("Twinford", "Crossgate", "Oldmarket", "Larkhill")
HELD_OUT: Final = ("Oldmarket", "Larkhill")
WEATHERS: Final = ("day", "overcast", "low", "fog", "wet", "night")
KEY: Final = 5  # steps of the world (0.1 s) from one key frame to the next
START: Final = 1_600_000_000_000_000  # us
REACH: Final = 80.0  # m within which things are annotated
DRAWN: Final = 140.0  # m within which things are drawn
PART: Final = "part.json"
# s by which each camera fires before the LiDAR's sweep ends, as in nuScenes
AHEAD: Final = {
    "CAM_FRONT_LEFT": 0.0431,
    "CAM_FRONT": 0.0355,
    "CAM_FRONT_RIGHT": 0.0276,
    "CAM_BACK_RIGHT": 0.0201,
    "CAM_BACK": 0.0104,
    "CAM_BACK_LEFT": 0.0005,
}
FIRST: Final = 0.1  # s, when the first sweep ends
PART_S: Final = 7200.0  # s that a part may take
SHARED: Final = 4  # drives along one street where each street is built for the recording
GPU_STEPS: Final = 4  # whose pictures are rendered in one call on a GPU


@dataclass(frozen=True, slots=True)
class Recording:
    """What to record.

    scenes: of each town; seconds: of each scene; width: of the pictures (16:9); sweeps: frames between key frames that
    are written too (0 to 4); quality: of JPEG files; device: where pictures are rendered (it decides bits, though few:
    see docs/camera.md); streets: see `drive_street`. ConfigError for what cannot be.
    """

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
    device: str = "cpu"
    streets: str = "town"

    def __post_init__(self) -> None:
        for town in self.towns:
            if not is_town(town):
                raise ConfigError(f"unknown town '{town}' (see: ssad list towns)")
        check_streets(self.streets)
        if not self.towns or self.scenes < 1:
            raise ConfigError("nothing to record: name a town, and one scene or more")
        if self.width < 64 or self.width % 16 or not 0 <= self.sweeps < KEY or not 0.5 <= self.seconds <= 3600:
            raise ConfigError("width: a multiple of 16 from 64; sweeps: 0 to 4; seconds: 0.5 to 3600")

    def identity(self) -> dict[str, Any]:
        """What decides the bytes."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items() if k != "out"}


def draw_weather(key: tuple[object, ...], kind: str = "") -> Weather:
    """Weather and hour of a scene: mostly day, some dusk and night, some fog and wet roads; or all of one kind."""
    draws = generator("record weather", *key)
    drawn = draws.choice(WEATHERS, p=[0.36, 0.2, 0.16, 0.08, 0.1, 0.1])
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
    return found[kind or str(drawn)]


def weather_words(weather: Weather) -> str:
    """A weather as the description of a scene tells it, such as "sun 40 degrees above the horizon, clouds 35 %"."""
    height = round(np.degrees(weather.sun_height))
    told = [
        f"sun {abs(height)} degrees {'below' if height < 0 else 'above'} the horizon",
        f"clouds {weather.clouds:.0%}",
    ]
    if weather.fog:
        told.append(f"fog of {weather.fog:.3f}/m")
    if weather.wet:
        told.append(f"wet road {weather.wet:.0%}")
    return ", ".join(told).replace("%", " %")


def depth_bytes(depth: Any) -> bytes:
    """A depth map [H, W] at a quarter of the resolution, 16-bit PNG: 64 a metre, 65535 for the sky."""
    small = np.asarray(depth, np.float64)[2::4, 2::4]
    values = np.where(np.isfinite(small), np.minimum(np.rint(small * 64), 65534), 65535).astype(np.uint16)
    return bytes(cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def attributes_of(who: PlacedObject) -> tuple[str, ...]:
    """The nuScenes attributes of a body at a moment."""
    body, moving = who.body, who.speed > 0.3
    if body.kind == "pedestrian":
        return ("pedestrian.moving",) if moving else ("pedestrian.standing",)
    if body.kind in ("motorcycle", "bicycle"):
        return ("cycle.with_rider",) if body.style == "ridden" else ("cycle.without_rider",)
    if body.kind in ("traffic_cone", "barrier"):
        return ()
    return ("vehicle.parked",) if body.parked else ("vehicle.moving",) if moving else ("vehicle.stopped",)


def ego_at(trace: EpisodeTrace, time: float) -> F64:
    """Pose [4, 4] of the ego at a time, s, between steps in between."""
    exact = min(max(time / trace.dt, 0.0), len(trace.x) - 1.0)
    low = min(int(exact), max(len(trace.x) - 2, 0))
    high, part = min(low + 1, len(trace.x) - 1), exact - low
    turn = float(wrap_angle(float(trace.yaw[high, 0] - trace.yaw[low, 0])))
    x, y = (float(v[low, 0]) + part * float(v[high, 0] - v[low, 0]) for v in (trace.x, trace.y))
    return upright_pose(x, y, float(trace.yaw[low, 0]) + part * turn)


@lru_cache(maxsize=1)
def _street(town: str, streets: str, key: tuple[object, ...]) -> Street:
    """The street of a drive, kept for the next one along it."""
    return drive_street(load_town(town), streets, key=key)


def _scenes(task: tuple[Recording, str, Sequence[int]]) -> None:
    """Records scenes of a town, which share a street."""
    recording, town, numbers = task
    for number in numbers:
        _scene(recording, town, number)


def _name(town: str, number: int) -> str:
    return f"scene-{town.lower()}-{number:03d}"


def _scene(recording: Recording, town: str, number: int) -> None:
    """Records one scene into its part. What is there already is left alone."""
    name = _name(town, number)
    folder = recording.out / ".parts" / name
    if (folder / PART).is_file():
        return
    shutil.rmtree(folder, ignore_errors=True)
    quiet_warp()
    cv2.setNumThreads(1)
    key = (recording.seed, town, number)
    graph = load_town(town)
    street = _street(town, recording.streets, (recording.seed, town, number // SHARED))
    seconds, streets = recording.seconds + 0.2, recording.streets
    episode = make_drive(graph, key=(recording.seed, number), seconds=seconds, streets=streets)
    trace = drive(episode, graph)
    cast = place_objects(trace, graph, street, key=key, streets=streets, many_signs=streets == "any")
    weather = draw_weather(key)
    cameras = [rig_camera(channel, recording.width) for channel in RIG]
    samples: list[dict[str, Any]] = []
    files = _Files(folder, recording.quality)
    spacing = max(1, KEY // (recording.sweeps + 1))
    steps = [
        step
        for step in range(min(int(recording.seconds / trace.dt), len(trace.x) - 2) + 1)
        if step % KEY == 0 or (step % spacing == 0 and step % KEY <= spacing * recording.sweeps)
    ]
    stage = Scene(street, cast.meshes.only(_meshes_near(cast, trace, steps)), device=recording.device)
    at_once = GPU_STEPS if recording.device != "cpu" else 1
    for start in range(0, len(steps), at_once):
        moments = [_Moment.of(step, cast, trace, cameras, weather, key) for step in steps[start : start + at_once]]
        for moment, shares in _look(stage, moments, files, number, together=recording.device != "cpu"):
            now = moment.now
            ego = ego_at(trace, now)
            around = cast.at(now, ego[:2, 3], DRAWN)
            points, _ = sweep(stage, HDL32E, ego, [s.thing for s in around], key=("lidar", *key, moment.step))
            files.cloud(points, sweep=moment.step, moment=moment_of(number, now), on_key=moment.on_key, ego=ego)
            if moment.on_key:
                boxes = _annotate([s for s in around if s.body.kind], ego, points, shares)
                samples.append({"time": moment_of(number, now), "sweep": moment.step, "boxes": boxes})
    part = {
        "name": name,
        "town": town,
        "drive": episode.key,
        "samples": samples,
        "frames": files.rows,
        "weather": weather_words(weather),
        "sensors": _sensors(cameras),
    }
    safeio.write_atomic(folder / PART, safeio.dump_json(part) + "\n")


def _meshes_near(cast: SceneObjects, trace: EpisodeTrace, steps: Sequence[int]) -> set[int]:
    """The meshes of all that is drawn at these steps."""
    found = set()
    for step in steps:
        now = FIRST + step * trace.dt
        for time in [now, *(now - ahead for ahead in AHEAD.values())]:
            found |= {one.thing.mesh for one in cast.at(time, ego_at(trace, time)[:2, 3], DRAWN)}
    return found


@dataclass(frozen=True, slots=True)
class _Moment:
    """What the cameras look at in one step; now: when the sweep ends, s; times and egos: of each view."""

    step: int
    now: float
    views: list[View]
    times: list[float]
    egos: list[F64]

    @property
    def on_key(self) -> bool:
        """Whether it is a key frame."""
        return self.step % KEY == 0

    @staticmethod
    def of(  # noqa: PLR0917
        step: int,
        cast: SceneObjects,
        trace: EpisodeTrace,
        cameras: list[Camera],
        weather: Weather,
        key: tuple[object, ...],
    ) -> _Moment:
        """Each camera at its own time; the first sweep ends when every camera has fired."""
        now = FIRST + step * trace.dt
        views, times, egos = [], [], []
        for c, camera in enumerate(cameras):
            fired = now - AHEAD[camera.channel]
            ego = ego_at(trace, fired)
            things = tuple(s.thing for s in cast.at(fired, ego[:2, 3], DRAWN))
            noise = int(digest("noise", *key, step, c)[:7], 16)
            lamps = own_lamps(ego, weather)
            views.append(View(camera, ego @ camera.to_ego, things, weather, SENSOR, noise, lamps))
            times.append(fired)
            egos.append(ego)
        return _Moment(step, now, views, times, egos)


def _look(
    stage: Scene, moments: Sequence[_Moment], files: _Files, number: int, *, together: bool
) -> Iterator[tuple[_Moment, dict[int, float]]]:
    """Render and write the pictures of some moments, all of them in one call or one by one.

    Yields:
        Each moment with the largest share of each thing that a camera sees (of key frames).
    """
    flat = [(moment, c) for moment in moments for c in range(len(moment.views))]
    found: list[dict[int, float]] = [{} for _ in moments]
    count = len(flat) if together else 1
    for k in range(0, len(flat), count):
        block = flat[k : k + count]
        picture = render(stage, [moment.views[c] for moment, c in block], linear=False)
        for n, (moment, c) in enumerate(block):
            view = moment.views[c]
            if moment.on_key:
                shares = found[next(i for i, one in enumerate(moments) if one is moment)]
                for tag, share in visible_share(stage, view, picture, n).items():
                    shares[tag] = max(shares.get(tag, 0.0), share)
            files.picture(
                view.camera,
                picture.image[n],
                picture.depth[n],
                sweep=moment.step,
                moment=moment_of(number, moment.times[c]),
                on_key=moment.on_key,
                ego=moment.egos[c],
            )
    yield from zip(moments, found, strict=True)


def moment_of(number: int, time: float) -> int:
    """Time stamp in us of a moment of scene `number`."""
    return START + number * 100_000_000 + round(time * 1e6)


def drive(episode: Episode, graph: LaneGraph) -> EpisodeTrace:
    """The Autopilot drives an episode."""
    from ssad.drivers import make_system
    from ssad.world.rollout import rollout
    from ssad.world.world import World

    return rollout(World([episode], {graph.name: graph}), make_system("autopilot"))[0]


@dataclass(slots=True)
class _Files:
    """Files of a scene's part, and the rows that say what they are."""

    folder: Path
    quality: int
    rows: list[dict[str, Any]] = field(default_factory=list)

    def picture(
        self, camera: Camera, image: U8, depth: Any, *, sweep: int, moment: int, on_key: bool, ego: F64
    ) -> None:
        """One picture and its depth map."""
        name = f"{camera.channel}_{moment}"
        safeio.write_atomic(self.folder / f"{name}.depth.png", depth_bytes(depth))
        self._write(
            f"{name}.jpg",
            encode_jpeg(image, self.quality, "420"),
            channel=camera.channel,
            time=moment,
            key=on_key,
            size=[camera.width, camera.height],
            sweep=sweep,
            ego=ego.tolist(),
        )

    def cloud(self, points: Any, *, sweep: int, moment: int, on_key: bool, ego: F64) -> None:
        """One sweep."""
        self._write(
            f"LIDAR_TOP_{moment}.pcd.bin",
            points_bytes(points),
            channel="LIDAR_TOP",
            time=moment,
            key=on_key,
            size=[0, 0],
            sweep=sweep,
            ego=ego.tolist(),
        )

    def _write(self, name: str, data: bytes, **row: Any) -> None:
        safeio.write_atomic(self.folder / name, data)
        self.rows.append({"file": name} | row)


def _annotate(around: list[PlacedObject], ego: F64, points: Any, shares: dict[int, float]) -> list[dict[str, Any]]:
    """Boxes of what nuScenes has a category for, within reach and seen by a camera or hit by the LiDAR."""
    near = [s for s in around if s.body.kind in BODY_CATEGORIES and np.hypot(*(s.pose[:2, 3] - ego[:2, 3])) < REACH]
    if not near:
        return []
    centre = np.array([s.pose[:3, 3] + [0, 0, s.body.size[2] / 2] for s in near])
    size_lwh = np.array([s.body.size for s in near])
    rotation = matrix_to_quaternion([s.pose[:3, :3] for s in near])
    boxes = WorldBoxes(centre, size_lwh, rotation, np.zeros_like(centre))
    pose = ego @ HDL32E.to_ego
    world = np.asarray(points[:, :3], np.float64) @ pose[:3, :3].T + pose[:3, 3]
    counts, size = points_in_boxes(world, boxes), boxes.size_wlh
    found = []
    for n, who in enumerate(near):
        share = shares.get(who.body.tag, 0.0)
        if counts[n] or share > 0:
            found.append(
                {
                    "tag": who.body.tag,
                    "category": BODY_CATEGORIES[who.body.kind],
                    "attributes": list(attributes_of(who)),
                    "centre": centre[n].tolist(),
                    "size": size[n].tolist(),
                    "rotation": list(rotation[n]),
                    "points": int(counts[n]),
                    "visibility": visibility_token(share),
                }
            )
    return found


def _sensors(cameras: list[Camera]) -> list[dict[str, Any]]:
    rows = [
        {"channel": c.channel, "modality": "camera", "pose": c.to_ego.tolist(), "intrinsic": c.intrinsic.tolist()}
        for c in cameras
    ]
    return [*rows, {"channel": "LIDAR_TOP", "modality": "lidar", "pose": HDL32E.to_ego.tolist(), "intrinsic": []}]


def record_nuscenes(
    recording: Recording,
    *,
    workers: int | None = None,
    ray: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Path:
    """Records all scenes and writes the tables; the root of the data set. Run again to go on. StoreError."""
    out = recording.out
    together = SHARED if recording.streets == "any" else 1
    tasks = [
        (recording, town, range(first, min(first + together, recording.scenes)))
        for town in recording.towns
        for first in range(0, recording.scenes, together)
    ]
    if (out / recording.version / "splits.json").is_file():  # written last
        if not (out / ".parts" / "recording.json").is_file():
            raise StoreError(f"{out}: holds a data set, but not how it was recorded (.parts); choose another folder")
        check_parts(out, recording.identity())
        return out
    pool = open_pool(len(tasks), workers=workers, ray=ray, device=recording.device)
    with locked(out, "ssad record"):
        run_parts(out, recording.identity(), _scenes, tasks, pool=pool, progress=progress)
        _merge(recording, [_name(town, number) for _, town, numbers in tasks for number in numbers])
    return out


def check_parts(out: Path, identity: dict[str, Any]) -> None:
    """Writes what is recorded here, or compares. StoreError: something else."""
    safeio.make_folder(out / ".parts")
    page = out / ".parts" / "recording.json"
    if page.is_file():
        if safeio.read_json(page) != identity:
            raise StoreError(f"{out}: holds another recording; choose another folder")
    else:
        safeio.write_atomic(page, safeio.dump_json(identity, indent=1) + "\n")


def run_parts(
    out: Path,
    identity: dict[str, Any],
    record: Callable[[Any], Any],
    tasks: Sequence[Any],
    *,
    pool: Pool,
    progress: Callable[[int, int], None],
) -> None:
    """Records every part that is not there yet. StoreError: another recording, or parts that failed (see `run_all`)."""
    check_parts(out, identity)
    run_all(pool, record, tasks, timeout_s=PART_S, progress=progress)


def _merge(recording: Recording, names: list[str]) -> None:
    """Tables from the parts, files to their places."""
    out = recording.out
    splits: dict[str, list[str]] = {"train": [], "val": [], "all": []}
    with NuScenesWriter(out, recording.version) as writer:
        for name in names:
            folder = out / ".parts" / name
            part = safeio.read_json(folder / PART)
            description = f"{part['town']}, {part['weather']}"
            scene = writer.add_scene(name, description=description, location=part["town"])
            splits["val" if part["town"] in recording.held_out else "train"].append(name)
            splits["all"].append(name)
            for sensor in part["sensors"]:
                pose = np.array(sensor["pose"])
                writer.add_sensor(
                    scene,
                    sensor["channel"],
                    modality=sensor["modality"],
                    translation=tuple(pose[:3, 3]),
                    rotation=tuple(matrix_to_quaternion(pose[:3, :3])),
                    intrinsic=sensor["intrinsic"],
                )
            times = {}
            for sample in part["samples"]:
                times[sample["sweep"]] = writer.add_sample(scene, sample["time"])
            for frame in part["frames"]:
                ego = np.array(frame["ego"])
                token = writer.add_sensor_frame(
                    scene,
                    frame["channel"],
                    timestamp_us=frame["time"],
                    data=folder / frame["file"],
                    ego_translation=tuple(ego[:3, 3]),
                    ego_rotation=tuple(matrix_to_quaternion(ego[:3, :3])),
                    sample=times[frame["sweep"]] if frame["key"] else None,
                    size=tuple(frame["size"]),
                )
                depth = folder / f"{frame['file'].removesuffix('.jpg')}.depth.png"
                if depth.is_file():
                    place_file(out / "depth" / frame["channel"] / f"{token}.png", depth)
            known: dict[int, str] = {}
            for sample in part["samples"]:
                for box in sample["boxes"]:
                    if box["tag"] not in known:
                        known[box["tag"]] = writer.add_instance(scene, f"thing-{box['tag']}", category=box["category"])
                    writer.add_annotation(
                        times[sample["sweep"]],
                        known[box["tag"]],
                        translation=box["centre"],
                        size=box["size"],
                        rotation=box["rotation"],
                        visibility=box["visibility"],
                        attributes=box["attributes"],
                        lidar_points=box["points"],
                    )
        for split, members in splits.items():
            writer.set_split(split, members)

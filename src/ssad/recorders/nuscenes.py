"""`ssad record`: drives in the world, seen by the nuScenes rig, as a data set in the nuScenes schema.

One scene is one unit of work: its files and a page of its content are written to OUT/.parts. When all scenes are
complete, the tables are built from the pages in a fixed order and the files move to their places. A run can be
stopped at any moment and resumed, and the bytes do not depend on the number of processes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
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
from ssad.core.machine import start_warp_quietly
from ssad.core.nuscenes_names import visibility_token
from ssad.core.rotations import matrix_to_quaternion, upright_pose, wrap_angle
from ssad.core.seeding import digest, generator
from ssad.core.types import F64, U8, Episode, EpisodeTrace
from ssad.datasets.nuscenes.files import points_bytes
from ssad.datasets.nuscenes.writer import NuScenesWriter, place_file
from ssad.engine.pool import open_pool, run_all
from ssad.recorders.drives import check_streets, drive_street, make_drive
from ssad.recorders.parts import TIME_LIMIT, PartsFolder
from ssad.recorders.randomisation import NO_RANDOMISATION, CameraDraw, Randomisation, describe_bodies
from ssad.rendering.bodies.actor_bodies import BODY_CATEGORIES, category_of
from ssad.rendering.camera.effects import DEFAULT_EFFECTS, check_effects
from ssad.rendering.camera.labels import visible_share
from ssad.rendering.camera.lamps import own_lamps
from ssad.rendering.camera.render import RenderQuality, SceneWeather, View, render
from ssad.rendering.camera.rig import RIG, rig_camera
from ssad.rendering.camera.scene import RenderScene
from ssad.rendering.camera.sensor import SENSOR
from ssad.rendering.camera.street_lighting import UNLIT
from ssad.rendering.lidar import HDL32E, points_in_boxes, sweep
from ssad.rendering.scene_objects import PlacedObject, SceneObjects, place_objects
from ssad.rendering.signal_heads import SignalHeads, head_meshes
from ssad.rendering.street.model import Street
from ssad.world.roads import is_town, load_town

TOWNS: Final = ("Twinford", "Crossgate", "Oldmarket", "Larkhill")
HELD_OUT: Final = ("Oldmarket", "Larkhill")
WEATHERS: Final = ("day", "overcast", "low", "fog", "wet", "night")
KEY: Final = 5  # steps of the world (0.1 s) from one key frame to the next
START: Final = 1_600_000_000_000_000  # us
ANNOTATION_RANGE: Final = 80.0  # m within which things are annotated
RENDER_RANGE: Final = 140.0  # m within which things are drawn
# s by which each camera fires before the LiDAR's sweep ends, as in nuScenes
AHEAD: Final = {
    "CAM_FRONT_LEFT": 0.0431,
    "CAM_FRONT": 0.0355,
    "CAM_FRONT_RIGHT": 0.0276,
    "CAM_BACK_RIGHT": 0.0201,
    "CAM_BACK": 0.0104,
    "CAM_BACK_LEFT": 0.0005,
}
FIRST_SWEEP_END: Final = 0.1  # s, when the first sweep ends
DRIVES_PER_STREET: Final = 4  # drives along one street where each street is built for the recording
RANDOMISED: Final = "randomisation.json"  # in the folder of the tables: ranges, and what was drawn for each scene
LIGHTING_SHARES: Final = {"M3": 0.15, "M4": 0.25, "M5": 0.15, "P2": 0.1, "P4": 0.15, "P5": 0.1, UNLIT: 0.1}  # of nights
GPU_STEPS: Final = 4  # whose pictures are rendered in one call on a GPU


@dataclass(frozen=True, slots=True)
class Recording:
    """Settings of a recording.

    Attributes:
        out: Root of the data set.
        towns: Towns to record.
        held_out: Towns of the split val.
        scenes: Number of scenes in each town.
        seconds: Length of each scene, s.
        width: Width of the images (16:9), px.
        sweeps: Frames between key frames that are written too (0 to 4).
        seed: Root of the random numbers.
        quality: Quality of JPEG files.
        version: Version of the data set.
        device: Device that renders (it decides bits, though few: see docs/how-to/record-data.md).
        streets: See `drive_street`.
        randomisation: What is drawn for each camera and each vehicle of a scene.
        effects: Effects of the rendering, see `ssad.rendering.camera.effects`.

    Raises:
        ConfigError: A value is out of range.
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
    randomisation: Randomisation = NO_RANDOMISATION
    effects: frozenset[str] = DEFAULT_EFFECTS

    def __post_init__(self) -> None:
        check_effects(self.effects)
        for town in self.towns:
            if not is_town(town):
                raise ConfigError(f"unknown town '{town}' (see: ssad list towns)")
        check_streets(self.streets)
        if not self.towns or self.scenes < 1:
            raise ConfigError("nothing to record: name a town, and one scene or more")
        if self.width < 64 or self.width % 16 or not 0 <= self.sweeps < KEY or not 0.5 <= self.seconds <= 3600:
            raise ConfigError("width: a multiple of 16 from 64; sweeps: 0 to 4; seconds: 0.5 to 3600")

    @property
    def parts(self) -> PartsFolder:
        """The scenes of the recording."""
        return PartsFolder(self.out, self.identity())

    def identity(self) -> dict[str, Any]:
        """Return the settings that decide the bytes of the recording, as plain data."""
        settings = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in asdict(self).items()
            if name not in ("out", "randomisation")
        } | {"effects": sorted(self.effects)}
        # Left out where there is none, so that such recordings keep their identity.
        return settings | ({"randomisation": self.randomisation.identity()} if self.randomisation else {})


def draw_weather(
    key: tuple[object, ...], kind: str = "", *, effects: Collection[str] = DEFAULT_EFFECTS
) -> SceneWeather:
    """Draw the weather and hour of a scene: mostly day, some dusk and night, some fog and wet roads.

    Args:
        key: Key of the draw.
        kind: One of `WEATHERS`; "": drawn too.
        effects: Effects of the rendering. Nights have a class of street lighting if `street-lighting` is among them.
    """
    rng = generator("record weather", *key)
    drawn_kind = rng.choice(WEATHERS, p=[0.36, 0.2, 0.16, 0.08, 0.1, 0.1])
    heading, turn = float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(0, 50))
    sun_height = float(rng.uniform(0.4, 1.2))
    # All kinds draw their numbers, so that fixing the kind does not change the draws.
    by_kind = {
        "day": SceneWeather(sun_height, heading, float(rng.uniform(0.05, 0.6)), turn=turn),
        "overcast": SceneWeather(sun_height, heading, float(rng.uniform(0.85, 1.0)), turn=turn),
        "low": SceneWeather(float(rng.uniform(0.1, 0.3)), heading, float(rng.uniform(0.0, 0.5)), turn=turn),
        "fog": SceneWeather(sun_height, heading, 0.9, fog=float(rng.uniform(0.006, 0.025)), turn=turn),
        "wet": SceneWeather(sun_height, heading, 0.95, wet=float(rng.uniform(0.4, 1.0)), turn=turn),
        "night": SceneWeather(
            float(rng.uniform(-0.3, -0.05)),
            heading,
            float(rng.uniform(0, 0.9)),
            turn=turn,
            lighting=draw_lighting(generator("record lighting", *key)) if "street-lighting" in effects else "",
        ),
    }
    return by_kind[kind or str(drawn_kind)]


def draw_lighting(draws: np.random.Generator) -> str:
    """Draw the class of the street lighting of a night."""
    return str(draws.choice(list(LIGHTING_SHARES), p=list(LIGHTING_SHARES.values())))


def describe_weather(weather: SceneWeather) -> str:
    """Describe a weather in words, such as "sun 40 degrees above the horizon, clouds 35 %"."""
    sun_degrees = round(np.degrees(weather.sun_height))
    phrases = [
        f"sun {abs(sun_degrees)} degrees {'below' if sun_degrees < 0 else 'above'} the horizon",
        f"clouds {weather.clouds:.0%}",
    ]
    if weather.fog:
        phrases.append(f"fog of {weather.fog:.3f}/m")
    if weather.lighting:
        phrases.append(f"street lighting {weather.lighting}")
    if weather.wet:
        phrases.append(f"wet road {weather.wet:.0%}")
    return ", ".join(phrases).replace("%", " %")


def depth_bytes(depth: Any) -> bytes:
    """Encode a depth map [H, W] at a quarter of the resolution as 16-bit PNG: 64 per metre, 65535 for the sky."""
    quarter = np.asarray(depth, np.float64)[2::4, 2::4]
    codes = np.where(np.isfinite(quarter), np.minimum(np.rint(quarter * 64), 65534), 65535).astype(np.uint16)
    return bytes(cv2.imencode(".png", codes, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def attributes_of(placed_object: PlacedObject) -> tuple[str, ...]:
    """The nuScenes attributes of a body at a moment."""
    body, moving = placed_object.body, placed_object.speed > 0.3
    if body.kind == "pedestrian":
        return ("pedestrian.moving",) if moving else ("pedestrian.standing",)
    if body.kind in ("motorcycle", "bicycle"):
        return ("cycle.without_rider",) if body.style == "parked" else ("cycle.with_rider",)
    if body.kind in ("traffic_cone", "barrier"):
        return ()
    return ("vehicle.parked",) if body.is_parked else ("vehicle.moving",) if moving else ("vehicle.stopped",)


def ego_at(trace: EpisodeTrace, time: float) -> F64:
    """Return the interpolated pose [4, 4] of the ego at a time, s."""
    exact_step = min(max(time / trace.dt, 0.0), len(trace.x) - 1.0)
    lower_step = min(int(exact_step), max(len(trace.x) - 2, 0))
    upper_step, fraction = min(lower_step + 1, len(trace.x) - 1), exact_step - lower_step
    yaw_change = float(wrap_angle(float(trace.yaw[upper_step, 0] - trace.yaw[lower_step, 0])))
    x, y = (
        float(coordinate[lower_step, 0]) + fraction * float(coordinate[upper_step, 0] - coordinate[lower_step, 0])
        for coordinate in (trace.x, trace.y)
    )
    return upright_pose(x, y, float(trace.yaw[lower_step, 0]) + fraction * yaw_change)


@lru_cache(maxsize=1)
def _street(town: str, streets: str, key: tuple[object, ...]) -> Street:
    """Return the street of a drive, kept for the next one along it."""
    return drive_street(load_town(town), streets, key=key)


def _record_scenes(task: tuple[Recording, str, Sequence[int]]) -> None:
    """Record scenes of a town, which share a street."""
    recording, town, numbers = task
    for number in numbers:
        _record_scene(recording, town, number)


def _scene_name(town: str, number: int) -> str:
    return f"scene-{town.lower()}-{number:03d}"


def _record_scene(recording: Recording, town: str, number: int) -> None:
    """Record one scene into its part; a finished part is left alone."""
    name = _scene_name(town, number)
    parts = recording.parts
    if parts.is_finished(name):
        return
    folder = parts.begin(name)
    start_warp_quietly()
    cv2.setNumThreads(1)
    key = (recording.seed, town, number)
    graph = load_town(town)
    street = _street(town, recording.streets, (recording.seed, town, number // DRIVES_PER_STREET))
    # The last sweep ends 0.1 s after the last step, and interpolation needs one more.
    seconds, streets = recording.seconds + 0.2, recording.streets
    episode = make_drive(graph, key=(recording.seed, number), seconds=seconds, streets=streets)
    trace = drive_with_autopilot(episode, graph)
    population = place_objects(trace, graph, street, key=key, streets=streets, many_signs=streets == "any")
    randomisation = recording.randomisation
    population.bodies = randomisation.randomise_bodies(population.bodies, key)
    weather = draw_weather(key, effects=recording.effects)
    draws = {channel: randomisation.draw_camera((*key, channel)) for channel in RIG}
    cameras = [draws[channel].camera(rig_camera(channel, recording.width)) for channel in RIG]
    samples: list[dict[str, Any]] = []
    files = _PartWriter(folder, {channel: draws[channel].quality(recording.quality) for channel in RIG})
    sweep_spacing = max(1, KEY // (recording.sweeps + 1))
    steps = [
        step
        for step in range(min(int(recording.seconds / trace.dt), len(trace.x) - 2) + 1)
        if step % KEY == 0 or (step % sweep_spacing == 0 and step % KEY <= sweep_spacing * recording.sweeps)
    ]
    # Most bodies of a town are never in view; building only the visible ones saves time and memory.
    meshes = [*population.meshes.select(_meshes_near(population, trace, steps)), *head_meshes()]
    heads = SignalHeads(graph, street, len(population.meshes))
    scene = RenderScene(street, meshes, device=recording.device)
    steps_per_call = GPU_STEPS if recording.device != "cpu" else 1
    for start in range(0, len(steps), steps_per_call):
        moments = [
            _Moment.of(step, population, heads, trace, (cameras, draws), weather, key)
            for step in steps[start : start + steps_per_call]
        ]
        for moment, shares in _render_moments(scene, moments, files, number, recording):
            sweep_end = moment.now
            ego = ego_at(trace, sweep_end)
            surrounding = population.at(sweep_end, ego[:2, 3], RENDER_RANGE)
            points, _ = sweep(
                scene, HDL32E, ego, [placed.scene_object for placed in surrounding], key=("lidar", *key, moment.step)
            )
            files.write_sweep(
                points,
                sweep=moment.step,
                moment=moment_timestamp(number, sweep_end),
                on_key=moment.is_key_frame,
                ego=ego,
            )
            if moment.is_key_frame:
                boxes = _annotate([placed for placed in surrounding if placed.body.kind], ego, points, shares)
                samples.append({"time": moment_timestamp(number, sweep_end), "sweep": moment.step, "boxes": boxes})
    part_page: dict[str, Any] = {
        "name": name,
        "town": town,
        "drive": episode.key,
        "samples": samples,
        "frames": files.rows,
        "weather": describe_weather(weather),
        "sensors": _sensors(cameras),
    }
    if randomisation:
        part_page["randomised"] = {
            "cameras": {channel: dict(draw.values) for channel, draw in draws.items()},
            "vehicles": describe_bodies(population.bodies),
        }
    parts.finish(name, part_page)


def _meshes_near(population: SceneObjects, trace: EpisodeTrace, steps: Sequence[int]) -> set[int]:
    """The meshes of all that is drawn at these steps."""
    mesh_indices = set()
    for step in steps:
        sweep_end = FIRST_SWEEP_END + step * trace.dt
        for time in [sweep_end, *(sweep_end - lead_time for lead_time in AHEAD.values())]:
            mesh_indices |= {
                placed.scene_object.mesh for placed in population.at(time, ego_at(trace, time)[:2, 3], RENDER_RANGE)
            }
    return mesh_indices


@dataclass(frozen=True, slots=True)
class _Moment:
    """Views of all cameras in one step.

    Attributes:
        step: Step of the world.
        now: End of the LiDAR's sweep, s.
        views: View of each camera.
        times: Time of each view, s.
        egos: Pose of the ego at each view.
    """

    step: int
    now: float
    views: list[View]
    times: list[float]
    egos: list[F64]

    @property
    def is_key_frame(self) -> bool:
        """True for a key frame."""
        return self.step % KEY == 0

    @staticmethod
    def of(  # noqa: PLR0917
        step: int,
        population: SceneObjects,
        heads: SignalHeads,
        trace: EpisodeTrace,
        cameras_and_draws: tuple[list[Camera], Mapping[str, CameraDraw]],
        weather: SceneWeather,
        key: tuple[object, ...],
    ) -> _Moment:
        """Each camera at its own time; the first sweep ends when every camera has fired."""
        sweep_end = FIRST_SWEEP_END + step * trace.dt
        cameras, draws = cameras_and_draws
        views, times, egos = [], [], []
        for camera_index, camera in enumerate(cameras):
            exposure_time = sweep_end - AHEAD[camera.channel]
            # The ego moves between the exposures of two cameras, as in nuScenes.
            ego = ego_at(trace, exposure_time)
            scene_objects = tuple(
                placed.scene_object for placed in population.at(exposure_time, ego[:2, 3], RENDER_RANGE)
            )
            noise_seed = int(digest("noise", *key, step, camera_index)[:7], 16)
            lamps = own_lamps(ego, weather)
            scene_objects += heads.trace_lights(trace, exposure_time, ego[:2, 3])
            draw = draws[camera.channel]
            view_weather, sensor = draw.weather(weather), draw.sensor(SENSOR, camera)
            views.append(View(camera, ego @ camera.to_ego, scene_objects, view_weather, sensor, noise_seed, lamps))
            times.append(exposure_time)
            egos.append(ego)
        return _Moment(step, sweep_end, views, times, egos)


def _render_moments(
    stage: RenderScene, moments: Sequence[_Moment], files: _PartWriter, number: int, recording: Recording
) -> Iterator[tuple[_Moment, dict[int, float]]]:
    """Render and write the pictures of some moments, all of them in one call or one by one.

    Yields:
        Each moment with the largest share of each thing that a camera sees (of key frames).
    """
    camera_moments = [(moment, camera_index) for moment in moments for camera_index in range(len(moment.views))]
    largest_shares: list[dict[int, float]] = [{} for _ in moments]
    views_per_call = len(camera_moments) if recording.device != "cpu" else 1
    quality = RenderQuality(effects=recording.effects)
    for start in range(0, len(camera_moments), views_per_call):
        batch = camera_moments[start : start + views_per_call]
        views = [moment.views[camera_index] for moment, camera_index in batch]
        rendering = render(stage, views, quality=quality, linear=False)
        for view_index, (moment, camera_index) in enumerate(batch):
            view = moment.views[camera_index]
            if moment.is_key_frame:
                shares = largest_shares[
                    next(moment_index for moment_index, candidate in enumerate(moments) if candidate is moment)
                ]
                for tag, share in visible_share(stage, view, rendering, view_index).items():
                    shares[tag] = max(shares.get(tag, 0.0), share)
            files.write_image(
                view.camera,
                rendering.image[view_index],
                rendering.depth[view_index],
                sweep=moment.step,
                moment=moment_timestamp(number, moment.times[camera_index]),
                on_key=moment.is_key_frame,
                ego=moment.egos[camera_index],
            )
    yield from zip(moments, largest_shares, strict=True)


def moment_timestamp(sweep_number: int, time: float) -> int:
    """Return the time stamp in us of a moment of scene `sweep_number`."""
    return START + sweep_number * 100_000_000 + round(time * 1e6)


def drive_with_autopilot(episode: Episode, graph: LaneGraph) -> EpisodeTrace:
    """Drive an episode with the Autopilot; the trace has all traffic lights and turn signals."""
    from ssad.drivers import make_system
    from ssad.world.rollout import rollout
    from ssad.world.world import World

    return rollout(World([episode], {graph.name: graph}), make_system("autopilot"), all_signals=True)[0]


@dataclass(slots=True)
class _PartWriter:
    """Files of a scene's part, and the rows that describe them; quality of JPEG by channel."""

    folder: Path
    quality: Mapping[str, int]
    rows: list[dict[str, Any]] = field(default_factory=list)

    def write_image(
        self, camera: Camera, image: U8, depth: Any, *, sweep: int, moment: int, on_key: bool, ego: F64
    ) -> None:
        """Write one image and its depth map."""
        name = f"{camera.channel}_{moment}"
        safeio.write_atomic(self.folder / f"{name}.depth.png", depth_bytes(depth))
        self._write(
            f"{name}.jpg",
            encode_jpeg(image, self.quality[camera.channel], "420"),
            channel=camera.channel,
            time=moment,
            key=on_key,
            size=[camera.width, camera.height],
            sweep=sweep,
            ego=ego.tolist(),
        )

    def write_sweep(self, points: Any, *, sweep: int, moment: int, on_key: bool, ego: F64) -> None:
        """Write one sweep."""
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


def _annotate(
    nearby_objects: list[PlacedObject], ego: F64, points: Any, shares: dict[int, float]
) -> list[dict[str, Any]]:
    """Boxes of what nuScenes has a category for, within reach and seen by a camera or hit by the LiDAR."""
    annotated_objects = [
        placed
        for placed in nearby_objects
        if placed.body.kind in BODY_CATEGORIES and np.hypot(*(placed.pose[:2, 3] - ego[:2, 3])) < ANNOTATION_RANGE
    ]
    if not annotated_objects:
        return []
    centre = np.array([placed.pose[:3, 3] + [0, 0, placed.body.size[2] / 2] for placed in annotated_objects])
    size_lwh = np.array([placed.body.size for placed in annotated_objects])
    rotation = matrix_to_quaternion([placed.pose[:3, :3] for placed in annotated_objects])
    boxes = WorldBoxes(centre, size_lwh, rotation, np.zeros_like(centre))
    pose = ego @ HDL32E.to_ego
    world_points = np.asarray(points[:, :3], np.float64) @ pose[:3, :3].T + pose[:3, 3]
    point_counts, size = points_in_boxes(world_points, boxes), boxes.size_wlh
    annotation_rows = []
    for row, placed_object in enumerate(annotated_objects):
        share = shares.get(placed_object.body.tag, 0.0)
        if point_counts[row] or share > 0:
            annotation_rows.append(
                {
                    "tag": placed_object.body.tag,
                    "category": category_of(placed_object.body.kind, placed_object.body.style),
                    "attributes": list(attributes_of(placed_object)),
                    "centre": centre[row].tolist(),
                    "size": size[row].tolist(),
                    "rotation": list(rotation[row]),
                    "points": int(point_counts[row]),
                    "visibility": visibility_token(share),
                }
            )
    return annotation_rows


def _sensors(cameras: list[Camera]) -> list[dict[str, Any]]:
    rows = [
        {
            "channel": camera.channel,
            "modality": "camera",
            "pose": camera.to_ego.tolist(),
            "intrinsic": camera.intrinsic.tolist(),
        }
        for camera in cameras
    ]
    return [*rows, {"channel": "LIDAR_TOP", "modality": "lidar", "pose": HDL32E.to_ego.tolist(), "intrinsic": []}]


def record_nuscenes(
    recording: Recording,
    *,
    workers: int | None = None,
    ray: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Path:
    """Record all scenes and write the tables; an interrupted recording is resumed.

    Returns:
        The root of the data set.

    Raises:
        StoreError: The folder holds something else, or scenes failed.
    """
    out = recording.out
    scenes_per_task = DRIVES_PER_STREET if recording.streets == "any" else 1
    tasks = [
        (recording, town, range(first_scene, min(first_scene + scenes_per_task, recording.scenes)))
        for town in recording.towns
        for first_scene in range(0, recording.scenes, scenes_per_task)
    ]
    if (out / recording.version / "splits.json").is_file():  # written last
        if not recording.parts.is_claimed:
            raise StoreError(f"{out}: holds a data set, but not how it was recorded (.parts); choose another folder")
        recording.parts.claim()
        return out
    pool = open_pool(len(tasks), workers=workers, ray=ray, device=recording.device)
    with recording.parts.lock("ssad record"):
        run_all(pool, _record_scenes, tasks, timeout_s=TIME_LIMIT, progress=progress)
        _merge(recording, [_scene_name(town, number) for _, town, numbers in tasks for number in numbers])
    return out


def _merge(recording: Recording, names: list[str]) -> None:
    """Build the tables from the parts and move the files to their places."""
    out = recording.out
    splits: dict[str, list[str]] = {"train": [], "val": [], "all": []}
    with NuScenesWriter(out, recording.version) as writer:
        for name in names:
            folder, part_page = recording.parts.part(name), recording.parts.page(name)
            description = f"{part_page['town']}, {part_page['weather']}"
            scene = writer.add_scene(name, description=description, location=part_page["town"])
            splits["val" if part_page["town"] in recording.held_out else "train"].append(name)
            splits["all"].append(name)
            for sensor in part_page["sensors"]:
                pose = np.array(sensor["pose"])
                writer.add_sensor(
                    scene,
                    sensor["channel"],
                    modality=sensor["modality"],
                    translation=tuple(pose[:3, 3]),
                    rotation=tuple(matrix_to_quaternion(pose[:3, :3])),
                    intrinsic=sensor["intrinsic"],
                )
            sample_tokens = {}
            for sample in part_page["samples"]:
                sample_tokens[sample["sweep"]] = writer.add_sample(scene, sample["time"])
            for frame in part_page["frames"]:
                ego = np.array(frame["ego"])
                token = writer.add_sensor_frame(
                    scene,
                    frame["channel"],
                    timestamp_us=frame["time"],
                    data=folder / frame["file"],
                    ego_translation=tuple(ego[:3, 3]),
                    ego_rotation=tuple(matrix_to_quaternion(ego[:3, :3])),
                    sample=sample_tokens[frame["sweep"]] if frame["key"] else None,
                    size=tuple(frame["size"]),
                )
                depth = folder / f"{frame['file'].removesuffix('.jpg')}.depth.png"
                if depth.is_file():
                    place_file(out / "depth" / frame["channel"] / f"{token}.png", depth)
            instance_tokens: dict[int, str] = {}
            for sample in part_page["samples"]:
                for box in sample["boxes"]:
                    if box["tag"] not in instance_tokens:
                        instance_tokens[box["tag"]] = writer.add_instance(
                            scene, f"thing-{box['tag']}", category=box["category"]
                        )
                    writer.add_annotation(
                        sample_tokens[sample["sweep"]],
                        instance_tokens[box["tag"]],
                        translation=box["centre"],
                        size=box["size"],
                        rotation=box["rotation"],
                        visibility=box["visibility"],
                        attributes=box["attributes"],
                        lidar_points=box["points"],
                    )
        for split, scene_names in splits.items():
            writer.set_split(split, scene_names)
    if recording.randomisation:
        page = {
            "ranges": recording.randomisation.identity(),
            "scenes": {name: recording.parts.page(name)["randomised"] for name in names},
        }
        safeio.write_atomic(out / recording.version / RANDOMISED, safeio.dump_json(page) + "\n")

"""Record images of a target for 2D detection, with COCO annotations (`ssad record --clips`).

drive: a camera follows the driving target on its route, 20 m behind, as in the paper; orbit: views of a target on
the road, or of a stop sign beside it, over distance, azimuth, elevation and weather. A recording consists of
parts, as that of drives does: images are written to their final places, a page of each part to OUT/.parts, and the
annotations when all parts are complete. Any number of processes therefore gives the same bytes, and a stopped run
can be resumed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from itertools import islice, product
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from ssad.core import safeio
from ssad.core.boxes import UNIT_CORNERS, image_rectangles
from ssad.core.errors import ConfigError, FormatError, StoreError
from ssad.core.frames import Camera
from ssad.core.images import encode_jpeg
from ssad.core.machine import start_warp_quietly
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.rotations import upright_pose
from ssad.core.seeding import digest, generator
from ssad.core.types import F64, U8, EpisodeTrace
from ssad.datasets.coco import coco_data
from ssad.engine.pool import open_pool, run_all
from ssad.recorders.drives import drive_street, make_drive
from ssad.recorders.nuscenes import draw_weather, drive_with_autopilot
from ssad.recorders.parts import TIME_LIMIT, is_same_request
from ssad.recorders.randomisation import CameraDraw, Randomisation, describe_body
from ssad.recorders.target_recording import BEHIND, FOCAL, SMALL, TargetRecording
from ssad.recorders.viewpoints import (
    AIM,
    Place,
    Viewpoint,
    between,
    following_viewpoints,
    has_free_sight,
    has_room,
    near_share,
    orbiting_viewpoints,
    shuffled_cells,
    sign_viewpoints,
    weather_name,
)
from ssad.rendering.bodies import draw_paint, draw_size, draw_style, make_body
from ssad.rendering.bodies.actor_bodies import BODY_CATEGORIES, PLAIN_CLASSES, class_of
from ssad.rendering.camera.labels import label_image
from ssad.rendering.camera.lamps import NOSE, own_lamps
from ssad.rendering.camera.render import Rendering, RenderQuality, SceneWeather, View, render
from ssad.rendering.camera.scene import RenderScene, SceneObject, TextureDecal, TextureLayer
from ssad.rendering.camera.sensor import SENSOR
from ssad.rendering.meshes.mesh import Point
from ssad.rendering.scene_objects import (
    GroundOccupancy,
    ObjectBody,
    PlacedObject,
    SceneObjects,
    occupy_standing,
    place_objects,
)
from ssad.rendering.signal_heads import SignalHeads, head_meshes
from ssad.rendering.street_signs import free_places, plate_and_post
from ssad.rendering.target import STANDING, TargetCar, TargetSign, TargetWalker, class_of_target
from ssad.world.roads import load_town

CLASSES: Final = (*MMDET3D_CLASSES, *PLAIN_CLASSES)  # category ids are 1 and more in this order
EACH: Final = 25  # pictures of a part: of one drive, if all can be taken there
MAX_DRIVES: Final = 12  # tried for a part; from the fourth on, an orbit takes other cells than it should
PLACE_TRIES: Final = (3, 6, 12, 24)  # places tried for one view of an orbit in each turn of one drive
TARGETS: Final = 5  # bodies that an orbit shows in turn
SECONDS: Final = 24.0  # of a drive
APPROACH_SECONDS: Final = 48.0  # of a drive in which the target is seen from far
TARGET: Final = 1_000_000  # its tag
HIDDEN: Final = 0.25  # visible share below which an object is crowd, as one with a side below SMALL
MIN_VISIBLE_SHARE: Final = 0.6  # least visible share of the target, and least share of it inside the picture
STRAIGHT: Final = 0.95  # least distance of a target on an approach, as a share of the way to it
MAX_NEAR_SHARE: Final = 0.2  # largest share of the picture that something right before the camera may cover


@dataclass(frozen=True, slots=True)
class _TargetDrive:
    """A drive to take images of.

    Attributes:
        recording: Settings of the recording.
        key: Key of all random draws.
        trace: The drive.
        population: Bodies of the drive.
        scene: Street and bodies, ready to be rendered.
        heads: Signals of the street.
        targets: Bodies that play the target in turn.
        places: Possible places of a standing target.
    """

    recording: TargetRecording
    key: tuple[object, ...]
    trace: EpisodeTrace
    population: SceneObjects
    scene: RenderScene
    heads: SignalHeads
    targets: tuple[ObjectBody, ...]
    places: tuple[Place, ...] = ()


def _prepare(recording: TargetRecording, town: str, key: tuple[object, ...]) -> _TargetDrive:
    graph = load_town(town)
    seconds = APPROACH_SECONDS if recording.approach else SECONDS
    street = drive_street(graph, recording.streets, key=("clips", *key))
    trace = drive_with_autopilot(make_drive(graph, key=("clips", *key), seconds=seconds), graph)
    population = place_objects(trace, graph, street, key=key, many_signs=recording.streets == "any")
    places: tuple[Place, ...] = ()
    randomisation = recording.randomisation
    if isinstance(recording.target, TargetSign):
        targets: tuple[ObjectBody, ...] = (_add_target_sign(population, recording.target),)
        route_points = np.stack([trace.x[:, 0], trace.y[:, 0]], -1)[::5].astype(np.float64)
        free_ground = GroundOccupancy(street)
        occupy_standing(population, free_ground)
        free_spots = free_places(graph, route_points, free_ground, key=("target", *key))
        places = tuple((*place, plate_height(targets[0])) for place in free_spots)
    elif recording.target is not None:
        targets = (_add_target_body(population, recording.target),)
    else:
        target_count = TARGETS if recording.mode == "orbit" else 1
        targets = tuple(
            _draw_target(population, generator("clips target", *key, index)) for index in range(target_count)
        )
    population.bodies = randomisation.randomise_bodies(population.bodies, key)
    # A target that was asked for keeps its paint.
    has_paint = recording.target is None
    targets = tuple(
        randomisation.randomise_body(target, (*key, "target", index), has_paint=has_paint)
        for index, target in enumerate(targets)
    )
    return _TargetDrive(
        recording,
        key,
        trace,
        population,
        RenderScene(street, [*population.meshes, *head_meshes()], device=recording.device),
        SignalHeads(graph, street, len(population.meshes)),
        targets,
        places,
    )


def _surrounding(stage_set: _TargetDrive, viewpoint: Viewpoint) -> list[PlacedObject]:
    """Return the objects around the camera; on an approach, without those between it and the target."""
    placed_objects = stage_set.population.at(viewpoint.time, viewpoint.camera[:2, 3], 150.0)
    if not stage_set.recording.approach:
        return placed_objects
    is_between = between(stage_set.targets[0], viewpoint, placed_objects)
    return [placed for placed, is_hiding in zip(placed_objects, is_between, strict=True) if not is_hiding]


def _draw_target(population: SceneObjects, rng: np.random.Generator) -> ObjectBody:
    """Some car in the place of the ego, with its mesh in the cast."""
    style = draw_style("car", generator=rng)
    full_size = draw_size("car", style, generator=rng)
    # The car plays the ego of the drive, so its footprint is bounded.
    size = min(full_size[0], 4.9), min(full_size[1], 2.06), full_size[2]
    mesh = population.meshes.add(make_body("car", style=style, size=size, generator=rng))
    return _body(mesh, style, size, draw_paint(rng))


def _add_target_body(population: SceneObjects, target: TargetCar | TargetWalker) -> ObjectBody:
    """The target in the place of the ego, with its mesh in the cast."""
    body = _body(population.meshes.add(target.mesh()), target.style, target.full_size, target.colour)
    return replace(body, kind=class_of_target(target))


def _add_target_sign(population: SceneObjects, target: TargetSign) -> ObjectBody:
    """The target sign: its plate, which is labelled, and its post."""
    meshes = tuple(population.meshes.add(mesh) for mesh in plate_and_post(target.mesh()))
    size, static_track = target.full_size, (np.zeros((1, 4)), np.ones(1, bool), np.zeros(1))
    return ObjectBody(TARGET, target.kind, target.style, size, (0.5, 0.5, 0.5), meshes, *static_track)


def plate_height(sign: ObjectBody) -> float:
    """Return the height of the middle of a sign's plate above its foot, m."""
    return sign.size[2] - sign.size[1] / 2


def _body(mesh: int, style: str, size: Point, paint: tuple[float, float, float]) -> ObjectBody:
    return ObjectBody(TARGET, "car", style, size, paint, (mesh,), np.zeros((1, 4)), np.ones(1, bool), np.zeros(1))


def batch_size(device: str) -> int:
    """Return the number of views rendered at once; on the CPU one is as fast as many."""
    return 1 if device == "cpu" else 32


def _viewpoint_rounds(
    stage_set: _TargetDrive, town: str, slots: range, attempt: int, missing: Callable[[], list[int]]
) -> Iterator[list[tuple[int, Viewpoint]]]:
    """Again and again shots for what is missing (numbers from 0 in the part), until this drive has no more."""
    recording, key = stage_set.recording, stage_set.key
    rng = generator("clips shots", *key)
    if recording.approach:
        yield from _approaching_rounds(stage_set, town, slots, missing, rng)
        return
    if recording.mode == "drive":
        weather = draw_weather(("clips", *key), effects=recording.effects)
        remaining = iter(
            following_viewpoints(
                stage_set.trace, weather, behind=recording.behind, height=recording.height, count=len(slots), rng=rng
            )
        )
        while batch := list(zip(missing(), remaining, strict=False)):
            yield batch
        return
    if isinstance(recording.target, TargetSign) and not stage_set.places:
        return
    grid = list(product(recording.distances, recording.azimuths, recording.elevations, recording.weathers or ("",)))
    cell_indices = shuffled_cells(slots, len(grid), key=(recording.seed, town))
    if attempt >= 3:
        # Some cells have no free view in a town; random cells keep the recording from stalling.
        cell_indices = generator("clips cells", *key).integers(len(grid), size=len(slots)).tolist()
    # low things before a sign hide little of it
    height = stage_set.places[0][4] if stage_set.places else 2 * AIM
    for turn, attempts in enumerate(PLACE_TRIES):
        proposals: list[tuple[int, Viewpoint]] = []
        for index in missing():
            *cell, weather_kind = grid[cell_indices[index]]
            weather = draw_weather(("clips", *key, turn, index), weather_kind, effects=recording.effects)
            if isinstance(recording.target, TargetSign):
                seconds = (len(stage_set.trace.x) - 1) * stage_set.trace.dt
                views = sign_viewpoints(stage_set.places, seconds, weather, (cell[0], cell[1]), rng)
            else:
                views = orbiting_viewpoints(stage_set.trace, weather, (cell[0], cell[1], cell[2]), rng)
            proposals += [(index, viewpoint) for viewpoint in islice(views, attempts)]
        sight_free = has_free_sight(
            stage_set.scene,
            [viewpoint for _, viewpoint in proposals],
            batch=batch_size(recording.device),
            height=height,
        )
        # Reversed, so that the first free proposal of each image wins.
        first_free = dict(reversed([pair for pair, is_free in zip(proposals, sight_free, strict=True) if is_free]))
        yield sorted(first_free.items())


def _approaching_rounds(
    stage_set: _TargetDrive, town: str, slots: range, missing: Callable[[], list[int]], rng: np.random.Generator
) -> Iterator[list[tuple[int, Viewpoint]]]:
    """Yield rounds of shots for missing images, each at its own distance, until the drive has no more."""
    recording = stage_set.recording
    weather = draw_weather(("clips", *stage_set.key), effects=recording.effects)
    distance_indices = shuffled_cells(slots, len(recording.approach), key=(recording.seed, town))
    remaining: dict[int, Iterator[Viewpoint]] = {}
    for index, distance in enumerate(recording.approach):
        viewpoints = following_viewpoints(
            stage_set.trace,
            weather,
            behind=distance,
            height=recording.height,
            count=distance_indices.count(index),
            rng=rng,
        )
        remaining[index] = _visible_viewpoints(stage_set, viewpoints, distance)
    while True:
        batch = []
        for slot in missing():
            viewpoint = next(remaining[distance_indices[slot]], None)
            if viewpoint is not None:
                batch.append((slot, viewpoint))
        if not batch:
            return
        yield batch


def _visible_viewpoints(
    stage_set: _TargetDrive, viewpoints: Sequence[Viewpoint], distance: float
) -> Iterator[Viewpoint]:
    """Yield the viewpoints of an approach from which the street does not hide the target, with their distance."""
    for viewpoint in viewpoints:
        if viewpoint.description["distance"] < STRAIGHT * distance:
            continue  # behind a bend
        if has_free_sight(stage_set.scene, [viewpoint], batch=1, height=2 * AIM)[0]:
            yield replace(viewpoint, description=viewpoint.description | {"distance": distance})


def _record_part(task: tuple[TargetRecording, str, int, int, str]) -> str:
    """Record `count` images, of one drive if possible, and return the name of the part.

    A finished part is left alone.

    Raises:
        ConfigError: The drives show too few views of the target.
    """
    recording, town, number, count, name = task
    parts = recording.parts
    if parts.is_finished(name):
        return name
    parts.begin(name)
    start_warp_quietly()
    cv2.setNumThreads(1)
    rows: dict[int, dict[str, Any]] = {}
    skipped: Counter[str] = Counter()
    slots = range(number * EACH, number * EACH + count)

    def missing() -> list[int]:
        return [index for index in range(count) if index not in rows]

    for attempt in range(MAX_DRIVES):
        stage_set = _prepare(recording, town, (recording.seed, recording.mode, town, number, attempt))
        for viewpoints in _viewpoint_rounds(stage_set, town, slots, attempt, missing):
            for image_index, row, image in _accept_views(stage_set, viewpoints, skipped):
                file = f"{name}-{image_index:03d}.jpg"
                quality = _draw_camera(stage_set, image_index).quality(recording.quality)
                safeio.write_atomic(recording.out / "images" / file, encode_jpeg(image, quality, "420"))
                base_row = {
                    "file_name": file,
                    "town": town,
                    "drive": stage_set.trace.key,
                    "part": number,
                    "attempt": attempt,
                }
                rows[image_index] = base_row | {"slot": image_index} | row
        if not missing():
            break
    else:
        reasons = (
            ", ".join(f"{occurrences} {reason}" for reason, occurrences in sorted(skipped.items()))
            or "the drives are too short"
        )
        raise ConfigError(
            f"{town}: {len(rows)} of {count} pictures in {MAX_DRIVES} drives ({reasons}); choose smaller distances"
        )
    parts.finish(name, {"images": [rows[image_index] for image_index in range(count)], "skipped": skipped})
    return name


def _accept_views(
    stage_set: _TargetDrive, shots: Sequence[tuple[int, Viewpoint]], skipped: Counter[str]
) -> Iterator[tuple[int, dict[str, Any], U8]]:
    """Renders and labels shots; those that show their target, with what is annotated. Counts why others do not."""
    recording = stage_set.recording
    candidates: list[tuple[int, Viewpoint, View, list[PlacedObject]]] = []
    for slot, viewpoint in shots:
        target = stage_set.targets[slot % len(stage_set.targets)]
        surrounding = _surrounding(stage_set, viewpoint)
        if not has_room(target, viewpoint, surrounding):
            skipped["crowded"] += 1
            continue
        draw = _draw_camera(stage_set, slot)
        # Orbits ask for places of the camera; only its pitch may change them.
        pose = draw.pose(viewpoint.camera, raised=recording.mode == "drive")
        viewpoint = replace(viewpoint, camera=pose, weather=draw.weather(viewpoint.weather))  # noqa: PLW2901
        view = _view(stage_set, slot, viewpoint, surrounding, draw)
        surrounding.append(PlacedObject(target, viewpoint.target, 0.0, view.objects[0]))
        candidates.append((slot, viewpoint, view, surrounding))
    batch = batch_size(recording.device)
    for start in range(0, len(candidates), batch):
        views, quality = [view for _, _, view, _ in candidates[start : start + batch]], recording.render_quality
        rendering = render(stage_set.scene, views, quality=quality, linear=False)
        for index, (slot, viewpoint, view, surrounding) in enumerate(candidates[start : start + batch]):
            objects, reject_reason = _annotate(stage_set.scene, view, rendering, index, surrounding)
            if reject_reason:
                skipped[reject_reason] += 1
                continue
            target = surrounding[-1].body
            row = {
                "width": recording.size,
                "height": recording.size,
                "time": viewpoint.time,
                "weather": weather_name(viewpoint.weather),
                "light": asdict(viewpoint.weather),
                "intrinsic": view.camera.intrinsic.tolist(),
                "pose": viewpoint.camera.tolist(),
                "target_pose": viewpoint.target.tolist(),
                "target_style": target.style,
                "target_size": [round(extent, 3) for extent in target.size],
                "objects": objects,
            }
            if recording.randomisation:
                row["randomised"] = dict(_draw_camera(stage_set, slot).values) | {"target": describe_body(target)}
            yield slot, row | viewpoint.description, rendering.image[index]


def _draw_camera(stage_set: _TargetDrive, slot: int) -> CameraDraw:
    """Draw the camera of an image."""
    return stage_set.recording.randomisation.draw_camera((*stage_set.key, slot))


def label_of(kind: str) -> int | None:
    """Return the index into `CLASSES` of a kind of body; None for background."""
    if kind in PLAIN_CLASSES:
        return CLASSES.index(kind)
    return CLASSES.index(class_of(kind)) if kind in BODY_CATEGORIES else None


def is_facing(sign: F64, viewer: F64) -> bool:
    """Return whether the front of a sign of pose [4, 4] can be read from a position [3]: not from behind or aside."""
    forward, left, _ = sign[:3, :3].T @ (viewer - sign[:3, 3])
    return bool(abs(np.degrees(np.arctan2(left, forward))) < BEHIND)


def _camera(size: int) -> Camera:
    centre, focal = size / 2, FOCAL * size
    return Camera(size, size, np.array([[focal, 0, centre], [0, focal, centre], [0, 0, 1.0]]))


def _view(
    stage_set: _TargetDrive, n: int, viewpoint: Viewpoint, nearby_objects: Sequence[PlacedObject], draw: CameraDraw
) -> View:
    """View `n` of a part: the target first, then who else is there."""
    target = stage_set.targets[n % len(stage_set.targets)]
    camera = draw.camera(_camera(stage_set.recording.size))
    target_object = SceneObject(target.meshes[0], viewpoint.target, target.paint, TARGET, finish=target.finish)
    noise_seed = int(digest("clips noise", *stage_set.key, n)[:7], 16)
    lamps = own_lamps(_follower(viewpoint), viewpoint.weather) if stage_set.recording.mode == "drive" else ()
    focus_point = float(viewpoint.target[0, 3]), float(viewpoint.target[1, 3])
    other_parts = (SceneObject(mesh, viewpoint.target, target.paint) for mesh in target.meshes[1:])
    lights = stage_set.heads.trace_lights(stage_set.trace, viewpoint.time, viewpoint.camera[:2, 3])
    scene_objects = (target_object, *other_parts, *(placed.scene_object for placed in nearby_objects), *lights)
    return View(
        camera,
        viewpoint.camera,
        scene_objects,
        viewpoint.weather,
        draw.sensor(SENSOR, camera),
        noise_seed,
        lamps,
        focus_point,
    )


def _follower(viewpoint: Viewpoint) -> F64:
    """The vehicle [4, 4] that carries the following camera, which is 2 m behind its nose."""
    camera_position, forward = viewpoint.camera[:3, 3], viewpoint.camera[:3, 2]
    pose = upright_pose(float(camera_position[0]), float(camera_position[1]), float(np.arctan2(forward[1], forward[0])))
    return pose @ upright_pose(2.0 - NOSE, 0.0, 0.0)


def _annotate(
    scene: RenderScene, view: View, picture: Rendering, index: int, nearby_objects: Sequence[PlacedObject]
) -> tuple[list[dict[str, Any]], str]:
    """Return the annotation of an image, and the reason why the image is of no use ("" if it is of use)."""
    labels = label_image(scene, view, picture, index)
    placed_by_tag = {placed.body.tag: placed for placed in nearby_objects}
    is_target = labels.tag == TARGET
    extents = labels.box[:, 2:] - labels.box[:, :2]
    if not is_target.any() or labels.share[is_target][0] < MIN_VISIBLE_SHARE:
        return [], "hidden"
    if labels.image_share[is_target][0] < MIN_VISIBLE_SHARE or extents[is_target].min() < SMALL:
        return [], "cut or small"
    target_distance = float(np.linalg.norm(placed_by_tag[TARGET].pose[:3, 3] - view.pose[:3, 3]))
    # A wall or post right before the camera leaves too little of the street to see.
    if (
        near_share(view, picture.depth[index], picture.tag[index], max_distance=max(2.0, target_distance / 3))
        > MAX_NEAR_SHARE
    ):
        return [], "blocked"
    is_crowd = (extents.min(1) < SMALL) | (labels.share < HIDDEN)
    objects = []
    for row, tag in enumerate(labels.tag.tolist()):
        placed_object = placed_by_tag[tag]
        label = label_of(placed_object.body.kind)
        if label is not None:
            centre_height = placed_object.body.size[2] / 2
            if placed_object.body.kind in PLAIN_CLASSES:
                is_crowd[row] |= not is_facing(placed_object.pose, view.pose[:3, 3])
                centre_height = plate_height(placed_object.body)
            middle = placed_object.pose[:3, 3] + [0.0, 0.0, centre_height]
            x1, y1, x2, y2 = _image_rectangle(view, placed_object.pose, placed_object.body.size).tolist()
            objects.append(
                {
                    "label": label,
                    "box": labels.box[row].tolist(),
                    "pixels": int(labels.pixels[row]),
                    "crowd": bool(is_crowd[row]),
                    "target": tag == TARGET,
                    "hull": [x1, y1, x2 - x1, y2 - y1],
                    "visible": round(float(labels.share[row]), 3),
                    "distance": round(float(np.linalg.norm(middle - view.pose[:3, 3])), 2),
                }
            )
    return objects, ""


def _image_rectangle(view: View, pose: F64, size: tuple[float, float, float]) -> F64:
    """Return x1, y1, x2, y2 (px) around the whole 3D box of a body, visible or not."""
    # The pose of a body is that of the middle of its base.
    corners = (UNIT_CORNERS + np.array([0.0, 0.0, 0.5])) * size
    body_to_camera = np.linalg.inv(view.pose) @ pose
    camera_corners, camera = corners @ body_to_camera[:3, :3].T + body_to_camera[:3, 3], view.camera
    box = image_rectangles(camera_corners[None], camera.intrinsic, (camera.width, camera.height))[0]
    return np.asarray(np.round(box, 2))


def record_target_images(
    recording: TargetRecording,
    *,
    workers: int | None = None,
    ray: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Path:
    """Takes all pictures and writes annotations/{train,test,all}.json; the folder. Run again to go on.

    Each file's `info` says what was recorded, how many objects there are of each class, and how many pictures were
    taken elsewhere instead, and why. StoreError, ConfigError.
    """
    return record_all([recording], workers=workers, ray=ray, progress=progress)[0]


def record_all(
    recordings: Sequence[TargetRecording],
    *,
    workers: int | None = None,
    ray: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[Path]:
    """Record several recordings, as `record_target_images` does, with all their parts side by side.

    Returns:
        Their folders.

    Raises:
        StoreError: See `record_target_images`.
        ConfigError: See `record_target_images`.
    """
    tasks: list[list[tuple[TargetRecording, str, int, int, str]]] = []
    for recording in recordings:
        _check_same_recording(recording)
        tasks.append(
            [
                (recording, town, number, min(EACH, count - start), f"{recording.mode}-{town.lower()}-{number:03d}")
                for town, count in recording.images
                for number, start in enumerate(range(0, count, EACH))
            ]
        )
    all_tasks = [task for recording_tasks in tasks for task in recording_tasks]
    with ExitStack() as locks:
        for recording in recordings:
            locks.enter_context(recording.parts.lock("ssad record"))
            safeio.remove_unfinished(recording.out / "images")
        pool = open_pool(len(all_tasks), workers=workers, ray=ray, device=recordings[0].device)
        run_all(pool, _record_part, all_tasks, timeout_s=TIME_LIMIT, progress=progress)
        for recording, recording_tasks in zip(recordings, tasks, strict=True):
            _write_pages(recording, recording_tasks)
    return [recording.out for recording in recordings]


def _check_same_recording(recording: TargetRecording) -> None:
    """StoreError: the folder holds another recording."""
    annotations_file = recording.out / "annotations" / "all.json"
    if annotations_file.is_file() and not recording.parts.is_claimed:
        data = safeio.read_json(annotations_file)
        info = data.get("info") if isinstance(data, dict) else None
        if not isinstance(info, dict) or not is_same_request(info.get("recording"), recording.identity()):
            raise StoreError(f"{recording.out}: holds another recording; choose another folder")


def _write_pages(recording: TargetRecording, tasks: Sequence[tuple[TargetRecording, str, int, int, str]]) -> None:
    """annotations/{train,test,all}.json of parts that are all there."""
    splits = {
        "train": [entry_task for entry_task in tasks if entry_task[1] not in recording.held_out],
        "test": [entry_task for entry_task in tasks if entry_task[1] in recording.held_out],
        "all": tasks,
    }
    for split, split_tasks in splits.items():
        rows: list[dict[str, Any]] = []
        reject_counts: Counter[str] = Counter()
        for task in split_tasks:
            part_page = recording.parts.page(task[4])
            rows += part_page["images"]
            reject_counts.update(part_page["skipped"])
        counts = Counter(CLASSES[entry["label"]] for row in rows for entry in row["objects"] if not entry["crowd"])
        split_info = {
            "recording": recording.identity(),
            "split": split,
            "towns": sorted({entry_task[1] for entry_task in split_tasks}),
            "images": len(rows),
            "objects": counts,
            "weathers": Counter(row["weather"] for row in rows),
            "skipped": reject_counts,
        }
        page = safeio.dump_json(coco_data(CLASSES, rows, split_info)) + "\n"
        safeio.write_atomic(recording.out / "annotations" / f"{split}.json", page)


@dataclass(frozen=True, slots=True)
class RecordedView:
    """A recorded picture and what it shows, ready to be rendered again.

    Attributes:
        file: Its name in the folder `images`.
        row: What the annotation file says of it.
        scene: Street and bodies.
        view: Camera, things (the target first, tag `TARGET`) and light.
        objects: What is annotated in it: label (index into `CLASSES`), bbox (x, y, width, height) of what is seen, hull
            (the same of the whole 3D box), area, target ...
        quality: Quality with which it was rendered.
    """

    file: str
    row: Mapping[str, Any]
    scene: RenderScene
    view: View
    objects: tuple[Mapping[str, Any], ...]
    quality: RenderQuality

    def with_layers(self, *edits: TextureLayer | TextureDecal) -> View:
        """The view with layers on the target, and with decals, given in the target's frame, around it."""
        target, *other_objects = self.view.objects
        layers = tuple(layer for layer in edits if isinstance(layer, TextureLayer))
        decals = tuple(
            replace(layer, pose=target.pose @ layer.pose) for layer in edits if isinstance(layer, TextureDecal)
        )
        textured_target = replace(target, layers=layers)
        return replace(self.view, objects=(textured_target, *other_objects), decals=(*self.view.decals, *decals))


Row = Mapping[str, Any]


def image_rows(folder: Path, split: str = "all") -> list[tuple[Row, tuple[Row, ...]]]:
    """Return the images of a recording in order, each with its annotations.

    Args:
        folder: Folder of the recording.
        split: train, test or all.

    Raises:
        FormatError: The folder holds no recording.
    """
    path = folder / "annotations" / f"{split}.json"
    data = safeio.read_json(path, limit=1 << 30)
    try:
        by_image: dict[int, list[Row]] = {row["id"]: [] for row in data["images"]}
        for annotation in data["annotations"]:
            by_image[annotation["image_id"]].append(annotation)
        return [(row, tuple(by_image[row["id"]])) for row in data["images"]]
    except (KeyError, TypeError) as error:
        raise _unknown(path, error) from None


def recording_of(folder: Path, split: str = "all") -> dict[str, Any]:
    """Return the description of a recording (see `TargetRecording.identity`).

    Raises:
        FormatError: No recording.
    """
    path = folder / "annotations" / f"{split}.json"
    try:
        return dict(safeio.read_json(path, limit=1 << 30)["info"]["recording"])
    except (KeyError, TypeError, ValueError) as error:
        raise _unknown(path, error) from None


def recorded_views(
    folder: Path,
    *,
    split: str = "all",
    device: str = "cpu",
    selected_keys: Collection[str] | None = None,
    hour: Callable[[SceneWeather, float], SceneWeather] = lambda weather, heading: weather,
    stages: dict[Any, Any] | None = None,
) -> Iterator[RecordedView]:
    """The pictures of a recording with their scenes, in order.

    Rendering a view with its quality gives the recorded picture (before JPEG) again. Pictures of one drive share a
    scene.

    Args:
        folder: What `record_target_images` wrote.
        split: train, test or all.
        device: Where to render.
        selected_keys: Names of the files that are wanted; None for all.
        hour: The weather to show instead of the recorded one, from that and the heading of the target, rad.
        stages: Where all scenes are kept for another call; None: they are let go one after the other.

    Raises:
        FormatError: No recording of this version.
    """
    path = folder / "annotations" / f"{split}.json"
    rows = image_rows(folder, split)
    try:
        recording = _recording_from_description(recording_of(folder, split), folder, device)
        prepared_drives: dict[tuple[object, ...], _TargetDrive] = {} if stages is None else stages
        for row, objects in rows:
            if selected_keys is not None and row["file_name"] not in selected_keys:
                continue
            key = (recording.seed, recording.mode, row["town"], row["part"], row["attempt"])
            if key not in prepared_drives:
                if stages is None:  # one part at a time: its pictures may come from several drives
                    prepared_drives = {
                        other_key: other_drive
                        for other_key, other_drive in prepared_drives.items()
                        if other_key[:-1] == key[:-1]
                    }
                prepared_drives[key] = _prepare(recording, row["town"], key)
            stage_set = prepared_drives[key]
            target_pose = np.array(row["target_pose"])
            weather = hour(SceneWeather(**row["light"]), float(np.arctan2(target_pose[1, 0], target_pose[0, 0])))
            viewpoint = Viewpoint(row["time"], np.array(row["pose"]), target_pose, weather, {})
            surrounding = _surrounding(stage_set, viewpoint)
            view = _view(stage_set, row["slot"], viewpoint, surrounding, _draw_camera(stage_set, row["slot"]))
            yield RecordedView(row["file_name"], row, stage_set.scene, view, objects, recording.render_quality)
    except (KeyError, TypeError) as error:
        raise _unknown(path, error) from None


def _unknown(path: Path, error: Exception) -> FormatError:
    error_text = f"({type(error).__name__}: {error})"
    return FormatError(f"{path}: not the clips of this version {error_text}; record them again")


def _recording_from_description(description: Mapping[str, Any], folder: Path, device: str) -> TargetRecording:
    """The recording that `TargetRecording.identity` describes."""
    settings: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in description.items()
        if name != "clips"
    }
    settings["randomisation"] = Randomisation.of(settings.get("randomisation", {}))
    settings["effects"] = frozenset(description["effects"])
    settings["images"] = tuple((town, count) for town, count in description["images"])
    if description["target"] is not None:
        size = description["target"]["size"]
        target_settings = {name: value for name, value in description["target"].items() if name != "kind"}
        target_class: Any = STANDING[description["target"]["kind"]] if "kind" in description["target"] else TargetCar
        settings["target"] = target_class(**target_settings | {"size": None if size is None else tuple(size)})
    return TargetRecording(folder, **settings | {"mode": description["clips"], "device": device})

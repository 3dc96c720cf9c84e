"""`ssad record --clips`: pictures of a target, a car or a stop sign, for 2D detection, with COCO annotations.

drive: a camera follows the driving target on its own way, 20 m behind, as in the paper; orbit: views of a target on the
road, or of a stop sign beside it, over distance, azimuth, elevation and weather. Recorded in parts as drives are:
pictures are written to their places, a page of each part to OUT/.parts, the annotations when all parts are there. So
any number of processes gives the same bytes, and a run that was stopped goes on.
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
from ssad.core.boxes import UNIT_CORNERS, hulls
from ssad.core.errors import ConfigError, FormatError, StoreError
from ssad.core.frames import Camera
from ssad.core.images import encode_jpeg
from ssad.core.machine import quiet_warp
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.rotations import upright_pose
from ssad.core.seeding import digest, generator
from ssad.core.types import F64, U8, EpisodeTrace
from ssad.datasets.coco import coco_data
from ssad.engine.pool import open_pool, run_all
from ssad.engine.store import locked
from ssad.recorders.drives import drive_street, make_drive
from ssad.recorders.nuscenes import PART_S, check_parts, draw_weather, drive
from ssad.recorders.target_recording import BEHIND, FOCAL, SMALL, Clips
from ssad.recorders.viewpoints import (
    AIM,
    Place,
    Viewpoint,
    follow,
    free_sight,
    has_room,
    near_share,
    orbit,
    orbit_sign,
    turn_of,
    weather_name,
)
from ssad.rendering.bodies import draw_paint, draw_size, draw_style, make_body
from ssad.rendering.bodies.actor_bodies import BODY_CATEGORIES, PLAIN_CLASSES, class_of
from ssad.rendering.camera.labels import label_picture
from ssad.rendering.camera.lamps import NOSE, own_lamps
from ssad.rendering.camera.render import Picture, View, Weather, render
from ssad.rendering.camera.scene import Decal, Layer, Scene, Thing
from ssad.rendering.camera.sensor import SENSOR
from ssad.rendering.meshes.mesh import Point
from ssad.rendering.scene_objects import Clear, ObjectBody, PlacedObject, SceneObjects, place_objects, take_still
from ssad.rendering.street_signs import free_places, plate_and_post
from ssad.rendering.target import STANDING, TargetCar, TargetSign, TargetWalker, class_of_target
from ssad.world.roads import load_town

CLASSES: Final = (*MMDET3D_CLASSES, *PLAIN_CLASSES)  # category ids are 1 and more in this order
EACH: Final = 25  # pictures of a part: of one drive, if all can be taken there
DRIVES: Final = 12  # tried for a part; from the fourth on, an orbit takes other cells than it should
TRIES: Final = (3, 6, 12, 24)  # places tried for one view of an orbit in each turn of one drive
TARGETS: Final = 5  # bodies that an orbit shows in turn
SECONDS: Final = 24.0  # of a drive
TARGET: Final = 1_000_000  # its tag
HIDDEN: Final = 0.25  # visible share below which an object is crowd, as one with a side below SMALL
SEEN: Final = 0.6  # least visible share of the target, and least share of it inside the picture
NEAR: Final = 0.2  # largest share of the picture that something right before the camera may cover


@dataclass(frozen=True, slots=True)
class _Set:
    """A drive to take pictures of.

    Attributes:
        clips: What is recorded.
        key: Of all draws.
        trace: The drive.
        cast: Who is there.
        stage: Street and bodies, ready to be rendered.
        targets: The bodies that play the target in turn.
        places: Where a target that stands can be.
    """

    clips: Clips
    key: tuple[object, ...]
    trace: EpisodeTrace
    cast: SceneObjects
    stage: Scene
    targets: tuple[ObjectBody, ...]
    places: tuple[Place, ...] = ()


def _prepare(clips: Clips, town: str, key: tuple[object, ...]) -> _Set:
    graph = load_town(town)
    street = drive_street(graph, clips.streets, key=("clips", *key))
    trace = drive(make_drive(graph, key=("clips", *key), seconds=SECONDS), graph)
    cast = place_objects(trace, graph, street, key=key, many_signs=clips.streets == "any")
    places: tuple[Place, ...] = ()
    if isinstance(clips.target, TargetSign):
        targets: tuple[ObjectBody, ...] = (_sign(cast, clips.target),)
        way = np.stack([trace.x[:, 0], trace.y[:, 0]], -1)[::5].astype(np.float64)
        clear = Clear(street)
        take_still(cast, clear)
        found = free_places(graph, way, clear, key=("target", *key))
        places = tuple((*place, plate_height(targets[0])) for place in found)
    elif clips.target is not None:
        targets = (_named(cast, clips.target),)
    else:
        count = TARGETS if clips.mode == "orbit" else 1
        targets = tuple(_drawn(cast, generator("clips target", *key, n)) for n in range(count))
    return _Set(clips, key, trace, cast, Scene(street, cast.meshes, device=clips.device), targets, places)


def _drawn(cast: SceneObjects, draws: np.random.Generator) -> ObjectBody:
    """Some car in the place of the ego, with its mesh in the cast."""
    style = draw_style("car", generator=draws)
    drawn = draw_size("car", style, generator=draws)
    size = min(drawn[0], 4.9), min(drawn[1], 2.06), drawn[2]
    mesh = cast.meshes.add(make_body("car", style=style, size=size, generator=draws))
    return _body(mesh, style, size, draw_paint(draws))


def _named(cast: SceneObjects, target: TargetCar | TargetWalker) -> ObjectBody:
    """The target in the place of the ego, with its mesh in the cast."""
    body = _body(cast.meshes.add(target.mesh()), target.style, target.full_size, target.colour)
    return replace(body, kind=class_of_target(target))


def _sign(cast: SceneObjects, target: TargetSign) -> ObjectBody:
    """The target sign: its plate, which is labelled, and its post."""
    meshes = tuple(cast.meshes.add(part) for part in plate_and_post(target.mesh()))
    size, still = target.full_size, (np.zeros((1, 4)), np.ones(1, bool), np.zeros(1))
    return ObjectBody(TARGET, target.kind, target.style, size, (0.5, 0.5, 0.5), meshes, *still)


def plate_height(sign: ObjectBody) -> float:
    """Height of the middle of a sign's plate above its foot, m."""
    return sign.size[2] - sign.size[1] / 2


def _body(mesh: int, style: str, size: Point, paint: tuple[float, float, float]) -> ObjectBody:
    return ObjectBody(TARGET, "car", style, size, paint, (mesh,), np.zeros((1, 4)), np.ones(1, bool), np.zeros(1))


def batch_size(device: str) -> int:
    """Views rendered at once: on the CPU one is as fast as many."""
    return 1 if device == "cpu" else 32


def _rounds(
    made: _Set, town: str, slots: range, attempt: int, missing: Callable[[], list[int]]
) -> Iterator[list[tuple[int, Viewpoint]]]:
    """Again and again shots for what is missing (numbers from 0 in the part), until this drive has no more."""
    clips, key = made.clips, made.key
    draws = generator("clips shots", *key)
    if clips.mode == "drive":
        weather = draw_weather(("clips", *key))
        left = iter(
            follow(made.trace, weather, behind=clips.behind, height=clips.height, count=len(slots), draws=draws)
        )
        while todo := list(zip(missing(), left, strict=False)):
            yield todo
        return
    if isinstance(clips.target, TargetSign) and not made.places:
        return
    grid = list(product(clips.distances, clips.azimuths, clips.elevations, clips.weathers or ("",)))
    wanted = turn_of(slots, len(grid), key=(clips.seed, town))
    if attempt >= 3:
        wanted = generator("clips cells", *key).integers(len(grid), size=len(slots)).tolist()
    # low things before a sign hide little of it
    height = made.places[0][4] if made.places else 2 * AIM
    for turn, tries in enumerate(TRIES):
        proposed: list[tuple[int, Viewpoint]] = []
        for n in missing():
            *cell, kind = grid[wanted[n]]
            weather = draw_weather(("clips", *key, turn, n), kind)
            if isinstance(clips.target, TargetSign):
                seconds = (len(made.trace.x) - 1) * made.trace.dt
                views = orbit_sign(made.places, seconds, weather, (cell[0], cell[1]), draws)
            else:
                views = orbit(made.trace, weather, (cell[0], cell[1], cell[2]), draws)
            proposed += [(n, s) for s in islice(views, tries)]
        clear = free_sight(made.stage, [s for _, s in proposed], at_once=batch_size(clips.device), height=height)
        first = dict(reversed([pair for pair, ok in zip(proposed, clear, strict=True) if ok]))
        yield sorted(first.items())


def _part(task: tuple[Clips, str, int, int, str]) -> str:
    """Takes `count` pictures, of one drive if it can be; the part's name. What is there is left alone. ConfigError."""
    clips, town, number, count, name = task
    page = clips.out / ".parts" / name / "part.json"
    if page.is_file():
        return name
    quiet_warp()
    cv2.setNumThreads(1)
    rows: dict[int, dict[str, Any]] = {}
    skipped: Counter[str] = Counter()
    slots = range(number * EACH, number * EACH + count)

    def missing() -> list[int]:
        return [n for n in range(count) if n not in rows]

    for attempt in range(DRIVES):
        made = _prepare(clips, town, (clips.seed, clips.mode, town, number, attempt))
        for shots in _rounds(made, town, slots, attempt, missing):
            for n, row, image in _take(made, shots, skipped):
                file = f"{name}-{n:03d}.jpg"
                safeio.write_atomic(clips.out / "images" / file, encode_jpeg(image, clips.quality, "420"))
                about = {"file_name": file, "town": town, "drive": made.trace.key, "part": number, "attempt": attempt}
                rows[n] = about | {"slot": n} | row
        if not missing():
            break
    else:
        why = ", ".join(f"{v} {k}" for k, v in sorted(skipped.items())) or "the drives are too short"
        raise ConfigError(
            f"{town}: {len(rows)} of {count} pictures in {DRIVES} drives ({why}); choose smaller distances"
        )
    safeio.write_atomic(page, safeio.dump_json({"images": [rows[n] for n in range(count)], "skipped": skipped}) + "\n")
    return name


def _take(
    made: _Set, shots: Sequence[tuple[int, Viewpoint]], skipped: Counter[str]
) -> Iterator[tuple[int, dict[str, Any], U8]]:
    """Renders and labels shots; those that show their target, with what is annotated. Counts why others do not."""
    clips = made.clips
    camera = _camera(clips.size)
    ready: list[tuple[int, Viewpoint, View, list[PlacedObject]]] = []
    for n, shot in shots:
        target = made.targets[n % len(made.targets)]
        around = made.cast.at(shot.time, shot.camera[:2, 3], 150.0)
        if not has_room(target, shot, around):
            skipped["crowded"] += 1
            continue
        view = _view(made, n, shot, around, camera)
        around.append(PlacedObject(target, shot.target, 0.0, view.things[0]))
        ready.append((n, shot, view, around))
    size = batch_size(clips.device)
    for k in range(0, len(ready), size):
        picture = render(made.stage, [view for _, _, view, _ in ready[k : k + size]], linear=False)
        for index, (n, shot, view, around) in enumerate(ready[k : k + size]):
            objects, fault = _annotate(made.stage, view, picture, index, around)
            if fault:
                skipped[fault] += 1
                continue
            target = around[-1].body
            row = {
                "width": clips.size,
                "height": clips.size,
                "time": shot.time,
                "weather": weather_name(shot.weather),
                "light": asdict(shot.weather),
                "intrinsic": camera.intrinsic.tolist(),
                "pose": shot.camera.tolist(),
                "target_pose": shot.target.tolist(),
                "target_style": target.style,
                "target_size": [round(v, 3) for v in target.size],
                "objects": objects,
            }
            yield n, row | shot.about, picture.image[index]


def label_of(kind: str) -> int | None:
    """Index into `CLASSES` of a kind of body; None for what is background."""
    if kind in PLAIN_CLASSES:
        return CLASSES.index(kind)
    return CLASSES.index(class_of(kind)) if kind in BODY_CATEGORIES else None


def faces(sign: F64, eye: F64) -> bool:
    """Whether the front of a sign of pose [4, 4] can be read from a place [3]: not from behind or far from aside."""
    ahead, left, _ = sign[:3, :3].T @ (eye - sign[:3, 3])
    return bool(abs(np.degrees(np.arctan2(left, ahead))) < BEHIND)


def _camera(size: int) -> Camera:
    middle, focal = size / 2, FOCAL * size
    return Camera(size, size, np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]]))


def _view(made: _Set, n: int, shot: Viewpoint, around: Sequence[PlacedObject], camera: Camera) -> View:
    """View `n` of a part: the target first, then who else is there."""
    target = made.targets[n % len(made.targets)]
    own = Thing(target.meshes[0], shot.target, target.paint, TARGET)
    noise = int(digest("clips noise", *made.key, n)[:7], 16)
    lamps = own_lamps(_follower(shot), shot.weather) if made.clips.mode == "drive" else ()
    focus = float(shot.target[0, 3]), float(shot.target[1, 3])
    rest = (Thing(mesh, shot.target, target.paint) for mesh in target.meshes[1:])
    things = (own, *rest, *(s.thing for s in around))
    return View(camera, shot.camera, things, shot.weather, SENSOR, noise, lamps, focus)


def _follower(shot: Viewpoint) -> F64:
    """The vehicle [4, 4] that carries the following camera, which is 2 m behind its nose."""
    eye, ahead = shot.camera[:3, 3], shot.camera[:3, 2]
    pose = upright_pose(float(eye[0]), float(eye[1]), float(np.arctan2(ahead[1], ahead[0])))
    return pose @ upright_pose(2.0 - NOSE, 0.0, 0.0)


def _annotate(
    stage: Scene, view: View, picture: Picture, index: int, around: Sequence[PlacedObject]
) -> tuple[list[dict[str, Any]], str]:
    """What is seen in a picture, the target among it; and why the picture is of no use (else '')."""
    labels = label_picture(stage, view, picture, index)
    at = {s.body.tag: s for s in around}
    own = labels.tag == TARGET
    side = labels.box[:, 2:] - labels.box[:, :2]
    if not own.any() or labels.share[own][0] < SEEN:
        return [], "hidden"
    if labels.inside[own][0] < SEEN or side[own].min() < SMALL:
        return [], "cut or small"
    away = float(np.linalg.norm(at[TARGET].pose[:3, 3] - view.pose[:3, 3]))
    if near_share(view, picture.depth[index], picture.tag[index], within=max(2.0, away / 3)) > NEAR:
        return [], "blocked"
    crowd = (side.min(1) < SMALL) | (labels.share < HIDDEN)
    objects = []
    for n, tag in enumerate(labels.tag.tolist()):
        who = at[tag]
        label = label_of(who.body.kind)
        if label is not None:
            tall = who.body.size[2] / 2
            if who.body.kind in PLAIN_CLASSES:
                crowd[n] |= not faces(who.pose, view.pose[:3, 3])
                tall = plate_height(who.body)
            middle = who.pose[:3, 3] + [0.0, 0.0, tall]
            x1, y1, x2, y2 = _hull(view, who.pose, who.body.size).tolist()
            objects.append(
                {
                    "label": label,
                    "box": labels.box[n].tolist(),
                    "pixels": int(labels.pixels[n]),
                    "crowd": bool(crowd[n]),
                    "target": tag == TARGET,
                    "hull": [x1, y1, x2 - x1, y2 - y1],
                    "visible": round(float(labels.share[n]), 3),
                    "distance": round(float(np.linalg.norm(middle - view.pose[:3, 3])), 2),
                }
            )
    return objects, ""


def _hull(view: View, pose: F64, size: tuple[float, float, float]) -> F64:
    """x1, y1, x2, y2 around all of a body's 3D box in a picture, whether it is seen or not, px."""
    corners = (UNIT_CORNERS + np.array([0.0, 0.0, 0.5])) * size
    turn = np.linalg.inv(view.pose) @ pose
    local, camera = corners @ turn[:3, :3].T + turn[:3, 3], view.camera
    found = hulls(local[None], camera.intrinsic, (camera.width, camera.height))[0]
    return np.asarray(np.round(found, 2))


def record_clips(
    clips: Clips,
    *,
    workers: int | None = None,
    ray: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Path:
    """Takes all pictures and writes annotations/{train,test,all}.json; the folder. Run again to go on.

    Each file's `info` says what was recorded, how many objects there are of each class, and how many pictures were
    taken elsewhere instead, and why. StoreError, ConfigError.
    """
    return record_all([clips], workers=workers, ray=ray, progress=progress)[0]


def record_all(
    recordings: Sequence[Clips],
    *,
    workers: int | None = None,
    ray: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[Path]:
    """Several recordings as `record_clips` takes them, all their parts side by side; their folders.

    Raises:
        StoreError: As `record_clips`.
        ConfigError: As `record_clips`.
    """
    tasks: list[list[tuple[Clips, str, int, int, str]]] = []
    for clips in recordings:
        _check_other(clips)
        tasks.append(
            [
                (clips, town, number, min(EACH, count - start), f"{clips.mode}-{town.lower()}-{number:03d}")
                for town, count in clips.images
                for number, start in enumerate(range(0, count, EACH))
            ]
        )
    every = [task for own in tasks for task in own]
    with ExitStack() as held:
        for clips in recordings:
            held.enter_context(locked(clips.out, "ssad record"))
            check_parts(clips.out, clips.identity())
        pool = open_pool(len(every), workers=workers, ray=ray, device=recordings[0].device)
        run_all(pool, _part, every, timeout_s=PART_S, progress=progress)
        for clips, own in zip(recordings, tasks, strict=True):
            _write_pages(clips, own)
    return [clips.out for clips in recordings]


def _check_other(clips: Clips) -> None:
    """StoreError: the folder holds another recording."""
    finished = clips.out / "annotations" / "all.json"
    if finished.is_file() and not (clips.out / ".parts").is_dir():
        data = safeio.read_json(finished)
        info = data.get("info") if isinstance(data, dict) else None
        if not isinstance(info, dict) or info.get("recording") != clips.identity():
            raise StoreError(f"{clips.out}: holds another recording; choose another folder")


def _write_pages(clips: Clips, tasks: Sequence[tuple[Clips, str, int, int, str]]) -> None:
    """annotations/{train,test,all}.json of parts that are all there."""
    splits = {
        "train": [t for t in tasks if t[1] not in clips.held_out],
        "test": [t for t in tasks if t[1] in clips.held_out],
        "all": tasks,
    }
    for split, members in splits.items():
        rows: list[dict[str, Any]] = []
        skipped: Counter[str] = Counter()
        for task in members:
            part = safeio.read_json(clips.out / ".parts" / task[4] / "part.json")
            rows += part["images"]
            skipped.update(part["skipped"])
        counts = Counter(CLASSES[o["label"]] for row in rows for o in row["objects"] if not o["crowd"])
        about = {
            "recording": clips.identity(),
            "split": split,
            "towns": sorted({t[1] for t in members}),
            "images": len(rows),
            "objects": counts,
            "weathers": Counter(row["weather"] for row in rows),
            "skipped": skipped,
        }
        page = safeio.dump_json(coco_data(CLASSES, rows, about)) + "\n"
        safeio.write_atomic(clips.out / "annotations" / f"{split}.json", page)


@dataclass(frozen=True, slots=True)
class ClipView:
    """A recorded picture and what it shows, ready to be rendered again.

    Attributes:
        file: Its name in the folder `images`.
        row: What the annotation file says of it.
        scene: Street and bodies.
        view: Camera, things (the target first, tag `TARGET`) and light.
        objects: What is annotated in it: label (index into `CLASSES`), bbox (x, y, width, height) of what is seen, hull
            (the same of the whole 3D box), area, target ...
    """

    file: str
    row: Mapping[str, Any]
    scene: Scene
    view: View
    objects: tuple[Mapping[str, Any], ...]

    def wearing(self, *shown: Layer | Decal) -> View:
        """The view with layers on the target, and with decals, given in the target's frame, around it."""
        target, *others = self.view.things
        layers = tuple(one for one in shown if isinstance(one, Layer))
        decals = tuple(replace(one, pose=target.pose @ one.pose) for one in shown if isinstance(one, Decal))
        dressed = replace(target, layers=layers)
        return replace(self.view, things=(dressed, *others), decals=(*self.view.decals, *decals))


Row = Mapping[str, Any]


def clip_rows(folder: Path, split: str = "all") -> list[tuple[Row, tuple[Row, ...]]]:
    """Each picture of a recording, as its annotation file has it, with what is annotated in it; in order.

    Raises:
        FormatError: No recording.
    """
    path = folder / "annotations" / f"{split}.json"
    data = safeio.read_json(path, limit=1 << 30)
    try:
        own: dict[int, list[Row]] = {row["id"]: [] for row in data["images"]}
        for one in data["annotations"]:
            own[one["image_id"]].append(one)
        return [(row, tuple(own[row["id"]])) for row in data["images"]]
    except (KeyError, TypeError) as error:
        raise _unknown(path, error) from None


def recording_of(folder: Path, split: str = "all") -> dict[str, Any]:
    """What was recorded (see `Clips.identity`).

    Raises:
        FormatError: No recording.
    """
    path = folder / "annotations" / f"{split}.json"
    try:
        return dict(safeio.read_json(path, limit=1 << 30)["info"]["recording"])
    except (KeyError, TypeError, ValueError) as error:
        raise _unknown(path, error) from None


def clip_views(
    folder: Path,
    *,
    split: str = "all",
    device: str = "cpu",
    only: Collection[str] | None = None,
    hour: Callable[[Weather, float], Weather] = lambda weather, heading: weather,
    stages: dict[Any, Any] | None = None,
) -> Iterator[ClipView]:
    """The pictures of a recording with their scenes, in order.

    Rendering a view gives the recorded picture (before JPEG) again. Pictures of one drive share a scene.

    Args:
        folder: What `record_clips` wrote.
        split: train, test or all.
        device: Where to render.
        only: Names of the files that are wanted; None for all.
        hour: The weather to show instead of the recorded one, from that and the heading of the target, rad.
        stages: Where all scenes are kept for another call; None: they are let go one after the other.

    Raises:
        FormatError: No recording of this version.
    """
    path = folder / "annotations" / f"{split}.json"
    rows = clip_rows(folder, split)
    try:
        clips = _clips_of(recording_of(folder, split), folder, device)
        sets: dict[tuple[object, ...], _Set] = {} if stages is None else stages
        for row, objects in rows:
            if only is not None and row["file_name"] not in only:
                continue
            key = (clips.seed, clips.mode, row["town"], row["part"], row["attempt"])
            if key not in sets:
                if stages is None:  # one part at a time: its pictures may come from several drives
                    sets = {known: kept for known, kept in sets.items() if known[:-1] == key[:-1]}
                sets[key] = _prepare(clips, row["town"], key)
            made = sets[key]
            target = np.array(row["target_pose"])
            weather = hour(Weather(**row["light"]), float(np.arctan2(target[1, 0], target[0, 0])))
            shot = Viewpoint(row["time"], np.array(row["pose"]), target, weather, {})
            around = made.cast.at(shot.time, shot.camera[:2, 3], 150.0)
            view = _view(made, row["slot"], shot, around, _camera(clips.size))
            yield ClipView(row["file_name"], row, made.stage, view, objects)
    except (KeyError, TypeError) as error:
        raise _unknown(path, error) from None


def _unknown(path: Path, error: Exception) -> FormatError:
    why = f"({type(error).__name__}: {error})"
    return FormatError(f"{path}: not the clips of this version {why}; record them again")


def _clips_of(about: Mapping[str, Any], folder: Path, device: str) -> Clips:
    """The recording that `Clips.identity` describes."""
    given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in about.items() if k != "clips"}
    given["images"] = tuple((town, count) for town, count in about["images"])
    if about["target"] is not None:
        size = about["target"]["size"]
        about_it = {k: v for k, v in about["target"].items() if k != "kind"}
        make: Any = STANDING[about["target"]["kind"]] if "kind" in about["target"] else TargetCar
        given["target"] = make(**about_it | {"size": None if size is None else tuple(size)})
    return Clips(folder, **given | {"mode": about["clips"], "device": device})

"""A logged drive in the nuScenes schema as a scenario: the ego is driven anew, all others do what they did.

Between key frames (2 Hz) others move straight on, as the official toolkit has it. They are there from their first to
their last annotation.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ssad.core.errors import ConfigError, RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import quaternion_to_yaw, wrap_angle
from ssad.core.types import F64, Actor, Limits, Pose, Scenario, SignalPlan
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import MAX_TIME_DIFF, SceneData
from ssad.interchange.ego_start import start_parameters
from ssad.scenarios.dynamic import build_episode
from ssad.scenarios.dynamic.frozen import Rows, told_rows
from ssad.world.episode_arrays import MAX_AGENTS
from ssad.world.models import MODELS
from ssad.world.roads import is_town, load_town, route_along
from ssad.world.roads.paths import graph_of_paths

OURS: Final = "ssad"  # the vehicle of a log that `ssad record` wrote
AXLE_TO_MIDDLE: Final = 1.385  # m from the rear axle of nuScenes' Renault Zoe, where its poses are, to its middle
STEP: Final = 0.1  # s of the world
KEY_POINT: Final = 25.0  # m between key points of the ego's route
OFF: Final = 5.0  # m from its route that the logged ego is at most: it may be about to change lanes
LEAST_WAY: Final = 10.0  # m that the ego drives at least
MOVED: Final = 10.0  # m that a vehicle drives at least to show where a lane is
CARS: Final = ("car", "suv", "coupe", "compact", "van")
LARGE: Final = ("truck", "bus", "van")
# nuScenes category (or what it begins with) -> the models that may play it, by size
MODELS_OF: Final[Mapping[str, tuple[str, ...]]] = {
    "vehicle.car": CARS,
    "vehicle.emergency": CARS,
    "vehicle.truck": LARGE,
    "vehicle.bus": LARGE,
    "vehicle.trailer": LARGE,
    "vehicle.construction": LARGE,
    "vehicle.motorcycle": ("motorcycle",),
    "vehicle.bicycle": ("bicycle",),
    "human.pedestrian": ("walker",),
    "movable_object.barrier": ("barrier",),
    "movable_object.trafficcone": ("cone",),
}


@dataclass(frozen=True, slots=True)
class LoggedDrive:
    """A logged drive, ready to be driven again.

    Attributes:
        scenario: The scenario, of type Custom.
        graph: Its town.
        known: Whether the town can be loaded by its name; else the graph must be stored.
        left_out: What of the log has no actor: category, or why -> how many.
    """

    scenario: Scenario
    graph: LaneGraph
    known: bool
    left_out: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class _Track:
    """An object of the log while it is annotated without a gap: time s, x, y m and yaw rad [T, 4] of its middle."""

    name: str
    model: str
    rows: F64


def scenario_of_drive(
    data: NuScenes, scene: str, *, town: str, map_name: str | None = None, name: str | None = None
) -> LoggedDrive:
    """The scenario of a scene.

    Args:
        data: The folder.
        scene: Name or token of the scene.
        town: What a town made for it is called.
        map_name: Town that it was driven in, or a file of it; without one, the town that `ssad record` says, and else
            lanes along the paths that were driven.
        name: Of the scenario. None: log/ and the scene's name.

    Returns:
        The scenario with its town.

    Raises:
        ConfigError: There is no such scene, nothing is annotated in it, or the ego hardly moves.
        FormatError: Tables are broken.
        MapError: The map cannot be read.
        RouteError: The ego's way does not lie on the roads of the map.
    """
    found = data.scene(scene)
    where = f"{data.root / data.version}: scene '{found.record.name}'"
    start = found.samples[0].timestamp
    ego = _ego(found, start)
    if len(ego) < 2:
        raise ConfigError(f"{where}: it has no poses of the ego")
    way = ego[ego[:, 0] >= -0.25]
    if float(np.hypot(*np.diff(way[:, 1:3], axis=0).T).sum()) < LEAST_WAY:
        raise ConfigError(f"{where}: the ego drives less than {LEAST_WAY:g} m; choose another scene")
    tracks, left_out = _tracks(found, start)
    if not tracks:
        raise ConfigError(f"{where}: nothing is annotated that could be an actor; choose another scene")
    tracks, left_out = _nearest(tracks, ego, left_out)
    graph, known = _town(found, where, way, tracks, town=town, map_name=map_name)
    scenario = _scenario(found, graph, way, tracks, name or f"log/{found.record.name}", data.version)
    build_episode(scenario, graph, seed=0)
    return LoggedDrive(scenario, graph, known, left_out)


def _ours(scene: SceneData) -> bool:
    return scene.log is not None and scene.log.vehicle == OURS


def _ego(scene: SceneData, start: int) -> F64:
    """Time s since `start` us, x, y and yaw [T, 4] of the middle of the ego, from the poses of all sensors."""
    ahead = 0.0 if _ours(scene) else AXLE_TO_MIDDLE  # `ssad record` writes where the middle is
    rows: dict[int, tuple[float, float, float, float]] = {}
    for frame in scene.frames:
        pose = frame.ego_to_world
        x, y = (pose[:2, 3] + ahead * pose[:2, 0]).tolist()
        rows[frame.timestamp_us] = 1e-6 * (frame.timestamp_us - start), x, y, float(np.arctan2(pose[1, 0], pose[0, 0]))
    return np.array([rows[time] for time in sorted(rows)], np.float64).reshape(-1, 4)


def _tracks(scene: SceneData, start: int) -> tuple[list[_Track], Counter[str]]:
    """Tracks in the order in which they begin; categories that nothing can play, and how many objects they have."""
    rows: dict[str, list[tuple[float, float, float, float]]] = {}
    about: dict[str, tuple[str, F64]] = {}
    for sample in scene.samples:
        boxes = scene.annotations(sample.token)
        if not len(boxes.instance):
            continue
        yaw = quaternion_to_yaw(boxes.rotation)
        for n, instance in enumerate(boxes.instance):
            time = 1e-6 * (sample.timestamp - start)
            x, y = boxes.centre[n, :2].tolist()
            rows.setdefault(instance, []).append((time, x, y, float(yaw[n])))
            about.setdefault(instance, (boxes.category[n], boxes.size_lwh[n]))
    tracks: list[_Track] = []
    left_out: Counter[str] = Counter()
    numbers: Counter[str] = Counter()
    for instance, told in rows.items():
        category, size = about[instance]
        model = model_of(category, size)
        if model is None:
            left_out[category] += 1
            continue
        kind = category.rsplit(".", 1)[-1]
        numbers[kind] += 1
        table = np.array(told, np.float64)
        gaps = np.flatnonzero(np.diff(table[:, 0]) > MAX_TIME_DIFF) + 1
        for part, piece in enumerate(np.split(table, gaps)):
            again = f"-{part + 1}" if part else ""
            tracks.append(_Track(f"{kind}-{numbers[kind]}{again}", model, piece))
    return tracks, left_out


def model_of(category: str, size_lwh: F64) -> str | None:
    """The model of the world that is most like an object.

    Args:
        category: Of nuScenes.
        size_lwh: Length, width, height, m.

    Returns:
        Name of the model; None where nothing is like it.
    """
    for start, models in MODELS_OF.items():
        if category.startswith(start):
            return min(models, key=lambda name: float(np.abs(_size(name) - size_lwh).sum()))
    return None


def _size(model: str) -> F64:
    body = MODELS[model]
    return np.array([body.length, body.width, body.height])


def _nearest(tracks: Sequence[_Track], ego: F64, left_out: Counter[str]) -> tuple[list[_Track], Counter[str]]:
    """As many tracks as a scene has room for: those that come nearest to the logged ego."""
    room = MAX_AGENTS - 1
    if len(tracks) <= room:
        return list(tracks), left_out
    away = []
    for track in tracks:
        at = np.stack([np.interp(track.rows[:, 0], ego[:, 0], ego[:, k]) for k in (1, 2)], 1)
        away.append(float(np.hypot(*(track.rows[:, 1:3] - at).T).min()))
    kept = sorted(np.argsort(away, kind="stable")[:room].tolist())
    left_out = left_out + Counter({f"too many (a scene has room for {room})": len(tracks) - room})
    return [tracks[n] for n in kept], left_out


def _town(
    scene: SceneData, where: str, way: F64, tracks: Sequence[_Track], *, town: str, map_name: str | None
) -> tuple[LaneGraph, bool]:
    """The town of a drive, and whether it can be loaded by its name."""
    if map_name is not None:
        known = is_town(map_name)
        graph = load_town(map_name)
        return (graph if known else replace(graph, name=town)), known
    if _ours(scene):
        assert scene.log is not None
        for told in (scene.log.location, scene.record.description.partition(",")[0]):
            if is_town(told):
                return load_town(told), True
    paths, speeds = [way[:, 1:3]], [_fastest(way)]
    for track in tracks:
        moved = float(np.hypot(*(track.rows[-1, 1:3] - track.rows[0, 1:3])))
        if moved >= MOVED and track.model in (*CARS, *LARGE, "motorcycle"):
            paths.append(track.rows[:, 1:3])
            speeds.append(_fastest(track.rows))
    return graph_of_paths(town, paths, speeds=[max(speed, 5.0) for speed in speeds]), False


def _fastest(rows: F64) -> float:
    """The highest speed of a track [T, 4] over half a second, m/s."""
    at = np.arange(rows[0, 0], rows[-1, 0] + 1e-6, 0.5)
    if len(at) < 2:
        return 0.0
    x, y = (np.interp(at, rows[:, 0], rows[:, k]) for k in (1, 2))
    return float(np.hypot(np.diff(x), np.diff(y)).max() / 0.5)


def _scenario(  # noqa: PLR0917
    scene: SceneData, graph: LaneGraph, way: F64, tracks: Sequence[_Track], name: str, version: str
) -> Scenario:
    """The ego's route and start, the actors, and limits with time to spare."""
    points = _key_points(way)
    try:
        route = route_along(graph, points)
    except RouteError as error:
        raise RouteError(f"scene '{scene.record.name}': the way of the ego: {error}") from None
    driven = way[way[:, 0] >= 0.0, 1:3]
    off = float(np.hypot(*np.moveaxis(driven[:, None] - route.xy[None], -1, 0)).min(1).max())
    if off > OFF:
        raise RouteError(
            f"scene '{scene.record.name}': the way of the ego is up to {off:.1f} m from the roads of '{graph.name}'; "
            "give the map of that place"
        )
    first = points[0]
    early = way[np.searchsorted(way[:, 0], min(0.5, float(way[-1, 0])))]
    speed = math.hypot(early[1] - first.x, early[2] - first.y) / max(float(early[0]), STEP)
    parameters = start_parameters(route, first, speed, digits=3)
    parameters.pop("ego_longitudinal", None)  # the route begins where the ego does
    seconds = 1e-6 * (scene.samples[-1].timestamp - scene.samples[0].timestamp)
    steps = math.ceil(2 * seconds / STEP) + 100
    location = f" in {scene.log.location}" if scene.log is not None and scene.log.location else ""
    return Scenario(
        name=name,
        type="Custom",
        town=graph.name,
        route=points,
        parameters=parameters,
        actors=tuple(_actor(track) for track in tracks),
        signals=SignalPlan("green", "red", until=steps * STEP),  # a log does not say what they showed
        limits=Limits(max_steps=steps, max_time=round(steps * STEP, 1)),
        target_speed=round(float(np.clip(_fastest(way), 3.0, 60.0)), 2),
        group="log",
        source=f"nuScenes schema {version}, {scene.record.name}{location}",
    )


def _key_points(way: F64) -> tuple[Pose, ...]:
    """Places of the ego at the start, each `KEY_POINT` m, and at the end."""
    unwrapped = np.unwrap(way[:, 3])
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way[:, 1:3], axis=0).T))])
    begin = float(np.interp(0.0, way[:, 0], driven))
    count = max(1, round((driven[-1] - begin) / KEY_POINT))
    at = np.linspace(begin, driven[-1], count + 1)
    rising = np.concatenate([[True], np.diff(driven) > 1e-9])
    x, y, yaw = (np.interp(at, driven[rising], v[rising]) for v in (way[:, 1], way[:, 2], unwrapped))
    return tuple(
        Pose(round(a, 3), round(b, 3), round(float(wrap_angle(c)), 4))
        for a, b, c in zip(x.tolist(), y.tolist(), yaw.tolist(), strict=True)
    )


def _actor(track: _Track) -> Actor:
    """An actor with the trajectory of a track."""
    rows = track.rows
    if len(rows) == 1:  # seen in one key frame: there for that moment
        rows = np.concatenate([rows, rows])
        rows[1, 0] += STEP
    told: Rows = told_rows(rows)
    return Actor(track.name, track.model, Pose(*told[0][1:]), trajectory=told)

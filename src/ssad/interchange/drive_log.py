"""A logged drive in the nuScenes schema as a scenario: the ego is driven anew, all others repeat their motion.

Between key frames (2 Hz) other agents move in a straight line, as in the official toolkit. They exist from their
first to their last annotation.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ssad.core.errors import ConfigError, RouteError
from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import quaternion_to_yaw, wrap_angle
from ssad.core.types import F64, Actor, EpisodeLimits, Pose, Scenario, SignalPlan
from ssad.core.wording import counted
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import MAX_TIME_DIFF, SceneData
from ssad.interchange.ego_start import start_parameters
from ssad.scenarios.dynamic import build_episode
from ssad.scenarios.dynamic.frozen import Rows, round_rows
from ssad.world.episode_arrays import MAX_AGENTS
from ssad.world.models import MODELS
from ssad.world.roads import is_town, load_town, route_along
from ssad.world.roads.paths import graph_of_paths

OURS: Final = "ssad"  # the vehicle of a log that `ssad record` wrote
AXLE_TO_MIDDLE: Final = 1.385  # m from the rear axle of nuScenes' Renault Zoe, where its poses are, to its middle
STEP: Final = 0.1  # s of the world
KEY_POINT: Final = 25.0  # m between key points of the ego's route
OFF: Final = 5.0  # m, largest distance of the logged ego from its route: it may be changing lanes
LEAST_WAY: Final = 10.0  # m, minimum drive of the ego
MAX_WAY: Final = 1e5  # m that the ego drives
TOO_FAST: Final = 70.0  # m/s; a faster object is a mistake of the log
MOVED: Final = 10.0  # m, minimum drive of a vehicle whose path counts as a lane
CARS: Final = ("car", "suv", "coupe", "compact", "van")
LARGE: Final = ("truck", "bus", "van")
# nuScenes category (or its beginning) -> models that may represent it; the size decides
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
        is_known_town: Whether the town can be loaded by its name; else the graph must be stored.
    """

    scenario: Scenario
    graph: LaneGraph
    is_known_town: bool


@dataclass(frozen=True, slots=True)
class _Track:
    """An object during one gapless stretch of annotations: time s, x, y m and yaw rad [T, 4] of its middle."""

    name: str
    model: str
    rows: F64


def scenario_of_drive(
    data: NuScenes,
    scene: str,
    *,
    town: str,
    map_name: str | None = None,
    name: str | None = None,
    report: ImportReport | None = None,
) -> LoggedDrive:
    """Build the scenario of a scene.

    Args:
        data: The folder.
        scene: Name or token of the scene.
        town: Name for a town made for the scene.
        map_name: Its town, or a file of that town; None: the town that `ssad record` has noted, else lanes
            along the driven paths.
        name: Name of the scenario. None: log/ and the scene's name.
        report: Filled with what came in, what is not carried over, and what is doubtful.

    Returns:
        The scenario with its town.

    Raises:
        ConfigError: The scene does not exist, has no annotations, or its ego hardly moves.
        FormatError: Tables are broken.
        MapError: The map cannot be read.
        RouteError: The ego's path does not lie on the roads of the map.
    """
    account = ImportReport(str(data.root)) if report is None else report
    scene_data = data.scene(scene)
    location = f"{data.root / data.version}: scene '{scene_data.record.name}'"
    start = scene_data.samples[0].timestamp
    ego_poses = _ego_motion(scene_data, start)
    if len(ego_poses) < 2:
        raise ConfigError(f"{location}: it has no poses of the ego")
    path_length = ego_poses[ego_poses[:, 0] >= -0.25]
    way = float(np.hypot(*np.diff(path_length[:, 1:3], axis=0).T).sum())
    if not way <= MAX_WAY:
        raise ConfigError(f"{location}: the ego drives {way / 1000:.3g} km; at most {MAX_WAY / 1000:g} km are imported")
    if way < LEAST_WAY:
        raise ConfigError(f"{location}: the ego drives less than {LEAST_WAY:g} m; choose another scene")
    if _max_speed(ego_poses) > TOO_FAST:
        account.doubt(f"the ego moves faster than {TOO_FAST:g} m/s")
    tracks = _tracks(scene_data, start, account)
    if not tracks:
        raise ConfigError(f"{location}: nothing is annotated that could be an actor; choose another scene")
    tracks = _nearest_tracks(tracks, ego_poses, account)
    graph, is_known = _town(scene_data, location, path_length, tracks, town=town, map_name=map_name)
    scenario_name = name or f"log/{scene_data.record.name}"
    scenario = _scenario(scene_data, graph, path_length, tracks, scenario_name, data.version, account)
    build_episode(scenario, graph, seed=0)
    account.contents += [
        f"nuScenes schema {data.version}, scene {scene_data.record.name}: {len(scene_data.samples)} key frames",
        f"the ego drives {way:.0f} m in {graph.name}; {counted(len(scenario.actors), 'actor')} with logged motion",
    ]
    if not is_known:
        account.note("the map of the log is not read: lanes follow the paths that were driven")
    account.note("a log has no states of signals: they are green for the ego and red for all others")
    account.omit("pictures and point clouds")
    return LoggedDrive(scenario, graph, is_known)


def _is_recorded_by_ssad(scene: SceneData) -> bool:
    return scene.log is not None and scene.log.vehicle == OURS


def _ego_motion(scene: SceneData, start: int) -> F64:
    """Return time s since `start` us, x, y and yaw [T, 4] of the middle of the ego, from the poses of all sensors."""
    axle_offset = (
        0.0 if _is_recorded_by_ssad(scene) else AXLE_TO_MIDDLE
    )  # `ssad record` writes the pose of the body's middle
    rows: dict[int, tuple[float, float, float, float]] = {}
    for frame in scene.frames:
        pose = frame.ego_to_world
        x, y = (pose[:2, 3] + axle_offset * pose[:2, 0]).tolist()
        rows[frame.timestamp_us] = 1e-6 * (frame.timestamp_us - start), x, y, float(np.arctan2(pose[1, 0], pose[0, 0]))
    return np.array([rows[time] for time in sorted(rows)], np.float64).reshape(-1, 4)


def _tracks(scene: SceneData, start: int, report: ImportReport) -> list[_Track]:
    """Return tracks in the order of their starts; the report names objects of categories without a model."""
    rows: dict[str, list[tuple[float, float, float, float]]] = {}
    category_and_size: dict[str, tuple[str, F64]] = {}
    for sample in scene.samples:
        boxes = scene.annotations(sample.token)
        if not len(boxes.instance):
            continue
        yaw = quaternion_to_yaw(boxes.rotation)
        for box_index, instance in enumerate(boxes.instance):
            time = 1e-6 * (sample.timestamp - start)
            x, y = boxes.centre[box_index, :2].tolist()
            rows.setdefault(instance, []).append((time, x, y, float(yaw[box_index])))
            category_and_size.setdefault(instance, (boxes.category[box_index], boxes.size_lwh[box_index]))
    tracks: list[_Track] = []
    name_counts: Counter[str] = Counter()
    for instance, track_rows in rows.items():
        category, size = category_and_size[instance]
        model = model_of(category, size)
        if model is None:
            report.omit(f"objects of category {category[:60]}", f"instance {instance[:12]}")
            continue
        short_name = category.rsplit(".", 1)[-1]
        name_counts[short_name] += 1
        table = np.array(track_rows, np.float64)
        # Over a longer gap the motion is unknown, as for the velocities of the official toolkit.
        gap_indices = np.flatnonzero(np.diff(table[:, 0]) > MAX_TIME_DIFF) + 1
        if len(gap_indices):
            report.note(
                f"objects with gaps of more than {MAX_TIME_DIFF:g} s in their annotations become several actors",
                f"{short_name}-{name_counts[short_name]}",
            )
        for part_index, part_rows in enumerate(np.split(table, gap_indices)):
            suffix = f"-{part_index + 1}" if part_index else ""
            tracks.append(_Track(f"{short_name}-{name_counts[short_name]}{suffix}", model, part_rows))
            if _max_speed(part_rows) > TOO_FAST:
                report.doubt(f"an object moves faster than {TOO_FAST:g} m/s", tracks[-1].name)
            if len(part_rows) == 1:
                report.note(f"objects annotated in one key frame exist for {STEP:g} s", tracks[-1].name)
    return tracks


def model_of(category: str, size_lwh: F64) -> str | None:
    """Return the model of the world that represents an object best.

    Args:
        category: Category of nuScenes.
        size_lwh: Length, width, height, m.

    Returns:
        Name of the model; None if no model represents the category.
    """
    for prefix, models in MODELS_OF.items():
        if category.startswith(prefix):
            return min(models, key=lambda name: float(np.abs(_model_size(name) - size_lwh).sum()))
    return None


def _model_size(model: str) -> F64:
    body = MODELS[model]
    return np.array([body.length, body.width, body.height])


def _nearest_tracks(tracks: Sequence[_Track], ego: F64, report: ImportReport) -> list[_Track]:
    """Return as many tracks as a scene can hold: those that come nearest to the logged ego."""
    max_tracks = MAX_AGENTS - 1
    if len(tracks) <= max_tracks:
        return list(tracks)
    distances = []
    for track in tracks:
        ego_positions = np.stack([np.interp(track.rows[:, 0], ego[:, 0], ego[:, axis]) for axis in (1, 2)], 1)
        distances.append(float(np.hypot(*(track.rows[:, 1:3] - ego_positions).T).min()))
    track_indices = sorted(np.argsort(distances, kind="stable")[:max_tracks].tolist())
    for track_index in sorted(set(range(len(tracks))) - set(track_indices)):
        report.omit(
            f"objects: a scene has room for {max_tracks}, the nearest to the ego's path", tracks[track_index].name
        )
    return [tracks[track_index] for track_index in track_indices]


def _town(
    scene: SceneData, location: str, path: F64, tracks: Sequence[_Track], *, town: str, map_name: str | None
) -> tuple[LaneGraph, bool]:
    """The town of a drive, and whether it can be loaded by its name."""
    if map_name is not None:
        is_known = is_town(map_name)
        graph = load_town(map_name)
        return (graph if is_known else replace(graph, name=town)), is_known
    if _is_recorded_by_ssad(scene):
        assert scene.log is not None
        for town_name in (scene.log.location, scene.record.description.partition(",")[0]):
            if is_town(town_name):
                return load_town(town_name), True
    paths, speeds = [path[:, 1:3]], [_max_speed(path)]
    for track in tracks:
        displacement = float(np.hypot(*(track.rows[-1, 1:3] - track.rows[0, 1:3])))
        if displacement >= MOVED and track.model in (*CARS, *LARGE, "motorcycle"):
            paths.append(track.rows[:, 1:3])
            speeds.append(_max_speed(track.rows))
    return graph_of_paths(town, paths, speeds=[max(speed, 5.0) for speed in speeds]), False


def _max_speed(rows: F64) -> float:
    """Return the highest speed of a track [T, 4] over half a second, m/s."""
    times = np.arange(rows[0, 0], rows[-1, 0] + 1e-6, 0.5)
    if len(times) < 2:
        return 0.0
    x, y = (np.interp(times, rows[:, 0], rows[:, axis]) for axis in (1, 2))
    return float(np.hypot(np.diff(x), np.diff(y)).max() / 0.5)


def _scenario(  # noqa: PLR0917
    scene: SceneData,
    graph: LaneGraph,
    path: F64,
    tracks: Sequence[_Track],
    name: str,
    version: str,
    report: ImportReport,
) -> Scenario:
    """The ego's route and start, the actors, and limits with time to spare."""
    points = _key_points(path)
    try:
        route = route_along(graph, points)
    except RouteError as error:
        raise RouteError(f"scene '{scene.record.name}': the way of the ego: {error}") from None
    path_length = path[path[:, 0] >= 0.0, 1:3]
    route_distance = float(np.hypot(*np.moveaxis(path_length[:, None] - route.xy[None], -1, 0)).min(1).max())
    if route_distance > OFF:
        raise RouteError(
            f"scene '{scene.record.name}': the way of the ego is up to {route_distance:.1f} m "
            f"from the roads of '{graph.name}'; "
            "give the map of that place"
        )
    start_pose = points[0]
    early_row = path[np.searchsorted(path[:, 0], min(0.5, float(path[-1, 0])))]
    speed = math.hypot(early_row[1] - start_pose.x, early_row[2] - start_pose.y) / max(float(early_row[0]), STEP)
    parameters = start_parameters(route, start_pose, speed, digits=3, report=report)
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
        signals=SignalPlan("green", "red", until=steps * STEP),  # a log does not record the states of signals
        limits=EpisodeLimits(max_steps=steps, max_time=round(steps * STEP, 1)),
        target_speed=round(float(np.clip(_max_speed(path), 3.0, 60.0)), 2),
        group="log",
        source=f"nuScenes schema {version}, {scene.record.name}{location}",
    )


def _key_points(path: F64) -> tuple[Pose, ...]:
    """Places of the ego at the start, each `KEY_POINT` m, and at the end."""
    unwrapped = np.unwrap(path[:, 3])
    path_length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, 1:3], axis=0).T))])
    start_distance = float(np.interp(0.0, path[:, 0], path_length))
    count = max(1, round((path_length[-1] - start_distance) / KEY_POINT))
    distances = np.linspace(start_distance, path_length[-1], count + 1)
    # Interpolation over distance needs increasing values, and a standing ego adds none.
    is_increasing = np.concatenate([[True], np.diff(path_length) > 1e-9])
    x, y, yaw = (
        np.interp(distances, path_length[is_increasing], values[is_increasing])
        for values in (path[:, 1], path[:, 2], unwrapped)
    )
    return tuple(
        Pose(round(key_x, 3), round(key_y, 3), round(float(wrap_angle(key_yaw)), 4))
        for key_x, key_y, key_yaw in zip(x.tolist(), y.tolist(), yaw.tolist(), strict=True)
    )


def _actor(track: _Track) -> Actor:
    """Return an actor with the trajectory of a track."""
    rows = track.rows
    if len(rows) == 1:  # annotated in one key frame: it exists for that moment only
        rows = np.concatenate([rows, rows])
        rows[1, 0] += STEP
    kept_rows: Rows = round_rows(rows)
    return Actor(track.name, track.model, Pose(*kept_rows[0][1:]), trajectory=kept_rows)

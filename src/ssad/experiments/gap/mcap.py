"""Drives as MCAP recordings with Foxglove's schemas, for Foxglove, Lichtblick and other viewers (the extra `view`).

Topics: /tf (the ego in the world, its camera on the ego), /camera and /camera/calibration, /truth (who is there),
/detections, /tracks (what is believed), /plan (the way that the planner follows), /map and /above (the scene from
above). Topics of what a driver sees are there for perceiving drivers alone.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssad.core import safeio
from ssad.core.errors import ConfigError, install_extra
from ssad.core.frames import Camera
from ssad.core.images import encode_jpeg
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import matrix_to_quaternion, yaw_to_quaternion
from ssad.core.types import F64, U8, AgentKind, EpisodeTrace, LaneType
from ssad.drivers.perceiving.objects import SIZES
from ssad.experiments.gap.drive_sheet import RecordedDrive

WORLD, EGO, ABOVE = "world", "ego", "above"
PLAN_LENGTH: Final = 50.0  # m of the route that are shown as the plan
QUALITY: Final = 90  # of JPEG
COLOURS: Final = {
    "truth": (0.8, 0.8, 0.8, 0.4),
    "detections": (1.0, 0.6, 0.1, 0.6),
    "tracks": (0.3, 0.65, 1.0, 0.6),
    "plan": (0.35, 0.85, 0.45, 1.0),
    "map": (0.45, 0.47, 0.5, 1.0),
}
Message = tuple[int, str, Any]  # ns, topic, message


def require_mcap() -> None:
    """Raise ConfigError if the packages of the extra `view` are missing."""
    try:
        importlib.import_module("mcap_protobuf.writer")
        importlib.import_module("foxglove_schemas_protobuf.SceneUpdate_pb2")
    except ImportError:
        raise ConfigError(f"--mcap needs mcap and Foxglove's schemas; {install_extra('view')}") from None


def write_mcap(
    path: Path,
    trace: EpisodeTrace,
    graph: LaneGraph,
    *,
    recorded_drive: RecordedDrive | None = None,
    top_views: Iterable[U8] = (),
) -> Path:
    """Write a drive as MCAP, whole or not at all; its clock starts at 0.

    Args:
        path: Where to.
        trace: The drive.
        graph: Its town.
        recorded_drive: What its driver saw, found and believed, if it is one that perceives.
        top_views: The scene from above [H, W, 3], a picture a step.

    Returns:
        The path.

    Raises:
        ConfigError: The extra `view` is missing.
        StoreError: The file cannot be written.
    """
    require_mcap()
    from mcap_protobuf.writer import Writer

    messages = [
        *_scene_messages(trace, graph),
        *_top_view_messages(trace, top_views),
        *(() if recorded_drive is None else _perception_messages(recorded_drive)),
    ]
    with safeio.atomic_path(path) as temporary, temporary.open("wb") as file, Writer(file) as writer:
        # Viewers expect log times in order; the sort is stable, so topics of one time keep theirs.
        for sequence_number, (time, topic, message) in enumerate(
            sorted(messages, key=lambda timed_message: timed_message[0])
        ):
            writer.write_message(topic, message, log_time=time, publish_time=time, sequence=sequence_number)
    return path


def _new_message(name: str, time: int | None = None, **fields: Any) -> Any:
    """Build a message of Foxglove's schemas."""
    message = getattr(importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)(**fields)
    if time is not None:
        message.timestamp.FromNanoseconds(time)
    return message


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)


def _scene_messages(trace: EpisodeTrace, graph: LaneGraph) -> Iterator[Message]:
    """Yield the map once, and the poses of all agents and the plan at each step."""
    yield 0, "/map", _scene_update("map", 0, lines=list(_lanes(graph)))
    names = [f"{agent_index} {name}" for agent_index, name in enumerate(trace.names)]
    for step in range(len(trace.x)):
        time = _nanoseconds(step * trace.dt)
        pose = np.stack([trace.x[step], trace.y[step], trace.yaw[step]], -1).astype(np.float64)
        yield time, "/tf", _transform(time, WORLD, EGO, [*pose[0, :2], 0.0], yaw_to_quaternion(pose[0, 2]))
        rows = np.flatnonzero(trace.active[step])
        size = np.stack([trace.length[rows], trace.width[rows]], -1)
        kind = trace.kind[rows].astype(np.int64)
        cubes = _upright_boxes("truth", pose[rows], size.astype(np.float64), kind)
        yield (
            time,
            "/truth",
            _scene_update("truth", time, cubes=cubes, words={names[agent_index]: "" for agent_index in rows.tolist()}),
        )
        route = trace.route.astype(np.float64)
        # The plan begins where the ego is now, not where the route begins.
        nearest_point = int(np.hypot(*(route - pose[0, :2]).T).argmin())
        route_distance = np.cumsum(np.concatenate([[0.0], np.hypot(*np.diff(route[nearest_point:], axis=0).T)]))
        line = _line("plan", route[nearest_point:][route_distance <= PLAN_LENGTH])
        controls = {name: f"{getattr(trace, name)[step]:.3f}" for name in ("throttle", "brake", "steer")}
        yield time, "/plan", _scene_update("plan", time, lines=[line], words=controls)


def _perception_messages(recorded_drive: RecordedDrive) -> Iterator[Message]:
    """Yield the images, detections and beliefs of the driver."""
    for seconds, image in recorded_drive.shots:  # none of a perceiver without cameras
        name, camera = next(iter(recorded_drive.perceived.cameras.items()))
        camera_rotation, camera_position = matrix_to_quaternion(camera.to_ego[:3, :3]), camera.to_ego[:3, 3].tolist()
        time = _nanoseconds(seconds)
        jpeg = encode_jpeg(np.ascontiguousarray(image), QUALITY, "420")
        yield time, "/tf", _transform(time, EGO, name, camera_position, camera_rotation)
        yield time, "/camera", _new_message("CompressedImage", time, frame_id=name, data=jpeg, format="jpeg")
        yield time, "/camera/calibration", _calibration(time, name, camera)
    for seconds, detections in recorded_drive.perceived.detections:
        if detections is not None:
            pose = np.column_stack([detections.place, np.nan_to_num(detections.yaw)])
            cubes = _upright_boxes("detections", pose, detections.size, detections.kind)
            metadata = {f"score {row}": f"{score:.3f}" for row, score in enumerate(detections.score.tolist())}
            yield (
                _nanoseconds(seconds),
                "/detections",
                _scene_update("detections", _nanoseconds(seconds), cubes=cubes, words=metadata),
            )
    for seconds, tracks in recorded_drive.perceived.tracks:
        cubes = _upright_boxes("tracks", np.column_stack([tracks.place, tracks.yaw]), tracks.size, tracks.kind)
        metadata = {f"track {row}": str(track_id) for row, track_id in enumerate(tracks.ident.tolist())}
        yield (
            _nanoseconds(seconds),
            "/tracks",
            _scene_update("tracks", _nanoseconds(seconds), cubes=cubes, words=metadata),
        )


def _top_view_messages(trace: EpisodeTrace, top_views: Iterable[U8]) -> Iterator[Message]:
    for step, top_view in enumerate(top_views):
        time, jpeg = _nanoseconds(step * trace.dt), encode_jpeg(np.ascontiguousarray(top_view), QUALITY, "420")
        yield time, "/above", _new_message("CompressedImage", time, frame_id=ABOVE, data=jpeg, format="jpeg")


def _scene_update(name: str, time: int, *, words: dict[str, str] | None = None, **entities: Any) -> Any:
    """A scene in place of the one before under this name."""
    metadata = [_new_message("KeyValuePair", key=key, value=value) for key, value in (words or {}).items()]
    # Viewers replace an entity by the next one with the same id.
    entity = _new_message("SceneEntity", time, frame_id=WORLD, id=name, metadata=metadata, **entities)
    return _new_message("SceneUpdate", entities=[entity])


def _colour(name: str) -> Any:
    red, green, blue, opacity = COLOURS[name]
    return _new_message("Color", r=red, g=green, b=blue, a=opacity)


def _upright_boxes(name: str, pose: F64, size: F64, kind: Any) -> list[Any]:
    """Build upright boxes at x, y, yaw [N, 3], of lengths and widths [N, 2].

    The heights are those usual for their kinds [N].
    """
    cubes = []
    rotations = yaw_to_quaternion(pose[:, 2]).reshape(-1, 4)
    for (x, y, _), (length, width), rotation, agent_kind in zip(
        pose.tolist(), size.tolist(), rotations, kind, strict=True
    ):
        height = float(SIZES[min(int(agent_kind), len(AgentKind) - 1), 2])
        cube_pose = _new_message("Pose", position=_vector([x, y, 0.5 * height]), orientation=_quaternion(rotation))
        cubes.append(
            _new_message("CubePrimitive", pose=cube_pose, size=_vector([length, width, height]), color=_colour(name))
        )
    return cubes


def _line(name: str, points: F64, height: float = 0.05) -> Any:
    vertices = [_new_message("Point3", x=x, y=y, z=height) for x, y in points.tolist()]
    return _new_message("LinePrimitive", thickness=0.15, points=vertices, color=_colour(name), pose=_origin())


def _lanes(graph: LaneGraph) -> Iterator[Any]:
    """Yield the centre lines of the driving lanes."""
    for lane in np.flatnonzero(graph.kind == LaneType.DRIVING).tolist():
        yield _line("map", graph.xy[graph.offset[lane] : graph.offset[lane + 1]].astype(np.float64), 0.0)


def _origin() -> Any:
    return _new_message(
        "Pose", position=_vector([0.0, 0.0, 0.0]), orientation=_quaternion(np.array([1.0, 0.0, 0.0, 0.0]))
    )


def _vector(values: Sequence[float]) -> Any:
    return _new_message("Vector3", x=values[0], y=values[1], z=values[2])


def _quaternion(rotation: F64) -> Any:
    w, x, y, z = rotation.tolist()
    return _new_message("Quaternion", x=x, y=y, z=z, w=w)


def _transform(time: int, parent: str, child: str, translation: Sequence[float], rotation: F64) -> Any:
    return _new_message(
        "FrameTransform",
        time,
        parent_frame_id=parent,
        child_frame_id=child,
        translation=_vector(translation),
        rotation=_quaternion(rotation),
    )


def _calibration(time: int, name: str, camera: Camera) -> Any:
    intrinsic = camera.intrinsic
    projection = np.column_stack([intrinsic, np.zeros(3)])
    return _new_message(
        "CameraCalibration",
        time,
        frame_id=name,
        width=camera.width,
        height=camera.height,
        K=intrinsic.ravel().tolist(),
        P=projection.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
    )

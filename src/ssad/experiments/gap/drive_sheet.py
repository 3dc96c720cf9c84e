"""Drives from the view of their drivers: the camera image, and from above the true, detected and believed objects."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ssad.core.geometry import to_local
from ssad.core.images import add_caption
from ssad.core.lane_graph import LaneGraph
from ssad.core.perception import DrivePerception
from ssad.core.types import F64, U8, EpisodeTrace
from ssad.metrics.perception_in_drive import in_view

WIDTH, VIEW_HEIGHT, SCALE, VIEW_BEHIND = 360, 360, 6.0, 8.0  # pixels, pixels a metre, m behind the ego
GROUND, LANE, VISIBLE, HIDDEN, DETECTED, BELIEVED, EGO = (
    (34, 36, 40),
    (70, 73, 80),
    (205, 205, 205),
    (110, 110, 110),
    (255, 150, 30),
    (80, 170, 255),
    (90, 220, 120),
)
LEGEND = "grey: there (dark: out of view), orange: found, blue: believed"


def drive_sheet(
    trace: EpisodeTrace, perceived: DrivePerception, shots: Sequence[tuple[float, U8]], graph: LaneGraph
) -> U8:
    """A row for each of three moments: 2 and 1 s before the first contact and at it, or spread over the drive.

    Args:
        trace: The drive.
        perceived: What was perceived in it.
        shots: Pictures that the driver got, with their times, s.
        graph: The town.
    """
    contact_steps, end_time = np.flatnonzero(trace.contact_agent > 0), (len(trace.x) - 1) * trace.dt
    row_times = (
        [max(contact_steps[0] * trace.dt - seconds, 0.0) for seconds in (2.0, 1.0, 0.0)]
        if len(contact_steps)
        else [end_time * quarter / 4 for quarter in (1, 2, 3)]
    )
    return np.vstack([_draw_moment(RecordedDrive("", trace, perceived, shots), time, graph) for time in row_times])


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """Drive with the perception of its driver.

    Attributes:
        title: Title in the film.
        trace: The drive.
        perceived: Perception of the driver in it.
        shots: Images of the driver, with their times, s.
    """

    title: str
    trace: EpisodeTrace
    perceived: DrivePerception
    shots: Sequence[tuple[float, U8]]

    @property
    def end(self) -> float:
        """End of the drive, s."""
        return (len(self.trace.x) - 1) * self.trace.dt


def drive_film(drives: Sequence[RecordedDrive], graph: LaneGraph, *, frame_interval: float = 0.2) -> Iterator[U8]:
    """Drives side by side, moment by moment; one that has ended stays at its last moment.

    Args:
        drives: The drives; none without pictures.
        graph: Their town.
        frame_interval: s from one frame to the next.

    Yields:
        RGB frames [H, W, 3] of one size.
    """
    end_time = max(drive.end for drive in drives)
    for frame_index in range(int(end_time / frame_interval + 1.5)):
        yield np.hstack(
            [
                _draw_moment(drive, min(frame_index * frame_interval, drive.end), graph, at_exact_step=True)
                for drive in drives
            ]
        )


def _draw_moment(drive: RecordedDrive, time: float, graph: LaneGraph, *, at_exact_step: bool = False) -> U8:
    """Draw a moment of a drive; unless `at_exact_step`, all of it is shown at the time of the nearest image."""
    trace, perceived = drive.trace, drive.perceived
    shown_time, image = min(drive.shots, key=lambda timed_image: abs(timed_image[0] - time))
    shown_time = time if at_exact_step else shown_time
    step = min(round(shown_time / trace.dt), len(trace.x) - 1)
    image_width = image.shape[1] * VIEW_HEIGHT // image.shape[0]
    resized = cv2.resize(np.ascontiguousarray(image), (image_width, VIEW_HEIGHT), interpolation=cv2.INTER_AREA)
    text = f"{drive.title}{', ' if drive.title else ''}{shown_time:.1f} s, {trace.speed[step, 0]:.1f} m/s"
    camera_panel = add_caption(
        np.asarray(_mark_objects(resized, trace, step, shown_time, perceived), np.uint8), text, image_width
    )
    top_panel = add_caption(_top_view(trace, step, shown_time, perceived, graph), LEGEND, WIDTH)
    row_height = max(len(camera_panel), len(top_panel))
    return np.hstack([_pad_to_height(camera_panel, row_height), _pad_to_height(top_panel, row_height)])


def _pad_to_height(image: U8, height: int) -> U8:
    return np.pad(image, ((0, height - len(image)), (0, 0), (0, 0)))


def _nearest_record(records: Sequence[tuple[float, Any]], time: float) -> Any:
    """Return the record nearest to a time; None without records."""
    return min(records, key=lambda record: abs(record[0] - time))[1] if records else None


def _mark_objects(image: U8, trace: EpisodeTrace, step: int, time: float, perceived: DrivePerception) -> U8:
    """A stake on the road for each object found (orange) and believed (blue)."""
    camera = next(iter(perceived.cameras.values()))
    factor = image.shape[1] / camera.width
    ego = (float(trace.x[step, 0]), float(trace.y[step, 0]), float(trace.yaw[step, 0]))
    detections, tracks = _nearest_record(perceived.detections, time), _nearest_record(perceived.tracks, time)
    for positions, colour in (
        ([] if detections is None else detections.place, DETECTED),
        ([] if tracks is None else tracks.place, BELIEVED),
    ):
        for position in positions:
            ego_point = to_local(np.array(ego), np.asarray(position))
            stake_ends = []
            for height in (0.0, 1.6):
                camera_point = np.linalg.inv(camera.to_ego) @ np.array([ego_point[0], ego_point[1], height, 1.0])
                if camera_point[2] > 0.5:
                    pixel = camera.intrinsic @ camera_point[:3] / camera_point[2] * factor
                    stake_ends.append((round(float(pixel[0])), round(float(pixel[1]))))
            if len(stake_ends) == 2:
                cv2.line(image, stake_ends[0], stake_ends[1], colour, 2, cv2.LINE_AA)
                cv2.circle(image, stake_ends[0], 3, colour, -1, cv2.LINE_AA)
    return image


def _top_view(trace: EpisodeTrace, step: int, time: float, perceived: DrivePerception, graph: LaneGraph) -> U8:
    """From above, the ego's heading up."""
    canvas = np.full((VIEW_HEIGHT, WIDTH, 3), GROUND, np.uint8)
    ego = np.array([trace.x[step, 0], trace.y[step, 0], trace.yaw[step, 0]], np.float64)

    def pixels(points: Any) -> Any:
        ego_points = to_local(ego, np.asarray(points, np.float64).reshape(-1, 2))
        columns = WIDTH / 2 - SCALE * ego_points[:, 1]
        rows = VIEW_HEIGHT - SCALE * (ego_points[:, 0] + VIEW_BEHIND)
        return np.rint(np.stack([columns, rows], 1)).astype(np.int32)

    is_near = np.hypot(graph.xy[:, 0] - ego[0], graph.xy[:, 1] - ego[1]) < 90.0
    for lane in range(graph.lane_count):
        vertices = slice(graph.offset[lane], graph.offset[lane + 1])
        if is_near[vertices].any():
            cv2.polylines(canvas, [pixels(graph.xy[vertices])], False, LANE, 2, cv2.LINE_AA)
    visible = in_view(trace, [step], perceived.cameras)[0]
    for agent in np.flatnonzero(trace.active[step]):
        colour = EGO if agent == 0 else VISIBLE if visible[agent] else HIDDEN
        pose = np.array([trace.x[step, agent], trace.y[step, agent], trace.yaw[step, agent]], np.float64)
        size = np.array([trace.length[agent], trace.width[agent]], np.float64)
        cv2.fillPoly(canvas, [pixels(_rectangle(pose, size))], colour, cv2.LINE_AA)
    detections, tracks = _nearest_record(perceived.detections, time), _nearest_record(perceived.tracks, time)
    if detections is not None:
        for x, y in pixels(detections.place).tolist():
            cv2.drawMarker(canvas, (x, y), DETECTED, cv2.MARKER_TILTED_CROSS, 9, 2, cv2.LINE_AA)
    if tracks is not None:
        for place, velocity, yaw, size in zip(tracks.place, tracks.velocity, tracks.yaw, tracks.size, strict=True):
            outline = pixels(_rectangle(np.array([*place, yaw]), size))
            cv2.polylines(canvas, [outline], True, BELIEVED, 2, cv2.LINE_AA)
            cv2.polylines(canvas, [pixels([place, place + velocity])], False, BELIEVED, 1, cv2.LINE_AA)
    return canvas


def _rectangle(pose: F64, size: F64) -> F64:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    local_corners = 0.5 * size * np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    return np.asarray(local_corners @ np.array([[cos, sin], [-sin, cos]]) + pose[:2])

"""Frames and boxes of a scene, and its boxes at any time between key frames.

Frames of reference as in `ssad.datasets.nuscenes.schema`. Boxes and velocities are those of the official toolkit
(nuscenes-devkit 1.2.0: get_boxes, box_velocity).
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from ssad.core.boxes import WorldBoxes
from ssad.core.errors import ConfigError
from ssad.core.rotations import slerp
from ssad.core.types import F64, I32
from ssad.datasets.nuscenes.schema import Log, Sample, Scene

MAX_TIME_DIFF = 1.5  # s between key frames beyond which the velocity is NaN


@dataclass(frozen=True, slots=True)
class SensorFrame:
    """One file of one sensor, joined with its calibration and pose.

    Attributes:
        token: Token of the file.
        sample_token: Token of its sample.
        scene_token: Token of its scene.
        channel: Name of the sensor.
        modality: camera, lidar or radar.
        filename: Path relative to the root.
        timestamp_us: Time, us.
        key_frame: Whether the file belongs to a key frame; else it is a sweep.
        width, height: Size in pixels; 0 for sensors other than cameras.
        intrinsic: Camera matrix [3, 3]; None for other sensors.
        sensor_to_ego, ego_to_world: Poses [4, 4], m.
    """

    token: str
    sample_token: str
    scene_token: str
    channel: str
    modality: str
    filename: str
    timestamp_us: int
    key_frame: bool
    width: int
    height: int
    intrinsic: F64 | None
    sensor_to_ego: F64
    ego_to_world: F64


@dataclass(frozen=True, slots=True)
class Annotations(WorldBoxes):
    """Boxes at one time, in table order.

    Attributes:
        token: Tokens of the annotations.
        instance: Tokens of the instances.
        category: Names of the categories.
        attributes: Names of the attributes of each box.
        visibility: Tokens of the visibility levels.
        lidar_points, radar_points: Points in each box [N].
    """

    token: tuple[str, ...]
    instance: tuple[str, ...]
    category: tuple[str, ...]
    attributes: tuple[tuple[str, ...], ...]
    visibility: tuple[str, ...]
    lidar_points: I32
    radar_points: I32


@dataclass(frozen=True, slots=True)
class SceneData:
    """A scene: its samples in time order, and the frames of all sensors (with sweeps) by time and channel."""

    record: Scene
    log: Log | None
    samples: tuple[Sample, ...]
    frames: tuple[SensorFrame, ...]
    boxes: dict[str, Annotations] = field(repr=False)

    def annotations(self, sample_token: str) -> Annotations:
        """Return the boxes of a key frame. ConfigError for a sample of another scene."""
        boxes = self.boxes.get(sample_token)
        if boxes is None:
            raise ConfigError(f"scene '{self.record.name}' has no sample '{sample_token}'")
        return boxes

    def annotations_at(self, timestamp_us: int) -> Annotations:
        """Boxes at a time: those of the following key frame, moved to where they were between it and the one before.

        An instance without a box in the key frame before keeps its place; before the first and after the last key
        frame, and at a key frame's own time, the boxes are that key frame's.
        """
        times = [sample.timestamp for sample in self.samples]
        next_index = bisect_left(times, timestamp_us)
        if next_index == len(times) or timestamp_us == times[next_index]:
            return self.boxes[self.samples[min(next_index, len(times) - 1)].token]
        return self._interpolate(next_index, timestamp_us)

    def annotations_of(self, frame: SensorFrame) -> Annotations:
        """Return the boxes of a frame as the official get_boxes does: those of its sample, moved for sweeps."""
        if frame.key_frame:
            return self.annotations(frame.sample_token)
        for sample_index, sample in enumerate(self.samples):
            if sample.token == frame.sample_token:
                return self._interpolate(sample_index, frame.timestamp_us)
        return self.annotations(frame.sample_token)

    def _interpolate(self, sample_number: int, timestamp_us: int) -> Annotations:
        """Boxes of sample `sample_number`, moved towards the sample before it; times beyond the two are clipped."""
        sample = self.samples[sample_number]
        current = self.boxes[sample.token]
        if sample_number == 0:
            return current
        previous_sample = self.samples[sample_number - 1]
        previous = self.boxes[previous_sample.token]
        fraction = min(
            max((timestamp_us - previous_sample.timestamp) / (sample.timestamp - previous_sample.timestamp), 0.0), 1.0
        )
        previous_rows = {instance: position for position, instance in enumerate(previous.instance)}
        pairs = [
            (position, previous_rows[instance])
            for position, instance in enumerate(current.instance)
            if instance in previous_rows
        ]
        if not pairs:
            return current
        current_index, previous_index = np.array(pairs).T
        centre, rotation = current.centre.copy(), current.rotation.copy()
        centre[current_index] = previous.centre[previous_index] + fraction * (
            current.centre[current_index] - previous.centre[previous_index]
        )
        rotation[current_index] = slerp(previous.rotation[previous_index], current.rotation[current_index], fraction)
        return replace(current, centre=make_read_only(centre), rotation=make_read_only(rotation))


def velocities(centre: F64, time: npt.NDArray[np.int64], previous_rows: I32, next_rows: I32) -> F64:
    """Return the velocities of boxes by differences over their neighbours.

    Args:
        centre: Centres [N, 3], m.
        time: Times [N], us.
        previous_rows: Row of the previous box of the same instance [N]; -1: none.
        next_rows: Row of the next box of the same instance [N]; -1: none.

    Returns:
        Velocities [N, 3], m/s; NaN without a neighbour, or if the neighbours are too far apart in time.
    """
    rows = np.arange(len(centre))
    start_rows, end_rows = np.where(previous_rows >= 0, previous_rows, rows), np.where(next_rows >= 0, next_rows, rows)
    # Converted before subtracting, as in the devkit.
    seconds = 1e-6 * time[end_rows] - 1e-6 * time[start_rows]
    time_limit = np.where((previous_rows >= 0) & (next_rows >= 0), 2.0 * MAX_TIME_DIFF, MAX_TIME_DIFF)
    is_valid = (start_rows != end_rows) & (seconds <= time_limit)
    with np.errstate(divide="ignore", invalid="ignore"):  # broken tables may have two boxes at one time
        return np.where(is_valid[:, None], (centre[end_rows] - centre[start_rows]) / seconds[:, None], np.nan)


def make_read_only(array: F64) -> F64:
    """Make an array read-only and return it."""
    array.setflags(write=False)
    return array

"""What the reader gives: the frames and boxes of a scene, and the boxes at any time between key frames.

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

MAX_TIME_DIFF = 1.5  # s between key frames, beyond it no velocity is given


@dataclass(frozen=True, slots=True)
class SensorFrame:
    """One file of one sensor, joined with its calibration and pose.

    filename is relative to the root; timestamp in us; width, height in pixels (0 for other sensors than cameras);
    intrinsic [3, 3] (None for other sensors); sensor_to_ego, ego_to_world [4, 4], metres.
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
    """Boxes at one time in table order.

    token of the annotation, instance token, category and attribute names, visibility token; velocity [N, 3];
    lidar_points, radar_points [N] in the box.
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
    """A scene: its samples in time order, and the frames of all sensors (key frames and sweeps) by time and channel."""

    record: Scene
    log: Log | None
    samples: tuple[Sample, ...]
    frames: tuple[SensorFrame, ...]
    boxes: dict[str, Annotations] = field(repr=False)

    def annotations(self, sample_token: str) -> Annotations:
        """Boxes of a key frame. ConfigError for a sample of another scene."""
        found = self.boxes.get(sample_token)
        if found is None:
            raise ConfigError(f"scene '{self.record.name}' has no sample '{sample_token}'")
        return found

    def annotations_at(self, timestamp_us: int) -> Annotations:
        """Boxes at a time: those of the following key frame, moved to where they were between it and the one before.

        An instance without a box in the key frame before keeps its place; before the first and after the last key
        frame, and at a key frame's own time, the boxes are that key frame's.
        """
        times = [sample.timestamp for sample in self.samples]
        number = bisect_left(times, timestamp_us)
        if number == len(times) or timestamp_us == times[number]:
            return self.boxes[self.samples[min(number, len(times) - 1)].token]
        return self._between(number, timestamp_us)

    def annotations_of(self, frame: SensorFrame) -> Annotations:
        """Boxes that belong to a frame as the official get_boxes gives them: those of its sample, moved for sweeps."""
        if frame.key_frame:
            return self.annotations(frame.sample_token)
        for number, sample in enumerate(self.samples):
            if sample.token == frame.sample_token:
                return self._between(number, frame.timestamp_us)
        return self.annotations(frame.sample_token)

    def _between(self, number: int, timestamp_us: int) -> Annotations:
        """Boxes of sample `number`, moved towards the sample before it; times beyond the two are clipped."""
        sample = self.samples[number]
        now = self.boxes[sample.token]
        if number == 0:
            return now
        past = self.samples[number - 1]
        then = self.boxes[past.token]
        share = min(max((timestamp_us - past.timestamp) / (sample.timestamp - past.timestamp), 0.0), 1.0)
        row = {instance: i for i, instance in enumerate(then.instance)}
        pairs = [(i, row[instance]) for i, instance in enumerate(now.instance) if instance in row]
        if not pairs:
            return now
        new, old = np.array(pairs).T
        centre, rotation = now.centre.copy(), now.rotation.copy()
        centre[new] = then.centre[old] + share * (now.centre[new] - then.centre[old])
        rotation[new] = slerp(then.rotation[old], now.rotation[new], share)
        return replace(now, centre=frozen(centre), rotation=frozen(rotation))


def velocities(centre: F64, time: npt.NDArray[np.int64], before: I32, after: I32) -> F64:
    """Velocity [N, 3] m/s by differences over the neighbours; NaN without one or when they are too far in time."""
    own = np.arange(len(centre))
    first, last = np.where(before >= 0, before, own), np.where(after >= 0, after, own)
    seconds = 1e-6 * time[last] - 1e-6 * time[first]
    limit = np.where((before >= 0) & (after >= 0), 2.0 * MAX_TIME_DIFF, MAX_TIME_DIFF)
    known = (first != last) & (seconds <= limit)
    with np.errstate(divide="ignore", invalid="ignore"):  # broken tables may have two boxes at one time
        return np.where(known[:, None], (centre[last] - centre[first]) / seconds[:, None], np.nan)


def frozen(array: F64) -> F64:
    """The array, which can no longer be written."""
    array.setflags(write=False)
    return array

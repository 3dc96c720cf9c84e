"""Data that a perceiving driver yields: detected objects, tracks, and the perception of a whole drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from ssad.core.columns import concatenate
from ssad.core.frames import Camera
from ssad.core.types import F64

I64 = npt.NDArray[np.int64]
# Share of its distance within which two readings belong to the same stop sign.
SIGN_MATCH_SHARE: Final = 0.35


@dataclass(frozen=True, slots=True)
class Objects:
    """Table of M detected objects of several scenes, in the world frame.

    Attributes:
        scene: [M] index of the scene.
        place: [M, 2] x, y of the centre, m.
        covariance: [M, 2, 2] covariance of the position, m^2.
        yaw: [M] heading, rad; NaN where unknown.
        size: [M, 2] length and width, m.
        velocity: [M, 2] m/s; NaN where unknown.
        kind: [M] `ssad.core.types.AgentKind`.
        score: [M] confidence in 0..1.
    """

    scene: I64
    place: F64
    covariance: F64
    yaw: F64
    size: F64
    velocity: F64
    kind: I64
    score: F64

    def __len__(self) -> int:
        return len(self.scene)

    def take(self, index: npt.NDArray[Any] | slice) -> Self:
        """Return the rows selected by indices, a mask or a slice."""
        return type(self)(**{column.name: getattr(self, column.name)[index] for column in fields(self)})

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """Concatenate tables in order; at least one is required."""
        return concatenate(parts)


def no_objects() -> Objects:
    """Return a table without rows."""
    floats, integers = np.zeros(0), np.zeros(0, np.int64)
    return Objects(
        integers, np.zeros((0, 2)), np.zeros((0, 2, 2)), floats, np.zeros((0, 2)), np.zeros((0, 2)), integers, floats
    )


@dataclass(frozen=True, slots=True)
class Tracks:
    """Table of N tracked objects of several scenes, in the world frame.

    Attributes:
        scene: [N] index of the scene.
        ident: [N] number of the track, unique in its scene for the whole episode.
        place: [N, 2] x, y of the centre, m.
        velocity: [N, 2] along x and y, m/s.
        yaw: [N] heading, rad.
        size: [N, 2] length and width, m; above 0.
        kind: [N] `ssad.core.types.AgentKind`; not NONE.
        score: [N] confidence of the last detection, 0 to 1.
    """

    scene: I64
    ident: I64
    place: F64
    velocity: F64
    yaw: F64
    size: F64
    kind: I64
    score: F64

    def __len__(self) -> int:
        return len(self.scene)

    def take(self, index: npt.NDArray[Any] | slice) -> Self:
        """Return the rows selected by indices, a mask or a slice."""
        return type(self)(**{column.name: getattr(self, column.name)[index] for column in fields(self)})


def no_tracks() -> Tracks:
    """Return a table without rows."""
    floats, integers, pairs = np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 2))
    return Tracks(integers, integers, pairs, pairs, floats, pairs, integers, floats)


LANE_CONFIDENCE: Final = 0.7
"""Confidence of a `PerceivedLane` from which on its markings count as detected."""


@dataclass(frozen=True, slots=True)
class PerceivedLane:
    """Lane in the ego's frame at a moment, as a driver perceives it.

    Its lines are y(x) = offset + heading x + curvature x^2 / 2 +- width / 2.

    Attributes:
        offset: Offset of its middle from the middle of the ego, m to the left.
        heading: Slope of its middle there.
        curvature: 1/m, positive to the left.
        width: m.
        confidence: Certainty that its markings were there in this image, 0 to 1.
    """

    offset: float
    heading: float
    curvature: float
    width: float
    confidence: float

    def middle(self, distance: float) -> float:
        """Return the place of the middle of the lane at a distance ahead of the ego, m to the left.

        Args:
            distance: m ahead of the middle of the ego.
        """
        return self.offset + self.heading * distance + 0.5 * self.curvature * distance * distance


@dataclass(frozen=True, eq=False)
class DrivePerception:
    """Perception of a driver in one drive.

    Attributes:
        looks: For each look its time, s, and the detections; None without an image.
        known: For each step its time, s, and the confirmed tracks.
        cameras: Its cameras.
        signs: For each look its time, s, and the positions of the stop signs that were read [M, 2].
        lanes: For each step of a lane keeper its time, s, and the lane; None before it has detected one.
        limits: For each step of a driver that reads speed limits its time, s, and the limit of the last sign that it
            has read, km/h; None before the first.
    """

    detections: Sequence[tuple[float, Objects | None]]
    tracks: Sequence[tuple[float, Tracks]]
    cameras: Mapping[str, Camera]
    signs: Sequence[tuple[float, F64]] = ()
    lanes: Sequence[tuple[float, PerceivedLane | None]] = ()
    limits: Sequence[tuple[float, int | None]] = ()

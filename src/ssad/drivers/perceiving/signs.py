"""Stop signs read by a perceiving driver: without a reading it stops at no stop line.

The map provides the stop lines; a sign that has been read makes one mandatory. Prior work attacks single images of
signs; the effect on a drive depends on how long a sign is remembered (Shen et al., SoK: semantic AI security, 2022).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from ssad.core.detections import Detections
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.perception import SIGN_MATCH_SHARE
from ssad.core.types import F32, F64, I32, U8

NAMES: Final = ("stop_sign", "stop sign")  # of our detectors and of COCO
FACE: Final = 0.762  # m, height of the face of a sign R1-1 (30 inches) on a street
AHEAD, ASIDE, BEHIND = 70.0, 14.0, 2.0  # m around the ego, along and across its heading, within which a sign counts


@dataclass(frozen=True, slots=True, kw_only=True)
class SignReading:
    """Settings of reading stop signs.

    Attributes:
        confirm: Number of looks with a reading that confirm a sign.
        memory: s that a sign is remembered after its last reading; inf: until it has been passed.
        score: Minimum score of a reading.
    """

    confirm: int = 2
    memory: float = float("inf")
    score: float = 0.3

    def __post_init__(self) -> None:
        if self.confirm < 1 or not self.memory >= 0.0 or not 0.0 <= self.score <= 1.0:
            raise ConfigError(
                "reading signs needs confirm >= 1, memory >= 0 s and a score of 0 to 1, not "
                f"{self.confirm}, {self.memory} and {self.score}"
            )


def sign_labels(classes: Sequence[str]) -> list[int]:
    """Return the labels of stop signs.

    Args:
        classes: Names of a detector's labels.

    Raises:
        ConfigError: The detector has no class for stop signs.
    """
    labels = [label for label, name in enumerate(classes) if name in NAMES]
    if not labels:
        raise ConfigError("signs are read by a detector with the class stop_sign, such as yolov5n")
    return labels


def read_signs(detections: Detections, camera: Camera, pose: F64, classes: Sequence[str], *, score: float) -> F64:
    """Return the positions of the stop signs in an image.

    Args:
        detections: What was found in it; a sign's distance is told by the height of its box.
        camera: The camera.
        pose: Of the camera in the world, [4, 4].
        classes: Names of the labels.
        score: Least score.

    Returns:
        x, y in the world [M, 2], m.

    Raises:
        ConfigError: The detector knows no stop signs.
    """
    selected = np.isin(detections.label.cpu().numpy(), sign_labels(classes)) & (
        detections.score.detach().cpu().numpy() >= score
    )
    box = detections.box.detach().cpu().double().numpy()[selected]
    depth = camera.intrinsic[1, 1] * FACE / np.maximum(box[:, 3] - box[:, 1], 1.0)
    image_centre = np.stack([0.5 * (box[:, 0] + box[:, 2]), 0.5 * (box[:, 1] + box[:, 3]), np.ones(len(box))], 1)
    local = image_centre @ np.linalg.inv(camera.intrinsic).T * depth[:, None]
    position: F64 = (local @ pose[:3, :3].T + pose[:3, 3])[:, :2]
    return position


@dataclass(slots=True)
class _SignTrack:
    place: F64
    hits: int
    last: float


@dataclass(slots=True)
class SignMemory:
    """Memory of the stop signs that have been read in B scenes.

    Attributes:
        settings: Settings.
    """

    settings: SignReading
    _signs_by_scene: list[list[_SignTrack]] = field(default_factory=list)

    def reset(self, batch: int) -> None:
        """Forget all signs of all scenes."""
        self._signs_by_scene = [[] for _ in range(batch)]

    def update(self, scene: int, time: float, viewpoint: F64, places: F64) -> None:
        """Update the memory with the signs of one look.

        Args:
            scene: Index of the scene.
            time: s when the image was taken.
            viewpoint: [2] x, y of the viewpoint.
            places: [M, 2] positions of the signs.
        """
        updated: set[int] = set()
        for place in places:
            reach = SIGN_MATCH_SHARE * float(np.linalg.norm(place - viewpoint)) + 1.0
            distances = [
                (float(np.linalg.norm(sign.place - place)), sign_index)
                for sign_index, sign in enumerate(self._signs_by_scene[scene])
            ]
            min_distance, sign_index = min(distances, default=(np.inf, -1))
            if min_distance > reach:
                self._signs_by_scene[scene].append(_SignTrack(place, 1, time))
                updated.add(len(self._signs_by_scene[scene]) - 1)
                continue
            sign = self._signs_by_scene[scene][sign_index]
            # nearer readings are more accurate, so the latest position replaces the earlier one
            self._signs_by_scene[scene][sign_index] = _SignTrack(place, sign.hits + (sign_index not in updated), time)
            updated.add(sign_index)

    def is_sign_ahead(self, scenes: I32, time: F64, pose: F32) -> U8:
        """Return whether egos know of a stop sign ahead.

        Args:
            scenes: [N] indices of the scenes.
            time: [N] s.
            pose: [N, 3] x, y, yaw of the egos.

        Returns:
            [N] 1 or 0.
        """
        is_ahead = np.zeros(len(scenes), np.uint8)
        signs = [(row, sign) for row, scene in enumerate(scenes.tolist()) for sign in self._signs_by_scene[scene]]
        if not signs:
            return is_ahead
        row = np.array([row_index for row_index, _ in signs])
        place = np.array([sign.place for _, sign in signs])
        hits, last = (np.array(column) for column in zip(*((sine.hits, sine.last) for _, sine in signs), strict=True))
        yaw = pose[row, 2].astype(np.float64)
        offset, cosine, sine = place - pose[row, :2], np.cos(yaw), np.sin(yaw)
        forward, lateral = cosine * offset[:, 0] + sine * offset[:, 1], cosine * offset[:, 1] - sine * offset[:, 0]
        confirmed = (hits >= self.settings.confirm) & (time[row] - last <= self.settings.memory)
        nearby = (forward > -BEHIND) & (forward < AHEAD) & (np.abs(lateral) < ASIDE)
        is_ahead[row[confirmed & nearby]] = 1
        return is_ahead

    def snapshot(self) -> Any:
        """Return a copy of the memory."""
        return [
            [_SignTrack(sign.place.copy(), sign.hits, sign.last) for sign in scene] for scene in self._signs_by_scene
        ]

    def restore(self, snapshot: Any) -> None:
        """Continue from an earlier snapshot."""
        self._signs_by_scene = [
            [_SignTrack(sign.place.copy(), sign.hits, sign.last) for sign in scene] for scene in snapshot
        ]

"""Stop signs that a perceiving driver reads: without them, it stops before no line of a stop sign.

Where lines lie is told by the map; whether one must stop there, by a sign that has been read. Prior work attacks single
pictures of signs; whether a drive is changed depends on how long a sign is remembered (Shen et al., SoK: semantic AI
security, 2022).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from ssad.core.detections import Detections
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import F32, F64, I32, U8

NAMES: Final = ("stop_sign", "stop sign")  # of our detectors and of COCO
FACE: Final = 0.762  # m, height of the face of a sign R1-1 (30 inches) on a street
SAME: Final = 0.35  # share of its distance, within which a sign that is read again is the same
AHEAD, ASIDE, BEHIND = 70.0, 14.0, 2.0  # m around the ego, along and across its heading, within which a sign counts


@dataclass(frozen=True, slots=True, kw_only=True)
class SignReading:
    """Settings.

    Attributes:
        confirm: Looks in which a sign must have been read until it is believed.
        memory: s that it is remembered after it was last read; inf: until it has been passed.
        score: Least score of a sign that is read.
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
    """Labels of stop signs.

    Args:
        classes: Names of a detector's labels.

    Raises:
        ConfigError: It knows no stop signs.
    """
    labels = [k for k, name in enumerate(classes) if name in NAMES]
    if not labels:
        raise ConfigError("signs are read by a detector with the class stop_sign, such as yolov5n")
    return labels


def read_signs(found: Detections, camera: Camera, pose: F64, classes: Sequence[str], *, score: float) -> F64:
    """Where the stop signs of a picture stand.

    Args:
        found: What was found in it; a sign's distance is told by the height of its box.
        camera: The camera.
        pose: Of the camera in the world, [4, 4].
        classes: Names of the labels.
        score: Least score.

    Returns:
        x, y in the world [M, 2], m.

    Raises:
        ConfigError: The detector knows no stop signs.
    """
    chosen = np.isin(found.label.cpu().numpy(), sign_labels(classes)) & (found.score.detach().cpu().numpy() >= score)
    box = found.box.detach().cpu().double().numpy()[chosen]
    depth = camera.intrinsic[1, 1] * FACE / np.maximum(box[:, 3] - box[:, 1], 1.0)
    middle = np.stack([0.5 * (box[:, 0] + box[:, 2]), 0.5 * (box[:, 1] + box[:, 3]), np.ones(len(box))], 1)
    local = middle @ np.linalg.inv(camera.intrinsic).T * depth[:, None]
    place: F64 = (local @ pose[:3, :3].T + pose[:3, 3])[:, :2]
    return place


@dataclass(slots=True)
class _Sign:
    place: F64
    hits: int
    last: float


@dataclass(slots=True)
class SignMemory:
    """The signs that have been read in B scenes.

    Attributes:
        settings: Settings.
    """

    settings: SignReading
    _known: list[list[_Sign]] = field(default_factory=list)

    def reset(self, batch: int) -> None:
        """Forget all signs of all scenes."""
        self._known = [[] for _ in range(batch)]

    def update(self, scene: int, time: float, eye: F64, places: F64) -> None:
        """Take in a look.

        Args:
            scene: Which scene.
            time: s when the picture was taken.
            eye: [2] x, y from where.
            places: [M, 2] of the signs read.
        """
        seen: set[int] = set()
        for place in places:
            reach = SAME * float(np.linalg.norm(place - eye)) + 1.0
            near = [(float(np.linalg.norm(sign.place - place)), k) for k, sign in enumerate(self._known[scene])]
            away, k = min(near, default=(np.inf, -1))
            if away > reach:
                self._known[scene].append(_Sign(place, 1, time))
                seen.add(len(self._known[scene]) - 1)
                continue
            sign = self._known[scene][k]
            # what is nearer is measured better: the last place counts
            self._known[scene][k] = _Sign(place, sign.hits + (k not in seen), time)
            seen.add(k)

    def known(self, scenes: I32, time: F64, pose: F32) -> U8:
        """Whether egos know of a stop sign before them.

        Args:
            scenes: [N] which scenes.
            time: [N] s.
            pose: [N, 3] x, y, yaw of the egos.

        Returns:
            [N] 1 or 0.
        """
        found = np.zeros(len(scenes), np.uint8)
        signs = [(row, sign) for row, scene in enumerate(scenes.tolist()) for sign in self._known[scene]]
        if not signs:
            return found
        row = np.array([one for one, _ in signs])
        place = np.array([sign.place for _, sign in signs])
        hits, last = (np.array(column) for column in zip(*((s.hits, s.last) for _, s in signs), strict=True))
        yaw = pose[row, 2].astype(np.float64)
        apart, c, s = place - pose[row, :2], np.cos(yaw), np.sin(yaw)
        along, aside = c * apart[:, 0] + s * apart[:, 1], c * apart[:, 1] - s * apart[:, 0]
        counts = (hits >= self.settings.confirm) & (time[row] - last <= self.settings.memory)
        near = (along > -BEHIND) & (along < AHEAD) & (np.abs(aside) < ASIDE)
        found[row[counts & near]] = 1
        return found

    def snapshot(self) -> Any:
        """All that changes."""
        return [[_Sign(sign.place.copy(), sign.hits, sign.last) for sign in scene] for scene in self._known]

    def restore(self, snapshot: Any) -> None:
        """Go on from an earlier moment."""
        self._known = [[_Sign(sign.place.copy(), sign.hits, sign.last) for sign in scene] for scene in snapshot]

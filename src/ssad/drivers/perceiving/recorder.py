"""Recorder of what a perceiving driver detects, tracks and sees in a drive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ssad.core.perception import DrivePerception, PerceivedLane
from ssad.core.types import F64, U8
from ssad.drivers.perceiving.driver import LaneEvent, LimitEvent, PerceivedEvent, PerceptionEvent


class PerceptionRecorder:
    """Recorder of the detections and tracks of a driver, by scene, and of a few images of each drive.

    Args:
        cameras: Cameras of the driver.
        scenes: Number of scenes.
        every: Minimum time from one stored image to the next, s; the last one is always stored. None: none are
            stored.
    """

    def __init__(self, cameras: Mapping[str, Any], scenes: int, image_interval: float | None = 0.5) -> None:
        self.cameras, self.every = cameras, image_interval
        self.looks: list[list[Any]] = [[] for _ in range(scenes)]
        self.known: list[list[Any]] = [[] for _ in range(scenes)]
        self._shots: list[list[tuple[float, Any]]] = [[] for _ in range(scenes)]
        self.signs: list[list[tuple[float, F64]]] = [[] for _ in range(scenes)]
        self.lanes: list[list[tuple[float, PerceivedLane | None]]] = [[] for _ in range(scenes)]
        self.limits: list[list[tuple[float, int | None]]] = [[] for _ in range(scenes)]

    def __call__(self, event: PerceivedEvent) -> None:
        """See `PerceivingDriver`."""
        if isinstance(event, LimitEvent):
            self.limits[event.scene].append((event.time, event.limit))
            return
        if isinstance(event, LaneEvent):
            self.lanes[event.scene].append((event.time, event.lane))
            if self.every is not None:
                self._store_image(self._shots[event.scene], event.time, event.image, self.every)
            return
        if isinstance(event, PerceptionEvent):
            self.looks[event.scene].append((event.time, event.objects))
            if event.signs is not None:
                self.signs[event.scene].append((event.time, event.signs))
            # The images of a lane keeper come with its lanes, more often.
            if self.every is not None and not self.lanes[event.scene]:
                for image in list(event.images.values())[:1]:
                    self._store_image(self._shots[event.scene], event.time, image, self.every)
            return
        # Tracks of all scenes come together; sorted by scene, each scene is a slice.
        tracks = event.tracks.take(np.argsort(event.tracks.scene, kind="stable"))
        track_limits = (np.searchsorted(tracks.scene, event.scene, side=side).tolist() for side in ("left", "right"))
        for scene, time, first_track, last_track in zip(
            event.scene.tolist(), event.time.tolist(), *track_limits, strict=True
        ):
            self.known[scene].append((time, tracks.take(slice(first_track, last_track))))

    @staticmethod
    def _store_image(shots: list[tuple[float, Any]], time: float, picture: Any, every: float) -> None:
        """The last picture stays as it came, often on a GPU, until it is known that it is kept."""
        if len(shots) > 1 and shots[-1][0] - shots[-2][0] < every - 1e-4:
            shots[-1] = time, picture
            return
        if shots:
            shots[-1] = shots[-1][0], _channels_last(shots[-1][1])
        shots.append((time, picture))

    def images(self, scene: int) -> list[tuple[float, U8]]:
        """Return the images [H, W, 3] of the driver of a scene, with their times, s."""
        return [(time, _channels_last(image)) for time, image in self._shots[scene]]

    def perception(self, scene: int) -> DrivePerception:
        """Return the perception in a scene."""
        return DrivePerception(
            self.looks[scene],
            self.known[scene],
            self.cameras,
            self.signs[scene],
            self.lanes[scene],
            self.limits[scene],
        )


def _channels_last(picture: Any) -> U8:
    """A picture [3, H, W], or one that is [H, W, 3] already, as an array [H, W, 3] of its own."""
    if hasattr(picture, "cpu"):
        picture = picture.cpu().numpy()
    return np.ascontiguousarray(np.moveaxis(picture, 0, -1)) if picture.shape[0] == 3 else picture

"""The driving system that knows of traffic only what its cameras show.

    cameras -> detector -> world -> tracker -> belief -> the Autopilot's planner and controller

Route, lane map and its own pose are given, signals are those of the map, and so are stop signs unless it reads them
itself; other road users are told by detected objects and nothing else. All else is the Autopilot, so that what it
drives worse is what it sees worse.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ssad.core.driving import Belief, Observation
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.rotations import upright_poses
from ssad.core.types import F32, F64, I32, U8, Controller, Episode
from ssad.drivers.perceiving.eyes import Eyes
from ssad.drivers.perceiving.lift import Lifting, lift, merged
from ssad.drivers.perceiving.objects import I64, Objects, no_objects
from ssad.drivers.perceiving.repair import Repair
from ssad.drivers.perceiving.signs import SignMemory, SignReading, read_signs
from ssad.drivers.perceiving.tracker import Tracker, Tracking, Tracks, believed

LATE = 1e-4  # s, less than a step: times are 32-bit numbers


@dataclass(frozen=True, eq=False)
class Sighting:
    """One look of a scene, for who watches.

    Attributes:
        scene: Which scene.
        time: s when the pictures were taken.
        found: What was found in them, in the world; None: no camera had a picture.
        pictures: What the cameras showed, uint8 [3, H, W] by name, where eyes look at pictures; tensors where pictures
            stay on a GPU.
        signs: Where the stop signs stand that were read, if the driver reads them: x, y in the world [M, 2], m.
        eye: From where: x, y [2].
    """

    scene: int
    time: float
    found: Objects | None
    pictures: Mapping[str, U8] = field(default_factory=dict)
    signs: F64 | None = None
    eye: F64 | None = None


@dataclass(frozen=True, eq=False)
class Known:
    """Belief at a step, for observers.

    Attributes:
        scene: [N] the scenes.
        time: [N] s.
        tracks: The confirmed tracks of these scenes at these times.
    """

    scene: I32
    time: F64
    tracks: Tracks


class Perceiving:
    """Autopilot on the belief of its eyes.

    Args:
        eyes: Source of detections.
        lifting: Settings of the projection of detections to the world.
        tracking: Settings of the tracker.
        rate: Looks per second; the world has 10 steps per second.
        latency: s from an image to its detections. Tracks are predicted to the present, so latency delays new objects
            but does not misplace known ones.
        watch: Called with each look, and with the belief at each step.
        repair: Repairs one perception error, to isolate its effect.
        signs: Settings of reading stop signs; None: those of the map are known.

    Raises:
        ConfigError: A value is out of its range.
    """

    name = "perceiving"
    controller = Controller.AUTOPILOT

    def __init__(
        self,
        eyes: Eyes,
        *,
        lifting: Lifting | None = None,
        tracking: Tracking | None = None,
        rate: float = 5.0,
        latency: float = 0.1,
        watch: Callable[[Sighting | Known], None] | None = None,
        repair: Repair | None = None,
        signs: SignReading | None = None,
    ) -> None:
        if not 0.0 < rate <= 1000.0 or not 0.0 <= latency <= 10.0:
            raise ConfigError(f"perceiving needs a rate above 0 and a latency of 0 to 10 s, not {rate} and {latency}")
        self.eyes, self.lifting, self.tracking = eyes, lifting or Lifting(), tracking or Tracking()
        self.rate, self.latency, self.watch = rate, latency, watch
        self.repair = repair
        self.sensors: tuple[str, ...] = tuple(dict.fromkeys((*eyes.sensors, *(("truth",) if repair else ()))))
        self._signs = None if signs is None else SignMemory(signs)
        self._tracker = Tracker(self.tracking, 0)
        self._looks = np.zeros(0, np.int64)
        self._waiting: list[Sighting] = []

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras among its sensors, which the engine renders."""
        return {name: camera for name, camera in self.eyes.cameras.items() if name in self.sensors}

    @property
    def detector(self) -> Any:
        """Detector of its eyes, for attacks; None if they have none."""
        return getattr(self.eyes, "detector", None)

    def to(self, device: str) -> None:
        """Move the computation to another device, if the eyes support it."""
        move_eyes = getattr(self.eyes, "to", None)
        if move_eyes is not None:
            move_eyes(device)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget the past."""
        self._tracker = Tracker(self.tracking, len(episodes))
        self._looks = np.full(len(episodes), -1)
        self._waiting = []
        if self._signs is not None:
            self._signs.reset(len(episodes))
        self.eyes.reset(episodes)

    def snapshot(self) -> Any:
        """Return the complete state; `restore` continues from it bit by bit, together with a simulator snapshot."""
        signs = None if self._signs is None else self._signs.snapshot()
        return self._tracker.snapshot(), self._looks.copy(), list(self._waiting), self.eyes.snapshot(), signs

    def restore(self, snapshot: Any) -> None:
        """Continue from an earlier snapshot of the same batch."""
        tracks, look_counts, pending, eye_state, sign_state = snapshot
        self._tracker.restore(tracks)
        self._looks, self._waiting = look_counts.copy(), list(pending)
        self.eyes.restore(eye_state)
        if self._signs is not None:
            self._signs.restore(sign_state)

    def act(self, view: Observation) -> F32:
        """Raise RuntimeError: the planner runs inside the world."""
        raise RuntimeError("the Autopilot runs inside the world")

    def believe(self, view: Observation) -> Belief:
        """Return the tracked objects around the egos."""
        now = view.time.astype(np.float64)
        look_counts = np.floor((now + LATE) * self.rate).astype(np.int64)
        due_rows = np.flatnonzero(~view.done & (look_counts > self._looks[view.scene]))
        if len(due_rows):
            self._looks[view.scene[due_rows]] = look_counts[due_rows]
            self._waiting += self._sightings(view, due_rows, now)
        self._take_in(dict(zip(view.scene.tolist(), now.tolist(), strict=True)))
        tracks = self._tracker.confirmed(view.scene, now)
        if self.watch is not None:
            self.watch(Known(view.scene, now, tracks))
        belief = believed(tracks, view.scene)
        if self._signs is None:
            return belief
        return replace(belief, stop_sign=self._signs.known(view.scene, now, view.pose))

    def _sightings(self, view: Observation, rows: I64, now: F64) -> list[Sighting]:
        """Return the sightings of some rows at the present time."""
        detections_by_camera, scenes = self.eyes.look(view, rows), view.scene[rows].astype(np.int64)
        ego_poses = upright_poses(view.pose[rows].astype(np.float64))
        parts, without_image, signs = [no_objects()], np.ones(len(rows), bool), [[np.zeros((0, 2))] for _ in rows]
        for name, camera in self.eyes.cameras.items():
            image_rows = np.array(
                [index for index, detections in enumerate(detections_by_camera[name]) if detections is not None],
                np.int64,
            )
            valid_detections, camera_poses = (
                [detections for detections in detections_by_camera[name] if detections is not None],
                ego_poses[image_rows] @ camera.to_ego,
            )
            parts.append(
                lift(
                    valid_detections, camera, camera_poses, scenes[image_rows], self.eyes.classes, settings=self.lifting
                )
            )
            without_image[image_rows] = False
            if self._signs is not None:
                for index, detections, camera_pose in zip(
                    image_rows.tolist(), valid_detections, camera_poses, strict=True
                ):
                    signs[index].append(
                        read_signs(detections, camera, camera_pose, self.eyes.classes, score=self._signs.settings.score)
                    )
        # Neighbouring cameras overlap, so an object can be detected twice.
        merged_objects = merged(Objects.joined(parts), self.lifting.merge)
        sightings = []
        for index, row in enumerate(rows.tolist()):
            scene_slice = slice(*np.searchsorted(merged_objects.scene, [scenes[index], scenes[index] + 1]))
            scene_objects = None if without_image[index] else merged_objects.take(scene_slice)
            if self.repair is not None:
                scene_objects = self.repair(view, row, scene_objects or no_objects(), self.eyes.cameras, self.lifting)
            images = {} if self.watch is None else self._pictures(view, row)
            sign_positions = None if self._signs is None else np.concatenate(signs[index])
            sightings.append(
                Sighting(
                    int(scenes[index]), float(now[row]), scene_objects, images, sign_positions, ego_poses[index, :2, 3]
                )
            )
            if self.watch is not None:
                self.watch(sightings[-1])
        return sightings

    def _pictures(self, view: Observation, row: int) -> dict[str, U8]:
        """Return the camera images of a row."""
        return {name: view.readings[name][row] for name in self.cameras}

    def _take_in(self, now: Mapping[int, float]) -> None:
        """Pass arrived sightings to the tracker, look by look; a look without images carries no information."""
        ready = [
            arrival
            for arrival in self._waiting
            if arrival.scene in now and arrival.time + self.latency <= now[arrival.scene] + LATE
        ]
        ready_ids = {id(arrival) for arrival in ready}
        self._waiting = [arrival for arrival in self._waiting if id(arrival) not in ready_ids]
        while ready:
            # The tracker takes at most one look per scene and call, in order of time.
            first_of_scene: dict[int, Sighting] = {}
            for sighting in ready:
                first_of_scene.setdefault(sighting.scene, sighting)
            ready = [arrival for arrival in ready if first_of_scene[arrival.scene] is not arrival]
            batch = [arrival for arrival in first_of_scene.values() if arrival.found is not None]
            if batch:
                scenes = np.array([arrival.scene for arrival in batch])
                times = np.array([arrival.time for arrival in batch])
                objects = Objects.joined(
                    [no_objects(), *(arrival.found for arrival in batch if arrival.found is not None)]
                )
                self._tracker.update(scenes, times, objects)
                for processed in batch:
                    if self._signs is not None and processed.signs is not None and processed.eye is not None:
                        self._signs.update(processed.scene, processed.time, processed.eye, processed.signs)

"""The driving system that knows of traffic only what its sensors show.

    sensors -> perceiver -> world -> tracker -> belief -> planner and controller

Route, lane map and its own pose are given, signals are those of the map, and so are stop signs unless it reads them
itself; other road users are told by detected objects and nothing else. All else is by default the Autopilot, so that
what it drives worse is what it sees worse. Perceiver, tracker and planner are protocols
(`ssad.drivers.perceiving.parts`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ssad.core.detections import Detections
from ssad.core.driving import Belief, Observation
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.perception import I64, Objects, PerceivedLane, Tracks, no_objects
from ssad.core.rotations import upright_poses
from ssad.core.types import F32, F64, I32, U8, Bool, Controller, Episode
from ssad.drivers.perceiving.ego_boxes import EgoBoxes, boxes_in_world, check_boxes, stop_sign_positions
from ssad.drivers.perceiving.lift import Lifting, lift, merge_duplicates
from ssad.drivers.perceiving.parts import (
    Perceiver,
    Planner,
    Tracker,
    cameras_of,
    hide_truth,
    restore_part,
    snapshot_part,
)
from ssad.drivers.perceiving.planner import AutopilotPlanner
from ssad.drivers.perceiving.repair import RepairedAgents
from ssad.drivers.perceiving.signs import SignMemory, SignReading, read_signs, sign_labels
from ssad.drivers.perceiving.tracker import KalmanTracker, TrackerSettings
from ssad.drivers.perceiving.tracks import belief_from_tracks, check_tracks

if TYPE_CHECKING:
    from ssad.rendering.lidar import Lidar

LATE = 1e-4  # s, less than a step: times are 32-bit numbers


@dataclass(frozen=True, eq=False)
class PerceptionEvent:
    """Perception result of one scene at one time, for observers.

    Attributes:
        scene: Index of the scene.
        time: Time of the images, s.
        objects: Detected objects in the world; None: no sensor had a reading.
        images: Camera images, uint8 [3, H, W] by name, where the perceiver reads images; tensors where
            images stay on a GPU.
        signs: Positions of the stop signs that were read, if the driver reads them: x, y in the world [M, 2], m.
        pose: Pose of the ego at that time: x, y, yaw [3].
    """

    scene: int
    time: float
    objects: Objects | None
    images: Mapping[str, U8] = field(default_factory=dict)
    signs: F64 | None = None
    pose: F64 | None = None


@dataclass(frozen=True, eq=False)
class TrackingEvent:
    """Belief at a step, for observers.

    Attributes:
        scene: [N] the scenes.
        time: [N] s.
        tracks: The confirmed tracks of these scenes at these times.
    """

    scene: I32
    time: F64
    tracks: Tracks


@dataclass(frozen=True, eq=False)
class LaneEvent:
    """Lane that a lane keeper believes in at a step, for observers.

    Attributes:
        scene: Index of the scene.
        time: s.
        lane: The lane; None before the first detection.
        image: Image that it was detected in, uint8 [3, H, W].
    """

    scene: int
    time: float
    lane: PerceivedLane | None
    image: U8


@dataclass(frozen=True, eq=False)
class LimitEvent:
    """Speed limit that a lane keeper has read at a step, for observers.

    Attributes:
        scene: Index of the scene.
        time: s.
        limit: Limit of the last sign that it has read, km/h; None before the first.
    """

    scene: int
    time: float
    limit: int | None


PerceivedEvent = PerceptionEvent | TrackingEvent | LaneEvent | LimitEvent
"""Event that a perceiving driver reports to an observer."""


class PerceivingDriver:
    """Driver that perceives: by default the Autopilot on the belief of a perceiver.

    With the planner of the Autopilot it has the method `believe` of `ssad.core.driving.Believer`; with another one its
    controller is EXTERNAL, and `act` returns the controls of that planner.

    Args:
        perceiver: Source of detections.
        tracker: Tracker of the detected objects; None: the built-in one.
        planner: Planner over the belief; None: that of the Autopilot.
        lifting: Settings of the projection of detections to the world.
        tracking: Settings of the built-in tracker.
        rate: Looks per second; the world has 10 steps per second.
        latency: s from an image to its detections. Tracks are predicted to the present, so latency delays new objects
            but does not misplace known ones.
        watch: Called with each look, and with the belief at each step.
        repair: Repairs one perception error, to isolate its effect.
        signs: Settings of reading stop signs; None: those of the map are known.

    Raises:
        ConfigError: A value is out of its range, or there are settings for a tracker that is not built in.
    """

    name = "perceiving"
    believe: Callable[[Observation], Belief]

    def __init__(
        self,
        perceiver: Perceiver,
        *,
        tracker: Tracker | None = None,
        planner: Planner | None = None,
        lifting: Lifting | None = None,
        tracking: TrackerSettings | None = None,
        rate: float = 5.0,
        latency: float = 0.1,
        watch: Callable[[PerceivedEvent], None] | None = None,
        repair: RepairedAgents | None = None,
        signs: SignReading | None = None,
    ) -> None:
        if not 0.0 < rate <= 1000.0 or not 0.0 <= latency <= 10.0:
            raise ConfigError(f"perceiving needs a rate above 0 and a latency of 0 to 10 s, not {rate} and {latency}")
        if tracker is not None and tracking is not None:
            raise ConfigError("perceiving takes a tracker, or settings of the built-in one (tracking), not both")
        self.perceiver, self.lifting, self.tracking = perceiver, lifting or Lifting(), tracking or TrackerSettings()
        self.tracker: Tracker = tracker or KalmanTracker(self.tracking, 0)
        self.planner: Planner = planner or AutopilotPlanner()
        self.controller: Controller = getattr(self.planner, "controller", Controller.EXTERNAL)
        self.rate, self.latency, self.watch = rate, latency, watch
        self.repair = repair
        self.sensors: tuple[str, ...] = tuple(dict.fromkeys((*perceiver.sensors, *(("truth",) if repair else ()))))
        self._perceiver_name = str(getattr(perceiver, "name", type(perceiver).__name__))
        self._views = cameras_of(perceiver)  # those of a perfect detector are no sensors
        self._signs = None if signs is None else SignMemory(signs)
        self._looks = np.zeros(0, np.int64)
        self._waiting: list[PerceptionEvent] = []
        if self.controller == Controller.AUTOPILOT:
            # Only a driver with this method is a Believer, whose belief the world plans over.
            self.believe = self._perceived_belief

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras among its sensors, which the engine renders."""
        return {name: camera for name, camera in self._views.items() if name in self.sensors}

    @property
    def lidars(self) -> Mapping[str, Lidar]:
        """Models of the LiDARs of its perceiver."""
        return dict(getattr(self.perceiver, "lidars", {}))

    @property
    def radars(self) -> Mapping[str, Lidar]:
        """Models of the rays of the radars of its perceiver."""
        return dict(getattr(self.perceiver, "radars", {}))

    @property
    def detector(self) -> Any:
        """Detector of its perceiver, for attacks; None without one."""
        return getattr(self.perceiver, "detector", None)

    def to(self, device: str) -> None:
        """Move the computation to another device, as far as the parts support it."""
        for part in (self.perceiver, self.tracker, self.planner):
            move_part = getattr(part, "to", None)
            if move_part is not None:
                move_part(device)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget the past."""
        self.tracker.reset(episodes)
        self._looks = np.full(len(episodes), -1)
        self._waiting = []
        if self._signs is not None:
            self._signs.reset(len(episodes))
        self.perceiver.reset(episodes)
        self.planner.reset(episodes)

    def snapshot_batch(self) -> Any:
        """Return the state of the whole batch; with a simulator's snapshot, `restore_batch` continues to the bit.

        Single episodes cannot be told apart in it, so the driver is no `ssad.core.driving.Branching`.
        """
        signs = None if self._signs is None else self._signs.snapshot()
        parts = [snapshot_part(part) for part in (self.perceiver, self.tracker, self.planner)]
        return parts, self._looks.copy(), list(self._waiting), signs

    def restore_batch(self, snapshot: Any) -> None:
        """Continue from an earlier snapshot of the same batch."""
        (perceiver, tracker, planner), look_counts, pending, sign_state = snapshot
        self.perceiver = restore_part(self.perceiver, perceiver)
        self.tracker = restore_part(self.tracker, tracker)
        self.planner = restore_part(self.planner, planner)
        self._looks, self._waiting = look_counts.copy(), list(pending)
        if self._signs is not None:
            self._signs.restore(sign_state)

    def act(self, view: Observation) -> F32:
        """Return the controls [N, 3] of its planner over what it believes.

        Raises:
            RuntimeError: The planner is that of the Autopilot, which runs inside the world.
        """
        if self.controller == Controller.AUTOPILOT:
            raise RuntimeError("the Autopilot runs inside the world")
        return self.planner.plan(hide_truth(view, readings=False), self._perceived_belief(view))

    def _perceived_belief(self, view: Observation) -> Belief:
        """Return the tracked objects around the egos."""
        now = view.time.astype(np.float64)
        look_counts = np.floor((now + LATE) * self.rate).astype(np.int64)
        due_rows = np.flatnonzero(~view.done & (look_counts > self._looks[view.scene]))
        if len(due_rows):
            self._looks[view.scene[due_rows]] = look_counts[due_rows]
            self._waiting += self._perceive_rows(view, due_rows, now)
        self._track_arrivals(dict(zip(view.scene.tolist(), now.tolist(), strict=True)))
        tracks = self.tracker.confirmed(view.scene, now)
        check_tracks(tracks, view.scene, type(self.tracker).__name__)
        if self.watch is not None:
            self.watch(TrackingEvent(view.scene, now, tracks))
        belief = belief_from_tracks(tracks, view.scene)
        if self._signs is None:
            return belief
        return replace(belief, stop_sign=self._signs.is_sign_ahead(view.scene, now, view.pose))

    def _perceive_rows(self, view: Observation, rows: I64, now: F64) -> list[PerceptionEvent]:
        """Return the sightings of some rows at the present time."""
        percepts = self.perceiver.perceive(hide_truth(view, readings=True), rows)
        scenes = view.scene[rows].astype(np.int64)
        ego_poses = upright_poses(view.pose[rows].astype(np.float64))
        if isinstance(percepts, Mapping):
            parts, without_reading, signs = self._objects_from_images(percepts, ego_poses, scenes)
        else:
            parts, without_reading, signs = self._objects_from_boxes(percepts, ego_poses, scenes)
        # Neighbouring sensors overlap, so an object can be detected twice.
        merged_objects = merge_duplicates(Objects.cat(parts), self.lifting.merge)
        events = []
        for index, row in enumerate(rows.tolist()):
            scene_slice = slice(*np.searchsorted(merged_objects.scene, [scenes[index], scenes[index] + 1]))
            scene_objects = None if without_reading[index] else merged_objects.take(scene_slice)
            if self.repair is not None:
                scene_objects = self.repair(view, row, scene_objects or no_objects(), self._views, self.lifting)
            images = {} if self.watch is None else self._camera_images(view, row)
            sign_positions = None if self._signs is None else np.concatenate(signs[index])
            events.append(
                PerceptionEvent(
                    int(scenes[index]),
                    float(now[row]),
                    scene_objects,
                    images,
                    sign_positions,
                    view.pose[row].astype(np.float64),
                )
            )
            if self.watch is not None:
                self.watch(events[-1])
        return events

    def _objects_from_images(
        self, detections_by_camera: Mapping[str, Sequence[Detections | None]], ego_poses: F64, scenes: I64
    ) -> tuple[list[Objects], Bool, list[list[F64]]]:
        """Return objects, rows [n] without an image, and positions of stop signs by row, of detections in images."""
        parts, without_image, signs = [no_objects()], np.ones(len(scenes), bool), [[np.zeros((0, 2))] for _ in scenes]
        self._check_percepts(detections_by_camera, len(scenes))
        for name, camera in self._views.items():
            image_rows = np.array(
                [index for index, detections in enumerate(detections_by_camera[name]) if detections is not None],
                np.int64,
            )
            valid_detections, camera_poses = (
                [detections for detections in detections_by_camera[name] if detections is not None],
                ego_poses[image_rows] @ camera.to_ego,
            )
            classes = self.perceiver.classes
            parts.append(
                lift(valid_detections, camera, camera_poses, scenes[image_rows], classes, settings=self.lifting)
            )
            without_image[image_rows] = False
            if self._signs is not None:
                for index, detections, camera_pose in zip(
                    image_rows.tolist(), valid_detections, camera_poses, strict=True
                ):
                    signs[index].append(
                        read_signs(detections, camera, camera_pose, classes, score=self._signs.settings.score)
                    )
        return parts, without_image, signs

    def _objects_from_boxes(
        self, boxes_by_row: Any, ego_poses: F64, scenes: I64
    ) -> tuple[list[Objects], Bool, list[list[F64]]]:
        """Return objects, rows [n] without a reading, and positions of stop signs by row, of boxes around the egos."""
        name, classes = self._perceiver_name, self.perceiver.classes
        if not isinstance(boxes_by_row, Sequence) or len(boxes_by_row) != len(scenes):
            received = len(boxes_by_row) if isinstance(boxes_by_row, Sequence) else type(boxes_by_row).__name__
            raise ConfigError(f"perceiver {name}: perceive returned {received}; expected a list of {len(scenes)} rows")
        read_rows = [row for row, boxes in enumerate(boxes_by_row) if boxes is not None]
        read_boxes = [boxes for boxes in boxes_by_row if boxes is not None]
        for boxes in read_boxes:
            if not isinstance(boxes, EgoBoxes):
                raise ConfigError(
                    f"perceiver {name}: perceive returned a row of type {type(boxes).__name__}; expected "
                    "ssad.drivers.perceiving.ego_boxes.EgoBoxes or None"
                )
            check_boxes(boxes, classes, name)
        objects = boxes_in_world(read_boxes, ego_poses[read_rows], scenes[read_rows], classes, settings=self.lifting)
        without_reading = np.ones(len(scenes), bool)
        without_reading[read_rows] = False
        signs = [[np.zeros((0, 2))] for _ in scenes]
        if self._signs is not None:
            labels, score = sign_labels(classes), self._signs.settings.score
            for row, boxes in zip(read_rows, read_boxes, strict=True):
                signs[row].append(stop_sign_positions(boxes, ego_poses[row], labels, score=score))
        return [objects], without_reading, signs

    def _check_percepts(self, detections_by_camera: Mapping[str, Sequence[Detections | None]], count: int) -> None:
        """Raise ConfigError unless there are detections of each camera and row."""
        name = self._perceiver_name
        if set(detections_by_camera) != set(self._views):
            raise ConfigError(
                f"perceiver {name}: perceive returned detections of {', '.join(detections_by_camera) or 'no camera'}; "
                f"expected those of its cameras {', '.join(self._views) or '(none)'}"
            )
        for camera, detections in detections_by_camera.items():
            if len(detections) != count:
                raise ConfigError(f"perceiver {name}: camera {camera} has {len(detections)} rows; expected {count}")

    def _camera_images(self, view: Observation, row: int) -> dict[str, U8]:
        """Return the camera images of a row."""
        return {name: view.readings[name][row] for name in self.cameras}

    def _track_arrivals(self, now: Mapping[int, float]) -> None:
        """Pass arrived sightings to the tracker, look by look; a look without images carries no information."""
        ready = [
            event
            for event in self._waiting
            if event.scene in now and event.time + self.latency <= now[event.scene] + LATE
        ]
        ready_ids = {id(event) for event in ready}
        self._waiting = [event for event in self._waiting if id(event) not in ready_ids]
        while ready:
            # The tracker takes at most one look per scene and call, in order of time.
            first_of_scene: dict[int, PerceptionEvent] = {}
            for ready_event in ready:
                first_of_scene.setdefault(ready_event.scene, ready_event)
            ready = [event for event in ready if first_of_scene[event.scene] is not event]
            batch = [event for event in first_of_scene.values() if event.objects is not None]
            if batch:
                scenes = np.array([event.scene for event in batch])
                times = np.array([event.time for event in batch])
                poses = np.array([event.pose for event in batch])
                objects = Objects.cat([no_objects(), *(event.objects for event in batch if event.objects is not None)])
                self.tracker.update(scenes, times, objects, poses)
                for processed in batch:
                    if self._signs is not None and processed.signs is not None and processed.pose is not None:
                        self._signs.update(processed.scene, processed.time, processed.pose[:2], processed.signs)

"""The shifts on the fly: a scene of a nuScenes folder whose images and sweeps come out shifted."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from ssad.core.boxes import TrackedBoxes
from ssad.core.errors import FormatError
from ssad.core.frames import Applied, Camera, Frame, SceneContext, StandingObject, SweepFrame
from ssad.core.images import read_image
from ssad.core.nuscenes_names import LIDAR, VISIBILITY
from ssad.core.safeio import read_bytes
from ssad.core.types import F32, F64, U8
from ssad.datasets.nuscenes.files import read_points
from ssad.datasets.nuscenes.scene import Annotations, SceneData, SensorFrame
from ssad.scenarios.static.shifts import (
    ShiftSpec,
    random_severity,
    shift_images,
    shift_points,
    sky_light,
    transformed_boxes,
)
from ssad.scenarios.static.shifts.sun import choose_sun, free_sun, sun_angle, sun_depth, sun_direction, sun_in_picture


def boxes_of(found: Annotations) -> tuple[TrackedBoxes, npt.NDArray[np.intp]]:
    """Annotations as boxes, and their rows [N]; an unknown visibility counts as visible.

    Boxes without a volume are left out: no shift of an object can be made of them.
    """
    rows = np.flatnonzero((found.size_lwh > 0).all(axis=1))
    own = found.take(rows)
    visible = np.array([VISIBILITY.get(token, 1.0) for token in own.visibility])
    return TrackedBoxes(own.centre, own.size_lwh, own.rotation, own.velocity, own.instance, visible), rows


class SceneShifter:
    """A scene seen through a shift; what a frame gives depends only on the scene, the frame and the spec.

    Args:
        root: The folder of the dataset.
        scene: From `NuScenes.scene`.
        spec: The shift.
        random: Whether its severity is drawn anew (by sample in the paper's calibration, by scene in the physical one).
    """

    def __init__(self, root: Path, scene: SceneData, spec: ShiftSpec, *, random: bool = False) -> None:
        self.root, self.scene, self.base, self.random = Path(root), scene, spec, random
        self._clouds: OrderedDict[str, F32] = OrderedDict()
        self._suns: dict[str, tuple[str, float | None]] = {}
        self._tracks: dict[str, tuple[F64, F64]] = {}
        for channel in {f.channel for f in scene.frames}:
            track = [f for f in scene.frames if f.channel == channel]
            times = np.array([f.timestamp_us for f in track]) / 1e6
            self._tracks[channel] = times, np.array([f.ego_to_world[:3, 3] for f in track])
        self._sweeps = [f for f in scene.frames if f.channel == LIDAR]
        self._sweep_times = np.array([f.timestamp_us for f in self._sweeps])

    def spec(self, frame: SensorFrame) -> ShiftSpec:
        """The shift of a frame, its severity drawn where it is random."""
        if not self.random:
            return self.base
        return self.base.at(random_severity(self.base, frame.scene_token, frame.sample_token))

    @property
    def context(self) -> SceneContext:
        """Brightness of the sky, heading of the ego and place of the sun, from the first sample that can be read."""
        return self._opening[1]

    @cached_property
    def _opening(self) -> tuple[str, SceneContext]:
        """The context, and the token of the sample it was measured on ("" when none can be read)."""
        start = self.scene.frames[0].timestamp_us / 1e6 if self.scene.frames else 0.0
        token = self.scene.record.token
        for sample in self.scene.samples:
            cameras = self._cameras(sample.token)
            try:
                images = [self.read(f) for f in cameras]
                depths = [self._depth(f) for f in cameras]
            except FormatError:
                continue
            if images:
                forward = cameras[0].ego_to_world[:2, 0]
                heading = float(np.arctan2(forward[1], forward[0]))
                night = "night" in self.scene.record.description.lower()  # as nuScenes says it
                context = SceneContext(token, sky_light(images, depths, night=night), heading, start)
                if self._has_sun:
                    shown = [(self._view(f), image) for f, image in zip(cameras, images, strict=True) if _has_lens(f)]
                    context = replace(context, sun=choose_sun(self.base, context, shown))
                return sample.token, context
        return "", SceneContext(token, start=start)

    def basis(self, frame: SensorFrame) -> dict[str, str]:
        """What else of the dataset decides about a frame under weather: plain data for the manifest.

        context: token of the sample that gave the brightness of the sky; sweep: name of the LiDAR file that gave
        depth, "" when it could not be read; sun: name of the picture that says whether the sun is hidden, "" for
        none. A better basis, after the dataset was mended, means another picture.
        """
        found = {}
        if self.base.family == "environment":
            found["context"] = self._opening[0]
        if frame.modality == "camera" and self._uses_depth and self._sweeps:
            sweep = self._nearest(frame)
            found["sweep"] = sweep.filename if self._read(sweep) is not None else ""
        if frame.modality == "camera" and self._has_sun:
            found["sun"] = self._sun(frame.sample_token)[0]
        return found

    def outdated(self, frame: SensorFrame, basis: Mapping[str, object]) -> bool:
        """Whether a frame made on this basis would now have a better one."""
        order = {sample.token: n for n, sample in enumerate(self.scene.samples)}
        made = order.get(str(basis["context"]), len(order)) if "context" in basis else 0
        if made and order.get(self._opening[0], len(order)) < made:
            return True
        now = self.basis(frame)
        return any(basis.get(name) == "" and now.get(name) != "" for name in ("sweep", "sun"))

    def velocity(self, frame: SensorFrame) -> F64:
        """Velocity [3] of the ego, m/s, world: from the poses of the channel before and after."""
        times, places = self._tracks[frame.channel]
        now = int(np.searchsorted(times, frame.timestamp_us / 1e6))
        before, after = max(now - 1, 0), min(now + 1, len(times) - 1)
        span = times[after] - times[before]
        return np.asarray((places[after] - places[before]) / span) if span > 0 else np.zeros(3)

    def cloud(self, frame: SensorFrame) -> F32:
        """The clean points [P, 5] of a sweep; the last few sweeps are kept.

        Raises:
            FormatError: The sweep cannot be read.
        """
        if frame.token not in self._clouds:
            self._clouds[frame.token] = read_points(self.root / frame.filename)
            self._clouds[frame.token].setflags(write=False)
            while len(self._clouds) > 4:
                self._clouds.popitem(last=False)
        return self._clouds[frame.token]

    @property
    def _uses_depth(self) -> bool:
        """Whether images take depth from the LiDAR."""
        return self.base.calibration == "physical" and self.base.name in ("fog", "rain", "snow", "sunlight")

    def _nearest(self, frame: SensorFrame) -> SensorFrame:
        """The nearest sweep in time."""
        return self._sweeps[int(np.abs(self._sweep_times - frame.timestamp_us).argmin())]

    def _read(self, sweep: SensorFrame) -> F32 | None:
        """Points of the sweep; None when they cannot be read."""
        try:
            return self.cloud(sweep)
        except FormatError:
            return None

    def _points(self, frame: SensorFrame) -> F32 | None:
        """The nearest sweep in the frame of a camera; None without LiDAR or when it cannot be read."""
        if not self._sweeps:
            return None
        sweep = self._nearest(frame)
        cloud = self._read(sweep)
        if cloud is None:
            return None
        to_camera = np.linalg.inv(frame.ego_to_world @ frame.sensor_to_ego) @ sweep.ego_to_world @ sweep.sensor_to_ego
        return np.asarray(cloud[:, :3] @ to_camera[:3, :3].T + to_camera[:3, 3], np.float32)

    def _depth(self, frame: SensorFrame) -> F32 | None:
        """The depth map that `ssad record` wrote beside the picture; None where there is none. FormatError."""
        path = self.root / "depth" / frame.channel / f"{frame.token}.png"
        if not path.is_file():
            return None
        values = cv2.imdecode(np.frombuffer(read_bytes(path), np.uint8), cv2.IMREAD_UNCHANGED)
        if values is None or values.dtype != np.uint16 or values.ndim != 2:
            raise FormatError(f"{path}: not a depth map of 16 bits")
        return np.where(values == 65535, np.inf, values / 64).astype(np.float32)

    def _frame(
        self, frame: SensorFrame, boxes: TrackedBoxes, points: F32 | None = None, depth: F32 | None = None
    ) -> Frame:
        if frame.intrinsic is None or not _has_lens(frame):
            raise FormatError(f"{frame.filename}: the camera {frame.channel} has no focal length")
        camera = Camera(frame.width, frame.height, frame.intrinsic, frame.sensor_to_ego, frame.channel)
        return Frame(
            camera,
            frame.scene_token,
            frame.sample_token if self.base.family == "object" else frame.token,
            frame.timestamp_us / 1e6,
            frame.ego_to_world,
            self.velocity(frame),
            boxes,
            depth=depth,
            points=points,
        )

    @property
    def _has_sun(self) -> bool:
        return self.base.calibration == "physical" and self.base.name == "sunlight"

    def _cameras(self, sample_token: str) -> list[SensorFrame]:
        """The pictures of a sample."""
        return [
            f for f in self.scene.frames if f.key_frame and f.modality == "camera" and f.sample_token == sample_token
        ]

    def _sun(self, sample_token: str) -> tuple[str, float | None]:
        """The picture of a sample that shows the sun most centrally, and the share of the sun that is visible in it.

        Returns:
            File name and share; "" and None when the sun stands in no picture that can be read.
        """
        if sample_token not in self._suns:
            toward = sun_direction(self.base, self.context)
            views = [(f, self._frame(f, TrackedBoxes.empty())) for f in self._cameras(sample_token) if _has_lens(f)]
            views = [(f, view) for f, view in views if sun_in_picture(view, toward)]
            self._suns[sample_token] = "", None
            for f, bare in sorted(views, key=lambda pair: sun_angle(pair[1], toward)):
                try:
                    depth = sun_depth(self._view(f), self.read(f))
                except FormatError:
                    continue
                self._suns[sample_token] = f.filename, free_sun(bare, depth, toward)
                break
        return self._suns[sample_token]

    def camera_frame(self, frame: SensorFrame) -> Frame:
        """What the shift is told about an image."""
        view = self._view(frame)
        return replace(view, sun=self._sun(frame.sample_token)[1]) if self._has_sun else view

    def _view(self, frame: SensorFrame) -> Frame:
        """The same by its own picture alone."""
        objects = self.base.family == "object" or self._uses_depth or self.base.places_objects
        boxes = boxes_of(self.scene.annotations_of(frame))[0] if objects else TrackedBoxes.empty()
        if self.base.places_objects:
            return self._frame(frame, boxes, depth=self._depth(frame))
        if not self._uses_depth:
            return self._frame(frame, boxes)
        return self._frame(frame, boxes, self._points(frame), self._depth(frame))

    def read(self, frame: SensorFrame) -> U8:
        """The clean image.

        Raises:
            FormatError: The image cannot be read, or its size is not what the tables say.
        """
        image = read_image(self.root / frame.filename)
        if frame.width and image.shape[:2] != (frame.height, frame.width):
            raise FormatError(
                f"{self.root / frame.filename}: {image.shape[1]} x {image.shape[0]} pixels, "
                f"the tables say {frame.width} x {frame.height}"
            )
        return image

    def images(
        self, frames: Sequence[SensorFrame], *, clean: Sequence[U8] | None = None, device: str | None = None
    ) -> tuple[list[U8], list[Applied]]:
        """Shifted images of camera frames of one size.

        Args:
            frames: The frames.
            clean: Their images from `read`, if they are at hand.
            device: Where to compute.

        Returns:
            The images [H, W, 3], and what was done to each.

        Raises:
            FormatError: An image or sweep cannot be read.
        """
        pixels = [self.read(f) for f in frames] if clean is None else clean
        specs = [self.spec(f) for f in frames]
        # tables without sizes: that of the image
        sized = [
            f if f.width and f.height else replace(f, width=p.shape[1], height=p.shape[0])
            for f, p in zip(frames, pixels, strict=True)
        ]
        views = [self.camera_frame(f) for f in sized]
        out, done = shift_images(np.stack(pixels), views, specs, contexts=self._contexts, device=device)
        return list(out), done

    def image(self, frame: SensorFrame, *, clean: U8 | None = None) -> tuple[U8, Applied]:
        """One shifted image, and what was done.

        Raises:
            FormatError: An image or sweep cannot be read.
        """
        images, done = self.images([frame], clean=None if clean is None else [clean])
        return images[0], done[0]

    @property
    def _contexts(self) -> dict[str, SceneContext] | None:
        if self.base.places_objects:
            return {self.context.scene: replace(self.context, objects=self.objects)}
        return {self.context.scene: self.context} if self.base.family == "environment" else None

    @cached_property
    def objects(self) -> tuple[StandingObject, ...]:
        """What a shift that places objects puts on the road of the scene, at all severities."""
        from ssad.scenarios.static.shifts.anomaly import place_objects

        poses = np.array([f.ego_to_world for f in self.scene.frames if f.key_frame or f.modality == "camera"])
        boxes = [boxes_of(self.scene.annotations(sample.token))[0] for sample in self.scene.samples]
        return place_objects(self.base, self.scene.record.token, poses.reshape(-1, 4, 4), boxes)

    def points(self, frame: SensorFrame) -> tuple[F32, Applied]:
        """The shifted points [P, 5] of a LiDAR frame, and what was done.

        Raises:
            FormatError: The sweep cannot be read.
        """
        objects = self.base.family == "object"
        boxes = boxes_of(self.scene.annotations_of(frame))[0] if objects else TrackedBoxes.empty()
        sweep = SweepFrame(
            frame.scene_token,
            frame.sample_token if self.base.family == "object" else frame.token,
            frame.timestamp_us / 1e6,
            frame.sensor_to_ego,
            frame.ego_to_world,
            self.velocity(frame),
            boxes,
        )
        return shift_points(self.cloud(frame), sweep, self.spec(frame), contexts=self._contexts)

    def key_sweep(self, sample_token: str) -> SensorFrame | None:
        """The LiDAR frame of a sample, if it has one."""
        return next((f for f in self._sweeps if f.key_frame and f.sample_token == sample_token), None)

    def labels(self, sample_token: str, *, lidar: bool | None = True) -> Annotations:
        """The boxes of a sample after the shift, with the number of points in each.

        Severity 0 changes nothing, counts included.

        Args:
            sample_token: Token of the sample.
            lidar: Count the points in the shifted sweep (True), in the clean one (False), or leave the counts unchanged
                (None).

        Raises:
            FormatError: The sweep cannot be read.
        """
        found = self.scene.annotations(sample_token)
        frame = next((f for f in self.scene.frames if f.sample_token == sample_token), None)
        if frame is None or self.spec(frame).severity == 0:
            return found
        old, rows = boxes_of(found)
        boxes = transformed_boxes(self.spec(frame), old, scene=frame.scene_token, sample=sample_token)
        centre, size, rotation = found.centre.copy(), found.size_lwh.copy(), found.rotation.copy()
        centre[rows], size[rows], rotation[rows] = boxes.centre, boxes.size_lwh, boxes.rotation
        points, sweep = found.lidar_points.copy(), self.key_sweep(sample_token)
        if sweep is not None and lidar is not None:
            points[rows] = _count(self.points(sweep)[0] if lidar else self.cloud(sweep), sweep, boxes)
        return replace(found, centre=centre, size_lwh=size, rotation=rotation, lidar_points=points)


def _has_lens(frame: SensorFrame) -> bool:
    return frame.intrinsic is not None and min(frame.intrinsic[0, 0], frame.intrinsic[1, 1]) > 0


def _count(cloud: F32, sweep: SensorFrame, boxes: TrackedBoxes) -> npt.NDArray[np.int32]:
    """Points in each box."""
    from ssad.scenarios.static.shifts.lidar import inside
    from ssad.scenarios.static.shifts.objects import affine

    pose = sweep.ego_to_world @ sweep.sensor_to_ego
    world = np.asarray(cloud[:, :3] @ pose[:3, :3].T + pose[:3, 3])
    matrix, centre = affine(boxes)
    counts = [int(inside(world, matrix[n], centre[n]).sum()) for n in range(len(boxes))]
    return np.array(counts, np.int32)

"""Shifts on the fly: a scene of a nuScenes folder with shifted images and sweeps."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ssad.core.boxes import TrackedBoxes
from ssad.core.errors import FormatError
from ssad.core.frames import Camera, Frame, SceneContext, ShiftReport, StandingObject, SweepFrame
from ssad.core.image_files import read_image_file
from ssad.core.nuscenes_names import LIDAR, VISIBILITY
from ssad.core.types import F32, F64, U8
from ssad.datasets.nuscenes.files import read_frame_image, read_frame_points
from ssad.datasets.nuscenes.scene import Annotations, SceneData, SensorFrame
from ssad.scenarios.static.shifts import (
    ShiftSpec,
    random_severity,
    shift_images,
    shift_points,
    sky_light,
    transformed_boxes,
)
from ssad.scenarios.static.shifts.sun import (
    choose_sun,
    sun_angle,
    sun_depth,
    sun_direction,
    sun_in_image,
    visible_sun_share,
)


def boxes_of(annotations: Annotations) -> tuple[TrackedBoxes, npt.NDArray[np.intp]]:
    """Return annotations as boxes, and their rows [N]; an unknown visibility counts as visible.

    Boxes without a volume are left out: no shift of an object can be made of them.
    """
    rows = np.flatnonzero((annotations.size_lwh > 0).all(axis=1))
    solid_annotations = annotations.take(rows)
    visibility = np.array([VISIBILITY.get(token, 1.0) for token in solid_annotations.visibility])
    return TrackedBoxes(
        solid_annotations.centre,
        solid_annotations.size_lwh,
        solid_annotations.rotation,
        solid_annotations.velocity,
        solid_annotations.instance,
        visibility,
    ), rows


class SceneShifter:
    """Scene seen through a shift; a result depends only on the scene, the frame and the spec.

    Args:
        root: The folder of the dataset.
        scene: Scene from `NuScenes.scene`.
        spec: The shift.
        random: Whether its severity is drawn anew (by sample in the paper's calibration, by scene in the physical
            one).
    """

    def __init__(self, root: Path, scene: SceneData, spec: ShiftSpec, *, random: bool = False) -> None:
        self.root, self.scene, self.base, self.random = Path(root), scene, spec, random
        self._clouds: OrderedDict[str, F32] = OrderedDict()
        self._suns: dict[str, tuple[str, float | None]] = {}
        self._tracks: dict[str, tuple[F64, F64]] = {}
        for channel in {frame.channel for frame in scene.frames}:
            channel_frames = [frame for frame in scene.frames if frame.channel == channel]
            timestamps = np.array([frame.timestamp_us for frame in channel_frames]) / 1e6
            self._tracks[channel] = timestamps, np.array([frame.ego_to_world[:3, 3] for frame in channel_frames])
        self._sweeps = [frame for frame in scene.frames if frame.channel == LIDAR]
        self._sweep_times = np.array([frame.timestamp_us for frame in self._sweeps])

    def spec(self, frame: SensorFrame) -> ShiftSpec:
        """Return the shift of a frame, with a drawn severity if it is random."""
        if not self.random:
            return self.base
        return self.base.at(random_severity(self.base, frame.scene_token, frame.sample_token))

    @property
    def context(self) -> SceneContext:
        """Brightness of the sky, heading of the ego and place of the sun, from the first readable sample."""
        return self._measured_context[1]

    @cached_property
    def _measured_context(self) -> tuple[str, SceneContext]:
        """Context, and the token of the sample that it was measured on ("" if none can be read)."""
        start = self.scene.frames[0].timestamp_us / 1e6 if self.scene.frames else 0.0
        token = self.scene.record.token
        for sample in self.scene.samples:
            cameras = self._cameras(sample.token)
            try:
                images = [self.read(frame) for frame in cameras]
                depths = [self._depth(frame) for frame in cameras]
            # A broken first sample must not stop the scene: the next one serves as well.
            except FormatError:
                continue
            if images:
                forward = cameras[0].ego_to_world[:2, 0]
                heading = float(np.arctan2(forward[1], forward[0]))
                is_night = "night" in self.scene.record.description.lower()  # as nuScenes says it
                context = SceneContext(token, sky_light(images, depths, night=is_night), heading, start)
                if self._has_sun:
                    visible_images = [
                        (self._view(frame), image)
                        for frame, image in zip(cameras, images, strict=True)
                        if _has_lens(frame)
                    ]
                    context = replace(context, sun=choose_sun(self.base, context, visible_images))
                return sample.token, context
        return "", SceneContext(token, start=start)

    def basis(self, frame: SensorFrame) -> dict[str, str]:
        """Return all further data that decide a frame under weather: plain data for the manifest.

        context: token of the sample that gave the brightness of the sky; sweep: name of the LiDAR file that gave
        depth, "" if it could not be read; sun: name of the image that tells whether the sun is hidden, "" for
        none. A better basis, after a repair of the dataset, means another image.
        """
        basis_fields = {}
        if self.base.family == "environment":
            basis_fields["context"] = self._measured_context[0]
        if frame.modality == "camera" and self._uses_depth and self._sweeps:
            sweep = self._nearest_sweep(frame)
            basis_fields["sweep"] = sweep.filename if self._read_sweep(sweep) is not None else ""
        if frame.modality == "camera" and self._has_sun:
            basis_fields["sun"] = self._sun(frame.sample_token)[0]
        return basis_fields

    def is_outdated(self, frame: SensorFrame, basis: Mapping[str, object]) -> bool:
        """Return True if a frame made on this basis would now have a better one."""
        sample_order = {sample.token: index for index, sample in enumerate(self.scene.samples)}
        used_index = sample_order.get(str(basis["context"]), len(sample_order)) if "context" in basis else 0
        if used_index and sample_order.get(self._measured_context[0], len(sample_order)) < used_index:
            return True
        current_basis = self.basis(frame)
        return any(basis.get(name) == "" and current_basis.get(name) != "" for name in ("sweep", "sun"))

    def velocity(self, frame: SensorFrame) -> F64:
        """Return the velocity [3] of the ego, m/s, world, from the neighbouring poses of the channel."""
        times, positions = self._tracks[frame.channel]
        frame_index = int(np.searchsorted(times, frame.timestamp_us / 1e6))
        previous_index, next_index = max(frame_index - 1, 0), min(frame_index + 1, len(times) - 1)
        time_span = times[next_index] - times[previous_index]
        return (
            np.asarray((positions[next_index] - positions[previous_index]) / time_span)
            if time_span > 0
            else np.zeros(3)
        )

    def cloud(self, frame: SensorFrame) -> F32:
        """Return the clean points [P, 5] of a sweep; the last few sweeps are cached.

        Raises:
            FormatError: The sweep cannot be read.
        """
        if frame.token not in self._clouds:
            self._clouds[frame.token] = read_frame_points(self.root, frame)
            self._clouds[frame.token].setflags(write=False)
            while len(self._clouds) > 4:
                self._clouds.popitem(last=False)
        return self._clouds[frame.token]

    @property
    def _uses_depth(self) -> bool:
        """True if images take depth from the LiDAR."""
        return self.base.calibration == "physical" and self.base.name in ("fog", "rain", "snow", "sunlight")

    def _nearest_sweep(self, frame: SensorFrame) -> SensorFrame:
        """Return the nearest sweep in time."""
        return self._sweeps[int(np.abs(self._sweep_times - frame.timestamp_us).argmin())]

    def _read_sweep(self, sweep: SensorFrame) -> F32 | None:
        """Return the points of a sweep; None if they cannot be read."""
        try:
            return self.cloud(sweep)
        except FormatError:
            return None

    def _points(self, frame: SensorFrame) -> F32 | None:
        """Return the nearest sweep in the frame of a camera; None without LiDAR or if it cannot be read."""
        if not self._sweeps:
            return None
        sweep = self._nearest_sweep(frame)
        cloud = self._read_sweep(sweep)
        if cloud is None:
            return None
        to_camera = np.linalg.inv(frame.ego_to_world @ frame.sensor_to_ego) @ sweep.ego_to_world @ sweep.sensor_to_ego
        return np.asarray(cloud[:, :3] @ to_camera[:3, :3].T + to_camera[:3, 3], np.float32)

    def _depth(self, frame: SensorFrame) -> F32 | None:
        """Return the depth map that `ssad record` wrote beside the image; None without one.

        Raises:
            FormatError: The file is no depth map.
        """
        path = self.root / "depth" / frame.channel / f"{frame.token}.png"
        if not path.is_file():
            return None
        depth_map = read_image_file(path)
        if not depth_map.has_16_bits or depth_map.pixels.shape[2] != 1:
            raise FormatError(f"{path}: not a depth map of 16 bits")
        codes = depth_map.pixels[..., 0]
        # The inverse of `depth_bytes` of the recorder: 64 steps per metre, 65535 for the sky.
        return np.where(codes == 65535, np.inf, codes / 64).astype(np.float32)

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
        """Return the camera frames of a sample."""
        return [
            frame
            for frame in self.scene.frames
            if frame.key_frame and frame.modality == "camera" and frame.sample_token == sample_token
        ]

    def _sun(self, sample_token: str) -> tuple[str, float | None]:
        """Return the image of a sample that shows the sun most centrally, and the visible share of the sun in it.

        Returns:
            File name and share; "" and None if the sun is in no readable image.
        """
        if sample_token not in self._suns:
            sun_vector = sun_direction(self.base, self.context)
            views = [
                (frame, self._frame(frame, TrackedBoxes.empty()))
                for frame in self._cameras(sample_token)
                if _has_lens(frame)
            ]
            views = [(frame, view) for frame, view in views if sun_in_image(view, sun_vector)]
            self._suns[sample_token] = "", None
            for frame, bare_view in sorted(views, key=lambda pair: sun_angle(pair[1], sun_vector)):
                try:
                    depth = sun_depth(self._view(frame), self.read(frame))
                except FormatError:
                    continue
                self._suns[sample_token] = frame.filename, visible_sun_share(bare_view, depth, sun_vector)
                break
        return self._suns[sample_token]

    def camera_frame(self, frame: SensorFrame) -> Frame:
        """Return the description of an image that the shift uses."""
        view = self._view(frame)
        return replace(view, sun=self._sun(frame.sample_token)[1]) if self._has_sun else view

    def _view(self, frame: SensorFrame) -> Frame:
        """Return the same from the image alone, without the sun."""
        needs_boxes = self.base.family == "object" or self._uses_depth or self.base.places_objects
        boxes = boxes_of(self.scene.annotations_of(frame))[0] if needs_boxes else TrackedBoxes.empty()
        if self.base.places_objects:
            return self._frame(frame, boxes, depth=self._depth(frame))
        if not self._uses_depth:
            return self._frame(frame, boxes)
        return self._frame(frame, boxes, self._points(frame), self._depth(frame))

    def describe_frame(self, frame: SensorFrame) -> Frame:
        """Return the description of an image with all that is known of it: boxes, depth, LiDAR returns."""
        return self._frame(
            frame, boxes_of(self.scene.annotations_of(frame))[0], self._points(frame), self._depth(frame)
        )

    def read(self, frame: SensorFrame) -> U8:
        """Return the clean image.

        Raises:
            FormatError: The image cannot be read, or its size contradicts the tables.
        """
        return read_frame_image(self.root, frame)

    def images(
        self, frames: Sequence[SensorFrame], *, clean: Sequence[U8] | None = None, device: str | None = None
    ) -> tuple[list[U8], list[ShiftReport]]:
        """Return the shifted images of camera frames of one size.

        Args:
            frames: The frames.
            clean: Their images from `read`, if available.
            device: Device of the computation.

        Returns:
            The images [H, W, 3], and a report for each.

        Raises:
            FormatError: An image or sweep cannot be read.
        """
        clean_images = [self.read(frame) for frame in frames] if clean is None else clean
        specs = [self.spec(frame) for frame in frames]
        # tables may lack sizes; the image has them
        sized_frames = [
            frame if frame.width and frame.height else replace(frame, width=image.shape[1], height=image.shape[0])
            for frame, image in zip(frames, clean_images, strict=True)
        ]
        views = [self.camera_frame(frame) for frame in sized_frames]
        shifted, reports = shift_images(np.stack(clean_images), views, specs, contexts=self._contexts, device=device)
        return list(shifted), reports

    def image(self, frame: SensorFrame, *, clean: U8 | None = None) -> tuple[U8, ShiftReport]:
        """Return one shifted image, and a report.

        Raises:
            FormatError: An image or sweep cannot be read.
        """
        images, reports = self.images([frame], clean=None if clean is None else [clean])
        return images[0], reports[0]

    @property
    def _contexts(self) -> dict[str, SceneContext] | None:
        if self.base.places_objects:
            return {self.context.scene: replace(self.context, objects=self.objects)}
        return {self.context.scene: self.context} if self.base.family == "environment" else None

    @cached_property
    def objects(self) -> tuple[StandingObject, ...]:
        """Objects that a shift places on the road of the scene, at all severities."""
        from ssad.scenarios.static.shifts.anomaly import place_objects

        poses = np.array(
            [frame.ego_to_world for frame in self.scene.frames if frame.key_frame or frame.modality == "camera"]
        )
        boxes = [boxes_of(self.scene.annotations(sample.token))[0] for sample in self.scene.samples]
        return place_objects(self.base, self.scene.record.token, poses.reshape(-1, 4, 4), boxes)

    def points(self, frame: SensorFrame) -> tuple[F32, ShiftReport]:
        """Return the shifted points [P, 5] of a LiDAR frame, and a report.

        Raises:
            FormatError: The sweep cannot be read.
        """
        needs_boxes = self.base.family == "object"
        boxes = boxes_of(self.scene.annotations_of(frame))[0] if needs_boxes else TrackedBoxes.empty()
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
        """Return the LiDAR frame of a sample, if it has one."""
        return next((frame for frame in self._sweeps if frame.key_frame and frame.sample_token == sample_token), None)

    def labels(self, sample_token: str, *, lidar: bool | None = True) -> Annotations:
        """Return the boxes of a sample after the shift, with the number of points in each.

        Severity 0 changes nothing, counts included.

        Args:
            sample_token: Token of the sample.
            lidar: Count the points in the shifted sweep (True), in the clean one (False), or leave the counts unchanged
                (None).

        Raises:
            FormatError: The sweep cannot be read.
        """
        original = self.scene.annotations(sample_token)
        frame = next((candidate for candidate in self.scene.frames if candidate.sample_token == sample_token), None)
        if frame is None or self.spec(frame).severity == 0:
            return original
        original_boxes, rows = boxes_of(original)
        boxes = transformed_boxes(self.spec(frame), original_boxes, scene=frame.scene_token, sample=sample_token)
        centre, size, rotation = original.centre.copy(), original.size_lwh.copy(), original.rotation.copy()
        centre[rows], size[rows], rotation[rows] = boxes.centre, boxes.size_lwh, boxes.rotation
        point_counts, sweep = original.lidar_points.copy(), self.key_sweep(sample_token)
        if sweep is not None and lidar is not None:
            point_counts[rows] = _count_points(self.points(sweep)[0] if lidar else self.cloud(sweep), sweep, boxes)
        return replace(original, centre=centre, size_lwh=size, rotation=rotation, lidar_points=point_counts)


def _has_lens(frame: SensorFrame) -> bool:
    return frame.intrinsic is not None and min(frame.intrinsic[0, 0], frame.intrinsic[1, 1]) > 0


def _count_points(cloud: F32, sweep: SensorFrame, boxes: TrackedBoxes) -> npt.NDArray[np.int32]:
    """Count the points in each box."""
    from ssad.scenarios.static.shifts.lidar import is_inside_box
    from ssad.scenarios.static.shifts.objects import box_maps

    pose = sweep.ego_to_world @ sweep.sensor_to_ego
    world_points = np.asarray(cloud[:, :3] @ pose[:3, :3].T + pose[:3, 3])
    matrix, centre = box_maps(boxes)
    counts = [
        int(is_inside_box(world_points, matrix[box_index], centre[box_index]).sum()) for box_index in range(len(boxes))
    ]
    return np.array(counts, np.int32)

"""Built-in perceivers: a detector on camera images, and a perfect detector that knows the truth.

Both report `Detections` in the frame of a camera, so the rest of the pipeline is the same; any difference in driving
is caused by the detector.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch

from ssad.core.boxes import UNIT_CORNERS, camera_axes, camera_yaw
from ssad.core.detections import Detections, Solids
from ssad.core.driving import Belief, Observation
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.nuscenes_names import CAMERAS, MMDET3D_ATTRIBUTES, MMDET3D_CLASSES
from ssad.core.perception import I64
from ssad.core.protocols import Detector
from ssad.core.rotations import Floats, upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F64, AgentKind, Episode
from ssad.core.visibility import is_visible
from ssad.detectors import make_detector
from ssad.drivers.perceiving.objects import SIZES
from ssad.drivers.perceiving.tracker import tracking_settings
from ssad.rendering.camera.rig import rig_camera

FRONT = ("CAM_FRONT",)
# class that a perfect detector reports for each kind
NAMES: Mapping[int, str] = {
    AgentKind.CAR: "car",
    AgentKind.TRUCK: "truck",
    AgentKind.BUS: "bus",
    AgentKind.MOTORCYCLE: "motorcycle",
    AgentKind.BICYCLE: "bicycle",
    AgentKind.WALKER: "pedestrian",
    AgentKind.PROP: "barrier",
}
MEMORY = 100  # approximate bytes of GPU memory that a detector needs per image value
_SLOTS = 64  # more than the agents of any scene: with fixed draws per look none depends on the number of agents


def nuscenes_cameras(width: int = 640, channels: Sequence[str] = FRONT) -> dict[str, Camera]:
    """Return cameras of the nuScenes rig with images of a width in pixels, by channel."""
    return {channel: rig_camera(channel, width) for channel in channels}


def camera_perceiver(
    detector: str = "fcos3d-light",
    *,
    cameras: Sequence[str] = FRONT,
    width: int = 640,
    weights: str | None = None,
    threshold: float | None = None,
    input_width: int | None = None,
) -> CameraPerceiver:
    """Return the built-in perceiver of camera images.

    Args:
        detector: Name of the detector.
        cameras: Channels of the nuScenes rig.
        width: Width of their images, pixels.
        weights: File of weights; None: the shipped ones.
        threshold: Minimum score of detections; None: the one that suits the detector.
        input_width: Width to which a 3D detector resizes images, pixels; None: its own.

    Raises:
        UnknownNameError: There is no such detector.
        ConfigError: There is no such camera.
    """
    options: dict[str, Any] = {"weights": weights} | ({} if input_width is None else {"input_width": input_width})
    min_score = tracking_settings(detector).low if threshold is None else threshold
    perceiver = CameraPerceiver(detector, _rig_cameras(cameras, width), threshold=min_score, **options)
    _ = perceiver.detector  # so that a wrong name fails here
    return perceiver


def perfect_perceiver(
    *,
    cameras: Sequence[str] = FRONT,
    width: int = 640,
    reach: float = 60.0,
    missed: float = 0.0,
    burst: float = 3.0,
    noise: float = 0.0,
    phantoms: float = 0.0,
) -> PerfectPerceiver:
    """Return the built-in perceiver that knows the truth; arguments as of `camera_perceiver` and `PerfectPerceiver`."""
    return PerfectPerceiver(
        _rig_cameras(cameras, width), reach=reach, missed=missed, burst=burst, noise=noise, phantoms=phantoms
    )


def _rig_cameras(channels: Sequence[str], width: int) -> dict[str, Camera]:
    unknown = [channel for channel in channels if channel not in CAMERAS]
    if unknown or not channels or isinstance(channels, str) or not 64 <= width <= 1600:
        raise ConfigError(
            f"cameras must be a list of some of {', '.join(CAMERAS)}, and width 64 to 1600 pixels, not {channels} and "
            f"{width}"
        )
    return nuscenes_cameras(width, channels)


class CameraPerceiver:
    """Detector on camera images. An image that is 0 everywhere counts as a detected loss of signal.

    Args:
        detector: The detector, or the name of one, which is made on first use.
        cameras: Cameras by name; None: the front camera of nuScenes, 640 pixels wide.
        threshold: Minimum score of reported detections.
        device: Device of a named detector; a detector object stays on its own.
        options: Options of the builder of a named detector.
    """

    def __init__(
        self,
        detector: Detector | str,
        cameras: Mapping[str, Camera] | None = None,
        *,
        threshold: float = 0.1,
        device: str = "cpu",
        **options: Any,
    ) -> None:
        self.cameras: Mapping[str, Camera] = nuscenes_cameras() if cameras is None else dict(cameras)
        self.sensors: tuple[str, ...] = tuple(self.cameras)
        self.threshold, self.device = threshold, device
        self._detector_or_name, self._options = detector, options
        self._loaded_detector: Detector | None = None

    @property
    def detector(self) -> Detector:
        """The detector, on its device."""
        if self._loaded_detector is None:
            if isinstance(self._detector_or_name, str):
                loaded: Detector = make_detector(self._detector_or_name, device=self.device, **self._options)
                self._loaded_detector = loaded
            else:
                self._loaded_detector = self._detector_or_name
        return self._loaded_detector

    @property
    def name(self) -> str:
        """Name of the detector."""
        return self._detector_or_name if isinstance(self._detector_or_name, str) else self._detector_or_name.name

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the detector's labels."""
        return tuple(self.detector.classes)

    def to(self, device: str) -> None:
        """Remake a named detector on another device."""
        if device != self.device and isinstance(self._detector_or_name, str):
            self.device, self._loaded_detector = device, None

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Do nothing: the detector is stateless."""

    def snapshot(self) -> None:
        """Return None: the detector is stateless."""

    def restore(self, snapshot: Any) -> None:
        """Do nothing: the detector is stateless."""

    def perceive(self, view: Observation, rows: I64) -> dict[str, list[Detections | None]]:
        """Detect objects; on a GPU all cameras of one size form one batch, on a CPU each camera its own."""
        detections: dict[str, list[Detections | None]] = {}
        batches: dict[Any, list[tuple[str, I64, torch.Tensor]]] = {}
        for name in self.cameras:
            images = self._images(view, rows, name)
            detections[name] = [None] * len(rows)
            valid_rows = np.flatnonzero(images.flatten(1).any(1).cpu().numpy())
            if len(valid_rows):
                valid_images = images if len(valid_rows) == len(rows) else images[_row_indices(valid_rows, images)]
                batches.setdefault(images.shape[1:] if images.is_cuda else name, []).append(
                    (name, valid_rows, valid_images)
                )
        for batch in batches.values():
            intrinsics = np.array(
                [self.cameras[name].intrinsic for name, valid_rows, _ in batch for _ in valid_rows], np.float32
            )
            stacked = batch[0][2] if len(batch) == 1 else torch.cat([entry for *_, entry in batch])
            targets = [(name, index) for name, valid_rows, _ in batch for index in valid_rows.tolist()]
            for (name, index), entry in zip(targets, self.detect(stacked, intrinsics), strict=True):
                detections[name][index] = entry
        return detections

    def _images(self, view: Observation, rows: I64, name: str) -> torch.Tensor:
        """Return images uint8 [n, 3, H, W] of a camera on the detector's device, from arrays or tensors."""
        reading, camera = view.readings[name], self.cameras[name]
        if reading.shape[1:] != (3, camera.height, camera.width):
            raise ConfigError(
                f"sensor '{name}' shows pictures of shape {tuple(reading.shape[1:])}; expected "
                f"(3, {camera.height}, {camera.width})"
            )
        if not isinstance(reading, torch.Tensor):
            reading = np.asarray(reading)
            reading = torch.from_numpy(reading if reading.flags.writeable else reading.copy())
        if len(rows) < len(reading):
            reading = reading[_row_indices(rows, reading)]
        return reading.to(self.device).contiguous()

    def detect(self, images: torch.Tensor, lens_intrinsics: Floats) -> list[Detections]:
        """Return the detections, on the host, in images uint8 [n, 3, H, W] with intrinsics [n, 3, 3]."""
        intrinsics = torch.from_numpy(lens_intrinsics).to(self.device) if self.detector.task == "3d" else None
        batch_size, detections = _batch_capacity(images), []
        for start in range(0, len(images), batch_size):
            batch_intrinsics = None if intrinsics is None else intrinsics[start : start + batch_size]
            detections += self.detector.predict(
                images[start : start + batch_size].float() / 255.0, batch_intrinsics, threshold=self.threshold
            )
        return Detections.cpu(detections) if images.is_cuda else detections


def _batch_capacity(images: torch.Tensor) -> int:
    """Return the batch size of the detector: on a GPU, as many images as fit into a quarter of the free memory."""
    if not images.is_cuda:
        return max(len(images), 1)
    device = images.device
    free_bytes = (
        torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    )
    return max(free_bytes // 4 // (MEMORY * images[0].numel()), 16)


def _row_indices(rows: I64, reference: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(rows).to(reference.device)


class PerfectPerceiver:
    """Perfect detector that knows the truth: it finds every visible object at its true position.

    An object is found if its centre is in front of a camera, a part of its outline is in the image, and it is not
    hidden (see `ssad.core.visibility.is_visible`). `missed`, `noise` and `phantoms` add the failures of real detectors.

    Args:
        cameras: Cameras by name; None: the front camera of nuScenes.
        reach: Range, m.
        missed: Share of the looks in which an object is missed.
        burst: Mean number of consecutive looks that an object stays missed, as in `DegradedBelief`.
        noise: Standard deviation of the distance of an object as a share of it.
        phantoms: Mean number of phantom cars per look; anywhere in the image, 5 to 40 m away.

    Raises:
        ConfigError: A value is out of its range.
    """

    classes = MMDET3D_CLASSES

    def __init__(  # plain values
        self,
        cameras: Mapping[str, Camera] | None = None,
        *,
        reach: float = 60.0,
        missed: float = 0.0,
        burst: float = 3.0,
        noise: float = 0.0,
        phantoms: float = 0.0,
    ) -> None:
        if not 0.0 <= missed < 1.0 or burst < 1.0 or min(noise, phantoms) < 0.0:
            raise ConfigError(
                "perfect eyes need missed in [0, 1), burst >= 1, noise >= 0 and phantoms >= 0, "
                f"not {missed}, {burst}, {noise} and {phantoms}"
            )
        self.cameras: Mapping[str, Camera] = nuscenes_cameras() if cameras is None else dict(cameras)
        self.sensors: tuple[str, ...] = ("truth",)
        self.reach, self.missed, self.noise, self.phantoms = reach, missed, noise, phantoms
        self.again = 1.0 / max(burst, missed / (1.0 - missed))
        self.lost = missed * self.again / (1.0 - missed)
        self._draws: list[np.random.Generator] = []
        self._missing = np.zeros((0, _SLOTS), bool)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Restart the random draws for these episodes."""
        self._draws = [generator("eyes", episode.key, episode.seed) for episode in episodes]
        self._missing = np.array([draws.random(_SLOTS) < self.missed for draws in self._draws]).reshape(-1, _SLOTS)

    def perceive(self, view: Observation, rows: I64) -> dict[str, list[Detections | None]]:
        """Return the visible objects as detections, with the configured errors."""
        truth: Belief = view.readings["truth"]
        truth = truth.rows(rows)
        visible = is_visible(view.pose[rows, :2], truth, self.reach)
        distance_factors = np.ones(visible.shape)
        for index, scene in enumerate(view.scene[rows].tolist()):
            draws, count = self._draws[scene], visible.shape[1]
            uniform = draws.random(_SLOTS)
            missing = self._missing[scene]
            self._missing[scene] = missing = np.where(missing, uniform >= self.again, uniform < self.lost)
            visible[index] &= ~missing[:count]
            distance_factors[index] += self.noise * draws.normal(size=_SLOTS)[:count]
        detections: dict[str, list[Detections | None]] = {}
        for name, camera in self.cameras.items():
            detections[name] = []
            for index, row in enumerate(rows.tolist()):
                visible_boxes = object_boxes(truth, index, visible[index])
                pose = upright_pose(*view.pose[row].astype(np.float64).tolist()) @ camera.to_ego
                projected_objects = project_boxes(
                    visible_boxes,
                    np.asarray(np.linalg.inv(pose), np.float64),
                    camera,
                    distance_factors[index][visible[index]],
                )
                scene = int(view.scene[row])
                detections[name].append(
                    Detections.cat([projected_objects, self._draw_phantoms(self._draws[scene], camera)])
                )
        return detections

    def snapshot(self) -> Any:
        """Return copies of the random generators and the missed objects."""
        return deepcopy(self._draws), self._missing.copy()

    def restore(self, snapshot: Any) -> None:
        """Restore the random generators and the missed objects."""
        self._draws, self._missing = deepcopy(snapshot[0]), snapshot[1].copy()

    def _draw_phantoms(self, draws: np.random.Generator, camera: Camera) -> Detections:
        """Return phantom cars."""
        count = int(draws.poisson(self.phantoms)) if self.phantoms else 0
        column, depth = draws.uniform(0, camera.width, count), draws.uniform(5.0, 40.0, count)
        x = (column - camera.intrinsic[0, 2]) / camera.intrinsic[0, 0] * depth
        size = np.tile(SIZES[AgentKind.CAR], (count, 1))
        # Phantoms stand on the ground: camera height minus half of their own.
        y = camera.to_ego[2, 3] - 0.5 * size[:, 2]
        yaw = draws.uniform(-np.pi, np.pi, count)
        return _detections(np.stack([x, y, depth], 1), size, yaw, [AgentKind.CAR] * count, np.zeros((count, 2)), camera)


def object_boxes(truth: Belief, scene: int, mask: Any) -> tuple[F64, F64, F64, list[int], F64]:
    """Return objects of a scene as upright boxes in the world, with the default heights of their kinds.

    Args:
        truth: The objects of all scenes.
        scene: Index of the scene.
        mask: [K] selects its objects.

    Returns:
        Centre [N, 3], size [N, 3] (length, width, height), yaw [N], kind, velocity [N, 2].
    """
    pose, speed = truth.pose[scene][mask].astype(np.float64), truth.speed[scene][mask].astype(np.float64)
    kind = truth.kind[scene][mask].tolist()
    height = SIZES[kind, 2] if kind else np.zeros(0)
    size = np.column_stack([truth.size[scene][mask].astype(np.float64), height]).reshape(-1, 3)
    centre = np.column_stack([pose[:, :2], 0.5 * height]).reshape(-1, 3)
    velocity = speed[:, None] * np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], 1)
    return centre, size, pose[:, 2], kind, velocity


def project_boxes(
    boxes: tuple[F64, F64, F64, list[int], F64], to_camera: F64, camera: Camera, shift: Floats | None = None
) -> Detections:
    """Return the detections of upright boxes in the world by a perfect detector.

    Args:
        boxes: As `object_boxes` gives them.
        to_camera: From the world to the camera, [4, 4].
        camera: The camera.
        shift: Factors [N] on the distances.
    """
    centre, size, yaw, kind, velocity = boxes
    local = centre @ to_camera[:3, :3].T + to_camera[:3, 3]
    if shift is not None:
        local = local * shift[:, None]
    direction = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))]) @ to_camera[:3, :3].T
    camera_velocity = np.column_stack([velocity, np.zeros(len(yaw))]) @ to_camera[:3, :3].T
    return _detections(local, size, camera_yaw(direction), kind, camera_velocity[:, [0, 2]], camera)


def _detections(  # noqa: PLR0917  # columns
    centre: F64, size: F64, yaw: F64, kind: Sequence[int], velocity: F64, camera: Camera
) -> Detections:
    """Return boxes in a camera's frame (length, width, height) as detections; boxes out of the image are dropped."""
    corners = np.einsum("nij,nkj->nki", camera_axes(yaw), UNIT_CORNERS * size[:, None]) + centre[:, None]
    # Corners behind the camera would be mirrored by the division.
    depth = np.maximum(corners[..., 2:], 0.1)
    points = (corners / depth) @ camera.intrinsic.T
    minimum, maximum = points[..., :2].min(1), points[..., :2].max(1)
    image_size = np.array([camera.width, camera.height], float)
    box = np.concatenate([np.clip(minimum, 0.0, image_size), np.clip(maximum, 0.0, image_size)], 1)
    rows = np.flatnonzero((centre[:, 2] > 0.5) & (box[:, 2] - box[:, 0] >= 1.0) & (box[:, 3] - box[:, 1] >= 1.0))
    label = [MMDET3D_CLASSES.index(NAMES[kind[row]]) for row in rows.tolist()]
    size_lhw = size[rows][:, [0, 2, 1]]
    attribute = torch.full((len(rows),), MMDET3D_ATTRIBUTES.index("none"))
    columns = [torch.from_numpy(np.ascontiguousarray(column[rows])) for column in (centre, yaw, velocity, box)]
    solid = Solids(columns[0], torch.from_numpy(size_lhw), columns[1], columns[2], attribute)
    return Detections(
        torch.ones(len(rows), dtype=torch.float64), torch.tensor(label, dtype=torch.int64), columns[3], solid
    )

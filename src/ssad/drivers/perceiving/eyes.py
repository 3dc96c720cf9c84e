"""What looks: a detector on the pictures of cameras, or a perfect one that is told the truth.

Both report `Detections` in the frame of a camera, so that all that follows is the same; where the two drive
differently, the difference is the detector's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any, Protocol

import numpy as np
import torch

from ssad.core.boxes import UNIT_CORNERS, camera_axes, camera_yaw
from ssad.core.detections import Detections, Solids
from ssad.core.driving import Belief, Observation
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.nuscenes_names import MMDET3D_ATTRIBUTES, MMDET3D_CLASSES
from ssad.core.protocols import Detector
from ssad.core.registry import resolve
from ssad.core.rotations import Floats, upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F64, AgentKind, Episode
from ssad.drivers.belief import in_sight
from ssad.drivers.perceiving.objects import I64, SIZES
from ssad.rendering.camera.rig import rig_camera

FRONT = ("CAM_FRONT",)
# what a perfect detector calls each kind
NAMES: Mapping[int, str] = {
    AgentKind.CAR: "car",
    AgentKind.TRUCK: "truck",
    AgentKind.BUS: "bus",
    AgentKind.MOTORCYCLE: "motorcycle",
    AgentKind.BICYCLE: "bicycle",
    AgentKind.WALKER: "pedestrian",
    AgentKind.PROP: "barrier",
}
MEMORY = 100  # bytes that a detector needs on a GPU for each value of a picture, about
_SLOTS = 64  # a scene has fewer agents: draws for all, so that none depends on how many there are


class Eyes(Protocol):
    """What looks.

    Attributes:
        sensors: Names of the sensors that it reads.
        cameras: The cameras that it looks through, by the names of their sensors.
    """

    sensors: tuple[str, ...]
    cameras: Mapping[str, Camera]

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the labels of its detections."""

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget the past.

        Args:
            episodes: The B episodes that are driven next.
        """

    def snapshot(self) -> Any:
        """All that changes from look to look."""

    def restore(self, snapshot: Any) -> None:
        """Go on from an earlier moment.

        Args:
            snapshot: What `snapshot` returned.
        """

    def look(self, view: Observation, rows: I64) -> dict[str, list[Detections | None]]:
        """Look through all cameras.

        Args:
            view: What the egos see.
            rows: [n] which of its rows are wanted.

        Returns:
            For each camera what was found in each row, [n]; None where there was no picture.
        """


def front(width: int = 640, channels: Sequence[str] = FRONT) -> dict[str, Camera]:
    """Cameras of the nuScenes rig with pictures so many pixels wide, by channel."""
    return {channel: rig_camera(channel, width) for channel in channels}


class CameraEyes:
    """A detector on pictures. A picture that is 0 everywhere is none: the signal is lost, and that is noticed.

    Args:
        detector: The detector, or the name of one, which is made when it is first needed.
        cameras: Cameras by name; None: the front camera of nuScenes, 640 pixels wide.
        threshold: Least score of what it reports.
        device: Where the detector computes; one that is not a name is there already.
        options: What the builder of a named detector takes.
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
        self.cameras: Mapping[str, Camera] = front() if cameras is None else dict(cameras)
        self.sensors: tuple[str, ...] = tuple(self.cameras)
        self.threshold, self.device = threshold, device
        self._given, self._options = detector, options
        self._made: Detector | None = None

    @property
    def detector(self) -> Detector:
        """The detector, on its device."""
        if self._made is None:
            if isinstance(self._given, str):
                # by name: drivers do not import detectors
                make: Callable[..., Detector] = resolve(
                    "function", {"make_detector": "ssad.detectors:make_detector"}, "make_detector"
                )
                self._made = make(self._given, device=self.device, **self._options)
            else:
                self._made = self._given
        return self._made

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the detector's labels."""
        return tuple(self.detector.classes)

    def to(self, device: str) -> None:
        """Make a named detector on another device."""
        if device != self.device and isinstance(self._given, str):
            self.device, self._made = device, None

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Nothing to forget."""

    def snapshot(self) -> None:
        """Nothing changes."""

    def restore(self, snapshot: Any) -> None:
        """Nothing changes."""

    def look(self, view: Observation, rows: I64) -> dict[str, list[Detections | None]]:
        """See `Eyes`; on a GPU the pictures of all cameras of one size are one batch, on a CPU those of a camera."""
        found: dict[str, list[Detections | None]] = {}
        batches: dict[Any, list[tuple[str, I64, torch.Tensor]]] = {}
        for name in self.cameras:
            pictures = self._pictures(view, rows, name)
            found[name] = [None] * len(rows)
            seen = np.flatnonzero(pictures.flatten(1).any(1).cpu().numpy())
            if len(seen):
                shown = pictures if len(seen) == len(rows) else pictures[_at(seen, pictures)]
                batches.setdefault(pictures.shape[1:] if pictures.is_cuda else name, []).append((name, seen, shown))
        for batch in batches.values():
            lens = np.array([self.cameras[name].intrinsic for name, seen, _ in batch for _ in seen], np.float32)
            together = batch[0][2] if len(batch) == 1 else torch.cat([one for *_, one in batch])
            places = [(name, k) for name, seen, _ in batch for k in seen.tolist()]
            for (name, k), one in zip(places, self.detect(together, lens), strict=True):
                found[name][k] = one
        return found

    def _pictures(self, view: Observation, rows: I64, name: str) -> torch.Tensor:
        """Pictures uint8 [n, 3, H, W] of a camera on the detector's device, from arrays or tensors."""
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
            reading = reading[_at(rows, reading)]
        return reading.to(self.device).contiguous()

    def detect(self, pictures: torch.Tensor, lens: Floats) -> list[Detections]:
        """What is in pictures uint8 [n, 3, H, W] with intrinsics [n, 3, 3]; all of it on the host."""
        needed = torch.from_numpy(lens).to(self.device) if self.detector.task == "3d" else None
        room, found = _room(pictures), []
        for k in range(0, len(pictures), room):
            part = None if needed is None else needed[k : k + room]
            found += self.detector.predict(pictures[k : k + room].float() / 255.0, part, threshold=self.threshold)
        return on_host(found) if pictures.is_cuda else found


def _room(pictures: torch.Tensor) -> int:
    """Pictures that a detector is given at once: on a GPU as many as need a quarter of the memory that is left."""
    if not pictures.is_cuda:
        return max(len(pictures), 1)
    device = pictures.device
    left = torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return max(left // 4 // (MEMORY * pictures[0].numel()), 16)


def _at(rows: I64, like: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(rows).to(like.device)


def on_host(found: list[Detections]) -> list[Detections]:
    """Detections of images [at least one] on the host, brought there in one go and not image by image."""
    counts = [len(one.score) for one in found]

    def brought(values: Sequence[torch.Tensor]) -> Sequence[torch.Tensor]:
        return torch.split(torch.cat(list(values)).cpu(), counts)

    flat = [brought([getattr(one, name) for one in found]) for name in ("score", "label", "box")]
    solids = [one.solid for one in found if one.solid is not None]
    if len(solids) < len(found):
        return [Detections(*part) for part in zip(*flat, strict=True)]
    names = ("centre", "size_lhw", "yaw", "velocity", "attribute")
    deep = zip(*(brought([getattr(one, name) for one in solids]) for name in names), strict=True)
    parts = zip(*flat, deep, strict=True)
    return [Detections(score, label, box, Solids(*solid)) for score, label, box, solid in parts]


class PerfectEyes:
    """A detector that is told the truth: it finds all that can be seen, where it is.

    Found is what has its middle before a camera and a part of its outline in the picture, and is not hidden (see
    `ssad.drivers.belief.in_sight`). With `missed`, `noise` and `phantoms`, it fails as detectors do.

    Args:
        cameras: Cameras by name; None: the front camera of nuScenes.
        reach: m to which it sees.
        missed: Share of the looks in which an object is missed.
        burst: Looks in a row that an object stays missed on average, as in `DegradedBelief`.
        noise: Standard deviation of the distance of an object as a share of it.
        phantoms: Cars a look that are not there, on average; anywhere in the picture, 5 to 40 m away.

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
        self.cameras: Mapping[str, Camera] = front() if cameras is None else dict(cameras)
        self.sensors: tuple[str, ...] = ("truth",)
        self.reach, self.missed, self.noise, self.phantoms = reach, missed, noise, phantoms
        self.again = 1.0 / max(burst, missed / (1.0 - missed))
        self.lost = missed * self.again / (1.0 - missed)
        self._draws: list[np.random.Generator] = []
        self._missing = np.zeros((0, _SLOTS), bool)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """See `Eyes`; draws begin anew for these episodes."""
        self._draws = [generator("eyes", episode.key, episode.seed) for episode in episodes]
        self._missing = np.array([draws.random(_SLOTS) < self.missed for draws in self._draws]).reshape(-1, _SLOTS)

    def look(self, view: Observation, rows: I64) -> dict[str, list[Detections | None]]:
        """See `Eyes`."""
        truth: Belief = view.readings["truth"]
        truth = truth.rows(rows)
        seen = in_sight(view.pose[rows, :2], truth, self.reach)
        shift = np.ones(seen.shape)
        for k, scene in enumerate(view.scene[rows].tolist()):
            draws, count = self._draws[scene], seen.shape[1]
            chance = draws.random(_SLOTS)
            gone = self._missing[scene]
            self._missing[scene] = gone = np.where(gone, chance >= self.again, chance < self.lost)
            seen[k] &= ~gone[:count]
            shift[k] += self.noise * draws.normal(size=_SLOTS)[:count]
        found: dict[str, list[Detections | None]] = {}
        for name, camera in self.cameras.items():
            found[name] = []
            for k, row in enumerate(rows.tolist()):
                boxes = boxes_of(truth, k, seen[k])
                pose = upright_pose(*view.pose[row].astype(np.float64).tolist()) @ camera.to_ego
                one = projected(boxes, np.asarray(np.linalg.inv(pose), np.float64), camera, shift[k][seen[k]])
                scene = int(view.scene[row])
                found[name].append(_joined(one, self._invented(self._draws[scene], camera)))
        return found

    def snapshot(self) -> Any:
        """See `Eyes`."""
        return deepcopy(self._draws), self._missing.copy()

    def restore(self, snapshot: Any) -> None:
        """See `Eyes`."""
        self._draws, self._missing = deepcopy(snapshot[0]), snapshot[1].copy()

    def _invented(self, draws: np.random.Generator, camera: Camera) -> Detections:
        """Cars that are not there."""
        count = int(draws.poisson(self.phantoms)) if self.phantoms else 0
        column, depth = draws.uniform(0, camera.width, count), draws.uniform(5.0, 40.0, count)
        x = (column - camera.intrinsic[0, 2]) / camera.intrinsic[0, 0] * depth
        size = np.tile(SIZES[AgentKind.CAR], (count, 1))
        y = camera.to_ego[2, 3] - 0.5 * size[:, 2]
        turn = draws.uniform(-np.pi, np.pi, count)
        return _detections(
            np.stack([x, y, depth], 1), size, turn, [AgentKind.CAR] * count, np.zeros((count, 2)), camera
        )


def boxes_of(truth: Belief, scene: int, mask: Any) -> tuple[F64, F64, F64, list[int], F64]:
    """Objects of a scene as upright boxes in the world, with the heights that are usual for their kinds.

    Args:
        truth: The objects of all scenes.
        scene: Which scene.
        mask: [K] which of its objects.

    Returns:
        Middle [N, 3], size [N, 3] (length, width, height), yaw [N], kind, velocity [N, 2].
    """
    pose, speed = truth.pose[scene][mask].astype(np.float64), truth.speed[scene][mask].astype(np.float64)
    kind = truth.kind[scene][mask].tolist()
    height = SIZES[kind, 2] if kind else np.zeros(0)
    size = np.column_stack([truth.size[scene][mask].astype(np.float64), height]).reshape(-1, 3)
    centre = np.column_stack([pose[:, :2], 0.5 * height]).reshape(-1, 3)
    velocity = speed[:, None] * np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], 1)
    return centre, size, pose[:, 2], kind, velocity


def projected(
    boxes: tuple[F64, F64, F64, list[int], F64], to_camera: F64, camera: Camera, shift: Floats | None = None
) -> Detections:
    """What a perfect detector reports of upright boxes in the world.

    Args:
        boxes: As `boxes_of` gives them.
        to_camera: From the world to the camera, [4, 4].
        camera: The camera.
        shift: Factors [N] on the distances.
    """
    centre, size, yaw, kind, velocity = boxes
    local = centre @ to_camera[:3, :3].T + to_camera[:3, 3]
    if shift is not None:
        local = local * shift[:, None]
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))]) @ to_camera[:3, :3].T
    moving = np.column_stack([velocity, np.zeros(len(yaw))]) @ to_camera[:3, :3].T
    return _detections(local, size, camera_yaw(ahead), kind, moving[:, [0, 2]], camera)


def _detections(  # noqa: PLR0917  # columns
    centre: F64, size: F64, yaw: F64, kind: Sequence[int], velocity: F64, camera: Camera
) -> Detections:
    """Boxes in a camera's frame (sizes: length, width, height) as detections; those out of the picture are left out."""
    corners = np.einsum("nij,nkj->nki", camera_axes(yaw), UNIT_CORNERS * size[:, None]) + centre[:, None]
    front_ = np.maximum(corners[..., 2:], 0.1)
    points = (corners / front_) @ camera.intrinsic.T
    low, high = points[..., :2].min(1), points[..., :2].max(1)
    limit = np.array([camera.width, camera.height], float)
    box = np.concatenate([np.clip(low, 0.0, limit), np.clip(high, 0.0, limit)], 1)
    rows = np.flatnonzero((centre[:, 2] > 0.5) & (box[:, 2] - box[:, 0] >= 1.0) & (box[:, 3] - box[:, 1] >= 1.0))
    label = [MMDET3D_CLASSES.index(NAMES[kind[k]]) for k in rows.tolist()]
    turned = size[rows][:, [0, 2, 1]]
    attribute = torch.full((len(rows),), MMDET3D_ATTRIBUTES.index("none"))
    columns = [torch.from_numpy(np.ascontiguousarray(v[rows])) for v in (centre, yaw, velocity, box)]
    solid = Solids(columns[0], torch.from_numpy(turned), columns[1], columns[2], attribute)
    return Detections(
        torch.ones(len(rows), dtype=torch.float64), torch.tensor(label, dtype=torch.int64), columns[3], solid
    )


def _joined(one: Detections, other: Detections) -> Detections:
    a, b = one.solid, other.solid
    assert a is not None
    assert b is not None
    solid = Solids(
        torch.cat([a.centre, b.centre]),
        torch.cat([a.size_lhw, b.size_lhw]),
        torch.cat([a.yaw, b.yaw]),
        torch.cat([a.velocity, b.velocity]),
        torch.cat([a.attribute, b.attribute]),
    )
    score, label = torch.cat([one.score, other.score]), torch.cat([one.label, other.label])
    return Detections(score, label, torch.cat([one.box, other.box]), solid)

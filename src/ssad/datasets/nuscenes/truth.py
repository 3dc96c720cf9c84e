"""Ground truth of the detection task from the tables of a dataset, with bounded memory.

The tables are streamed and only what the chosen samples need is kept. Source: nuscenes-devkit 1.2.0,
eval/common/loaders.py (`load_gt`, `add_center_dist`), nuscenes.py (`box_velocity`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Final, TypeVar

import msgspec
import numpy as np

from ssad.core.boxes import size_columns
from ssad.core.errors import ConfigError, FormatError
from ssad.core.nuscenes_names import ATTRIBUTES, BICYCLE_RACK, CATEGORY_TO_CLASS, CLASSES, LIDAR, VISIBILITY
from ssad.core.types import F64, I32
from ssad.datasets.nuscenes.results import uncollected, with_ego
from ssad.datasets.nuscenes.scene import velocities
from ssad.datasets.nuscenes.schema import (
    Attribute,
    Category,
    Quaternion,
    Sample,
    Scene,
    Sensor,
    Vector,
)
from ssad.datasets.nuscenes.tables import stream, table_path
from ssad.metrics.detection_boxes import I8, I64, BikeRacks, BoxTable

_RACK_LABEL: Final = len(CLASSES)

T = TypeVar("T")


@dataclass(frozen=True)
class GroundTruth:
    """What a results file is compared with.

    Attributes:
        samples: Tokens [S].
        scene: Index of each sample's scene in `scenes` [S].
        scenes: Names of the scenes.
        ego: Global position of the ego at each sample [S, 3], m.
        boxes: All boxes, not filtered.
        points: LiDAR and radar points in each box [N].
        visibility: 1 to 4; 0 for unknown [N].
        racks: Bicycle racks.
    """

    samples: tuple[str, ...]
    scene: I32
    scenes: tuple[str, ...]
    ego: F64
    boxes: BoxTable
    points: I32
    visibility: I8
    racks: BikeRacks


# only what is needed of a table: the rest is passed over by the decoder
class _Calibrated(msgspec.Struct, gc=False):
    token: str
    sensor_token: str


class _Instance(msgspec.Struct, gc=False):
    token: str
    category_token: str


class _Data(msgspec.Struct, gc=False):
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    is_key_frame: bool


class _Pose(msgspec.Struct, gc=False):
    token: str
    translation: Vector


class _Annotation(msgspec.Struct, gc=False):
    token: str
    sample_token: str
    instance_token: str
    visibility_token: str | None
    attribute_tokens: tuple[str, ...]
    translation: Vector
    size: Vector
    rotation: Quaternion
    num_lidar_pts: int
    num_radar_pts: int
    prev: str
    next: str


def read_truth(
    root: str | Path, version: str, *, scenes: Collection[str] | None = None, samples: Collection[str] | None = None
) -> GroundTruth:
    """The ground truth of some scenes, of some samples, or of all.

    Samples and the boxes of each are in the order of their tables. Annotations outside the detection classes are left
    out.

    Args:
        root: The nuScenes root.
        version: Name of the version.
        scenes: Names of the scenes; None: all.
        samples: Tokens of the samples; None: all.

    Raises:
        FormatError: A table is broken, a reference leads nowhere, or an annotation has two attributes.
        ConfigError: No sample is chosen.
    """
    tables = _Tables(Path(root), version)
    names = {s.token: s.name for s in tables.rows("scene", Scene)}
    chosen = [
        s
        for s in tables.rows("sample", Sample)
        if (scenes is None or names.get(s.scene_token) in scenes) and (samples is None or s.token in samples)
    ]
    if not chosen:
        raise ConfigError(f"{tables.folder}: it has none of the chosen scenes; is this the version of the split?")
    index = {s.token: i for i, s in enumerate(chosen)}
    if samples is not None and len(index) != len(set(samples)):
        raise ConfigError(f"{tables.folder}: it lacks {len(set(samples)) - len(index)} of the chosen samples")
    used = tuple(dict.fromkeys(tables.find(names, s.scene_token, "scene") for s in chosen))
    place = {name: i for i, name in enumerate(used)}
    scene = np.array([place[names[s.scene_token]] for s in chosen], np.int32)
    ego = _ego(tables, index)
    with uncollected():
        boxes, points, visibility, racks = _annotations(tables, chosen, index)
    return GroundTruth(tuple(index), scene, used, ego, with_ego(boxes, ego), points, visibility, racks)


@dataclass(frozen=True)
class _Tables:
    """The tables of a version."""

    root: Path
    version: str

    @property
    def folder(self) -> Path:
        return self.root / self.version

    def rows(self, name: str, kind: type[T]) -> Iterator[T]:
        for block in stream(table_path(self.root, self.version, name), kind):
            yield from block

    def find(self, known: Mapping[str, str], token: str, name: str) -> str:
        """The entry of a token. FormatError."""
        if token not in known:
            raise FormatError(f"{table_path(self.root, self.version, name)}: it has no record '{token}' that is used")
        return known[token]


def _ego(tables: _Tables, index: Mapping[str, int]) -> F64:
    """Global position [S, 3] of the ego at each sample: the pose of its LiDAR key frame."""
    sensors = {s.token for s in tables.rows("sensor", Sensor) if s.channel == LIDAR}
    own = {c.token for c in tables.rows("calibrated_sensor", _Calibrated) if c.sensor_token in sensors}
    pose: list[str | None] = [None] * len(index)
    for data in tables.rows("sample_data", _Data):
        if data.is_key_frame and data.calibrated_sensor_token in own and data.sample_token in index:
            pose[index[data.sample_token]] = data.ego_pose_token
    if None in pose:
        token = list(index)[pose.index(None)]
        raise FormatError(f"{tables.folder}/sample_data.json: sample {token} has no key frame of {LIDAR}")
    wanted = set(pose)
    found = {p.token: p.translation for p in tables.rows("ego_pose", _Pose) if p.token in wanted}
    missing = next((token for token in pose if token not in found), None)
    if missing is not None:
        raise FormatError(f"{tables.folder}/ego_pose.json: it has no record '{missing}' that is used")
    return np.array([found[token] for token in pose if token is not None], np.float64)


def _annotations(
    tables: _Tables, chosen: Sequence[Sample], index: Mapping[str, int]
) -> tuple[BoxTable, I32, I8, BikeRacks]:
    """Boxes, their points and visibility, and the bicycle racks of the samples."""
    category = {c.token: c.name for c in tables.rows("category", Category)}
    kinds = {name: CLASSES.index(kind) for name, kind in CATEGORY_TO_CLASS.items()} | {BICYCLE_RACK: _RACK_LABEL}
    label_of = {
        i.token: kinds.get(tables.find(category, i.category_token, "category"), -1)
        for i in tables.rows("instance", _Instance)
    }
    attributes = {
        a.token: ATTRIBUTES.index(a.name) for a in tables.rows("attribute", Attribute) if a.name in ATTRIBUTES
    }
    path = table_path(tables.root, tables.version, "sample_annotation")
    # the frames before and after may lie in samples that are not chosen
    scenes = {s.scene_token for s in chosen}
    time = {s.token: s.timestamp for s in tables.rows("sample", Sample) if s.scene_token in scenes}

    numbers: list[F64] = []
    whole: list[I64] = []
    tokens: list[str] = []
    before: list[str] = []
    after: list[str] = []
    for block in stream(path, _Annotation):
        kept = [a for a in block if a.sample_token in time and _label(path, a, label_of) >= 0]
        if not kept:
            continue
        numbers.append(np.array([(*a.translation, *a.size, *a.rotation) for a in kept], np.float64))
        ints = [
            (
                index.get(a.sample_token, -1),
                label_of[a.instance_token],
                _attribute(path, a, attributes),
                int(a.visibility_token or 0) if a.visibility_token in VISIBILITY else 0,
                a.num_lidar_pts + a.num_radar_pts,
                time[a.sample_token],
            )
            for a in kept
        ]
        whole.append(np.array(ints, np.int64))
        tokens += [a.token for a in kept]
        before += [a.prev for a in kept]
        after += [a.next for a in kept]
    values = np.concatenate(numbers) if numbers else np.zeros((0, 10))
    columns = np.concatenate(whole) if whole else np.zeros((0, 6), np.int64)
    velocity = _velocity(path, tokens, (before, after), values[:, :3], columns[:, 5])
    size = values[:, 3:6][:, size_columns("wlh", "lwh")]
    order = np.argsort(columns[:, 0], kind="stable")
    order = order[columns[order, 0] >= 0]
    real = order[columns[order, 1] < _RACK_LABEL]
    rack = order[columns[order, 1] == _RACK_LABEL]
    boxes = BoxTable(
        sample=columns[real, 0].astype(np.int32),
        label=columns[real, 1].astype(np.int8),
        centre=values[real, :3],
        size_lwh=size[real],
        rotation=values[real, 6:],
        velocity=velocity[real],
        attribute=columns[real, 2].astype(np.int8),
        score=np.full(len(real), -1.0),
        ego_distance=np.full(len(real), np.nan),
    )
    racks = BikeRacks(values[rack, :3], size[rack], values[rack, 6:], velocity[rack], columns[rack, 0].astype(np.int32))
    return boxes, columns[real, 4].astype(np.int32), columns[real, 3].astype(np.int8), racks


def _label(path: Path, a: _Annotation, label_of: Mapping[str, int]) -> int:
    """Class of an annotation, -1 for one that does not count."""
    label = label_of.get(a.instance_token)
    if label is None:
        raise FormatError(f"{path}: annotation {a.token}: instance.json has no record '{a.instance_token}'")
    return label


def _attribute(path: Path, a: _Annotation, known: Mapping[str, int]) -> int:
    """Index of an annotation's attribute, -1 for none."""
    if not a.attribute_tokens:
        return -1
    if len(a.attribute_tokens) > 1:
        raise FormatError(f"{path}: annotation {a.token} has more than one attribute")
    found = known.get(a.attribute_tokens[0], -1)
    if found < 0:
        raise FormatError(f"{path}: annotation {a.token}: unknown attribute '{a.attribute_tokens[0]}'")
    return found


def _velocity(
    path: Path, tokens: Sequence[str], links: tuple[Sequence[str], Sequence[str]], centre: F64, time: I64
) -> F64:
    """Velocity [N, 2] from the frames before and after; NaN for a single frame or frames too far apart in time."""
    row = dict(zip(tokens, range(len(tokens)), strict=True))
    row[""] = -1
    ends = []
    for side, link in zip(("prev", "next"), links, strict=True):
        end = np.fromiter(map(row.get, link, repeat(-2)), np.int64, len(tokens))
        if (end == -2).any():
            bad = int((end == -2).argmax())
            raise FormatError(f"{path}: annotation {tokens[bad]}: its {side} is not in its scene")
        ends.append(end.astype(np.int32))
    return velocities(centre, time, *ends)[:, :2]

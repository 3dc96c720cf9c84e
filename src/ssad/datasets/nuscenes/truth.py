"""Ground truth of the detection task from the tables of a dataset, with bounded memory.

The tables are streamed, and only rows of the selected samples are kept. Source: nuscenes-devkit 1.2.0,
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
from ssad.datasets.nuscenes.results import add_ego_distance, pause_garbage_collection
from ssad.datasets.nuscenes.scene import velocities
from ssad.datasets.nuscenes.schema import (
    Attribute,
    Category,
    Count,
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
    """Ground truth that a results file is compared with.

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


# only the needed fields of a table: the decoder skips all others
class _CalibratedSensorRow(msgspec.Struct, gc=False):
    token: str
    sensor_token: str


class _InstanceRow(msgspec.Struct, gc=False):
    token: str
    category_token: str


class _SampleDataRow(msgspec.Struct, gc=False):
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    is_key_frame: bool


class _EgoPoseRow(msgspec.Struct, gc=False):
    token: str
    translation: Vector


class _AnnotationRow(msgspec.Struct, gc=False):
    token: str
    sample_token: str
    instance_token: str
    visibility_token: str | None
    attribute_tokens: tuple[str, ...]
    translation: Vector
    size: Vector
    rotation: Quaternion
    num_lidar_pts: Count
    num_radar_pts: Count
    prev: str
    next: str


def read_truth(
    root: str | Path, version: str, *, scenes: Collection[str] | None = None, samples: Collection[str] | None = None
) -> GroundTruth:
    """Read the ground truth of some scenes, of some samples, or of all.

    Samples and the boxes of each are in the order of their tables. Annotations outside the detection classes
    are left out.

    Args:
        root: The nuScenes root.
        version: Name of the version.
        scenes: Names of the scenes; None: all.
        samples: Tokens of the samples; None: all.

    Raises:
        FormatError: A table is broken, a reference is dangling, or an annotation has two attributes.
        ConfigError: No sample is selected.
    """
    tables = _Tables(Path(root), version)
    name_by_token = {sample.token: sample.name for sample in tables.rows("scene", Scene)}
    selected = [
        sample
        for sample in tables.rows("sample", Sample)
        if (scenes is None or name_by_token.get(sample.scene_token) in scenes)
        and (samples is None or sample.token in samples)
    ]
    if not selected:
        raise ConfigError(f"{tables.folder}: it has none of the chosen scenes; is this the version of the split?")
    sample_index = {sample.token: position for position, sample in enumerate(selected)}
    if samples is not None and len(sample_index) != len(set(samples)):
        raise ConfigError(f"{tables.folder}: it lacks {len(set(samples)) - len(sample_index)} of the chosen samples")
    scene_names = tuple(dict.fromkeys(tables.find(name_by_token, sample.scene_token, "scene") for sample in selected))
    scene_index = {scene_name: position for position, scene_name in enumerate(scene_names)}
    scene_of_sample = np.array([scene_index[name_by_token[sample.scene_token]] for sample in selected], np.int32)
    ego = _ego(tables, sample_index)
    with pause_garbage_collection():
        boxes, points, visibility, racks = _annotations(tables, selected, sample_index)
    return GroundTruth(
        tuple(sample_index), scene_of_sample, scene_names, ego, add_ego_distance(boxes, ego), points, visibility, racks
    )


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

    def find(self, token_map: Mapping[str, str], token: str, name: str) -> str:
        """The entry of a token. FormatError."""
        if token not in token_map:
            raise FormatError(f"{table_path(self.root, self.version, name)}: it has no record '{token}' that is used")
        return token_map[token]


def _ego(tables: _Tables, index: Mapping[str, int]) -> F64:
    """Global position [S, 3] of the ego at each sample: the pose of its LiDAR key frame."""
    sensors = {sensor.token for sensor in tables.rows("sensor", Sensor) if sensor.channel == LIDAR}
    lidar_calibrations = {
        calibration.token
        for calibration in tables.rows("calibrated_sensor", _CalibratedSensorRow)
        if calibration.sensor_token in sensors
    }
    pose_tokens: list[str | None] = [None] * len(index)
    for record in tables.rows("sample_data", _SampleDataRow):
        if (
            record.is_key_frame
            and record.calibrated_sensor_token in lidar_calibrations
            and record.sample_token in index
        ):
            pose_tokens[index[record.sample_token]] = record.ego_pose_token
    if None in pose_tokens:
        token = list(index)[pose_tokens.index(None)]
        raise FormatError(f"{tables.folder}/sample_data.json: sample {token} has no key frame of {LIDAR}")
    used_poses = set(pose_tokens)
    positions = {
        ego_pose.token: ego_pose.translation
        for ego_pose in tables.rows("ego_pose", _EgoPoseRow)
        if ego_pose.token in used_poses
    }
    missing = next((token for token in pose_tokens if token not in positions), None)
    if missing is not None:
        raise FormatError(f"{tables.folder}/ego_pose.json: it has no record '{missing}' that is used")
    return np.array([positions[token] for token in pose_tokens if token is not None], np.float64)


def _annotations(
    tables: _Tables, selected_samples: Sequence[Sample], index: Mapping[str, int]
) -> tuple[BoxTable, I32, I8, BikeRacks]:
    """Boxes, their points and visibility, and the bicycle racks of the samples."""
    category_names = {
        category_record.token: category_record.name for category_record in tables.rows("category", Category)
    }
    label_by_category = {
        category_name: CLASSES.index(class_name) for category_name, class_name in CATEGORY_TO_CLASS.items()
    } | {BICYCLE_RACK: _RACK_LABEL}
    label_by_instance = {
        instance.token: label_by_category.get(tables.find(category_names, instance.category_token, "category"), -1)
        for instance in tables.rows("instance", _InstanceRow)
    }
    attributes = {
        annotation.token: ATTRIBUTES.index(annotation.name)
        for annotation in tables.rows("attribute", Attribute)
        if annotation.name in ATTRIBUTES
    }
    path = table_path(tables.root, tables.version, "sample_annotation")
    # neighbours, which velocities need, may lie in samples that are not selected
    scenes = {sample.scene_token for sample in selected_samples}
    timestamp_by_sample = {
        sample.token: sample.timestamp for sample in tables.rows("sample", Sample) if sample.scene_token in scenes
    }

    float_blocks: list[F64] = []
    integer_blocks: list[I64] = []
    tokens: list[str] = []
    previous_tokens: list[str] = []
    next_tokens: list[str] = []
    for block in stream(path, _AnnotationRow):
        relevant = [
            annotation
            for annotation in block
            if annotation.sample_token in timestamp_by_sample and _label(path, annotation, label_by_instance) >= 0
        ]
        if not relevant:
            continue
        float_blocks.append(
            np.array(
                [(*annotation.translation, *annotation.size, *annotation.rotation) for annotation in relevant],
                np.float64,
            )
        )
        integer_rows = [
            (
                index.get(annotation.sample_token, -1),
                label_by_instance[annotation.instance_token],
                _attribute(path, annotation, attributes),
                int(annotation.visibility_token or 0) if annotation.visibility_token in VISIBILITY else 0,
                annotation.num_lidar_pts + annotation.num_radar_pts,
                timestamp_by_sample[annotation.sample_token],
            )
            for annotation in relevant
        ]
        integer_blocks.append(np.array(integer_rows, np.int64))
        tokens += [annotation.token for annotation in relevant]
        previous_tokens += [annotation.prev for annotation in relevant]
        next_tokens += [annotation.next for annotation in relevant]
    values = np.concatenate(float_blocks) if float_blocks else np.zeros((0, 10))
    columns = np.concatenate(integer_blocks) if integer_blocks else np.zeros((0, 6), np.int64)
    velocity = _velocity(path, tokens, (previous_tokens, next_tokens), values[:, :3], columns[:, 5])
    size = values[:, 3:6][:, size_columns("wlh", "lwh")]
    # Stable, so that the boxes of a sample stay in table order.
    order = np.argsort(columns[:, 0], kind="stable")
    order = order[columns[order, 0] >= 0]
    box_rows = order[columns[order, 1] < _RACK_LABEL]
    rack_rows = order[columns[order, 1] == _RACK_LABEL]
    boxes = BoxTable(
        sample=columns[box_rows, 0].astype(np.int32),
        label=columns[box_rows, 1].astype(np.int8),
        centre=values[box_rows, :3],
        size_lwh=size[box_rows],
        rotation=values[box_rows, 6:],
        velocity=velocity[box_rows],
        attribute=columns[box_rows, 2].astype(np.int8),
        score=np.full(len(box_rows), -1.0),
        ego_distance=np.full(len(box_rows), np.nan),
    )
    racks = BikeRacks(
        values[rack_rows, :3],
        size[rack_rows],
        values[rack_rows, 6:],
        velocity[rack_rows],
        columns[rack_rows, 0].astype(np.int32),
    )
    return boxes, columns[box_rows, 4].astype(np.int32), columns[box_rows, 3].astype(np.int8), racks


def _label(path: Path, annotation: _AnnotationRow, label_of: Mapping[str, int]) -> int:
    """Class of an annotation, -1 for one that does not count."""
    label = label_of.get(annotation.instance_token)
    if label is None:
        raise FormatError(
            f"{path}: annotation {annotation.token}: instance.json has no record '{annotation.instance_token}'"
        )
    return label


def _attribute(path: Path, annotation: _AnnotationRow, attribute_index: Mapping[str, int]) -> int:
    """Index of an annotation's attribute, -1 for none."""
    if not annotation.attribute_tokens:
        return -1
    if len(annotation.attribute_tokens) > 1:
        raise FormatError(f"{path}: annotation {annotation.token} has more than one attribute")
    attribute = attribute_index.get(annotation.attribute_tokens[0], -1)
    if attribute < 0:
        raise FormatError(
            f"{path}: annotation {annotation.token}: unknown attribute '{annotation.attribute_tokens[0]}'"
        )
    return attribute


def _velocity(
    path: Path, tokens: Sequence[str], links: tuple[Sequence[str], Sequence[str]], centre: F64, time: I64
) -> F64:
    """Return velocities [N, 2] from the previous and next annotations; NaN for one alone or too far apart in time."""
    row_by_token = dict(zip(tokens, range(len(tokens)), strict=True))
    row_by_token[""] = -1
    neighbours = []
    for field_name, link_tokens in zip(("prev", "next"), links, strict=True):
        neighbour_rows = np.fromiter(map(row_by_token.get, link_tokens, repeat(-2)), np.int64, len(tokens))
        if (neighbour_rows == -2).any():
            first_missing = int((neighbour_rows == -2).argmax())
            raise FormatError(f"{path}: annotation {tokens[first_missing]}: its {field_name} is not in its scene")
        neighbours.append(neighbour_rows.astype(np.int32))
    return velocities(centre, time, *neighbours)[:, :2]

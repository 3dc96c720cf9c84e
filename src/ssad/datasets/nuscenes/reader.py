"""nuScenes scene by scene: frames of all sensors joined with calibration and pose, and boxes at any time.

Any version (v1.0-mini to v1.0-trainval) is opened through `ssad.datasets.nuscenes.index`; memory is that of one
scene. Scenes are objects of `ssad.datasets.nuscenes.scene`; `ssad.datasets.nuscenes.files` reads the files.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np

from ssad.core.boxes import size_columns
from ssad.core.errors import ConfigError, FormatError
from ssad.core.folders import is_file_name
from ssad.core.import_report import ImportReport
from ssad.core.rotations import pose_matrix
from ssad.core.types import F64, I32
from ssad.core.wording import counted
from ssad.datasets.nuscenes.index import Index, open_index
from ssad.datasets.nuscenes.scene import (
    Annotations,
    SceneData,
    SensorFrame,
    make_read_only,
    velocities,
)
from ssad.datasets.nuscenes.schema import (
    TABLES,
    Attribute,
    CalibratedSensor,
    Category,
    EgoPose,
    Instance,
    Log,
    Sample,
    SampleAnnotation,
    SampleData,
    Scene,
    Sensor,
    TableRecord,
)
from ssad.datasets.nuscenes.tables import nuscenes_path, table_path

R = TypeVar("R", bound=TableRecord)


UNREAD_FOLDERS = ("can_bus", "lidarseg", "maps", "panoptic")


class NuScenes:
    """A nuScenes root folder. It may be passed to other processes: each opens the index for itself.

    Args:
        root: Folder with samples/, sweeps/ and a folder for each version.
        version: Such as v1.0-mini; None for the only one.

    Raises:
        ConfigError: The version does not exist, or several exist and none is named.
        FormatError: The tables are broken.
        StoreError: A folder or a table leads out of the root (`ssad.core.folders.data_path`), or the index of a large
            version cannot be written.
    """

    def __init__(self, root: Path, version: str | None = None) -> None:
        self.root = Path(root)
        self.version = _choose_version(self.root, version)
        _check_links(self.root)
        self._index: Index = open_index(self.root, self.version)

    def __reduce__(self) -> tuple[Any, ...]:
        return (NuScenes, (self.root, self.version))

    def __enter__(self) -> NuScenes:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the index file; a later call opens it again."""
        self._index.close()

    def report(self) -> ImportReport:
        """Return a report on the folder: its scenes, and tables and folders that are not read."""
        report = ImportReport(str(self.root))
        report.contents.append(f"nuScenes schema {self.version}: {counted(len(self.scenes()), 'scene')}")
        for path in sorted((self.root / self.version).glob("*.json")):
            if path.stem not in TABLES:
                report.omit("tables that are not read", f"{self.version}/{path.name}")
        for path in sorted(self.root.iterdir()):
            if path.name in UNREAD_FOLDERS:
                report.omit("folders that are not read", path.name)
        return report

    def scenes(self) -> list[Scene]:
        """Return all scenes, in table order."""
        return list(self._scenes)

    def scene(self, name_or_token: str) -> SceneData:
        """Load a scene by name or token, with its frames and boxes.

        Raises:
            ConfigError: The scene does not exist.
            FormatError: The tables are broken.
        """
        for record in self._scenes:
            if name_or_token in (record.name, record.token):
                return self._load(record)
        suggestions = difflib.get_close_matches(name_or_token, [scene.name for scene in self._scenes], n=3, cutoff=0.0)
        hint = f"; closest: {', '.join(suggestions)}" if suggestions else "; it has no scene"
        raise ConfigError(f"{self.root / self.version}: no scene '{name_or_token}'{hint}")

    @cached_property
    def _scenes(self) -> list[Scene]:
        scenes = self._index.rows(Scene)
        for scene in scenes:
            self._check_file_name(Scene, scene.token, scene.name)
        return scenes

    def _check_file_name(self, kind: type[TableRecord], token: str, name: str) -> None:
        """Raise FormatError for a name that files are named after and that could lead out of their folder."""
        if not is_file_name(name):
            raise FormatError(f"{self._path(kind)}: '{token}': '{name[:80]}' cannot be part of a file's name")

    @cached_property
    def _sensors(self) -> dict[str, Sensor]:
        return {sensor.token: sensor for sensor in self._index.rows(Sensor)}

    @cached_property
    def _categories(self) -> dict[str, str]:
        return {category.token: category.name for category in self._index.rows(Category)}

    @cached_property
    def _attributes(self) -> dict[str, str]:
        return {attribute.token: attribute.name for attribute in self._index.rows(Attribute)}

    def _load(self, record: Scene) -> SceneData:
        samples = self._samples(record)
        tokens = [sample.token for sample in samples]
        log = self._index.get(Log, [record.log_token]).get(record.log_token)
        return SceneData(record, log, samples, self._frames(record, tokens), self._boxes(samples))

    def _path(self, kind: type[TableRecord]) -> Path:
        return table_path(
            self.root, self.version, next(name for name, record_type in TABLES.items() if record_type is kind)
        )

    def _require_rows(self, kind: type[R], tokens: Iterable[str], source: type[TableRecord]) -> dict[str, R]:
        """Return rows by token, all of them. FormatError names the table that refers to a missing row."""
        unique_tokens = list(dict.fromkeys(tokens))
        rows = self._index.get(kind, unique_tokens)
        for token in unique_tokens:
            if token not in rows:
                raise self._dangling_token_error(source, kind, token)
        return rows

    def _dangling_token_error(self, source: type[TableRecord], kind: type[TableRecord], token: str) -> FormatError:
        table = self._path(kind).name
        return FormatError(f"{self._path(source)}: it names token '{token}', which {table} does not have")

    def _samples(self, scene: Scene) -> tuple[Sample, ...]:
        """Samples along the chain from the scene's first. FormatError: it dangles, loops or leaves some out."""
        remaining = {sample.token: sample for sample in self._index.children(Sample, [scene.token])}
        ordered: list[Sample] = []
        token, source = scene.first_sample_token, "scene"
        while token:
            sample = remaining.pop(token, None)
            location = f"{self._path(Scene if source == 'scene' else Sample)}: scene '{scene.name}'"
            if sample is None and any(token == visited_sample.token for visited_sample in ordered):
                raise FormatError(f"{location}: the chain of samples comes back to '{token}'")
            if sample is None:
                raise FormatError(f"{location}: sample '{token}' is not among its samples in sample.json")
            if ordered and sample.timestamp <= ordered[-1].timestamp:
                raise FormatError(f"{location}: sample '{token}' is not later than the one before it in the chain")
            ordered.append(sample)
            token, source = sample.next, "sample"
        if remaining:
            location = f"{self._path(Sample)}: scene '{scene.name}'"
            raise FormatError(f"{location}: sample '{next(iter(remaining))}' is not in the chain of its samples")
        if not ordered:
            raise FormatError(f"{self._path(Scene)}: scene '{scene.name}' has no sample")
        return tuple(ordered)

    def _frames(self, scene: Scene, samples: Sequence[str]) -> tuple[SensorFrame, ...]:
        rows = self._index.children(SampleData, samples)
        if not rows:
            return ()
        calibrations = self._require_rows(CalibratedSensor, (row.calibrated_sensor_token for row in rows), SampleData)
        poses = self._require_rows(EgoPose, (row.ego_pose_token for row in rows), SampleData)
        sensor_poses = self._matrices(list(calibrations.values()))
        ego_poses = self._matrices(list(poses.values()))
        intrinsics = {token: self._intrinsic(record) for token, record in calibrations.items()}
        frames = []
        for row in rows:
            calibration = row.calibrated_sensor_token
            sensor = self._sensor(calibrations[calibration])
            self._check_file_name(SampleData, row.token, row.token)
            self._check_file_name(Sensor, sensor.token, sensor.channel)
            # A table may come from anywhere: a path must not lead out of the root.
            if (
                (relative_path := PurePosixPath(row.filename)).is_absolute()
                or ".." in relative_path.parts
                or not row.filename
            ):
                location = f"{self._path(SampleData)}: '{row.token}'"
                raise FormatError(f"{location}: '{row.filename}' is no path below the root")
            frames.append(
                SensorFrame(
                    token=row.token,
                    sample_token=row.sample_token,
                    scene_token=scene.token,
                    channel=sensor.channel,
                    modality=sensor.modality,
                    filename=row.filename,
                    timestamp_us=row.timestamp,
                    key_frame=row.is_key_frame,
                    width=row.width or 0,
                    height=row.height or 0,
                    intrinsic=intrinsics[calibration],
                    sensor_to_ego=sensor_poses[calibration],
                    ego_to_world=ego_poses[row.ego_pose_token],
                )
            )
        frames.sort(key=lambda frame: (frame.timestamp_us, frame.channel, frame.token))
        return tuple(frames)

    def _sensor(self, calibration: CalibratedSensor) -> Sensor:
        sensor = self._sensors.get(calibration.sensor_token)
        if sensor is None:
            raise self._dangling_token_error(CalibratedSensor, Sensor, calibration.sensor_token)
        return sensor

    def _intrinsic(self, calibration: CalibratedSensor) -> F64 | None:
        if self._sensor(calibration).modality != "camera":
            return None
        rows = calibration.camera_intrinsic
        if len(rows) != 3 or any(len(row) != 3 for row in rows):
            raise FormatError(f"{self._path(CalibratedSensor)}: '{calibration.token}': camera_intrinsic is not 3 x 3")
        return make_read_only(np.array(rows, np.float64))

    def _matrices(self, records: Sequence[CalibratedSensor] | Sequence[EgoPose]) -> dict[str, F64]:
        """Return poses [4, 4] by token."""
        quaternions = np.array([record.rotation for record in records], np.float64)
        zero_rows = np.flatnonzero(~(np.abs(quaternions).max(axis=1) > 0.0))
        if len(zero_rows):
            record = records[int(zero_rows[0])]
            raise FormatError(f"{self._path(type(record))}: '{record.token}': the rotation has length zero")
        matrices = make_read_only(pose_matrix([record.translation for record in records], quaternions))
        return {record.token: matrix for record, matrix in zip(records, matrices, strict=True)}

    def _boxes(self, samples: Sequence[Sample]) -> dict[str, Annotations]:
        """Return the boxes of each sample of a scene."""
        rows = self._index.children(SampleAnnotation, [sample.token for sample in samples])
        instances = self._require_rows(Instance, (row.instance_token for row in rows), SampleAnnotation)
        row_by_token = {row.token: row_index for row_index, row in enumerate(rows)}
        sample_times = {sample.token: sample.timestamp for sample in samples}
        timestamps = np.array([sample_times[row.sample_token] for row in rows], np.int64)
        # Velocities need the neighbours in other samples, so they are computed for the whole scene at once.
        centre = _columns([row.translation for row in rows], 3)
        velocity = velocities(centre, timestamps, *self._neighbours(rows, row_by_token, timestamps))
        rows_by_sample: dict[str, list[int]] = {sample.token: [] for sample in samples}
        for row_index, row in enumerate(rows):
            rows_by_sample[row.sample_token].append(row_index)
        boxes = {}
        for token, sample_rows in rows_by_sample.items():
            annotations_of_sample = [rows[row_index] for row_index in sample_rows]
            boxes[token] = Annotations(
                token=tuple(row.token for row in annotations_of_sample),
                instance=tuple(row.instance_token for row in annotations_of_sample),
                category=tuple(self._category(instances[row.instance_token]) for row in annotations_of_sample),
                attributes=tuple(
                    tuple(self._attribute(name) for name in row.attribute_tokens) for row in annotations_of_sample
                ),
                visibility=tuple(row.visibility_token for row in annotations_of_sample),
                centre=make_read_only(centre[sample_rows]),
                size_lwh=make_read_only(
                    _columns([row.size for row in annotations_of_sample], 3)[:, size_columns("wlh", "lwh")]
                ),
                rotation=self._rotations(annotations_of_sample),
                velocity=make_read_only(velocity[sample_rows]),
                lidar_points=_counts([row.num_lidar_pts for row in annotations_of_sample]),
                radar_points=_counts([row.num_radar_pts for row in annotations_of_sample]),
            )
        return boxes

    def _neighbours(self, rows: Sequence[SampleAnnotation], row_by_token: dict[str, int], time: Any) -> tuple[I32, I32]:
        """Rows [N] of the boxes before and after each box of the same instance, -1 where there is none."""
        neighbours = np.full((2, len(rows)), -1, np.int32)
        for row_index, row in enumerate(rows):
            for side, token in enumerate((row.prev, row.next)):
                if not token:
                    continue
                neighbour = row_by_token.get(token)
                if neighbour is None:
                    raise self._dangling_token_error(SampleAnnotation, SampleAnnotation, token)
                if (time[neighbour] >= time[row_index]) if side == 0 else (time[neighbour] <= time[row_index]):
                    field_name = "prev" if side == 0 else "next"
                    expected_order = "earlier" if side == 0 else "later"
                    location = f"{self._path(SampleAnnotation)}: '{row.token}'"
                    raise FormatError(
                        f"{location}: its {field_name} '{token}' is not {expected_order} (the chain loops)"
                    )
                neighbours[side, row_index] = neighbour
        return neighbours[0], neighbours[1]

    def _category(self, instance: Instance) -> str:
        name = self._categories.get(instance.category_token)
        if name is None:
            raise self._dangling_token_error(Instance, Category, instance.category_token)
        return name

    def _attribute(self, token: str) -> str:
        name = self._attributes.get(token)
        if name is None:
            raise self._dangling_token_error(SampleAnnotation, Attribute, token)
        return name

    def _rotations(self, rows: Sequence[SampleAnnotation]) -> F64:
        rotation = _columns([row.rotation for row in rows], 4)
        zero_rows = np.flatnonzero(~(np.abs(rotation).max(axis=1, initial=0.0) > 0.0))
        if len(zero_rows):
            token = rows[int(zero_rows[0])].token
            raise FormatError(f"{self._path(SampleAnnotation)}: '{token}': the rotation has length zero")
        return rotation


def _check_links(root: Path) -> None:
    """Raise StoreError if a folder of sensors leads out of the root: before any of its files is read."""
    for name in ("samples", "sweeps"):
        folder = nuscenes_path(root, name)
        if folder.is_dir():
            with os.scandir(folder) as entries:
                for entry in entries:
                    if entry.is_symlink():
                        nuscenes_path(root, f"{name}/{entry.name}")


def _choose_version(root: Path, version: str | None) -> str:
    """Return the version to open: the requested one, else the only one. ConfigError if there is none."""
    if not root.is_dir():
        raise ConfigError(f"{root}: no such folder; give the nuScenes folder that holds v1.0-*, samples and sweeps")
    available = sorted(path.name for path in root.glob("v1.0-*") if path.is_dir())
    listing = ", ".join(available) or "none"
    if version is None:
        if len(available) != 1:
            problem = "several versions" if available else "no folder v1.0-*"
            raise ConfigError(f"{root}: {problem} (found: {listing}); name the version to read")
        return available[0]
    if not (root / version).is_dir():
        raise ConfigError(f"{root}: no version '{version}' (found: {listing})")
    return version


def _columns(rows: Sequence[tuple[float, ...]], width: int) -> F64:
    return make_read_only(np.array(rows, np.float64).reshape(len(rows), width))


def _counts(values: Sequence[int]) -> I32:
    counts = np.array(values, np.int32)
    counts.setflags(write=False)
    return counts

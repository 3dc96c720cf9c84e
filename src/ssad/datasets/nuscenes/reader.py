"""nuScenes scene by scene: frames of all sensors joined with calibration and pose, and boxes at any time.

Any version (v1.0-mini to v1.0-trainval) is opened through `ssad.datasets.nuscenes.index`; memory is that of one scene.
What is found is in `ssad.datasets.nuscenes.scene`, the files are read by `ssad.datasets.nuscenes.files`.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np

from ssad.core.boxes import size_columns
from ssad.core.errors import ConfigError, FormatError
from ssad.core.rotations import pose_matrix
from ssad.core.types import F64, I32
from ssad.datasets.nuscenes.index import Index, open_index
from ssad.datasets.nuscenes.scene import (
    Annotations,
    SceneData,
    SensorFrame,
    frozen,
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
from ssad.datasets.nuscenes.tables import table_path

R = TypeVar("R", bound=TableRecord)


class NuScenes:
    """A nuScenes root folder. It may be passed to other processes: each opens the index for itself.

    Args:
        root: Folder with samples/, sweeps/ and a folder for each version.
        version: Such as v1.0-mini; None for the only one.

    Raises:
        ConfigError: The version is not there, or there are several and none is named.
        FormatError: The tables are broken.
        StoreError: The index of a large version cannot be written.
    """

    def __init__(self, root: Path, version: str | None = None) -> None:
        self.root = Path(root)
        self.version = _choose(self.root, version)
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

    def scenes(self) -> list[Scene]:
        """All scenes, in table order."""
        return list(self._scenes)

    def scene(self, name_or_token: str) -> SceneData:
        """A scene by name or token, with everything in it.

        Raises:
            ConfigError: There is no such scene.
            FormatError: The tables are broken.
        """
        for record in self._scenes:
            if name_or_token in (record.name, record.token):
                return self._load(record)
        close = difflib.get_close_matches(name_or_token, [scene.name for scene in self._scenes], n=3, cutoff=0.0)
        hint = f"; closest: {', '.join(close)}" if close else "; it has no scene"
        raise ConfigError(f"{self.root / self.version}: no scene '{name_or_token}'{hint}")

    @cached_property
    def _scenes(self) -> list[Scene]:
        return self._index.rows(Scene)

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
        return table_path(self.root, self.version, next(name for name, known in TABLES.items() if known is kind))

    def _need(self, kind: type[R], tokens: Iterable[str], source: type[TableRecord]) -> dict[str, R]:
        """Rows by token, all of them. FormatError naming the table that names an absent one."""
        wanted = list(dict.fromkeys(tokens))
        found = self._index.get(kind, wanted)
        for token in wanted:
            if token not in found:
                raise self._dangling(source, kind, token)
        return found

    def _dangling(self, source: type[TableRecord], kind: type[TableRecord], token: str) -> FormatError:
        table = self._path(kind).name
        return FormatError(f"{self._path(source)}: it names token '{token}', which {table} does not have")

    def _samples(self, scene: Scene) -> tuple[Sample, ...]:
        """Samples along the chain from the scene's first. FormatError: it dangles, loops or leaves some out."""
        found = {sample.token: sample for sample in self._index.children(Sample, [scene.token])}
        chain: list[Sample] = []
        token, source = scene.first_sample_token, "scene"
        while token:
            sample = found.pop(token, None)
            where = f"{self._path(Scene if source == 'scene' else Sample)}: scene '{scene.name}'"
            if sample is None and any(token == other.token for other in chain):
                raise FormatError(f"{where}: the chain of samples comes back to '{token}'")
            if sample is None:
                raise FormatError(f"{where}: sample '{token}' is not among its samples in sample.json")
            if chain and sample.timestamp <= chain[-1].timestamp:
                raise FormatError(f"{where}: sample '{token}' is not later than the one before it in the chain")
            chain.append(sample)
            token, source = sample.next, "sample"
        if found:
            where = f"{self._path(Sample)}: scene '{scene.name}'"
            raise FormatError(f"{where}: sample '{next(iter(found))}' is not in the chain of its samples")
        if not chain:
            raise FormatError(f"{self._path(Scene)}: scene '{scene.name}' has no sample")
        return tuple(chain)

    def _frames(self, scene: Scene, samples: Sequence[str]) -> tuple[SensorFrame, ...]:
        rows = self._index.children(SampleData, samples)
        if not rows:
            return ()
        calibrations = self._need(CalibratedSensor, (row.calibrated_sensor_token for row in rows), SampleData)
        poses = self._need(EgoPose, (row.ego_pose_token for row in rows), SampleData)
        mounted = self._matrices(list(calibrations.values()))
        placed = self._matrices(list(poses.values()))
        intrinsics = {token: self._intrinsic(record) for token, record in calibrations.items()}
        frames = []
        for row in rows:
            calibration = row.calibrated_sensor_token
            sensor = self._sensor(calibrations[calibration])
            if (relative := PurePosixPath(row.filename)).is_absolute() or ".." in relative.parts or not row.filename:
                where = f"{self._path(SampleData)}: '{row.token}'"
                raise FormatError(f"{where}: '{row.filename}' is no path below the root")
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
                    sensor_to_ego=mounted[calibration],
                    ego_to_world=placed[row.ego_pose_token],
                )
            )
        frames.sort(key=lambda frame: (frame.timestamp_us, frame.channel, frame.token))
        return tuple(frames)

    def _sensor(self, calibration: CalibratedSensor) -> Sensor:
        sensor = self._sensors.get(calibration.sensor_token)
        if sensor is None:
            raise self._dangling(CalibratedSensor, Sensor, calibration.sensor_token)
        return sensor

    def _intrinsic(self, calibration: CalibratedSensor) -> F64 | None:
        if self._sensor(calibration).modality != "camera":
            return None
        rows = calibration.camera_intrinsic
        if len(rows) != 3 or any(len(row) != 3 for row in rows):
            raise FormatError(f"{self._path(CalibratedSensor)}: '{calibration.token}': camera_intrinsic is not 3 x 3")
        return frozen(np.array(rows, np.float64))

    def _matrices(self, records: Sequence[CalibratedSensor] | Sequence[EgoPose]) -> dict[str, F64]:
        """Poses [4, 4] by token."""
        quaternions = np.array([record.rotation for record in records], np.float64)
        empty = np.flatnonzero(~(np.abs(quaternions).max(axis=1) > 0.0))
        if len(empty):
            record = records[int(empty[0])]
            raise FormatError(f"{self._path(type(record))}: '{record.token}': the rotation has length zero")
        matrices = frozen(pose_matrix([record.translation for record in records], quaternions))
        return {record.token: matrix for record, matrix in zip(records, matrices, strict=True)}

    def _boxes(self, samples: Sequence[Sample]) -> dict[str, Annotations]:
        """Boxes of each sample of a scene."""
        rows = self._index.children(SampleAnnotation, [sample.token for sample in samples])
        instances = self._need(Instance, (row.instance_token for row in rows), SampleAnnotation)
        place = {row.token: i for i, row in enumerate(rows)}
        times = {sample.token: sample.timestamp for sample in samples}
        time = np.array([times[row.sample_token] for row in rows], np.int64)
        centre = _columns([row.translation for row in rows], 3)
        velocity = velocities(centre, time, *self._neighbours(rows, place, time))
        members: dict[str, list[int]] = {sample.token: [] for sample in samples}
        for i, row in enumerate(rows):
            members[row.sample_token].append(i)
        result = {}
        for token, chosen in members.items():
            own = [rows[i] for i in chosen]
            result[token] = Annotations(
                token=tuple(row.token for row in own),
                instance=tuple(row.instance_token for row in own),
                category=tuple(self._category(instances[row.instance_token]) for row in own),
                attributes=tuple(tuple(self._attribute(name) for name in row.attribute_tokens) for row in own),
                visibility=tuple(row.visibility_token for row in own),
                centre=frozen(centre[chosen]),
                size_lwh=frozen(_columns([row.size for row in own], 3)[:, size_columns("wlh", "lwh")]),
                rotation=self._rotations(own),
                velocity=frozen(velocity[chosen]),
                lidar_points=_counts([row.num_lidar_pts for row in own]),
                radar_points=_counts([row.num_radar_pts for row in own]),
            )
        return result

    def _neighbours(self, rows: Sequence[SampleAnnotation], place: dict[str, int], time: Any) -> tuple[I32, I32]:
        """Rows [N] of the boxes before and after each box of the same instance, -1 where there is none."""
        found = np.full((2, len(rows)), -1, np.int32)
        for i, row in enumerate(rows):
            for side, token in enumerate((row.prev, row.next)):
                if not token:
                    continue
                other = place.get(token)
                if other is None:
                    raise self._dangling(SampleAnnotation, SampleAnnotation, token)
                if (time[other] >= time[i]) if side == 0 else (time[other] <= time[i]):
                    which = "prev" if side == 0 else "next"
                    order = "earlier" if side == 0 else "later"
                    where = f"{self._path(SampleAnnotation)}: '{row.token}'"
                    raise FormatError(f"{where}: its {which} '{token}' is not {order} (the chain loops)")
                found[side, i] = other
        return found[0], found[1]

    def _category(self, instance: Instance) -> str:
        name = self._categories.get(instance.category_token)
        if name is None:
            raise self._dangling(Instance, Category, instance.category_token)
        return name

    def _attribute(self, token: str) -> str:
        name = self._attributes.get(token)
        if name is None:
            raise self._dangling(SampleAnnotation, Attribute, token)
        return name

    def _rotations(self, rows: Sequence[SampleAnnotation]) -> F64:
        rotation = _columns([row.rotation for row in rows], 4)
        empty = np.flatnonzero(~(np.abs(rotation).max(axis=1, initial=0.0) > 0.0))
        if len(empty):
            token = rows[int(empty[0])].token
            raise FormatError(f"{self._path(SampleAnnotation)}: '{token}': the rotation has length zero")
        return rotation


def _choose(root: Path, version: str | None) -> str:
    """The version to open: the one asked for, else the only one there is. ConfigError."""
    if not root.is_dir():
        raise ConfigError(f"{root}: no such folder; give the nuScenes folder that holds v1.0-*, samples and sweeps")
    known = sorted(path.name for path in root.glob("v1.0-*") if path.is_dir())
    listed = ", ".join(known) or "none"
    if version is None:
        if len(known) != 1:
            what = "several versions" if known else "no folder v1.0-*"
            raise ConfigError(f"{root}: {what} (found: {listed}); name the version to read")
        return known[0]
    if not (root / version).is_dir():
        raise ConfigError(f"{root}: no version '{version}' (found: {listed})")
    return version


def _columns(rows: Sequence[tuple[float, ...]], width: int) -> F64:
    return frozen(np.array(rows, np.float64).reshape(len(rows), width))


def _counts(values: Sequence[int]) -> I32:
    counts = np.array(values, np.int32)
    counts.setflags(write=False)
    return counts

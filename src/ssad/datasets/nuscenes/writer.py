"""A nuScenes folder from typed calls: 13 tables that the official toolkit loads, and the sensor files.

Tokens are digests of names (scene, channel, time), so that the same calls give the same bytes. Chains (prev, next),
first and last tokens, counts and the samples of sweeps are derived in `close`, which writes the tables.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any, Final, TypeVar

import cv2
import msgspec
import numpy as np

from ssad.core.errors import FormatError
from ssad.core.folders import check_links_above
from ssad.core.nuscenes_names import ATTRIBUTES, CATEGORIES
from ssad.core.safeio import atomic_path, dump_json, make_folder, write_atomic
from ssad.core.seeding import digest
from ssad.datasets.nuscenes.schema import (
    TABLES,
    Attribute,
    CalibratedSensor,
    Category,
    EgoPose,
    Instance,
    Log,
    Map,
    Quaternion,
    Sample,
    SampleAnnotation,
    SampleData,
    Scene,
    Sensor,
    TableRecord,
    Vector,
    Visibility,
)
from ssad.datasets.nuscenes.tables import table_path

MINI_VAL: Final = ("scene-0103", "scene-0916")
MINI_TRAIN: Final = tuple(f"scene-{i:04d}" for i in (61, 553, 655, 757, 796, 1077, 1094, 1100))
_LEVELS: Final = ("v0-40", "v40-60", "v60-80", "v80-100")
_FORMATS: Final = {"camera": (".jpg", "jpg"), "lidar": (".pcd.bin", "pcd"), "radar": (".pcd", "pcd")}
_FIRST_FREE = 9001

R = TypeVar("R", bound=TableRecord)
IDENTITY: Final[Quaternion] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class _Frame:
    """A row of sample_data whose chain is not yet known."""

    row: SampleData
    scene: str
    channel: str


class NuScenesWriter:
    """Collects the records of a version; sensor files are written at once, the tables by `close`.

    As a context manager it closes if the block succeeds, and writes no tables otherwise. Its methods raise
    ValueError for wrong use (an unknown token, a duplicate time), and StoreError if a folder cannot be written.
    """

    def __init__(self, root: Path, version: str = "v1.0-mini") -> None:
        self.root, self.version = Path(root), version
        make_folder(self.root / version)
        self._rows: dict[type[TableRecord], dict[str, Any]] = {kind: {} for kind in TABLES.values()}
        self._frames: dict[str, _Frame] = {}
        self._mounted: dict[tuple[str, str], tuple[str, str]] = {}
        self._instance_scene: dict[str, str] = {}
        self._order: dict[str, list[Sample]] = {}
        self._splits: dict[str, list[str]] = {}
        for name in CATEGORIES:
            self._add(Category(_token("category", name), name=name))
        for name in ATTRIBUTES:
            self._add(Attribute(_token("attribute", name), name=name))
        for number, level in enumerate(_LEVELS, start=1):
            description = f"visibility of whole object is between {level[1:].replace('-', ' and ')}%"
            self._add(Visibility(str(number), level=level, description=description))

    def __enter__(self) -> NuScenesWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()

    def add_scene(self, name: str | None = None, *, description: str = "", location: str = "drawn") -> str:
        """Add a scene. Without a name it gets the next of mini_val, mini_train, then scene-9001 and so on."""
        used_names = {scene.name for scene in self._rows[Scene].values()}
        if name is None:
            # Names of the official mini splits first, so that the official toolkit finds the scenes in its splits.
            candidates = chain(
                MINI_VAL, MINI_TRAIN, (f"scene-{scene_number:04d}" for scene_number in count(_FIRST_FREE))
            )
            name = next(candidate for candidate in candidates if candidate not in used_names)
        if name in used_names:
            raise ValueError(f"scene '{name}' was added before")
        logfile = f"log-{name}"
        log = self._add(Log(_token("log", logfile), logfile, "ssad", "2020-01-01", location))
        return self._add(Scene(_token("scene", name), name, log, description))

    def add_sensor(
        self,
        scene: str,
        channel: str,
        *,
        modality: str,
        translation: Vector,
        rotation: Quaternion,
        intrinsic: Sequence[Sequence[float]] = (),
    ) -> str:
        """Add a sensor on the ego in a scene.

        Args:
            scene: Token of the scene.
            channel: Name of the sensor.
            modality: camera, lidar or radar.
            translation: Position in the ego frame, m.
            rotation: Orientation in the ego frame, quaternion.
            intrinsic: 3 x 3 for cameras.

        Returns:
            Token of the calibration.
        """
        if modality not in _FORMATS:
            raise ValueError(f"modality '{modality}' is none of {', '.join(_FORMATS)}")
        sensor_token = _token("sensor", channel)
        if sensor_token not in self._rows[Sensor]:
            self._add(Sensor(sensor_token, channel, modality))
        calibration_token = _token("calibrated_sensor", self._record_of(Scene, scene).name, channel)
        matrix = tuple(tuple(float(value) for value in row) for row in intrinsic)
        self._add(CalibratedSensor(calibration_token, sensor_token, _floats(translation), _floats(rotation), matrix))
        self._mounted[scene, channel] = calibration_token, modality
        return calibration_token

    def add_sample(self, scene: str, timestamp_us: int) -> str:
        """Add a key frame of a scene, in any order."""
        name = self._record_of(Scene, scene).name
        return self._add(Sample(_token("sample", name, timestamp_us), timestamp_us, scene))

    def add_sensor_frame(
        self,
        scene: str,
        channel: str,
        *,
        timestamp_us: int,
        data: bytes | Path,
        ego_translation: Vector,
        ego_rotation: Quaternion = IDENTITY,
        sample: str | None = None,
        size: tuple[int, int] = (0, 0),
    ) -> str:
        """Add a file of a sensor: its bytes, or a file to link to (copied if it cannot be linked).

        Args:
            scene: Token of the scene.
            channel: Name of the sensor.
            timestamp_us: Time, microseconds.
            data: Bytes, or the file.
            ego_translation: Position of the ego in the world, m.
            ego_rotation: Orientation of the ego in the world, quaternion.
            sample: Token of the key frame that it belongs to; None for a sweep, which gets the sample that follows
                it.
            size: Width and height of an image in pixels.

        Returns:
            Token of the file's record.
        """
        record = self._record_of(Scene, scene)
        if (scene, channel) not in self._mounted:
            raise ValueError(f"scene '{record.name}' has no sensor '{channel}': call add_sensor first")
        calibration, modality = self._mounted[scene, channel]
        if sample is not None and self._record_of(Sample, sample).scene_token != scene:
            raise ValueError(f"sample '{sample}' is of another scene")
        suffix, kind = _FORMATS[modality]
        folder = "sweeps" if sample is None else "samples"
        filename = f"{folder}/{channel}/{record.name}__{channel}__{timestamp_us}{suffix}"
        token = _token("sample_data", record.name, channel, timestamp_us)
        row = SampleData(
            token,
            sample_token=sample or "",
            ego_pose_token=token,
            calibrated_sensor_token=calibration,
            timestamp=timestamp_us,
            is_key_frame=sample is not None,
            filename=filename,
            fileformat=kind,
            height=size[1],
            width=size[0],
        )
        if token in self._frames:
            raise ValueError(f"'{channel}' has two files at {timestamp_us} in scene '{record.name}'")
        self._add(EgoPose(token, _floats(ego_translation), _floats(ego_rotation), timestamp_us))
        self._frames[token] = _Frame(row, scene, channel)
        place_file(self.root / filename, data)
        return token

    def add_instance(self, scene: str, key: str, *, category: str) -> str:
        """Add an object of a scene, such as key 'car-3'; its annotations are added one per sample."""
        token = _token("instance", self._record_of(Scene, scene).name, key)
        self._instance_scene[token] = scene
        return self._add(Instance(token, self._token_of(Category, category)))

    def add_annotation(
        self,
        sample: str,
        instance: str,
        *,
        translation: Vector,
        size: Vector,
        rotation: Quaternion,
        visibility: str = "4",
        attributes: Iterable[str] = (),
        lidar_points: int = 0,
    ) -> str:
        """Add the box of an object in a key frame.

        Args:
            sample: Token of the key frame.
            instance: Token of the object.
            translation: Centre in the global frame, m.
            size: Width, length, height, m.
            rotation: Orientation in the global frame, quaternion.
            visibility: Token of the visibility level, '1' to '4'.
            attributes: Names of the attributes.
            lidar_points: Number of LiDAR points in the box.

        Returns:
            Token of the annotation.
        """
        self._record_of(Instance, instance)
        if self._instance_scene[instance] != self._record_of(Sample, sample).scene_token:
            raise ValueError(f"instance '{instance}' and sample '{sample}' are of different scenes")
        self._record_of(Visibility, visibility)
        return self._add(
            SampleAnnotation(
                _token("sample_annotation", sample, instance),
                sample_token=sample,
                instance_token=instance,
                visibility_token=visibility,
                attribute_tokens=tuple(self._token_of(Attribute, name) for name in attributes),
                translation=_floats(translation),
                size=_floats(size),
                rotation=_floats(rotation),
                num_lidar_pts=int(lidar_points),
                num_radar_pts=0,
            )
        )

    def set_split(self, name: str, scenes: Iterable[str]) -> None:
        """Set a split of splits.json: scene names. Without any, `close` writes all, mini_train and mini_val."""
        self._splits[name] = list(scenes)

    def close(self) -> None:
        """Derive the chains and write the 13 tables, the maps and splits.json. ValueError for an empty scene."""
        if not self._rows[Scene]:
            raise ValueError("a version needs at least one scene")
        self._chain_samples()
        self._chain_frames()
        self._chain_annotations()
        self._draw_maps()
        for name, kind in TABLES.items():
            _write_table(table_path(self.root, self.version, name), self._rows[kind].values())
        names = [scene.name for scene in self._rows[Scene].values()]
        standard_splits: Mapping[str, Sequence[str]] = {"all": names, "mini_train": MINI_TRAIN, "mini_val": MINI_VAL}
        default_splits = {
            split: [name for name in names if name in members] for split, members in standard_splits.items()
        }
        splits = self._splits or {split: members for split, members in default_splits.items() if members}
        write_atomic(self.root / self.version / "splits.json", dump_json(splits, indent=1) + "\n")

    def _add(self, record: TableRecord) -> str:
        table = self._rows[type(record)]
        if record.token in table:
            raise ValueError(f"a {type(record).__name__} with the same key was added before: {record.token}")
        table[record.token] = record
        return record.token

    def _record_of(self, kind: type[R], token: str) -> R:
        record: R | None = self._rows[kind].get(token)
        if record is None:
            raise ValueError(f"no {kind.__name__} has the token '{token}'")
        return record

    def _token_of(self, kind: type[Category] | type[Attribute], name: str) -> str:
        """Return the token of a category or attribute; one that the original does not have is added."""
        token = _token("category" if kind is Category else "attribute", name)
        if token not in self._rows[kind]:
            self._add(kind(token, name=name))
        return token

    def _link(self, kind: type[TableRecord], rows: Sequence[Any]) -> None:
        """Store rows of one chain, in time order, with prev and next."""
        for number, row in enumerate(rows):
            previous_token = rows[number - 1].token if number else ""
            next_token = rows[number + 1].token if number + 1 < len(rows) else ""
            self._rows[kind][row.token] = msgspec.structs.replace(row, prev=previous_token, next=next_token)

    def _chain_samples(self) -> None:
        self._order = {token: [] for token in self._rows[Scene]}
        for sample in sorted(self._rows[Sample].values(), key=lambda row: row.timestamp):
            self._order[sample.scene_token].append(sample)
        for token, samples in self._order.items():
            scene: Scene = self._rows[Scene][token]
            if not samples:
                raise ValueError(f"scene '{scene.name}' has no sample")
            self._link(Sample, samples)
            self._rows[Scene][token] = msgspec.structs.replace(
                scene,
                nbr_samples=len(samples),
                first_sample_token=samples[0].token,
                last_sample_token=samples[-1].token,
            )

    def _chain_frames(self) -> None:
        chains: dict[tuple[str, str], list[SampleData]] = {}
        for frame in self._frames.values():
            row = frame.row
            if not row.sample_token:
                samples = self._order[frame.scene]
                next_index = bisect_left([sample.timestamp for sample in samples], row.timestamp)
                row = msgspec.structs.replace(row, sample_token=samples[min(next_index, len(samples) - 1)].token)
            self._rows[SampleData][row.token] = row
            chains.setdefault((frame.scene, frame.channel), []).append(row)
        for rows in chains.values():
            self._link(SampleData, sorted(rows, key=lambda row: row.timestamp))

    def _chain_annotations(self) -> None:
        time = {token: sample.timestamp for token, sample in self._rows[Sample].items()}
        chains: dict[str, list[SampleAnnotation]] = {}
        for row in self._rows[SampleAnnotation].values():
            chains.setdefault(row.instance_token, []).append(row)
        for token, instance in list(self._rows[Instance].items()):
            rows = sorted(chains.get(token, []), key=lambda row: time[row.sample_token])
            if not rows:
                del self._rows[Instance][token]  # the object never appears in a sample
                continue
            self._link(SampleAnnotation, rows)
            self._rows[Instance][token] = msgspec.structs.replace(
                instance,
                nbr_annotations=len(rows),
                first_annotation_token=rows[0].token,
                last_annotation_token=rows[-1].token,
            )

    def _draw_maps(self) -> None:
        """Write a blank map for each location: the official toolkit requires one for each log."""
        logs_by_location: dict[str, list[str]] = {}
        for log in self._rows[Log].values():
            logs_by_location.setdefault(log.location, []).append(log.token)
        for location, logs in logs_by_location.items():
            token = _token("map", location)
            filename = f"maps/{token}.png"
            _, png = cv2.imencode(".png", np.zeros((64, 64), np.uint8))
            write_atomic(self.root / filename, png.tobytes())
            self._rows[Map][token] = Map(token, tuple(logs), "semantic_prior", filename)


def _token(*key: object) -> str:
    return digest("nuscenes", *key)[:32]


def _floats(values: Sequence[float]) -> Any:
    """Return values as a tuple of plain finite numbers. ValueError."""
    numbers = tuple(float(value) for value in values)
    if not np.isfinite(numbers).all():
        raise ValueError(f"{numbers} is not finite")
    return numbers


def place_file(path: Path, data: bytes | Path) -> None:
    """Write bytes, or link to a file, or copy it if it cannot be linked; an existing file is replaced.

    Raises:
        FormatError: The source file does not exist.
        StoreError: The target cannot be written.
    """
    if isinstance(data, bytes):
        write_atomic(path, data)
        return
    source = data.resolve()
    if not source.is_file():
        raise FormatError(f"{data}: no such file to link to")
    check_links_above(path)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        os.link(source, path)
        return
    with atomic_path(path) as temporary:
        shutil.copyfile(source, temporary)


def _write_table(path: Path, rows: Iterable[TableRecord]) -> None:
    """Write a JSON list, one record per line, atomically. StoreError."""
    encoder = msgspec.json.Encoder()
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        separator = b"[\n"
        for row in rows:
            stream.write(separator + encoder.encode(row))
            separator = b",\n"
        stream.write(b"\n]\n" if separator == b",\n" else b"[]\n")


__all__ = ["IDENTITY", "MINI_TRAIN", "MINI_VAL", "NuScenesWriter"]

"""Worker that writes one scene under one shift. It can be killed at any moment and started again."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from io import RawIOBase
from pathlib import Path
from typing import Any, Final

import cv2
import msgspec
import numpy as np

from ssad.core import safeio
from ssad.core.errors import FormatError, StoreError
from ssad.core.folders import check_links_above, open_inside
from ssad.core.frames import ShiftReport
from ssad.core.image_files import check_writable, encode_like, turn_upright
from ssad.core.images import annotation_orientation
from ssad.core.machine import start_warp_quietly
from ssad.core.nuscenes_names import LIDAR
from ssad.datasets.nuscenes.files import read_frame_file
from ssad.datasets.nuscenes.index import fingerprint
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.datasets.nuscenes.tables import BROKEN, nuscenes_path
from ssad.datasets.point_files import encode_points_like, read_point_file
from ssad.recorders.shifted.manifest import (
    FOLDER,
    STATES,
    digest_bytes,
    digest_file,
    is_link_to,
    read_lines,
    serialise_lines,
    shard_path,
)
from ssad.recorders.shifted.options import Shard
from ssad.scenarios.static.shifts.scene_shifter import SceneShifter

UNFINISHED: Final = ".unfinished"  # folder of a root for partly written files; removed when the root is complete
_DATA: dict[object, NuScenes] = {}


class SceneLabels(msgspec.Struct):
    """The boxes of a scene after the shift.

    Attributes:
        lines: Hash of the manifest lines that they were made with.
        boxes: Boxes by token.
    """

    lines: str
    boxes: dict[str, msgspec.Raw]


def labels_path(root: Path, scene: str) -> Path:
    """Return the path of a scene's shifted boxes: written last, so that they exist only for a finished scene."""
    return root / FOLDER / f"{scene}.labels.json"


def read_finished_labels(root: Path, scene: str) -> SceneLabels | None:
    """Return the boxes of a scene all of whose files were made; None for an unfinished scene."""
    try:
        encoded = safeio.read_bytes(labels_path(root, scene), limit=1 << 30)
        labels = msgspec.json.decode(encoded, type=SceneLabels)
        return labels if labels.lines == digest_file(shard_path(root, scene)) else None
    except (FormatError, *BROKEN):
        return None  # missing or damaged: the scene is checked again


def make_shard(shard: Shard) -> dict[str, int]:
    """Write the files of a scene, its manifest lines and its labels.

    Files that match their line are left alone. A file that cannot be made because of the dataset is recorded as
    failed.

    Returns:
        Number of files by state.

    Raises:
        StoreError: The output cannot be written.
        FormatError: The tables are broken.
    """
    threads = cv2.getNumThreads()
    # Each worker has one core: threads of OpenCV would only compete with other workers.
    cv2.setNumThreads(1)
    start_warp_quietly()
    try:
        records = _make_files(shard)
    finally:
        cv2.setNumThreads(threads)
    return {state: sum(record["state"] == state for record in records.values()) for state in STATES}


def _open(shard: Shard) -> NuScenes:
    """Return the dataset, kept open between shards while its tables stay the same."""
    source, version = shard.options.source, shard.options.version
    key = (source, version, fingerprint(source, version))
    if key not in _DATA:
        for dataset in _DATA.values():
            dataset.close()
        _DATA.clear()
        _DATA[key] = NuScenes(source, version)
    return _DATA[key]


def _make_files(shard: Shard) -> dict[str, dict[str, Any]]:
    scene = _open(shard).scene(shard.scene)
    shifter = SceneShifter(shard.options.source, scene, shard.spec(), random=shard.is_random)
    lines_path, labels_file = shard_path(shard.root, shard.scene), labels_path(shard.root, shard.scene)
    previous_records = read_lines(lines_path)
    records: dict[str, dict[str, Any]] = {}
    for frame in scene.frames:
        previous = previous_records.get(frame.filename)
        if previous is not None and _is_intact(shard, previous) and not shifter.is_outdated(frame, previous):
            records[frame.filename] = previous
    if len(records) == len({other_frame.filename for other_frame in scene.frames}):
        scene_labels = read_finished_labels(shard.root, shard.scene)
        if scene_labels is not None and scene_labels.lines == digest_bytes(serialise_lines(records.values()).encode()):
            return records
    # The labels mark a finished scene, so they must go before any file changes.
    _remove(labels_file)
    check_folders(shard.root, {Path(other_frame.filename).parent for other_frame in scene.frames}, shard.options.source)
    safeio.make_folder(lines_path.parent)
    with _open_for_append(lines_path) as lines_file:
        for frame in scene.frames:
            if frame.filename not in records:
                record = records[frame.filename] = _make_file(shard, shifter, frame)
                _append(lines_path, lines_file, record)
    boxes = {}
    for sample in scene.samples:
        boxes.update(_boxes(shard, shifter, sample.token, records))
    manifest_text = serialise_lines(records.values())
    safeio.write_atomic(lines_path, manifest_text)
    content = {"lines": digest_bytes(manifest_text.encode()), "boxes": boxes}
    safeio.write_atomic(labels_file, safeio.dump_json(content) + "\n")
    return records


def check_folders(root: Path, folders: Iterable[str | Path], source: Path) -> None:
    """Raise StoreError if an output folder leads into the dataset, whose files must not be replaced."""
    dataset_folder = os.path.realpath(source)
    for folder in sorted(map(str, folders)):
        if Path(os.path.realpath(root / folder)).is_relative_to(dataset_folder):
            raise StoreError(f"{root / folder}: leads into the dataset {source}; remove that link and run again")


@contextlib.contextmanager
def _open_for_append(path: Path) -> Iterator[RawIOBase]:
    """Open a file to append whole lines; it is on disk when the block ends."""
    descriptor = open_inside(
        path.parent.parent, f"{path.parent.name}/{path.name}", os.O_WRONLY | os.O_APPEND | os.O_CREAT
    )
    with open(descriptor, "ab", buffering=0) as stream:
        if stream.tell():
            _append(path, stream, None)  # ends a line that a kill may have truncated
        yield stream
        try:
            os.fsync(stream.fileno())
        except OSError as error:
            raise _write_error(path, error) from None


def _append(path: Path, file: RawIOBase, record: Mapping[str, Any] | None) -> None:
    remaining = (safeio.dump_json(record) if record else "").encode() + b"\n"
    try:
        while remaining:
            remaining = remaining[file.write(remaining) :]
    except OSError as error:
        raise _write_error(path, error) from None


def _write_error(path: Path, error: OSError) -> StoreError:
    return StoreError(f"{path}: cannot be written: {error.strerror or error}; mend that and run the same command again")


def _is_intact(shard: Shard, record: Mapping[str, Any]) -> bool:
    """Return whether a file matches its manifest line."""
    path, source = shard.root / str(record["file"]), shard.options.source / str(record["file"])
    if record["state"] == "linked":
        return is_link_to(path, source)
    if record["state"] == "absent":
        return not path.is_symlink() and not path.exists() and not source.exists()
    if record["state"] == "failed" or path.is_symlink() or not path.is_file():
        return False
    return bool(path.stat().st_size == record["bytes"] and digest_file(path) == record["hash"])


def _make_file(shard: Shard, shifter: SceneShifter, frame: SensorFrame) -> dict[str, Any]:
    """Make one file, shifted or linked, and return its manifest line."""
    kind = "camera" if frame.modality == "camera" else "lidar" if frame.channel == LIDAR else frame.modality
    record: dict[str, Any] = {"file": frame.filename, "kind": kind, "token": frame.token}
    if kind not in ("camera", "lidar"):
        return _link(shard, record | {"reason": "no shift for this sensor"}, is_required=False)
    if (kind == "lidar" and not shard.options.lidar) or not (frame.key_frame or shard.options.sweeps):
        return _link(shard, record | {"reason": "not asked for"}, is_required=False)
    try:
        encoded, pixels, applied = (_image if kind == "camera" else _points)(shard, shifter, frame)
    except FormatError as error:
        return _failed_line(shard, record, str(error))
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        message = f"{frame.filename}: its boxes, pose or calibration make no picture: {error}"
        return _failed_line(shard, record, message)
    application = {"applied": applied.applied, "details": dict(applied.details), "skipped": dict(applied.skipped)}
    record |= {
        "severity": shifter.spec(frame).severity,
        "changed": encoded is not None,
        **application,
        **shifter.basis(frame),
    }
    if encoded is None:
        return _link(shard, record if applied.skipped else record | {"reason": _unchanged_reason(shifter, frame)})
    _write(shard.root, shard.root / frame.filename, encoded)
    return record | {"state": "shifted", "pixels": pixels, "hash": digest_bytes(encoded), "bytes": len(encoded)}


def _unchanged_reason(shifter: SceneShifter, frame: SensorFrame) -> str:
    """Return the reason why a file did not change, for shifts that state none."""
    if shifter.spec(frame).severity == 0:
        return "severity 0 changes nothing"
    return "no object in it" if shifter.base.family == "object" else "the shift changed nothing in it"


def _image(shard: Shard, shifter: SceneShifter, frame: SensorFrame) -> tuple[bytes | None, str, ShiftReport]:
    """Return bytes of a shifted image (None: unchanged), hash of its pixels, and the application of the shift."""
    image_file, clean_image = read_frame_file(shifter.root, frame)
    check_writable(image_file)
    image, applied = shifter.image(frame, clean=clean_image)
    if not applied.applied or np.array_equal(image, clean_image):
        return None, "", applied
    image = np.ascontiguousarray(image)
    orientation = annotation_orientation(image_file, width=frame.width, height=frame.height)
    encoded = encode_like(
        image_file,
        turn_upright(image, orientation),
        quality=shard.options.quality,
        subsampling=shard.subsampling,
        compression=1,
    )
    return encoded, digest_bytes(image.data), applied


def _points(shard: Shard, shifter: SceneShifter, frame: SensorFrame) -> tuple[bytes | None, str, ShiftReport]:
    """Return bytes of a shifted sweep (None: unchanged), their hash, and the application of the shift."""
    points, applied = shifter.points(frame)
    if not applied.applied or np.array_equal(points, shifter.cloud(frame)):
        return None, "", applied
    point_file = read_point_file(nuscenes_path(shifter.root, frame.filename))
    if point_file.dropped_fields:
        applied = replace(applied, details={**applied.details, "dropped_fields": list(point_file.dropped_fields)})
    encoded = encode_points_like(point_file, points)
    return encoded, digest_bytes(encoded), applied


def _boxes(shard: Shard, shifter: SceneShifter, sample: str, records: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The boxes of a sample after the shift. A sweep that cannot be read is on record, and its counts stay."""
    sweep = shifter.key_sweep(sample)
    state = "absent" if sweep is None else records[sweep.filename]["state"]
    try:
        labels = shifter.labels(sample, lidar=None if state in ("absent", "failed") else shard.options.lidar)
    except FormatError as error:  # it was linked without being read
        assert sweep is not None
        identity = {name: records[sweep.filename][name] for name in ("file", "kind", "token")}
        records[sweep.filename] = _failed_line(shard, identity, str(error))
        labels = shifter.labels(sample, lidar=None)
    sizes = labels.size_wlh
    return {
        token: {
            "translation": labels.centre[row].tolist(),
            "size": sizes[row].tolist(),
            "rotation": labels.rotation[row].tolist(),
            "num_lidar_pts": int(labels.lidar_points[row]),
        }
        for row, token in enumerate(labels.token)
    }


def _failed_line(shard: Shard, record: dict[str, Any], message: str) -> dict[str, Any]:
    """Return the manifest line of a file that cannot be made, and remove any older version of it."""
    _remove(shard.root / record["file"])
    return record | {"state": "failed", "reason": message.replace(f"{shard.options.source}{os.sep}", "")}


def _link(shard: Shard, record: dict[str, Any], *, is_required: bool = True) -> dict[str, Any]:
    """Link a file to the clean one and return its manifest line; a file that is not needed may be absent."""
    source = nuscenes_path(shard.options.source, record["file"])
    if not os.path.isfile(source):
        if is_required or os.path.lexists(source):
            return _failed_line(shard, record, f"{record['file']}: no such file")
        _remove(shard.root / record["file"])
        return record | {"state": "absent"}
    link(shard.root, source, shard.root / record["file"])
    return record | {"state": "linked"}


def _temporary(root: Path) -> Path:
    return root / UNFINISHED / f"{os.getpid()}-{os.urandom(6).hex()}"


def link(root: Path, source: Path, target: Path) -> None:
    """Put a symbolic link in place of any existing file.

    The link names the file that `source` finally resolves to; a file in the same folder is named relatively, so
    that a root may be moved.

    Args:
        root: Folder of the dataset.
        source: File that the link leads to.
        target: Path of the link.

    Raises:
        StoreError: The link cannot be written.
    """
    destination = source.name if source.parent == target.parent else os.path.realpath(source)
    try:
        if os.path.islink(target) and os.readlink(target) == destination:
            return
    except OSError as error:
        raise _write_error(target, error) from None
    with _replacement_path(root, target) as temporary:
        temporary.symlink_to(destination)


def _write(root: Path, target: Path, data: bytes) -> None:
    """Write a whole file or nothing. Files are not synced: their size and hash are in the manifest, which is."""
    with _replacement_path(root, target) as temporary:
        temporary.write_bytes(data)


@contextlib.contextmanager
def _replacement_path(root: Path, target: Path) -> Iterator[Path]:
    """Yield a path in the folder of unfinished files that replaces `target` if the block succeeds. StoreError."""
    temporary = _temporary(root)
    check_links_above(target, root=root)
    check_links_above(temporary, root=root)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.parent.mkdir(exist_ok=True)
        yield temporary
        # A rename within one file system is atomic: a kill leaves either the old file or the new one.
        os.replace(temporary, target)
    except OSError as error:
        raise _write_error(target, error) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _remove(target: Path) -> None:
    try:
        target.unlink(missing_ok=True)
    except OSError as error:
        raise _write_error(target, error) from None

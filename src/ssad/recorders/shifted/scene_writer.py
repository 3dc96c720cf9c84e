"""One scene under one shift, written out: what a worker does. It can be killed at any moment and started again."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping
from io import RawIOBase
from pathlib import Path
from typing import Any, Final

import cv2
import msgspec
import numpy as np

from ssad.core import safeio
from ssad.core.errors import FormatError, StoreError
from ssad.core.frames import Applied
from ssad.core.images import encode_jpeg
from ssad.core.machine import quiet_warp
from ssad.core.nuscenes_names import LIDAR
from ssad.core.types import U8
from ssad.datasets.nuscenes.files import points_bytes
from ssad.datasets.nuscenes.index import fingerprint
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.recorders.shifted.manifest import (
    FOLDER,
    STATES,
    digest_bytes,
    digest_file,
    leads_to,
    read_lines,
    shard_path,
    text,
)
from ssad.recorders.shifted.options import Shard
from ssad.scenarios.static.shifts.scene_shifter import SceneShifter

UNFINISHED: Final = ".unfinished"  # folder of a root for files that are being written; removed when it is done
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
    """The boxes of a scene after the shift: written last, so that they are there only for a finished scene."""
    return root / FOLDER / f"{scene}.labels.json"


def finished(root: Path, scene: str) -> SceneLabels | None:
    """The boxes of a scene all of whose files were made; None for one that is still to be done."""
    try:
        data = safeio.read_bytes(labels_path(root, scene), limit=1 << 30)
        labels = msgspec.json.decode(data, type=SceneLabels)
        return labels if labels.lines == digest_file(shard_path(root, scene)) else None
    except (FormatError, msgspec.MsgspecError):
        return None  # not there, or damaged: the scene is looked through again


def make_shard(shard: Shard) -> dict[str, int]:
    """Writes the files of a scene, its manifest lines and its labels; counts by state.

    Files that are there as their line says are left alone. A file that cannot be made because of the dataset is
    recorded as failed. StoreError when the output cannot be written; FormatError for broken tables.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    quiet_warp()
    try:
        done = _files(shard)
    finally:
        cv2.setNumThreads(threads)
    return {state: sum(r["state"] == state for r in done.values()) for state in STATES}


def _open(shard: Shard) -> NuScenes:
    """The dataset, kept open between shards for as long as its tables stay the same."""
    source, version = shard.options.source, shard.options.version
    key = (source, version, fingerprint(source, version))
    if key not in _DATA:
        for old in _DATA.values():
            old.close()
        _DATA.clear()
        _DATA[key] = NuScenes(source, version)
    return _DATA[key]


def _files(shard: Shard) -> dict[str, dict[str, Any]]:
    scene = _open(shard).scene(shard.scene)
    shifter = SceneShifter(shard.options.source, scene, shard.spec(), random=shard.random)
    path, labels = shard_path(shard.root, shard.scene), labels_path(shard.root, shard.scene)
    known = read_lines(path)
    done: dict[str, dict[str, Any]] = {}
    for frame in scene.frames:
        old = known.get(frame.filename)
        if old is not None and _stands(shard, old) and not shifter.outdated(frame, old):
            done[frame.filename] = old
    if len(done) == len({f.filename for f in scene.frames}):
        made = finished(shard.root, shard.scene)
        if made is not None and made.lines == digest_bytes(text(done.values()).encode()):
            return done
    _remove(labels)
    check_folders(shard.root, {Path(f.filename).parent for f in scene.frames}, shard.options.source)
    safeio.make_folder(path.parent)
    with _appending(path) as lines:
        for frame in scene.frames:
            if frame.filename not in done:
                record = done[frame.filename] = _make(shard, shifter, frame)
                _append(path, lines, record)
    boxes = {}
    for sample in scene.samples:
        boxes.update(_boxes(shard, shifter, sample.token, done))
    lines_text = text(done.values())
    safeio.write_atomic(path, lines_text)
    found = {"lines": digest_bytes(lines_text.encode()), "boxes": boxes}
    safeio.write_atomic(labels, safeio.dump_json(found) + "\n")
    return done


def check_folders(root: Path, folders: Iterable[str | Path], source: Path) -> None:
    """StoreError when a folder to write into leads into the dataset itself, whose files must not be replaced."""
    clean = os.path.realpath(source)
    for folder in sorted(map(str, folders)):
        if Path(os.path.realpath(root / folder)).is_relative_to(clean):
            raise StoreError(f"{root / folder}: leads into the dataset {source}; remove that link and run again")


@contextlib.contextmanager
def _appending(path: Path) -> Iterator[RawIOBase]:
    """The file, open to append whole lines, on disk when the block ends."""
    try:
        file = open(path, "ab", buffering=0)  # noqa: SIM115 (errors of the block are not those of the file)
    except OSError as error:
        raise _cannot(path, error) from None
    with file:
        if file.tell():
            _append(path, file, None)  # ends a line that a kill may have torn
        yield file
        try:
            os.fsync(file.fileno())
        except OSError as error:
            raise _cannot(path, error) from None


def _append(path: Path, file: RawIOBase, record: Mapping[str, Any] | None) -> None:
    data = (safeio.dump_json(record) if record else "").encode() + b"\n"
    try:
        while data:
            data = data[file.write(data) :]
    except OSError as error:
        raise _cannot(path, error) from None


def _cannot(path: Path, error: OSError) -> StoreError:
    return StoreError(f"{path}: cannot be written: {error.strerror or error}; mend that and run the same command again")


def _stands(shard: Shard, record: Mapping[str, Any]) -> bool:
    """Whether a file is as its line says."""
    path, source = shard.root / str(record["file"]), shard.options.source / str(record["file"])
    if record["state"] == "linked":
        return leads_to(path, source)
    if record["state"] == "absent":
        return not path.is_symlink() and not path.exists() and not source.exists()
    if record["state"] == "failed" or path.is_symlink() or not path.is_file():
        return False
    return bool(path.stat().st_size == record["bytes"] and digest_file(path) == record["hash"])


def _make(shard: Shard, shifter: SceneShifter, frame: SensorFrame) -> dict[str, Any]:
    """Makes one file, shifted or linked, and says what was done."""
    kind = "camera" if frame.modality == "camera" else "lidar" if frame.channel == LIDAR else frame.modality
    record: dict[str, Any] = {"file": frame.filename, "kind": kind, "token": frame.token}
    if kind not in ("camera", "lidar"):
        return _link(shard, record | {"reason": "no shift for this sensor"}, needed=False)
    if (kind == "lidar" and not shard.options.lidar) or not (frame.key_frame or shard.options.sweeps):
        return _link(shard, record | {"reason": "not asked for"}, needed=False)
    try:
        data, pixels, applied = (_image if kind == "camera" else _points)(shard, shifter, frame)
    except FormatError as error:
        return _failed(shard, record, str(error))
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        why = f"{frame.filename}: its boxes, pose or calibration make no picture: {error}"
        return _failed(shard, record, why)
    told = {"applied": applied.applied, "details": dict(applied.details), "skipped": dict(applied.skipped)}
    record |= {"severity": shifter.spec(frame).severity, "changed": data is not None, **told, **shifter.basis(frame)}
    if data is None:
        return _link(shard, record if applied.skipped else record | {"reason": _idle(shifter, frame)})
    _write(shard.root, shard.root / frame.filename, data)
    return record | {"state": "shifted", "pixels": pixels, "hash": digest_bytes(data), "bytes": len(data)}


def _idle(shifter: SceneShifter, frame: SensorFrame) -> str:
    """Why a file did not change, where the shift does not say."""
    if shifter.spec(frame).severity == 0:
        return "severity 0 changes nothing"
    return "no object in it" if shifter.base.family == "object" else "the shift changed nothing in it"


def _image(shard: Shard, shifter: SceneShifter, frame: SensorFrame) -> tuple[bytes | None, str, Applied]:
    """Bytes of a shifted image (None: unchanged), hash of its pixels, what was done."""
    clean = shifter.read(frame)
    image, applied = shifter.image(frame, clean=clean)
    if not applied.applied or np.array_equal(image, clean):
        return None, "", applied
    image = np.ascontiguousarray(image)
    return _encode(image, shard, frame.filename), digest_bytes(image.data), applied


def _points(shard: Shard, shifter: SceneShifter, frame: SensorFrame) -> tuple[bytes | None, str, Applied]:
    """Bytes of a shifted sweep (None: unchanged), their hash, what was done."""
    points, applied = shifter.points(frame)
    if not applied.applied or np.array_equal(points, shifter.cloud(frame)):
        return None, "", applied
    data = points_bytes(points)
    return data, digest_bytes(data), applied


def _boxes(shard: Shard, shifter: SceneShifter, sample: str, done: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The boxes of a sample after the shift. A sweep that cannot be read is on record, and its counts stay."""
    sweep = shifter.key_sweep(sample)
    state = "absent" if sweep is None else done[sweep.filename]["state"]
    try:
        found = shifter.labels(sample, lidar=None if state in ("absent", "failed") else shard.options.lidar)
    except FormatError as error:  # linked unseen, now found to be broken
        assert sweep is not None
        kept = {name: done[sweep.filename][name] for name in ("file", "kind", "token")}
        done[sweep.filename] = _failed(shard, kept, str(error))
        found = shifter.labels(sample, lidar=None)
    sizes = found.size_wlh
    return {
        token: {
            "translation": found.centre[n].tolist(),
            "size": sizes[n].tolist(),
            "rotation": found.rotation[n].tolist(),
            "num_lidar_pts": int(found.lidar_points[n]),
        }
        for n, token in enumerate(found.token)
    }


def _failed(shard: Shard, record: dict[str, Any], message: str) -> dict[str, Any]:
    """A line for a file that cannot be made; nothing is left of an older one."""
    _remove(shard.root / record["file"])
    return record | {"state": "failed", "reason": message.replace(f"{shard.options.source}{os.sep}", "")}


def _encode(image: U8, shard: Shard, name: str) -> bytes:
    """The file's bytes, in the format of the original."""
    if name.lower().endswith(".png"):
        fine, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not fine:
            raise FormatError(f"{name}: cannot be encoded as PNG")
        return data.tobytes()
    return encode_jpeg(image, shard.options.quality, shard.subsampling)


def _link(shard: Shard, record: dict[str, Any], *, needed: bool = True) -> dict[str, Any]:
    """A link to the clean file; one that is not needed may be absent."""
    source = shard.options.source / record["file"]
    if not os.path.isfile(source):
        if needed or os.path.lexists(source):
            return _failed(shard, record, f"{record['file']}: no such file")
        _remove(shard.root / record["file"])
        return record | {"state": "absent"}
    link(shard.root, source, shard.root / record["file"])
    return record | {"state": "linked"}


def _temporary(root: Path) -> Path:
    return root / UNFINISHED / f"{os.getpid()}-{os.urandom(6).hex()}"


def link(root: Path, source: Path, target: Path) -> None:
    """Put a symbolic link in place of whatever was there.

    It names the file that `source` finally resolves to; a file beside it is named relatively, so that a root may be
    moved.

    Args:
        root: Folder of the dataset.
        source: What the link leads to.
        target: Where the link is put.

    Raises:
        StoreError: The link cannot be written.
    """
    end = source.name if source.parent == target.parent else os.path.realpath(source)
    try:
        if os.path.islink(target) and os.readlink(target) == end:
            return
    except OSError as error:
        raise _cannot(target, error) from None
    with _replacing(root, target) as temporary:
        temporary.symlink_to(end)


def _write(root: Path, target: Path, data: bytes) -> None:
    """The whole file or nothing. Not synced one by one: its size and hash are in the manifest, which is."""
    with _replacing(root, target) as temporary:
        temporary.write_bytes(data)


@contextlib.contextmanager
def _replacing(root: Path, target: Path) -> Iterator[Path]:
    """A path in the folder of unfinished files that replaces `target` when the block ends well. StoreError."""
    temporary = _temporary(root)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.parent.mkdir(exist_ok=True)
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise _cannot(target, error) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _remove(target: Path) -> None:
    try:
        target.unlink(missing_ok=True)
    except OSError as error:
        raise _cannot(target, error) from None

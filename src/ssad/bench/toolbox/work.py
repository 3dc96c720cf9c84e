"""One scene under one shift, written out: what a worker does. It can be killed at any moment and started again."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ssad import safeio
from ssad.bench.toolbox.manifest import digest_bytes, digest_file, read_lines, shard_path, text
from ssad.bench.toolbox.plan import Shard
from ssad.bench.toolbox.scene import LIDAR, SceneShifter
from ssad.datasets.nuscenes.files import encode_jpeg, points_bytes
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.errors import FormatError, StoreError
from ssad.frames import Applied
from ssad.types import U8

_DATA: dict[tuple[str, str], NuScenes] = {}


def labels_path(root: Path, scene: str) -> Path:
    """The boxes of a scene after the shift."""
    return root / "manifest" / f"{scene}.labels.json"


def make_shard(shard: Shard) -> dict[str, int]:
    """Writes the files of a scene, its manifest lines and its labels; counts by state.

    Files that are there as their line says are left alone. A file that cannot be made because of the dataset is
    recorded as failed. StoreError when the output cannot be written; FormatError for broken tables.
    """
    cv2.setNumThreads(1)
    key = (str(shard.options.source), shard.options.version)
    if key not in _DATA:
        _DATA.clear()
        _DATA[key] = NuScenes(shard.options.source, shard.options.version)
    scene = _DATA[key].scene(shard.scene)
    shifter = SceneShifter(shard.options.source, scene, shard.spec(), random=shard.random)
    path = shard_path(shard.root, shard.scene)
    known = read_lines(path)
    done: dict[str, dict[str, Any]] = {}
    safeio.make_folder(path.parent)
    with _appending(path) as lines:
        for frame in scene.frames:
            old = known.get(frame.filename)
            if old is not None and old["state"] != "failed" and _stands(shard.root, old):
                done[frame.filename] = old
                continue
            record = _make(shard, shifter, frame)
            done[frame.filename] = record
            try:
                lines.write(safeio.dump_json(record).encode() + b"\n")
            except OSError as error:
                raise StoreError(f"{path}: cannot be written: {error.strerror or error}") from None
    labels = {}
    for sample in scene.samples:
        with contextlib.suppress(FormatError):  # a sweep that cannot be read is on record; its counts stay
            found = shifter.labels(sample.token)
            for n, token in enumerate(found.token):
                labels[token] = {
                    "translation": found.centre[n].tolist(),
                    "size": found.size[n].tolist(),
                    "rotation": found.rotation[n].tolist(),
                    "num_lidar_pts": int(found.lidar_points[n]),
                }
    safeio.write_atomic(labels_path(shard.root, shard.scene), safeio.dump_json(labels) + "\n")
    safeio.write_atomic(path, text(done.values()))
    return {state: sum(r["state"] == state for r in done.values()) for state in ("shifted", "linked", "failed")}


@contextlib.contextmanager
def _appending(path: Path) -> Any:
    """The file, open to append whole lines, on disk when the block ends."""
    try:
        with open(path, "ab", buffering=0) as file:
            if file.tell():
                file.write(b"\n")  # ends a line that a kill may have torn
            yield file
            os.fsync(file.fileno())
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {error.strerror or error}") from None


def _stands(root: Path, record: Mapping[str, Any]) -> bool:
    """Whether a file is as its line says."""
    path = root / str(record["file"])
    if record["state"] == "linked":
        return path.is_symlink() and path.exists()
    if path.is_symlink() or not path.is_file() or path.stat().st_size != int(record["bytes"]):
        return False
    return digest_file(path) == str(record["hash"])


def _make(shard: Shard, shifter: SceneShifter, frame: SensorFrame) -> dict[str, Any]:
    """Makes one file, shifted or linked, and says what was done."""
    kind = "camera" if frame.modality == "camera" else "lidar" if frame.channel == LIDAR else frame.modality
    record: dict[str, Any] = {"file": frame.filename, "kind": kind, "token": frame.token}
    target = shard.root / frame.filename
    wanted = kind == "camera" or (kind == "lidar" and shard.options.lidar)
    if not wanted or (not frame.key_frame and not shard.options.sweeps):
        return _link(
            shard,
            frame,
            target,
            record | {"reason": "not asked for" if wanted or kind == "lidar" else "no shift for this sensor"},
        )
    try:
        if kind == "camera":
            image, applied = shifter.image(frame)
            changed = not np.array_equal(image, shifter.read(frame)) if applied.applied else False
            pixels = digest_bytes(image.tobytes())
            data = b"" if not applied.applied else _encode(image, shard, frame.filename)
        else:
            points, applied = shifter.points(frame)
            data = points_bytes(points)
            pixels, changed = digest_bytes(data), applied.applied
    except FormatError as error:
        _remove(target)
        return record | {"state": "failed", "reason": _without(str(error), shard.options.source)}
    record |= {"severity": shifter.spec(frame).severity, "changed": changed, **_told(applied)}
    if not applied.applied:
        return _link(shard, frame, target, record)
    _write(target, data)
    return record | {"state": "shifted", "pixels": pixels, "hash": digest_bytes(data), "bytes": len(data)}


def _without(message: str, source: Path) -> str:
    """A message with file names relative to the dataset."""
    return message.replace(f"{source}{os.sep}", "")


def _told(applied: Applied) -> dict[str, Any]:
    """A record of what was applied, as plain data."""
    return {"applied": applied.applied, "details": dict(applied.details), "skipped": dict(applied.skipped)}


def _encode(image: U8, shard: Shard, name: str) -> bytes:
    """The file's bytes, in the format of the original."""
    if name.lower().endswith(".png"):
        fine, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not fine:
            raise FormatError(f"{name}: cannot be encoded as PNG")
        return data.tobytes()
    return encode_jpeg(image, shard.options.quality, shard.subsampling)


def _link(shard: Shard, frame: SensorFrame, target: Path, record: dict[str, Any]) -> dict[str, Any]:
    """A link to the unchanged file."""
    source = (shard.options.source / frame.filename).resolve()
    if not source.is_file():
        _remove(target)
        return record | {"state": "failed", "reason": f"{frame.filename}: no such file"}
    link(source, target)
    return record | {"state": "linked"}


def link(source: Path, target: Path) -> None:
    """A symbolic link in place of whatever was there. StoreError."""
    temporary = target.with_name(f".{target.name}-{os.getpid()}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(source)
        os.replace(temporary, target)
    except OSError as error:
        raise StoreError(f"{target}: cannot be written: {error.strerror or error}") from None


def _remove(target: Path) -> None:
    with contextlib.suppress(OSError):
        target.unlink(missing_ok=True)


def _write(target: Path, data: bytes) -> None:
    """The whole file or nothing. Not synced one by one: its size and hash are in the manifest, which is."""
    temporary = target.with_name(f".{target.name}-{os.getpid()}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)
        os.replace(temporary, target)
    except OSError as error:
        raise StoreError(f"{target}: cannot be written: {error.strerror or error}") from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)

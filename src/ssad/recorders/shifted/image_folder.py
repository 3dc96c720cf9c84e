"""`ssad shift` on a folder of pictures that is not a nuScenes root, such as KITTI or COCO: each picture alone.

Nothing is known of a picture but, in KITTI, the camera matrix (`calib/NUMBER.txt` beside `image_2`). For others a
typical camera, level on a flat road, is assumed. Shifts that need boxes or depth of the scene are therefore refused:
the object shifts, and placed objects. Other files (labels, calibration, LiDAR) are linked: LiDAR points stay clean.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ssad.core.errors import ConfigError, SSADError, StoreError
from ssad.core.frames import Camera, Frame
from ssad.core.images import encode_jpeg, read_image
from ssad.core.machine import start_warp_quietly
from ssad.core.safeio import dump_json, make_folder, read_text, remove_unfinished, write_atomic
from ssad.core.types import U8
from ssad.engine.pool import open_pool
from ssad.engine.store import RUN, Store
from ssad.engine.task import Task
from ssad.recorders.shifted.options import Strength
from ssad.scenarios.static.shifts import KNOWN, SHIFTS, VERSIONS, ShiftSpec, random_severity, shift_images
from ssad.scenarios.static.shifts.spec import PLACING

PICTURES = (".jpg", ".jpeg", ".png")
JPEG, PAGE, LINES = (".jpg", ".jpeg"), "manifest.json", "manifest.jsonl"
PICTURE_S = 600.0  # time limit of a picture, s
KITTI = {"image_2": "P2", "image_3": "P3"}


@dataclass(frozen=True)
class ShiftedFolder:
    """A written folder.

    Attributes:
        root: Path of the folder.
        shifted: Number of pictures that were written.
        linked: Number of other files.
        applied: Share of the pictures that the shift changed.
        reasons: Reasons of failed pictures, one line each.
    """

    root: Path
    shifted: int
    linked: int
    applied: float
    reasons: tuple[str, ...]


def picture_shifts(names: Sequence[str]) -> tuple[str, ...]:
    """Return the shifts that pictures alone allow; "all" is already resolved to the paper's 11 shifts.

    Raises:
        ConfigError: A shift that was requested by name needs boxes of the scene.
    """
    possible = tuple(name for name in names if KNOWN[name][0] != "object" and name not in PLACING)
    impossible = [name for name in names if name not in possible]
    if impossible and set(names) != set(SHIFTS):
        raise ConfigError(
            f"{impossible[0]} needs boxes in space, which pictures alone do not have; take a nuScenes folder, "
            "or one picture with --box"
        )
    return possible


@dataclass(frozen=True, slots=True)
class ShiftTask:
    """One picture under one shift: the unit of work of a worker.

    Attributes:
        path: Path of the picture.
        key: Name of the picture in the folder.
        root: Folder of the shifted picture.
        spec: The shift; its severity is arbitrary under `random`.
        random: Whether the severity is drawn for each picture.
        quality, subsampling: See `shift_pictures`.
    """

    path: Path
    key: str
    root: Path
    spec: ShiftSpec
    random: bool
    quality: int
    subsampling: str


def shift_pictures(
    source: Path,
    out: Path,
    *,
    shifts: Sequence[str],
    severities: Sequence[Strength],
    settings: Mapping[str, Any],
    workers: int | None = None,
    ray: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[ShiftedFolder]:
    """Write OUT/SHIFT-SEVERITY with the files of a folder and its pictures shifted; resumes an interrupted run.

    The bytes depend neither on the number of workers nor on the cluster. OUT also holds the record of the work,
    like the results folder of a run.

    Args:
        source: Folder of pictures, at any depth.
        out: Folder of the new folders.
        shifts: See `picture_shifts`.
        severities: 1 to 5, or "random": drawn for each picture.
        settings: seed, calibration, quality, subsampling.
        workers: Number of processes; None: one per core; 0: all in this process.
        ray: Address of a cluster that sees the same folders.
        progress: Called with the number of finished pictures and of all pictures.

    Returns:
        One entry per folder.

    Raises:
        ConfigError: The folder has no picture, or OUT lies in the source.
        StoreError: OUT holds shifts with other settings, or cannot be written.
    """
    source = source.resolve()
    if out.resolve().is_relative_to(source):
        raise ConfigError(f"{out}: lies in {source}, which it would become a part of; give another OUT")
    files = sorted(path for path in source.rglob("*") if path.is_file())
    pictures = [path for path in files if path.suffix.lower() in PICTURES]
    if not pictures:
        raise ConfigError(f"{source}: no nuScenes folder, and no picture (.jpg, .png) in it")
    conditions = {out / f"{name}-{strength}": (name, strength) for name in shifts for strength in severities}
    identity = {"source": str(source), "version": VERSIONS[settings["calibration"]], **settings}
    for root in conditions:
        if root.exists() and not (out / RUN).is_file():
            raise StoreError(f"{root}: holds something else; choose another OUT")
    with Store.open(
        out, {"identity": identity, "suite": {"name": "ssad shift", **identity}}, retry=True, command="ssad shift"
    ) as store:
        tasks = [
            _make_task(path, source, root, condition=condition, settings=settings)
            for root, condition in conditions.items()
            for path in pictures
        ]
        for folder in {(picture.root / picture.key).parent for picture in tasks}:
            remove_unfinished(folder)
        missing = [
            picture
            for picture in tasks
            if _task_name(picture) not in store.results or not (picture.root / picture.key).is_file()
        ]
        with open_pool(len(missing), workers=workers, ray=ray) as pool:
            for picture in missing:
                pool.add(Task(_shift_image, picture, PICTURE_S, label=picture))
            for finished, outcome in enumerate(pool.outcomes(), 1):
                picture = outcome.task.label
                record = outcome.value or {"status": outcome.status, "reason": outcome.reason}
                if _task_name(picture) not in store.results:  # else only the file was missing, and its record stands
                    store.append({"key": _task_name(picture), **record}, None)
                progress(len(tasks) - len(missing) + finished, len(tasks))
        return [
            _finish_folder(root, source, files, settings=identity, condition=condition, results=store.results)
            for root, condition in conditions.items()
        ]


def _make_task(
    path: Path, source: Path, root: Path, *, condition: tuple[str, Strength], settings: Mapping[str, Any]
) -> ShiftTask:
    shift, strength = condition
    spec = ShiftSpec(
        shift, 1 if strength == "random" else int(strength), seed=settings["seed"], calibration=settings["calibration"]
    )
    return ShiftTask(
        path,
        path.relative_to(source).as_posix(),
        root.absolute(),
        spec,
        strength == "random",
        settings["quality"],
        settings["subsampling"],
    )


def _task_name(image: ShiftTask) -> str:
    return f"{image.root.name}/{image.key}"


def _shift_image(image_task: ShiftTask) -> dict[str, Any]:
    """In a worker: shift one picture; what is recorded of it."""
    spec = (
        replace(image_task.spec, severity=random_severity(image_task.spec, image_task.key, image_task.key))
        if image_task.random
        else image_task.spec
    )
    start_warp_quietly()
    try:
        image = read_image(image_task.path)
        frame = Frame(camera_of(image_task.path, image), scene=image_task.key, sample=image_task.key)
        shifted, (application,) = shift_images(image, [frame], spec)
        make_folder((image_task.root / image_task.key).parent)
        write_atomic(image_task.root / image_task.key, _encode_shifted(shifted, image_task))
    except SSADError as error:
        return {"status": "failed", "severity": spec.severity, "reason": str(error)}
    details = {
        "applied": application.applied,
        "details": dict(application.details),
        "skipped": dict(application.skipped),
    }
    return {"status": "ok", "severity": spec.severity, **details}


def _encode_shifted(image: U8, image_task: ShiftTask) -> bytes:
    if image_task.path.suffix.lower() not in JPEG:
        return bytes(cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes())
    chroma = image_task.subsampling
    if chroma == "auto":  # 420 averages the chroma of neighbours, which would weaken noise
        chroma = "444" if image_task.spec.family == "sensor" else "420"
    return encode_jpeg(image, image_task.quality, chroma)


def camera_of(path: Path, image: U8) -> Camera:
    """Return the camera of a picture: that of KITTI's calibration if it exists, else a typical one.

    Raises:
        ConfigError: The calibration does not contain the camera.
    """
    camera = Camera.typical(image.shape[1], image.shape[0])
    calibration = path.parent.parent / "calib" / f"{path.stem}.txt"
    if path.parent.name not in KITTI or not calibration.is_file():
        return camera
    matrix_name = KITTI[path.parent.name]
    for line in read_text(calibration).splitlines():
        line_name, _, matrix_text = line.partition(":")
        if line_name.strip() == matrix_name:
            try:
                matrix = np.array(matrix_text.split(), np.float64).reshape(3, 4)[:, :3]
            except ValueError:
                break
            return replace(camera, intrinsic=matrix)
    raise ConfigError(f"{calibration}: no line '{matrix_name}:' with 12 numbers")


def _finish_folder(
    root: Path,
    source: Path,
    files: Sequence[Path],
    *,
    settings: Mapping[str, Any],
    condition: tuple[str, Strength],
    results: Mapping[str, Mapping[str, Any]],
) -> ShiftedFolder:
    """Link what is no picture, say what was done, and count."""
    link_count = 0
    for path in files:
        target = root / path.relative_to(source)
        if path.suffix.lower() in PICTURES:
            continue
        link_count += 1
        if not target.is_symlink():
            make_folder(target.parent)
            os.symlink(path, target)
    folder_records = {
        key.removeprefix(f"{root.name}/"): line for key, line in results.items() if key.startswith(f"{root.name}/")
    }
    # The store is in the order of completion; sorting makes the manifest independent of it.
    manifest_lines = [{**folder_records[key], "key": key} for key in sorted(folder_records)]
    write_atomic(make_folder(root) / LINES, "".join(dump_json(line) + "\n" for line in manifest_lines))
    write_atomic(root / PAGE, dump_json({"shift": condition[0], "severity": condition[1], **settings}, indent=1) + "\n")
    successes = [line for line in manifest_lines if line["status"] == "ok"]
    reasons = tuple(f"{line['key']}: {line['reason']}" for line in manifest_lines if line["status"] != "ok")
    applied = sum(bool(line["applied"]) for line in successes) / max(len(successes), 1)
    return ShiftedFolder(root, len(successes), link_count, applied, reasons)

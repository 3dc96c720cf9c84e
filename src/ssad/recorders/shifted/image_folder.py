"""`ssad shift` on a folder of pictures that is not a nuScenes root, such as KITTI or COCO: each picture alone.

Nothing is known of a picture but, in KITTI, the camera matrix (`calib/NUMBER.txt` beside `image_2`). For others a
typical camera, level on a flat road, is assumed. Shifts that need boxes or depth of the scene are therefore refused:
the object shifts, and placed objects. Point clouds get the LiDAR twin of the shift. Labels, calibration and all other
files are linked; a picture that cannot be shifted is named and left out, never linked.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ssad.core.errors import ConfigError, SSADError, StoreError
from ssad.core.folders import check_links_above
from ssad.core.frames import Camera, Frame, ShiftReport, SweepFrame
from ssad.core.image_files import FORMAT_NAMES, check_writable, encode_like, read_image_file
from ssad.core.machine import start_warp_quietly
from ssad.core.safeio import dump_json, make_folder, read_text, remove_unfinished, write_atomic
from ssad.core.types import U8
from ssad.datasets.picture_folders import FolderFile, list_folder
from ssad.datasets.point_files import encode_points_like, read_point_file
from ssad.engine.pool import open_pool
from ssad.engine.store import RUN, Store
from ssad.engine.task import Task
from ssad.recorders.shifted.options import Strength
from ssad.recorders.shifted.scene_writer import check_folders
from ssad.scenarios.static.shifts import (
    KNOWN,
    SHIFTS,
    VERSIONS,
    ShiftSpec,
    random_severity,
    shift_images,
    shift_points,
)
from ssad.scenarios.static.shifts.spec import PLACING

PAGE, LINES = "manifest.json", "manifest.jsonl"
LAYOUT = 2  # of the files that are written: a folder of an earlier layout is not resumed
PICTURE_S = 600.0  # time limit of a picture, s
KITTI = {"image_2": "P2", "image_3": "P3"}


@dataclass(frozen=True)
class ShiftedFolder:
    """A written folder.

    Attributes:
        root: Path of the folder.
        shifted: Number of pictures that were written.
        clouds: Number of point clouds that were written.
        linked: Number of other files.
        labels: Number of images among these, which lie in folders of labels.
        applied: Share of the pictures that the shift changed.
        reasons: Reasons of failed pictures, one line each.
    """

    root: Path
    shifted: int
    clouds: int
    linked: int
    labels: int
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
    """One picture or point cloud under one shift: the unit of work of a worker.

    Attributes:
        file: The clean file.
        root: Folder of the shifted file.
        spec: The shift; its severity is arbitrary under `random`.
        random: Whether the severity is drawn for each picture.
        quality, subsampling: See `shift_pictures`.
    """

    file: FolderFile
    root: Path
    spec: ShiftSpec
    random: bool
    quality: int
    subsampling: str

    @property
    def target(self) -> Path:
        """Path of the shifted file."""
        return self.root / self.file.key


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
        settings: seed, calibration, quality, subsampling, and lidar (whether point clouds are shifted too).
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
    files = list_folder(source)
    selected_kinds = ("image", "points", "refused") if settings["lidar"] else ("image", "refused")
    selected_files = [file for file in files if file.kind in selected_kinds]
    if not any(file.kind in ("image", "points") for file in selected_files):
        raise ConfigError(f"{source}: no nuScenes folder, and no picture ({FORMAT_NAMES}) in it")
    conditions = {out / f"{name}-{strength}": (name, strength) for name in shifts for strength in severities}
    identity = {"source": str(source), "version": VERSIONS[settings["calibration"]], "layout": LAYOUT, **settings}
    for root in conditions:
        if root.exists() and not (out / RUN).is_file():
            raise StoreError(f"{root}: holds something else; choose another OUT")
    with Store.open(
        out, {"identity": identity, "suite": {"name": "ssad shift", **identity}}, retry=True, command="ssad shift"
    ) as store:
        tasks = [
            _make_task(file, root, condition=condition, settings=settings)
            for root, condition in conditions.items()
            for file in selected_files
        ]
        for root in conditions:
            folder_names = {os.path.dirname(file.key) for file in files}
            check_folders(root, folder_names, source)
            for folder_name in folder_names:
                check_links_above(root / folder_name, root=out, itself=True)
        for folder in {task.target.parent for task in tasks}:
            remove_unfinished(folder)
        missing = [task for task in tasks if _task_name(task) not in store.results or not _is_written(task)]
        failures: dict[str, dict[str, Any]] = {}
        with open_pool(len(missing), workers=workers, ray=ray) as pool:
            for task in missing:
                pool.add(Task(_shift_file, task, PICTURE_S, label=task))
            for finished, outcome in enumerate(pool.outcomes(), 1):
                task = outcome.task.label
                record = outcome.value or {"status": outcome.status, "reason": outcome.reason}
                if record["status"] != "ok":
                    # Whatever lies there is no shifted version of this file.
                    task.target.unlink(missing_ok=True)
                    failures[_task_name(task)] = record
                # Else only the file was missing, and its record stands, unless the file cannot be made any more.
                if _task_name(task) not in store.results:
                    store.append({"key": _task_name(task), **record}, None)
                progress(len(tasks) - len(missing) + finished, len(tasks))
        return [
            _finish_folder(root, files, settings=identity, condition=condition, results={**store.results, **failures})
            for root, condition in conditions.items()
        ]


def _make_task(
    file: FolderFile, root: Path, *, condition: tuple[str, Strength], settings: Mapping[str, Any]
) -> ShiftTask:
    shift, strength = condition
    spec = ShiftSpec(
        shift, 1 if strength == "random" else int(strength), seed=settings["seed"], calibration=settings["calibration"]
    )
    return ShiftTask(file, root.absolute(), spec, strength == "random", settings["quality"], settings["subsampling"])


def _task_name(task: ShiftTask) -> str:
    return f"{task.root.name}/{task.file.key}"


def _is_written(task: ShiftTask) -> bool:
    """Return whether the shifted file exists. A link is none, but for a point cloud that its shift does not change."""
    return task.target.is_file() and (task.file.kind == "points" or not task.target.is_symlink())


def _shift_file(task: ShiftTask) -> dict[str, Any]:
    """In a worker: shift one file; what is recorded of it."""
    moment = task.file.moment
    spec = replace(task.spec, severity=random_severity(task.spec, moment, moment)) if task.random else task.spec
    start_warp_quietly()
    try:
        if task.file.kind == "refused":
            raise StoreError(task.file.target)
        make_folder(task.target.parent)
        report, notes = _shift_points(task, spec) if task.file.kind == "points" else _shift_image(task, spec)
    except SSADError as error:
        reason = str(error).removeprefix(f"{task.file.path}: ")
        return {"status": "failed", "severity": spec.severity, "reason": reason}
    record = {"applied": report.applied, "details": dict(report.details), "skipped": dict(report.skipped)}
    return {"status": "ok", "severity": spec.severity, "kind": task.file.kind, **record, "notes": notes}


def _shift_image(task: ShiftTask, spec: ShiftSpec) -> tuple[ShiftReport, list[str]]:
    """Write a shifted image; return the report of the shift and the conversions of the file."""
    image_file = read_image_file(task.file.path)
    check_writable(image_file)
    image = image_file.rgb
    frame = Frame(camera_of(task.file.path, image), scene=task.file.key, sample=task.file.key)
    shifted, (report,) = shift_images(image, [frame], spec)
    chroma = task.subsampling
    if chroma == "auto":  # 420 averages the chroma of neighbours, which would weaken noise
        chroma = "444" if spec.family == "sensor" else "420"
    write_atomic(task.target, encode_like(image_file, shifted, quality=task.quality, subsampling=chroma))
    notes = [f"shifted upright, stored with EXIF orientation {image_file.orientation}"] * (image_file.orientation != 1)
    notes += ["16 bits: the upper eight are shifted"] * image_file.has_16_bits
    notes += ["CMYK: shifted as RGB without a colour profile"] * (image_file.model == "CMYK")
    return report, notes


def _shift_points(task: ShiftTask, spec: ShiftSpec) -> tuple[ShiftReport, list[str]]:
    """Write a shifted point cloud, or link it where its shift changes cameras alone; see `_shift_image`."""
    point_file = read_point_file(task.file.path, columns=task.file.point_columns)
    frame = SweepFrame(scene=task.file.key, sample=task.file.key)
    points, report = shift_points(point_file.points, frame, spec)
    if not report.applied and report.skipped:
        _link(task.file.path, task.target)
    else:
        write_atomic(task.target, encode_points_like(point_file, points))
    notes = [f"fields left out: {', '.join(point_file.dropped_fields)}"] * bool(point_file.dropped_fields)
    notes += [f"{point_file.dropped_points} points without a place left out"] * bool(point_file.dropped_points)
    return report, notes


def _link(destination: Path | str, link: Path) -> None:
    """Put a symbolic link in place of whatever is there. StoreError."""
    try:
        if link.is_symlink() and os.readlink(link) == str(destination):
            return
        link.unlink(missing_ok=True)
        os.symlink(destination, link)
    except OSError as error:
        raise StoreError(f"{link}: cannot be written: {error.strerror or error}") from None


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
            if not np.isfinite(matrix).all():
                break
            return replace(camera, intrinsic=matrix)
    raise ConfigError(f"{calibration}: no line '{matrix_name}:' with 12 numbers")


def _finish_folder(
    root: Path,
    files: Sequence[FolderFile],
    *,
    settings: Mapping[str, Any],
    condition: tuple[str, Strength],
    results: Mapping[str, Mapping[str, Any]],
) -> ShiftedFolder:
    """Link what is not shifted, say what was done, and count."""
    folder_records = {
        key.removeprefix(f"{root.name}/"): line for key, line in results.items() if key.startswith(f"{root.name}/")
    }
    linked_files = [file for file in files if file.key not in folder_records and file.kind != "link"]
    for file in linked_files:
        make_folder((root / file.key).parent)
        _link(file.path, root / file.key)
    # The store is in the order of completion; sorting makes the manifest independent of it.
    manifest_lines = [{**folder_records[key], "key": key} for key in sorted(folder_records)]
    for file in files:
        if file.kind == "link":
            line = _link_inside(root, file, condition[1])
            manifest_lines += [] if line is None else [line]
    write_atomic(make_folder(root) / LINES, "".join(dump_json(line) + "\n" for line in manifest_lines))
    write_atomic(root / PAGE, dump_json({"shift": condition[0], "severity": condition[1], **settings}, indent=1) + "\n")
    successes = [line for line in manifest_lines if line["status"] == "ok"]
    images = [line for line in successes if line["kind"] == "image"]
    reasons = tuple(f"{line['key']}: {line['reason']}" for line in manifest_lines if line["status"] != "ok")
    applied = sum(bool(line["applied"]) for line in images) / max(len(images), 1)
    label_count = sum(file.kind == "label" for file in linked_files)
    return ShiftedFolder(
        root, len(images), len(successes) - len(images), len(linked_files), label_count, applied, reasons
    )


def _link_inside(root: Path, file: FolderFile, severity: Strength) -> dict[str, Any] | None:
    """Repeat a link of the clean folder in the shifted one, where it leads to the shifted file.

    Returns:
        The manifest line of a link whose file failed; None for others.
    """
    link, destination = root / file.key, root / file.target
    if file.path.is_dir():
        make_folder(destination)  # it may be empty
    if not destination.exists():
        link.unlink(missing_ok=True)
        reason = f"a symbolic link to {file.target}, which was not shifted"
        return {"key": file.key, "status": "failed", "severity": severity, "reason": reason}
    make_folder(link.parent)
    _link(os.path.relpath(destination, link.parent), link)
    return None

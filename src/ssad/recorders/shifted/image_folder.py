"""`ssad shift` on a folder of pictures that is no nuScenes root, such as KITTI's or COCO's: each picture by itself.

Of a picture nothing is known but, in KITTI, the camera matrix (`calib/NUMBER.txt` beside `image_2`). A typical camera,
level on a flat road, is assumed of others. So what needs boxes or depth of the scene is refused: the object shifts, and
objects that are placed. All that is no picture (labels, calibration, LiDAR) is linked: LiDAR points stay clean.
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
from ssad.core.machine import quiet_warp
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
PICTURE_S = 600.0  # s that a picture may take
KITTI = {"image_2": "P2", "image_3": "P3"}


@dataclass(frozen=True)
class ShiftedFolder:
    """A written folder.

    Attributes:
        root: Where it is.
        shifted: Number of pictures that were written.
        linked: Number of other files.
        applied: Share of the pictures that the shift has changed.
        reasons: Why pictures failed, a line each.
    """

    root: Path
    shifted: int
    linked: int
    applied: float
    reasons: tuple[str, ...]


def picture_shifts(names: Sequence[str]) -> tuple[str, ...]:
    """Those of some shifts that pictures alone can have; "all" was resolved to the paper's 11 before.

    Raises:
        ConfigError: A shift needs boxes of the scene, and was asked for by name.
    """
    possible = tuple(name for name in names if KNOWN[name][0] != "object" and name not in PLACING)
    missing = [name for name in names if name not in possible]
    if missing and set(names) != set(SHIFTS):
        raise ConfigError(
            f"{missing[0]} needs boxes in space, which pictures alone do not have; take a nuScenes folder, "
            "or one picture with --box"
        )
    return possible


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture under one shift: what a worker is given.

    Attributes:
        path: Where it is.
        key: Its name in the folder.
        root: Folder of the new one.
        spec: The shift; under `random` with any severity.
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
    """Write OUT/SHIFT-SEVERITY with the files of a folder, its pictures shifted; goes on where it was stopped.

    The bytes depend neither on the number of workers nor on the cluster. OUT also holds the record of the work, as the
    results folder of a run does.

    Args:
        source: Folder with pictures in it, however deep.
        out: Folder of the new ones.
        shifts: See `picture_shifts`.
        severities: 1 to 5, or "random": drawn for each picture.
        settings: seed, calibration, quality, subsampling.
        workers: Number of processes; None: one for each core; 0: all in this process.
        ray: Address of a cluster that sees the same folders.
        progress: Called with the number of pictures that are done, and of all.

    Returns:
        One entry a folder.

    Raises:
        ConfigError: There is no picture, or OUT lies in the source.
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
    told = {"source": str(source), "version": VERSIONS[settings["calibration"]], **settings}
    for root in conditions:
        if root.exists() and not (out / RUN).is_file():
            raise StoreError(f"{root}: holds something else; choose another OUT")
    with Store.open(
        out, {"identity": told, "suite": {"name": "ssad shift", **told}}, retry=True, what="ssad shift"
    ) as store:
        wanted = [
            _picture(path, source, root, how=how, settings=settings)
            for root, how in conditions.items()
            for path in pictures
        ]
        for folder in {(one.root / one.key).parent for one in wanted}:
            remove_unfinished(folder)
        missing = [one for one in wanted if _name(one) not in store.results or not (one.root / one.key).is_file()]
        with open_pool(len(missing), workers=workers, ray=ray) as pool:
            for one in missing:
                pool.add(Task(_written, one, PICTURE_S, label=one))
            for done, outcome in enumerate(pool.outcomes(), 1):
                one = outcome.task.label
                record = outcome.value or {"status": outcome.status, "reason": outcome.reason}
                if _name(one) not in store.results:  # else only the file was missing
                    store.append({"key": _name(one), **record}, None)
                progress(len(wanted) - len(missing) + done, len(wanted))
        return [_ended(root, source, files, told=told, how=how, done=store.results) for root, how in conditions.items()]


def _picture(
    path: Path, source: Path, root: Path, *, how: tuple[str, Strength], settings: Mapping[str, Any]
) -> Picture:
    shift, strength = how
    spec = ShiftSpec(
        shift, 1 if strength == "random" else int(strength), seed=settings["seed"], calibration=settings["calibration"]
    )
    return Picture(
        path,
        path.relative_to(source).as_posix(),
        root.absolute(),
        spec,
        strength == "random",
        settings["quality"],
        settings["subsampling"],
    )


def _name(one: Picture) -> str:
    return f"{one.root.name}/{one.key}"


def _written(one: Picture) -> dict[str, Any]:
    """In a worker: shift one picture; what is recorded of it."""
    spec = replace(one.spec, severity=random_severity(one.spec, one.key, one.key)) if one.random else one.spec
    quiet_warp()
    try:
        image = read_image(one.path)
        frame = Frame(camera_of(one.path, image), scene=one.key, sample=one.key)
        shifted, (done,) = shift_images(image, [frame], spec)
        make_folder((one.root / one.key).parent)
        write_atomic(one.root / one.key, _encoded(shifted, one))
    except SSADError as error:
        return {"status": "failed", "severity": spec.severity, "reason": str(error)}
    about = {"applied": done.applied, "details": dict(done.details), "skipped": dict(done.skipped)}
    return {"status": "ok", "severity": spec.severity, **about}


def _encoded(image: U8, one: Picture) -> bytes:
    if one.path.suffix.lower() not in JPEG:
        return bytes(cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes())
    chroma = one.subsampling
    if chroma == "auto":  # 420 would weaken noise
        chroma = "444" if one.spec.family == "sensor" else "420"
    return encode_jpeg(image, one.quality, chroma)


def camera_of(path: Path, image: U8) -> Camera:
    """The camera of a picture: that of KITTI's calibration where it lies beside, else a typical one.

    Raises:
        ConfigError: The calibration has no such camera.
    """
    camera = Camera.typical(image.shape[1], image.shape[0])
    calibration = path.parent.parent / "calib" / f"{path.stem}.txt"
    if path.parent.name not in KITTI or not calibration.is_file():
        return camera
    name = KITTI[path.parent.name]
    for line in read_text(calibration).splitlines():
        key, _, numbers = line.partition(":")
        if key.strip() == name:
            try:
                matrix = np.array(numbers.split(), np.float64).reshape(3, 4)[:, :3]
            except ValueError:
                break
            return replace(camera, intrinsic=matrix)
    raise ConfigError(f"{calibration}: no line '{name}:' with 12 numbers")


def _ended(
    root: Path,
    source: Path,
    files: Sequence[Path],
    *,
    told: Mapping[str, Any],
    how: tuple[str, Strength],
    done: Mapping[str, Mapping[str, Any]],
) -> ShiftedFolder:
    """Link what is no picture, say what was done, and count."""
    linked = 0
    for path in files:
        target = root / path.relative_to(source)
        if path.suffix.lower() in PICTURES:
            continue
        linked += 1
        if not target.is_symlink():
            make_folder(target.parent)
            os.symlink(path, target)
    own = {key.removeprefix(f"{root.name}/"): line for key, line in done.items() if key.startswith(f"{root.name}/")}
    lines = [{**own[key], "key": key} for key in sorted(own)]
    write_atomic(make_folder(root) / LINES, "".join(dump_json(line) + "\n" for line in lines))
    write_atomic(root / PAGE, dump_json({"shift": how[0], "severity": how[1], **told}, indent=1) + "\n")
    good = [line for line in lines if line["status"] == "ok"]
    reasons = tuple(f"{line['key']}: {line['reason']}" for line in lines if line["status"] != "ok")
    applied = sum(bool(line["applied"]) for line in good) / max(len(good), 1)
    return ShiftedFolder(root, len(good), linked, applied, reasons)

"""`ssad shift` on a folder of pictures that is no nuScenes root, such as KITTI's or COCO's: each picture by itself.

Of a picture nothing is known but, in KITTI, the camera matrix (`calib/NUMBER.txt` beside `image_2`). A typical camera,
level on a flat road, is assumed of others. So what needs boxes or depth of the scene is refused: the object shifts, and
objects that are placed. All that is no picture (labels, calibration, LiDAR) is linked: LiDAR points stay clean.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ssad.core.errors import ConfigError, SSADError, StoreError
from ssad.core.frames import Camera, Frame
from ssad.core.images import encode_jpeg, read_image
from ssad.core.jsonl import read_lines
from ssad.core.safeio import dump_json, make_folder, read_json, read_text, write_atomic
from ssad.core.types import U8
from ssad.scenarios.static.shifts import KNOWN, SHIFTS, VERSIONS, ShiftSpec, random_severity, shift_images
from ssad.scenarios.static.shifts.spec import PLACING
from ssad.toolbox.options import Strength

PICTURES = (".jpg", ".jpeg", ".png")
JPEG, PAGE, LINES = (".jpg", ".jpeg"), "manifest.json", "manifest.jsonl"
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


def shift_pictures(
    source: Path, out: Path, *, shifts: Sequence[str], severities: Sequence[Strength], settings: Mapping[str, Any],
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[ShiftedFolder]:  # fmt: skip
    """Write OUT/SHIFT-SEVERITY with the files of a folder, its pictures shifted; goes on where it was stopped.

    Args:
        source: Folder with pictures in it, however deep.
        out: Folder of the new ones.
        shifts: See `picture_shifts`.
        severities: 1 to 5, or "random": drawn for each picture.
        settings: seed, calibration, quality, subsampling.
        progress: Called with the number of pictures that are done, and of all.

    Returns:
        One entry a folder.

    Raises:
        ConfigError: There is no picture, or OUT lies in the source.
        StoreError: A folder holds the same shift with other settings, or cannot be written.
    """
    if out.resolve().is_relative_to(source.resolve()):
        raise ConfigError(f"{out}: lies in {source}, which it would become a part of; give another OUT")
    files = sorted(path for path in source.rglob("*") if path.is_file())
    pictures = [path for path in files if path.suffix.lower() in PICTURES]
    if not pictures:
        raise ConfigError(f"{source}: no nuScenes folder, and no picture (.jpg, .png) in it")
    conditions = [(name, strength) for name in shifts for strength in severities]
    written, total = [], len(pictures) * len(conditions)
    for number, (name, strength) in enumerate(conditions):
        first = 1 if strength == "random" else int(strength)
        spec = ShiftSpec(name, first, seed=settings["seed"], calibration=settings["calibration"])
        told = {"shift": name, "severity": strength, "version": VERSIONS[spec.calibration], **settings}
        root = _begun(out / f"{name}-{strength}", told)
        done = {line["key"] for line in read_lines(root / LINES)}
        with (root / LINES).open("a") as lines:
            for place, path in enumerate(pictures):
                relative = path.relative_to(source).as_posix()
                if relative not in done or not (root / relative).is_file():
                    line = _written(path, relative, root, spec=spec, told=told)
                    lines.write(dump_json(line) + "\n")
                    lines.flush()
                progress(number * len(pictures) + place + 1, total)
        written.append(_ended(root, source, files))
    return written


def _begun(root: Path, told: Mapping[str, Any]) -> Path:
    """The folder of a condition, new or with the same settings."""
    if (root / PAGE).is_file():
        if read_json(root / PAGE) != told:
            raise StoreError(f"{root}: holds this shift with other settings; choose another OUT or remove it")
        return root
    if root.exists() and any(root.iterdir()):
        raise StoreError(f"{root}: holds something else; choose another OUT")
    make_folder(root)
    write_atomic(root / PAGE, dump_json(dict(told), indent=1) + "\n")
    return root


def _written(
    path: Path, relative: str, root: Path, *, spec: ShiftSpec, told: Mapping[str, Any]
) -> dict[str, Any]:  # fmt: skip
    """Shift one picture; its line for the manifest."""
    if told["severity"] == "random":
        spec = replace(spec, severity=random_severity(spec, relative, relative))
    line: dict[str, Any] = {"key": relative, "severity": spec.severity}
    try:
        image = read_image(path)
        frame = Frame(camera_of(path, image), scene=relative, sample=relative)
        shifted, (done,) = shift_images(image, [frame], spec)
        make_folder((root / relative).parent)
        write_atomic(root / relative, _encoded(shifted, path.suffix.lower(), told=told, spec=spec))
    except SSADError as error:
        return line | {"failed": str(error)}
    return line | {"applied": done.applied, "details": dict(done.details), "skipped": dict(done.skipped)}


def _encoded(image: U8, suffix: str, *, told: Mapping[str, Any], spec: ShiftSpec) -> bytes:
    if suffix not in JPEG:
        return bytes(cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes())
    chroma = told["subsampling"]
    if chroma == "auto":  # 420 would weaken noise
        chroma = "444" if spec.family == "sensor" else "420"
    return encode_jpeg(image, told["quality"], chroma)


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


def _ended(root: Path, source: Path, files: Sequence[Path]) -> ShiftedFolder:
    """Link what is no picture, and count."""
    latest = {line["key"]: line for line in read_lines(root / LINES)}
    linked = 0
    for path, target in _others(files, source, root):
        linked += 1
        if not target.is_symlink():
            make_folder(target.parent)
            os.symlink(path.resolve(), target)
    good = [line for line in latest.values() if "failed" not in line]
    reasons = tuple(f"{line['key']}: {line['failed']}" for line in latest.values() if "failed" in line)
    applied = sum(bool(line["applied"]) for line in good) / max(len(good), 1)
    return ShiftedFolder(root, len(good), linked, applied, reasons)


def _others(files: Sequence[Path], source: Path, root: Path) -> Iterator[tuple[Path, Path]]:
    for path in files:
        if path.suffix.lower() not in PICTURES:
            yield path, root / path.relative_to(source)

"""`ssad shift` and `ssad score`: parse the options, show progress, print the result."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from rich.console import Console

from ssad.core.errors import ConfigError, FormatError, StoreError, unknown_name
from ssad.core.wording import counted
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.splits import scenes_of_split
from ssad.datasets.nuscenes.truth import GroundTruth
from ssad.engine.progress import LiveProgress
from ssad.recorders.shifted.contact_sheet import parse_box, write_sheets
from ssad.recorders.shifted.image_folder import picture_shifts, shift_pictures
from ssad.recorders.shifted.manifest import PAGE, check_manifest, manifest_digest, read_manifest, verify
from ssad.recorders.shifted.options import SUBSAMPLING, Options, Strength
from ssad.recorders.shifted.write import write_shifted_roots
from ssad.scenarios.static.shifts import KNOWN, SHIFTS, Calibration


def severities(severity_list: str) -> tuple[Strength, ...]:
    """Parse the severities of --severity, such as "1,3" or "random".

    Raises:
        ConfigError: A part is neither a severity nor "random".
    """
    result: list[Strength] = []
    for severity_text in (item.strip() for item in severity_list.split(",")):
        if severity_text == "random":
            result.append("random")
        elif severity_text in ("0", "1", "2", "3", "4", "5"):
            result.append(int(severity_text))
        else:
            raise ConfigError(f"--severity {severity_list}: expected comma-separated numbers from 1 to 5, or random")
    return tuple(dict.fromkeys(result))


def shift_names(names: Sequence[str]) -> tuple[str, ...]:
    """Resolve the names of --shifts; ["all"] means the shifts of the paper.

    Raises:
        UnknownNameError: A shift does not exist.
    """
    if list(names) == ["all"]:
        return tuple(SHIFTS)
    for name in names:
        if name not in KNOWN:
            raise unknown_name("shift", name, KNOWN)
    return tuple(dict.fromkeys(names))


def shift_folder(
    source: Path,
    out: Path,
    *,
    shifts: Sequence[str],
    severity: str,
    version: str | None,
    split: str | None,
    scenes: Sequence[str],
    workers: int | None,
    ray: str | None,
    settings: Mapping[str, Any],
) -> int:
    """Write nuScenes-N and print one line for each root.

    Args:
        source: The nuScenes root.
        out: Folder of the roots.
        shifts: See `shift_names`.
        severity: See `severities`.
        version: Version of the dataset; None: the only one.
        split: Split whose scenes are written; None: no split.
        scenes: Names of the scenes.
        workers: See `write_shifted_roots`.
        ray: See `write_shifted_roots`.
        settings: Further fields of `Options`.

    Returns:
        The exit code.

    Raises:
        ConfigError: See `write_shifted_roots`.
        FormatError: See `write_shifted_roots`.
        StoreError: See `write_shifted_roots`.
    """
    with NuScenes(source, version) as data:
        scene_names = tuple(scenes) or (tuple(scenes_of_split(source, data.version, split)) if split else ())
        version = data.version
        if split:
            # An official split may name scenes that this version does not have.
            available = {record.name for record in data.scenes()}
            scene_names = tuple(name for name in scene_names if name in available)
            if not scene_names:
                raise ConfigError(
                    f"{source}: version {version} has no scene of the split '{split}'; choose another --split"
                )
    options = Options(source, out, version, shift_names(shifts), severities(severity), scenes=scene_names, **settings)
    try:
        with LiveProgress("shift", 1, 0, console=Console(stderr=True), unit="scenes") as display:
            roots = write_shifted_roots(options, workers=workers, ray=ray, progress=display.show)
    except KeyboardInterrupt:
        print(f"stopped; finished files are kept in {out}; repeat the command to resume", file=sys.stderr)
        return 130
    failure_count = 0
    for root in roots:
        failure_count += root.failed
        report = f"{root.root}: {root.shifted} files shifted, {root.linked} linked unchanged, "
        report += f"{100 * root.applied:.0f} % of the images changed"
        print(report + (f", {root.failed} failed" if root.failed else ""))
        for reason in root.reasons[:3]:
            print(f"  {reason}")
        if len(root.reasons) > 3:
            print(f"  ... and {len(root.reasons) - 3} more: see {root.root / 'manifest'}")
    if failure_count:
        print(
            f"{counted(failure_count, 'file')} failed, so their roots are incomplete and cannot be scored; "
            "fix these files in the dataset and repeat the command"
        )
    return int(failure_count > 0)


def shift_picture_folder(
    source: Path,
    out: Path,
    *,
    shifts: Sequence[str],
    severity: str,
    workers: int | None,
    ray: str | None,
    settings: Mapping[str, Any],
) -> int:
    """Shift the pictures of a folder that is not a nuScenes root, and print one line for each new folder.

    Args:
        source: The folder.
        out: Folder of the new folders.
        shifts: See `shift_names`.
        severity: See `severities`.
        workers: See `shift_pictures`.
        ray: See `shift_pictures`.
        settings: See `shift_pictures`.

    Returns:
        The exit code.

    Raises:
        SSADError: See `shift_pictures`.
    """
    if settings["calibration"] not in get_args(Calibration):
        raise unknown_name("calibration", settings["calibration"], get_args(Calibration))
    if settings["subsampling"] not in SUBSAMPLING:
        raise unknown_name("subsampling", settings["subsampling"], SUBSAMPLING)
    possible_shifts, strengths = picture_shifts(shift_names(shifts)), severities(severity)
    try:
        with LiveProgress("shift", 1, 0, console=Console(stderr=True), unit="pictures") as display:
            folders = shift_pictures(
                source,
                out,
                shifts=possible_shifts,
                severities=strengths,
                settings=settings,
                workers=workers,
                ray=ray,
                progress=display.show,
            )
    except KeyboardInterrupt:
        print(f"stopped; finished files are kept in {out}; repeat the command to resume", file=sys.stderr)
        return 130
    skipped_shifts = [name for name in shift_names(shifts) if name not in possible_shifts]
    if skipped_shifts:
        print(f"left out, since they need boxes in space: {', '.join(skipped_shifts)}")
    for folder in folders:
        report = f"{folder.root}: {counted(folder.shifted, 'picture')} shifted, "
        report += f"{counted(folder.clouds, 'point cloud')} shifted, " if folder.clouds else ""
        report += f"{counted(folder.linked, 'other file')} linked unchanged, "
        report += f"{folder.labels} of them images in folders of labels, " if folder.labels else ""
        report += f"{100 * folder.applied:.0f} % of the pictures changed"
        print(report + (f", {len(folder.reasons)} failed and left out" if folder.reasons else ""))
        for reason in folder.reasons[:10]:
            print(f"  {reason}")
        if len(folder.reasons) > 10:
            print(f"  ... and {len(folder.reasons) - 10} more: see {folder.root / 'manifest.jsonl'}")
    return int(any(folder.reasons for folder in folders))


def verify_folder(out: Path) -> int:
    """Compare a root, or all roots in a folder, with their manifests.

    Returns:
        The exit code: 1 if files differ.

    Raises:
        StoreError: The folder holds no root, or a root cannot be read.
    """
    roots = [out] if (out / PAGE).is_file() or (out / "manifest").is_dir() else sorted(out.glob("*/manifest"))
    # An incomplete root has no manifest.json yet, so roots are found by their manifest folders.
    roots = [root.parent if root.name == "manifest" and root != out else root for root in roots]
    if not roots:
        raise StoreError(f"{out}: not written by ssad shift; give its OUT folder, or one root in it")
    mismatch_count = 0
    for root in roots:
        file_count, problems = verify(root)
        mismatch_count += len(problems)
        print(f"{root}: {counted(file_count, 'file')}, {len(problems)} differ from the manifest")
        for problem in problems[:5]:
            print(f"  {problem}")
    return int(mismatch_count > 0)


def write_contact_sheets(
    source: Path,
    out: Path,
    *,
    shifts: Sequence[str],
    version: str | None,
    channel: str,
    split: str | None,
    scenes: Sequence[str],
    boxes: Sequence[str],
    severity: str,
    seed: int,
    calibration: str,
) -> None:
    """Write two contact sheets of an image, or of one camera of a dataset.

    Args:
        source: The image, or a nuScenes root.
        out: Output folder of the sheets.
        shifts: See `shift_names`.
        version: Version of the dataset; None: the only one.
        channel: Name of the camera.
        split: Must be None: a contact sheet has no split.
        scenes: Name of the scene, at most one, for a dataset; none: the first.
        boxes: Boxes in the image, see `parse_box`.
        severity: See `severities`; the first one is used.
        seed: Seed of the shifts.
        calibration: Calibration of the shifts.

    Raises:
        ConfigError: The arguments do not fit together.
        SSADError: The image or the dataset cannot be read, or a sheet cannot be written.
    """
    if split is not None or (scenes and source.is_file()):
        raise ConfigError(
            f"{'--split' if split is not None else '--scenes'} cannot be used for a contact sheet of {source}"
        )
    if len(scenes) > 1:
        raise ConfigError(f"a contact sheet shows one scene, not {len(scenes)}; give one, such as --scenes {scenes[0]}")
    if calibration not in get_args(Calibration):
        raise unknown_name("calibration", calibration, get_args(Calibration))
    strength = severities(severity)[0]
    rectangles = [parse_box(text) for text in boxes]
    severity_level = 3 if strength == "random" else int(strength)
    checked_calibration: Calibration = "paper" if calibration == "paper" else "physical"
    shift_sheet, severity_sheet = write_sheets(
        source,
        out,
        version=version,
        channel=channel,
        scene=next(iter(scenes), None),
        boxes=rectangles,
        severity=severity_level,
        seed=seed,
        calibration=checked_calibration,
        shifts=shift_names(shifts),
    )
    print(f"shifts: {shift_sheet}\nseverities: {severity_sheet}")


def checked(dataset_root: Path) -> Callable[[dict[str, Any], GroundTruth], dict[str, Any]]:
    """Return a check for `score_results` that refuses to score clean data as shifted, or shifted data as clean.

    A shifted root must match its manifest. Results may name the data they were made on (`ssad_manifest` in
    their meta); these must then be the same data. The check returns a description of the data.
    """

    def check(meta: dict[str, Any], truth: GroundTruth) -> dict[str, Any]:
        stated_digest = meta.get("ssad_manifest")
        if read_manifest(dataset_root) is None:
            if stated_digest not in (None, "clean"):
                raise FormatError(
                    f"the results were made on shifted data (manifest {stated_digest}), but {dataset_root} is a clean "
                    "dataset; give the shifted folder as --dataroot"
                )
            return {"data": "clean"}
        manifest = check_manifest(dataset_root, truth.scenes)
        actual_digest = manifest_digest(dataset_root)
        if stated_digest is not None and stated_digest != actual_digest:
            stated_data = "clean data" if stated_digest == "clean" else f"other data (manifest {stated_digest})"
            raise FormatError(
                f"the results were made on {stated_data}, not on {dataset_root} (manifest {actual_digest}); "
                "give the data that they were made on as --dataroot"
            )
        assert manifest is not None
        return {"data": "shifted", "manifest": actual_digest, "stated": stated_digest is not None} | dict(
            manifest["identity"]
        )

    return check

"""`ssad shift` and `ssad score`: parse the options, show progress, print the outcome."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from rich.console import Console

from ssad.core.errors import ConfigError, FormatError, StoreError, unknown_name
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.splits import scenes_of_split
from ssad.datasets.nuscenes.truth import GroundTruth
from ssad.engine.progress import Live
from ssad.recorders.shifted.contact_sheet import parse_box, write_sheets
from ssad.recorders.shifted.image_folder import picture_shifts, shift_pictures
from ssad.recorders.shifted.manifest import PAGE, check_manifest, manifest_digest, read_manifest, verify
from ssad.recorders.shifted.options import SUBSAMPLING, Options, Strength
from ssad.recorders.shifted.write import materialise
from ssad.scenarios.static.shifts import KNOWN, SHIFTS, Calibration


def severities(text: str) -> tuple[Strength, ...]:
    """Severities from the text of --severity, such as "1,3" or "random".

    Raises:
        ConfigError: The text is neither.
    """
    found: list[Strength] = []
    for part in (p.strip() for p in text.split(",")):
        if part == "random":
            found.append("random")
        elif part in ("0", "1", "2", "3", "4", "5"):
            found.append(int(part))
        else:
            raise ConfigError(f"--severity {text}: expected comma-separated numbers from 1 to 5, or random")
    return tuple(dict.fromkeys(found))


def shift_names(names: Sequence[str]) -> tuple[str, ...]:
    """The shifts of --shifts; ["all"] means those of the paper.

    Raises:
        UnknownNameError: There is no such shift.
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
        split: Split whose scenes are written; None: none is chosen.
        scenes: Names of the scenes.
        workers: See `materialise`.
        ray: See `materialise`.
        settings: Further fields of `Options`.

    Returns:
        The exit code.

    Raises:
        ConfigError: See `materialise`.
        FormatError: See `materialise`.
        StoreError: See `materialise`.
    """
    with NuScenes(source, version) as data:
        chosen = tuple(scenes) or (tuple(scenes_of_split(source, data.version, split)) if split else ())
        version = data.version
        if split:
            known = {record.name for record in data.scenes()}
            chosen = tuple(name for name in chosen if name in known)
            if not chosen:
                raise ConfigError(
                    f"{source}: version {version} has no scene of the split '{split}'; choose another --split"
                )
    options = Options(source, out, version, shift_names(shifts), severities(severity), scenes=chosen, **settings)
    try:
        with Live("shift", 1, 0, console=Console(stderr=True), unit="scenes") as live:
            written = materialise(options, workers=workers, ray=ray, progress=live.show)
    except KeyboardInterrupt:
        print(f"stopped; finished files are kept in {out}; repeat the command to resume", file=sys.stderr)
        return 130
    failed = 0
    for root in written:
        failed += root.failed
        line = f"{root.root}: {root.shifted} files shifted, {root.linked} linked unchanged, "
        line += f"{100 * root.applied:.0f} % of the images changed"
        print(line + (f", {root.failed} failed" if root.failed else ""))
        for reason in root.reasons[:3]:
            print(f"  {reason}")
        if len(root.reasons) > 3:
            print(f"  ... and {len(root.reasons) - 3} more: see {root.root / 'manifest'}")
    if failed:
        print(
            f"{failed} files failed, so their roots are incomplete and cannot be scored; "
            "fix these files in the dataset and repeat the command"
        )
    return int(failed > 0)


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
    """Shift the pictures of a folder that is no nuScenes root, and print one line for each new folder.

    Args:
        source: The folder.
        out: Folder of the new ones.
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
    chosen, strengths = picture_shifts(shift_names(shifts)), severities(severity)
    try:
        with Live("shift", 1, 0, console=Console(stderr=True), unit="pictures") as live:
            written = shift_pictures(
                source,
                out,
                shifts=chosen,
                severities=strengths,
                settings=settings,
                workers=workers,
                ray=ray,
                progress=live.show,
            )
    except KeyboardInterrupt:
        print(f"stopped; finished files are kept in {out}; repeat the command to resume", file=sys.stderr)
        return 130
    left_out = [name for name in shift_names(shifts) if name not in chosen]
    if left_out:
        print(f"left out, since they need boxes in space: {', '.join(left_out)}")
    for one in written:
        told = f"{one.root}: {one.shifted} pictures shifted, {one.linked} other files linked unchanged, "
        told += f"{100 * one.applied:.0f} % of the pictures changed"
        print(told + (f", {len(one.reasons)} failed" if one.reasons else ""))
        for reason in one.reasons[:3]:
            print(f"  {reason}")
    return int(any(one.reasons for one in written))


def verify_folder(out: Path) -> int:
    """Compare a root, or all roots in a folder, with their manifests; exit code 1 if files differ.

    Raises:
        StoreError: There is nothing to compare, or it cannot be read.
    """
    roots = [out] if (out / PAGE).is_file() or (out / "manifest").is_dir() else sorted(out.glob("*/manifest"))
    roots = [root.parent if root.name == "manifest" and root != out else root for root in roots]
    if not roots:
        raise StoreError(f"{out}: not written by ssad shift; give its OUT folder, or one root in it")
    bad = 0
    for root in roots:
        count, problems = verify(root)
        bad += len(problems)
        print(f"{root}: {count} files, {len(problems)} differ from the manifest")
        for problem in problems[:5]:
            print(f"  {problem}")
    return int(bad > 0)


def write_contact_sheets(
    source: Path,
    out: Path,
    *,
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
        out: Where the sheets are written.
        version: Version of the dataset; None: the only one.
        channel: Name of the camera.
        split: Must be None: a contact sheet is not of a split.
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
    level = 3 if strength == "random" else int(strength)
    kind: Calibration = "paper" if calibration == "paper" else "physical"
    first, second = write_sheets(
        source,
        out,
        version=version,
        channel=channel,
        scene=next(iter(scenes), None),
        boxes=rectangles,
        severity=level,
        seed=seed,
        calibration=kind,
    )
    print(f"all shifts: {first}\nall severities: {second}")


def checked(root: Path) -> Callable[[dict[str, Any], GroundTruth], dict[str, Any]]:
    """A check for `score_results` that refuses to score clean data as shifted, or the other way round.

    A shifted root must match its manifest. If the results name the data that they were made from (`ssad_manifest` in
    their meta), these must be the same data. The check returns what is known of the data.
    """

    def check(meta: dict[str, Any], truth: GroundTruth) -> dict[str, Any]:
        said = meta.get("ssad_manifest")
        if read_manifest(root) is None:
            if said not in (None, "clean"):
                raise FormatError(
                    f"the results were made on shifted data (manifest {said}), but {root} is a clean dataset; "
                    "give the shifted folder as --dataroot"
                )
            return {"data": "clean"}
        manifest = check_manifest(root, truth.scenes)
        mine = manifest_digest(root)
        if said is not None and said != mine:
            seen = "clean data" if said == "clean" else f"other data (manifest {said})"
            raise FormatError(
                f"the results were made on {seen}, not on {root} (manifest {mine}); "
                "give the data that they were made on as --dataroot"
            )
        assert manifest is not None
        return {"data": "shifted", "manifest": mine, "stated": said is not None} | dict(manifest["identity"])

    return check

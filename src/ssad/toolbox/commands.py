"""What `ssad shift` and `ssad score` do with the toolbox: options in words, progress, and what is printed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ssad.core.errors import ConfigError, FormatError, StoreError, unknown_name
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.splits import scenes_of_split
from ssad.datasets.nuscenes.truth import GroundTruth
from ssad.scenarios.static.shifts import SHIFTS, Calibration
from ssad.toolbox.contact_sheet import parse_box, write_sheets
from ssad.toolbox.manifest import PAGE, check_manifest, manifest_digest, read_manifest, verify
from ssad.toolbox.options import Options, Strength
from ssad.toolbox.write import materialise


def severities(text: str) -> tuple[Strength, ...]:
    """ "1,3", "random" -> severities. ConfigError."""
    found: list[Strength] = []
    for part in (p.strip() for p in text.split(",")):
        if part == "random":
            found.append("random")
        elif part in ("0", "1", "2", "3", "4", "5"):
            found.append(int(part))
        else:
            raise ConfigError(f"--severity {text}: expected 1 to 5 with commas between them, or random")
    return tuple(dict.fromkeys(found))


def shift_names(names: Sequence[str]) -> tuple[str, ...]:
    """Names, or all of them. UnknownNameError."""
    if list(names) == ["all"]:
        return tuple(SHIFTS)
    for name in names:
        if name not in SHIFTS:
            raise unknown_name("shift", name, SHIFTS)
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
    """Writes nuScenes-N and prints a line a root; 1 when files failed. ConfigError, FormatError, StoreError."""
    with NuScenes(source, version) as data:
        chosen = tuple(scenes) or (tuple(scenes_of_split(source, data.version, split)) if split else ())
        version = data.version
        if split:
            known = {record.name for record in data.scenes()}
            chosen = tuple(name for name in chosen if name in known)
            if not chosen:
                raise ConfigError(f"{source}: {version} holds no scene of the split '{split}'")
    options = Options(source, out, version, shift_names(shifts), severities(severity), scenes=chosen, **settings)
    columns = (TextColumn("shift"), BarColumn(), MofNCompleteColumn(), TextColumn("scenes"), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("shift", total=None)
        try:
            written = materialise(
                options, workers=workers, ray=ray, progress=lambda n, of: bar.update(task, completed=n, total=of)
            )
        except KeyboardInterrupt:
            bar.stop()
            print(f"stopped; what is done is kept in {out}: the same command goes on from there", file=sys.stderr)
            return 130
    failed = 0
    for root in written:
        failed += root.failed
        line = f"{root.root}: {root.shifted} files shifted, {root.linked} linked, "
        line += f"{100 * root.applied:.0f} % of the images changed"
        print(line + (f", {root.failed} FAILED" if root.failed else ""))
        for reason in root.reasons[:3]:
            print(f"  {reason}")
        if len(root.reasons) > 3:
            print(f"  ... and {len(root.reasons) - 3} more: see {root.root / 'manifest'}")
    if failed:
        print(
            f"{failed} files failed, so their roots are not complete; mend the dataset and run the same command again"
        )
    return int(failed > 0)


def verify_folder(out: Path) -> int:
    """Compares a root, or all roots of a folder, with their manifests; exit code 1 for differences. StoreError."""
    roots = [out] if (out / PAGE).is_file() or (out / "manifest").is_dir() else sorted(out.glob("*/manifest"))
    roots = [root.parent if root.name == "manifest" and root != out else root for root in roots]
    if not roots:
        raise StoreError(f"{out}: not written by ssad shift")
    bad = 0
    for root in roots:
        count, problems = verify(root)
        bad += len(problems)
        print(f"{root}: {count} files, {len(problems)} not as in the manifest")
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
    """Contact sheets of a picture or of a dataset's camera. ConfigError, SSADError."""
    if split is not None or (scenes and source.is_file()):
        raise ConfigError(
            f"{'--split' if split is not None else '--scenes'} does not go with a contact sheet of {source}"
        )
    if len(scenes) > 1:
        raise ConfigError(f"a contact sheet is of one scene, not of {len(scenes)}: --scenes {scenes[0]}")
    if calibration not in get_args(Calibration):
        raise unknown_name("calibration", calibration, get_args(Calibration))
    strength = severities(severity)[0]
    rectangles = [parse_box(text) for text in boxes]
    level = 3 if strength == "random" else int(strength)
    kind: Calibration = "paper" if calibration == "paper" else "physical"
    first, second = write_sheets(
        source, out, version=version, channel=channel, scene=next(iter(scenes), None), boxes=rectangles,
        severity=level, seed=seed, calibration=kind,
    )  # fmt: skip
    print(f"12 panels: {first}\nseverities: {second}")


def checked(root: Path) -> Callable[[dict[str, Any], GroundTruth], dict[str, Any]]:
    """A check for `score_results`: a shifted root must be what its manifest says, and the results, if they say which
    data they saw (`ssad_manifest` in their meta), must have seen these. Returns what is known of the data."""

    def check(meta: dict[str, Any], truth: GroundTruth) -> dict[str, Any]:
        said = meta.get("ssad_manifest")
        if read_manifest(root) is None:
            if said not in (None, "clean"):
                raise FormatError(f"the results were made on shifted data (manifest {said}), {root} is a clean dataset")
            return {"data": "clean"}
        manifest = check_manifest(root, truth.scenes)
        mine = manifest_digest(root)
        if said is not None and said != mine:
            seen = "clean data" if said == "clean" else f"other data (manifest {said})"
            raise FormatError(f"the results were made on {seen}, not on {root} (manifest {mine})")
        assert manifest is not None
        return {"data": "shifted", "manifest": mine, "stated": said is not None} | dict(manifest["identity"])

    return check

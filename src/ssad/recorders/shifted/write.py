"""`ssad shift`: plans the shards, hands them to processes or to Ray, and finishes each root."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError, StoreError
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.schema import TABLES
from ssad.datasets.nuscenes.tables import stream, table_path
from ssad.engine.pool import open_pool, run_all
from ssad.engine.store import locked
from ssad.recorders.shifted.manifest import FOLDER, PAGE, TABLE, Tally, digest_file, page, read_lines, shard_path
from ssad.recorders.shifted.options import Options, Shard, Strength
from ssad.recorders.shifted.scene_writer import UNFINISHED, check_folders, finished, link, make_shard
from ssad.scenarios.static.shifts.sun import NO_SUN

Progress = Callable[[int, int], None]
SHARD_S = 7200.0  # s that a scene under a shift may take


@dataclass(frozen=True, slots=True)
class Written:
    """State of a written nuScenes root; with failed files it has no manifest.json and is incomplete.

    Attributes:
        root: The folder.
        shifted: Number of images written with the shift.
        linked: Number of files linked to the original.
        failed: Number of files that failed.
        applied: Share of the images that changed.
        reasons: Why files failed.
    """

    root: Path
    shifted: int
    linked: int
    failed: int
    applied: float
    reasons: tuple[str, ...]


def materialise(
    options: Options, *, workers: int | None = None, ray: str | None = None, progress: Progress = lambda done, of: None
) -> list[Written]:
    """Write one nuScenes root for each shift and severity; run again, it resumes and keeps what is there.

    The bytes depend neither on the number of workers nor on the cluster.

    Args:
        options: What to write.
        workers: Number of processes; None: one for each core; 0: all in this process.
        ray: Address of a cluster that sees the same folders.
        progress: Called with the number of finished parts and of all parts.

    Returns:
        The state of each root.

    Raises:
        ConfigError: The options do not fit together, or do not fit the dataset.
        FormatError: The dataset is broken.
        StoreError: A root cannot be written, or a shift changed no image at all.
    """
    if workers is not None and workers < 0:
        raise ConfigError(f"{workers} workers: expected 1 or more (0: in this process)")
    if (options.source / FOLDER / "identity.json").exists():
        raise ConfigError(f"{options.source}: shifted already; give the clean dataset")
    data = NuScenes(options.source, options.version)
    names = tuple(record.name for record in data.scenes())
    unknown = sorted(set(options.scenes) - set(names))
    if unknown:
        raise ConfigError(f"{options.source}: no scene {', '.join(unknown[:5])} in {options.version}")
    chosen = options.scenes or names
    if not chosen:
        raise ConfigError(f"{options.source}: {options.version} has no scenes")
    data.scene(chosen[0])  # broken tables are found before anything is written; builds the index once
    data.close()
    roots = [(shift, severity) for shift in options.shifts for severity in options.severities]
    source = {"root": str(options.source.resolve()), "version": options.version, "tables": _tables(options)}
    with locked(options.out, "ssad shift"):
        for shift, severity in roots:
            _begin(options, shift, severity, source)
        shards = options.absolute().shards(chosen)
        run_all(
            open_pool(len(shards), workers=workers, ray=ray), make_shard, shards, timeout_s=SHARD_S, progress=progress
        )
        written, problems = [], []
        for shift, severity in roots:
            try:
                written.append(_finish(options, shift, severity, source=source, scenes=chosen, known=names))
            except StoreError as error:  # the other roots are finished nevertheless
                problems.append(error)
        if problems:
            raise StoreError(" | ".join(map(str, problems)))
        return written


def _tables(options: Options) -> dict[str, str]:
    """Hashes of the tables: a shifted root belongs to one dataset."""
    return {name: digest_file(table_path(options.source, options.version, name)) for name in sorted(TABLES)}


def _begin(options: Options, shift: str, severity: Strength, source: dict[str, Any]) -> None:
    """A new root, or one of the same identity to go on with. StoreError for another's."""
    root = options.root(shift, severity)
    check_folders(root, ("", FOLDER, options.version, UNFINISHED), options.source)
    safeio.make_folder(root / FOLDER)
    identity = {"identity": dict(Shard(options, shift, severity, "").identity()), "source": source}
    path = root / FOLDER / "identity.json"
    if path.exists():
        if _read_identity(path) != identity:
            raise StoreError(f"{root}: holds a shift of other data or options; choose another folder")
    else:
        safeio.write_atomic(path, safeio.dump_json(identity, indent=1) + "\n")
    try:
        (root / PAGE).unlink(missing_ok=True)  # not complete until it is again
        _clear(root, options.version)
    except OSError as error:
        raise StoreError(f"{root}: cannot be written: {error.strerror or error}") from None
    for entry in sorted(options.source.iterdir()):
        if entry.name in ("samples", "sweeps", PAGE, FOLDER) or entry.name.startswith(("v1.0-", ".")):
            continue
        link(root, entry, root / entry.name)
    own = {f"{TABLE}.json", f"{TABLE}.original.json", f"{TABLE}.transformed.json"}
    for table in sorted((options.source / options.version).glob("*.json")):
        if table.name not in own:
            link(root, table, root / options.version / table.name)


def _read_identity(path: Path) -> Any:
    """What a root says that it holds; None when that is damaged."""
    try:
        return safeio.read_json(path)
    except FormatError:
        return None


def _clear(root: Path, version: str) -> None:
    """Removes what a killed run left half written."""
    if (root / UNFINISHED).exists():
        shutil.rmtree(root / UNFINISHED, ignore_errors=True)
    for folder in (root.parent, root, root / FOLDER, root / version):
        safeio.remove_unfinished(folder)


def _finish(
    options: Options,
    shift: str,
    severity: Strength,
    *,
    source: dict[str, Any],
    scenes: Sequence[str],
    known: Sequence[str],
) -> Written:
    """Labels, the manifest's page, and the check that something changed.

    The page covers the scenes of earlier runs as well, if they are whole: scenes may be spread over runs.
    """
    root = options.root(shift, severity)
    tally, labels = Tally(), dict[str, msgspec.Raw]()
    for scene in known:
        made = finished(root, scene)
        if made is None and scene in scenes:
            raise StoreError(f"{root}: the lines of {scene} are gone; run the same ssad shift again")
        lines = read_lines(shard_path(root, scene)).values() if made is not None else ()
        if made is None or (scene not in scenes and any(r["state"] == "failed" for r in lines)):
            continue
        tally.add(scene, lines)
        labels |= made.boxes
    transformed = _write_labels(options, root, labels)
    changed = tally.changed if tally.images else tally.states["shifted"]
    if not tally.reasons and severity != 0 and not changed and not (tally.skipped.keys() & NO_SUN):
        why = "; ".join(f"{reason} ({count})" for reason, count in sorted(tally.skipped.items()))
        raise StoreError(f"{root}: {shift} changed none of {tally.images} images: {why or 'no reason was given'}")
    shutil.rmtree(root / UNFINISHED, ignore_errors=True)
    if not tally.reasons:
        identity = Shard(options, shift, severity, "").identity()
        found = page(identity, source, tally, labels=options.labels, transformed=transformed)
        safeio.write_atomic(root / PAGE, safeio.dump_json(found, indent=1) + "\n")
    states = tally.states
    return Written(
        root, states["shifted"], states["linked"], states["failed"], tally.applied, tuple(sorted(tally.reasons))
    )


def _write_labels(options: Options, root: Path, labels: dict[str, msgspec.Raw]) -> str:
    """sample_annotation.json as asked for; both sets of boxes beside it. One pass, a block at a time.

    The hash of the transformed ones.
    """
    original = table_path(options.source, options.version, TABLE)
    folder = table_path(root, options.version, TABLE).parent
    moved = folder / f"{TABLE}.transformed.json"
    encoder = msgspec.json.Encoder()
    with safeio.atomic_path(moved) as temporary, open(temporary, "wb") as file:
        separator = b"[\n"
        for block in stream(original, dict[str, Any]):
            for row in block:
                new = labels.get(row.get("token", ""))
                file.write(separator + encoder.encode(row if new is None else row | msgspec.json.decode(new)))
                separator = b",\n"
        file.write(b"\n]\n" if separator == b",\n" else b"[\n]\n")
    link(root, original, folder / f"{TABLE}.original.json")
    link(root, original if options.labels == "original" else moved, folder / f"{TABLE}.json")
    return digest_file(moved)

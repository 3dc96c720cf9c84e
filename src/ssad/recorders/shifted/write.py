"""`ssad shift`: plan the shards, run them in processes or on Ray, and finish each root."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec

from ssad.core import safeio
from ssad.core.errors import ConfigError, StoreError
from ssad.core.folders import check_links_above
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.schema import TABLES
from ssad.datasets.nuscenes.tables import nuscenes_path, stream, table_path
from ssad.engine.pool import open_pool, run_all
from ssad.engine.store import locked
from ssad.recorders.parts import TIME_LIMIT, claim
from ssad.recorders.shifted.manifest import (
    FOLDER,
    PAGE,
    TABLE,
    ManifestCounts,
    build_manifest,
    digest_file,
    read_lines,
    shard_path,
)
from ssad.recorders.shifted.options import Options, Shard, Strength
from ssad.recorders.shifted.scene_writer import UNFINISHED, check_folders, link, make_shard, read_finished_labels
from ssad.scenarios.static.shifts.sun import NO_SUN

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class ShiftedRoot:
    """State of a written nuScenes root; with failed files it has no manifest.json and is incomplete.

    Attributes:
        root: The folder.
        shifted: Number of images written with the shift.
        linked: Number of files linked to the original.
        failed: Number of files that failed.
        applied: Share of the images that changed.
        reasons: Reasons of failed files.
    """

    root: Path
    shifted: int
    linked: int
    failed: int
    applied: float
    reasons: tuple[str, ...]


def write_shifted_roots(
    options: Options, *, workers: int | None = None, ray: str | None = None, progress: Progress = lambda done, of: None
) -> list[ShiftedRoot]:
    """Write one nuScenes root for each shift and severity; a repeated run resumes and keeps existing files.

    The bytes depend neither on the number of workers nor on the cluster.

    Args:
        options: Options of the command.
        workers: Number of processes; None: one per core; 0: all in this process.
        ray: Address of a cluster that sees the same folders.
        progress: Called with the number of finished shards and of all shards.

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
    dataset = NuScenes(options.source, options.version)
    all_scenes = tuple(record.name for record in dataset.scenes())
    unknown = sorted(set(options.scenes) - set(all_scenes))
    if unknown:
        raise ConfigError(f"{options.source}: no scene {', '.join(unknown[:5])} in {options.version}")
    scene_names = options.scenes or all_scenes
    if not scene_names:
        raise ConfigError(f"{options.source}: {options.version} has no scenes")
    dataset.scene(scene_names[0])  # broken tables are found before anything is written; builds the index once
    dataset.close()
    conditions = [(shift, severity) for shift in options.shifts for severity in options.severities]
    source = {"root": str(options.source.resolve()), "version": options.version, "tables": _tables(options)}
    with locked(options.out, "ssad shift"):
        for shift, severity in conditions:
            _open_root(options, shift, severity, source)
        shards = options.absolute().shards(scene_names)
        run_all(
            open_pool(len(shards), workers=workers, ray=ray),
            make_shard,
            shards,
            timeout_s=TIME_LIMIT,
            progress=progress,
        )
        written_roots, errors = [], []
        for shift, severity in conditions:
            try:
                written_roots.append(
                    _finish_root(options, shift, severity, source=source, scenes=scene_names, scene_names=all_scenes)
                )
            except StoreError as error:  # finish the other roots nevertheless
                errors.append(error)
        if errors:
            raise StoreError(" | ".join(map(str, errors)))
        return written_roots


def _tables(options: Options) -> dict[str, str]:
    """Return the hashes of the tables: a shifted root belongs to one dataset."""
    return {name: digest_file(table_path(options.source, options.version, name)) for name in sorted(TABLES)}


def _open_root(options: Options, shift: str, severity: Strength, source: dict[str, Any]) -> None:
    """Create a root, or resume one with the same identity. StoreError for a root of another identity."""
    root = options.root(shift, severity)
    check_folders(root, ("", FOLDER, options.version, UNFINISHED), options.source)
    identity = {"identity": dict(Shard(options, shift, severity, "").identity()), "source": source}
    refusal = f"{root}: holds a shift of other data or options; choose another folder"
    check_links_above(root, root=options.out, itself=True)
    claim(root / FOLDER / "identity.json", identity, refusal)
    try:
        (root / PAGE).unlink(missing_ok=True)  # the root is incomplete until this run finishes it
        _clear(root, options.version)
    except OSError as error:
        raise StoreError(f"{root}: cannot be written: {error.strerror or error}") from None
    sensor_folders = _sensor_folders(options.source)
    for entry in sorted(options.source.iterdir()):
        if entry.name in ("samples", "sweeps", PAGE, FOLDER) or entry.name.startswith(("v1.0-", ".")):
            continue
        if any(folder.is_relative_to(os.path.realpath(entry)) for folder in sensor_folders):
            continue  # `samples` leads into it: a link to it would put the clean files beside the shifted ones
        link(root, nuscenes_path(options.source, entry.name), root / entry.name)
    # The annotation tables are written at the end; all other tables are linked.
    annotation_tables = {f"{TABLE}.json", f"{TABLE}.original.json", f"{TABLE}.transformed.json"}
    for table in sorted((options.source / options.version).glob("*.json")):
        if table.name not in annotation_tables:
            link(root, table, root / options.version / table.name)


def _sensor_folders(source: Path) -> set[Path]:
    """Return the real folders of the files of sensors, which symbolic links may lead to: of channels and of files."""
    folders = [source / name for name in ("samples", "sweeps")]
    channels = [channel for folder in folders if folder.is_dir() for channel in folder.iterdir() if channel.is_dir()]
    first_files = [file for channel in channels for file in islice(channel.iterdir(), 1)]
    return {Path(os.path.realpath(path)) for path in (*folders, *channels)} | {
        Path(os.path.realpath(file)).parent for file in first_files
    }


def _clear(root: Path, version: str) -> None:
    """Remove files that a killed run left unfinished."""
    if (root / UNFINISHED).exists():
        shutil.rmtree(root / UNFINISHED, ignore_errors=True)
    for folder in (root.parent, root, root / FOLDER, root / version):
        safeio.remove_unfinished(folder)


def _finish_root(
    options: Options,
    shift: str,
    severity: Strength,
    *,
    source: dict[str, Any],
    scenes: Sequence[str],
    scene_names: Sequence[str],
) -> ShiftedRoot:
    """Labels, the manifest's page, and the check that something changed.

    The page covers the scenes of earlier runs as well, if they are whole: scenes may be spread over runs.
    """
    root = options.root(shift, severity)
    counts, scene_boxes = ManifestCounts(), dict[str, msgspec.Raw]()
    for scene in scene_names:
        scene_labels = read_finished_labels(root, scene)
        if scene_labels is None and scene in scenes:
            raise StoreError(f"{root}: the lines of {scene} are gone; run the same ssad shift again")
        records = read_lines(shard_path(root, scene)).values() if scene_labels is not None else ()
        if scene_labels is None or (scene not in scenes and any(record["state"] == "failed" for record in records)):
            continue
        counts.add(scene, records)
        scene_boxes |= scene_labels.boxes
    transformed = _write_labels(options, root, scene_boxes)
    changed_count = counts.changed if counts.images else counts.states["shifted"]
    if not counts.reasons and severity != 0 and not changed_count and not (counts.skipped.keys() & NO_SUN):
        explanation = "; ".join(f"{reason} ({count})" for reason, count in sorted(counts.skipped.items()))
        raise StoreError(
            f"{root}: {shift} changed none of {counts.images} images: {explanation or 'no reason was given'}"
        )
    shutil.rmtree(root / UNFINISHED, ignore_errors=True)
    if not counts.reasons:
        identity = Shard(options, shift, severity, "").identity()
        manifest = build_manifest(identity, source, counts, labels=options.labels, transformed=transformed)
        safeio.write_atomic(root / PAGE, safeio.dump_json(manifest, indent=1) + "\n")
    states = counts.states
    return ShiftedRoot(
        root, states["shifted"], states["linked"], states["failed"], counts.applied_share, tuple(sorted(counts.reasons))
    )


def _write_labels(options: Options, root: Path, labels: dict[str, msgspec.Raw]) -> str:
    """Write sample_annotation.json as requested, and both sets of boxes beside it, a block at a time.

    Returns:
        Hash of the transformed table.
    """
    original = table_path(options.source, options.version, TABLE)
    folder = table_path(root, options.version, TABLE).parent
    transformed = folder / f"{TABLE}.transformed.json"
    encoder = msgspec.json.Encoder()
    with safeio.atomic_path(transformed) as temporary, open(temporary, "wb") as output:
        separator = b"[\n"
        for block in stream(original, dict[str, Any]):
            for annotation in block:
                moved_box = labels.get(annotation.get("token", ""))
                output.write(
                    separator
                    + encoder.encode(annotation if moved_box is None else annotation | msgspec.json.decode(moved_box))
                )
                separator = b",\n"
        output.write(b"\n]\n" if separator == b",\n" else b"[\n]\n")
    link(root, original, folder / f"{TABLE}.original.json")
    link(root, original if options.labels == "original" else transformed, folder / f"{TABLE}.json")
    return digest_file(transformed)

"""`ssad shift`: plans the shards, hands them to processes or to Ray, and finishes each root."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from ssad import safeio
from ssad.bench.toolbox.manifest import FOLDER, PAGE, digest_file, page, read_lines, shard_path
from ssad.bench.toolbox.plan import Options, Shard, Strength
from ssad.bench.toolbox.work import labels_path, link, make_shard
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.schema import TABLES
from ssad.datasets.nuscenes.tables import stream, table_path
from ssad.errors import ConfigError, SSADError, StoreError

Progress = Callable[[int, int], None]
TABLE = "sample_annotation"


@dataclass(frozen=True, slots=True)
class Written:
    """A finished root: how many files were shifted, linked, failed; the share of images that changed; problems."""

    root: Path
    shifted: int
    linked: int
    failed: int
    applied: float
    reasons: tuple[str, ...]


def materialise(
    options: Options, *, workers: int | None = None, ray: str | None = None, progress: Progress | None = None
) -> list[Written]:
    """Writes one nuScenes root a shift and severity. Run again to resume: what stands is kept.

    workers: processes (None: one a core); ray: address of a cluster that sees the same folders. The bytes do not
    depend on either. ConfigError, FormatError, StoreError; StoreError also when a shift changed no image at all.
    """
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
    safeio.make_folder(options.out)
    with _locked(options.out):
        for shift, severity in roots:
            _begin(options, shift, severity, source)
        shards = options.shards(tuple(chosen))
        for count, _ in enumerate(_work(shards, workers=workers, ray=ray), 1):
            if progress is not None:
                progress(count, len(shards))
        return [_finish(options, shift, severity, source, chosen) for shift, severity in roots]


def _tables(options: Options) -> dict[str, str]:
    """Hashes of the tables: a shifted root belongs to one dataset."""
    return {name: digest_file(table_path(options.source, options.version, name)) for name in sorted(TABLES)}


class _locked:
    """One `ssad shift` a folder."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / ".lock"

    def __enter__(self) -> None:
        import fcntl

        self.descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self.descriptor)
            raise StoreError(f"{self.path.parent}: another ssad shift is writing there") from None

    def __exit__(self, *_: object) -> None:
        os.close(self.descriptor)


def _begin(options: Options, shift: str, severity: Strength, source: dict[str, Any]) -> None:
    """A new root, or one of the same identity to go on with. StoreError for another's."""
    root = options.root(shift, severity)
    safeio.make_folder(root / FOLDER)
    identity = {"identity": dict(Shard(options, shift, severity, "").identity()), "source": source}
    path = root / FOLDER / "identity.json"
    if path.exists():
        if safeio.read_json(path) != identity:
            raise StoreError(f"{root}: holds a shift of other data or options; choose another folder")
    else:
        safeio.write_atomic(path, safeio.dump_json(identity, indent=1) + "\n")
    (root / PAGE).unlink(missing_ok=True)  # not complete until it is again
    for entry in sorted(options.source.iterdir()):
        if entry.name in ("samples", "sweeps", PAGE, FOLDER) or entry.name.startswith(("v1.0-", ".")):
            continue
        link(entry.resolve(), root / entry.name)
    for name in TABLES:
        if name != TABLE:
            link(table_path(options.source, options.version, name).resolve(), table_path(root, options.version, name))
    extra = options.source / options.version / "splits.json"
    if extra.is_file():
        link(extra.resolve(), root / options.version / "splits.json")


def _work(shards: Sequence[Shard], *, workers: int | None, ray: str | None) -> Iterator[dict[str, int]]:
    """Runs the shards; results as they come."""
    if ray is not None:
        yield from _on_ray(shards, ray)
        return
    count = min(workers or os.cpu_count() or 1, len(shards))
    if count <= 1:
        yield from map(make_shard, shards)
        return
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(make_shard, shard) for shard in shards]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool:
            raise StoreError("a worker died (out of memory?); run the same command again to go on") from None
        except BaseException:
            for future in futures:
                future.cancel()
            raise


def _on_ray(shards: Sequence[Shard], address: str) -> Iterator[dict[str, int]]:
    """Runs the shards on a Ray cluster."""
    try:
        import ray
    except ImportError:
        raise ConfigError("--ray needs the extra `ray`: pip install 'ssad-testbed[ray]'") from None
    try:
        ray.init(address=None if address == "local" else address, log_to_driver=False, ignore_reinit_error=True)
    except Exception as error:
        raise ConfigError(f"no Ray cluster at '{address}': {error}") from None
    task = ray.remote(make_shard)
    waiting = [task.remote(shard) for shard in shards]
    while waiting:
        ready, waiting = ray.wait(waiting)
        try:
            yield ray.get(ready[0])
        except ray.exceptions.RayTaskError as error:
            cause = error.cause
            raise cause if isinstance(cause, SSADError) else StoreError(f"a Ray task failed: {cause}") from None


def _finish(options: Options, shift: str, severity: Strength, source: dict[str, Any], scenes: Iterable[str]) -> Written:
    """Labels, the manifest's page, and the check that something changed."""
    root = options.root(shift, severity)
    shard = Shard(options, shift, severity, "")
    records = {scene: list(read_lines(shard_path(root, scene)).values()) for scene in scenes}
    labels: dict[str, Any] = {}
    for scene in scenes:
        labels |= safeio.read_json(labels_path(root, scene))
    _write_labels(options, root, labels)
    everything = [r for rows in records.values() for r in rows]
    failed = [r for r in everything if r["state"] == "failed"]
    found = page(shard.identity(), source, records, options.labels)
    if severity != 0 and found["images"] and found["applied"] == 0 and len(failed) < found["images"]:
        why = "; ".join(f"{reason} ({count})" for reason, count in found["skipped"].items()) or "no reason was given"
        raise StoreError(f"{root}: {shift} changed none of {found['images']} images: {why}")
    if not failed:
        safeio.write_atomic(root / PAGE, safeio.dump_json(found, indent=1) + "\n")
    reasons = tuple(str(r["reason"]) for r in failed)
    count = {state: sum(r["state"] == state for r in everything) for state in ("shifted", "linked")}
    return Written(root, count["shifted"], count["linked"], len(failed), float(found["applied"]), reasons)


def _write_labels(options: Options, root: Path, labels: dict[str, Any]) -> None:
    """sample_annotation.json as asked for; both sets of boxes beside it. One pass, a block at a time."""
    original = table_path(options.source, options.version, TABLE)
    folder = table_path(root, options.version, TABLE).parent
    moved = folder / f"{TABLE}.transformed.json"
    encoder = msgspec.json.Encoder()
    with safeio.atomic_path(moved) as temporary, open(temporary, "wb") as file:
        separator = b"[\n"
        for block in stream(original, dict[str, Any]):
            for row in block:
                file.write(separator + encoder.encode(row | labels.get(row.get("token", ""), {})))
                separator = b",\n"
        file.write(b"\n]\n" if separator == b",\n" else b"[\n]\n")
    link(original.resolve(), folder / f"{TABLE}.original.json")
    chosen = original.resolve() if options.labels == "original" else Path(moved.name)
    link(chosen, folder / f"{TABLE}.json")

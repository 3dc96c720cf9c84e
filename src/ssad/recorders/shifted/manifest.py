"""Manifest of a nuScenes-N root: one line per file while the root is written, one page when it is complete.

ROOT/manifest/SCENE.jsonl has one line per file: its state, the shift applied, severity, hash of the pixels before
encoding, hash and size of the file, and skipped objects with the reason. States: shifted; linked (the clean file: the
shift was not requested for it or changed nothing in it); absent (not requested, and not in the dataset either);
failed. ROOT/manifest.json is the summary; it exists only when the root is complete.
"""

from __future__ import annotations

import hashlib
import heapq
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeGuard

from ssad.core import safeio
from ssad.core.errors import FormatError, StoreError
from ssad.core.seeding import digest

PAGE: Final = "manifest.json"
FOLDER: Final = "manifest"
TABLE: Final = "sample_annotation"
STATES: Final = ("shifted", "linked", "absent", "failed")


def shard_path(root: Path, scene: str) -> Path:
    """Return the path of a scene's manifest lines."""
    return root / FOLDER / f"{scene}.jsonl"


def read_lines(path: Path) -> dict[str, dict[str, Any]]:
    """Read the lines of a shard by file name; a file's last line counts, and truncated lines are skipped."""
    records: dict[str, dict[str, Any]] = {}
    if not path.exists():
        return records
    for line in safeio.read_bytes(path, limit=1 << 30).split(b"\n"):
        try:
            record = safeio.parse_json(line.decode(), str(path)) if line else None
        except (FormatError, UnicodeDecodeError):
            continue  # truncated by a kill: the file is made again
        if _is_complete(record):
            records[record["file"]] = record
    return records


def _is_complete(record: Any) -> TypeGuard[dict[str, Any]]:
    """Return whether a line has all the fields that the toolbox reads."""
    if not isinstance(record, dict) or record.get("state") not in STATES:
        return False
    text_fields = ["file", "kind"] + (["hash"] if record["state"] == "shifted" else [])
    text_fields += ["reason"] if record["state"] == "failed" else []
    size_valid = record["state"] != "shifted" or isinstance(record.get("bytes"), int)
    return size_valid and all(isinstance(record.get(field_name), str) for field_name in text_fields)


def serialise_lines(records: Iterable[Mapping[str, Any]]) -> str:
    """Serialise lines sorted by file name: the text does not depend on the order in which files were made."""
    return "".join(
        safeio.dump_json(dict(record)) + "\n" for record in sorted(records, key=lambda record: str(record["file"]))
    )


def digest_bytes(data: bytes | memoryview) -> str:
    """Return the hash used in manifests: 32 hex digits of BLAKE2b."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def digest_file(path: Path) -> str:
    """Return the hash of a file of any size, as `digest_bytes`. FormatError if the file cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file") from None
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None


@dataclass(slots=True)
class ManifestCounts:
    """Counts over the lines of a root, added scene by scene so that only one scene is in memory."""

    scenes: dict[str, str] = field(default_factory=dict)
    files: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    images: int = 0
    changed: int = 0
    reasons: list[str] = field(default_factory=list)

    def add(self, scene: str, records: Iterable[Mapping[str, Any]]) -> None:
        """Add the lines of a scene."""
        rows = list(records)
        self.scenes[scene] = digest_bytes(serialise_lines(rows).encode())
        for record in rows:
            self.files[f"{record['kind']} {record['state']}"] += 1
            self.states[record["state"]] += 1
            self.skipped.update(record.get("skipped") or {})
            if record["kind"] == "camera":
                self.images += 1
                self.changed += bool(record.get("changed"))
            if record["state"] == "failed":
                self.reasons.append(record["reason"])
            elif "reason" in record:
                self.skipped[record["reason"]] += 1

    @property
    def applied_share(self) -> float:
        """Share of the images that changed."""
        return self.changed / max(self.images, 1)


def build_manifest(
    identity: Mapping[str, Any], source: Mapping[str, Any], tally: ManifestCounts, *, labels: str, transformed: str
) -> dict[str, Any]:
    """Build manifest.json of a complete root: identity, source, counts, and hashes of lines and new boxes."""
    return {
        "identity": dict(identity),
        "source": dict(source),
        "labels": labels,
        "transformed": transformed,
        "scenes": dict(sorted(tally.scenes.items())),
        "files": dict(sorted(tally.files.items())),
        "images": tally.images,
        "applied": tally.applied_share,
        "skipped": dict(sorted(tally.skipped.items())),
    }


def read_manifest(root: Path) -> dict[str, Any] | None:
    """Read manifest.json of a root; None for a clean dataset. StoreError for an incomplete root."""
    path = Path(root) / PAGE
    if not path.is_file():
        if (Path(root) / FOLDER).is_dir():
            raise StoreError(f"{root}: nuScenes-N that is not complete (no {PAGE}); run the same ssad shift again")
        return None
    manifest = safeio.read_json(path)
    field_types = {"identity": dict, "source": dict, "scenes": dict, "images": int, "labels": str, "transformed": str}
    if not isinstance(manifest, dict) or any(
        not isinstance(manifest.get(field_name), field_type) for field_name, field_type in field_types.items()
    ):
        raise FormatError(f"{path}: not a manifest written by ssad shift")
    if any(
        not isinstance(manifest["source"].get(source_field), source_type)
        for source_field, source_type in (("root", str), ("version", str), ("tables", dict))
    ):
        raise FormatError(f"{path}: not a manifest written by ssad shift")
    return manifest


def manifest_digest(root: Path) -> str:
    """Return the hash by which a results file names the data it was made on."""
    return digest_file(Path(root) / PAGE)


def check_manifest(root: Path, scenes: Iterable[str] = (), *, sample: int = 16) -> dict[str, Any] | None:
    """Read the manifest of a root and check that its data are indeed shifted.

    Lines must match the hashes in the summary; each file must exist with its size, and not be a link to the
    clean file; `sample` of them, by a fixed draw, are hashed; the boxes must be those that the summary names.

    Args:
        root: A nuScenes root.
        scenes: Names of the scenes that must be covered, and the only ones checked; none: all.
        sample: Number of files that are hashed.

    Returns:
        The manifest; None for a clean dataset.

    Raises:
        StoreError: The check fails.
    """
    root = Path(root)
    manifest = read_manifest(root)
    if manifest is None:
        return None
    scene_names = sorted(set(scenes))
    missing = [scene for scene in scene_names if scene not in manifest["scenes"]]
    if missing:
        remainder = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise StoreError(
            f"{root}: these scenes are not shifted: {', '.join(missing[:3])}{remainder}; run ssad shift for them"
        )
    for box_problem in _find_box_problems(root, manifest):
        raise StoreError(f"{box_problem}; run the same ssad shift again")
    selected: list[tuple[str, str, str]] = []
    for scene in scene_names or manifest["scenes"]:
        records = read_lines(shard_path(root, scene))
        if digest_bytes(serialise_lines(records.values()).encode()) != manifest["scenes"][scene]:
            raise StoreError(f"{shard_path(root, scene)}: not the lines that {PAGE} was made of; run ssad shift again")
        for record in records.values():
            problem = _find_problem(root, record, manifest)
            if problem:
                raise StoreError(f"{root / record['file']}: {problem}; run the same ssad shift again")
        shifted = ((entry["file"], entry["hash"]) for entry in records.values() if entry["state"] == "shifted")
        # The smallest digests are a reproducible random sample, and need one scene in memory at a time.
        selected = heapq.nsmallest(sample, [*selected, *((digest("manifest check", *pair), *pair) for pair in shifted)])
    for _, name, expected_hash in selected:
        if digest_file(root / name) != expected_hash:
            raise StoreError(f"{root / name}: not the bytes in the manifest; run the same ssad shift again")
    return manifest


def _find_problem(root: Path, record: Mapping[str, Any], manifest: Mapping[str, Any]) -> str | None:
    """Return the problem of a file, judged by its name, size and link alone; None if there is none."""
    path = root / record["file"]
    if record["state"] == "failed":
        return f"failed: {record['reason']}"
    if record["state"] == "absent":
        return "there, where the dataset has none" if path.is_symlink() or path.exists() else None
    if record["state"] == "linked":
        return (
            None if is_link_to(path, Path(manifest["source"]["root"]) / record["file"]) else "no link to the clean file"
        )
    if path.is_symlink():
        return "a link, where the manifest says that it was shifted"
    if not path.is_file():
        return "missing"
    size = path.stat().st_size
    return None if size == record["bytes"] else f"{size} bytes, {record['bytes']} in the manifest"


def is_link_to(link: Path, source: Path) -> bool:
    """Return whether `link` is a symbolic link to `source`, and `source` exists."""
    try:
        return link.is_symlink() and os.path.samefile(link, source)
    except OSError:
        return False


def _find_box_problems(root: Path, manifest: Mapping[str, Any]) -> Iterator[str]:
    """Yield a problem unless sample_annotation.json is the set of boxes that the summary names."""
    version = manifest["source"]["version"]
    path = root / version / f"{TABLE}.json"
    is_transformed = manifest["labels"] == "transformed"
    transformed_path = root / version / f"{TABLE}.transformed.json"
    if not is_link_to(
        path, transformed_path if is_transformed else Path(manifest["source"]["root"]) / version / f"{TABLE}.json"
    ):
        yield f"{path}: no link to the {manifest['labels']} boxes, which {PAGE} names"


def verify(root: Path) -> tuple[int, list[str]]:
    """Compare every file and table of a root with the manifest, by their hashes.

    Returns:
        Number of files; and one line for each that differs from the manifest.

    Raises:
        StoreError: The root has no manifest.
        FormatError: The manifest is broken.
    """
    root = Path(root)
    manifest = read_manifest(root)
    if manifest is None:
        raise StoreError(f"{root}: not written by ssad shift (no {PAGE})")
    file_count, problems = 0, list(_find_box_problems(root, manifest))
    version = manifest["source"]["version"]
    table_hashes = {
        table_name: text for table_name, text in manifest["source"]["tables"].items() if table_name != TABLE
    }
    table_hashes |= {f"{TABLE}.original": manifest["source"]["tables"].get(TABLE)}
    table_hashes |= {f"{TABLE}.transformed": manifest["transformed"]}
    for table_name, expected_hash in sorted(table_hashes.items()):
        problems += _find_byte_problems(root / version / f"{table_name}.json", expected_hash)
    for scene, expected_hash in manifest["scenes"].items():
        records = read_lines(shard_path(root, scene))
        if digest_bytes(serialise_lines(records.values()).encode()) != expected_hash:
            problems.append(f"{shard_path(root, scene)}: not the lines that {PAGE} was made of")
        for record in records.values():
            file_count += 1
            problem = _find_problem(root, record, manifest)
            if problem:
                problems.append(f"{root / record['file']}: {problem}")
            elif record["state"] == "shifted":
                problems += _find_byte_problems(root / record["file"], record["hash"])
    return file_count, problems


def _find_byte_problems(path: Path, expected_hash: str) -> list[str]:
    """Return one line if a file has another hash or cannot be read."""
    try:
        return [] if digest_file(path) == expected_hash else [f"{path}: not the bytes in the manifest"]
    except FormatError as error:
        return [str(error)]

"""The manifest of a nuScenes-N root: one line a file while it is written, one page when it is done.

ROOT/manifest/SCENE.jsonl has a line a file: what was applied, severity, hash of the pixels before encoding, hash and
size of the file, what was skipped and why. ROOT/manifest.json sums it up; it is there only when the root is complete.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from ssad import safeio
from ssad.errors import FormatError, StoreError
from ssad.seeding import generator

PAGE: Final = "manifest.json"
FOLDER: Final = "manifest"
STATES: Final = ("shifted", "linked", "failed")


def shard_path(root: Path, scene: str) -> Path:
    """The lines of a scene."""
    return root / FOLDER / f"{scene}.jsonl"


def read_lines(path: Path) -> dict[str, dict[str, Any]]:
    """The lines of a shard by file name, a later line of a file before an earlier; what was cut off is left out."""
    found: dict[str, dict[str, Any]] = {}
    if not path.exists():
        return found
    for line in safeio.read_bytes(path, limit=1 << 30).split(b"\n"):
        try:
            record = safeio.parse_json(line.decode(), str(path)) if line else None
        except (FormatError, UnicodeDecodeError):
            continue  # torn by a kill: the file is done again
        if isinstance(record, dict) and "file" in record:
            found[record["file"]] = record
    return found


def text(records: Iterable[Mapping[str, Any]]) -> str:
    """Lines sorted by file name: the same whatever order the files were made in."""
    return "".join(safeio.dump_json(dict(r)) + "\n" for r in sorted(records, key=lambda r: str(r["file"])))


def digest_bytes(data: bytes) -> str:
    """Hash that manifests use: 32 hex digits of BLAKE2b."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def digest_file(path: Path) -> str:
    """The same of a file. FormatError when it cannot be read."""
    return digest_bytes(safeio.read_bytes(path, limit=1 << 30))


def page(
    identity: Mapping[str, Any],
    source: Mapping[str, Any],
    records: Mapping[str, Sequence[Mapping[str, Any]]],
    labels: str,
) -> dict[str, Any]:
    """manifest.json of a complete root: identity, source, counts, and the hash of each scene's lines."""
    everything = [r for rows in records.values() for r in rows]
    cameras = [r for r in everything if r["kind"] == "camera"]
    skipped: Counter[str] = Counter()
    for record in everything:
        skipped.update(record.get("skipped", {}))
    return {
        "identity": dict(identity),
        "source": dict(source),
        "labels": labels,
        "scenes": {scene: digest_bytes(text(rows).encode()) for scene, rows in sorted(records.items())},
        "files": dict(sorted(Counter(f"{r['kind']} {r['state']}" for r in everything).items())),
        "images": len(cameras),
        "applied": sum(bool(r.get("changed")) for r in cameras) / max(len(cameras), 1),
        "skipped": dict(sorted(skipped.items())),
    }


def read_manifest(root: Path) -> dict[str, Any] | None:
    """manifest.json of a root; None for a clean dataset. StoreError for a root that is not complete."""
    path = Path(root) / PAGE
    if not path.is_file():
        if (Path(root) / FOLDER).is_dir():
            raise StoreError(f"{root}: nuScenes-N that is not complete (no {PAGE}); run the same ssad shift again")
        return None
    data = safeio.read_json(path)
    if not isinstance(data, dict) or not {"identity", "source", "scenes", "images"} <= set(data):
        raise FormatError(f"{path}: not a manifest written by ssad shift")
    return data


def manifest_digest(root: Path) -> str:
    """The hash by which a results file can say on which data it was made."""
    return digest_file(Path(root) / PAGE)


def check_manifest(root: Path, scenes: Iterable[str] = (), *, sample: int = 16) -> dict[str, Any] | None:
    """The manifest of a root after a check that its data are shifted indeed; None for a clean dataset.

    Lines must be those that the page has hashes of; each file must be there with its size, and not be a link to the
    clean one; `sample` of them, by a fixed draw, are hashed. scenes: names that must be covered. StoreError.
    """
    root = Path(root)
    manifest = read_manifest(root)
    if manifest is None:
        return None
    missing = sorted(set(scenes) - set(manifest["scenes"]))
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise StoreError(
            f"{root}: these scenes are not shifted: {', '.join(missing[:3])}{more}; run ssad shift for them"
        )
    shifted = []
    for scene, expected in manifest["scenes"].items():
        lines = read_lines(shard_path(root, scene))
        if digest_bytes(text(lines.values()).encode()) != expected:
            raise StoreError(f"{shard_path(root, scene)}: not the lines that {PAGE} was made of; run ssad shift again")
        for record in lines.values():
            problem = _wrong(root, record)
            if problem:
                raise StoreError(f"{root / record['file']}: {problem}; run the same ssad shift again")
            if record["state"] == "shifted":
                shifted.append(record)
    draw = generator("manifest check", str(manifest["identity"]))
    for index in draw.permutation(len(shifted))[:sample]:
        record = shifted[int(index)]
        if digest_file(root / record["file"]) != record["hash"]:
            raise StoreError(f"{root / record['file']}: not the bytes in the manifest; run ssad shift again")
    return manifest


def _wrong(root: Path, record: Mapping[str, Any]) -> str | None:
    """What is wrong with a file, going by its name and size alone."""
    path = root / record["file"]
    if record["state"] == "failed":
        return f"failed: {record['reason']}"
    if record["state"] == "linked":
        return None if path.is_symlink() and path.exists() else "the link to the unchanged file is gone or broken"
    if path.is_symlink():
        return "a link, where the manifest says that it was shifted"
    if not path.is_file():
        return "missing"
    size = path.stat().st_size
    return None if size == record["bytes"] else f"{size} bytes, {record['bytes']} in the manifest"


def verify(root: Path) -> tuple[int, list[str]]:
    """Hashes every file of a root: their number, and one line for each that is not as the manifest says."""
    root = Path(root)
    manifest = read_manifest(root)
    if manifest is None:
        raise StoreError(f"{root}: not written by ssad shift (no {PAGE})")
    count, problems = 0, []
    for scene, expected in manifest["scenes"].items():
        lines = read_lines(shard_path(root, scene))
        if digest_bytes(text(lines.values()).encode()) != expected:
            problems.append(f"{shard_path(root, scene)}: not the lines that {PAGE} was made of")
        for record in lines.values():
            count += 1
            problem = _wrong(root, record)
            if (
                problem is None
                and record["state"] == "shifted"
                and digest_file(root / record["file"]) != record["hash"]
            ):
                problem = "not the bytes in the manifest"
            if problem:
                problems.append(f"{root / record['file']}: {problem}")
    return count, problems

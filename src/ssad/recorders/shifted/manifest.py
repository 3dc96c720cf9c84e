"""The manifest of a nuScenes-N root: one line a file while it is written, one page when it is done.

ROOT/manifest/SCENE.jsonl has a line a file: its state, what was applied, severity, hash of the pixels before encoding,
hash and size of the file, what was skipped and why. States: shifted; linked (the clean file: the shift was not asked
for it or changed nothing in it); absent (not asked for, and not in the dataset either); failed. ROOT/manifest.json sums
it up; it is there only when the root is complete.
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
        if _whole(record):
            found[record["file"]] = record
    return found


def _whole(record: Any) -> TypeGuard[dict[str, Any]]:
    """Whether a line has what the rest of the toolbox asks of it."""
    if not isinstance(record, dict) or record.get("state") not in STATES:
        return False
    names = ["file", "kind"] + (["hash"] if record["state"] == "shifted" else [])
    names += ["reason"] if record["state"] == "failed" else []
    sized = record["state"] != "shifted" or isinstance(record.get("bytes"), int)
    return sized and all(isinstance(record.get(name), str) for name in names)


def text(records: Iterable[Mapping[str, Any]]) -> str:
    """Lines sorted by file name: the same whatever order the files were made in."""
    return "".join(safeio.dump_json(dict(r)) + "\n" for r in sorted(records, key=lambda r: str(r["file"])))


def digest_bytes(data: bytes | memoryview) -> str:
    """Hash that manifests use: 32 hex digits of BLAKE2b."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def digest_file(path: Path) -> str:
    """The same of a file of any size. FormatError when it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file") from None
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None


@dataclass(slots=True)
class Tally:
    """Counts over the lines of a root, added scene by scene so that memory is that of one scene."""

    scenes: dict[str, str] = field(default_factory=dict)
    files: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    images: int = 0
    changed: int = 0
    reasons: list[str] = field(default_factory=list)

    def add(self, scene: str, records: Iterable[Mapping[str, Any]]) -> None:
        """The lines of a scene."""
        rows = list(records)
        self.scenes[scene] = digest_bytes(text(rows).encode())
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
    def applied(self) -> float:
        """Share of the images that changed."""
        return self.changed / max(self.images, 1)


def page(
    identity: Mapping[str, Any], source: Mapping[str, Any], tally: Tally, *, labels: str, transformed: str
) -> dict[str, Any]:
    """manifest.json of a complete root: identity, source, counts, hashes of each scene's lines and of the new boxes."""
    return {
        "identity": dict(identity),
        "source": dict(source),
        "labels": labels,
        "transformed": transformed,
        "scenes": dict(sorted(tally.scenes.items())),
        "files": dict(sorted(tally.files.items())),
        "images": tally.images,
        "applied": tally.applied,
        "skipped": dict(sorted(tally.skipped.items())),
    }


def read_manifest(root: Path) -> dict[str, Any] | None:
    """manifest.json of a root; None for a clean dataset. StoreError for a root that is not complete."""
    path = Path(root) / PAGE
    if not path.is_file():
        if (Path(root) / FOLDER).is_dir():
            raise StoreError(f"{root}: nuScenes-N that is not complete (no {PAGE}); run the same ssad shift again")
        return None
    data = safeio.read_json(path)
    kinds = {"identity": dict, "source": dict, "scenes": dict, "images": int, "labels": str, "transformed": str}
    if not isinstance(data, dict) or any(not isinstance(data.get(name), kind) for name, kind in kinds.items()):
        raise FormatError(f"{path}: not a manifest written by ssad shift")
    if any(not isinstance(data["source"].get(n), k) for n, k in (("root", str), ("version", str), ("tables", dict))):
        raise FormatError(f"{path}: not a manifest written by ssad shift")
    return data


def manifest_digest(root: Path) -> str:
    """The hash by which a results file can say on which data it was made."""
    return digest_file(Path(root) / PAGE)


def check_manifest(root: Path, scenes: Iterable[str] = (), *, sample: int = 16) -> dict[str, Any] | None:
    """The manifest of a root, after a check that its data are indeed shifted.

    Lines must be those that the page has hashes of; each file must be there with its size, and not be a link to the
    clean one; `sample` of them, by a fixed draw, are hashed; the boxes must be those that the page names.

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
    wanted = sorted(set(scenes))
    missing = [scene for scene in wanted if scene not in manifest["scenes"]]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise StoreError(
            f"{root}: these scenes are not shifted: {', '.join(missing[:3])}{more}; run ssad shift for them"
        )
    for found in _wrong_boxes(root, manifest):
        raise StoreError(f"{found}; run the same ssad shift again")
    draw: list[tuple[str, str, str]] = []
    for scene in wanted or manifest["scenes"]:
        lines = read_lines(shard_path(root, scene))
        if digest_bytes(text(lines.values()).encode()) != manifest["scenes"][scene]:
            raise StoreError(f"{shard_path(root, scene)}: not the lines that {PAGE} was made of; run ssad shift again")
        for record in lines.values():
            problem = _wrong(root, record, manifest)
            if problem:
                raise StoreError(f"{root / record['file']}: {problem}; run the same ssad shift again")
        shifted = ((r["file"], r["hash"]) for r in lines.values() if r["state"] == "shifted")
        draw = heapq.nsmallest(sample, [*draw, *((digest("manifest check", *pair), *pair) for pair in shifted)])
    for _, name, expected in draw:
        if digest_file(root / name) != expected:
            raise StoreError(f"{root / name}: not the bytes in the manifest; run the same ssad shift again")
    return manifest


def _wrong(root: Path, record: Mapping[str, Any], manifest: Mapping[str, Any]) -> str | None:
    """What is wrong with a file, going by its name, size and link alone."""
    path = root / record["file"]
    if record["state"] == "failed":
        return f"failed: {record['reason']}"
    if record["state"] == "absent":
        return "there, where the dataset has none" if path.is_symlink() or path.exists() else None
    if record["state"] == "linked":
        return (
            None if leads_to(path, Path(manifest["source"]["root"]) / record["file"]) else "no link to the clean file"
        )
    if path.is_symlink():
        return "a link, where the manifest says that it was shifted"
    if not path.is_file():
        return "missing"
    size = path.stat().st_size
    return None if size == record["bytes"] else f"{size} bytes, {record['bytes']} in the manifest"


def leads_to(link: Path, source: Path) -> bool:
    """Whether `link` is a symbolic link to `source`, which is there."""
    try:
        return link.is_symlink() and os.path.samefile(link, source)
    except OSError:
        return False


def _wrong_boxes(root: Path, manifest: Mapping[str, Any]) -> Iterator[str]:
    """Whether sample_annotation.json is the set of boxes that the page names."""
    version = manifest["source"]["version"]
    path = root / version / f"{TABLE}.json"
    new = manifest["labels"] == "transformed"
    expected = root / version / f"{TABLE}.transformed.json"
    if not leads_to(path, expected if new else Path(manifest["source"]["root"]) / version / f"{TABLE}.json"):
        yield f"{path}: no link to the {manifest['labels']} boxes, which {PAGE} names"


def verify(root: Path) -> tuple[int, list[str]]:
    """Compare every file and table of a root with the manifest, by their hashes.

    Returns:
        Number of files; and a line for each that differs from the manifest.

    Raises:
        StoreError: The root has no manifest.
        FormatError: The manifest is broken.
    """
    root = Path(root)
    manifest = read_manifest(root)
    if manifest is None:
        raise StoreError(f"{root}: not written by ssad shift (no {PAGE})")
    count, problems = 0, list(_wrong_boxes(root, manifest))
    version = manifest["source"]["version"]
    expected = {name: text for name, text in manifest["source"]["tables"].items() if name != TABLE}
    expected |= {f"{TABLE}.original": manifest["source"]["tables"].get(TABLE)}
    expected |= {f"{TABLE}.transformed": manifest["transformed"]}
    for name, hashed in sorted(expected.items()):
        problems += _wrong_bytes(root / version / f"{name}.json", hashed)
    for scene, hashed in manifest["scenes"].items():
        lines = read_lines(shard_path(root, scene))
        if digest_bytes(text(lines.values()).encode()) != hashed:
            problems.append(f"{shard_path(root, scene)}: not the lines that {PAGE} was made of")
        for record in lines.values():
            count += 1
            problem = _wrong(root, record, manifest)
            if problem:
                problems.append(f"{root / record['file']}: {problem}")
            elif record["state"] == "shifted":
                problems += _wrong_bytes(root / record["file"], record["hash"])
    return count, problems


def _wrong_bytes(path: Path, expected: str) -> list[str]:
    """A line when a file has another hash or cannot be read."""
    try:
        return [] if digest_file(path) == expected else [f"{path}: not the bytes in the manifest"]
    except FormatError as error:
        return [str(error)]

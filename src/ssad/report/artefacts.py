"""Files beside the records: missing or altered ones, and pictures for the page."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.errors import SSADError, StoreError
from ssad.core.folders import path_inside
from ssad.core.traces import load_trace, trace_hash
from ssad.report.load import Run, load_run

DIGEST_BYTES = 16
_PICTURES = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}


def check_artefacts(folder: Path | str) -> list[str]:
    """Return the problems of the files that the records of a run name.

    Args:
        folder: A run folder.

    Returns:
        A line for each file that is missing or not as the run left it, such as "traces/4fe2.npz is missing"; empty if
        all are intact. A file is compared with the record's `hashes`, a trace without one with its episode's
        trace_hash.

    Raises:
        StoreError: The folder holds no run with results.
    """
    return artefact_problems(load_run(folder))


def artefact_problems(run: Run) -> list[str]:
    """Return `check_artefacts` of a loaded run."""
    problems: dict[str, str] = {}
    checked_paths: set[str] = set()
    for line in run.lines:
        hashes: Mapping[str, str] = line.get("hashes") or {}
        for path in [*_paths(line.get("artefacts") or {}), *hashes]:
            if path not in checked_paths:
                checked_paths.add(path)
                expected_hash = run.episodes.get(line["key"], {}).get("trace_hash", "") if path.endswith(".npz") else ""
                problem = _problem(run.folder, path, hashes.get(path, ""), expected_hash)
                if problem:
                    problems[path] = f"{path} {problem}"
    return list(problems.values())


def pictures(folder: Path) -> list[dict[str, str]]:
    """Return the existing pictures of pictures/pictures.json: file, caption, data (as a data: URI)."""
    picture_folder = folder / "pictures"
    captions_file = path_inside(folder, "pictures/pictures.json")
    if not captions_file.is_file():
        return []
    entries = []
    captions = safeio.read_json(captions_file)
    if not isinstance(captions, dict):
        raise StoreError(f"{captions_file}: not a mapping from pictures to captions; remove it and run again")
    for file, caption in sorted(captions.items(), key=lambda item: (len(item[0]), item[0])):
        path = path_inside(picture_folder, Path(file).name or "unnamed")
        kind = _PICTURES.get(path.suffix)
        if kind and path.is_file():
            encoded = base64.b64encode(safeio.read_bytes(path)).decode()
            entries.append({"file": path.name, "caption": str(caption), "data": f"data:image/{kind};base64,{encoded}"})
    return entries


def _paths(artefacts: Mapping[str, Any]) -> Iterator[str]:
    for value in artefacts.values():
        yield from [str(path) for path in value] if isinstance(value, list) else [str(value)]


def _problem(folder: Path, path: str, digest: str, trace: str) -> str:
    """Return the problem of a file or folder, "" if there is none."""
    try:
        artefact = path_inside(folder, path)  # records may come from anywhere
    except StoreError:
        return "lies outside the run folder"
    if not artefact.exists():
        return "is missing"
    if digest:
        with artefact.open("rb") as file:
            current_digest = hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=DIGEST_BYTES)).hexdigest()
        return "" if current_digest == digest else "is not as the run left it"
    if trace:
        try:
            return "" if trace_hash(load_trace(artefact)) == trace else "is not as the run left it"
        except SSADError:
            return "is damaged"
    return ""

"""What lies beside the records: files that are missing or altered, and pictures for the page."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.errors import SSADError
from ssad.core.traces import load_trace, trace_hash
from ssad.report.load import Run, load_run

DIGEST_BYTES = 16
_PICTURES = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}


def check_artefacts(folder: Path | str) -> list[str]:
    """What is wrong with the files that the records of a run name.

    Args:
        folder: a run folder.

    Returns:
        A line for each file that is missing or not as the run left it, such as "traces/4fe2.npz is missing"; empty if
        all is well. A file is compared with the record's `hashes`, a trace without one with its episode's trace_hash.

    Raises:
        StoreError: the folder holds no run with results.
    """
    return artefact_problems(load_run(folder))


def artefact_problems(run: Run) -> list[str]:
    """`check_artefacts` of a run that is loaded."""
    found: dict[str, str] = {}
    checked: set[str] = set()
    for line in run.lines:
        hashes: Mapping[str, str] = line.get("hashes") or {}
        for path in [*_paths(line.get("artefacts") or {}), *hashes]:
            if path not in checked:
                checked.add(path)
                trace = run.episodes.get(line["key"], {}).get("trace_hash", "") if path.endswith(".npz") else ""
                wrong = _problem(run.folder, path, hashes.get(path, ""), trace)
                if wrong:
                    found[path] = f"{path} {wrong}"
    return list(found.values())


def pictures(folder: Path) -> list[dict[str, str]]:
    """The pictures of pictures/pictures.json that are there: file, caption, data (as a data: URI)."""
    place = folder / "pictures"
    if not (place / "pictures.json").is_file():
        return []
    found = []
    captions = safeio.read_json(place / "pictures.json")
    for file, caption in sorted(captions.items(), key=lambda item: (len(item[0]), item[0])):
        path = place / Path(str(file)).name
        kind = _PICTURES.get(path.suffix)
        if kind and path.is_file():
            data = base64.b64encode(safeio.read_bytes(path)).decode()
            found.append({"file": path.name, "caption": str(caption), "data": f"data:image/{kind};base64,{data}"})
    return found


def _paths(artefacts: Mapping[str, Any]) -> Iterator[str]:
    for value in artefacts.values():
        yield from [str(path) for path in value] if isinstance(value, list) else [str(value)]


def _problem(folder: Path, path: str, digest: str, trace: str) -> str:
    """What is wrong with a file or folder, "" if nothing is."""
    place = folder / path
    if not place.resolve().is_relative_to(folder.resolve()):
        return "lies outside the run folder"
    if not place.exists():
        return "is missing"
    if digest:
        with place.open("rb") as file:
            now = hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=DIGEST_BYTES)).hexdigest()
        return "" if now == digest else "is not as the run left it"
    if trace:
        try:
            return "" if trace_hash(load_trace(place)) == trace else "is not as the run left it"
        except SSADError:
            return "is damaged"
    return ""

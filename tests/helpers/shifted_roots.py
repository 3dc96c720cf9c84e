"""Roots that the toolbox has written: how to make, read, edit and refuse them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ssad.core.errors import SSADError
from ssad.recorders.shifted import Options
from ssad.recorders.shifted.manifest import read_lines

VERSION = "v1.0-mini"
SCENES = ("scene-0103", "scene-0916")


def options(source: Path, out: Path, *shifts: str, **other: Any) -> Options:
    """Options with short defaults."""
    return Options(source, out, VERSION, shifts or ("fog",), other.pop("severities", (3,)), **other)


def tree(folder: Path) -> dict[str, str | bytes]:
    """Every file with its bytes and every link with its target; locks left out."""
    return {
        str(path.relative_to(folder)): os.readlink(path) if path.is_symlink() else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.name != ".lock" and (path.is_symlink() or path.is_file())
    }


def lines(root: Path, *scenes: str) -> dict[str, dict[str, Any]]:
    """All lines by file name."""
    found = {}
    for scene in scenes or SCENES:
        found.update(read_lines(root / "manifest" / f"{scene}.jsonl"))
    return found


def first(root: Path, kind: str = "camera", state: str = "shifted") -> str:
    """Name of the first file of a kind and state."""
    return min(name for name, r in lines(root).items() if r["kind"] == kind and r["state"] == state)


def table(root: Path, name: str) -> Any:
    return json.loads((root / VERSION / f"{name}.json").read_text())


def edit(root: Path, name: str, change: Callable[[dict[str, Any]], object]) -> None:
    """Changes every row of a table."""
    rows = table(root, name)
    for row in rows:
        change(row)
    (root / VERSION / f"{name}.json").write_text(json.dumps(rows))


def fails(kind: type[SSADError], call: Callable[[], object], *words: str) -> str:
    """The message, one line with these words."""
    with pytest.raises(kind) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message
    return message

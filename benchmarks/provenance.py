"""Origin of a stored run: date, source, packages and machine, and the packages that are no longer allowed."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
PACKAGES = ("ssad", "python", "torch", "numpy", "warp-lang")
NAMES = {"ssad": "SSAD", "python": "Python", "numpy": "NumPy", "warp-lang": "Warp"}


def origin(header: Mapping[str, Any]) -> str:
    """Return one sentence: when and with what a run was made, from its run.json.

    A run keeps a hash of the source that its results depend on; it does not keep a commit.
    """
    versions = {**header.get("versions", {}), **_all_torch(header)}
    packages = [f"{NAMES.get(name, name)} {versions[name]}" for name in PACKAGES if name in versions]
    date, code = header.get("started", "an unknown day")[:10], header.get("code", "unknown")
    return f"Run of {date}, source hash `{code}` (no commit is recorded), {', '.join(packages)}."


def warning(header: Mapping[str, Any]) -> str:
    """Return a warning in Markdown if a run was made with packages that pyproject.toml excludes; else ""."""
    old = refused({**header.get("versions", {}), **_all_torch(header)})
    return f"**Made with {' and '.join(old)}.**" if old else ""


def refused(versions: Mapping[str, str]) -> list[str]:
    """Return packages whose version pyproject.toml excludes, such as "torch 2.11.0 (now >=2.15.0)".

    Args:
        versions: Package -> version, or several versions joined by " and ".
    """
    project = tomllib.loads(PROJECT.read_text())["project"]
    listed = [*project["dependencies"], *(one for extra in project["optional-dependencies"].values() for one in extra)]
    allowed = {requirement.name: requirement.specifier for requirement in map(Requirement, listed)}
    return [
        f"{name} {version}, which `pyproject.toml` no longer allows ({allowed[name]})"
        for name, several in versions.items()
        if name in allowed
        for version in several.split(" and ")
        if version and not allowed[name].contains(version.partition("+")[0])
    ]


def _all_torch(header: Mapping[str, Any]) -> dict[str, str]:
    """Return the versions of PyTorch of all cells of a joined run, or of the run."""
    several = header.get("torch")
    return {"torch": " and ".join(several)} if several else {}

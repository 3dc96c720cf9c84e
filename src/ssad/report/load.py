"""A run folder as its header and its lines, whatever the kind of the run."""

from __future__ import annotations

import contextlib
import itertools
import shlex
import textwrap
import traceback
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.errors import FormatError, StoreError
from ssad.core.folders import check_tree
from ssad.core.jsonl import shown
from ssad.core.run_records import RESULTS, read_records

INCIDENTAL = (
    "batch",
    "chunk",
    "description",
    "name",
    "pictures",
    "reference",
    "sheets",
    "timeout_s",
    "witness",
)  # keys of suites that change no result

HEADER_TYPES = {
    "kind": str,
    "suite": dict,
    "command": str,
    "versions": dict,
    "code": str,
    "machine": dict,
    "columns": list,
    "factors": list,
    "cells": list,
    "commands": list,
}
"""Types of the keys of run.json that are used; each may be missing."""


@dataclass(frozen=True)
class Run:
    """A run folder.

    Attributes:
        folder: Its path.
        header: Content of run.json.
        lines: Lines of results.jsonl, in the order of the suite.
        episodes: Lines of episodes.jsonl by key; empty for kinds that have none.
        planned: Number of cells of the complete run.
        sealed: Whether its lines have seals, so that a change to them is noticed.
    """

    folder: Path
    header: Mapping[str, Any]
    lines: tuple[Mapping[str, Any], ...]
    episodes: Mapping[str, Mapping[str, Any]]
    planned: int
    sealed: bool = True

    @property
    def suite(self) -> Mapping[str, Any]:
        """The resolved suite."""
        suite_settings: Mapping[str, Any] = self.header.get("suite", {})
        return suite_settings

    @property
    def kind(self) -> str:
        """Kind of experiment; runs from before there were several are of kind "driving"."""
        return str(self.header.get("kind") or self.suite.get("kind") or "driving")

    @property
    def title(self) -> str:
        """Title of the page: the suite's title, unless the run differs from that suite."""
        name = str(self.suite.get("name") or "SSAD")
        title = str(self.suite.get("title") or name)
        if not self.changed_settings or any(setting.startswith("title=") for setting in self.changed_settings):
            return title
        description = f"{name} with {'; '.join(_in_words(setting) for setting in self.changed_settings)}"
        if len(description) <= 100:
            return description
        keys = dict.fromkeys(setting.partition("=")[0].replace("_", " ") for setting in self.changed_settings)
        return textwrap.shorten(f"{title}, with other {', '.join(keys)}", 160, placeholder=" ...")

    @cached_property
    def changed_settings(self) -> tuple[str, ...]:
        """Settings that differ from the suite of this name, as KEY=VALUE; those that change no result are left out."""
        arguments = shlex.split(self.command)
        settings = [argument for option, argument in itertools.pairwise(arguments) if option == "--set"]
        return tuple(setting for setting in settings if setting.partition("=")[0] not in INCIDENTAL)

    @property
    def command(self) -> str:
        """Command that repeats the run."""
        return str(self.header.get("command") or f"ssad run {self.suite.get('name', 'quick')}")

    @cached_property
    def names(self) -> Mapping[str, str]:
        """Key of a cell -> its name, such as "blind/StraightObstacle/00"."""
        return {cell["key"]: str(cell.get("name", cell["key"])) for cell in self.header.get("cells", [])}

    @property
    def failures(self) -> list[Mapping[str, Any]]:
        """Lines of failed cells."""
        return [line for line in self.lines if line["status"] != "ok"]


def _in_words(setting: str) -> str:
    """Return KEY=VALUE in words: objects with a name by that name, lists without brackets."""
    key, _, value_text = setting.partition("=")
    try:
        value = safeio.parse_yaml(value_text)
    except FormatError:
        return f"{key} {value_text}"
    return f"{key} {_spoken(value)}"


def _spoken(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(
            str(entry.get("name", _spoken(entry))) if isinstance(entry, dict) else str(entry) for entry in value
        )
    if isinstance(value, dict):
        return ", ".join(f"{key} {_spoken(entry)}" for key, entry in value.items())
    return str(value)


def _check_header(path: Path, header: Any) -> None:
    """Raise StoreError if run.json has a key of another type than `ssad run` writes."""
    problem = "" if isinstance(header, dict) else "it is no object"
    for name, kind in HEADER_TYPES.items():
        if not problem and not isinstance(header.get(name), kind | None):
            problem = f"{name} is {shown(header[name])}"
    for name, key in (("cells", "key"), ("columns", "name")):
        entries = [] if problem else header.get(name) or []
        for number, entry in enumerate(entries):
            if not isinstance(entry, dict) or not isinstance(entry.get(key), str):
                problem = f"{name}[{number}] is {shown(entry)}, without the text {key}"
                break
    for name in ("factors", "commands"):
        if not problem and not all(isinstance(entry, str) for entry in header.get(name) or []):
            problem = f"{name} is {shown(header[name])}"
    if problem:
        raise StoreError(f"{path}: not written by ssad run: {problem}; give a folder written by: ssad run")


def load_run(folder: Path | str) -> Run:
    """Read run.json, results.jsonl and episodes.jsonl, and check every line.

    A folder whose lines have no seals, such as one of an earlier version, is read with a warning.

    Raises:
        StoreError: The folder does not hold a run, something in it leads out of it, the run has no result yet, or its
            records fail a check of `ssad.core.run_records.read_records`.
    """
    folder = Path(folder)
    if not (folder / "run.json").is_file():
        raise StoreError(f"{folder}: no run here (run.json is missing); give a folder written by: ssad run")
    check_tree(folder)
    header: Mapping[str, Any] = safeio.read_json(folder / "run.json")
    _check_header(folder / "run.json", header)
    header = {name: value for name, value in header.items() if value is not None}
    records = read_records(folder, header)
    if not records.results:
        raise StoreError(f"{folder}: the run has no results yet; run it again to go on")
    if not records.sealed:
        warnings.warn(
            f"{folder / RESULTS}: its lines have no seals, so changes to them cannot be noticed; run the suite again "
            "for sealed ones",
            stacklevel=1,
        )
    positions = {cell["key"]: position for position, cell in enumerate(header.get("cells", []))}
    lines = sorted(records.results, key=lambda line: positions.get(line["key"], len(positions)))
    planned = max(len(positions), len(lines))
    return Run(folder, header, tuple(lines), records.episodes, planned, sealed=records.sealed)


@contextlib.contextmanager
def read_as_kind(*runs: Run) -> Iterator[None]:
    """Make an error of a page that is made of runs' records one line: the records may come from anywhere.

    Raises:
        StoreError: The records are not those of the kind. Its cause is the error, for authors of kinds.
    """
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise StoreError(
            f"{' or '.join(str(run.folder) for run in runs)}: its records are not those of kind {runs[0].kind}: "
            f"{type(error).__name__}: {error} "
            f"({Path(place.filename).name}:{place.lineno}); run the suite again"
        ) from error

"""Checks of the paths on a command line, before a command imports what it computes with, which takes seconds."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ssad.core.errors import ConfigError, FormatError, StoreError
from ssad.core.folders import RECORDING_FILE, RUN_FILE, check_output_folder

RUN = (RUN_FILE,)
COMPARISON = (RUN_FILE, "compare.html")
REPLAYS = ("[0-9a-f]" * 16 + "*.npz", "[0-9a-f]" * 16 + "*.jpg")
TRAINING = ("log.jsonl", "last.pt")
RECORDING = (RECORDING_FILE,)
SHIFTED = (RUN_FILE, "*/manifest/identity.json")
DETECTIONS = ("detections.json", "results.json")
PAGE = ("pictures",)
EXPORTED_SCENARIOS = ("*.xosc", "*.xml", "scenarios.json")
EXPORTED_TEXTURE = ("texture.json",)
EXPORTED_LIGHT = ("light.json",)
"""Names of what a command writes, by which it knows its own folder."""

NAMED_FILE = re.compile(r"(?:[\w.-]+:)?([^\s:?@*]+\.(?:yaml|yml|safetensors|py|xodr|osm|xosc|onnx))(?:[:?@].*)?")


def check_out(folder: Path | None, patterns: Sequence[str], *, option: str = "--out") -> None:
    """Check that a command can write to a folder, and that nothing else lies there.

    Args:
        folder: The folder; None: the default, which the command checks.
        patterns: Names of what the command writes, as of `check_output_folder`.
        option: Option or argument that names the folder.

    Raises:
        StoreError: The folder holds something else, or cannot be written.
    """
    if folder is None:
        return
    check_output_folder(folder, patterns, option=option)
    existing = folder.absolute()
    while not os.path.lexists(existing) and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise StoreError(f"{folder}: cannot write there: {existing} is a file; choose a folder with {option}")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise StoreError(f"{folder}: cannot write there: Permission denied; choose another folder with {option}")


def check_exists(*paths: Path | None) -> None:
    """Check that files or folders exist; None stands for an option that is not given.

    Raises:
        FormatError: One does not.
    """
    for path in paths:
        if path is not None and not os.path.lexists(path):
            raise FormatError(f"{path}: no such file or folder{_suggestion(path)}")


def check_named_files(suite: str, settings: Sequence[str]) -> None:
    """Check that the files exist that a suite and settings name, such as scenarios and weights.

    Args:
        suite: Name of a suite, or YAML file.
        settings: Settings KEY=VALUE; others are left to the suite's own check.

    Raises:
        ConfigError: A file is neither here nor beside the suite.
        FormatError: The suite cannot be read.
    """
    from ssad.core.safeio import parse_yaml, read_yaml_document

    beside, texts = [Path()], []
    if suite.endswith((".yaml", ".yml")):
        beside.append(Path(suite).parent)
        texts += list(_texts(read_yaml_document(suite).data))
    for setting in settings:
        key, separator, text = setting.partition("=")
        if separator:
            texts += list(_texts(parse_yaml(text, f"--set {key.strip()}")))
    for text in texts:
        match = NAMED_FILE.fullmatch(text)
        if match and not any((folder / Path(match[1]).expanduser()).exists() for folder in beside):
            raise ConfigError(f"{match[1]}: no such file{_suggestion(Path(match[1]))}")


def _suggestion(path: Path) -> str:
    """Return the most similar names in the folder of a missing file, in words; empty if there is none."""
    try:
        names = difflib.get_close_matches(path.name, os.listdir(path.parent), n=3)
    except OSError:
        return ""
    return f"; closest: {', '.join(names)}" if names else ""


def _texts(value: Any) -> Iterator[str]:
    """Yield the texts in plain data."""
    if isinstance(value, str):
        yield value
    elements = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    for element in elements:
        yield from _texts(element)

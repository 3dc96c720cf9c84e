"""Scenes of a split: from the dataset's own splits.json, the official lists, or all scenes.

The official lists (splits.json beside this file, scene numbers) are those of nuscenes-devkit 1.2.0, utils/splits.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path

from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError
from ssad.datasets.nuscenes.schema import Scene
from ssad.datasets.nuscenes.tables import stream, table_path


@cache
def official_splits() -> Mapping[str, tuple[str, ...]]:
    """Return scene names by split: train, val, test, mini_train, mini_val, train_detect, train_track."""
    scene_numbers = safeio.read_json(Path(__file__).with_name("splits.json"))
    return {name: tuple(f"scene-{number:04d}" for number in numbers) for name, numbers in scene_numbers.items()}


def own_splits(root: Path, version: str) -> dict[str, tuple[str, ...]]:
    """Read the splits of ROOT/VERSION/splits.json ({name: [scene names]}); none if the file does not exist.

    Raises:
        FormatError: The file is broken.
    """
    path = table_path(root, version, "splits")
    if not path.is_file():
        return {}
    content = safeio.read_json(path)
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected an object of split names and lists of scene names")
    for name, scenes in content.items():
        if not isinstance(scenes, list) or not all(isinstance(scene, str) for scene in scenes):
            raise FormatError(f"{path}: split '{name}': expected a list of scene names")
    return {name: tuple(scenes) for name, scenes in content.items()}


def scenes_of_split(root: Path, version: str, split: str) -> tuple[str, ...]:
    """Return the names of the scenes of a split.

    The folder's own splits.json takes precedence, then `all` (every scene of the version), then the official
    lists, some of whose scenes another version may not have.

    Raises:
        ConfigError: The split does not exist.
    """
    custom_splits = own_splits(root, version)
    if split in custom_splits:
        return custom_splits[split]
    if split == "all":
        return tuple(scene.name for block in stream(table_path(root, version, "scene"), Scene) for scene in block)
    devkit_splits = official_splits()
    if split in devkit_splits:
        return devkit_splits[split]
    available = ", ".join(sorted({*custom_splits, *devkit_splits, "all"}))
    raise ConfigError(
        f"unknown split '{split}' of {root / version}; known: {available}; others go into its splits.json"
    )

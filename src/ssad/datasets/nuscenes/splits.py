"""Which scenes a split has: the dataset's own splits.json, the official lists, or all scenes.

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
    """Scene names by name of the split: train, val, test, mini_train, mini_val, train_detect, train_track."""
    data = safeio.read_json(Path(__file__).with_name("splits.json"))
    return {name: tuple(f"scene-{number:04d}" for number in numbers) for name, numbers in data.items()}


def own_splits(root: Path, version: str) -> dict[str, tuple[str, ...]]:
    """The splits of ROOT/VERSION/splits.json ({name: [scene names]}); none where there is no such file.

    Raises:
        FormatError: The file is broken.
    """
    path = root / version / "splits.json"
    if not path.is_file():
        return {}
    data = safeio.read_json(path)
    if not isinstance(data, dict):
        raise FormatError(f"{path}: expected an object of split names and lists of scene names")
    for name, scenes in data.items():
        if not isinstance(scenes, list) or not all(isinstance(scene, str) for scene in scenes):
            raise FormatError(f"{path}: split '{name}': expected a list of scene names")
    return {name: tuple(scenes) for name, scenes in data.items()}


def scenes_of_split(root: Path, version: str, split: str) -> tuple[str, ...]:
    """Names of the scenes of a split.

    The folder's own splits.json takes precedence, then `all` (every scene of the version), then the official lists,
    some of whose scenes another version may not have.

    Raises:
        ConfigError: There is no such split.
    """
    own = own_splits(root, version)
    if split in own:
        return own[split]
    if split == "all":
        return tuple(s.name for block in stream(table_path(root, version, "scene"), Scene) for s in block)
    official = official_splits()
    if split in official:
        return official[split]
    known = ", ".join(sorted({*own, *official, "all"}))
    raise ConfigError(f"unknown split '{split}' of {root / version}; known: {known}; others go into its splits.json")

"""Data and detectors that a suite scores: looked up and checked, with what results depend on of them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from ssad.core import safeio
from ssad.core.checkpoints import state_hash
from ssad.core.errors import ConfigError
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.registry import Reference, split_weights
from ssad.core.schema import Names, Schema
from ssad.core.source import source_version
from ssad.datasets.nuscenes.camera_truth import scenes_of
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.detectors import DETECTORS, SHIPPED
from ssad.experiments.perception.scene_boxes import detector_of
from ssad.recorders.nuscenes import Recording

RECORDED = "recorded"


class Recorded(Schema):
    """The validation set that is recorded where none is given: drives in towns that the shipped detectors never saw.

    Attributes:
        towns: names.
        scenes: of each town.
        seconds: of a scene, two samples each.
        width: of the pictures.
        seed: of the drives.
    """

    towns: Names = Field(default=["Oldmarket", "Larkhill"])
    scenes: int = Field(default=12, ge=1)
    seconds: float = Field(default=8.0, ge=0.5, allow_inf_nan=False)
    width: int = Field(default=800, ge=64)
    seed: int = Field(default=0, ge=0)


class DetectorTable(Schema):
    """Which detectors are scored, on which data.

    Attributes:
        name: of the suite.
        detectors: names, with weights of your own as NAME=FILE, or module:object.
        data: "recorded", or the root of a data set in the nuScenes schema, with version (default: the one that is
            there) and split.
        recorded: what is recorded.
    """

    name: str
    detectors: Names = Field(default=["fcos3d-light", "pgd-det-light"], min_length=1)
    data: str = Field(default=RECORDED, min_length=1)
    version: str | None = None
    split: str = "val"
    recorded: Recorded = Recorded()


def detectors_of(
    table: DetectorTable, names: Sequence[str] | None = None, *, flat: bool = False
) -> tuple[dict[str, str], dict[str, str], dict[str, str]]:
    """By name of the detectors: versions of weights and own source; files of weights ("": shipped); tasks (2d, 3d).

    Args:
        table: Which names them.
        names: Those that are meant, as a suite writes them; None: `table.detectors`.
        flat: Whether 2D detectors with a class of nuScenes are welcome too.

    Raises:
        ConfigError: A detector appears twice, has no weights, or is not of the kind that is welcome.
    """
    weights: dict[str, str] = {}
    files: dict[str, str] = {}
    tasks: dict[str, str] = {}
    for text in table.detectors if names is None else names:
        name, file = split_weights(text)
        if name in files:
            raise ConfigError(
                f"suite {table.name}: detectors: {name} appears twice; tell two of a kind apart by a label, "
                f"{name}@mine=FILE"
            )
        path = str(Path(file).expanduser().resolve()) if file and file != "random" else file
        kind = Reference.of(name).name
        if not path and kind in DETECTORS and not (SHIPPED / f"{kind}.json").is_file():
            raise ConfigError(
                f"suite {table.name}: no weights of {kind} are shipped; give a file, {kind}=FILE "
                f"(docs/detectors.md: ssad train detector {kind}, or official ones)"
            )
        detector = detector_of(name, path, "cpu")
        tasks[name] = str(getattr(detector, "task", ""))
        if tasks[name] != "3d":
            if not flat:
                raise ConfigError(f"suite {table.name}: {name} finds 2D boxes; this suite takes 3D detectors")
            if not set(detector.classes) & set(MMDET3D_CLASSES):
                raise ConfigError(f"suite {table.name}: {name} knows none of the ten classes of nuScenes")
        own = f" {source_version(kind.partition(':')[0])}" if ":" in kind else ""
        weights[name], files[name] = state_hash(detector) + own, path
    return weights, files, tasks


def data_of(table: DetectorTable) -> dict[str, Any]:
    """What the results depend on of the data set, which is checked.

    Raises:
        ConfigError: There is no such version, split or scene.
        FormatError: The data set is broken.
    """
    if table.data == RECORDED:
        if table.split not in ("val", "all"):
            raise ConfigError(f"suite {table.name}: recorded data have the splits val and all, not '{table.split}'")
        return {**recording_of(table, Path(RECORDED)).identity(), "split": table.split}
    root = Path(table.data).expanduser()
    if not root.is_dir():
        raise ConfigError(f"suite {table.name}: data: {root} is no folder; give the root of a data set, or {RECORDED}")
    with NuScenes(root, table.version) as data:
        version, scenes = data.version, scenes_of(data, table.split)
    about: dict[str, Any] = {"version": version, "split": table.split, "scenes": list(scenes)}
    for name in ("sample", "sample_annotation", "sample_data", "calibrated_sensor"):
        content = safeio.read_bytes(root / version / f"{name}.json", limit=1 << 34)
        about[name] = hashlib.sha256(content).hexdigest()[:16]
    return about


def recording_of(table: DetectorTable, out: Path) -> Recording:
    """On the CPU, on any machine: it decides bits."""
    own = table.recorded
    towns = tuple(own.towns)
    return Recording(out, towns, towns, scenes=own.scenes, seconds=own.seconds, width=own.width, seed=own.seed)

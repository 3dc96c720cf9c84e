"""Data and detectors that a suite scores: resolved and checked, with everything that results depend on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import Field

from ssad.core import safeio
from ssad.core.checkpoints import state_hash
from ssad.core.errors import ConfigError
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.registry import Reference, split_weights
from ssad.core.schema import Names, Schema
from ssad.core.source import plugin_version
from ssad.datasets.nuscenes.camera_truth import scenes_of
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.detectors import DETECTORS, SHIPPED, file_prefix
from ssad.experiments.perception.scene_boxes import detector_of
from ssad.recorders.nuscenes import Recording
from ssad.rendering.target import Target, class_of_target

RECORDED = "recorded"


class RecordedData(Schema):
    """Validation set that is recorded by default: drives in towns that the shipped detectors never saw.

    Attributes:
        towns: towns of the drives.
        scenes: number of scenes in each town.
        seconds: length of a scene, with two samples a second.
        width: width of the images.
        seed: seed of the drives.
    """

    towns: Names = Field(default=["Oldmarket", "Larkhill"])
    scenes: int = Field(default=12, ge=1)
    seconds: float = Field(default=8.0, ge=0.5, allow_inf_nan=False)
    width: int = Field(default=800, ge=64)
    seed: int = Field(default=0, ge=0)


class DetectorTable(Schema):
    """Detectors to score and the data to score them on.

    Attributes:
        name: of the suite.
        detectors: names, with weights of your own as NAME=FILE, or module:object.
        data: "recorded", or the root of a data set in the nuScenes schema.
        version: version of that data set; default: the only one in the folder.
        split: split of that data set.
        recorded: settings of the recording.
    """

    name: str
    detectors: Names = Field(default=["fcos3d-light", "pgd-det-light"], min_length=1)
    data: str = Field(default=RECORDED, min_length=1)
    version: str | None = None
    split: str = "val"
    recorded: RecordedData = RecordedData()


class Victims(NamedTuple):
    """Detectors of a suite, by name.

    Attributes:
        weights: Hashes of weights and, for detectors of the user's own, of their source.
        files: Files of weights; "" for the shipped ones.
        tasks: 2d or 3d.
    """

    weights: dict[str, str]
    files: dict[str, str]
    tasks: dict[str, str]


def detectors_of(
    suite: str, entries: Sequence[str], *, allow_2d: bool = False, scenes: bool = True, targets: Iterable[Target] = ()
) -> Victims:
    """Build detectors once, and check that they fit the data.

    Args:
        suite: Name of the suite, for messages.
        entries: Detectors as the suite writes them.
        allow_2d: Whether 2D detectors are accepted too.
        scenes: Whether they are scored on scenes.
        targets: Targets that they are scored on.

    Raises:
        ConfigError: A detector appears twice, has no weights, or does not fit the data.
    """
    victims = Victims({}, {}, {})
    target_classes = list(dict.fromkeys(map(class_of_target, targets)))
    for entry in entries:
        name, weights_file = split_weights(entry)
        if name in victims.files:
            raise ConfigError(
                f"suite {suite}: detectors: {name} appears twice; tell two of a kind apart by a label, {name}@mine=FILE"
            )
        # Workers may run in another folder; "random" stands for untrained weights.
        path = (
            str(Path(weights_file).expanduser().resolve())
            if weights_file and weights_file != "random"
            else weights_file
        )
        detector_name = Reference.parse(name).name
        if not path and detector_name in DETECTORS and not (SHIPPED / f"{detector_name}.json").is_file():
            raise ConfigError(
                f"suite {suite}: no weights of {detector_name} are shipped; give a file, {detector_name}=FILE "
                f"(docs/how-to/train-detectors.md: ssad train detector {detector_name}, or official ones)"
            )
        detector = detector_of(name, path, "cpu")
        task = str(getattr(detector, "task", ""))
        if task != "3d" and not allow_2d:
            raise ConfigError(f"suite {suite}: {name} finds 2D boxes; this suite takes 3D detectors")
        if task != "3d" and scenes and not set(detector.classes) & set(MMDET3D_CLASSES):
            raise ConfigError(f"suite {suite}: {name} knows none of the ten classes of nuScenes")
        for class_name in target_classes:
            if class_name not in detector.classes:
                raise ConfigError(f"suite {suite}: {name} has no class {class_name}, which wears a texture or light")
        # The hash of an export's state is that of its file.
        is_export = bool(file_prefix(detector_name))
        source = "" if is_export else plugin_version("detector", DETECTORS, detector_name)
        victims.weights[name], victims.files[name] = " ".join(filter(None, (state_hash(detector), source))), path
        victims.tasks[name] = task
    return victims


def data_of(table: DetectorTable) -> dict[str, Any]:
    """Check the data set and return everything of it that the results depend on.

    Raises:
        ConfigError: Unknown version, split or scene.
        FormatError: The data set is broken.
    """
    if table.data == RECORDED:
        if table.split not in ("val", "all"):
            raise ConfigError(f"suite {table.name}: recorded data have the splits val and all, not '{table.split}'")
        return {**recording_of(table, Path(RECORDED)).identity(), "split": table.split}
    root = Path(table.data).expanduser()
    if not root.is_dir():
        raise ConfigError(f"suite {table.name}: data: {root} is no folder; give the root of a data set, or {RECORDED}")
    with NuScenes(root, table.version) as dataset:
        version, scenes = dataset.version, scenes_of(dataset, table.split)
    identity: dict[str, Any] = {"version": version, "split": table.split, "scenes": list(scenes)}
    for name in ("sample", "sample_annotation", "sample_data", "calibrated_sensor"):
        content = safeio.read_bytes(root / version / f"{name}.json", limit=1 << 34)
        identity[name] = hashlib.sha256(content).hexdigest()[:16]
    return identity


def recording_of(table: DetectorTable, out: Path) -> Recording:
    """Return the recording of a table; always on the CPU, because the device decides bits."""
    settings = table.recorded
    towns = tuple(settings.towns)
    return Recording(
        out, towns, towns, scenes=settings.scenes, seconds=settings.seconds, width=settings.width, seed=settings.seed
    )

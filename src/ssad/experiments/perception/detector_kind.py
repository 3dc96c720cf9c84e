"""Base of the open-loop kinds that score 3D detectors on recorded scenes under a condition."""

from __future__ import annotations

import tempfile
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field
from rich.console import Console

from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError
from ssad.core.images import save_picture
from ssad.core.machine import default_workers
from ssad.core.types import U8
from ssad.datasets.nuscenes.camera_truth import scenes_of
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SceneData
from ssad.engine.kind import Cell, Column, Job, Kind, Plan, Replay, Resources, SuiteBase
from ssad.engine.progress import Live
from ssad.engine.replay import difference
from ssad.engine.run import hash_artefacts
from ssad.experiments.perception.scene_boxes import (
    Examination,
    SceneCondition,
    boxes_path,
    find_boxes,
    forget_failures,
    score_scenes,
)
from ssad.experiments.perception.scored_data import RECORDED, DetectorTable, recording_of
from ssad.recorders.nuscenes import record_nuscenes
from ssad.scenarios.static.digital.defences import make_defence


class DetectorSuite(SuiteBase, DetectorTable):
    """Keys of suites that score 3D detectors.

    Attributes:
        replicates: Replicates of the bootstrap over scenes.
        timeout_s: Seconds that one scene under one condition, or one score, may take.
    """

    replicates: int = Field(default=100, ge=0, le=10_000)


class DetectorKind(Kind):
    """Kind whose cells are detectors under a condition; a shared piece of work is a scene under a condition."""

    columns: ClassVar[tuple[Column, ...]] = (
        Column("mAP", "mean average precision", "", "higher"),
        Column("NDS", "nuScenes detection score", "", "higher"),
        Column("AP_car", "average precision of cars", "", "higher"),
    )
    patience = 2

    @abstractmethod
    def scenes(self, cell: Cell, job: Job) -> Sequence[SceneCondition]:
        """Return the scenes of a cell, each under its condition."""

    @abstractmethod
    def condition(self, data: Any) -> SceneCondition:
        """Return a scene under its condition from the plain data of a piece."""

    @abstractmethod
    def settings(self, suite: Any) -> dict[str, Any]:
        """Return the settings of workers beside those of all kinds that score detectors."""

    def about(self, scenes: Mapping[str, SceneData]) -> dict[str, Any]:
        """Return further data of the scenes for the workers."""
        return {}

    @abstractmethod
    def sheet(self, examination: Examination, suite: Any, cell: Cell | None = None) -> tuple[Callable[[], U8], str]:
        """How the picture for the report is made, which shows the first detector at work, and its caption.

        Args:
            examination: Data, detectors, device.
            suite: The suite.
            cell: Whose condition alone is shown, beside the clean data; None: those of the suite.
        """

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Record the data set if none is given, and return its scenes and the settings of the workers."""
        suite: DetectorSuite = plan.suite
        root = Path(suite.data).expanduser()
        if suite.data == RECORDED:
            total = suite.recorded.scenes * len(suite.recorded.towns)
            with Live("recording", total, 0, console=resources.console, unit="scenes") as progress:
                root = record_nuscenes(
                    recording_of(suite, folder / "data"),
                    workers=resources.workers,
                    ray=resources.ray,
                    progress=progress.show,
                )
        with NuScenes(root, suite.version) as data:
            version = data.version
            scenes = {name: data.scene(name) for name in scenes_of(data, suite.split)}
            tokens = {name: scene.record.token for name, scene in scenes.items()}
        if not any(len(boxes) for scene in scenes.values() for boxes in scene.boxes.values()):
            raise ConfigError(
                f"suite {suite.name}: data: no scene of the split '{suite.split}' has ground truth: there is nothing "
                "to score; choose another split"
            )
        settings = {
            "root": str(root.resolve()),
            "version": version,
            "detectors": dict(plan.details),
            "seed": suite.seed,
            "replicates": suite.replicates,
            "scenes": tokens,
            "threads": max(1, default_workers() // (resources.workers or default_workers())),
            **self.settings(suite),
            **self.about(scenes),
        }
        job = Job(folder, plan.device, settings)
        # Stored failures of boxes would make the retried cells fail again at once.
        forget_failures(
            [boxes_path(folder, cell.system, condition) for cell in retry for condition in self.scenes(cell, job)]
        )
        return settings

    def make(self, name: str, data: Any, systems: Sequence[str], job: Job) -> None:
        """Find the boxes of one scene under one condition."""
        find_boxes(_examination(job), self.condition(data), systems)

    def result(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Return the scores of a cell; boxes that a shared piece failed to find are found alone."""
        examination, scenes = _examination(job), self.scenes(cell, job)
        for scene in scenes:
            find_boxes(examination, scene, [cell.system])
        folders = sorted({str(boxes_path(Path(), cell.system, scene).parent) for scene in scenes})
        return self.score(examination, cell, scenes, job) | {"artefacts": {"detections": folders}}

    def score(self, examination: Examination, cell: Cell, scenes: Sequence[SceneCondition], job: Job) -> dict[str, Any]:
        """Return the record of a cell whose boxes are there."""
        return score_scenes(examination, cell.system, scenes, replicates=job.settings["replicates"])

    def finish(self, plan: Plan, folder: Path) -> None:
        """Write the first detector's boxes to DIR/pictures/detections.jpg."""
        suite: DetectorSuite = plan.suite
        path = folder / "pictures" / "detections.jpg"
        root = folder / "data" if suite.data == RECORDED else Path(suite.data).expanduser()
        version = ""
        if not path.is_file():
            with NuScenes(root, suite.version) as data:
                version = data.version
        first_detector = next(iter(plan.details.items()))
        examination = Examination(
            folder,
            root,
            version,
            (first_detector,),
            suite.seed,
            plan.device,
            1,
        )
        make_picture, caption = self.sheet(examination, suite)
        if not path.is_file():
            try:
                save_picture(path, make_picture())
            except FormatError:  # a picture that cannot be read has failed its cells, which say so
                return
        safeio.write_atomic(path.with_name("pictures.json"), safeio.dump_json({path.name: caption}, indent=1) + "\n")

    def replay(self, plan: Plan, cell: Cell, record: Mapping[str, Any], folder: Path) -> Replay:
        """Find the boxes of the cell again, in an empty folder, and compare metrics and files."""
        quiet_resources = Resources(device=plan.device, console=Console(quiet=True))
        settings = self.prepare(plan, folder, quiet_resources)  # the data are there, or are recorded again
        with tempfile.TemporaryDirectory() as temporary:
            job = Job(Path(temporary), plan.device, settings)
            self.start(job)
            result = safeio.parse_json(safeio.dump_json(self.result(cell, job)))
            hashes = hash_artefacts(job.folder, result["artefacts"]["detections"])
        # last digits of boxes were seen to differ (the number of threads may be why); those of metrics are rounded
        equal_files = sum(record["hashes"].get(name) == digest for name, digest in hashes.items())
        examination = replace(_examination(job), folder=folder)
        system = examination.defended.get(cell.system, (cell.system, None))[0]
        examination = replace(examination, detectors=((system, dict(examination.detectors)[system]),))
        make_picture, _ = self.sheet(examination, plan.suite, cell)
        return Replay(
            cell,
            difference(record, result),
            picture=make_picture,
            compared=(
                f"{len(result['metrics'])} metrics, {equal_files} of {len(hashes)} files of boxes the same to the bit"
            ),
        )


def _examination(job: Job) -> Examination:
    settings = job.settings
    defended = {
        name: (detector, make_defence(kind, **options))
        for name, (detector, kind, options) in settings.get("defended", {}).items()
    }
    return Examination(
        job.folder,
        Path(settings["root"]),
        settings["version"],
        tuple(settings["detectors"].items()),
        settings["seed"],
        job.device,
        settings["threads"],
        defended,
    )

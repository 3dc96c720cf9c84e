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
    Condition,
    Examination,
    boxes_path,
    find_boxes,
    forget_failures,
    score_scenes,
)
from ssad.experiments.perception.scored_data import RECORDED, DetectorTable, recording_of
from ssad.recorders.nuscenes import record_nuscenes
from ssad.scenarios.static.digital.defences import make_defence


class DetectorSuite(SuiteBase, DetectorTable):
    """What suites say that score 3D detectors.

    Attributes:
        replicates: of the bootstrap over scenes.
        timeout_s: seconds that one scene under one condition, or one score, may take.
    """

    replicates: int = Field(default=100, ge=0, le=10_000)


class DetectorKind(Kind):
    """Cells are detectors under a condition; work is shared by scenes: a piece is a scene under a condition."""

    columns: ClassVar[tuple[Column, ...]] = (
        Column("mAP", "mean average precision", "", "higher"),
        Column("NDS", "nuScenes detection score", "", "higher"),
        Column("AP_car", "average precision of cars", "", "higher"),
    )
    patience = 2

    @abstractmethod
    def scenes(self, cell: Cell, job: Job) -> Sequence[Condition]:
        """The scenes of a cell, each under its condition."""

    @abstractmethod
    def condition(self, data: Any) -> Condition:
        """A scene under its condition from the plain data of a piece."""

    @abstractmethod
    def settings(self, suite: Any) -> dict[str, Any]:
        """What workers are told besides what all kinds that score detectors tell them."""

    def about(self, scenes: Mapping[str, SceneData]) -> dict[str, Any]:
        """What workers are told of the scenes besides their names."""
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
        """Records the data set if none is given; which scenes there are."""
        suite: DetectorSuite = plan.suite
        root = Path(suite.data).expanduser()
        if suite.data == RECORDED:
            total = suite.recorded.scenes * len(suite.recorded.towns)
            with Live("recording", total, 0, console=resources.console, unit="scenes") as live:
                root = record_nuscenes(
                    recording_of(suite, folder / "data"),
                    workers=resources.workers,
                    ray=resources.ray,
                    progress=live.show,
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
        forget_failures([boxes_path(folder, c.system, one) for c in retry for one in self.scenes(c, job)])
        return settings

    def make(self, name: str, data: Any, systems: Sequence[str], job: Job) -> None:
        """Boxes of one scene under one condition."""
        find_boxes(_examination(job), self.condition(data), systems)

    def result(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Scores of a cell; boxes that could not be found together with others are looked for alone."""
        examination, scenes = _examination(job), self.scenes(cell, job)
        for one in scenes:
            find_boxes(examination, one, [cell.system])
        folders = sorted({str(boxes_path(Path(), cell.system, one).parent) for one in scenes})
        return self.score(examination, cell, scenes, job) | {"artefacts": {"detections": folders}}

    def score(self, examination: Examination, cell: Cell, scenes: Sequence[Condition], job: Job) -> dict[str, Any]:
        """The record of a cell whose boxes are there."""
        return score_scenes(examination, cell.system, scenes, replicates=job.settings["replicates"])

    def finish(self, plan: Plan, folder: Path) -> None:
        """What the first detector sees: DIR/pictures/detections.jpg."""
        suite: DetectorSuite = plan.suite
        path = folder / "pictures" / "detections.jpg"
        root = folder / "data" if suite.data == RECORDED else Path(suite.data).expanduser()
        version = ""
        if not path.is_file():
            with NuScenes(root, suite.version) as data:
                version = data.version
        first = next(iter(plan.details.items()))
        settings = self.settings(suite)
        examination = Examination(
            folder, root, version, (first,), suite.seed, plan.device, 1, settings.get("calibration", "physical")
        )
        picture, caption = self.sheet(examination, suite)
        if not path.is_file():
            try:
                save_picture(path, picture())
            except FormatError:  # a picture that cannot be read has failed its cells, which say so
                return
        safeio.write_atomic(path.with_name("pictures.json"), safeio.dump_json({path.name: caption}, indent=1) + "\n")

    def replay(self, plan: Plan, cell: Cell, record: Mapping[str, Any], folder: Path) -> Replay:
        """Finds the boxes of the cell again, in an empty folder, and compares metrics and all else."""
        quiet = Resources(device=plan.device, console=Console(quiet=True))
        settings = self.prepare(plan, folder, quiet)  # the data are there, or are recorded again
        with tempfile.TemporaryDirectory() as temporary:
            job = Job(Path(temporary), plan.device, settings)
            self.start(job)
            result = safeio.parse_json(safeio.dump_json(self.result(cell, job)))
            files = hash_artefacts(job.folder, result["artefacts"]["detections"])
        # last digits of boxes were seen to differ (the number of threads may be why); those of metrics are rounded
        same = sum(record["hashes"].get(name) == value for name, value in files.items())
        examination = replace(_examination(job), folder=folder)
        system = examination.defended.get(cell.system, (cell.system, None))[0]
        examination = replace(examination, detectors=((system, dict(examination.detectors)[system]),))
        shown, _ = self.sheet(examination, plan.suite, cell)
        return Replay(
            cell,
            difference(record, result),
            picture=shown,
            compared=f"{len(result['metrics'])} metrics, {same} of {len(files)} files of boxes the same to the bit",
        )


def _examination(job: Job) -> Examination:
    own = job.settings
    defended = {
        name: (detector, make_defence(kind, **options))
        for name, (detector, kind, options) in own.get("defended", {}).items()
    }
    return Examination(
        job.folder,
        Path(own["root"]),
        own["version"],
        tuple(own["detectors"].items()),
        own["seed"],
        job.device,
        own["threads"],
        own.get("calibration", "physical"),
        defended,
    )

"""Kind `detection`: 3D detectors x distribution shifts x severities over a data set in the nuScenes schema.

It also has what other kinds that score 3D detectors under conditions need.
"""

from __future__ import annotations

import tempfile
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field
from rich.console import Console

from ssad.bench.kind import Cell, Column, Job, Kind, Names, Plan, Replay, Resources, SuiteBase
from ssad.bench.replay import difference
from ssad.bench.run import hash_artefacts
from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError
from ssad.core.images import save_picture
from ssad.core.types import U8
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SceneData
from ssad.evaluation.camera_truth import scenes_of
from ssad.evaluation.pictures import STRONG, detection_sheet
from ssad.evaluation.scene_boxes import (
    Condition,
    Examination,
    ShiftedScene,
    boxes_path,
    find_boxes,
    forget_failures,
    score_scenes,
)
from ssad.jobs.machine import default_workers
from ssad.jobs.progress import Live
from ssad.recording.nuscenes_recorder import record_nuscenes
from ssad.recording.scored_data import RECORDED, DetectorTable, data_of, detectors_of, recording_of
from ssad.scenarios.static.digital.defences import make_defence
from ssad.scenarios.static.shifts import KNOWN, SHIFTS, VERSIONS, ShiftSpec, dealt_severities

Severity = Annotated[int, Field(ge=1, le=5)] | Literal["random"]


class DetectorSuite(SuiteBase, DetectorTable):
    """What suites say that score 3D detectors.

    Attributes:
        replicates: of the bootstrap over scenes.
        timeout_s: seconds that one scene under one condition, or one score, may take.
    """

    replicates: int = Field(default=100, ge=0, le=10_000)


class DetectionSuite(DetectorSuite):
    """One table: 3D detectors x shifts x severities, beside the clean data; the first detector is the baseline of mCE.

    Attributes:
        shifts: names.
        severities: 1 to 5, or random (dealt to the scenes, all as often, give or take one; drawn by sample in the
            calibration of the paper).
        calibration: of the shifts.
    """

    kind: Literal["detection"]
    shifts: Names = Field(default=list(SHIFTS), min_length=1)
    severities: Annotated[list[Severity], Field(min_length=1)] = Field(default=[1, 2, 3, 4, 5, "random"], min_length=1)
    calibration: Literal["physical", "paper"] = "physical"


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


class Detection(DetectorKind):
    """See the module. Cells of all detectors share the work of shifting a scene: a piece is a scene under a shift."""

    name = "detection"
    suite = DetectionSuite
    factors = ("detector", "shift", "severity")

    def plan(self, suite: DetectionSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Detectors are built once, the data set is looked at."""
        lists: dict[str, Sequence[object]] = {"shift": suite.shifts, "severity": suite.severities}
        for what, values in lists.items():
            if len(set(values)) != len(values):
                raise ConfigError(f"suite {suite.name}: a {what} appears twice")
        for known in suite.shifts:
            ShiftSpec(known, calibration=suite.calibration)
        weights, detectors, _ = detectors_of(suite)
        data = data_of(suite)
        conditions: list[tuple[str | None, int | str]] = [
            (None, 0),
            *((shift, s) for shift in suite.shifts for s in suite.severities),
        ]
        cells = []
        for detector in detectors:
            for shift, severity in conditions:
                family = KNOWN[shift][0] if shift else "clean"
                fields = {"detector": detector, "shift": shift, "family": family, "severity": severity}
                spec = {"calibration": suite.calibration, "labels": "original"}
                title = f"{detector}/{shift or 'clean'}/{severity}"
                inputs = weights[detector], safeio.dump_json(data), device, suite.replicates
                cells.append(self.make_cell(title, detector, suite.seed, fields, spec, *inputs))
        versions = {"shifts": str(VERSIONS[suite.calibration])}
        return Plan(self, suite, device, tuple(cells), {"weights": weights, "data": data}, versions, detectors)

    def order(self, cell: Cell) -> float:
        """Clean first, then what the main table tells, the middle severity, the others."""
        severity = cell.fields["severity"]
        if cell.fields["shift"] is None:
            return 0
        return 1 if isinstance(severity, str) else 2 + abs(severity - 3)

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """Scenes whose boxes are still to be found."""
        scenes = self.scenes(cell, job)
        missing = [one for one in scenes if not boxes_path(job.folder, cell.system, one).is_file()]
        return {one.name: [one.shift, one.severity, one.scene] for one in missing}

    def scenes(self, cell: Cell, job: Job) -> list[ShiftedScene]:
        """See `DetectorKind`. A severity dealt to a scene is one of the five: nothing runs twice."""
        tokens: Mapping[str, str] = job.settings["scenes"]
        shift, severity = cell.fields["shift"], cell.fields["severity"]
        if shift is None or severity != "random" or cell.spec["calibration"] == "paper":
            return [ShiftedScene(shift, severity, scene) for scene in tokens]
        spec = ShiftSpec(shift, seed=cell.seed, calibration=cell.spec["calibration"])
        dealt = dealt_severities(spec, tokens.values())
        return [ShiftedScene(shift, dealt[token], scene) for scene, token in tokens.items()]

    def condition(self, data: Any) -> ShiftedScene:
        """See `DetectorKind`."""
        return ShiftedScene(*data)

    def settings(self, suite: DetectionSuite) -> dict[str, Any]:
        """See `DetectorKind`."""
        return {"calibration": suite.calibration}

    def sheet(
        self, examination: Examination, suite: DetectionSuite, cell: Cell | None = None
    ) -> tuple[Callable[[], U8], str]:
        """One moment under each shift."""
        shifts, severities = suite.shifts, suite.severities
        if cell is not None:
            shifts = [cell.fields["shift"]] if cell.fields["shift"] else []
            severities = [cell.fields["severity"]]
        severity = min([s for s in severities if isinstance(s, int)] or [STRONG], key=lambda s: abs(s - STRONG))
        caption = (
            f"What {examination.detectors[0][0]} finds (orange, score at least 0.3) and what is there (white), clean "
            f"and under each shift at severity {severity}."
        )
        return lambda: detection_sheet(examination, suite.split, shifts, severity), caption


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

"""Base of the open-loop kinds: detectors x perturbations x severities on recorded scenes and on recorded targets.

`perception` takes every perturbation; `detection`, `digital` and `physical` are presets of the same loop. A kind brings
the rows of its table, and says what a cell is scored on: scenes, or images of a target.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field
from rich.console import Console

from ssad.core import safeio
from ssad.core.errors import ConfigError, FormatError, UnknownNameError
from ssad.core.images import save_picture
from ssad.core.machine import default_workers, retain_freed_memory, start_warp_quietly
from ssad.core.protocols import Detector
from ssad.core.run_records import SHARE
from ssad.core.types import U8
from ssad.datasets.nuscenes.camera_truth import scenes_of
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SceneData
from ssad.detectors import cached_detector
from ssad.engine.kind import Cell, CellError, Column, Job, Kind, Plan, Replay, Resources, SuiteBase
from ssad.engine.progress import LiveProgress
from ssad.engine.replay import describe_difference
from ssad.engine.run import hash_artefacts
from ssad.experiments.perception.physical.lit_images import RelightableTargetImages
from ssad.experiments.perception.scene_boxes import (
    Examination,
    SceneCondition,
    boxes_path,
    find_boxes,
    forget_failures,
    score_scenes,
)
from ssad.experiments.perception.scored_data import (
    RECORDED,
    DetectorTable,
    Victims,
    data_of,
    detectors_of,
    recording_of,
)
from ssad.metrics.target_attacks import TargetSighting, precision, sightings, target_scores
from ssad.recorders.nuscenes import record_nuscenes
from ssad.recorders.target_images import record_all
from ssad.recorders.target_recording import TargetRecording
from ssad.scenarios.static.catalogue import registered_names
from ssad.scenarios.static.digital.defences import make_defence
from ssad.scenarios.static.perturbation import Perturbation


class DetectorSuite(SuiteBase, DetectorTable):
    """Keys of suites that score 3D detectors.

    Attributes:
        replicates: Replicates of the bootstrap over scenes.
        timeout_s: Seconds that one scene under one condition, or one score, may take.
    """

    replicates: int = Field(default=100, ge=0, le=10_000)


@dataclass(frozen=True, slots=True)
class CellDescription:
    """A system under a perturbation, or under none, as plain data.

    Attributes:
        title: Title of the cell.
        system: Name of a detector, or of one behind a defence.
        fields: Columns of its record; `detector` is one of them.
        spec: All that a worker needs.
        inputs: What the result depends on besides detector, data, device and the settings of the bootstrap.
    """

    title: str
    system: str
    fields: Mapping[str, Any]
    spec: Mapping[str, Any]
    inputs: Sequence[object] = ()


@dataclass(frozen=True, slots=True)
class TargetCondition:
    """Recorded images of a target under one perturbation.

    Attributes:
        images: The images.
        perturbation: The perturbation; None: the images are clean.
        name: The target in words.
        floor: AP50 of the clean images below which a perturbation has no score; None: that of the suite.
    """

    images: RelightableTargetImages
    perturbation: Perturbation | None
    name: str
    floor: float | None = None


Sightings = Sequence[TargetSighting]


class OpenLoopKind(Kind):
    """Kind whose cells are detectors under a perturbation, scored on scenes or on images of a target.

    A shared piece of work is a scene under a perturbation.

    Attributes:
        families: Key of a suite -> family of the perturbations that it names.
    """

    families: ClassVar[Mapping[str, str]] = {}

    columns: ClassVar[tuple[Column, ...]] = (
        Column("mAP", "mean average precision", "", "higher", limits=SHARE),
        Column("NDS", "nuScenes detection score", "", "higher", limits=SHARE),
        Column("AP_car", "average precision of cars", "", "higher", limits=SHARE),
    )
    patience: ClassVar[int | None] = 2

    def check(self, suite: Any) -> None:
        """Raise SSADError for wrong perturbations of a suite, before detectors are built."""

    def victims(self, suite: Any) -> Victims:
        """Return the detectors of a suite; by default those under its key `detectors`, which must be 3D.

        Raises:
            ConfigError: A detector does not fit the data.
        """
        return detectors_of(suite.name, suite.detectors)

    def data(self, suite: Any) -> dict[str, Any]:
        """Return what the results depend on of the recorded scenes of a suite; {}: it needs none."""
        return data_of(suite) if isinstance(suite, DetectorSuite) else {}

    def rows(self, suite: Any, victims: Victims, data: Mapping[str, Any]) -> Iterable[CellDescription]:
        """Return the rows of the table of a suite, in order."""
        raise NotImplementedError

    def versions(self, suite: Any) -> Mapping[str, str]:
        """Return versions that decide results, beside those of the packages."""
        return {}

    def plan(self, suite: Any, *, device: str = "cpu", check: bool = True) -> Plan:
        """Build perturbations and detectors once, and inspect the data."""
        try:
            self.check(suite)
        except UnknownNameError as error:
            self._check_families(suite, error)
            raise
        victims = self.victims(suite)
        data = self.data(suite)
        cells: dict[str, Cell] = {}
        for row in self.rows(suite, victims, data):
            inputs = victims.weights[row.fields["detector"]], device, suite.replicates, *row.inputs
            cell = self.make_cell(row.title, row.system, suite.seed, row.fields, row.spec, *inputs)
            cells.setdefault(cell.key, cell)
        inputs_by_name = {"weights": victims.weights, **({"data": data} if data else {})}
        return Plan(self, suite, device, tuple(cells.values()), inputs_by_name, self.versions(suite), victims.files)

    def _check_families(self, suite: Any, error: UnknownNameError) -> None:
        """Raise UnknownNameError if the unknown name of an error is registered in another family."""
        for key, family in self.families.items():
            for name in (getattr(entry, "name", entry) for entry in getattr(suite, key)):
                registered_family = registered_names().get(name, family)
                if registered_family != family and f"'{name}'" in str(error):
                    raise UnknownNameError(
                        f"suite {suite.name}: {key}: '{name}' is of the family {registered_family}, not {family}; "
                        "suites of kind perception take every family"
                    ) from None

    def scenes(self, cell: Cell, job: Job) -> Sequence[SceneCondition]:
        """Return the scenes that a cell is scored on, each under its perturbation; none for a cell of a target."""
        return ()

    def compared_scenes(self, cell: Cell, job: Job) -> Sequence[SceneCondition]:
        """Return further scenes, whose boxes those of a cell are compared with."""
        return ()

    def target(self, cell: Cell, job: Job, detector: Detector) -> TargetCondition:
        """Return the images of a target that a cell without scenes is scored on, for a detector."""
        raise NotImplementedError

    def target_columns(
        self, cell: Cell, job: Job, condition: TargetCondition, clean: Sightings, attacked: Sightings | None
    ) -> dict[str, Any]:
        """Return further columns of the record of a cell without scenes.

        Args:
            cell: The cell.
            job: Data that the workers share.
            condition: Its images and its perturbation.
            clean: Detections in the clean images.
            attacked: Detections under the perturbation; None for a clean cell.
        """
        return {}

    def settings(self, suite: Any, scenes: Mapping[str, SceneData]) -> dict[str, Any]:
        """Return further settings of the workers."""
        return {}

    def recordings(self, plan: Plan, folder: Path) -> list[TargetRecording]:
        """Return the recordings of targets that a plan needs, below a results folder."""
        return []

    def sheet(self, examination: Examination, suite: Any, cell: Cell | None = None) -> tuple[Callable[[], U8], str]:
        """Return the maker of the picture for the report, which shows the first detector on scenes, and its caption.

        Args:
            examination: Data, detectors, device.
            suite: The suite.
            cell: Whose perturbation alone is shown, beside the clean data; None: those of the suite.
        """
        raise NotImplementedError

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Record the scenes and targets that are needed, and return the settings of the workers."""
        suite = plan.suite
        settings = {
            "detectors": dict(plan.details),
            "seed": suite.seed,
            "replicates": suite.replicates,
            "threads": max(1, default_workers() // (resources.workers or default_workers())),
        }
        scenes: dict[str, SceneData] = {}
        if "data" in plan.inputs:
            root, version, scenes = _recorded_scenes(suite, folder, resources)
            tokens = {name: scene.record.token for name, scene in scenes.items()}
            settings |= {"root": str(root.resolve()), "version": version, "scenes": tokens}
        recordings = self.recordings(plan, folder)
        if recordings:
            with LiveProgress("recording targets", 1, 0, console=resources.console, unit="parts") as progress:
                record_all(recordings, workers=resources.workers, ray=resources.ray, progress=progress.show)
        settings |= self.settings(suite, scenes)
        job = Job(folder, plan.device, settings)
        # Stored failures of boxes would make the retried cells fail again at once.
        forget_failures(
            [boxes_path(folder, cell.system, condition) for cell in retry for condition in self.scenes(cell, job)]
        )
        return settings

    def start(self, job: Job) -> None:
        """Keep the memory of tensors, and silence Warp."""
        retain_freed_memory()
        start_warp_quietly()

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """Return the scenes whose boxes are still to be found, by name, with a cell that they belong to."""
        conditions = [*self.compared_scenes(cell, job), *self.scenes(cell, job)]
        return {
            condition.name: cell
            for condition in conditions
            if not boxes_path(job.folder, cell.system, condition).is_file()
        }

    def make(self, name: str, data: Any, systems: Sequence[str], job: Job) -> None:
        """Find the boxes of one scene under one perturbation."""
        conditions = [*self.compared_scenes(data, job), *self.scenes(data, job)]
        find_boxes(_examination(job), next(condition for condition in conditions if condition.name == name), systems)

    def result(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Return the scores of a cell; boxes that a shared piece failed to find are found alone.

        Raises:
            CellError: The detector does not find the clean target.
        """
        scenes = self.scenes(cell, job)
        if not scenes:
            return self._target_result(cell, job)
        examination = _examination(job)
        for scene in scenes:
            find_boxes(examination, scene, [cell.system])
        folders = sorted({str(boxes_path(Path(), cell.system, scene).parent) for scene in scenes})
        return self.score(examination, cell, scenes, job) | {"artefacts": {"detections": folders}}

    def _target_result(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Return the scores of a cell on images of its target."""
        settings, weights = job.settings, job.settings["detectors"].get(cell.system) or None
        detector = cached_detector(cell.system, weights=weights, device=job.device)
        condition = self.target(cell, job, detector)
        images, perturbation = condition.images, condition.perturbation
        bootstrap = {"replicates": settings["replicates"], "seed": settings["seed"]}
        if perturbation is None or type(perturbation).clean_target is Perturbation.clean_target:
            clean = _clean_sightings(images, cell.system, weights)
        else:
            clean = tuple(sightings(detector, perturbation.clean_target(images)))
        if perturbation is None:
            return target_scores(clean, **bootstrap) | self.target_columns(cell, job, condition, clean, None)
        clean_precision = round(precision(clean) or 0.0, 6)
        floor = settings["floor"] if condition.floor is None else condition.floor
        if clean_precision < floor:  # what is not found anyway cannot be hidden
            raise CellError(
                f"{cell.system} finds the clean {condition.name} with AP50 {clean_precision:.3f}, which is less than "
                f"the floor of {floor:g}"
            )
        attacked = tuple(sightings(detector, perturbation.on_target(images)))
        scores = target_scores(attacked, clean, floor=settings["floor"], **bootstrap) | {"clean_AP50": clean_precision}
        return scores | self.target_columns(cell, job, condition, clean, attacked)

    def score(self, examination: Examination, cell: Cell, scenes: Sequence[SceneCondition], job: Job) -> dict[str, Any]:
        """Return the record of a cell whose boxes are there."""
        return score_scenes(examination, cell.system, scenes, replicates=job.settings["replicates"])

    def finish(self, plan: Plan, folder: Path) -> None:
        """Write the first detector's boxes to DIR/pictures/detections.jpg, if scenes are scored."""
        if "data" not in plan.inputs:
            return
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
        """Find the boxes of the cell again, in an empty folder, and compare metrics and files.

        Raises:
            ConfigError: The cell is one of a target.
        """
        if "detections" not in record["artefacts"]:
            raise ConfigError(f"{folder}: cells that are scored on images of a target cannot be replayed")
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
            describe_difference(record, result),
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


def _recorded_scenes(
    suite: DetectorSuite, folder: Path, resources: Resources
) -> tuple[Path, str, dict[str, SceneData]]:
    """Record the data set of a suite if none is given; return its root, its version and the scenes of the split."""
    root = Path(suite.data).expanduser()
    if suite.data == RECORDED:
        total = suite.recorded.scenes * len(suite.recorded.towns)
        with LiveProgress("recording", total, 0, console=resources.console, unit="scenes") as progress:
            root = record_nuscenes(
                recording_of(suite, folder / "data"),
                workers=resources.workers,
                ray=resources.ray,
                progress=progress.show,
            )
    with NuScenes(root, suite.version) as data:
        version = data.version
        scenes = {name: data.scene(name) for name in scenes_of(data, suite.split)}
    if not any(len(boxes) for scene in scenes.values() for boxes in scene.boxes.values()):
        raise ConfigError(
            f"suite {suite.name}: data: no scene of the split '{suite.split}' has ground truth: there is nothing "
            "to score; choose another split"
        )
    return root, version, scenes


@lru_cache(maxsize=8)
def _clean_sightings(images: RelightableTargetImages, detector: str, weights: str | None) -> tuple[TargetSighting, ...]:
    """Return a detector's sightings in clean images, which all cells of a target are compared with."""
    return tuple(sightings(cached_detector(detector, weights=weights, device=images.device), images.clean()))

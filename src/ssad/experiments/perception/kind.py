"""Kind `perception`: detectors x perturbations of any family, on recorded scenes and on recorded images of a target.

The kinds `detection`, `digital` and `physical` are presets of the same open loop, with the tables of the paper: all
severities of shifts, sweeps and transfer of attacks, and textures that are trained on the way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.types import U8
from ssad.datasets.nuscenes.scene import SceneData
from ssad.engine.kind import Cell, CellError, Column, Job, Plan, Resources
from ssad.engine.progress import Live
from ssad.experiments.perception.detector_kind import DetectorKind, DetectorSuite
from ssad.experiments.perception.physical.target_attacks import TargetAttacks
from ssad.experiments.perception.physical.target_views import TargetClips
from ssad.experiments.perception.scene_boxes import (
    Examination,
    SceneCondition,
    boxes_path,
    score_scenes,
    sum_applied,
)
from ssad.experiments.perception.scored_data import data_of, detectors_of
from ssad.experiments.perception.sheets import detection_sheet
from ssad.metrics.target_attacks import Sighting, precision, sightings, target_scores
from ssad.recorders.target_images import record_all
from ssad.recorders.target_recording import Clips
from ssad.rendering.target import Target, TargetCar, class_of_target, parse_target
from ssad.scenarios.static.catalogue import NONE, PerturbationTable, parse_perturbation
from ssad.scenarios.static.digital.perturbation import DigitalAttack
from ssad.scenarios.static.digital.tally import sum_notes
from ssad.scenarios.static.perturbation import Perturbation
from ssad.world.roads import is_town

SCENES = "scenes"
"""Data of the cells that recorded scenes are scored in; the others name their target."""


class PerceptionSuite(DetectorSuite, PerturbationTable):
    """Detectors x perturbations x severities.

    Shifts, digital attacks and faults are scored on `data`, by mAP and NDS of 3D detectors and AP50 of 2D ones.
    Textures and lights are scored on images of the target that wears them, by AP50 and attack success rate.

    Attributes:
        target_town: Town in which targets are recorded.
        target_images: Number of images of each target.
        target_size: Side of the square images of targets, pixels.
        floor: AP50 of the clean target below which no texture or light is reported.
    """

    kind: Literal["perception"] = "perception"
    target_town: str = "Oldmarket"
    target_images: int = Field(default=60, ge=1)
    target_size: int = Field(default=640, ge=128, le=4096)
    floor: float = Field(default=0.9, ge=0.0, le=1.0)

    def beside(self, path: Path) -> Self:
        """Return the suite with the files of its perturbations resolved."""
        return super().beside(path).with_files_beside(path.parent)


class Perception(DetectorKind):
    """Kind `perception`. A piece is a scene under a perturbation, shown to all detectors unless it attacks one."""

    name = "perception"
    suite = PerceptionSuite
    columns = (
        *DetectorKind.columns,
        Column("AP50", "AP50 of the target", "", "lower"),
        Column("ASR_25", "attack success rate at 0.25", "", "higher"),
        Column("ASR_50", "attack success rate at 0.5", "", "higher"),
    )
    factors = ("data", "detector", "perturbation", "severity")

    def plan(self, suite: PerceptionSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Build detectors and perturbations once, and inspect the data set."""
        suite.conditions()
        weights, detectors, tasks = detectors_of(suite, flat=True)
        if not is_town(suite.target_town):
            raise ConfigError(f"suite {suite.name}: unknown town '{suite.target_town}' (see: ssad list towns)")
        pairs = [
            (made, entry.model_dump(mode="json"))
            for entry in suite.perturbations
            for made in entry.at(suite.severities)
        ]
        on_scenes = [pair for pair in pairs if not pair[0].needs_target]
        targets: dict[str, list[tuple[Perturbation, Any]]] = {}
        spellings: dict[Target, str] = {}  # "sedan" and "sedan:silver:0" are one target, recorded once
        for pair in pairs:
            if pair[0].needs_target:
                spelling = spellings.setdefault(parse_target(pair[0].target), pair[0].target)
                targets.setdefault(spelling, []).append(pair)
        data = data_of(suite) if on_scenes or not targets else {}
        cells = []
        for detector in detectors:
            conditions: list[tuple[str, Perturbation | None, Any]] = []
            if data:
                conditions += [(SCENES, None, None), *((SCENES, *pair) for pair in on_scenes)]
            for target, worn in targets.items():
                self._check_target(suite, detector, target)
                conditions += [(target, None, None), *((target, *pair) for pair in worn)]
            for place, perturbation, entry in conditions:
                name = NONE if perturbation is None else perturbation.name
                severity = 0 if perturbation is None else perturbation.severity
                fields = {
                    "data": place,
                    "detector": detector,
                    "task": tasks[detector],
                    "perturbation": name,
                    "severity": severity,
                    "family": NONE if perturbation is None else perturbation.family,
                }
                spec = {"perturbation": entry, "severity": severity}
                inputs = [weights[detector], device, suite.replicates]
                inputs += [safeio.dump_json(data)] if place == SCENES else [self._target_inputs(suite)]
                inputs += [] if perturbation is None else [perturbation.version()]
                title = f"{detector}/{place}/{name}" + (f"-{severity}" if severity else "")
                cells.append(self.make_cell(title, detector, suite.seed, fields, spec, *inputs))
        return Plan(self, suite, device, tuple(cells), {"weights": weights, "data": data}, {}, detectors)

    @staticmethod
    def _check_target(suite: PerceptionSuite, detector: str, target: str) -> None:
        """Raise ConfigError for a detector without the class of a target."""
        from ssad.detectors import make_detector

        class_name = class_of_target(parse_target(target))
        if class_name not in make_detector(detector).classes:
            raise ConfigError(
                f"suite {suite.name}: {detector} has no class {class_name}, which wears a texture or light"
            )

    @staticmethod
    def _target_inputs(suite: PerceptionSuite) -> str:
        """Return the settings that decide the images of targets."""
        return f"{suite.target_town} {suite.target_images} {suite.target_size} {suite.floor}"

    def order(self, cell: Cell) -> float:
        """Return the priority of a cell: clean first."""
        return float(cell.spec["perturbation"] is not None)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Record the data set and the images of targets that the suite needs."""
        suite: PerceptionSuite = plan.suite
        places = {cell.fields["data"] for cell in plan.cells}
        settings: dict[str, Any] = {"root": "", "version": "", "detectors": dict(plan.details), "threads": 1}
        if SCENES in places:
            scene_cells = [cell for cell in retry if cell.fields["data"] == SCENES]
            settings = super().prepare(plan, folder, resources, retry=scene_cells)
        recordings = [recording_of_target(suite, target, folder, plan.device) for target in sorted(places - {SCENES})]
        if recordings:
            with Live("recording targets", 1, 0, console=resources.console, unit="parts") as progress:
                record_all(recordings, workers=resources.workers, ray=resources.ray, progress=progress.show)
        return settings | {
            "seed": suite.seed,
            "replicates": suite.replicates,
            "floor": suite.floor,
            "target_images": suite.target_images,
        }

    def scenes(self, cell: Cell, job: Job) -> list[SceneCondition]:
        """Return the scenes of a cell under its perturbation; none for a cell of a target."""
        if cell.fields["data"] != SCENES:
            return []
        return [scene_condition(cell.spec, scene, cell.system) for scene in job.settings["scenes"]]

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """Return the scenes whose boxes are still to be found."""
        missing = [
            condition
            for condition in self.scenes(cell, job)
            if not boxes_path(job.folder, cell.system, condition).is_file()
        ]
        return {
            condition.name: {**cell.spec, "scene": condition.scene, "source": condition.source} for condition in missing
        }

    def condition(self, data: Any) -> SceneCondition:
        """Return the perturbed scene of a piece."""
        return scene_condition(data, data["scene"], data["source"])

    def settings(self, suite: Any) -> dict[str, Any]:
        """Return no further settings."""
        return {}

    def about(self, scenes: Mapping[str, SceneData]) -> dict[str, Any]:
        """Return no further data."""
        return {}

    def score(self, examination: Examination, cell: Cell, scenes: Sequence[SceneCondition], job: Job) -> dict[str, Any]:
        """Return the scores of a cell, and the cost of an attack."""
        is_attack = isinstance(scenes[0].perturbation, DigitalAttack)
        notes = sum_notes if is_attack else sum_applied
        return score_scenes(examination, cell.system, scenes, replicates=job.settings["replicates"], notes=notes)

    def result(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Return the scores of a cell on scenes, or on images of its target.

        Raises:
            CellError: The detector does not find the clean target.
        """
        target, settings = cell.fields["data"], job.settings
        if target == SCENES:
            return super().result(cell, job)
        attacks = TargetAttacks(job.folder, target, settings["seed"], job.device)
        images = attacks.clips(target_folder(target), settings["target_images"], cell.system)
        perturbation = perturbation_of(cell.spec)
        bootstrap = {"replicates": settings["replicates"], "seed": settings["seed"]}
        if perturbation is None:
            return target_scores(_clean_sightings(images, cell.system), **bootstrap)
        detector = attacks.detector(cell.system)
        clean = list(sightings(detector, perturbation.clean_target(images)))
        clean_precision = check_floor(clean, settings["floor"], f"{cell.system} finds the clean {target}")
        attacked = list(sightings(detector, perturbation.on_target(images)))
        return target_scores(attacked, clean, **bootstrap) | {"clean_AP50": clean_precision}

    def finish(self, plan: Plan, folder: Path) -> None:
        """Write the first detector's boxes to DIR/pictures/detections.jpg, if scenes are scored."""
        if any(cell.fields["data"] == SCENES for cell in plan.cells):
            super().finish(plan, folder)

    def sheet(
        self, examination: Examination, suite: PerceptionSuite, cell: Cell | None = None
    ) -> tuple[Callable[[], U8], str]:
        """Return a picture of one moment under each perturbation, and its caption."""
        perturbations = [one for one in suite.conditions() if not one.needs_target]
        if cell is not None:
            chosen = perturbation_of(cell.spec) if cell.fields["data"] == SCENES else None
            perturbations = [] if chosen is None else [chosen]
        caption = (
            f"What {examination.detectors[0][0]} finds (orange, score at least 0.3) and what is there (white), clean "
            "and under each perturbation."
        )
        return lambda: detection_sheet(examination, suite.split, perturbations), caption


def perturbation_of(spec: Mapping[str, Any]) -> Perturbation | None:
    """Return the perturbation of a cell or a piece; None for a clean one."""
    return None if spec["perturbation"] is None else parse_perturbation(spec["perturbation"]).make(spec["severity"])


def scene_condition(spec: Mapping[str, Any], scene: str, system: str) -> SceneCondition:
    """Return a scene under the perturbation of a cell; a system is its source only if the perturbation attacks one."""
    perturbation = perturbation_of(spec)
    attacks = perturbation is not None and perturbation.needs_victim
    return SceneCondition(scene, perturbation, system if attacks else "")


def target_folder(target: str) -> str:
    """Return the folder of the images of a target, below `data`."""
    return f"target-{target.replace(':', '-')}"


def recording_of_target(suite: PerceptionSuite, target: str, folder: Path, device: str) -> Clips:
    """Return the recording of a target: a car that drives ahead, a walker or a sign from all sides."""
    parsed = parse_target(target)
    return Clips(
        folder / "data" / target_folder(target),
        ((suite.target_town, suite.target_images),),
        held_out=(),
        mode="drive" if isinstance(parsed, TargetCar) else "orbit",
        size=suite.target_size,
        target=parsed,
        seed=suite.seed,
        device=device,
    )


def check_floor(clean: Sequence[Sighting], floor: float, finding: str) -> float:
    """Return AP50 of the clean target.

    Raises:
        CellError: It is below the floor: an attack cannot hide a target that is not found anyway.
    """
    clean_precision = round(precision(clean) or 0.0, 6)
    if clean_precision < floor:
        raise CellError(f"{finding} with AP50 {clean_precision:.3f}, which is less than the floor of {floor:g}")
    return clean_precision


@lru_cache(maxsize=8)
def _clean_sightings(images: TargetClips, detector: str) -> tuple[Sighting, ...]:
    """Return a detector's sightings in the images as recorded."""
    from ssad.detectors import make_detector

    return tuple(sightings(make_detector(detector, device=images.device), images.clean()))

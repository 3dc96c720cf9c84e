"""Kind `perception`: detectors x perturbations of any family, on recorded scenes and on recorded images of a target.

The kinds `detection`, `digital` and `physical` are presets of the same open loop, with the tables of the paper: all
severities of shifts, sweeps and transfer of attacks, and textures that are trained on the way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.core.run_records import COUNT, SHARE
from ssad.core.types import U8
from ssad.datasets.nuscenes.scene import SceneData
from ssad.engine.kind import Cell, Column, Job, Plan
from ssad.experiments.perception.open_loop import CellDescription, DetectorSuite, OpenLoopKind, TargetCondition
from ssad.experiments.perception.physical.lit_images import RelightableTargetImages
from ssad.experiments.perception.scene_boxes import Examination, SceneCondition, score_scenes, sum_applied
from ssad.experiments.perception.scored_data import Victims, data_of, detectors_of
from ssad.experiments.perception.sheets import detection_sheet
from ssad.metrics.attack_success import rate_note
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.target import Target, TargetCar, parse_target
from ssad.report.load import Run
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
        floor: AP50 of the clean target below which no texture or light is reported; share of the images in which the
            clean target is found, below which no attack success rate at that score is.
    """

    kind: Literal["perception"] = "perception"
    target_town: str = "Oldmarket"
    target_images: int = Field(default=60, ge=1)
    target_size: int = Field(default=640, ge=128, le=4096)
    floor: float = Field(default=0.9, ge=0.0, le=1.0)

    def beside(self, path: Path) -> Self:
        """Return the suite with the files of its perturbations resolved."""
        return super().beside(path).with_files_beside(path.parent)


class Perception(OpenLoopKind):
    """Kind `perception`. A piece is a scene under a perturbation, shown to all detectors unless it attacks one."""

    name = "perception"
    suite = PerceptionSuite
    columns = (
        *OpenLoopKind.columns,
        Column("AP50", "AP50 of the target", "", "lower", limits=SHARE),
        Column("ASR_25", "attack success rate at 0.25", "", "higher", limits=SHARE),
        Column("n0_25", "n0 at 0.25", limits=COUNT),
        Column("ASR_50", "attack success rate at 0.5", "", "higher", limits=SHARE),
        Column("n0_50", "n0 at 0.5", limits=COUNT),
    )
    factors = ("data", "detector", "perturbation", "severity")

    def check(self, suite: PerceptionSuite) -> None:
        """Build the perturbations."""
        suite.conditions()
        if not is_town(suite.target_town):
            raise ConfigError(f"suite {suite.name}: unknown town '{suite.target_town}' (see: ssad list towns)")

    def victims(self, suite: PerceptionSuite) -> Victims:
        """Return the detectors of the suite."""
        places = conditions_by_place(suite)
        targets = [parse_target(place) for place in places if place != SCENES]
        return detectors_of(suite.name, suite.detectors, allow_2d=True, scenes=SCENES in places, targets=targets)

    def data(self, suite: PerceptionSuite) -> dict[str, Any]:
        """Return what the results depend on of the recorded scenes, if a perturbation acts on them."""
        return data_of(suite) if SCENES in conditions_by_place(suite) else {}

    def rows(self, suite: PerceptionSuite, victims: Victims, data: Mapping[str, Any]) -> Iterator[CellDescription]:
        """Yield, for scenes and each target, the clean data and those under each perturbation."""
        target_inputs = f"{suite.target_town} {suite.target_images} {suite.target_size} {suite.floor}"
        for detector, (place, conditions) in product(victims.files, conditions_by_place(suite).items()):
            for perturbation, entry in [(None, None), *conditions]:
                name = NONE if perturbation is None else perturbation.name
                severity = 0 if perturbation is None else perturbation.severity
                fields = {
                    "data": place,
                    "detector": detector,
                    "task": victims.tasks[detector],
                    "perturbation": name,
                    "severity": severity,
                    "family": NONE if perturbation is None else perturbation.family,
                }
                inputs = [safeio.dump_json(data) if place == SCENES else target_inputs]
                inputs += [] if perturbation is None else [perturbation.version()]
                title = f"{detector}/{place}/{name}" + (f"-{severity}" if severity else "")
                yield CellDescription(title, detector, fields, {"perturbation": entry, "severity": severity}, inputs)

    def order(self, cell: Cell) -> float:
        """Return the priority of a cell: clean first."""
        return float(cell.spec["perturbation"] is not None)

    def recordings(self, plan: Plan, folder: Path) -> list[TargetRecording]:
        """Return the recordings of the targets."""
        targets = {cell.fields["data"] for cell in plan.cells} - {SCENES}
        return [recording_of_target(plan.suite, target, folder, plan.device) for target in sorted(targets)]

    def settings(self, suite: PerceptionSuite, scenes: Mapping[str, SceneData]) -> dict[str, Any]:
        """Return the floor of targets, and their number of images."""
        return {"floor": suite.floor, "target_images": suite.target_images}

    def scenes(self, cell: Cell, job: Job) -> list[SceneCondition]:
        """Return the scenes of a cell; a system is their source only if the perturbation attacks one."""
        if cell.fields["data"] != SCENES:
            return []
        perturbation = perturbation_of(cell)
        source = cell.system if perturbation is not None and perturbation.needs_victim else ""
        return [SceneCondition(scene, perturbation, source) for scene in job.settings["scenes"]]

    def score(self, examination: Examination, cell: Cell, scenes: Sequence[SceneCondition], job: Job) -> dict[str, Any]:
        """Return the scores of a cell, and the cost of an attack."""
        is_attack = isinstance(scenes[0].perturbation, DigitalAttack)
        notes = sum_notes if is_attack else sum_applied
        return score_scenes(examination, cell.system, scenes, replicates=job.settings["replicates"], notes=notes)

    def target(self, cell: Cell, job: Job, detector: Detector) -> TargetCondition:
        """Return the images of the cell's target, and its perturbation."""
        target: str = cell.fields["data"]
        folder = job.folder / "data" / target_folder(target)
        images = RelightableTargetImages.of(folder, job.settings["target_images"], detector, job.device)
        return TargetCondition(images, perturbation_of(cell), target)

    def note(self, run: Run) -> str:
        """Return the meaning of n0, and the floor of attack success rates."""
        return rate_note(run.suite["floor"]) if "floor" in run.suite else ""

    def sheet(
        self, examination: Examination, suite: PerceptionSuite, cell: Cell | None = None
    ) -> tuple[Callable[[], U8], str]:
        """Return a picture of one moment under each perturbation, and its caption."""
        perturbations = [one for one in suite.conditions() if not one.needs_target]
        if cell is not None:
            chosen = perturbation_of(cell) if cell.fields["data"] == SCENES else None
            perturbations = [] if chosen is None else [chosen]
        caption = (
            f"What {examination.detectors[0][0]} finds (orange, score at least 0.3) and what is there (white), clean "
            "and under each perturbation."
        )
        return lambda: detection_sheet(examination, suite.split, perturbations), caption


def conditions_by_place(suite: PerceptionSuite) -> dict[str, list[tuple[Perturbation, Any]]]:
    """Return the perturbations of a suite, each with its entry as data, by `SCENES` or the target that they act on."""
    places: dict[str, list[tuple[Perturbation, Any]]] = {SCENES: []}
    spellings: dict[Target, str] = {}  # "sedan" and "sedan:silver:0" are one target, recorded once
    for entry in suite.perturbations:
        for perturbation in entry.at(suite.severities):
            place = SCENES
            if perturbation.needs_target:
                place = spellings.setdefault(parse_target(perturbation.target), perturbation.target)
            places.setdefault(place, []).append((perturbation, entry.model_dump(mode="json")))
    if len(places) > 1 and not places[SCENES]:
        del places[SCENES]  # nothing needs them
    return places


def perturbation_of(cell: Cell) -> Perturbation | None:
    """Return the perturbation of a cell; None for a clean one."""
    spec = cell.spec
    return None if spec["perturbation"] is None else parse_perturbation(spec["perturbation"]).make(spec["severity"])


def target_folder(target: str) -> str:
    """Return the folder of the images of a target, below `data`."""
    return f"target-{target.replace(':', '-')}"


def recording_of_target(suite: PerceptionSuite, target: str, folder: Path, device: str) -> TargetRecording:
    """Return the recording of a target: a car that drives ahead, a walker or a sign from all sides."""
    parsed = parse_target(target)
    return TargetRecording(
        folder / "data" / target_folder(target),
        ((suite.target_town, suite.target_images),),
        held_out=(),
        mode="drive" if isinstance(parsed, TargetCar) else "orbit",
        size=suite.target_size,
        target=parsed,
        seed=suite.seed,
        device=device,
    )

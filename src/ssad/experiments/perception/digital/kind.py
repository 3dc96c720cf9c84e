"""Kind `digital`: detectors x digital attacks x losses x budgets x steps over a data set in the nuScenes schema."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.registry import split_weights
from ssad.core.types import U8
from ssad.datasets.nuscenes.scene import SceneData
from ssad.detectors import ONNX
from ssad.engine.kind import Cell, Column, Job, Plan, Resources
from ssad.experiments.perception.digital import page
from ssad.experiments.perception.digital.attack_record import attack_record
from ssad.experiments.perception.digital.attack_sheet import attack_sheet
from ssad.experiments.perception.digital.points import (
    AttackTable,
    Method,
    bystander_points,
    guard_of,
    hardened_points,
    points_of,
    rows_of,
    system_name,
    transfers_of,
)
from ssad.experiments.perception.digital.verdict import verdict
from ssad.experiments.perception.open_loop import CellDescription, DetectorSuite, OpenLoopKind
from ssad.experiments.perception.scene_boxes import Examination, SceneCondition
from ssad.experiments.perception.scored_data import Victims, detectors_of
from ssad.report.load import Run
from ssad.report.tables import Table
from ssad.scenarios.static.digital.perturbation import DigitalAttack
from ssad.scenarios.static.digital.reference_ensemble import REFERENCE_IMAGES
from ssad.scenarios.static.digital.spec import AttackSpec
from ssad.scenarios.static.digital.universal import UniversalFit


class DigitalSuite(DetectorSuite, AttackTable):
    """One table: detectors x digital attacks, beside the clean data and random noise of the same size.

    2D detectors are scored by AP50 of their boxes in the images; what a 3D box needs is absent.

    Attributes:
        transfer_detectors: detectors that take part in the transfer alone, as `detectors` names them.
        hardened: detectors of adversarially trained weights, named likewise: they are shown the table's attacks and the
            curves over radii alone, beside the detector that their name begins with.
    """

    kind: Literal["digital"]
    transfer_detectors: list[str] = Field(default=[])
    hardened: list[str] = Field(default=[])

    def loss_of(self, method: Method) -> str:
        """Return the loss of an attack: `vanish` in place of the training loss beside exports, which have none."""
        loss = super().loss_of(method)
        has_export = any(name.startswith(ONNX) for name in (*self.detectors, *self.hardened, *self.transfer_detectors))
        return "vanish" if has_export and not method.loss and loss == "full" else loss


class Digital(OpenLoopKind):
    """Kind `digital`. A piece is a scene under an attack on one system, shown to all systems that need it."""

    name = "digital"
    families: ClassVar = {"attacks": "digital"}
    suite = DigitalSuite
    columns = (
        *OpenLoopKind.columns,
        Column("drop", "share of the clean mAP that is lost", "", "higher", limits=(None, 1.0)),
    )
    factors = (
        "detector",
        "attack",
        "loss",
        "norm",
        "radius",
        "steps",
        "options",
        "source",
        "defence",
        "aware",
        "target",
        "subset",
    )

    def check(self, suite: DigitalSuite) -> None:
        """Build attacks and defences, so that errors show up here."""
        points_of(suite)

    def victims(self, suite: DigitalSuite) -> Victims:
        """Return all detectors of the suite."""
        names = [*suite.detectors, *suite.hardened, *suite.transfer_detectors]
        victims = detectors_of(suite.name, names, allow_2d=True)
        if suite.transfer_detectors and not suite.transfer:
            raise ConfigError(f"suite {suite.name}: transfer_detectors take part in the transfer, and it is empty")
        return victims

    def rows(self, suite: DigitalSuite, victims: Victims, data: Mapping[str, Any]) -> Iterator[CellDescription]:
        """Yield the attacks on each detector, and the images that are made against others."""
        points = points_of(suite)
        main_detectors, hardened_detectors = (
            [split_weights(text)[0] for text in entries] for entries in (suite.detectors, suite.hardened)
        )
        for detector in victims.files:
            transfer_sources = [
                candidate for candidate in victims.files if candidate not in (detector, *hardened_detectors)
            ]
            transferred_points = [
                replace(transfer_point, source=candidate)
                for transfer_point in transfers_of(suite)
                for candidate in transfer_sources
            ]
            entries = [*(points if detector in main_detectors else bystander_points(suite)), *transferred_points]
            for point in hardened_points(suite) if detector in hardened_detectors else entries:
                system = system_name(detector, point.defence)
                source = point.source or (system if point.aware or not point.defence else detector)
                title = f"{system}/{point.attack}{f'@{source}' if point.specs and source != system else ''}"
                title += f"/{point.scenes}" if point.scenes else ""
                inputs = [safeio.dump_json(data), point.version]
                inputs += [victims.weights[point.source]] if point.source else []
                spec = {
                    "attacks": [transfer_point.row for transfer_point in point.specs],
                    "source": source,
                    "scenes": point.scenes,
                }
                fields = {"detector": detector, **point.fields, "task": victims.tasks[detector]}
                yield CellDescription(title, system, fields, spec, inputs)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Prepare as `OpenLoopKind` does, and print how many gradients the suite takes."""
        settings = super().prepare(plan, folder, resources, retry=retry)
        job, images = Job(folder, plan.device, settings), settings["images"]
        passes_by_scene: dict[str, Any] = {
            scene.name: scene.perturbation.spec.passes_in(images[scene.scene])
            for cell in plan.cells
            for scene in self.scenes(cell, job)
            if isinstance(scene.perturbation, DigitalAttack)
        }
        detector_count = len(plan.details)
        text = (
            f"{sum(passes_by_scene.values()):,} forward and backward passes for {detector_count} "
            f"detector{'s' if detector_count != 1 else ''}"
        )
        resources.console.print(f"{text} in all", highlight=False)
        return settings

    def order(self, cell: Cell) -> float:
        """Return the priority of a cell: clean first, then the rows of the table, then the curves."""
        return 0 if not cell.spec["attacks"] else 1 if cell.fields["row"] else 2

    def scenes(self, cell: Cell, job: Job) -> list[SceneCondition]:
        """Return the scenes of a cell under its attack; of an ensemble those of one member after another."""
        towns: dict[str, list[str]] = {}
        for scene in job.settings["scenes"]:
            towns.setdefault(job.settings["towns"][scene], []).append(scene)
        selected = {scene for town_scenes in towns.values() for scene in town_scenes[: cell.spec["scenes"] or None]}
        scenes = [scene for scene in job.settings["scenes"] if scene in selected]
        if not cell.spec["attacks"]:
            return [SceneCondition(scene) for scene in scenes]
        batch, source = job.settings["batch"], cell.spec["source"]
        specs = [AttackSpec.of_row(row) for row in cell.spec["attacks"]]
        shares = _reference_shares(job.settings["scenes"])
        return [
            SceneCondition(scene, DigitalAttack(spec, reference_images=shares[scene]), source, batch)
            for spec in specs
            for scene in scenes
        ]

    def compared_scenes(self, cell: Cell, job: Job) -> list[SceneCondition]:
        """Return the clean scenes, which every cell is compared with."""
        return [SceneCondition(scene) for scene in dict.fromkeys(one.scene for one in self.scenes(cell, job))]

    def settings(self, suite: DigitalSuite, scenes: Mapping[str, SceneData]) -> dict[str, Any]:
        """Return the batch size, the defended detectors, and towns and numbers of camera images of the scenes."""
        defended_systems = {
            system_name(detector, defence): [detector, defence.name, dict(defence.options)]
            for detector in (split_weights(text)[0] for text in suite.detectors)
            for defence in dict.fromkeys(guard_of(suite, attack) for attack in suite.attacks if attack.defence)
            if defence
        }
        return {
            "batch": suite.batch,
            "defended": defended_systems,
            "towns": {name: scene.log.location if scene.log else "" for name, scene in scenes.items()},
            "images": {
                name: sum(frame.modality == "camera" and frame.key_frame for frame in scene.frames)
                for name, scene in scenes.items()
            },
        }

    def score(self, examination: Examination, cell: Cell, scenes: Sequence[SceneCondition], job: Job) -> dict[str, Any]:
        """Return the metrics, the cost of the attack, and the share of the system's clean mAP that is lost."""
        specs = [AttackSpec.of_row(row) for row in cell.spec["attacks"]]
        return attack_record(examination, cell.system, specs, scenes, replicates=job.settings["replicates"])

    def sheet(
        self, examination: Examination, suite: DigitalSuite, cell: Cell | None = None
    ) -> tuple[Callable[[], U8], str]:
        """Return a picture of one moment under the attacks of the table, and its caption."""
        rows = [entry.specs[0] for entry in rows_of(suite) if entry.row and len(entry.specs) == 1]
        if cell is not None:  # against the bare detector, even if the cell's images were made against another one
            rows = [AttackSpec.of_row(entry) for entry in cell.spec["attacks"]]
        specs = [entry for entry in dict.fromkeys(rows) if not isinstance(entry.make(), UniversalFit)]
        caption = (
            f"What {examination.detectors[0][0]} is shown (left), what was changed (middle, magnified so that the "
            "largest change is black or white), what it finds (orange, score at least 0.3) and what is there (white)."
        )
        return lambda: attack_sheet(examination, suite.split, specs), caption

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Return the page of a run and its tables."""
        return page.section(run, self.verdict(run))

    def summary(self, run: Run) -> Table:
        """Return the main table of a run."""
        return page.summary(run)

    def verdict(self, run: Run) -> list[str]:
        """Return the findings of a run in sentences, after the faults of its attacks, which call them in question."""
        return [*page.audit_sentence(run), *verdict(run)]


def _reference_shares(scenes: Sequence[str]) -> dict[str, int]:
    """Return how many images of each scene the reference ensemble attacks: the same for all cells of a run.

    The boxes of a scene are shared by cells on few and on all scenes, so the images must not depend on the cell.
    """
    count = len(scenes)
    return {
        scene: REFERENCE_IMAGES * (index + 1) // count - REFERENCE_IMAGES * index // count
        for index, scene in enumerate(scenes)
    }

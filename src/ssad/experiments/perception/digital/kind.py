"""Kind `digital`: detectors x digital attacks x losses x budgets x steps over a data set in the nuScenes schema."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.registry import split_weights
from ssad.core.types import U8
from ssad.datasets.nuscenes.scene import SceneData
from ssad.engine.kind import Cell, Column, Job, Plan, Resources
from ssad.experiments.perception.detector_kind import DetectorKind, DetectorSuite
from ssad.experiments.perception.digital import page
from ssad.experiments.perception.digital.attack_record import attack_record
from ssad.experiments.perception.digital.attack_sheet import attack_sheet
from ssad.experiments.perception.digital.attacked_scenes import AttackedScene, AttackSpec
from ssad.experiments.perception.digital.points import (
    AttackTable,
    bystander_points,
    guard_of,
    hardened_points,
    points_of,
    rows_of,
    system_name,
    transfers_of,
)
from ssad.experiments.perception.digital.verdict import verdict
from ssad.experiments.perception.scene_boxes import Condition, Examination, ShiftedScene, boxes_path
from ssad.experiments.perception.scored_data import data_of, detectors_of
from ssad.report.load import Run
from ssad.report.tables import Table
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


class Digital(DetectorKind):
    """See the module. A piece is a scene under an attack on one system, shown to all systems that need it."""

    name = "digital"
    suite = DigitalSuite
    columns = (*DetectorKind.columns, Column("drop", "share of the clean mAP that is lost", "", "higher"))
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

    def plan(self, suite: DigitalSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Attacks, defences and detectors are built once, the data set is looked at."""
        points = points_of(suite)
        named = [*suite.detectors, *suite.hardened, *suite.transfer_detectors]
        weights, detectors, tasks = detectors_of(suite, named, flat=True)
        if suite.transfer_detectors and not suite.transfer:
            raise ConfigError(f"suite {suite.name}: transfer_detectors take part in the transfer, and it is empty")
        main, hard = ([split_weights(text)[0] for text in own] for own in (suite.detectors, suite.hardened))
        data = data_of(suite)
        cells = []
        for detector in detectors:
            others = [other for other in detectors if other not in (detector, *hard)]
            moved = [replace(one, source=other) for one in transfers_of(suite) for other in others]
            own = [*(points if detector in main else bystander_points(suite)), *moved]
            for point in hardened_points(suite) if detector in hard else own:
                system = system_name(detector, point.defence)
                source = point.source or (system if point.aware or not point.defence else detector)
                title = f"{system}/{point.attack}{f'@{source}' if point.specs and source != system else ''}"
                title += f"/{point.scenes}" if point.scenes else ""
                inputs: list[Any] = [weights[detector], safeio.dump_json(data), device, suite.replicates]
                inputs += [weights[point.source]] if point.source else []
                told = {"attacks": [one.row for one in point.specs], "source": source, "scenes": point.scenes}
                fields = {"detector": detector, **point.fields, "task": tasks[detector]}
                cells.append(self.make_cell(title, system, suite.seed, fields, told, *inputs))
        return Plan(self, suite, device, tuple(cells), {"weights": weights, "data": data}, {}, detectors)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """See `DetectorKind`; says how many gradients the suite takes."""
        settings = super().prepare(plan, folder, resources, retry=retry)
        job, images = Job(folder, plan.device, settings), settings["images"]
        passes: dict[str, Any] = {
            f"{one.source}/{one.name}": one.spec.passes_in(images[one.scene])
            for cell in plan.cells
            for one in self.scenes(cell, job)
            if isinstance(one, AttackedScene)
        }
        count = len(plan.details)
        text = f"{sum(passes.values()):,} forward and backward passes for {count} detector{'s' if count != 1 else ''}"
        resources.console.print(f"{text} in all", highlight=False)
        return settings

    def order(self, cell: Cell) -> float:
        """Clean first, then the rows of the table, then the curves."""
        return 0 if not cell.spec["attacks"] else 1 if cell.fields["row"] else 2

    def scenes(self, cell: Cell, job: Job) -> list[Condition]:
        """See `DetectorKind`; of an ensemble those of one member after another."""
        towns: dict[str, list[str]] = {}
        for scene in job.settings["scenes"]:
            towns.setdefault(job.settings["towns"][scene], []).append(scene)
        kept = {scene for own in towns.values() for scene in own[: cell.spec["scenes"] or None]}
        scenes = [scene for scene in job.settings["scenes"] if scene in kept]
        if not cell.spec["attacks"]:
            return [ShiftedScene(None, 0, scene) for scene in scenes]
        batch, source = job.settings["batch"], cell.spec["source"]
        specs = [AttackSpec.of_row(one) for one in cell.spec["attacks"]]
        return [AttackedScene(spec, scene, batch, source) for spec in specs for scene in scenes]

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """See `Kind`: the scenes whose boxes are still to be found.

        Clean scenes, which every cell is compared with, are done for all systems at once; so are pictures that are made
        against one system and shown to several.
        """
        found: dict[str, Any] = {}
        for one in self.scenes(cell, job):
            clean = ShiftedScene(None, 0, one.scene)
            if not boxes_path(job.folder, cell.system, clean).is_file():
                found[clean.name] = {"scene": one.scene}
            if isinstance(one, AttackedScene) and not boxes_path(job.folder, cell.system, one).is_file():
                told = {"scene": one.scene, "batch": one.batch, "source": one.source, **one.spec.row}
                found[f"{one.source}/{one.name}"] = told
        return found

    def condition(self, data: Any) -> Condition:
        """See `DetectorKind`."""
        if "attack" not in data:
            return ShiftedScene(None, 0, data["scene"])
        return AttackedScene(AttackSpec.of_row(data), data["scene"], data["batch"], data["source"])

    def settings(self, suite: DigitalSuite) -> dict[str, Any]:
        """See `DetectorKind`."""
        defended = {
            system_name(detector, guard): [detector, guard.name, dict(guard.options)]
            for detector in (split_weights(text)[0] for text in suite.detectors)
            for guard in dict.fromkeys(guard_of(suite, one) for one in suite.attacks if one.defence)
            if guard
        }
        return {"batch": suite.batch, "defended": defended}

    def about(self, scenes: Mapping[str, SceneData]) -> dict[str, Any]:
        """Towns, and numbers of camera images."""
        return {
            "towns": {name: scene.log.location if scene.log else "" for name, scene in scenes.items()},
            "images": {
                name: sum(frame.modality == "camera" and frame.key_frame for frame in scene.frames)
                for name, scene in scenes.items()
            },
        }

    def score(self, examination: Examination, cell: Cell, scenes: Sequence[Condition], job: Job) -> dict[str, Any]:
        """Metrics, what the attack took, and which share of the system's clean mAP it took away."""
        specs = [AttackSpec.of_row(one) for one in cell.spec["attacks"]]
        return attack_record(examination, cell.system, specs, scenes, replicates=job.settings["replicates"])

    def sheet(
        self, examination: Examination, suite: DigitalSuite, cell: Cell | None = None
    ) -> tuple[Callable[[], U8], str]:
        """One moment under the attacks of the table."""
        rows = [one.specs[0] for one in rows_of(suite) if one.row and len(one.specs) == 1]
        if cell is not None:  # against the bare detector, also where the cell's pictures were made against another
            rows = [AttackSpec.of_row(one) for one in cell.spec["attacks"]]
        specs = [one for one in dict.fromkeys(rows) if not isinstance(one.make(), UniversalFit)]
        caption = (
            f"What {examination.detectors[0][0]} is shown (left), what was changed (middle, magnified so that the "
            "largest change is black or white), what it finds (orange, score at least 0.3) and what is there (white)."
        )
        return lambda: attack_sheet(examination, suite.split, specs), caption

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Page of a run and its tables."""
        return page.section(run, self.verdict(run))

    def summary(self, run: Run) -> Table:
        """Main table of a run."""
        return page.summary(run)

    def verdict(self, run: Run) -> list[str]:
        """Findings of a run in sentences."""
        return verdict(run)

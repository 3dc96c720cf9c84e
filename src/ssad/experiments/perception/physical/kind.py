"""Kind `physical`: detectors x textures on a car that drives, trained in one town and tested in another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.core.run_records import COUNT, SHARE
from ssad.datasets.nuscenes.scene import SceneData
from ssad.engine.kind import Cell, Column, Job, Plan, Resources, SuiteBase, find_cell
from ssad.engine.progress import LiveProgress
from ssad.experiments.perception.open_loop import CellDescription, OpenLoopKind, Sightings, TargetCondition
from ssad.experiments.perception.physical import page
from ssad.experiments.perception.physical.lit_images import RelightableTargetImages
from ssad.experiments.perception.physical.target_attacks import (
    SearchedLight,
    TargetAttacks,
    TrainedTexture,
    render_all_surfaces,
)
from ssad.experiments.perception.physical.target_sheets import write_sheets
from ssad.experiments.perception.physical.target_table import (
    APPROACH,
    CLEAN,
    DRIVE,
    GRID,
    VIEWS,
    TargetTable,
    rows_of,
    target_of,
)
from ssad.experiments.perception.physical.verdict import verdict
from ssad.experiments.perception.scored_data import Victims, detectors_of
from ssad.experiments.runs import read_plan
from ssad.metrics.target_approach import approach_scores
from ssad.metrics.target_grid import grid_scores
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.target import class_of_target, parse_target
from ssad.report.load import Run
from ssad.report.tables import Table
from ssad.scenarios.static.physical import TextureSpec
from ssad.scenarios.static.physical.lights.folder import LightSpec
from ssad.world.roads import is_town


class PhysicalSuite(SuiteBase, TargetTable):
    """One table: detectors x textures on a car, each trained on drives in one town and tested in another.

    Attributes:
        floor: Minimum AP50 of the clean images, below which no attack is reported; minimum share of them in which the
            target is found, below which no ASR at that score is.
        replicates: Replicates of the bootstrap over drives.
    """

    kind: Literal["physical"]
    floor: float = Field(default=0.9, ge=0.0, le=1.0)
    replicates: int = Field(default=100, ge=0, le=10_000)


class Physical(OpenLoopKind):
    """Kind `physical`. A piece is the training of a texture, or the search of a light, which several cells use."""

    name = "physical"
    families: ClassVar = {"attacks": "texture", "lights": "light"}
    suite = PhysicalSuite
    patience: ClassVar[int | None] = None
    columns = (
        Column("AP50", "AP50", "", "lower", limits=SHARE),
        Column("AP50_25", "AP50 above 0.25", "", "lower", limits=SHARE),
        Column("AP50_all", "AP50 of the whole class", "", "lower", limits=SHARE),
        Column("AP50_all_25", "AP50 of the whole class above 0.25", "", "lower", limits=SHARE),
        Column("ASR_25", "ASR at 0.25", "", "higher", limits=SHARE),
        Column("n0_25", "n0 at 0.25", limits=COUNT),
        Column("ASR_50", "ASR at 0.5", "", "higher", limits=SHARE),
        Column("n0_50", "n0 at 0.5", limits=COUNT),
        Column("ASR_any_25", "ASR at 0.25, of any class", "", "higher", limits=SHARE),
        Column("ASR_all_25", "ASR of the whole class at 0.25", "", "higher", limits=SHARE),
        Column("n0_all_25", "n0 of the whole class at 0.25", limits=COUNT),
        Column("confidence", "mean score", "", "lower", limits=SHARE),
    )
    factors = ("test", "view", "detector", "attack", "carrier", "source")

    def check(self, suite: PhysicalSuite) -> None:
        """Check towns and rows."""
        target_of(suite)
        for pair in suite.pairs:
            for town in (pair.train, pair.test):
                if not is_town(town):
                    raise ConfigError(f"suite {suite.name}: unknown town '{town}' (see: ssad list towns)")
        for town in (suite.grid.towns or ()) if suite.grid is not None else ():
            if town not in {pair.test for pair in suite.pairs}:
                raise ConfigError(f"suite {suite.name}: grid: no pair is tested in {town}")
        for _ in rows_of(suite):
            pass

    def victims(self, suite: PhysicalSuite) -> Victims:
        """Return the detectors and judges of the suite."""
        entries, target = [*suite.detectors, *suite.judges], target_of(suite)
        victims = detectors_of(suite.name, entries, allow_2d=True, scenes=False, targets=[target])
        for name, file in victims.files.items():
            if file:
                raise ConfigError(f"suite {suite.name}: {name}={file}: this suite takes shipped weights only")
            if victims.tasks[name] != "2d" and name in suite.detectors and suite.lights:
                raise ConfigError(
                    f"suite {suite.name}: {name} is no 2D detector; lights are searched against 2D ones only"
                )
        return victims

    def rows(self, suite: PhysicalSuite, victims: Victims, data: Mapping[str, Any]) -> Iterator[CellDescription]:
        """Yield the rows of the table; check the recordings."""
        for row in rows_of(suite):
            source = row.spec.get("light", row.spec).get("source", "")
            grid = suite.grid.model_dump_json() if suite.grid and row.fields["view"] == GRID else ""
            inputs = [suite.target, suite.place, suite.size, suite.floor, grid, victims.weights.get(source, "")]
            if suite.approach is not None and (row.fields["view"] == APPROACH or row.spec.get("approach")):
                inputs.append(suite.approach.model_dump_json())
            yield replace(row, inputs=(*inputs, version_of(row.spec)))
        suite.recordings(Path(), "cpu")

    def order(self, cell: Cell) -> float:
        """Return the priority of a cell: by view, and in each view clean cells, controls, trained attacks."""
        stage = 0 if cell.spec["attack"] is None else 1 if not cell.spec["source"] else 2
        return stage + 3 * VIEWS.index(cell.fields["view"])

    def recordings(self, plan: Plan, folder: Path) -> list[TargetRecording]:
        """Return the recordings of the suite."""
        suite: PhysicalSuite = plan.suite
        return suite.recordings(folder, plan.device)

    def settings(self, suite: PhysicalSuite, scenes: Mapping[str, SceneData]) -> dict[str, Any]:
        """Return the target, the floor, and the numbers of images of the grid and of an approach."""
        counts = {GRID: suite.grid.count if suite.grid else 0, APPROACH: suite.approach.images if suite.approach else 0}
        return {"target": suite.target, "floor": suite.floor, "counts": counts}

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Record the images, and render the visible surface of each carrier once."""
        settings = super().prepare(plan, folder, resources, retry=retry)
        specs = [TextureSpec.of_row(cell.spec) for cell in plan.cells if cell.spec["attack"]]
        surfaces = list(dict.fromkeys(spec.surface for spec in specs))
        if surfaces:
            with LiveProgress(
                "rendering what wears textures", 1, 0, console=resources.console, unit="parts"
            ) as progress:
                render_all_surfaces(
                    self.recordings(plan, folder),
                    plan.suite.target,
                    surfaces,
                    workers=resources.workers,
                    ray=resources.ray,
                    progress=progress.show,
                )
        return settings

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """Return the training of the cell's texture, or the search of its light, unless it is done."""
        perturbation = perturbation_of(cell, job)
        return (
            {f"{perturbation.family} {perturbation.name}": cell}
            if perturbation is not None and perturbation.is_missing
            else {}
        )

    def make(self, name: str, data: Any, systems: Sequence[str], job: Job) -> None:
        """Train a texture, or search a light."""
        perturbation = perturbation_of(data, job)
        assert perturbation is not None
        perturbation.make()

    def target(self, cell: Cell, job: Job, detector: Detector) -> TargetCondition:
        """Return the images in the town of the test, at the hour of the light, and the texture or light."""
        light, view = cell.spec.get("light"), cell.fields["view"]
        pair = (light or cell.spec)["pair"]
        folder = job.folder / "data" / f"{pair['test']}{'' if view == DRIVE else f'-{view}'}"
        count = pair["test_images"] if view == DRIVE else job.settings["counts"][view]
        images = RelightableTargetImages.of(folder, count, detector, job.device, hour=light["hour"] if light else None)
        name = class_of_target(parse_target(job.settings["target"])).replace("_", " ")
        # Far from the target the clean one may be lost: an approach says where.
        floor = 0.0 if view == APPROACH else None
        title = f"{name} ({light['hour']})" if light else name
        return TargetCondition(images, perturbation_of(cell, job), title, floor)

    def target_columns(
        self, cell: Cell, job: Job, condition: TargetCondition, clean: Sightings, attacked: Sightings | None
    ) -> dict[str, Any]:
        """Return the scores by view or by distance, and the record of the texture or light."""
        columns: dict[str, Any] = {}
        if cell.fields["view"] == APPROACH:
            bootstrap = {"replicates": job.settings["replicates"], "seed": job.settings["seed"]}
            columns = approach_scores(condition.images.rows(), clean, attacked, **bootstrap)
        if cell.fields["view"] == GRID:
            columns = grid_scores(condition.images.rows(), clean, attacked, floor=job.settings["floor"])
        perturbation = condition.perturbation
        return columns | perturbation.about() if isinstance(perturbation, TrainedTexture | SearchedLight) else columns

    def finish(self, plan: Plan, folder: Path) -> None:
        """Pictures of each test town under each texture, of the grid from four sides, and of lights: DIR/pictures."""
        suite: PhysicalSuite = plan.suite
        attacks = attacks_of(Job(folder, plan.device, {"target": suite.target, "seed": suite.seed}))
        write_sheets(attacks, suite, [(cell.fields, cell.spec) for cell in plan.cells])

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Return the page of a run and its tables."""
        return page.section(run, self.verdict(run))

    def summary(self, run: Run) -> Table:
        """Return the main table of a run."""
        return page.summary(run)

    def verdict(self, run: Run) -> list[str]:
        """Return the findings of a run in sentences."""
        return verdict(run)


def version_of(spec: Mapping[str, Any]) -> str:
    """Return the version of the texture or light of a row, if it is one of the user's own; "" for all others."""
    light = spec.get("light")
    if light is not None:
        return LightSpec.of_row(light).version
    return TextureSpec.of_row(spec).version if spec["attack"] is not None else ""


def attacks_of(job: Job) -> TargetAttacks:
    """Return the textures and lights of a run."""
    return TargetAttacks(job.folder, job.settings["target"], job.settings["seed"], job.device)


def perturbation_of(cell: Cell, job: Job) -> TrainedTexture | SearchedLight | None:
    """Return the texture or the light of a cell; None: it is clean."""
    if cell.fields["attack"] == CLEAN:
        return None
    attacks, light = attacks_of(job), cell.spec.get("light")
    return attacks.light(LightSpec.of_row(light)) if light else attacks.texture(TextureSpec.of_row(cell.spec))


def attacks_and_cell(folder: Path, name: str) -> tuple[TargetAttacks, Cell]:
    """Return the textures and lights of a physical run, and one of its cells.

    Args:
        folder: Results folder of the run.
        name: The cell: its key, the start of one, or its name.

    Raises:
        ConfigError: There is no such cell, or the run is of another kind.
    """
    plan = read_plan(folder)
    if plan.kind.name != Physical.name:
        raise ConfigError(f"{folder}: a run of kind {plan.kind.name} shows neither textures nor lights")
    return TargetAttacks(folder, plan.suite.target, plan.suite.seed), find_cell(plan.cells, name)

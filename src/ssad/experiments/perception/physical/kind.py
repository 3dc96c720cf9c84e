"""Kind `physical`: detectors x textures on a car that drives, trained in one town and tested in another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from ssad.core.checkpoints import state_hash
from ssad.core.errors import ConfigError
from ssad.core.machine import keep_memory, quiet_warp
from ssad.detectors import make_detector
from ssad.engine.kind import Cell, Column, Job, Kind, Plan, Resources, SuiteBase, find_cell
from ssad.engine.progress import Live
from ssad.experiments.perception.kind import check_floor
from ssad.experiments.perception.physical import page
from ssad.experiments.perception.physical.lit_images import LitPictures
from ssad.experiments.perception.physical.target_attacks import TargetAttacks, see_all
from ssad.experiments.perception.physical.target_sheets import write_sheets
from ssad.experiments.perception.physical.target_table import CLEAN, GRID, TargetTable, rows_of, target_of
from ssad.experiments.perception.physical.target_views import TargetClips
from ssad.experiments.perception.physical.verdict import verdict
from ssad.experiments.runs import read_plan
from ssad.metrics.target_attacks import Sighting, sightings, target_scores
from ssad.metrics.target_grid import grid_scores
from ssad.recorders.target_images import record_all
from ssad.rendering.target import class_of_target, parse_target
from ssad.report.load import Run
from ssad.report.tables import Table
from ssad.scenarios.static.physical import TextureSpec
from ssad.scenarios.static.physical.lights.folder import LightSpec
from ssad.world.roads import is_town


class PhysicalSuite(SuiteBase, TargetTable):
    """One table: detectors x textures on a car, each trained on drives in one town and tested in another.

    Attributes:
        floor: Minimum AP50 of the clean images, below which no attack is reported.
        replicates: Replicates of the bootstrap over drives.
    """

    kind: Literal["physical"]
    floor: float = Field(default=0.9, ge=0.0, le=1.0)
    replicates: int = Field(default=100, ge=0, le=10_000)


class Physical(Kind):
    """Kind `physical`. A piece is the training of a texture, which several cells use."""

    name = "physical"
    suite = PhysicalSuite
    columns = (
        Column("AP50", "AP50", "", "lower"),
        Column("AP50_25", "AP50 above 0.25", "", "lower"),
        Column("AP50_all", "AP50 of the whole class", "", "lower"),
        Column("AP50_all_25", "AP50 of the whole class above 0.25", "", "lower"),
        Column("ASR_25", "ASR at 0.25", "", "higher"),
        Column("ASR_50", "ASR at 0.5", "", "higher"),
        Column("ASR_any_25", "ASR at 0.25, of any class", "", "higher"),
        Column("ASR_all_25", "ASR of the whole class at 0.25", "", "higher"),
        Column("confidence", "mean score", "", "lower"),
    )
    factors = ("test", "view", "detector", "attack", "carrier", "source")

    def plan(self, suite: PhysicalSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Build detectors and carriers once, so that errors show up here."""
        target = target_of(suite)
        weights = {}
        for name in [*suite.detectors, *suite.judges]:
            if name in weights:
                raise ConfigError(f"suite {suite.name}: {name} is named twice among detectors and judges")
            detector = make_detector(name)
            if class_of_target(target) not in detector.classes:
                raise ConfigError(f"suite {suite.name}: {name} has no class {class_of_target(target)}")
            if detector.task != "2d" and name in suite.detectors and suite.lights:
                raise ConfigError(
                    f"suite {suite.name}: {name} is no 2D detector; lights are searched against 2D ones only"
                )
            weights[name] = state_hash(detector)
        for pair in suite.pairs:
            for town in (pair.train, pair.test):
                if not is_town(town):
                    raise ConfigError(f"suite {suite.name}: unknown town '{town}' (see: ssad list towns)")
        for town in (suite.grid.towns or ()) if suite.grid is not None else ():
            if town not in {pair.test for pair in suite.pairs}:
                raise ConfigError(f"suite {suite.name}: grid: no pair is tested in {town}")
        common_inputs = suite.target, suite.place, suite.size, suite.floor, suite.replicates, device
        cells: dict[str, Cell] = {}
        for row in rows_of(suite):
            detector, source = row.fields["detector"], row.spec.get("light", row.spec).get("source", "")
            grid = suite.grid.model_dump_json() if suite.grid and row.fields["view"] == GRID else ""
            inputs = *common_inputs, grid, weights[detector], weights.get(source, "")
            cell = self.make_cell(row.title, detector, suite.seed, row.fields, row.spec, *inputs)
            cells.setdefault(cell.key, cell)
        suite.recordings(Path(), device)
        return Plan(self, suite, device, tuple(cells.values()), {"weights": weights}, {}, None)

    def order(self, cell: Cell) -> float:
        """From behind before from all around; clean first, then controls, then what is trained."""
        stage = 0 if cell.spec["attack"] is None else 1 if not cell.spec["source"] else 2
        return stage + (3 if cell.fields["view"] == GRID else 0)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Record the images, and render the visible surface of each carrier once."""
        suite: PhysicalSuite = plan.suite
        recordings = suite.recordings(folder, plan.device)
        pool_options: dict[str, Any] = {"workers": resources.workers, "ray": resources.ray}
        with Live("recording", 1, 0, console=resources.console, unit="parts") as progress:
            record_all(recordings, **pool_options, progress=progress.show)
        surfaces = list(
            dict.fromkeys(TextureSpec.of_row(cell.spec).surface for cell in plan.cells if cell.spec["attack"])
        )
        if surfaces:
            with Live("rendering what wears textures", 1, 0, console=resources.console, unit="parts") as progress:
                see_all(recordings, suite.target, surfaces, **pool_options, progress=progress.show)
        return {
            "target": suite.target,
            "floor": suite.floor,
            "replicates": suite.replicates,
            "seed": suite.seed,
            "grid": suite.grid.count if suite.grid else 0,
        }

    def start(self, job: Job) -> None:
        """Keep the memory of tensors, and silence Warp."""
        keep_memory()
        quiet_warp()

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """Return the training of the cell's texture, or the search of its light, unless it is done."""
        attacks, light = attacks_of(job), cell.spec.get("light")
        if light:
            searched_light = LightSpec.of_row(light) if light["source"] else None
            missing = searched_light is not None and not attacks.lights.kept(searched_light).is_file()
            return {f"light {searched_light.name}": dict(cell.spec)} if searched_light and missing else {}
        spec = TextureSpec.of_row(cell.spec) if cell.spec["attack"] is not None else None
        if spec is None or not spec.trained or attacks.textures.kept(spec).is_file():
            return {}
        return {f"texture {spec.name}": dict(cell.spec)}

    def make(self, name: str, data: Any, systems: Sequence[str], job: Job) -> None:
        """Train a texture, or search a light."""
        if "light" in data:
            attacks_of(job).light(LightSpec.of_row(data["light"]))
        else:
            attacks_of(job).texture(TextureSpec.of_row(data))

    def result(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Return the scores in the town of the test.

        Raises:
            CellError: The detector does not find the clean target.
        """
        attacks, settings, detector = attacks_of(job), job.settings, cell.system
        light, grid, floor = cell.spec.get("light"), cell.fields["view"] == GRID, settings["floor"]
        bootstrap_options = {"replicates": settings["replicates"], "seed": settings["seed"]}
        pair = (light or cell.spec)["pair"]
        image_count = settings["grid"] if grid else pair["test_images"]
        images = attacks.clips(f"{pair['test']}{'-grid' if grid else ''}", image_count, detector)
        lit_images = LitPictures.of(images, light["hour"]) if light else None
        clean_sightings = _clean_sightings(lit_images or images, detector)
        if cell.fields["attack"] == CLEAN:
            scores = target_scores(clean_sightings, **bootstrap_options)
            return scores | (grid_scores(images.rows(), clean_sightings, None, floor=floor) if grid else {})
        hour_text = f" ({light['hour']})" if light else ""
        target_name = class_of_target(parse_target(settings["target"])).replace("_", " ")
        clean_precision = check_floor(clean_sightings, floor, f"{detector} finds the clean {target_name}{hour_text}")
        if lit_images:
            spec = LightSpec.of_row(light or {})
            attacked_images, attack_fields = attacks.under(lit_images, spec), partial(attacks.about_light, spec)
        else:
            texture = TextureSpec.of_row(cell.spec)
            attacked_images, attack_fields = attacks.worn(images, texture), partial(attacks.about, texture)
        attacked = list(sightings(attacks.detector(detector), attacked_images))
        scores = target_scores(attacked, clean_sightings, **bootstrap_options) | {"clean_AP50": clean_precision}
        if grid:
            scores |= grid_scores(images.rows(), clean_sightings, attacked, floor=floor)
        return scores | attack_fields()  # which may be trained or searched only now

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


def attacks_of(job: Job) -> TargetAttacks:
    """Return the textures and lights of a run."""
    return TargetAttacks(job.folder, job.settings["target"], job.settings["seed"], job.device)


@lru_cache(maxsize=8)
def _clean_sightings(pictures: TargetClips | LitPictures, detector: str) -> tuple[Sighting, ...]:
    """Return a detector's sightings in the images as recorded; cached, since every cell needs them."""
    return tuple(sightings(make_detector(detector, device=pictures.device), pictures.clean()))


def shown_by(folder: Path, name: str) -> tuple[TargetAttacks, Cell]:
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

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
from ssad.engine.kind import Cell, CellError, Column, Job, Kind, Plan, Resources, SuiteBase, find_cell
from ssad.engine.progress import Live
from ssad.experiments.perception.physical import page
from ssad.experiments.perception.physical.lit_images import LitPictures
from ssad.experiments.perception.physical.target_attacks import TargetAttacks, see_all
from ssad.experiments.perception.physical.target_sheets import write_sheets
from ssad.experiments.perception.physical.target_table import CLEAN, GRID, TargetTable, rows_of, target_of
from ssad.experiments.perception.physical.target_views import TargetClips
from ssad.experiments.perception.physical.verdict import verdict
from ssad.experiments.runs import read_plan
from ssad.metrics.target_attacks import Sighting, precision, sightings, target_scores
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
        floor: least AP50 of the clean pictures, below which no attack is reported.
        replicates: of the bootstrap over drives.
    """

    kind: Literal["physical"]
    floor: float = Field(default=0.9, ge=0.0, le=1.0)
    replicates: int = Field(default=100, ge=0, le=10_000)


class Physical(Kind):
    """See the module. A piece is the training of a texture, which several cells show."""

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
        """Detectors and carriers are built once, so that what is wrong ends here."""
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
        about = suite.target, suite.place, suite.size, suite.floor, suite.replicates, device
        cells: dict[str, Cell] = {}
        for row in rows_of(suite):
            detector, source = row.fields["detector"], row.spec.get("light", row.spec).get("source", "")
            grid = suite.grid.model_dump_json() if suite.grid and row.fields["view"] == GRID else ""
            inputs = *about, grid, weights[detector], weights.get(source, "")
            cell = self.make_cell(row.title, detector, suite.seed, row.fields, row.spec, *inputs)
            cells.setdefault(cell.key, cell)
        suite.recordings(Path(), device)
        return Plan(self, suite, device, tuple(cells.values()), {"weights": weights}, {}, None)

    def order(self, cell: Cell) -> float:
        """From behind before from all around; clean first, then controls, then what is trained."""
        shown = 0 if cell.spec["attack"] is None else 1 if not cell.spec["source"] else 2
        return shown + (3 if cell.fields["view"] == GRID else 0)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Records the pictures, and renders once what they see of each carrier."""
        suite: PhysicalSuite = plan.suite
        recordings = suite.recordings(folder, plan.device)
        work: dict[str, Any] = {"workers": resources.workers, "ray": resources.ray}
        with Live("recording", 1, 0, console=resources.console, unit="parts") as live:
            record_all(recordings, **work, progress=live.show)
        surfaces = list(dict.fromkeys(TextureSpec.of_row(c.spec).surface for c in plan.cells if c.spec["attack"]))
        if surfaces:
            with Live("rendering what wears textures", 1, 0, console=resources.console, unit="parts") as live:
                see_all(recordings, suite.target, surfaces, **work, progress=live.show)
        return {
            "target": suite.target,
            "floor": suite.floor,
            "replicates": suite.replicates,
            "seed": suite.seed,
            "grid": suite.grid.count if suite.grid else 0,
        }

    def start(self, job: Job) -> None:
        """Memory for tensors is kept."""
        keep_memory()
        quiet_warp()

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """The training of the cell's texture, or the search of its light, unless it is done."""
        attacks, light = attacks_of(job), cell.spec.get("light")
        if light:
            searched = LightSpec.of_row(light) if light["source"] else None
            missing = searched is not None and not attacks.lights.kept(searched).is_file()
            return {f"light {searched.name}": dict(cell.spec)} if searched and missing else {}
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
        """Scores in the town of the test. CellError: the detector does not find the clean target."""
        attacks, settings, detector = attacks_of(job), job.settings, cell.system
        light, grid, floor = cell.spec.get("light"), cell.fields["view"] == GRID, settings["floor"]
        draws = {"replicates": settings["replicates"], "seed": settings["seed"]}
        pair = (light or cell.spec)["pair"]
        count = settings["grid"] if grid else pair["test_images"]
        clips = attacks.clips(f"{pair['test']}{'-grid' if grid else ''}", count, detector)
        lit = LitPictures.of(clips, light["hour"]) if light else None
        clean = _clean_sightings(lit or clips, detector)
        if cell.fields["attack"] == CLEAN:
            found = target_scores(clean, **draws)
            return found | (grid_scores(clips.rows(), clean, None, floor=floor) if grid else {})
        have = round(precision(clean) or 0.0, 6)
        if have < floor:
            when = f" ({light['hour']})" if light else ""
            noun = class_of_target(parse_target(settings["target"])).replace("_", " ")
            found_at = f"{detector} finds the clean {noun}{when} with AP50 {have:.3f}"
            raise CellError(f"{found_at}, which is less than the floor of {floor:g}")
        if lit:
            spec = LightSpec.of_row(light or {})
            shown, about = attacks.under(lit, spec), partial(attacks.about_light, spec)
        else:
            texture = TextureSpec.of_row(cell.spec)
            shown, about = attacks.worn(clips, texture), partial(attacks.about, texture)
        attacked = list(sightings(attacks.detector(detector), shown))
        found = target_scores(attacked, clean, **draws) | {"clean_AP50": have}
        if grid:
            found |= grid_scores(clips.rows(), clean, attacked, floor=floor)
        return found | about()  # which may be trained or searched only now

    def finish(self, plan: Plan, folder: Path) -> None:
        """Pictures of each test town under each texture, of the grid from four sides, and of lights: DIR/pictures."""
        suite: PhysicalSuite = plan.suite
        attacks = attacks_of(Job(folder, plan.device, {"target": suite.target, "seed": suite.seed}))
        write_sheets(attacks, suite, [(cell.fields, cell.spec) for cell in plan.cells])

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Page of a run and its tables."""
        return page.section(run, self.verdict(run))

    def summary(self, run: Run) -> Table:
        """Main table of a run."""
        return page.summary(run)

    def verdict(self, run: Run) -> list[str]:
        """Findings of a run in sentences."""
        return verdict(run)


def attacks_of(job: Job) -> TargetAttacks:
    """The textures and lights of a run."""
    return TargetAttacks(job.folder, job.settings["target"], job.settings["seed"], job.device)


@lru_cache(maxsize=8)
def _clean_sightings(pictures: TargetClips | LitPictures, detector: str) -> tuple[Sighting, ...]:
    """What a detector finds in pictures as they were recorded; kept, since every cell needs it."""
    return tuple(sightings(make_detector(detector, device=pictures.device), pictures.clean()))


def shown_by(folder: Path, name: str) -> tuple[TargetAttacks, Cell]:
    """A cell of a physical run, and where its textures and lights are.

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

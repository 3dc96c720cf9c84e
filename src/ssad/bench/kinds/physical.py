"""Kind `physical`: 2D detectors x textures on a car that drives, trained in one town and tested in another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

from ssad.bench.kind import Cell, CellError, Column, Job, Kind, Plan, Resources
from ssad.bench.kinds.detection import state_hash
from ssad.bench.physical_lights import CLEAN, light_cells, lights_shown
from ssad.bench.physical_suite import Pair, PhysicalSuite, carrier_title, row_of, target_of
from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.images import save_picture
from ssad.detectors import make_detector
from ssad.evaluation.target_grid import grid_scores
from ssad.evaluation.target_scores import Sighting, sightings, target_scores
from ssad.jobs.machine import keep_memory, quiet_warp
from ssad.jobs.pool import open_pool, run_all
from ssad.jobs.progress import Live
from ssad.recording.clip_recorder import record_all
from ssad.recording.clips import Clips
from ssad.recording.lit_clips import LitPictures
from ssad.recording.target import TargetCar, class_of_target
from ssad.recording.target_attacks import TargetAttacks, layers_of, see_surfaces
from ssad.recording.target_views import TargetClips
from ssad.recording.textured_clips import unseen_parts
from ssad.roads import town_names
from ssad.scenarios.static.physical import CONTROLS, TextureSpec, make_carrier
from ssad.scenarios.static.physical.noninvasive.kept import LightSpec

GRID = "grid"
VIEWS = ("drive", GRID)
SIDES = (0.0, 90.0, 180.0, 270.0)  # of the grid that pictures show


class Physical(Kind):
    """See the module. A piece is the training of a texture, which several cells show."""

    name = "physical"
    suite = PhysicalSuite
    columns = (
        Column("AP50", "AP50", "", "lower"),
        Column("AP50_25", "AP50 above 0.25", "", "lower"),
        Column("AP50_all", "AP50 of all cars", "", "lower"),
        Column("AP50_all_25", "AP50 of all cars above 0.25", "", "lower"),
        Column("ASR_25", "ASR at 0.25", "", "higher"),
        Column("ASR_50", "ASR at 0.5", "", "higher"),
        Column("ASR_all_25", "ASR of all cars at 0.25", "", "higher"),
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
            if detector.task != "2d" and name in suite.detectors:
                raise ConfigError(f"suite {suite.name}: {name} is no 2D detector; 3D detectors can be judges")
            weights[name] = state_hash(detector)
        for pair in suite.pairs:
            for town in (pair.train, pair.test):
                if town not in town_names():
                    raise ConfigError(f"suite {suite.name}: unknown town '{town}' (see: ssad list towns)")
        rows = [row_of(suite, entry) for entry in suite.attacks]
        for row in rows:
            make_carrier(row["carrier"], row["options"]).on(target.mesh())
        cells: dict[str, Cell] = {}
        if suite.grid is not None:
            _grid_clips(suite, Path(), suite.pairs[0].test, device)
        for town in (suite.grid.towns or ()) if suite.grid is not None else ():
            if town not in {pair.test for pair in suite.pairs}:
                raise ConfigError(f"suite {suite.name}: grid: no pair is tested in {town}")
        for pair, view, detector in product(suite.pairs, VIEWS, weights):
            if view == GRID and not _seen_around(suite, pair):
                continue
            for row in [{"attack": None}, *rows] if rows or not suite.lights else []:
                for cell in self._cells(suite, pair, view, detector, row, weights, device):
                    cells.setdefault(cell.key, cell)
        cells |= {cell.key: cell for cell in light_cells(self, suite, weights, device)}
        return Plan(self, suite, device, tuple(cells.values()), {"weights": weights}, {}, None)

    def _cells(  # noqa: PLR0917
        self,
        suite: PhysicalSuite,
        pair: Pair,
        view: str,
        detector: str,
        row: Mapping[str, Any],
        weights: Mapping[str, str],
        device: str,
    ) -> list[Cell]:
        """The cells of an attack on a detector in a pair of towns."""
        attack = row["attack"]
        trained = attack is not None and (attack not in CONTROLS or row["of"] is not None)
        moved = trained and ((suite.transfer and row["of"] is None) or detector in suite.judges)
        sources = [row["source"]] if "file" in row else suite.detectors if moved else [detector]
        seeds = range(suite.seeds) if attack in ("random", "noise", "shuffled") else (0,)
        found = []
        for source in sources:
            for seed in seeds:
                spec = {"pair": pair.model_dump(), "number": seed, "view": view, "file": None, "around": 0, **row}
                spec["source"] = source if trained else ""
                fields = {
                    "test": pair.test, "train": pair.train, "view": view, "detector": detector,
                    "carrier": carrier_title(row),
                    "attack": _title(row),
                    "source": source if trained else "", "number": seed,
                }  # fmt: skip
                title = "/".join(
                    str(one) for one in [detector, pair.test, fields["attack"], fields["carrier"], source, seed]
                )
                if view == GRID:
                    title += f"/{GRID}"
                grid = suite.grid.model_dump_json() if suite.grid and view == GRID else ""
                inputs = suite.target, suite.place, suite.size, suite.floor, suite.replicates, grid, device
                found.append(
                    self.make_cell(
                        title, detector, suite.seed, fields, spec, *inputs, weights[detector], weights.get(source, "")
                    )
                )
        return found

    def order(self, cell: Cell) -> float:
        """From behind before from all around; clean first, then controls, then what is trained."""
        shown = 0 if cell.spec["attack"] is None else 1 if not cell.spec["source"] else 2
        return shown + (3 if cell.fields["view"] == GRID else 0)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Records the pictures, and renders once what they see of each carrier."""
        suite: PhysicalSuite = plan.suite
        images: dict[str, int] = {}
        for pair in suite.pairs:
            for town, count in ((pair.train, pair.train_images), (pair.test, pair.test_images)):
                images[town] = max(images.get(town, 0), count)
        target = target_of(suite)
        mode: Literal["drive", "orbit"] = "drive" if isinstance(target, TargetCar) else "orbit"
        recordings = [
            Clips(
                folder / "data" / town, ((town, count),), (), mode, suite.size, target, suite.behind, seed=suite.seed,
                device=plan.device, distances=tuple(suite.distances),
            )
            for town, count in images.items()
        ]  # fmt: skip
        if suite.grid is not None:
            tests = dict.fromkeys(pair.test for pair in suite.pairs if _seen_around(suite, pair))
            recordings += [_grid_clips(suite, folder, town, plan.device) for town in tests]
        further = max((entry.around for entry in suite.attacks), default=0)
        for town in dict.fromkeys(pair.train for pair in suite.pairs) if further else ():
            recordings.append(replace(_around(folder, town, suite, plan.device), images=((town, further),)))
        with Live("recording", 1, 0, console=resources.console, unit="parts") as live:
            record_all(recordings, workers=resources.workers, ray=resources.ray, progress=live.show)
        surfaces = list(dict.fromkeys(TextureSpec.of_row(c.spec).surface for c in plan.cells if c.spec["attack"]))
        tasks = [
            (clips.out, part, suite.target, surfaces, plan.device)
            for clips in recordings if surfaces for part in unseen_parts(clips.out, layers_of(suite.target, surfaces))
        ]  # fmt: skip
        if tasks:
            pool = open_pool(len(tasks), workers=resources.workers, ray=resources.ray, device=plan.device)
            with Live("rendering what wears textures", len(tasks), 0, console=resources.console, unit="parts") as live:
                run_all(pool, see_surfaces, tasks, progress=live.show)
        return {
            "target": suite.target, "floor": suite.floor, "replicates": suite.replicates, "seed": suite.seed,
            "grid": suite.grid.count if suite.grid else 0,
        }  # fmt: skip

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

    def execute(self, cells: Sequence[Cell], job: Job) -> Mapping[str, Mapping[str, Any]]:
        """Scores in the town of the test."""
        return {cell.key: self._score(cell, job) for cell in cells}

    def _score(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Scores of a cell. CellError: the detector does not find the clean car."""
        attacks, settings, detector = attacks_of(job), job.settings, cell.system
        light, grid, floor = cell.spec.get("light"), cell.fields["view"] == GRID, settings["floor"]
        draws = {"replicates": settings["replicates"], "seed": settings["seed"]}
        pair = (light or cell.spec)["pair"]
        count = settings["grid"] if grid else pair["test_images"]
        clips = attacks.clips(f"{pair['test']}{'-grid' if grid else ''}", count, detector)
        lit = LitPictures.of(clips, light["hour"]) if light else None
        clean = _clean_sightings(lit or clips, detector)
        before = target_scores(clean, **draws)
        if cell.fields["attack"] == CLEAN:
            return before | (grid_scores(clips.rows(), clean, None, floor=floor) if grid else {})
        have = before["metrics"]["AP50"] or 0.0
        if have < floor:
            when = f" ({light['hour']})" if light else ""
            raise CellError(
                f"{detector} finds the clean car{when} with AP50 {have:.3f}, which is less than the floor of {floor:g}"
            )
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
        captions, name = {}, suite.detectors[0]
        lights, path = lights_shown(plan.cells, suite, attacks.lights), folder / "pictures" / "lights.jpg"
        if lights and not path.is_file() and (folder / "data" / suite.pairs[0].test / "annotations").is_dir():
            save_picture(path, attacks.light_sheet(name, suite.pairs[0].test, lights))
        if path.is_file():
            captions[path.name] = (
                f"What {name} finds (orange, score at least 0.25) in a picture of {suite.pairs[0].test} under each "
                "light."
            )
        for pair in suite.pairs:
            chosen = self._chosen(plan, attacks, pair, name)
            trained = [(title, spec) for title, spec in chosen.items() if spec.source and not spec.of]
            for view, text, sides, shown in (
                ("drive", "from behind", (None,), chosen),
                (GRID, "from the front, the left, the rear and the right", SIDES, dict(trained[-1:])),
            ):
                path = folder / "pictures" / f"{view}-{pair.test.lower()}.jpg"
                clips = TargetClips(folder / "data" / f"{pair.test}{'-grid' if view == GRID else ''}", 1)
                if chosen and not path.is_file() and (clips.folder / "annotations").is_dir():
                    save_picture(path, attacks.sheet(name, clips, textures=shown, sides=sides, clean=CLEAN))
                if path.is_file():
                    captions[path.name] = (
                        f"What {name} finds (orange, score at least 0.25) in {pair.test}, clean and attacked, {text}."
                    )
        if captions:
            safeio.write_atomic(folder / "pictures" / "pictures.json", safeio.dump_json(captions, indent=1) + "\n")

    def _chosen(self, plan: Plan, attacks: TargetAttacks, pair: Pair, detector: str) -> dict[str, TextureSpec]:
        """The textures of a pair of towns that are there, one of each attack, by title."""
        found: dict[str, TextureSpec] = {}
        for cell in plan.cells:
            spec = cell.spec
            if spec["attack"] is None or spec["pair"] != pair.model_dump() or spec["number"]:
                continue
            if cell.system == detector and spec["source"] in ("", detector):
                texture = TextureSpec.of_row(spec)
                if not texture.trained or attacks.textures.kept(texture).is_file():
                    found.setdefault(f"{cell.fields['attack']} ({cell.fields['carrier']})", texture)
        return found


def attacks_of(job: Job) -> TargetAttacks:
    """The textures and lights of a run."""
    return TargetAttacks(job.folder, job.settings["target"], job.settings["seed"], job.device)


@lru_cache(maxsize=8)
def _clean_sightings(pictures: TargetClips | LitPictures, detector: str) -> tuple[Sighting, ...]:
    """What a detector finds in pictures as they were recorded; kept, since every cell needs it."""
    return tuple(sightings(make_detector(detector, device=pictures.device), pictures.clean()))


def _grid_clips(suite: PhysicalSuite, folder: Path, town: str, device: str) -> Clips:
    """The recording of a suite's grid in a town. ConfigError, UnknownNameError: a value that cannot be."""
    assert suite.grid is not None
    grid = suite.grid
    return Clips(
        folder / "data" / f"{town}-grid", ((town, grid.count),), (), mode="orbit", target=target_of(suite),
        size=suite.size, seed=suite.seed, device=device, distances=tuple(grid.distances),
        azimuths=tuple(grid.azimuths), elevations=tuple(grid.elevations), weathers=tuple(grid.weathers),
    )  # fmt: skip


def _around(folder: Path, town: str, suite: PhysicalSuite, device: str) -> Clips:
    """The recording of pictures from all around for trainings in a town."""
    return Clips(
        folder / "data" / f"{town}-around", ((town, 1),), (), mode="orbit", target=target_of(suite), size=suite.size,
        seed=suite.seed, device=device,
    )  # fmt: skip


def _seen_around(suite: PhysicalSuite, pair: Pair) -> bool:
    """Whether the grid is seen in the test of a pair."""
    return suite.grid is not None and (suite.grid.towns is None or pair.test in suite.grid.towns)


def _title(row: Mapping[str, Any]) -> str:
    """What tables call the attack of a row: such as "shuffled vanishing, all sides"."""
    if row["attack"] is None:
        return CLEAN
    sides = ", all sides" if row.get("around") else ""
    return f"shuffled {row['of']}{sides}" if row["of"] else f"{row['attack']}{sides}"

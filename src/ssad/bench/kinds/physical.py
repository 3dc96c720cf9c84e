"""Kind `physical`: 2D detectors x textures on a car that drives, trained in one town and tested in another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.bench.kind import Cell, CellError, Column, Job, Kind, Plan, Resources
from ssad.bench.kinds.detection import state_hash
from ssad.bench.physical_lights import light_cells, light_edit, light_pieces, light_result, light_sheet
from ssad.bench.physical_suite import Pair, PhysicalSuite, carrier_title, row_of, target_of
from ssad.camera.scene import Layer
from ssad.core import safeio
from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.core.images import save_picture
from ssad.core.protocols import Detector
from ssad.core.types import U8
from ssad.detectors import make_detector
from ssad.evaluation.target_grid import grid_scores
from ssad.evaluation.target_scores import Sighting, sightings, target_scores
from ssad.evaluation.target_sheet import COLUMNS, target_sheet
from ssad.jobs.machine import keep_memory, quiet_warp
from ssad.jobs.pool import open_pool, run_all
from ssad.jobs.progress import Live
from ssad.recording.clip_recorder import record_all
from ssad.recording.clips import Clips
from ssad.recording.target import TargetCar, parse_target
from ssad.recording.target_views import TargetClips
from ssad.recording.textured_clips import see_clips, unseen_parts
from ssad.roads import town_names
from ssad.scenarios.static.physical import CONTROLS, Surface, TextureSpec, View, albedo_of, make_carrier
from ssad.scenarios.static.physical.kept import TextureFolder

CLEAN, GRID = "clean", "grid"
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
            if "car" not in detector.classes:
                raise ConfigError(f"suite {suite.name}: {name} has no class car")
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
                inputs = suite.target, suite.behind, suite.size, suite.floor, suite.replicates, grid, device
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
        recordings = [
            Clips(
                folder / "data" / town, ((town, count),), (), target=target, behind=suite.behind, size=suite.size,
                seed=suite.seed, device=plan.device,
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
            for clips in recordings if surfaces for part in unseen_parts(clips.out, _layers(suite.target, surfaces))
        ]  # fmt: skip
        if tasks:
            pool = open_pool(len(tasks), workers=resources.workers, ray=resources.ray, device=plan.device)
            with Live("rendering what wears textures", len(tasks), 0, console=resources.console, unit="parts") as live:
                run_all(pool, _see, tasks, progress=live.show)
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
        if "light" in cell.spec:
            return light_pieces(cell, job)
        if cell.spec["attack"] is None:
            return {}
        spec = TextureSpec.of_row(cell.spec)
        if not spec.trained or _textures(job).kept(spec).is_file():
            return {}
        return {f"texture {spec.name}": dict(cell.spec)}

    def make(self, name: str, data: Any, systems: Sequence[str], job: Job) -> None:
        """Train a texture, or search a light."""
        if "light" in data:
            light_edit(job, data["light"])
            return
        texture_of(job, TextureSpec.of_row(data))

    def execute(self, cells: Sequence[Cell], job: Job) -> Mapping[str, Mapping[str, Any]]:
        """Scores in the town of the test."""
        return {cell.key: light_result(cell, job) if "light" in cell.spec else self._score(cell, job) for cell in cells}

    def _score(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Scores of a cell. CellError: the detector does not find the clean car."""
        settings, detector, grid = job.settings, cell.system, cell.spec["view"] == GRID
        clips = _test_clips(job, cell.spec, detector)
        clean = _clean_sightings(clips, detector)
        draws = {"replicates": settings["replicates"], "seed": settings["seed"]}
        before = target_scores(clean, **draws)
        if cell.spec["attack"] is None:
            return before | (grid_scores(clips.rows(), clean, None, floor=settings["floor"]) if grid else {})
        floor, have = settings["floor"], before["metrics"]["AP50"] or 0.0
        if have < floor:
            raise CellError(
                f"{detector} finds the clean car with AP50 {have:.3f}, which is less than the floor of {floor:g}"
            )
        spec, kept = TextureSpec.of_row(cell.spec), _textures(job)
        attacked = list(sightings(make_detector(detector, device=job.device), _worn(job, clips, spec)))
        found = target_scores(attacked, clean, **draws)
        if grid:
            found |= grid_scores(clips.rows(), clean, attacked, floor=floor)
        artefacts = {"texture": str(kept.picture(spec).relative_to(job.folder))}
        return {**found, "clean_AP50": have, "artefacts": artefacts, **kept.history(spec)}

    def finish(self, plan: Plan, folder: Path) -> None:
        """Pictures of each test town under each texture, of the grid from four sides, and of lights: DIR/pictures."""
        suite: PhysicalSuite = plan.suite
        captions = light_sheet(plan, folder)
        job = Job(folder, plan.device, {"target": suite.target, "seed": suite.seed})
        name = suite.detectors[0]
        detector = make_detector(name, device=plan.device)
        for pair in suite.pairs:
            chosen = self._chosen(plan, job, pair, name)
            for view, places in (("drive", (None,)), (GRID, SIDES)):
                path = folder / "pictures" / f"{view}-{pair.test.lower()}.jpg"
                clips = TargetClips(folder / "data" / f"{pair.test}{'-grid' if view == GRID else ''}", 1)
                trained = [(title, spec) for title, spec in chosen.items() if spec.source and not spec.of]
                shown = chosen if view == "drive" else dict(trained[-1:])
                if path.is_file() or not (clips.folder / "annotations").is_dir() or not chosen:
                    continue
                save_picture(path, _sheet(job, detector, clips, shown, places))
            for view, text in (("drive", "from behind"), (GRID, "from the front, the left, the rear and the right")):
                if (folder / "pictures" / f"{view}-{pair.test.lower()}.jpg").is_file():
                    captions[f"{view}-{pair.test.lower()}.jpg"] = (
                        f"What {name} finds (orange, score at least 0.25) in {pair.test}, clean and attacked, {text}."
                    )
        if captions:
            safeio.write_atomic(folder / "pictures" / "pictures.json", safeio.dump_json(captions, indent=1) + "\n")

    def _chosen(self, plan: Plan, job: Job, pair: Pair, detector: str) -> dict[str, TextureSpec]:
        """The textures of a pair of towns that are there, one of each attack, by title."""
        found: dict[str, TextureSpec] = {}
        for cell in plan.cells:
            spec = cell.spec
            if spec["attack"] is None or spec["pair"] != pair.model_dump() or spec["number"]:
                continue
            if cell.system == detector and spec["source"] in ("", detector):
                texture = TextureSpec.of_row(spec)
                if not texture.trained or _textures(job).kept(texture).is_file():
                    found.setdefault(f"{cell.fields['attack']} ({cell.fields['carrier']})", texture)
        return found


@lru_cache(maxsize=16)
def _surface(target: str, surface: str) -> Surface:
    """Where a texture goes, from plain data."""
    car, row = parse_target(target), safeio.parse_json(surface)
    assert isinstance(car, TargetCar)
    return make_carrier(row["carrier"], row["options"]).on(car.mesh())


def _layers(target: str, surfaces: Sequence[str]) -> list[tuple[Layer, ...]]:
    return [(_surface(target, surface).layer,) for surface in surfaces]


def _see(task: tuple[Path, int, str, Sequence[str], str]) -> None:
    """In a worker: render what the pictures of a part of a recording see of carriers, and keep it."""
    folder, part, target, surfaces, device = task
    quiet_warp()
    see_clips(folder, _layers(target, surfaces), part=part, device=device)


def _textures(job: Job) -> TextureFolder:
    """The textures of a run."""
    return TextureFolder(job.folder / "textures", job.settings["seed"], job.device)


def texture_of(job: Job, spec: TextureSpec) -> Tensor:
    """A texture of a run [3, H, W], sRGB; trained now if it has to be."""
    surface = _surface(job.settings["target"], spec.surface)

    def views() -> list[View]:
        town, count = spec.pair["train"], spec.pair["train_images"]
        classes = tuple(make_detector(spec.source).classes)
        clips = [TargetClips(job.folder / "data" / town, count, classes, job.device)]
        if spec.around:
            clips.append(TargetClips(job.folder / "data" / f"{town}-around", spec.around, classes, job.device))
        return [view for one in clips for _, view in one.wearing(surface)]

    return _textures(job).texture(
        spec, surface, views=views, detector=lambda: make_detector(spec.source, device=job.device)
    )


def _test_clips(job: Job, spec: Mapping[str, Any], detector: str) -> TargetClips:
    """The pictures that a cell is scored on, for a detector."""
    town, grid = spec["pair"]["test"], spec["view"] == GRID
    count = job.settings["grid"] if grid else spec["pair"]["test_images"]
    classes = tuple(make_detector(detector).classes)
    return TargetClips(job.folder / "data" / (f"{town}-grid" if grid else town), count, classes, job.device)


def _worn(job: Job, clips: TargetClips, spec: TextureSpec) -> Iterator[tuple[str, Tensor, Truth]]:
    """Drive, picture and truth of clips under a texture."""
    colour = albedo_of(texture_of(job, spec)).to(job.device)  # may be trained now, so gradients are on
    for drive, view in clips.wearing(_surface(job.settings["target"], spec.surface)):
        with torch.no_grad():
            yield drive, view.picture.together([view.picture], {0: colour[None]}), view.truth


@lru_cache(maxsize=8)
def _clean_sightings(clips: TargetClips, detector: str) -> tuple[Sighting, ...]:
    """What a detector finds in pictures as they were recorded; kept, since every cell needs it."""
    return tuple(sightings(make_detector(detector, device=clips.device), clips.clean()))


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


def _sheet(
    job: Job, detector: Detector, clips: TargetClips, textures: Mapping[str, TextureSpec], sides: Sequence[float | None]
) -> U8:
    """Views under textures below each other: the first one, or one from each side (azimuths in degrees)."""
    everything = replace(clips, count=len(replace(clips, count=1 << 30).rows()))
    rows = everything.rows()
    numbers = [k for side in sides for k in _from(rows, side)] or [0]
    clean = [one for k, one in enumerate(everything.clean()) if k in numbers]
    worn = {
        title: [one for k, one in enumerate(islice(_worn(job, everything, spec), max(numbers) + 1)) if k in numbers]
        for title, spec in textures.items()
    }
    sheets = []
    for k, (_, image, truth) in enumerate(clean):
        shown = [(CLEAN, image), *((title, views[k][1]) for title, views in worn.items())]
        columns = min(len(shown), COLUMNS)
        sheets.append(target_sheet(detector, shown, truth.box[0].tolist(), job.device, columns))
    return np.concatenate(sheets)


def _from(rows: Sequence[Mapping[str, Any]], side: float | None) -> list[int]:
    """The number of the first view from a side at some 10 m, by day; of any view where no side is wanted."""
    if side is None:
        return [0]
    near = sorted({abs(float(row["distance"]) - 10.0) for row in rows})[0]
    own = [
        k for k, row in enumerate(rows)
        if float(row["azimuth"]) == side and abs(float(row["distance"]) - 10.0) == near and row["weather"] != "night"
    ]  # fmt: skip
    return own[:1]

"""Kind `physical`: 2D detectors x textures on a car that drives, trained in one town and tested in another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ssad.bench.kind import Cell, CellError, Column, Job, Kind, Plan, Resources
from ssad.bench.kinds.detection import state_hash
from ssad.bench.physical_suite import Pair, PhysicalSuite, row_of, target_of
from ssad.core import safeio
from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.core.images import save_picture
from ssad.detectors import make_detector
from ssad.evaluation.target_scores import Sighting, sightings, target_scores
from ssad.evaluation.target_sheet import target_sheet
from ssad.jobs.machine import keep_memory, quiet_warp
from ssad.jobs.pool import open_pool, run_all
from ssad.jobs.progress import Live
from ssad.recording.clip_recorder import Clips, record_clips
from ssad.recording.target import TargetCar, parse_target
from ssad.recording.target_views import clean_images, target_views
from ssad.recording.textured_clips import textured_clips
from ssad.roads import town_names
from ssad.scenarios.static.physical import CONTROLS, Surface, TextureSpec, View, albedo_of, make_carrier
from ssad.scenarios.static.physical.kept import TextureFolder

CLEAN = "clean"


class Physical(Kind):
    """See the module. A piece is the training of a texture, which several cells show."""

    name = "physical"
    suite = PhysicalSuite
    columns = (
        Column("AP50", "AP50", "", "lower"),
        Column("AP50_all", "AP50 of all cars", "", "lower"),
        Column("ASR_25", "ASR at 0.25", "", "higher"),
        Column("ASR_50", "ASR at 0.5", "", "higher"),
        Column("confidence", "mean score", "", "lower"),
    )
    factors = ("test", "detector", "attack", "carrier", "source")

    def plan(self, suite: PhysicalSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Detectors and carriers are built once, so that what is wrong ends here."""
        target = target_of(suite)
        weights = {}
        for name in suite.detectors:
            detector = make_detector(name)
            if detector.task != "2d" or "car" not in detector.classes:
                raise ConfigError(f"suite {suite.name}: {name} is no 2D detector with a class car")
            weights[name] = state_hash(detector)
        for pair in suite.pairs:
            for town in (pair.train, pair.test):
                if town not in town_names():
                    raise ConfigError(f"suite {suite.name}: unknown town '{town}' (see: ssad list towns)")
        rows = [row_of(suite, entry) for entry in suite.attacks]
        for row in rows:
            make_carrier(row["carrier"], row["options"]).on(target.mesh())
        cells: dict[str, Cell] = {}
        for pair in suite.pairs:
            for detector in suite.detectors:
                for row in [{"attack": None}, *rows]:
                    for cell in self._cells(suite, pair, detector, row, weights, device):
                        cells.setdefault(cell.key, cell)
        return Plan(self, suite, device, tuple(cells.values()), {"weights": weights}, {}, None)

    def _cells(  # noqa: PLR0917
        self,
        suite: PhysicalSuite,
        pair: Pair,
        detector: str,
        row: Mapping[str, Any],
        weights: Mapping[str, str],
        device: str,
    ) -> list[Cell]:
        """The cells of an attack on a detector in a pair of towns."""
        attack = row["attack"]
        trained = attack is not None and (attack not in CONTROLS or row["of"] is not None)
        sources = suite.detectors if trained and suite.transfer else [detector]
        seeds = range(suite.seeds) if attack in ("random", "noise", "shuffled") else (0,)
        found = []
        for source in sources:
            for seed in seeds:
                spec = {**row, "pair": pair.model_dump(), "source": source if trained else "", "number": seed}
                fields = {
                    "test": pair.test, "train": pair.train, "detector": detector, "carrier": row.get("carrier", ""),
                    "attack": CLEAN if attack is None else attack if not row["of"] else f"shuffled {row['of']}",
                    "source": source if trained else "", "number": seed,
                }  # fmt: skip
                title = "/".join([detector, pair.test, fields["attack"], str(fields["carrier"]), source, str(seed)])
                inputs = suite.target, suite.behind, suite.size, suite.floor, suite.replicates, device
                found.append(
                    self.make_cell(
                        title, detector, suite.seed, fields, spec, *inputs, weights[detector], weights[source]
                    )
                )
        return found

    def order(self, cell: Cell) -> float:
        """Clean first, then controls, then what is trained."""
        return 0 if cell.spec["attack"] is None else 1 if not cell.spec["source"] else 2

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Records the pictures, and renders once what they see of each carrier."""
        suite: PhysicalSuite = plan.suite
        images: dict[str, int] = {}
        for pair in suite.pairs:
            for town, count in ((pair.train, pair.train_images), (pair.test, pair.test_images)):
                images[town] = max(images.get(town, 0), count)
        target = target_of(suite)
        for town, count in images.items():
            clips = Clips(
                folder / "data" / town, ((town, count),), (), target=target, behind=suite.behind, size=suite.size,
                seed=suite.seed, device=plan.device,
            )  # fmt: skip
            with Live(f"recording {town}", count, 0, console=resources.console, unit="parts") as live:
                record_clips(clips, workers=resources.workers, ray=resources.ray, progress=live.show)
        surfaces = dict.fromkeys(TextureSpec.of_row(c.spec).surface for c in plan.cells if c.spec["attack"])
        tasks = [
            (folder / "data" / town, suite.target, surface, plan.device) for town in images for surface in surfaces
        ]
        if tasks:
            pool = open_pool(len(tasks), workers=resources.workers, ray=resources.ray, device=plan.device)
            with Live("rendering what wears textures", len(tasks), 0, console=resources.console, unit="parts") as live:
                run_all(pool, _see, tasks, progress=live.show)
        return {
            "target": suite.target, "floor": suite.floor, "replicates": suite.replicates, "seed": suite.seed,
        }  # fmt: skip

    def start(self, job: Job) -> None:
        """Memory for tensors is kept."""
        keep_memory()
        quiet_warp()

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """The training of the cell's texture, unless it is done."""
        if cell.spec["attack"] is None:
            return {}
        spec = TextureSpec.of_row(cell.spec)
        if not spec.source or _textures(job).kept(spec).is_file():
            return {}
        return {f"texture {spec.name}": dict(cell.spec)}

    def make(self, name: str, data: Any, systems: Sequence[str], job: Job) -> None:
        """Train a texture."""
        texture_of(job, TextureSpec.of_row(data))

    def execute(self, cells: Sequence[Cell], job: Job) -> Mapping[str, Mapping[str, Any]]:
        """Scores in the town of the test."""
        found = {}
        for cell in cells:
            pair = cell.spec["pair"]
            clean = _clean_sightings(job.folder, job.device, cell.system, pair["test"], pair["test_images"])
            before = target_scores(clean, replicates=job.settings["replicates"], seed=job.settings["seed"])
            if cell.spec["attack"] is None:
                found[cell.key] = before
                continue
            floor, have = job.settings["floor"], before["metrics"]["AP50"] or 0.0
            if have < floor:
                raise CellError(
                    f"{cell.system} finds the clean car with AP50 {have:.3f}, which is less than the floor of {floor:g}"
                )
            spec = TextureSpec.of_row(cell.spec)
            own = target_scores(
                _sightings(job, cell.system, spec), clean, replicates=job.settings["replicates"],
                seed=job.settings["seed"],
            )  # fmt: skip
            kept = _textures(job)
            artefacts = {"texture": str(kept.picture(spec).relative_to(job.folder))}
            found[cell.key] = {**own, "clean_AP50": have, "artefacts": artefacts, **kept.history(spec)}
        return found

    def finish(self, plan: Plan, folder: Path) -> None:
        """One picture of the first test town under each texture: DIR/pictures/textures.jpg."""
        suite: PhysicalSuite = plan.suite
        job = Job(folder, plan.device, {"target": suite.target, "seed": suite.seed})
        path, pair, name = folder / "pictures" / "textures.jpg", suite.pairs[0], suite.detectors[0]
        chosen: dict[str, TextureSpec] = {}
        for cell in plan.cells:
            mine = cell.system == name and cell.spec["pair"] == pair.model_dump() and cell.spec["source"] in ("", name)
            if mine and cell.spec["attack"] and cell.spec["number"] == 0:
                spec = TextureSpec.of_row(cell.spec)
                if spec.source and not _textures(job).kept(spec).is_file():
                    continue
                chosen.setdefault(f"{cell.fields['attack']} ({cell.fields['carrier']})", spec)
        if not path.is_file() and (folder / "data" / pair.test / "annotations").is_dir():
            ((_, clean, _),) = clean_images(folder / "data" / pair.test, 1, device=plan.device)
            shown = [(CLEAN, clean)]
            shown += [(title, next(_worn(job, pair.test, spec, 1))[1]) for title, spec in chosen.items()]
            save_picture(path, target_sheet(make_detector(name, device=plan.device), shown, plan.device))
        if path.is_file():
            caption = (
                f"What {name} finds (orange, score at least 0.25) in a picture of {pair.test}, clean and attacked."
            )
            safeio.write_atomic(
                path.with_name("pictures.json"), safeio.dump_json({path.name: caption}, indent=1) + "\n"
            )


@lru_cache(maxsize=16)
def _surface(target: str, surface: str) -> Surface:
    """Where a texture goes, from plain data."""
    car, row = parse_target(target), safeio.parse_json(surface)
    assert isinstance(car, TargetCar)
    return make_carrier(row["carrier"], row["options"]).on(car.mesh())


def _see(task: tuple[Path, str, str, str]) -> None:
    """In a worker: render what all pictures of a recording see of a carrier, and keep it."""
    folder, target, surface, device = task
    quiet_warp()
    for _ in textured_clips(folder, (_surface(target, surface).layer,), device=device):
        pass


def _textures(job: Job) -> TextureFolder:
    """The textures of a run."""
    return TextureFolder(job.folder / "textures", job.settings["seed"], job.device)


def _views(job: Job, town: str, spec: TextureSpec, count: int) -> list[tuple[str, View]]:
    """Pictures of a town whose target waits for a texture."""
    surface = _surface(job.settings["target"], spec.surface)
    return target_views(job.folder / "data" / town, surface, count, device=job.device)


def texture_of(job: Job, spec: TextureSpec) -> Tensor:
    """A texture of a run [3, H, W], sRGB; trained now if it has to be."""
    return _textures(job).texture(
        spec,
        _surface(job.settings["target"], spec.surface),
        views=lambda: [view for _, view in _views(job, spec.pair["train"], spec, spec.pair["train_images"])],
        detector=lambda: make_detector(spec.source, device=job.device),
    )


def _worn(job: Job, town: str, spec: TextureSpec, count: int) -> Iterator[tuple[str, Tensor, Truth]]:
    """Drive, picture and truth of the first pictures of a town under a texture."""
    colour = albedo_of(texture_of(job, spec)).to(job.device)  # may be trained now, so gradients are on
    for drive, view in _views(job, town, spec, count):
        with torch.no_grad():
            yield drive, view.picture.show({0: colour}), view.truth


def _sightings(job: Job, detector: str, spec: TextureSpec) -> list[Sighting]:
    """What a detector finds in the pictures of the test under a texture."""
    pictures = _worn(job, spec.pair["test"], spec, spec.pair["test_images"])
    return list(sightings(make_detector(detector, device=job.device), pictures))


@lru_cache(maxsize=8)
def _clean_sightings(folder: Path, device: str, detector: str, town: str, count: int) -> tuple[Sighting, ...]:
    """What a detector finds in the pictures of the test as they were recorded; kept, since every cell needs it."""
    pictures = clean_images(folder / "data" / town, count, device=device)
    return tuple(sightings(make_detector(detector, device=device), pictures))

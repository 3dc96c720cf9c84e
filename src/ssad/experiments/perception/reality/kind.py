"""Kind `reality`: detectors x annotated photographs, clean, and with textures and their controls on the cars."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, field_validator

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.machine import retain_freed_memory
from ssad.core.run_records import NOT_NEGATIVE, SHARE
from ssad.datasets.photographs import Photograph, PhotographSet, read_photographs
from ssad.detectors import cached_detector
from ssad.engine.kind import Cell, CellError, Column, Job, Kind, Names, Plan, Resources, SuiteBase
from ssad.experiments.perception.reality import page
from ssad.experiments.perception.reality.photograph_boxes import (
    ROAD_CLASSES,
    PhotographBoxes,
    boxes_file,
    cached_boxes,
    find_boxes,
    known_labels,
    true_boxes,
)
from ssad.experiments.perception.reality.sheets import write_sheets
from ssad.experiments.perception.reality.verdict import verdict
from ssad.experiments.perception.reality.worn_textures import (
    CLEAN,
    TRAINED,
    WornCar,
    car_scores,
    drawn_colour,
    wearing_cars,
    worn_images,
)
from ssad.experiments.perception.scored_data import detectors_of
from ssad.metrics.photographs import HeightBand, photograph_scores, worn_scores
from ssad.report.load import Run
from ssad.report.tables import Table
from ssad.scenarios.static.physical.textures.perturbation import Texture
from ssad.scenarios.static.physical.textures.photographs import face_print

MARGIN = (-1.0, 1.0)


class RealitySuite(SuiteBase):
    """Detectors, photographs and textures.

    Attributes:
        data: folder of annotated photographs, or a JSON file of annotations (docs/how-to/test-on-photographs.md).
        split: split of the photographs, such as val2017; default: all of them.
        detectors: names, with weights of your own as NAME=FILE, onnx:FILE, centernet:FILE, or module:object.
        photographs: greatest number of photographs; of more, these are evenly spread.
        score: score from which on a box counts for recall and precision.
        heights: limits of the ranges of heights, pixels; smaller objects than the first are ignored.
        textures: textures for cars, as in suites of kind perception; each is pasted onto the rear of the cars.
        controls: random, noise, grey, shuffled: untrained textures beside each.
        draws: draws of each control that is random.
        wearer_height: least height of a car that wears a texture, pixels.
        replicates: replicates of the bootstrap over photographs.
    """

    kind: Literal["reality"]
    data: str = ""
    split: str = ""
    detectors: Names = Field(default=["yolov5n", "yolov3-tiny"], min_length=1)
    photographs: int = Field(default=500, ge=1)
    score: float = Field(default=0.25, gt=0.0, lt=1.0)
    heights: Annotated[list[float], Field(min_length=1)] = Field(default=[16.0, 24.0, 48.0, 96.0])
    textures: list[str] = Field(default=[])
    controls: list[Literal["random", "noise", "grey", "shuffled"]] = Field(default=["random", "shuffled"])
    draws: int = Field(default=3, ge=1, le=100)
    wearer_height: float = Field(default=40.0, ge=8.0)
    replicates: int = Field(default=200, ge=0, le=10_000)

    @field_validator("heights")
    @classmethod
    def _check_heights(cls, heights: list[float]) -> list[float]:
        if sorted(set(heights)) != heights or heights[0] < 0:
            raise ValueError("heights: rising numbers from 0, such as [16, 24, 48]")
        return heights

    def beside(self, path: Path) -> Self:
        """Return the suite with its textures and its data in the working folder, else beside its own file."""
        textures = [
            _beside(texture, path.parent) if texture.endswith(".json") else texture for texture in self.textures
        ]
        return self.model_copy(update={"textures": textures, "data": _beside(self.data, path.parent)})


def _beside(name: str, folder: Path) -> str:
    path = Path(name).expanduser()
    return name if not name or path.is_absolute() or path.exists() else str(folder / path)


class Reality(Kind):
    """Kind `reality`. All cells of a detector share its boxes in the clean photographs."""

    name = "reality"
    suite = RealitySuite
    columns = (
        Column("recall", "recall", "", "higher", limits=SHARE),
        Column("precision", "precision", "", "higher", limits=SHARE),
        Column("AP50", "AP50", "", "higher", limits=SHARE),
        Column("margin", "score margin", "", "higher", limits=MARGIN),
        Column("boxes", "boxes per photograph", limits=NOT_NEGATIVE),
        Column("wrong", "wrong boxes per photograph", "", "lower", limits=NOT_NEGATIVE),
        Column("found", "cars with a texture found", limits=SHARE),
        Column("score", "mean score of these cars", limits=SHARE),
        Column("change", "change of that score", limits=MARGIN),
        Column("hidden", "share of the cars found clean that are hidden", limits=SHARE),
    )
    factors = ("detector", "texture", "pasted")
    patience = 2

    def plan(self, suite: RealitySuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Build textures and detectors once, and read all annotations."""
        if not suite.data:
            raise ConfigError(
                f"suite {suite.name}: data: no folder of annotated photographs; give one with --set data=FOLDER "
                "(docs/how-to/test-on-photographs.md)"
            )
        for texture in suite.textures:
            face_print(texture)
        names = [Texture(texture).name for texture in suite.textures]
        if len(set(names)) < len(names):
            raise ConfigError(f"suite {suite.name}: textures: a name appears twice; give each texture once")
        photograph_set = read_photographs(Path(suite.data).expanduser(), suite.split).thinned(suite.photographs)
        data = data_identity(photograph_set)
        victims = detectors_of(suite.name, suite.detectors, allow_2d=True, scenes=False)
        cells = []
        for detector in victims.files:
            settings = [victims.weights[detector], device, safeio.dump_json(data), suite.score, suite.replicates]
            clean_boxes = boxes_file(detector, " ".join([CLEAN, self.code, *map(str, settings[:3])]))
            for texture, pasted in [("", CLEAN), *((t, p) for t in suite.textures for p in (TRAINED, *suite.controls))]:
                label = Texture(texture).name if texture else ""
                fields = {"detector": detector, "texture": label, "pasted": pasted}
                spec = {
                    "texture": texture,
                    "heights": suite.heights,
                    "wearer_height": suite.wearer_height,
                    "clean_boxes": clean_boxes,
                }
                inputs = [*settings, suite.draws if texture else "", Texture(texture).version() if texture else ""]
                title = f"{detector}/{label}/{pasted}" if texture else f"{detector}/{CLEAN}"
                cells.append(self.make_cell(title, detector, suite.seed, fields, spec, *inputs))
        inputs_by_name = {"weights": victims.weights, "data": data}
        return Plan(self, suite, device, tuple(cells), inputs_by_name, {}, victims.files)

    def plan_lines(self, plan: Plan) -> list[str]:
        """Return form and numbers of the photographs."""
        data = plan.inputs["data"]
        return [f"{data['photographs']} photographs in the form {data['form']}, {data['objects']} objects"]

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Return the settings of the workers."""
        suite: RealitySuite = plan.suite
        return {
            "detectors": dict(plan.details),
            "data": str(Path(suite.data).expanduser().resolve()),
            "split": suite.split,
            "photographs": suite.photographs,
            "score": suite.score,
            "draws": suite.draws,
            "replicates": suite.replicates,
        }

    def start(self, job: Job) -> None:
        """Keep the memory of tensors."""
        retain_freed_memory()

    def order(self, cell: Cell) -> float:
        """Return the priority of a cell: clean first."""
        return float(cell.fields["pasted"] != CLEAN)

    def result(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Return the scores of a detector on the photographs, or on the cars that wear a texture.

        Raises:
            CellError: The detector cannot be shown the photographs, or no car can wear a texture.
        """
        settings = job.settings
        photographs = _photographs(settings["data"], settings["split"], settings["photographs"])
        detector = cached_detector(
            cell.system, weights=settings["detectors"].get(cell.system) or None, device=job.device
        )
        clean_file = cell.spec["clean_boxes"]
        clean = cached_boxes(
            job.folder / clean_file, partial(find_boxes, detector, _clean_images(photographs), job.device)
        )
        cars = _cars(settings["data"], settings["split"], settings["photographs"], cell.spec["wearer_height"])
        if cell.fields["pasted"] == CLEAN:
            record = _clean_scores(cell, settings, known_labels(detector), photographs=photographs, boxes=clean)
            return _add_cars(record, settings, photographs, cars, clean) | {"artefacts": {"boxes": [clean_file]}}
        if not cars:
            raise CellError(
                f"no car of at least {cell.spec['wearer_height']:g} px shows its rear or front; lower wearer_height"
            )
        worn = face_print(cell.spec["texture"])
        draws = settings["draws"] if cell.fields["pasted"] in ("random", "noise", "shuffled") else 1
        files, scores = [], []
        for draw in range(draws):
            colour = drawn_colour(worn, cell.fields["pasted"], draw)
            files.append(boxes_file(cell.system, f"{cell.key} {draw}"))
            find = partial(find_boxes, detector, worn_images(photographs, cars, worn, colour), job.device)
            scores.append(car_scores(photographs, cars, cached_boxes(job.folder / files[-1], find)))
        clean_scores = np.tile(car_scores(photographs, cars, clean), draws)
        images = np.tile(np.array([car.image for car in cars], np.int32), draws)
        record = worn_scores(
            clean_scores,
            np.concatenate(scores),
            images,
            threshold=settings["score"],
            replicates=settings["replicates"],
            seed=cell.seed,
        )
        return record | {"n": len(cars), "images": len(set(images.tolist())), "artefacts": {"boxes": files}}

    def finish(self, plan: Plan, folder: Path) -> None:
        """Draw boxes into photographs, clean and with textures on the cars."""
        suite: RealitySuite = plan.suite
        arguments = (str(Path(suite.data).expanduser().resolve()), suite.split, suite.photographs)
        write_sheets(plan, folder, _photographs(*arguments), _cars(*arguments, suite.wearer_height))

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Return the page of a run and its tables."""
        return page.section(run, self.verdict(run))

    def summary(self, run: Run) -> Table:
        """Return the main table of a run."""
        return page.main_table(run)

    def verdict(self, run: Run) -> list[str]:
        """Return the findings of a run in sentences."""
        return verdict(run)


def _clean_scores(
    cell: Cell,
    settings: Mapping[str, Any],
    labels: Sequence[int],
    *,
    photographs: Sequence[Photograph],
    boxes: PhotographBoxes,
) -> dict[str, Any]:
    """Return the scores of boxes on the clean photographs, for the classes that a detector knows."""
    heights = cell.spec["heights"]
    return photograph_scores(
        true_boxes(photographs, labels),
        boxes.as_table(),
        images=len(photographs),
        classes=ROAD_CLASSES,
        bands=[HeightBand(low, high) for low, high in zip(heights, [*heights[1:], np.inf], strict=True)],
        threshold=settings["score"],
        replicates=settings["replicates"],
        seed=cell.seed,
    )


def _add_cars(
    record: dict[str, Any],
    settings: Mapping[str, Any],
    photographs: Sequence[Photograph],
    cars: Sequence[WornCar],
    boxes: PhotographBoxes,
) -> dict[str, Any]:
    """Return the record of the clean photographs with the scores of the cars that textures are pasted onto."""
    if cars:
        scores = car_scores(photographs, cars, boxes)
        images = np.array([car.image for car in cars], np.int32)
        clean_cars = worn_scores(scores, scores, images, threshold=settings["score"], replicates=settings["replicates"])
        for name in ("found", "score"):
            record["metrics"][name] = clean_cars["metrics"][name]
            record["intervals"] |= {name: clean_cars["intervals"][name]} if name in clean_cars["intervals"] else {}
    return record | {"cars": len(cars)}


def data_identity(photograph_set: PhotographSet) -> dict[str, Any]:
    """Return the form of a set of photographs, its numbers, and a hash of its images and annotations."""
    state = hashlib.sha256()
    objects = 0
    for photograph in photograph_set.photographs:
        state.update(photograph.name.encode() + b"\0")
        state.update(hashlib.sha256(safeio.read_bytes(photograph.file)).digest())
        for column in (photograph.box, photograph.label, photograph.solid, photograph.intrinsic):
            state.update(b"none" if column is None else np.ascontiguousarray(column).tobytes())
        objects += int((~photograph.ignored).sum())
    return {
        "form": photograph_set.form,
        "photographs": len(photograph_set.photographs),
        "objects": objects,
        "hash": state.hexdigest()[:16],
    }


def _clean_images(photographs: Sequence[Photograph]) -> Iterator[tuple[int, Any, Photograph]]:
    for number, photograph in enumerate(photographs):
        yield number, photograph.read(), photograph


@lru_cache(maxsize=2)
def _photographs(data: str, split: str, limit: int) -> tuple[Photograph, ...]:
    return read_photographs(Path(data), split).thinned(limit).photographs


@lru_cache(maxsize=2)
def _cars(data: str, split: str, limit: int, min_height: float) -> tuple[WornCar, ...]:
    return tuple(wearing_cars(_photographs(data, split, limit), min_height))

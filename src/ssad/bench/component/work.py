"""The pieces of work of a detection suite: one scene under one shift, seen by all detectors; written, then scored."""

from __future__ import annotations

import io
import time
import zipfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.core import safeio
from ssad.core.detections import Detections, Solids
from ssad.core.errors import FormatError, SSADError
from ssad.core.seeding import generator
from ssad.core.types import U8
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.datasets.nuscenes.truth import GroundTruth, read_truth
from ssad.detectors import make_detector
from ssad.detectors.check import promises
from ssad.detectors.mono3d.multi_camera import WorldBoxes
from ssad.evaluation.detection import SampleBoxes, detect_with, match_boxes, numbers, to_host
from ssad.jobs.machine import quiet_warp
from ssad.metrics.uncertainty import percentile_interval
from ssad.scenarios.static.shifts import Calibration, ShiftSpec
from ssad.toolbox.scene_shifter import SceneShifter

FOLDER = "detections"
_COLUMNS = ("translation", "size", "rotation", "velocity", "score", "label")


@dataclass(frozen=True, slots=True)
class Unit:
    """One scene under one shift (None: clean) at one severity ("random": drawn by sample)."""

    shift: str | None
    severity: int | str
    scene: str

    @property
    def path(self) -> str:
        """Where its boxes lie in the results folder."""
        name = "clean" if self.shift is None else f"{self.shift}-{self.severity}"
        return f"{FOLDER}/{name}/{self.scene}.npz"


@dataclass(frozen=True, slots=True)
class Job:
    """What is the same for all pieces of work. detectors: name -> weights ("" for the shipped ones)."""

    folder: Path
    root: Path
    version: str
    detectors: tuple[tuple[str, str], ...]
    calibration: Calibration
    seed: int
    replicates: int
    device: str
    threads: int


def detector_of(name: str, weights: str, device: str) -> Any:
    """A detector by name (what follows an @ is a label of the suite's own) and weights."""
    return make_detector(name.partition("@")[0], weights=weights or None, device=device)


class Watched:
    """A detector whose failure is a result: once it has raised, or broken a promise, it finds nothing more. reason:
    why, in one line, "" while it works. Memory that is used up and a device that is lost are raised. What it finds is
    on the host."""

    def __init__(self, detector: Any) -> None:
        self.detector, self.reason = detector, ""

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """As the detector, or nothing."""
        if not self.reason:
            try:
                found = to_host(self.detector.predict(images, intrinsic, threshold=threshold))
                self.reason = self._broken(found, len(images))
                if not self.reason:
                    return found
            except Exception as error:  # whatever a stranger's detector raises
                if isinstance(error, MemoryError | torch.OutOfMemoryError) or "CUDA error" in str(error):
                    raise
                text = " ".join(str(error).split())
                self.reason = text if isinstance(error, SSADError) else f"{type(error).__name__}: {text}"[:300]
        nothing, whole = torch.zeros(0), torch.zeros(0, dtype=torch.int64)
        solid = Solids(nothing.reshape(0, 3), nothing.reshape(0, 3), nothing, nothing.reshape(0, 2), whole)
        return [Detections(nothing, whole, nothing.reshape(0, 4), solid)] * len(images)

    def _broken(self, found: Sequence[Detections], images: int) -> str:
        if len(found) != images:
            return "broken promise: predict answers for each image"
        for one in found:
            for kept, promise in promises(one, classes=len(self.detector.classes), three=True):
                if not kept:
                    return f"broken promise: {promise}"
        return ""


@lru_cache(maxsize=4)
def _detectors(job: Job) -> list[Any]:
    quiet_warp()
    torch.set_num_threads(job.threads)
    return [detector_of(name, weights, job.device) for name, weights in job.detectors]


def shifter_of(job: Job, data: NuScenes, unit: Unit) -> SceneShifter | None:
    """The scene through the unit's shift; None for the clean one."""
    if unit.shift is None:
        return None
    drawn = unit.severity == "random"
    spec = ShiftSpec(unit.shift, 1 if drawn else int(unit.severity), seed=job.seed, calibration=job.calibration)
    return SceneShifter(job.root, data.scene(unit.scene), spec, random=drawn)


@dataclass(frozen=True, slots=True)
class Made:
    """A unit that was worked at; reason: why it failed, "" if it did not."""

    unit: Unit
    reason: str
    seconds: float


def make_unit(task: tuple[Job, Unit]) -> Made:
    """Writes the boxes that each detector finds, unless they are there.

    Memory that is used up, and a device that is lost, end the run: only what the data cause is a result.
    """
    job, unit = task
    path, began = job.folder / unit.path, time.monotonic()
    if path.is_file():
        return Made(unit, "", 0.0)
    try:
        with NuScenes(job.root, job.version) as data:
            scene, shifter = data.scene(unit.scene), shifter_of(job, data, unit)
            applied: Counter[str] = Counter()

            def look(frames: Sequence[SensorFrame]) -> Sequence[U8]:
                assert shifter is not None
                images, done = shifter.images(frames, device=None if job.device == "cpu" else job.device)
                applied.update("applied" if one.applied else "not applied" for one in done)
                for one in done:
                    applied.update({f"skipped: {why}": int(count) for why, count in one.skipped.items()})
                return images

            watched = [Watched(one) for one in _detectors(job)]
            shown: list[Any] = [*watched]
            found = detect_with(shown, job.root, scene, device=job.device, look=None if shifter is None else look)
    except SSADError as error:
        return Made(unit, str(error), time.monotonic() - began)
    columns: dict[str, Any] = {}
    for (name, _), samples, one in zip(job.detectors, found, watched, strict=True):
        if one.reason:
            columns[f"{name}/failed"] = np.array(one.reason)
            continue
        boxes = [sample.boxes for sample in samples]
        columns[f"{name}/sample"] = np.array([sample.token for sample in samples])
        columns[f"{name}/count"] = np.array([len(b) for b in boxes], np.int32)
        for column in _COLUMNS:
            columns[f"{name}/{column}"] = np.concatenate([getattr(b, column) for b in boxes])
        columns[f"{name}/attribute"] = np.array([a for b in boxes for a in b.attribute], "U40")
    columns["applied"] = np.array(safeio.dump_json(dict(sorted(applied.items()))))
    file = io.BytesIO()
    np.savez_compressed(file, **columns)
    safeio.write_atomic(path, file.getvalue())
    return Made(unit, "", time.monotonic() - began)


def forget_failures(folder: Path, units: Sequence[Unit]) -> None:
    """Takes away the boxes of units in which a detector failed, so that they are made anew. FormatError: broken."""
    for path in (folder / unit.path for unit in units):
        if not path.is_file():
            continue
        try:
            with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
                failed = any(name.endswith("/failed") for name in file.files)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise _broken_file(path, error) from None
        if failed:
            path.unlink()


def _broken_file(path: Path, error: Exception) -> FormatError:
    return FormatError(f"{path}: broken ({type(error).__name__}); remove it and run again")


class DetectorFailed(SSADError):
    """A detector failed on a scene; why."""


def read_unit(path: Path, detector: str) -> tuple[list[SampleBoxes], dict[str, int]]:
    """Boxes by sample of one detector, and how often the shift was applied. FormatError; DetectorFailed."""
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            if f"{detector}/failed" in file:
                raise DetectorFailed(str(file[f"{detector}/failed"]))
            ends = np.cumsum(file[f"{detector}/count"])
            parts = {c: np.split(file[f"{detector}/{c}"], ends[:-1]) for c in (*_COLUMNS, "attribute")}
            tokens = [str(token) for token in file[f"{detector}/sample"]]
            applied = safeio.parse_json(str(file["applied"]))
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise _broken_file(path, error) from None
    names = parts.pop("attribute")
    found = [
        SampleBoxes(token, WorldBoxes(**{c: parts[c][k] for c in _COLUMNS}, attribute=tuple(map(str, names[k]))))
        for k, token in enumerate(tokens)
    ]
    return found, {str(k): int(v) for k, v in applied.items()}


@lru_cache(maxsize=2)
def _truth(root: Path, version: str, scenes: tuple[str, ...]) -> GroundTruth:
    return read_truth(root, version, scenes=frozenset(scenes))


@dataclass(frozen=True, slots=True)
class Cell:
    """One row of the results: a detector under a shift (None: clean) at a severity, over units that hold its boxes."""

    key: str
    detector: str
    shift: str | None
    severity: int | str
    units: tuple[Unit, ...]


@dataclass(frozen=True, slots=True)
class Scored:
    """A cell that was worked at, and what its record says of it: numbers, or the reason why it failed."""

    cell: Cell
    result: dict[str, Any]
    seconds: float


def score_cell(task: tuple[Job, Cell]) -> Scored:
    """Metrics of a cell, their intervals by the bootstrap over scenes, and the replicates (paired between cells)."""
    (job, cell), began = task, time.monotonic()
    scenes = tuple(unit.scene for unit in cell.units)
    truth = _truth(job.root, job.version, scenes)
    found: list[SampleBoxes] = []
    applied: Counter[str] = Counter()
    for unit in cell.units:
        try:
            boxes, counts = read_unit(job.folder / unit.path, cell.detector)
        except DetectorFailed as error:
            return Scored(cell, {"reason": f"{unit.scene}: {error}"}, time.monotonic() - began)
        found += boxes
        applied.update(counts)
    matches = match_boxes(found, truth)
    values = numbers(matches.scores())
    draws: list[dict[str, float]] = []
    if len(truth.scenes) > 1:
        chance = generator("detection suite", job.seed, len(truth.scenes))  # the same draws for every cell
        even = np.full(len(truth.scenes), 1.0 / len(truth.scenes))
        for draw in chance.multinomial(len(truth.scenes), even, size=job.replicates):
            draws.append(numbers(matches.scores(draw[truth.scene]), few=True))
    replicates = {name: [round(d[name], 5) for d in draws] for name in (draws[0] if draws else {})}
    intervals = {name: [round(v, 5) for v in percentile_interval(np.array(r))] for name, r in replicates.items()}
    result = {
        "metrics": values, "intervals": intervals, "replicates": replicates, "n": len(truth.samples),
        "scenes": len(truth.scenes), "applied": dict(sorted(applied.items())),
    }  # fmt: skip
    return Scored(cell, result, time.monotonic() - began)

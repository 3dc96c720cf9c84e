"""What detectors find in one scene under one condition, kept as files: the work that cells of a suite share.

A condition is what the pictures went through: nothing, a shift, a digital attack.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ssad.core import safeio
from ssad.core.boxes import size_columns
from ssad.core.detections import Detections, Solids
from ssad.core.errors import FormatError, SSADError
from ssad.core.machine import keep_memory, quiet_warp
from ssad.core.seeding import digest, generator
from ssad.core.types import U8
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.datasets.nuscenes.truth import GroundTruth, read_truth
from ssad.detectors import make_detector
from ssad.detectors.check import promises
from ssad.detectors.image_scores import (
    PictureBoxes,
    PictureTruth,
    SamplePictures,
    match_pictures,
    picture_figures,
    read_picture_truth,
)
from ssad.detectors.mono3d.multi_camera import DetectedBoxes
from ssad.detectors.on_scenes import AT_ONCE, Look, SampleBoxes, detect_with, match_boxes, numbers, to_host
from ssad.metrics.uncertainty import replicate_estimate
from ssad.scenarios.static.digital.defences import Defence, Defended
from ssad.scenarios.static.shifts import Calibration, ShiftSpec
from ssad.scenarios.static.shifts.scene_shifter import SceneShifter

FOLDER = "detections"
_FLAT = ("camera", "box", "score", "label")  # of 2D detectors
_COLUMNS = ("translation", "size", "rotation", "velocity", "score", "label", "attribute")  # as nuScenes has them


@dataclass(frozen=True, slots=True)
class Examination:
    """What is the same for all scenes of a run.

    Attributes:
        folder: of the results.
        root, version: of the data set.
        detectors: name -> weights ("" for the shipped ones).
        seed: of the random numbers.
        device: where detectors, shifts and attacks run.
        threads: of linear algebra.
        calibration: of the shifts.
        defended: systems that are a detector behind a defence: name -> the detector's name and the defence. All other
            systems are detectors.
    """

    folder: Path
    root: Path
    version: str
    detectors: tuple[tuple[str, str], ...]
    seed: int
    device: str
    threads: int
    calibration: Calibration = "physical"
    defended: Mapping[str, tuple[str, Defence]] = field(default_factory=dict)


@dataclass(slots=True)
class Shown:
    """How detectors are shown a scene.

    Attributes:
        look: gives the pictures of camera frames; None: the files as they are.
        notes: plain data for the file of boxes, complete when all was looked at.
        ahead: the next pictures may be made while a detector looks at these.
        at_once: samples that a GPU is shown at once.
        done: is called when the boxes are written.
    """

    look: Look | None = None
    notes: Callable[[], Mapping[str, Any]] = field(default=dict)
    ahead: bool = True
    at_once: int = AT_ONCE
    done: Callable[[], None] = lambda: None


class Condition(Protocol):
    """One scene under one condition.

    Attributes:
        scene: name of the scene.
        name: its place below the folder of a detector's boxes: CONDITION/SCENE.
    """

    @property
    def scene(self) -> str:
        """Name of the scene."""

    @property
    def name(self) -> str:
        """Its place below the folder of a detector's boxes: CONDITION/SCENE."""

    def shown(self, examination: Examination, data: NuScenes, detectors: Sequence[Watched]) -> Shown:
        """How these detectors are shown the scene."""


@dataclass(frozen=True, slots=True)
class ShiftedScene:
    """One scene under one shift (None: clean) at one severity ("random": drawn by sample)."""

    shift: str | None
    severity: int | str
    scene: str

    @property
    def name(self) -> str:
        """See `Condition`."""
        return f"{'clean' if self.shift is None else f'{self.shift}-{self.severity}'}/{self.scene}"

    def shown(self, examination: Examination, data: NuScenes, detectors: Sequence[Watched]) -> Shown:
        """See `Condition`: all detectors are shown the same pictures; noted is how often the shift was applied."""
        shifter = shifter_of(examination, data, self)
        if shifter is None:
            return Shown()
        applied: Counter[str] = Counter()

        def look(frames: Sequence[SensorFrame]) -> Sequence[U8]:
            device = None if examination.device == "cpu" else examination.device
            images, done = shifter.images(frames, device=device)
            applied.update("applied" if one.applied else "not applied" for one in done)
            for one in done:
                applied.update({f"skipped: {why}": int(count) for why, count in one.skipped.items()})
            return images

        return Shown(look, lambda: applied)


def detector_of(name: str, weights: str, device: str) -> Any:
    """A detector by name (what follows an @ is a label of the suite's own) and weights."""
    return make_detector(name, weights=weights or None, device=device)


def boxes_path(folder: Path, detector: str, scene: Condition) -> Path:
    """Where the boxes of a detector lie: detections/DETECTOR/CONDITION/SCENE.npz."""
    return folder / FOLDER / file_name(detector) / f"{scene.name}.npz"


def file_name(name: str) -> str:
    """A name as a file's: what is no letter, digit, ., @ or - becomes -, and then a hash keeps names apart."""
    plain = re.sub(r"[^\w.@-]", "-", name)
    return plain if plain == name else f"{plain}-{digest(name)[:6]}"


class Watched:
    """A detector whose failure is a result: once it has raised, or broken a promise, it finds nothing more.

    Memory that is used up and a device that is lost are raised. What it finds is on the host.

    Attributes:
        name: of the system.
        reason: why it failed, in one line; "" while it works.
    """

    def __init__(self, detector: Any, name: str = "") -> None:
        self.detector, self.name, self.reason = detector, name, ""

    @property
    def task(self) -> str:
        """That of the detector."""
        return str(getattr(self.detector, "task", "3d"))

    @property
    def classes(self) -> tuple[str, ...]:
        """Those of the detector."""
        return tuple(self.detector.classes)

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
                self.failed(error)
        nothing, whole = torch.zeros(0), torch.zeros(0, dtype=torch.int64)
        solid = None
        if self.task != "2d":
            solid = Solids(nothing.reshape(0, 3), nothing.reshape(0, 3), nothing, nothing.reshape(0, 2), whole)
        return [Detections(nothing, whole, nothing.reshape(0, 4), solid)] * len(images)

    def failed(self, error: Exception) -> None:
        """Takes note of what the detector raised; raises it if memory is used up or the device is lost."""
        if isinstance(error, MemoryError | torch.OutOfMemoryError) or "CUDA error" in str(error):
            raise error
        text = " ".join(str(error).split())
        self.reason = text if isinstance(error, SSADError) else f"{type(error).__name__}: {text}"[:300]

    def _broken(self, found: Sequence[Detections], images: int) -> str:
        if len(found) != images:
            return "broken promise: predict answers for each image"
        for one in found:
            for kept, promise in promises(one, classes=len(self.detector.classes), three=self.task != "2d"):
                if not kept:
                    return f"broken promise: {promise}"
        return ""


@lru_cache(maxsize=8)
def _loaded(name: str, weights: str, device: str, threads: int) -> Any:
    quiet_warp()  # it runs the shifts
    torch.set_num_threads(threads)
    if device == "cpu":
        keep_memory()
    return detector_of(name, weights, device)


def system_of(examination: Examination, name: str) -> Any:
    """A system of a run by name: a detector, or one behind a defence; a detector is loaded once.

    Args:
        examination: of the run.
        name: of the system.
    """
    bare, defence = examination.defended.get(name, (name, None))
    weights = dict(examination.detectors)[bare]
    detector = _loaded(bare, weights, examination.device, examination.threads)
    return detector if defence is None else Defended(detector, defence)


def shifter_of(examination: Examination, data: NuScenes, scene: ShiftedScene) -> SceneShifter | None:
    """The scene through its shift; None for the clean one."""
    if scene.shift is None:
        return None
    drawn = scene.severity == "random"
    severity = 1 if drawn else int(scene.severity)
    spec = ShiftSpec(scene.shift, severity, seed=examination.seed, calibration=examination.calibration)
    return SceneShifter(examination.root, data.scene(scene.scene), spec, random=drawn)


def find_boxes(examination: Examination, scene: Condition, detectors: Sequence[str]) -> None:
    """Writes the boxes that detectors find in a scene, unless they are there.

    A detector that raises, or breaks a promise, leaves the reason in place of its boxes. Memory that is used up, and a
    device that is lost, raise.

    Raises:
        SSADError: the data are broken.
    """
    folder = examination.folder
    names = [name for name in detectors if not boxes_path(folder, name, scene).is_file()]
    if not names:
        return
    with NuScenes(examination.root, examination.version) as data:
        watched = [Watched(system_of(examination, name), name) for name in names]
        shown = scene.shown(examination, data, watched)
        eyes: list[Any] = list(watched)
        found = detect_with(
            eyes,
            examination.root,
            data.scene(scene.scene),
            device=examination.device,
            look=shown.look,
            ahead=shown.ahead,
            at_once=shown.at_once,
        )
    for name, samples, one in zip(names, found, watched, strict=True):
        _write(boxes_path(folder, name, scene), samples, one.reason, shown.notes(), flat=one.task == "2d")
    shown.done()


def _write(path: Path, samples: Sequence[Any], reason: str, notes: Mapping[str, Any], *, flat: bool) -> None:
    columns: dict[str, Any] = {"failed": np.array(reason)} if reason else {}
    if not reason:
        boxes = [sample.boxes for sample in samples]
        columns["sample"] = np.array([sample.token for sample in samples])
        columns["count"] = np.array([len(b) for b in boxes], np.int32)
        for name in _FLAT if flat else ():
            columns[name] = np.concatenate([getattr(one, name) for one in boxes])
        for name, parts in () if flat else zip(_COLUMNS, zip(*map(_to_columns, boxes), strict=True), strict=True):
            columns[name] = np.concatenate(parts)
        columns["applied"] = np.array(safeio.dump_json(dict(sorted(notes.items()))))
    file = io.BytesIO()
    np.savez_compressed(file, **columns)
    safeio.write_atomic(path, file.getvalue())


def _to_columns(boxes: DetectedBoxes) -> tuple[Any, ...]:
    """What a file holds of the boxes of a sample."""
    names = np.array(boxes.attribute, "U40")
    return boxes.centre, boxes.size_wlh, boxes.rotation, boxes.velocity, boxes.score, boxes.label, names


def _from_columns(translation: Any, size_wlh: Any, *others: Any) -> DetectedBoxes:
    """The boxes of a sample from a file's columns."""
    rotation, velocity, score, label, names = others
    size_lwh = size_wlh[:, size_columns("wlh", "lwh")]
    return DetectedBoxes(translation, size_lwh, rotation, velocity, score, label, tuple(map(str, names)))


class DetectorFailed(SSADError):
    """A detector failed on a scene; why."""


def read_boxes(path: Path) -> tuple[list[Any], dict[str, Any]]:
    """Boxes by sample (`SampleBoxes`, or `SamplePictures` of a 2D detector), and what the condition noted.

    Raises:
        DetectorFailed: it has a reason instead.
        FormatError: a broken file.
    """
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            if "failed" in file:
                raise DetectorFailed(str(file["failed"]))
            ends = np.cumsum(file["count"])
            flat = "camera" in file
            parts = [np.split(file[c], ends[:-1]) for c in (_FLAT if flat else _COLUMNS)]
            tokens = [str(token) for token in file["sample"]]
            notes = safeio.parse_json(str(file["applied"]))
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FormatError(f"{path}: broken ({type(error).__name__}); remove it and run again") from None
    found: list[Any] = []
    for k, token in enumerate(tokens):
        own = [part[k] for part in parts]
        found.append(SamplePictures(token, PictureBoxes(*own)) if flat else SampleBoxes(token, _from_columns(*own)))
    return found, {str(k): v for k, v in notes.items()}


def forget_failures(paths: Sequence[Path]) -> None:
    """Remove the files that record a detector's failure, so that they are made anew.

    Raises:
        FormatError: A file is broken.
    """
    for path in paths:
        if path.is_file():
            try:
                read_boxes(path)
            except DetectorFailed:
                path.unlink()


@lru_cache(maxsize=2)
def _truth(root: Path, version: str, scenes: tuple[str, ...]) -> GroundTruth:
    return read_truth(root, version, scenes=frozenset(scenes))


Sum = Callable[[Sequence[Mapping[str, Any]]], Mapping[str, Any]]


def sum_applied(notes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How often a shift was applied, over all scenes."""
    applied: Counter[str] = Counter()
    for one in notes:
        applied.update({name: int(count) for name, count in one.items()})
    return {"applied": dict(sorted(applied.items()))}


def score_scenes(
    examination: Examination, detector: str, scenes: Sequence[Condition], *, replicates: int, notes: Sum = sum_applied
) -> dict[str, Any]:
    """Metrics of a detector over scenes whose boxes are there, for a record.

    Args:
        examination: of the run.
        detector: name.
        scenes: each under its condition.
        replicates: of the bootstrap over scenes; the draws are the same for every detector and condition, so that
            differences are paired. Scenes of equal truth are copies: they are drawn, and count, together.
        notes: makes a record's columns of what the conditions noted.

    Returns:
        metrics, intervals (95 %, see `replicate_estimate`), replicates, n (samples of different scenes), scenes, and
        the columns of the notes.

    Raises:
        DetectorFailed: it failed on a scene.
    """
    found, noted = read_scenes(examination, detector, scenes)
    truth = truth_of(examination, [one.scene for one in scenes])
    return {**score_found(examination, found, truth, replicates=replicates), **notes(noted)}


def truth_of(examination: Examination, scenes: Sequence[str]) -> GroundTruth:
    """The ground truth of some scenes."""
    return _truth(examination.root, examination.version, tuple(scenes))


def read_scenes(
    examination: Examination, detector: str, scenes: Sequence[Condition]
) -> tuple[list[Any], list[dict[str, Any]]]:
    """Boxes of a system in scenes, and what was noted in each.

    Args:
        examination: of the run.
        detector: name of the system.
        scenes: each under its condition.

    Raises:
        DetectorFailed: it failed on a scene.
    """
    found: list[Any] = []
    noted = []
    for one in scenes:
        try:
            boxes, own = read_boxes(boxes_path(examination.folder, detector, one))
        except DetectorFailed as error:
            raise DetectorFailed(f"{one.scene}: {error}") from None
        found += boxes
        noted.append(own)
    return found, noted


def score_found(
    examination: Examination, found: Sequence[SampleBoxes], truth: GroundTruth, *, replicates: int
) -> dict[str, Any]:
    """As `score_scenes`, of boxes that are at hand.

    Args:
        examination: of the run.
        found: boxes of all samples.
        truth: of the same samples.
        replicates: of the bootstrap over scenes.
    """
    matches = match_boxes(found, truth)
    figures = lambda weights, few: numbers(matches.scores(weights), few=few)  # noqa: E731
    return _resampled(examination, figures, truth, replicates)


def score_pictures(
    examination: Examination, detector: Any, found: Sequence[SamplePictures], truth: GroundTruth, *, replicates: int
) -> dict[str, Any]:
    """As `score_found`, of a 2D detector's boxes in the images.

    Args:
        examination: of the run.
        detector: which found them.
        found: boxes of all samples.
        truth: of the same samples; it says which scenes are copies.
        replicates: of the bootstrap over scenes.
    """
    matches = match_pictures(found, picture_truth_of(examination, truth), detector.classes)
    figures = lambda weights, few: picture_figures(matches.scores(weights), few=few)  # noqa: E731
    return _resampled(examination, figures, truth, replicates)


def picture_truth_of(examination: Examination, truth: GroundTruth) -> PictureTruth:
    """The true boxes in the images of the samples of a truth."""
    return read_picture_truth(examination.root, examination.version, truth.scenes, truth.samples)


Figures = Callable[[Any, bool], dict[str, float]]
"""From weights of the samples (None: each once), and whether a few are enough, to figures by name."""


def _resampled(examination: Examination, figures: Figures, truth: GroundTruth, replicates: int) -> dict[str, Any]:
    """Figures, and their intervals by the bootstrap over scenes."""
    case = distinct_scenes(truth)
    count = int(case.max()) + 1
    draws: list[dict[str, float]] = []
    if count > 1:
        chance = generator("detection suite", examination.seed, count)  # the same draws for every cell
        for draw in chance.multinomial(count, np.full(count, 1.0 / count), size=replicates):
            draws.append(figures(draw[case[truth.scene]], True))
    common = [name for name in (draws[0] if draws else {}) if all(name in draw for draw in draws)]
    values = {name: [round(d[name], 5) for d in draws] for name in common}
    first = np.unique(case, return_index=True)[1]
    samples = int(np.isin(truth.scene, first).sum())
    metrics = figures(None, False)
    limits = {k: replicate_estimate(metrics[k], v, n=samples, clusters=count) for k, v in values.items()}
    return {
        "metrics": metrics,
        "intervals": {k: [round(e.low, 5), round(e.high, 5)] for k, e in limits.items() if np.isfinite(e.low)},
        "replicates": values,
        "n": samples,
        "scenes": count,
    }


def distinct_scenes(truth: GroundTruth) -> Any:
    """Which scenes are copies of one drive: those whose true boxes are equal, sample by sample.

    Args:
        truth: True boxes of all scenes.

    Returns:
        Number of the drive that each scene shows [scenes].
    """
    names: dict[str, int] = {}
    found = []
    boxes = truth.boxes
    for scene in range(len(truth.scenes)):
        samples = np.flatnonzero(truth.scene == scene)
        rows = np.flatnonzero(np.isin(boxes.sample, samples))
        values = [boxes.sample[rows] - (samples[0] if len(samples) else 0), boxes.label[rows], boxes.centre[rows]]
        values += [boxes.size_lwh[rows], boxes.rotation[rows]]
        text = digest(len(samples), *[np.ascontiguousarray(v).tobytes().hex() for v in values])
        found.append(names.setdefault(text if len(rows) else f"empty {scene}", len(names)))
    return np.array(found)

"""Detections in one scene under one condition, stored as files: the work that cells of a suite share.

A condition is the treatment of the images: none, a shift, or a digital attack.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ssad.core import safeio
from ssad.core.boxes import size_columns
from ssad.core.errors import FormatError, SSADError
from ssad.core.machine import retain_freed_memory, start_warp_quietly
from ssad.core.seeding import digest, file_name, generator
from ssad.core.types import U8
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.datasets.nuscenes.truth import GroundTruth, read_truth
from ssad.detectors import cached_detector, make_detector
from ssad.detectors.image_scores import (
    ImageBoxes,
    ImageTruth,
    SampleImages,
    image_figures,
    match_images,
    read_image_truth,
)
from ssad.detectors.monitored import MonitoredDetector
from ssad.detectors.mono3d.multi_camera import DetectedBoxes
from ssad.detectors.on_scenes import AT_ONCE, SampleBoxes, detect_with, match_boxes, score_figures
from ssad.metrics.uncertainty import replicate_estimate
from ssad.scenarios.static.digital.defences import Defence, Defended
from ssad.scenarios.static.perturbation import ImageLoader, Perturbation, PerturbedScene, RecordedScene

FOLDER = "detections"
CAMERAS = 6  # of a sample, as nuScenes has them
_FLAT = ("camera", "box", "score", "label")  # of 2D detectors
_COLUMNS = ("translation", "size", "rotation", "velocity", "score", "label", "attribute")  # as nuScenes has them


@dataclass(frozen=True, slots=True)
class Examination:
    """Settings shared by all scenes of a run.

    Attributes:
        folder: of the results.
        root, version: of the data set.
        detectors: name -> weights ("" for the shipped ones).
        seed: of the random numbers.
        device: device of detectors, shifts and attacks.
        threads: of linear algebra.
        defended: systems that are a detector behind a defence: name -> the detector's name and the defence. All
            other systems are detectors.
    """

    folder: Path
    root: Path
    version: str
    detectors: tuple[tuple[str, str], ...]
    seed: int
    device: str
    threads: int
    defended: Mapping[str, tuple[str, Defence]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SceneCondition:
    """One scene under one perturbation.

    Attributes:
        scene: Name of the scene.
        perturbation: The perturbation; None: the clean scene.
        source: Name of the attacked system; "": the perturbation attacks none.
        batch: Camera images that may be computed at once on a GPU.
    """

    scene: str
    perturbation: Perturbation | None = None
    source: str = ""
    batch: int = 12

    @property
    def name(self) -> str:
        """Place of its boxes below the folder of a detector: CONDITION/SCENE."""
        condition = "clean" if self.perturbation is None else self.perturbation.folder
        return f"{condition}{f'@{file_name(self.source)}' if self.source else ''}/{self.scene}"

    def present(
        self, examination: Examination, data: NuScenes, detectors: Sequence[MonitoredDetector]
    ) -> PerturbedScene:
        """Return the scene as these detectors receive it: all of them the same images.

        A failure of the attacked system is recorded, with its reason, as one of all systems that need the images.
        """
        if self.perturbation is None:
            return PerturbedScene()
        victim = None
        if self.source:
            victim = next((detector for detector in detectors if detector.name == self.source), None)
            victim = victim or MonitoredDetector(system_of(examination, self.source), self.source)
        presentation = self.perturbation.on_scene(recorded_scene(examination, data, self), victim)
        if victim is not None and presentation.load_images is not None:
            presentation.load_images = _share_failures(presentation.load_images, victim, detectors)
        return presentation


def recorded_scene(examination: Examination, data: NuScenes, condition: SceneCondition) -> RecordedScene:
    """Return the recorded scene of a condition."""
    return RecordedScene(
        examination.root,
        examination.version,
        data.scene(condition.scene),
        examination.seed,
        examination.device,
        condition.batch,
        # Only on a CPU does an image take so long that a stopped run should keep it.
        examination.folder if examination.device == "cpu" else None,
        examination.detectors,
    )


def _share_failures(
    perturb_images: ImageLoader, victim: MonitoredDetector, detectors: Sequence[MonitoredDetector]
) -> ImageLoader:
    """Return a function of images after which a failure of the victim is one of all detectors."""

    def look_and_pass(frames: Sequence[SensorFrame]) -> Sequence[U8]:
        images = perturb_images(frames)
        for detector in detectors:
            if victim.reason and detector is not victim and not detector.reason:
                detector.reason = f"the attack on {victim.name} failed: {victim.reason}"
        return images

    return look_and_pass


def detector_of(name: str, weights: str, device: str) -> Any:
    """Return a detector by name (a part after @ is a label of the suite's own) and weights."""
    return make_detector(name, weights=weights or None, device=device)


def boxes_path(folder: Path, detector: str, scene: SceneCondition) -> Path:
    """Return the path of the boxes of a detector: detections/DETECTOR/CONDITION/SCENE.npz."""
    return folder / FOLDER / file_name(detector) / f"{scene.name}.npz"


def system_of(examination: Examination, name: str) -> Any:
    """Return a system of a run by name: a detector, or one behind a defence; a detector is loaded once.

    Args:
        examination: of the run.
        name: of the system.
    """
    detector_name, defence = examination.defended.get(name, (name, None))
    weights = dict(examination.detectors)[detector_name]
    start_warp_quietly()  # it runs the shifts
    torch.set_num_threads(examination.threads)
    if examination.device == "cpu":
        retain_freed_memory()
    detector = cached_detector(detector_name, weights=weights or None, device=examination.device)
    return detector if defence is None else Defended(detector, defence)


def samples_at_once(presentation: PerturbedScene) -> int:
    """Return the samples to ask a scene for together: enough to fill a batch, of one sample's cameras or of several."""
    return max(AT_ONCE, math.ceil(presentation.images_at_once / CAMERAS))


def find_boxes(examination: Examination, scene: SceneCondition, detectors: Sequence[str]) -> None:
    """Write the boxes that detectors find in a scene, unless the files exist.

    The file of a detector that fails, or breaks a promise, contains the reason instead of boxes. Exhausted memory
    and a lost device are raised.

    Raises:
        SSADError: the data are broken.
    """
    folder = examination.folder
    missing_names = [name for name in detectors if not boxes_path(folder, name, scene).is_file()]
    if not missing_names:
        return
    with NuScenes(examination.root, examination.version) as dataset:
        monitored = [MonitoredDetector(system_of(examination, name), name) for name in missing_names]
        presentation = scene.present(examination, dataset, monitored)
        detector_objects: list[Any] = list(monitored)
        boxes_by_detector = detect_with(
            detector_objects,
            examination.root,
            dataset.scene(scene.scene),
            device=examination.device,
            load_images=presentation.load_images,
            ahead=presentation.ahead,
            at_once=samples_at_once(presentation),
        )
    for name, samples, monitored_detector in zip(missing_names, boxes_by_detector, monitored, strict=True):
        _write_boxes(
            boxes_path(folder, name, scene),
            samples,
            monitored_detector.reason,
            presentation.notes(),
            is_2d=monitored_detector.task == "2d",
        )
    presentation.done()


def _write_boxes(path: Path, samples: Sequence[Any], reason: str, notes: Mapping[str, Any], *, is_2d: bool) -> None:
    columns: dict[str, Any] = {"failed": np.array(reason)} if reason else {}
    if not reason:
        boxes = [sample.boxes for sample in samples]
        columns["sample"] = np.array([sample.token for sample in samples])
        columns["count"] = np.array([len(sample_boxes) for sample_boxes in boxes], np.int32)
        for name in _FLAT if is_2d else ():
            columns[name] = np.concatenate([getattr(boxes_2d, name) for boxes_2d in boxes])
        for name, column_parts in (
            () if is_2d else zip(_COLUMNS, zip(*map(_to_columns, boxes), strict=True), strict=True)
        ):
            columns[name] = np.concatenate(column_parts)
        columns["applied"] = np.array(safeio.dump_json(dict(sorted(notes.items()))))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **columns)
    safeio.write_atomic(path, buffer.getvalue())


def _to_columns(boxes: DetectedBoxes) -> tuple[Any, ...]:
    """Return the columns of a file for the boxes of a sample."""
    attribute_names = np.array(boxes.attribute, "U40")
    return boxes.centre, boxes.size_wlh, boxes.rotation, boxes.velocity, boxes.score, boxes.label, attribute_names


def _from_columns(translation: Any, size_wlh: Any, *columns: Any) -> DetectedBoxes:
    """Return the boxes of a sample from a file's columns."""
    rotation, velocity, score, label, attribute_names = columns
    size_lwh = size_wlh[:, size_columns("wlh", "lwh")]
    return DetectedBoxes(translation, size_lwh, rotation, velocity, score, label, tuple(map(str, attribute_names)))


class DetectorFailed(SSADError):
    """Failure of a detector on a scene, with its reason."""


def read_boxes(path: Path) -> tuple[list[Any], dict[str, Any]]:
    """Read boxes by sample (`SampleBoxes`, or `SampleImages` of a 2D detector), and the notes of the condition.

    Raises:
        DetectorFailed: the file holds a reason instead.
        FormatError: the file is broken.
    """
    try:
        with open(path, "rb") as raw_file, np.load(raw_file, allow_pickle=False) as archive:
            if "failed" in archive:
                raise DetectorFailed(str(archive["failed"]))
            sample_ends = np.cumsum(archive["count"])
            is_2d = "camera" in archive
            sample_parts = [np.split(archive[column], sample_ends[:-1]) for column in (_FLAT if is_2d else _COLUMNS)]
            tokens = [str(token) for token in archive["sample"]]
            notes = safeio.parse_json(str(archive["applied"]))
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FormatError(f"{path}: broken ({type(error).__name__}); remove it and run again") from None
    samples: list[Any] = []
    for sample_number, token in enumerate(tokens):
        sample_columns = [column_parts[sample_number] for column_parts in sample_parts]
        samples.append(
            SampleImages(token, ImageBoxes(*sample_columns))
            if is_2d
            else SampleBoxes(token, _from_columns(*sample_columns))
        )
    return samples, {str(sample_number): note for sample_number, note in notes.items()}


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
    """Count over all scenes how often a shift was applied."""
    applied_counts: Counter[str] = Counter()
    for scene_notes in notes:
        applied_counts.update({name: int(count) for name, count in scene_notes.items()})
    return {"applied": dict(sorted(applied_counts.items()))}


def score_scenes(
    examination: Examination,
    detector: str,
    scenes: Sequence[SceneCondition],
    *,
    replicates: int,
    notes: Sum = sum_applied,
) -> dict[str, Any]:
    """Return the metrics of a detector over scenes whose boxes exist, for a record.

    Args:
        examination: of the run.
        detector: name.
        scenes: each under its condition.
        replicates: of the bootstrap over scenes; the draws are the same for every detector and condition, so that
            differences are paired. Scenes of equal truth are copies: they are drawn, and count, together.
        notes: makes a record's columns from the notes of the conditions.

    Returns:
        metrics, intervals (95 %, see `replicate_estimate`), replicates, n (samples of different scenes), scenes,
        and the columns of the notes.

    Raises:
        DetectorFailed: it failed on a scene.
    """
    boxes, scene_notes = read_scenes(examination, detector, scenes)
    truth = truth_of(examination, [condition.scene for condition in scenes])
    return {**score_boxes(examination, detector, boxes, truth, replicates=replicates), **notes(scene_notes)}


def truth_of(examination: Examination, scenes: Sequence[str]) -> GroundTruth:
    """Return the ground truth of some scenes."""
    return _truth(examination.root, examination.version, tuple(scenes))


def read_scenes(
    examination: Examination, detector: str, scenes: Sequence[SceneCondition]
) -> tuple[list[Any], list[dict[str, Any]]]:
    """Read the boxes of a system in scenes, and the notes of each.

    Args:
        examination: of the run.
        detector: name of the system.
        scenes: each under its condition.

    Raises:
        DetectorFailed: it failed on a scene.
    """
    all_boxes: list[Any] = []
    scene_notes = []
    for condition in scenes:
        try:
            boxes, condition_notes = read_boxes(boxes_path(examination.folder, detector, condition))
        except DetectorFailed as error:
            raise DetectorFailed(f"{condition.scene}: {error}") from None
        all_boxes += boxes
        scene_notes.append(condition_notes)
    return all_boxes, scene_notes


def score_boxes(
    examination: Examination, detector: str, boxes_by_sample: Sequence[Any], truth: GroundTruth, *, replicates: int
) -> dict[str, Any]:
    """As `score_scenes`, of boxes that are at hand: in the world, or of a 2D detector in the images.

    Args:
        examination: of the run.
        detector: name.
        boxes_by_sample: boxes of all samples.
        truth: of the same samples; it says which scenes are copies.
        replicates: of the bootstrap over scenes.
    """
    if isinstance(boxes_by_sample[0], SampleImages):
        classes = system_of(examination, detector).classes
        pictures = match_images(boxes_by_sample, picture_truth_of(examination, truth), classes)
        figures = lambda weights, summary_only: image_figures(pictures.scores(weights), is_summary=summary_only)  # noqa: E731
    else:
        matches = match_boxes(boxes_by_sample, truth)
        figures = lambda weights, summary_only: score_figures(matches.scores(weights), summary_only=summary_only)  # noqa: E731
    return _add_intervals(examination, figures, truth, replicates)


def picture_truth_of(examination: Examination, truth: GroundTruth) -> ImageTruth:
    """Return the true boxes in the images of the samples of a truth."""
    return read_image_truth(examination.root, examination.version, truth.scenes, truth.samples)


Figures = Callable[[Any, bool], dict[str, float]]
"""From weights of the samples (None: each once), and whether a few are enough, to figures by name."""


def _add_intervals(examination: Examination, figures: Figures, truth: GroundTruth, replicates: int) -> dict[str, Any]:
    """Return figures, and their intervals by the bootstrap over scenes."""
    drive_of_scene = distinct_scenes(truth)
    drive_count = int(drive_of_scene.max()) + 1
    replicate_figures: list[dict[str, float]] = []
    if drive_count > 1:
        rng = generator("detection suite", examination.seed, drive_count)  # the same draws for every cell
        for multiplicities in rng.multinomial(drive_count, np.full(drive_count, 1.0 / drive_count), size=replicates):
            replicate_figures.append(figures(multiplicities[drive_of_scene[truth.scene]], True))
    # A draw without any object of a class has no AP for it.
    common_names = [
        name
        for name in (replicate_figures[0] if replicate_figures else {})
        if all(name in multiplicities for multiplicities in replicate_figures)
    ]
    values = {name: [round(replicate[name], 5) for replicate in replicate_figures] for name in common_names}
    first_scenes = np.unique(drive_of_scene, return_index=True)[1]
    samples = int(np.isin(truth.scene, first_scenes).sum())
    metrics = figures(None, False)
    estimates = {
        figure_name: replicate_estimate(metrics[figure_name], replicate_values, n=samples, clusters=drive_count)
        for figure_name, replicate_values in values.items()
    }
    return {
        "metrics": metrics,
        "intervals": {
            figure_name: [round(estimate.low, 5), round(estimate.high, 5)]
            for figure_name, estimate in estimates.items()
            if np.isfinite(estimate.low)
        },
        "replicates": values,
        "n": samples,
        "scenes": drive_count,
    }


def distinct_scenes(truth: GroundTruth) -> Any:
    """Find scenes that are copies of one drive: those whose true boxes are equal, sample by sample.

    Args:
        truth: True boxes of all scenes.

    Returns:
        Number of the drive of each scene [scenes].
    """
    numbers_by_digest: dict[str, int] = {}
    drive_numbers = []
    boxes = truth.boxes
    for scene in range(len(truth.scenes)):
        samples = np.flatnonzero(truth.scene == scene)
        rows = np.flatnonzero(np.isin(boxes.sample, samples))
        compared_arrays = [
            boxes.sample[rows] - (samples[0] if len(samples) else 0),
            boxes.label[rows],
            boxes.centre[rows],
        ]
        compared_arrays += [boxes.size_lwh[rows], boxes.rotation[rows]]
        content_digest = digest(
            len(samples), *[np.ascontiguousarray(array).tobytes().hex() for array in compared_arrays]
        )
        # Scenes without boxes look alike but need not be copies.
        drive_numbers.append(
            numbers_by_digest.setdefault(content_digest if len(rows) else f"empty {scene}", len(numbers_by_digest))
        )
    return np.array(drive_numbers)

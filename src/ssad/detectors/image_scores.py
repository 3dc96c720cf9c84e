"""2D detectors on data sets in the nuScenes schema: the boxes of each camera image, and AP50 over all images.

The truth is the hull of each object's 3D box in the image (`camera_truth`). Classes are matched by their names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ssad.core.detections import Detections
from ssad.core.nuscenes_names import CLASSES, MMDET3D_CLASSES
from ssad.core.types import F64, I32
from ssad.datasets.nuscenes.camera_truth import camera_truth
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SensorFrame
from ssad.metrics.detection2d import Boxes2D, Matched2D, match_2d
from ssad.metrics.detection_boxes import I64

CAMERAS = 64  # of a sample, at most: the number of an image is that of its sample times this, and its camera


@dataclass(frozen=True, slots=True)
class ImageBoxes:
    """Detections of a 2D detector in the images of one sample, a row per box.

    Attributes:
        camera: Place of the image among the camera frames of the sample [N].
        box: x1, y1, x2, y2 in pixels [N, 4].
        score: [N].
        label: Index into `MMDET3D_CLASSES` [N].
    """

    camera: I32
    box: F64
    score: F64
    label: I32

    def __len__(self) -> int:
        return len(self.score)


@dataclass(frozen=True, slots=True)
class SampleImages:
    """Detections in the images of one sample."""

    token: str
    boxes: ImageBoxes


@dataclass(frozen=True, slots=True)
class ImageTruth:
    """The true boxes of all camera images of some samples.

    Attributes:
        samples: Tokens [S].
        boxes: Their labels are indices into `MMDET3D_CLASSES`.
    """

    samples: tuple[str, ...]
    boxes: Boxes2D


@dataclass(frozen=True, slots=True)
class ImageScores:
    """AP50 of each of nuScenes's ten classes, in the order of `MMDET3D_CLASSES`; NaN for absent classes."""

    ap: F64

    @property
    def mean_ap(self) -> float:
        """Mean over the classes that are present; 0 without any."""
        return float(np.nanmean(self.ap)) if np.isfinite(self.ap).any() else 0.0


@dataclass(frozen=True, slots=True)
class ImageMatches:
    """Matches of boxes, sufficient for the scores under any weights of the samples.

    Attributes:
        matched: Detections from best to worst.
        sample: The sample of each.
        truth_counts: True boxes by class and sample [C, S].
    """

    matched: Matched2D
    sample: I64
    truth_counts: I64

    @property
    def samples(self) -> int:
        """Number of samples."""
        return int(self.truth_counts.shape[1])

    def scores(self, weights: npt.NDArray[np.integer[Any]] | None = None) -> ImageScores:
        """Return the scores, with each sample counted as often as its weight [S]; None: once."""
        repetitions = np.ones(self.samples, np.int64) if weights is None else np.asarray(weights, np.int64)
        # Repeating rows keeps their order, so the bootstrap needs no further matching.
        rows = np.repeat(np.arange(len(self.sample)), repetitions[self.sample])
        matches = self.matched
        resampled = Matched2D(
            matches.label[rows], matches.hit[rows], matches.ignored[rows], self.truth_counts @ repetitions
        )
        return ImageScores(resampled.average_precision())


def gather_images(
    samples: Sequence[Any],
    frames_by_sample: Mapping[str, Sequence[SensorFrame]],
    detections: Sequence[Detections],
    classes: Sequence[str],
) -> list[SampleImages]:
    """Group the boxes of images by sample, without those of classes that nuScenes does not have.

    Args:
        samples: Samples, in order.
        frames_by_sample: Camera frames of each sample.
        detections: Detections in all images, in order.
        classes: Names of the labels.
    """
    label_table = np.array(
        [MMDET3D_CLASSES.index(name) if name in MMDET3D_CLASSES else -1 for name in classes], np.int32
    )
    sample_pictures, start = [], 0
    for sample in samples:
        count = len(frames_by_sample.get(sample.token, []))
        sample_detections = detections[start : start + count]
        start += count
        camera_indices = np.repeat(np.arange(count), [len(single.score) for single in sample_detections]).astype(
            np.int32
        )
        labels = label_table[_join_columns([single.label for single in sample_detections]).astype(np.int64)]
        is_known = labels >= 0
        box, score = (
            _join_columns([single.box for single in sample_detections], 4),
            _join_columns([single.score for single in sample_detections]),
        )
        sample_pictures.append(
            SampleImages(
                sample.token, ImageBoxes(camera_indices[is_known], box[is_known], score[is_known], labels[is_known])
            )
        )
    return sample_pictures


def _join_columns(values: Sequence[torch.Tensor], width: int | None = None) -> F64:
    empty = np.zeros((0,) if width is None else (0, width))
    return np.concatenate([empty, *(tensor.detach().cpu().double().numpy() for tensor in values)])


@lru_cache(maxsize=2)
def read_image_truth(root: Path, version: str, scenes: tuple[str, ...], samples: tuple[str, ...]) -> ImageTruth:
    """Read the true boxes of all camera images.

    Args:
        root: Root of the data set.
        version: Version of the data set.
        scenes: Names.
        samples: Tokens of all samples of these scenes, in the order of their numbers.
    """
    sample_index = {token: index for index, token in enumerate(samples)}
    image_numbers: list[int] = []
    labels, boxes = [np.zeros(0, np.int64)], [np.zeros((0, 4))]
    frame_counts = dict.fromkeys(samples, 0)
    with NuScenes(root, version) as dataset:
        for name in scenes:
            scene = dataset.scene(name)
            for frame in scene.frames:
                if frame.modality != "camera" or not frame.key_frame:
                    continue
                truth = camera_truth(frame, scene.annotations(frame.sample_token))
                image_number = sample_index[frame.sample_token] * CAMERAS + frame_counts[frame.sample_token]
                frame_counts[frame.sample_token] += 1
                image_numbers += [image_number] * len(truth.label)
                labels.append(truth.label.numpy())
                boxes.append(truth.box.double().numpy())
    return ImageTruth(
        samples,
        Boxes2D(np.array(image_numbers, np.int32), np.concatenate(labels).astype(np.int32), np.concatenate(boxes)),
    )


def match_images(detections: Sequence[SampleImages], truth: ImageTruth, classes: Sequence[str]) -> ImageMatches:
    """Match boxes with an IoU of at least 0.5.

    Args:
        detections: Boxes of all samples.
        truth: Truth of the same samples.
        classes: Names of the classes of the detector; objects of others are left out.
    """
    truth_boxes = truth.boxes
    is_known = np.isin(truth_boxes.label, [index for index, name in enumerate(MMDET3D_CLASSES) if name in classes])
    truth_boxes = Boxes2D(truth_boxes.image[is_known], truth_boxes.label[is_known], truth_boxes.box[is_known])
    sample_index = {token: index for index, token in enumerate(truth.samples)}
    known_samples = sorted(
        (sample_pictures for sample_pictures in detections if sample_pictures.token in sample_index),
        key=lambda sample_pictures: sample_index[sample_pictures.token],
    )
    boxes_by_sample = [sample_pictures.boxes for sample_pictures in known_samples]
    sample_numbers = np.repeat(
        [sample_index[sample_pictures.token] for sample_pictures in known_samples],
        [len(sample_boxes) for sample_boxes in boxes_by_sample],
    ).astype(np.int64)
    camera_indices = np.concatenate([np.zeros(0, np.int32), *(sample_boxes.camera for sample_boxes in boxes_by_sample)])
    detected_boxes = Boxes2D(
        (sample_numbers * CAMERAS + camera_indices).astype(np.int32),
        # The empty array lets concatenate work without any sample.
        np.concatenate([np.zeros(0, np.int32), *(sample_boxes.label for sample_boxes in boxes_by_sample)]).astype(
            np.int32
        ),
        np.concatenate([np.zeros((0, 4)), *(sample_boxes.box for sample_boxes in boxes_by_sample)]),
        np.concatenate([np.zeros(0), *(sample_boxes.score for sample_boxes in boxes_by_sample)]),
    )
    class_count, sample_count = len(MMDET3D_CLASSES), len(truth.samples)
    matched_rows = match_2d(truth_boxes, detected_boxes, labels=class_count)
    assert matched_rows.row is not None
    truth_counts = np.bincount(
        truth_boxes.label.astype(np.int64) * sample_count + truth_boxes.image // CAMERAS,
        minlength=class_count * sample_count,
    )
    return ImageMatches(matched_rows, sample_numbers[matched_rows.row], truth_counts.reshape(class_count, sample_count))


def image_figures(scores: ImageScores, *, is_summary: bool = False) -> dict[str, float]:
    """Return the figures of scores, named as for 3D detectors: mAP, and the AP of each class present.

    Args:
        scores: The scores.
        is_summary: Return only mAP and the AP of cars.
    """
    class_ap = {f"AP_{name}": float(scores.ap[MMDET3D_CLASSES.index(name)]) for name in CLASSES}
    figures = {"mAP": scores.mean_ap, "AP_car": class_ap["AP_car"]} | ({} if is_summary else class_ap)
    return {name: round(value, 6) for name, value in figures.items() if np.isfinite(value)}

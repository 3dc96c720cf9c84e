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
class PictureBoxes:
    """What a 2D detector found in the images of one sample, a row a box.

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
class SamplePictures:
    """What was found in the images of one sample."""

    token: str
    boxes: PictureBoxes


@dataclass(frozen=True, slots=True)
class PictureTruth:
    """The true boxes of all camera images of some samples.

    Attributes:
        samples: Tokens [S].
        boxes: Their labels are indices into `MMDET3D_CLASSES`.
    """

    samples: tuple[str, ...]
    boxes: Boxes2D


@dataclass(frozen=True, slots=True)
class PictureScores:
    """AP50 of each of nuScenes's ten classes, in the order of `MMDET3D_CLASSES`; NaN where there is no object."""

    ap: F64

    @property
    def mean_ap(self) -> float:
        """Mean over the classes that are there; 0 if none is."""
        return float(np.nanmean(self.ap)) if np.isfinite(self.ap).any() else 0.0


@dataclass(frozen=True, slots=True)
class PictureMatches:
    """Which boxes match; enough for the scores under any weights of the samples.

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
        """How many there are."""
        return int(self.truth_counts.shape[1])

    def scores(self, weights: npt.NDArray[np.integer[Any]] | None = None) -> PictureScores:
        """The scores, where each sample counts as often as its weight [S] says; None: once."""
        times = np.ones(self.samples, np.int64) if weights is None else np.asarray(weights, np.int64)
        rows = np.repeat(np.arange(len(self.sample)), times[self.sample])
        own = self.matched
        drawn = Matched2D(own.label[rows], own.hit[rows], own.ignored[rows], self.truth_counts @ times)
        return PictureScores(drawn.average_precision())


def gather_pictures(
    samples: Sequence[Any],
    by_sample: Mapping[str, Sequence[SensorFrame]],
    found: Sequence[Detections],
    classes: Sequence[str],
) -> list[SamplePictures]:
    """The boxes of images put together by sample; those of classes that nuScenes does not have are left out.

    Args:
        samples: In order.
        by_sample: Camera frames of each.
        found: Of all images, in order.
        classes: Names of the labels.
    """
    table = np.array([MMDET3D_CLASSES.index(name) if name in MMDET3D_CLASSES else -1 for name in classes], np.int32)
    result, start = [], 0
    for sample in samples:
        count = len(by_sample.get(sample.token, []))
        own = found[start : start + count]
        start += count
        camera = np.repeat(np.arange(count), [len(one.score) for one in own]).astype(np.int32)
        label = table[_joined([one.label for one in own]).astype(np.int64)]
        known = label >= 0
        box, score = _joined([one.box for one in own], 4), _joined([one.score for one in own])
        result.append(SamplePictures(sample.token, PictureBoxes(camera[known], box[known], score[known], label[known])))
    return result


def _joined(values: Sequence[torch.Tensor], width: int | None = None) -> F64:
    empty = np.zeros((0,) if width is None else (0, width))
    return np.concatenate([empty, *(one.detach().cpu().double().numpy() for one in values)])


@lru_cache(maxsize=2)
def read_picture_truth(root: Path, version: str, scenes: tuple[str, ...], samples: tuple[str, ...]) -> PictureTruth:
    """The true boxes of all camera images.

    Args:
        root: Of the data set.
        version: Of the data set.
        scenes: Names.
        samples: Tokens of all samples of these scenes, in the order in which they are numbered.
    """
    place = {token: k for k, token in enumerate(samples)}
    image: list[int] = []
    label, box = [np.zeros(0, np.int64)], [np.zeros((0, 4))]
    seen = dict.fromkeys(samples, 0)
    with NuScenes(root, version) as data:
        for name in scenes:
            scene = data.scene(name)
            for frame in scene.frames:
                if frame.modality != "camera" or not frame.key_frame:
                    continue
                truth = camera_truth(frame, scene.annotations(frame.sample_token))
                number = place[frame.sample_token] * CAMERAS + seen[frame.sample_token]
                seen[frame.sample_token] += 1
                image += [number] * len(truth.label)
                label.append(truth.label.numpy())
                box.append(truth.box.double().numpy())
    return PictureTruth(
        samples, Boxes2D(np.array(image, np.int32), np.concatenate(label).astype(np.int32), np.concatenate(box))
    )


def match_pictures(found: Sequence[SamplePictures], truth: PictureTruth, classes: Sequence[str]) -> PictureMatches:
    """Match boxes whose IoU is 0.5 at least.

    Args:
        found: Boxes of all samples.
        truth: Of the same samples.
        classes: Names of those that the detector knows; objects of others are left out.
    """
    real = truth.boxes
    known = np.isin(real.label, [k for k, name in enumerate(MMDET3D_CLASSES) if name in classes])
    real = Boxes2D(real.image[known], real.label[known], real.box[known])
    place = {token: k for k, token in enumerate(truth.samples)}
    own = sorted((one for one in found if one.token in place), key=lambda one: place[one.token])
    parts = [one.boxes for one in own]
    sample = np.repeat([place[one.token] for one in own], [len(part) for part in parts]).astype(np.int64)
    camera = np.concatenate([np.zeros(0, np.int32), *(part.camera for part in parts)])
    boxes = Boxes2D(
        (sample * CAMERAS + camera).astype(np.int32),
        np.concatenate([np.zeros(0, np.int32), *(part.label for part in parts)]).astype(np.int32),
        np.concatenate([np.zeros((0, 4)), *(part.box for part in parts)]),
        np.concatenate([np.zeros(0), *(part.score for part in parts)]),
    )
    count, many = len(MMDET3D_CLASSES), len(truth.samples)
    matched = match_2d(real, boxes, labels=count)
    assert matched.row is not None
    counts = np.bincount(real.label.astype(np.int64) * many + real.image // CAMERAS, minlength=count * many)
    return PictureMatches(matched, sample[matched.row], counts.reshape(count, many))


def picture_figures(scores: PictureScores, *, few: bool = False) -> dict[str, float]:
    """The figures of scores, by the names that those of 3D detectors have: mAP, and the AP of each class that is there.

    Args:
        scores: The scores.
        few: Whether only mAP and the AP of cars are wanted.
    """
    each = {f"AP_{name}": float(scores.ap[MMDET3D_CLASSES.index(name)]) for name in CLASSES}
    found = {"mAP": scores.mean_ap, "AP_car": each["AP_car"]} | ({} if few else each)
    return {name: round(value, 6) for name, value in found.items() if np.isfinite(value)}

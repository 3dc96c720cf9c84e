"""Quality of the detections in a single image, computed from boxes alone; ensembles of attacks compare it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ssad.core.detections import Detections, Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.types import F64
from ssad.metrics.detection2d import Boxes2D, Matched2D, match_2d
from ssad.metrics.detection_boxes import I64
from ssad.metrics.detection_match import assign
from ssad.scenarios.static.digital.objectives import Aim

IOU = 0.5
METRES = 2.0
MAX_DETECTIONS = 100  # best detections of a class that are looked at in 2D, as COCO does


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """Detection quality of one image.

    Attributes:
        value: Mean average precision over the classes present, in [0, 1]; in an image without objects 1 if nothing is
            detected, else 0.
        noise: Sum of the scores of false detections minus that of the correct ones. Among images of equal value, the
            one with more noise lowers the precision of a whole set more.
    """

    value: float
    noise: float

    @property
    def order(self) -> tuple[float, float]:
        """Sort key: the smallest is the worst for the detector."""
        return self.value, -self.noise


def image_quality(
    detections: Detections, truth: Truth, *, task: Literal["2d", "3d"] = "2d", classes: int | None = None
) -> ImageQuality:
    """Score the detections in one image.

    From the best score down, each takes the nearest object of its class that is still free: by overlap, an IoU of 0.5
    at least, for 2D; by distance in the ground plane, less than 2 m, for 3D. Objects marked as crowd count neither as
    found nor as missed, and detections on them neither as right nor as wrong.

    Args:
        detections: Detections in the image.
        truth: Ground truth of the image.
        task: "2d" or "3d".
        classes: Number of classes; None: those that occur.

    Returns:
        The quality.

    Raises:
        ConfigError: Truth or detections have no 3D boxes, for 3D.
    """
    rank = detections.score.argsort(descending=True, stable=True)
    score, label = _float_array(detections.score[rank]), _int_array(detections.label[rank])
    truth_label = _int_array(truth.label)
    crowd = np.zeros(len(truth_label), np.bool_) if truth.crowd is None else truth.crowd.cpu().numpy().astype(np.bool_)
    class_count = max([classes or 0, *(label + 1), *(truth_label + 1)])
    if task == "2d":
        matches = match_2d(
            Boxes2D(
                np.zeros(len(truth_label), np.int32),
                truth_label.astype(np.int32),
                _float_array(truth.box),
                ignore=crowd,
            ),
            Boxes2D(np.zeros(len(label), np.int32), label.astype(np.int32), _float_array(detections.box[rank]), score),
            labels=class_count,
            threshold=IOU,
            max_detections=MAX_DETECTIONS,
        )
        # `match_2d` orders equal scores by class, which sums do not depend on
        score = np.sort(_top_scores(score, label))[::-1]
    else:
        matches = _match_3d(
            _ground_places(detections.solid)[rank.cpu().numpy()],
            label,
            _ground_places(truth.solid),
            truth_label,
            crowd=crowd,
            classes=class_count,
        )
    precision = matches.average_precision()
    correct, wrong = matches.hit, ~matches.hit & ~matches.ignored
    # rounded, so that pictures of equal quality are equal to the last digit
    value = round(float(np.nanmean(precision)), 9) if matches.truth.any() else float(not wrong.any())
    return ImageQuality(value, float(score[wrong].sum() - score[correct].sum()))


def truth_of_aim(truth: Truth, aim: Aim, classes: Sequence[str]) -> Truth:
    """Return the truth with every object that is not under attack marked as crowd.

    Args:
        truth: Ground truth of an image.
        aim: Objects under attack.
        classes: Names of the labels.
    """
    if aim.attacks_all:
        return truth
    names = list(aim.becomes) if aim.becomes else aim.classes
    crowd = torch.zeros(len(truth.label), dtype=torch.bool) if truth.crowd is None else truth.crowd.clone().cpu()
    for index, label in enumerate(truth.label.tolist()):
        is_class_attacked = names is None or classes[label] in names
        crowd[index] |= not (is_class_attacked and (aim.objects is None or index in aim.objects))
    return replace(truth, crowd=crowd.to(truth.label.device))


def _top_scores(score: F64, label: I64) -> F64:
    """Return the scores of the best `MAX_DETECTIONS` detections of each class."""
    return np.concatenate(
        [score[:0], *(score[label == label_index][:MAX_DETECTIONS] for label_index in np.unique(label))]
    )


def _match_3d(
    places: F64, label: I64, object_places: F64, object_labels: I64, *, crowd: npt.NDArray[np.bool_], classes: int
) -> Matched2D:
    """Match detections at places [N, 2], best first, with objects at places [Q, 2]."""
    distance = np.sqrt(((places[:, None] - object_places[None]) ** 2).sum(-1))
    is_close = (distance < METRES) & (label[:, None] == object_labels[None])
    detection_index, object_index = np.nonzero(is_close & ~crowd[None])
    # Detections come best first, so the primary key is the detection, then the distance.
    order = np.lexsort((object_index, distance[detection_index, object_index], detection_index))
    ((matched, _),) = assign(
        detection_index[order],
        object_index[order],
        distance[detection_index, object_index][order],
        boxes=len(object_labels),
        thresholds=(np.inf,),
    )
    correct = np.zeros(len(places), np.bool_)
    correct[matched] = True
    ignored = (is_close & crowd[None]).any(1)
    return Matched2D(
        label.astype(np.int32), correct, ignored & ~correct, np.bincount(object_labels[~crowd], minlength=classes)
    )


def _ground_places(solid: Solids | None) -> F64:
    if solid is None:
        raise ConfigError("the quality of 3D detections needs 3D boxes in the truth and in the detections")
    return _float_array(solid.centre)[:, [0, 2]]


def _float_array(values: Tensor) -> F64:
    array: F64 = values.detach().double().cpu().numpy()
    return array


def _int_array(values: Tensor) -> I64:
    array: I64 = values.detach().long().cpu().numpy()
    return array

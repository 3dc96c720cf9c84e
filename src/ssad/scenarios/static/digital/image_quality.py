"""How much of one picture a detector still gets right: what an ensemble of attacks compares, from boxes alone."""

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
MOST = 100  # best detections of a class that are looked at in 2D, as COCO does


@dataclass(frozen=True, slots=True)
class Quality:
    """What is left of one picture.

    Attributes:
        value: in [0, 1], the mean over the classes that are there of their average precision; in a picture without
            objects 1 if nothing is found, else 0.
        noise: the sum of the scores of false detections less that of the right ones: of pictures of equal value, the
            one with more of it hurts the precision of a whole set more.
    """

    value: float
    noise: float

    @property
    def order(self) -> tuple[float, float]:
        """Least first is worst first."""
        return self.value, -self.noise


def image_quality(
    found: Detections, truth: Truth, *, task: Literal["2d", "3d"] = "2d", classes: int | None = None
) -> Quality:
    """Score the detections of one picture.

    From the best score down, each takes the nearest object of its class that is still free: by overlap, an IoU of 0.5
    at least, for 2D; by distance in the ground plane, less than 2 m, for 3D. Objects marked as crowd count neither as
    found nor as missed, and detections on them neither as right nor as wrong.

    Args:
        found: What was detected.
        truth: What is there.
        task: "2d" or "3d".
        classes: How many classes there are; None: those that occur.

    Returns:
        The quality.

    Raises:
        ConfigError: Truth or detections have no 3D boxes, for 3D.
    """
    rank = found.score.argsort(descending=True, stable=True)
    score, label = _array(found.score[rank]), _whole(found.label[rank])
    real = _whole(truth.label)
    crowd = np.zeros(len(real), np.bool_) if truth.crowd is None else truth.crowd.cpu().numpy().astype(np.bool_)
    many = max([classes or 0, *(label + 1), *(real + 1)])
    if task == "2d":
        matched = match_2d(
            Boxes2D(np.zeros(len(real), np.int32), real.astype(np.int32), _array(truth.box), ignore=crowd),
            Boxes2D(np.zeros(len(label), np.int32), label.astype(np.int32), _array(found.box[rank]), score),
            labels=many,
            threshold=IOU,
            max_detections=MOST,
        )
        # it orders equal scores by class; sums over all of a kind do not mind
        score = np.sort(_best(score, label))[::-1]
    else:
        matched = _match_3d(
            _plane(found.solid)[rank.cpu().numpy()], label, _plane(truth.solid), real, crowd=crowd, classes=many
        )
    precision = matched.average_precision()
    hit, wrong = matched.hit, ~matched.hit & ~matched.ignored
    # rounded, so that pictures of equal quality are equal to the last digit
    value = round(float(np.nanmean(precision)), 9) if matched.truth.any() else float(not wrong.any())
    return Quality(value, float(score[wrong].sum() - score[hit].sum()))


def of_aim(truth: Truth, aim: Aim, classes: Sequence[str]) -> Truth:
    """The truth with every object as crowd that is not under attack.

    Args:
        truth: What is in an image.
        aim: Which objects are attacked.
        classes: Names of the labels.
    """
    if aim.everything:
        return truth
    names = list(aim.becomes) if aim.becomes else aim.classes
    crowd = torch.zeros(len(truth.label), dtype=torch.bool) if truth.crowd is None else truth.crowd.clone().cpu()
    for k, label in enumerate(truth.label.tolist()):
        wanted = names is None or classes[label] in names
        crowd[k] |= not (wanted and (aim.objects is None or k in aim.objects))
    return replace(truth, crowd=crowd.to(truth.label.device))


def _best(score: F64, label: I64) -> F64:
    """Scores of the best detections of each class, as many as are looked at."""
    return np.concatenate([score[:0], *(score[label == one][:MOST] for one in np.unique(label))])


def _match_3d(
    found: F64, label: I64, centre: F64, real: I64, *, crowd: npt.NDArray[np.bool_], classes: int
) -> Matched2D:
    """Matches of detections at places [N, 2], best first, with objects at places [Q, 2]."""
    distance = np.sqrt(((found[:, None] - centre[None]) ** 2).sum(-1))
    near = (distance < METRES) & (label[:, None] == real[None])
    pred, box = np.nonzero(near & ~crowd[None])
    order = np.lexsort((box, distance[pred, box], pred))
    ((took, _),) = assign(pred[order], box[order], distance[pred, box][order], boxes=len(real), thresholds=(np.inf,))
    hit = np.zeros(len(found), np.bool_)
    hit[took] = True
    ignored = (near & crowd[None]).any(1)
    return Matched2D(label.astype(np.int32), hit, ignored & ~hit, np.bincount(real[~crowd], minlength=classes))


def _plane(solid: Solids | None) -> F64:
    if solid is None:
        raise ConfigError("the quality of 3D detections needs 3D boxes in the truth and in the detections")
    return _array(solid.centre)[:, [0, 2]]


def _array(values: Tensor) -> F64:
    found: F64 = values.detach().double().cpu().numpy()
    return found


def _whole(values: Tensor) -> I64:
    found: I64 = values.detach().long().cpu().numpy()
    return found

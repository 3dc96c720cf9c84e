"""What boxes under an attack tell besides mAP and NDS.

Scores by distance, the success of a targeted attack, and the worst of several attacks at each moment.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ssad.core.nuscenes_names import CLASSES
from ssad.core.types import F64
from ssad.datasets.nuscenes.truth import GroundTruth
from ssad.detectors.on_scenes import SampleBoxes, box_table, match_boxes
from ssad.metrics.detection import CVPR_2019, Matches, filter_boxes, match
from ssad.metrics.detection_boxes import BoxTable

BANDS: Mapping[str, tuple[float, float]] = {"0-20": (0.0, 20.0), "20-40": (20.0, 40.0), "40+": (40.0, np.inf)}
NEAR = 2.0  # metres within which a box is taken for that of an object, as for the true-positive errors of nuScenes
SAME = 1e-3  # metres within which two places are one
SEEN = 0.1  # least score of a box that counts as a detection of an object


class Matched(Protocol):
    """Boxes against the truth: `ssad.metrics.detection.Matches`, or `PictureMatches` of 2D detectors."""

    @property
    def samples(self) -> int:
        """How many there are."""

    @property
    def truth_counts(self) -> Any:
        """True boxes by class and sample [C, S]."""

    def scores(self, weights: Any = None) -> Any:
        """Scores with `ap` [C, ...] and `mean_ap`, where samples count as often as their weights say."""


Match = Callable[[Sequence[Any]], Matched]
"""From the boxes of all samples under an attack to what they match."""


def by_distance(found: Sequence[SampleBoxes], truth: GroundTruth) -> dict[str, float]:
    """Scores of objects near and far from the ego: each band by itself, boxes and truth by their own distance.

    Args:
        found: Boxes of all samples.
        truth: Of the same samples.

    Returns:
        mAP_BAND, the mean over the classes that are there, and recall_BAND, the share of objects with a box of their
        class within 2 m; a band without objects has neither.
    """
    real = filter_boxes(truth.boxes, points=truth.points, racks=truth.racks)
    boxes = filter_boxes(box_table(found, truth), racks=truth.racks)
    scores: dict[str, float] = {}
    for name, (low, high) in BANDS.items():
        own = match(_between(real, low, high), _between(boxes, low, high), samples=len(truth.samples))
        there = own.truth_counts.sum(1) > 0
        if there.any():
            scores[f"mAP_{name}"] = round(float(own.scores().ap[there].mean()), 6)
            scores[f"recall_{name}"] = round(_hits(own) / int(own.truth_counts.sum()), 6)
    return scores


def _between(boxes: BoxTable, low: float, high: float) -> BoxTable:
    return boxes.take(np.flatnonzero((boxes.ego_distance >= low) & (boxes.ego_distance < high)))


def _hits(matches: Matches) -> int:
    """Objects that are found within 2 m."""
    place = CVPR_2019.dist_ths.index(NEAR)
    return sum(len(one.hits[place]) for one in matches.classes)


def target_success(
    clean: Sequence[SampleBoxes],
    attacked: Sequence[SampleBoxes],
    truth: GroundTruth,
    classes: Sequence[str] = (),
    *,
    becomes: Mapping[str, str],
    at: Mapping[str, F64] | None = None,
) -> dict[str, float]:
    """How often a targeted attack reaches its target, over the objects that are found in the clean pictures.

    An object is found if the best box within 2 m of it, with a score of 0.1 at least, is of its class. The target is
    reached if, under the attack, the best such box is of the wanted class; where no class is wanted, if the object is
    not found any more.

    Args:
        clean: Boxes in the clean pictures.
        attacked: Boxes under the attack.
        truth: Of the same samples.
        classes: Names of the classes that are attacked; empty: all, or those that `becomes` names.
        becomes: Class -> class that its objects should be taken for.
        at: Where the one object of each sample is that is attacked, m, by token; None: all objects are.

    Returns:
        success, absent if no such object is found; targets, the number of objects; kept, the share of the others that
        are found as what they are in both, absent if there are none.
    """
    real = filter_boxes(truth.boxes, points=truth.points, racks=truth.racks)
    chosen = np.isin(real.label, [CLASSES.index(name) for name in becomes or classes or CLASSES])
    if at is not None:
        places = np.array([at.get(token, np.full(3, np.nan)) for token in truth.samples])
        chosen &= np.abs(real.centre - places[real.sample]).max(1) < SAME
    before, after = (_taken_for(real, box_table(found, truth)) for found in (clean, attacked))
    known = before == real.label
    others = known & ~chosen
    kept = {"kept": round(float((after == before)[others].mean()), 6)} if others.any() else {}
    known &= chosen
    wanted = {CLASSES.index(one): CLASSES.index(other) for one, other in becomes.items()}
    reached = after == [wanted.get(int(label), -2) for label in real.label] if becomes else after != real.label
    count = int(known.sum())
    return {"targets": count, **({"success": round(float(reached[known].mean()), 6)} if count else {}), **kept}


def _taken_for(real: BoxTable, boxes: BoxTable) -> F64:
    """Label of the best box near each object [N]; -1: there is none."""
    found = np.full(len(real.label), -1)
    boxes = boxes.take(np.flatnonzero(boxes.score >= SEEN))
    for sample in np.unique(real.sample):
        rows, near = np.flatnonzero(real.sample == sample), np.flatnonzero(boxes.sample == sample)
        if not len(near):
            continue
        gap = np.linalg.norm(real.centre[rows, None, :2] - boxes.centre[None, near, :2], axis=-1)
        score = np.where(gap < NEAR, boxes.score[near][None], -1.0)
        best = score.argmax(1)
        found[rows] = np.where(score.max(1) >= SEEN, boxes.label[near][best], -1)
    return found


def worst_by_sample(found: Sequence[Sequence[Any]], tokens: Sequence[str], match: Match) -> list[Any]:
    """At each moment the boxes under the attack that leaves the detector least.

    Args:
        found: Boxes of all samples under each attack.
        tokens: Of all samples.
        match: Matches them with the truth.

    Returns:
        For each sample the boxes of the attack with the least mAP over this sample alone; of equal ones those with the
        larger sum of scores, as there is more among them that is false.
    """
    tables = [{one.token: one for one in boxes} for boxes in found]
    left = np.stack([_by_sample(match(boxes)) for boxes in found])
    noise = np.array([[float(np.sum(table[token].boxes.score)) for token in tokens] for table in tables])
    return [tables[min(range(len(found)), key=lambda m: (left[m, k], -noise[m, k]))][t] for k, t in enumerate(tokens)]


def worst_of(
    candidates: Mapping[str, Sequence[Any]], truth: GroundTruth, match: Match | None = None
) -> tuple[str, list[Any]]:
    """The boxes that score least over the whole set: those of one of the attacks, or the worst of each moment.

    The mixture of moments alone guarantees nothing, as mAP over a set is no mean over moments.

    Args:
        candidates: Boxes of all samples under each attack, by its name.
        truth: Of the same samples.
        match: Matches boxes with the truth; None: as the official evaluation of 3D detectors does.

    Returns:
        A name, "mixture" for the worst of each moment, and its boxes: their mAP is at most that of each attack.
    """
    against: Match = match or (lambda boxes: match_boxes(boxes, truth))
    every = {**candidates, "mixture": worst_by_sample(list(candidates.values()), truth.samples, against)}
    left = {name: against(boxes).scores().mean_ap for name, boxes in every.items()}
    name = min(left, key=lambda one: left[one])
    return name, list(every[name])


def _by_sample(matches: Matched) -> F64:
    """Mean AP of each sample alone [S], over the classes that are in it."""
    found = np.zeros(matches.samples)
    for k in range(matches.samples):
        there = matches.truth_counts[:, k] > 0
        if there.any():
            once = np.zeros(matches.samples, np.int64)
            once[k] = 1
            found[k] = matches.scores(once).ap[there].mean()
    return found

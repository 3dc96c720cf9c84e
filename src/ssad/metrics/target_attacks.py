"""How well a detector finds the target of a physical attack: AP50, and the share of pictures in which it is found."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.core.detections import Detections, Truth
from ssad.core.protocols import Detector
from ssad.core.seeding import generator
from ssad.core.types import F64, I32, Bool
from ssad.metrics.detection2d import Boxes2D, Matched2D, average_precision, match_2d
from ssad.metrics.detection_boxes import I64
from ssad.metrics.intervals import MIN_CLUSTERS, Clusters, bounded_limits, replicate_limits

IOU = 0.5
COVERED = 0.25  # share of the target from which on a box of any class says that something is there
PRECISIONS = {"AP50": (True, 0.0), "AP50_25": (True, 0.25), "AP50_all": (False, 0.0), "AP50_all_25": (False, 0.25)}
THRESHOLD = 0.001  # least score of a box that AP counts
TOGETHER = 16  # pictures that a GPU is shown at once; a processor takes one, whose bits depend on nothing else
CONFIDENCES = (0.25, 0.5)  # from which score on a box counts as a detection


@dataclass(frozen=True, slots=True)
class Sighting:
    """What a detector found in one picture of the target, as plain arrays.

    Attributes:
        drive: The drive that the picture is of; pictures of one drive are alike.
        box: Found boxes of the target's class [N, 4], best first.
        score: Their scores [N].
        real: True boxes of that class [Q, 4], the target first.
        crowd: Which of these count neither as found nor as missed [Q].
        any_class: The best score of a box of any class that covers a quarter of the target or more, and finds no other
            object; 0: there is none.
    """

    drive: str
    box: F64
    score: F64
    real: F64
    crowd: Bool
    any_class: float = 0.0

    def confidences(self) -> F64:
        """The score with which each true box is found [Q], 0 without.

        From the best box to the worst, each takes the true box that it covers most of those not yet taken, with an IoU
        of one half at least; so none is counted twice, and it is found at every confidence below its score.
        """
        found = np.zeros(len(self.real))
        for row, score in zip(_overlaps(self.box, self.real)[0], self.score.tolist(), strict=True):
            free = np.where(found > 0.0, 0.0, row)
            best = int(free.argmax())
            if free[best] >= IOU:
                found[best] = score
        return found


def _overlaps(box: F64, real: F64) -> tuple[F64, F64]:
    """IoU [N, Q] of boxes [N, 4] and [Q, 4], and the share of the latter that the former cover [N, Q]."""
    low, high = box[:, None], real[None]
    side = np.minimum(low[..., 2:], high[..., 2:]) - np.maximum(low[..., :2], high[..., :2])
    both = np.where((side > 0.0).all(-1), side.prod(-1), 0.0)
    whole = (high[..., 2:] - high[..., :2]).prod(-1)
    area = (low[..., 2:] - low[..., :2]).prod(-1) + whole - both
    return both / np.maximum(area, 1e-9), both / np.maximum(whole, 1e-9)


def _on_target(box: F64, score: F64, real: F64) -> float:
    """The best score of boxes [N, 4] that cover enough of the first true box [Q, 4] and do not find another."""
    overlap, covered = _overlaps(box, real)
    another = overlap[:, 1:].max(1, initial=0.0)
    on_it = (covered[:, 0] >= COVERED) & ((another < IOU) | (another < overlap[:, 0]))
    return float(score[on_it].max(initial=0.0))


def sighting(drive: str, found: Detections, truth: Truth) -> Sighting:
    """What was found of the class of the target, the first object of the truth, and on it of any class."""
    label = int(truth.label[0])
    own, same = (found.label == label).cpu(), (truth.label == label).cpu()
    box, score = found.box.cpu().double().numpy(), found.score.cpu().double().numpy()
    real = truth.box.cpu().double().numpy()
    crowd = np.zeros(len(truth.label), np.bool_) if truth.crowd is None else truth.crowd.cpu().numpy().astype(np.bool_)
    return Sighting(
        drive,
        box[own.numpy()],
        score[own.numpy()],
        real[same.numpy()],
        crowd[same.numpy()],
        _on_target(box, score, real),
    )


def sightings(detector: Detector, pictures: Iterable[tuple[str, Tensor, Truth]]) -> Iterator[Sighting]:
    """What a detector finds in pictures, one after another.

    Args:
        detector: Of a 3D detector the hulls of its boxes in the picture count.
        pictures: Drive, picture [1, 3, H, W] in 0 to 1, and truth in the classes of the detector, the target first; for
            a 3D detector with the camera matrix.
    """
    left = iter(pictures)
    while shown := list(islice(left, 1)):
        if shown[0][1].is_cuda:
            shown += islice(left, TOGETHER - 1)
        drives, images, truths = zip(*shown, strict=True)
        batch = torch.cat(images)
        cameras = [truth.intrinsic for truth in truths if truth.intrinsic is not None and detector.task == "3d"]
        intrinsic = torch.stack(cameras).to(batch) if cameras else None
        for drive, found, truth in zip(
            drives, detector.predict(batch, intrinsic, threshold=THRESHOLD), truths, strict=True
        ):
            yield sighting(drive, found, truth)


def target_scores(
    sightings: Sequence[Sighting], clean: Sequence[Sighting] | None = None, *, replicates: int = 100, seed: int = 0
) -> dict[str, Any]:
    """Scores of a set of pictures.

    AP50 counts the target alone and boxes of any score, AP50_25 boxes above a score of 0.25; AP50_all and AP50_all_25
    count every vehicle of its class. found_25 and found_50 are shares of the pictures in which the target is found with
    that score; ASR_25 and ASR_50 the share of those where it is found without the attack and is not with it; ASR_any_25
    the share of these where no box of any class covers a quarter of it either; ASR_all_25 that of all vehicles (no
    match is counted twice).

    Args:
        sightings: With the attack.
        clean: The same pictures without it; None for these themselves.
        replicates: Of the bootstrap over drives, for the intervals of AP.
        seed: Of its draws.

    Returns:
        metrics; intervals (95 %; of drives, absent where there are too few); replicates of each AP (of the bootstrap,
        the same draws for all attacks on the same pictures); n, the number of pictures; drives.
    """
    drives = sorted({one.drive for one in sightings})
    of = np.array([drives.index(one.drive) for one in sightings], np.int32)
    metrics: dict[str, float | None] = {}
    intervals: dict[str, list[float] | None] = {}
    drawn: dict[str, list[float]] = {}
    for name, (target_only, least) in PRECISIONS.items():
        value = metrics[name] = precision(sightings, target_only=target_only, least=least)
        if len(drives) >= MIN_CLUSTERS and replicates and value is not None:
            draws = generator("target scores", seed, name)
            picked = [draws.integers(len(drives), size=len(drives)) for _ in range(replicates)]
            values = _precisions(sightings, of, picked, target_only=target_only, least=least)
            spread = np.asarray(np.var(values, ddof=1))
            low, high = replicate_limits(np.asarray(value), spread, len(drives), bounded=True)
            intervals[name] = [float(low), float(high)]
            drawn[name] = [round(one, 5) for one in values]
    scores = [one.confidences() for one in sightings]
    scores_before = scores if clean is None else [one.confidences() for one in clean]
    best, before = np.array([one[0] for one in scores]), np.array([one[0] for one in scores_before])
    for level in CONFIDENCES:
        percent = round(100 * level)
        found = best > level
        metrics[f"found_{percent}"], intervals[f"found_{percent}"] = _share(found, np.ones(len(best), bool), of)
        if clean is not None:
            metrics[f"ASR_{percent}"], intervals[f"ASR_{percent}"] = _share(~found, before > level, of)
    if clean is not None:
        least = CONFIDENCES[0]
        unseen = np.maximum(best, [one.any_class for one in sightings]) <= least
        metrics["ASR_any_25"], intervals["ASR_any_25"] = _share(unseen, before > least, of)
        real = np.concatenate([~one.crowd for one in sightings])
        every, every_before = np.concatenate(scores)[real], np.concatenate(scores_before)[real]
        drive = np.repeat(of, [len(one.real) for one in sightings])[real]
        lost = every <= least, every_before > least
        metrics["ASR_all_25"], intervals["ASR_all_25"] = _share(*lost, drive)
    metrics["confidence"] = float(best.mean())
    kept = {name: limits for name, limits in intervals.items() if limits is not None}
    rounded = {name: None if value is None else round(value, 6) for name, value in metrics.items()}
    return {
        "metrics": rounded,
        "intervals": kept,
        "replicates": drawn,
        "n": len(sightings),
        "drives": len(drives),
    }


def precision(sightings: Sequence[Sighting], *, target_only: bool = True, least: float = 0.0) -> float | None:
    """AP50 of boxes above a score: of the target alone (others count neither way), or of all vehicles of its class."""
    real, found = _tables(sightings, target_only=target_only, least=least)
    value = average_precision(real, found, labels=1, threshold=IOU)[0]
    return None if np.isnan(value) else float(value)


def _precisions(
    sightings: Sequence[Sighting], of: I32, drawn: Iterable[I64], *, target_only: bool, least: float
) -> list[float]:
    """`precision` of several draws of drives; what a box hits in its picture does not depend on the draw.

    Args:
        sightings: All pictures.
        of: The drive of each [N].
        drawn: Drives of each draw, some of them several times.
        target_only: See `precision`.
        least: See `precision`.
    """
    real, found = _tables(sightings, target_only=target_only, least=least)
    matched = match_2d(real, found, labels=1, threshold=IOU)
    assert matched.row is not None
    assert found.score is not None
    assert real.ignore is not None
    row, hit = matched.row[~matched.ignored], matched.hit[~matched.ignored]
    order = np.argsort(found.image[row], kind="stable")  # picture after picture, in each the best box first
    row, hit = row[order], hit[order]
    drive = of[found.image[row]]
    count = np.bincount(of[real.image[~real.ignore]], minlength=int(of.max()) + 1)
    own = [np.flatnonzero(drive == one) for one in range(len(count))]
    values = []
    for drives in drawn:
        boxes = np.concatenate([own[one] for one in drives])
        boxes = boxes[np.argsort(-found.score[row[boxes]], kind="stable")]
        none = np.zeros(len(boxes), np.bool_)
        ranked = Matched2D(none.astype(np.int32), hit[boxes], none, np.array([count[drives].sum()]))
        values.append(float(ranked.average_precision()[0]))
    return [value for value in values if not np.isnan(value)]


def _tables(sightings: Sequence[Sighting], *, target_only: bool, least: float) -> tuple[Boxes2D, Boxes2D]:
    """True and found boxes of pictures, for their AP."""
    crowd = []
    own_boxes = [(one.box[one.score > least], one.score[one.score > least]) for one in sightings]
    for one in sightings:
        own = one.crowd.copy()
        own[0] = False
        if target_only:
            own[1:] = True
        crowd.append(own)
    return (
        _boxes([s.real for s in sightings], ignore=crowd),
        _boxes([box for box, _ in own_boxes], score=[score for _, score in own_boxes]),
    )


def _boxes(
    boxes: Sequence[F64], *, score: Sequence[F64] | None = None, ignore: Sequence[Bool] | None = None
) -> Boxes2D:
    image: I32 = np.repeat(np.arange(len(boxes), dtype=np.int32), [len(b) for b in boxes])
    return Boxes2D(
        image,
        np.zeros(len(image), np.int32),
        np.concatenate(boxes),
        None if score is None else np.concatenate(score),
        None if ignore is None else np.concatenate(ignore),
    )


def _share(event: Bool, counted: Bool, drive: I32) -> tuple[float | None, list[float] | None]:
    """Share of the counted pictures with an event, and its interval from drives; None where nothing is counted."""
    if not counted.any():
        return None, None
    drives, own = np.unique(drive[counted], return_inverse=True)
    size = np.bincount(own).astype(np.float64)
    sums: F64 = np.bincount(own, weights=event[counted].astype(np.float64)).astype(np.float64)
    share = float(sums.sum() / size.sum())
    if len(drives) < MIN_CLUSTERS:
        return share, None
    limits = bounded_limits(sums, Clusters(size, np.zeros(len(size), np.intp)), cap=2.0 * float(size.sum()))
    return share, [float(limits.low), float(limits.high)]

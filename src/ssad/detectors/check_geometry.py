"""Part of `ssad.detectors.check`: places all over the picture, boxes in its pixels, solids in the documented frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations, product

import torch
from torch import Tensor

from ssad.core.detections import Dense, Detections, Solids, Truth
from ssad.detectors.check_cases import CheckCase, usual_threshold
from ssad.detectors.mono3d.decode import corners, hull, project

BEST = 20  # detections of an image that are looked at
FEW = 5  # of these, how many are taken for true
NEAR = 1.5  # pixels between a detection and the place that it comes from: room for rounding
SIDES = ("length", "height", "width")
FITS = 0.9  # overlap of a box and the hull of a solid that belong together
CLEARLY = {"yaw": 1.08, "size": 1.08, "centre": 1.25}  # ratio of losses; for another centre other places answer
TRAINED = 0.4  # ratio of the losses of a detector's own detections to those of objects that are not there


def check_places(trial: CheckCase) -> None:
    """Nothing is left out: every level has places all over the picture, the same for every picture."""
    images = trial.images(1)
    with torch.no_grad():
        dense, other = trial.dense(images), trial.dense(1 - images)
    same = dense.place.shape == other.place.shape and torch.equal(dense.place, other.place)
    trial.need(same, "Dense.place depends on the size of the pictures alone, not on what they show")
    holes = [level for level in sorted(set(dense.level.tolist())) if not _covers(dense, level)]
    trial.need(not holes, f"Dense has places all over the picture, not only the best; level(s) {holes} have holes")


def _covers(dense: Dense, level: int) -> bool:
    """Whether each cell of a level within the picture has a place; it may lie in a corner of the cell."""
    mine = dense.level == level
    stride, place = float(dense.stride[mine][0]), dense.place[mine]
    x, y = (stride * (torch.arange(int(length / stride), device=place.device) + 0.5) for length in dense.size[::-1])
    for row in y.tolist():
        near = place[(place[:, 1] - row).abs() <= 0.75 * stride, 0]
        if not bool(((near[:, None] - x).abs() <= 0.75 * stride).any(0).all()):
            return False
    return True


def check_boxes(trial: CheckCase) -> None:
    """Boxes are in pixels of the picture, x before y, and detections are among those of the places."""
    images = trial.images()
    with torch.no_grad():
        dense = trial.dense(images)
    box, place = dense.box.double(), dense.place.double()
    middle = (box[..., :2] + box[..., 2:]) / 2
    straight, crossed = _follows(middle, place), _follows(middle, place.flip(-1))
    pixels = bool((middle.abs() > 2).any()) and straight < 2
    trial.need(pixels, "Dense.box is in pixels of the picture, not in shares of it or in pixels of the network's input")
    turned = crossed > 0.2 and crossed > 2 * abs(straight)
    trial.need(not turned, "Dense.box is x1, y1, x2, y2: its x follows the x of Dense.place, not the y")
    apart = []
    for found, boxes in zip(trial.predict(images, threshold=usual_threshold(trial, images)), box, strict=True):
        own, all_boxes = (_cut(b, trial.size) for b in (found.box[:BEST].double(), boxes))
        if len(own) and len(all_boxes):
            apart.append((own[:, None] - all_boxes).abs().amax(-1).amin(-1))
    near = not apart or float(torch.cat(apart).median()) <= NEAR
    trial.need(near, "the boxes of predict are among those of dense, in the same pixels")


def _follows(middle: Tensor, place: Tensor) -> float:
    """By how many pixels the middles [B, P, 2] of boxes move if the places [P, 2] move by one; 0 if these do not."""
    across = place - place.mean(0)
    spread = across.square().mean(0)
    if not bool((spread > 0).all()):
        return 0.0
    return float(((middle - middle.mean(1, keepdim=True)) * across).mean((0, 1)).div(spread).mean())


def _cut(box: Tensor, size: tuple[int, int]) -> Tensor:
    """Boxes [..., 4] cut to the picture."""
    return box.clamp_min(0).minimum(box.new_tensor([size[1], size[0]] * 2))


# ---------------------------------------------------------------- 3D


@dataclass(frozen=True, slots=True)
class Reading:
    """Another convention that 3D boxes may follow.

    Attributes:
        yaw: A key of `YAWS`; "": the documented convention.
        size: Columns that hold length, height and width.
        up: Height of the centre above the documented one, as a share of the object's height.
    """

    yaw: str = ""
    size: tuple[int, ...] = (0, 1, 2)
    up: float = 0.0

    @property
    def changed(self) -> list[str]:
        """What differs from the documented convention."""
        parts = {"yaw": self.yaw != "", "size": self.size != (0, 1, 2), "centre": self.up != 0}
        return [name for name, other in parts.items() if other]

    def __str__(self) -> str:
        order = ", ".join(SIDES[self.size.index(column)] for column in range(3))
        said = {"yaw": f"yaw {self.yaw}", "size": f"size as {order}", "centre": "centre of the bottom face"}
        if self.up > 0:
            said["centre"] = "centre of the top face"
        return " and ".join(said[name] for name in self.changed)

    def apply(self, solid: Solids) -> Solids:
        """The solids in the documented convention."""
        size = solid.size_lhw[:, list(self.size)]
        centre = solid.centre.clone()
        centre[:, 1] += self.up * size[:, 1]
        return replace(solid, centre=centre, size_lhw=size, yaw=YAWS[self.yaw](solid))


def _ray(solid: Solids) -> Tensor:
    return torch.atan2(solid.centre[:, 0], solid.centre[:, 2])


YAWS: dict[str, Callable[[Solids], Tensor]] = {
    "": lambda solid: solid.yaw,
    "of the opposite sign": lambda solid: -solid.yaw,
    "90 degrees too large": lambda solid: solid.yaw - math.pi / 2,
    "90 degrees too small": lambda solid: solid.yaw + math.pi / 2,
    "180 degrees off": lambda solid: solid.yaw + math.pi,
    "of the opposite sign and 90 degrees off": lambda solid: -solid.yaw - math.pi / 2,
    "counted from the line of sight": lambda solid: solid.yaw + _ray(solid),
}
READINGS = sorted(
    (Reading(*parts) for parts in product(YAWS, permutations(range(3)), (0.0, -0.5, 0.5))),
    key=lambda reading: len(reading.changed),
)


def check_solids(trial: CheckCase) -> None:
    """Solids are what their boxes show and what the losses take for true, in the documented convention."""
    images = trial.images()
    everything = trial.predict(images, threshold=usual_threshold(trial, images))
    if not trial.three or any(one.solid is None for one in everything):
        return
    fit = [_fit(trial, everything, reading) for reading in READINGS]
    best = max(fit)
    told = None
    if best > FITS:
        if 1 - fit[0] > 5 * (1 - best) + 0.005:
            as_good = [reading for reading, one in zip(READINGS, fit, strict=True) if one > best - 0.002]
            simple = [reading for reading in as_good if len(reading.changed) == len(as_good[0].changed)]
            told = min(simple, key=_losses(trial, images, everything))
    else:  # the boxes are not hulls, but predicted
        told = _better_for_losses(trial, images, everything)
        if told is not None and told.up != 0 and not _shown(fit[0], _fit(trial, everything, told)):
            told = None
    what = "solids have the centre of gravity, length, height, width and yaw of ssad.core.detections"
    trial.need(told is None, f"{what}; these fit better if read otherwise: {told}")


def _shown(documented: float, other: float) -> bool:
    """Whether boxes show another centre: the losses do not tell enough, since for that other places answer."""
    return other > 0.5 and other > documented + 0.1


def _fit(trial: CheckCase, everything: list[Detections], reading: Reading) -> float:
    """Mean overlap of the boxes with the hulls of the solids."""
    lens = trial.lens(1)
    found = []
    for one in everything:
        if one.solid is None or lens is None:
            continue
        solid = reading.apply(one.solid)
        shown = hull(project(corners(solid.centre, solid.size_lhw, solid.yaw), lens[0].to(solid.centre)))
        box, shown = _cut(one.box[:BEST], trial.size), _cut(shown[:BEST], trial.size)
        seen = _area(box) > 4
        found.append(_overlap(box[seen], shown[seen]))
    overlap = torch.cat(found) if found else torch.zeros(0)
    return float(overlap.double().mean()) if len(overlap) else 0.0


def _area(box: Tensor) -> Tensor:
    return (box[:, 2:] - box[:, :2]).clamp_min(0).prod(-1)


def _overlap(a: Tensor, b: Tensor) -> Tensor:
    """IoU [N] of boxes [N, 4] in pairs."""
    both = _area(torch.cat([torch.maximum(a[:, :2], b[:, :2]), torch.minimum(a[:, 2:], b[:, 2:])], 1))
    return both / (_area(a) + _area(b) - both).clamp_min(1e-6)


def _better_for_losses(trial: CheckCase, images: Tensor, everything: list[Detections]) -> Reading | None:
    """The reading of the detections, other than the documented one, with which they are clearly more the truth.

    None as well if no reading is: the losses of weights that are not trained are as large for one truth as for another.
    """
    loss = _losses(trial, images, everything)
    own, *others = (reading for reading in READINGS if len(reading.changed) <= 1)
    best = min(others, key=loss)
    clearly = math.isfinite(loss(own)) and loss(own) > CLEARLY[best.changed[0]] * loss(best)
    with torch.no_grad():
        dense = trial.dense(images)
        losses = trial.detector.losses(dense, trial.detector.assign(dense, trial.truth((2, 1, 1))))
    trained = loss(best) < TRAINED * float(sum(part.sum() for part in losses.values()))
    return best if clearly and trained else None


def _losses(trial: CheckCase, images: Tensor, everything: list[Detections]) -> Callable[[Reading], float]:
    """The sum of the losses if the best detections, read in a way, were true; infinite if no place answers for them."""
    with torch.no_grad():
        dense = trial.dense(images)

    def loss(reading: Reading) -> float:
        truth = [_truth(one, reading, trial) for one in everything]
        assignment = trial.detector.assign(dense, truth)
        if not bool((assignment.label >= 0).any()):
            return math.inf
        with torch.no_grad():
            return float(sum(part.sum() for part in trial.detector.losses(dense, assignment).values()))

    return loss


def _truth(found: Detections, reading: Reading, trial: CheckCase) -> Truth:
    """The best detections as truth."""
    lens = trial.lens(1)
    assert found.solid is not None
    assert lens is not None
    solid = reading.apply(found.solid)
    columns = (solid.centre, solid.size_lhw, solid.yaw, solid.velocity, solid.attribute)
    few = Solids(*(column[:FEW] for column in columns))
    return Truth(found.label[:FEW], _cut(found.box[:FEW], trial.size), few, lens[0])

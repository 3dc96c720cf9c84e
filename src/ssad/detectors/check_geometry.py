"""Geometric part of `ssad.detectors.check`: places that cover the image, boxes in its pixels, documented 3D frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations, product

import torch
from torch import Tensor

from ssad.core.detections import Dense, Detections, Solids, Truth
from ssad.core.tensor_boxes import area, iou, solid_corners
from ssad.detectors.check_cases import CheckCase, typical_threshold
from ssad.detectors.mono3d.decode import hull, project

MAX_COMPARED = 20  # detections compared in an image
TRUTH_COUNT = 5  # of these, the number used as truth
NEAR = 1.5  # pixels between a detection and the place that it comes from: room for rounding
SIDES = ("length", "height", "width")
MIN_FIT = 0.9  # overlap of a box and the hull of a solid that belong together
CLEAR_RATIOS = {"yaw": 1.08, "size": 1.08, "centre": 1.25}  # ratio of losses; for another centre other places answer
TRAINED = 0.4  # ratio of the losses of a detector's own detections to those of absent objects


def check_places(trial: CheckCase) -> None:
    """Check that every level has places all over the image, the same for every image."""
    images = trial.images(1)
    with torch.no_grad():
        dense, inverted_dense = trial.dense(images), trial.dense(1 - images)
    is_fixed = dense.place.shape == inverted_dense.place.shape and torch.equal(dense.place, inverted_dense.place)
    trial.expect(is_fixed, "Dense.place depends on the size of the pictures alone, not on what they show")
    incomplete_levels = [level for level in sorted(set(dense.level.tolist())) if not _covers(dense, level)]
    trial.expect(
        not incomplete_levels,
        f"Dense has places all over the picture, not only the best; level(s) {incomplete_levels} have holes",
    )


def _covers(dense: Dense, level: int) -> bool:
    """Return whether each cell of a level within the image has a place, possibly in a corner of the cell."""
    in_level = dense.level == level
    stride, place = float(dense.stride[in_level][0]), dense.place[in_level]
    x, y = (stride * (torch.arange(int(length / stride), device=place.device) + 0.5) for length in dense.size[::-1])
    for row_centre in y.tolist():
        nearby_x = place[(place[:, 1] - row_centre).abs() <= 0.75 * stride, 0]
        if not bool(((nearby_x[:, None] - x).abs() <= 0.75 * stride).any(0).all()):
            return False
    return True


def check_boxes(trial: CheckCase) -> None:
    """Check that boxes are in pixels, x before y, and that detections are among the boxes of the places."""
    images = trial.images()
    with torch.no_grad():
        dense = trial.dense(images)
    box, place = dense.box.double(), dense.place.double()
    centre = (box[..., :2] + box[..., 2:]) / 2
    slope, crossed_slope = _centre_slope(centre, place), _centre_slope(centre, place.flip(-1))
    in_pixels = bool((centre.abs() > 2).any()) and slope < 2
    trial.expect(
        in_pixels, "Dense.box is in pixels of the picture, not in shares of it or in pixels of the network's input"
    )
    is_swapped = crossed_slope > 0.2 and crossed_slope > 2 * abs(slope)
    trial.expect(not is_swapped, "Dense.box is x1, y1, x2, y2: its x follows the x of Dense.place, not the y")
    distances = []
    for detections, image_boxes in zip(
        trial.predict(images, threshold=typical_threshold(trial, images)), box, strict=True
    ):
        detected_boxes, place_boxes = (
            _clip(candidate_boxes, trial.size)
            for candidate_boxes in (detections.box[:MAX_COMPARED].double(), image_boxes)
        )
        if len(detected_boxes) and len(place_boxes):
            distances.append((detected_boxes[:, None] - place_boxes).abs().amax(-1).amin(-1))
    agrees = not distances or float(torch.cat(distances).median()) <= NEAR
    trial.expect(agrees, "the boxes of predict are among those of dense, in the same pixels")


def _centre_slope(centres: Tensor, place: Tensor) -> float:
    """Return how far the centres [B, P, 2] of boxes move per pixel of the places [P, 2]; 0 if these coincide."""
    deviation = place - place.mean(0)
    spread = deviation.square().mean(0)
    if not bool((spread > 0).all()):
        return 0.0
    return float(((centres - centres.mean(1, keepdim=True)) * deviation).mean((0, 1)).div(spread).mean())


def _clip(box: Tensor, size: tuple[int, int]) -> Tensor:
    """Clip boxes [..., 4] to the image."""
    return box.clamp_min(0).minimum(box.new_tensor([size[1], size[0]] * 2))


# ---------------------------------------------------------------- 3D


@dataclass(frozen=True, slots=True)
class Convention:
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
    def changed_parts(self) -> list[str]:
        """Names of the parts that differ from the documented convention."""
        differences = {"yaw": self.yaw != "", "size": self.size != (0, 1, 2), "centre": self.up != 0}
        return [name for name, differs in differences.items() if differs]

    def __str__(self) -> str:
        size_order = ", ".join(SIDES[self.size.index(column)] for column in range(3))
        descriptions = {
            "yaw": f"yaw {self.yaw}",
            "size": f"size as {size_order}",
            "centre": "centre of the bottom face",
        }
        if self.up > 0:
            descriptions["centre"] = "centre of the top face"
        return " and ".join(descriptions[name] for name in self.changed_parts)

    def apply(self, solid: Solids) -> Solids:
        """Convert solids from this convention to the documented one."""
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
CONVENTIONS = sorted(
    (Convention(*parts) for parts in product(YAWS, permutations(range(3)), (0.0, -0.5, 0.5))),
    key=lambda reading: len(reading.changed_parts),
)


def check_solids(trial: CheckCase) -> None:
    """Check 3D boxes against their 2D boxes and the losses, in the documented convention."""
    images = trial.images()
    batch_detections = trial.predict(images, threshold=typical_threshold(trial, images))
    if not trial.is_3d or any(entry.solid is None for entry in batch_detections):
        return
    overlaps = [_mean_overlap(trial, batch_detections, convention) for convention in CONVENTIONS]
    best_overlap = max(overlaps)
    better_convention = None
    if best_overlap > MIN_FIT:
        if 1 - overlaps[0] > 5 * (1 - best_overlap) + 0.005:
            ties = [
                convention
                for convention, entry in zip(CONVENTIONS, overlaps, strict=True)
                if entry > best_overlap - 0.002
            ]
            # Several conventions may fit equally well; report the simplest, and let the losses decide among those.
            simplest = [
                convention for convention in ties if len(convention.changed_parts) == len(ties[0].changed_parts)
            ]
            better_convention = min(simplest, key=_loss_of_convention(trial, images, batch_detections))
    else:  # the boxes are not hulls, but predicted
        better_convention = _better_for_losses(trial, images, batch_detections)
        if (
            better_convention is not None
            and better_convention.up != 0
            and not _is_better_centre(overlaps[0], _mean_overlap(trial, batch_detections, better_convention))
        ):
            better_convention = None
    promise = "solids have the centre of gravity, length, height, width and yaw of ssad.core.detections"
    trial.expect(better_convention is None, f"{promise}; these fit better if read otherwise: {better_convention}")


def _is_better_centre(documented: float, alternative: float) -> bool:
    """Return True if boxes show another centre; losses do not decide, since other places answer for it."""
    return alternative > 0.5 and alternative > documented + 0.1


def _mean_overlap(trial: CheckCase, batch_detections: list[Detections], convention: Convention) -> float:
    """Return the mean overlap of the boxes with the hulls of the solids."""
    intrinsic = trial.intrinsics(1)
    image_overlaps = []
    for detections in batch_detections:
        if detections.solid is None or intrinsic is None:
            continue
        solid = convention.apply(detections.solid)
        hulls = hull(project(solid_corners(solid.centre, solid.size_lhw, solid.yaw), intrinsic[0].to(solid.centre)))
        box, hulls = _clip(detections.box[:MAX_COMPARED], trial.size), _clip(hulls[:MAX_COMPARED], trial.size)
        is_visible = area(box) > 4
        image_overlaps.append(iou(box[is_visible], hulls[is_visible], min_union=1e-6))
    overlap = torch.cat(image_overlaps) if image_overlaps else torch.zeros(0)
    return float(overlap.double().mean()) if len(overlap) else 0.0


def _better_for_losses(trial: CheckCase, images: Tensor, batch_detections: list[Detections]) -> Convention | None:
    """Return the other convention under which the detections clearly fit the losses better.

    None if there is none, or if the weights are untrained: their losses are as large for one truth as for another.
    """
    loss = _loss_of_convention(trial, images, batch_detections)
    documented, *alternatives = (convention for convention in CONVENTIONS if len(convention.changed_parts) <= 1)
    best_convention = min(alternatives, key=loss)
    is_better = math.isfinite(loss(documented)) and loss(documented) > CLEAR_RATIOS[
        best_convention.changed_parts[0]
    ] * loss(best_convention)
    with torch.no_grad():
        dense = trial.dense(images)
        losses = trial.detector.losses(dense, trial.detector.assign(dense, trial.truth((2, 1, 1))))
    is_trained = loss(best_convention) < TRAINED * float(sum(part.sum() for part in losses.values()))
    return best_convention if is_better and is_trained else None


def _loss_of_convention(
    trial: CheckCase, images: Tensor, batch_detections: list[Detections]
) -> Callable[[Convention], float]:
    """Return a function from a convention to the losses with the best detections as truth; infinite without a place."""
    with torch.no_grad():
        dense = trial.dense(images)

    def loss(reading: Convention) -> float:
        # Detections serve as truth: the documented convention fits them best if the detector follows it.
        truth = [_detections_as_truth(detections, reading, trial) for detections in batch_detections]
        assignment = trial.detector.assign(dense, truth)
        if not bool((assignment.label >= 0).any()):
            return math.inf
        with torch.no_grad():
            return float(sum(part.sum() for part in trial.detector.losses(dense, assignment).values()))

    return loss


def _detections_as_truth(detections: Detections, convention: Convention, trial: CheckCase) -> Truth:
    """Return the best detections as truth."""
    intrinsic = trial.intrinsics(1)
    assert detections.solid is not None
    assert intrinsic is not None
    solid = convention.apply(detections.solid)
    fields = (solid.centre, solid.size_lhw, solid.yaw, solid.velocity, solid.attribute)
    solids = Solids(*(field_values[:TRUTH_COUNT] for field_values in fields))
    return Truth(detections.label[:TRUTH_COUNT], _clip(detections.box[:TRUTH_COUNT], trial.size), solids, intrinsic[0])

"""The conformance test of detectors: what attacks, training and evaluation rely on, tried out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from ssad.core.detections import Assignment, Detections, Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.nuscenes_names import MMDET3D_ATTRIBUTES
from ssad.core.protocols import Detector
from ssad.core.seeding import seed32
from ssad.detectors.check_cases import BATCH, CheckCase, modules_of, usual_threshold
from ssad.detectors.check_geometry import check_boxes, check_places, check_solids
from ssad.detectors.check_gradients import check_loss_signs, check_slopes, check_small_changes

RTOL = 2e-3
FEW = 0.01  # share of places that may differ in a batch: choices between values that are equal but for rounding


class DetectorCheckError(AssertionError):
    """A detector breaks promises; the message has them all, one a line."""


def check_detector(detector: Any, *, intrinsic: Tensor | None = None, size: tuple[int, int] = (96, 128)) -> None:
    """Hold a detector to `ssad.core.protocols.Detector`.

    Args:
        detector: The detector.
        intrinsic: Camera matrix [3, 3] of the pictures that are tried, for detectors of task "3d"; None: a focal length
            of 0.8 times the width.
        size: Height and width of these pictures, which are random; others follow.

    Raises:
        DetectorCheckError: The detector breaks promises; the message has every one of them.
    """
    faults = find_faults(detector, intrinsic=intrinsic, size=size)
    if faults:
        raise DetectorCheckError(f"{len(faults)} broken promises:\n" + "\n".join(f"- {fault}" for fault in faults))


def find_faults(detector: Any, *, intrinsic: Tensor | None = None, size: tuple[int, int] = (96, 128)) -> list[str]:
    """The promises that a detector breaks, a sentence each; none for one that keeps them."""
    return list(each_fault(detector, intrinsic=intrinsic, size=size))


def each_fault(detector: Any, *, intrinsic: Tensor | None = None, size: tuple[int, int] = (96, 128)) -> Iterator[str]:
    """As `find_faults`, one by one as they are found, the cheap parts first: who waits for one need not try the rest.

    Args:
        detector: What may keep to `ssad.core.protocols.Detector`.
        intrinsic: [3, 3] of the camera, for detectors of task "3d"; by default a focal length of 0.8 times the width.
        size: Height and width of the pictures that are tried, pixels.

    Yields:
        A sentence for each broken promise.
    """
    if not isinstance(detector, Detector):
        wanted = ("name", "task", "classes", "predict", "dense", "assign", "losses")
        missing = [name for name in wanted if not hasattr(detector, name)]
        yield f"it lacks {', '.join(missing)} of ssad.core.protocols.Detector"
        return
    trial = CheckCase(detector, size, intrinsic)
    for part in (
        _check_names,
        _check_dense,
        check_places,
        _check_gradient,
        _check_predict,
        check_boxes,
        check_solids,
        _check_batch,
        _check_losses,
        check_loss_signs,
        check_slopes,
        check_small_changes,
        _check_modes,
        _check_sizes,
        _check_refusals,
    ):
        told = len(trial.faults)
        name = part.__name__.strip("_").removeprefix("check_").replace("_", " ")
        with trial.guarded(name), torch.random.fork_rng(devices=[]):
            # not the state that a caller left: where he has seeded with 0, a detector that does so too changes nothing
            torch.default_generator.manual_seed(seed32("check_detector", name))
            part(trial)
        yield from trial.faults[told:]


# ---------------------------------------------------------------- the promises


def _check_names(trial: CheckCase) -> None:
    detector, need = trial.detector, trial.need
    name: Any = detector.name
    need(isinstance(name, str) and name != "", "name is a text")
    task: Any = detector.task
    need(task in ("2d", "3d"), 'task is "2d" or "3d"')
    classes: Any = detector.classes
    named = isinstance(classes, tuple) and len(classes) > 0 and all(isinstance(one, str) for one in classes)
    need(named and len(set(classes)) == len(classes), "classes are a tuple of distinct names, at least one")
    learning = [n for root in modules_of(detector) for n, p in root.named_parameters() if p.requires_grad]
    if not any(root.training for root in modules_of(detector)):
        need(not learning, f"parameters are frozen outside training; {learning[:1]} has requires_grad")


def _check_dense(trial: CheckCase) -> None:
    need, images = trial.need, trial.images()
    dense = trial.dense(images)
    classes = len(trial.detector.classes)
    if not need(dense.logit.ndim == 3, "Dense.logit is [B, P, C]"):
        return
    count = dense.logit.shape[1]
    need(dense.logit.shape == (BATCH, count, classes), "Dense.logit is [B, P, C], C as many as classes")
    need(dense.quality is None or dense.quality.shape == (BATCH, count), "Dense.quality is [B, P] or None")
    need(dense.box.shape == (BATCH, count, 4), "Dense.box is [B, P, 4]")
    need(dense.place.shape == (count, 2), "Dense.place is [P, 2]")
    need(dense.stride.shape == (count,) and bool((dense.stride > 0).all()), "Dense.stride is [P], above 0")
    level = dense.level
    need(level.shape == (count,) and not level.is_floating_point(), "Dense.level is [P], whole numbers")
    need(tuple(dense.size) == trial.size, "Dense.size is height and width of the pictures")
    parts = [dense.logit, dense.box, dense.place, *([] if dense.quality is None else [dense.quality])]
    need(all(bool(p.isfinite().all()) for p in parts), "what Dense holds is finite")
    need(all(p.dtype in (torch.float32, torch.float64) for p in parts), "what Dense holds is float32 or float64")
    maps: Any = dense.maps
    lists = all(isinstance(v, list) and all(isinstance(t, Tensor) for t in v) for v in maps.values())
    need(lists, "Dense.maps holds lists of tensors by name")
    need(all(f.ndim == 4 and len(f) == BATCH for f in dense.features), "Dense.features are [B, K, h, w]")
    heights = [f.shape[2] for f in dense.features]
    need(heights == sorted(heights, reverse=True), "Dense.features are ordered finest first")


def _check_gradient(trial: CheckCase) -> None:
    names = ["logit", "box"] + (["quality"] if trial.dense(trial.images(1)).quality is not None else [])
    for name in names:
        images = trial.images(2).requires_grad_()
        dense = trial.dense(images)
        value = getattr(dense, name)[0]
        if not trial.need(value.requires_grad, f"Dense.{name} is differentiable to the images"):
            continue
        (gradient,) = torch.autograd.grad((value.double() ** 2).mean(), images)
        trial.need(bool(gradient.isfinite().all()), f"the gradient of Dense.{name} is finite")
        limit = torch.tensor(dense.size[::-1], device=value.device)
        inside = ((dense.box[0, :, :2] > 0) & (dense.box[0, :, 2:] < limit)).any()  # all may be cut at the border
        reaches = bool(gradient[0].any()) or (name == "box" and not bool(inside))
        trial.need(reaches, f"the gradient of Dense.{name} reaches the image")
        trial.need(not bool(gradient[1].any()), f"Dense.{name} of an image does not depend on the others")


def _check_predict(trial: CheckCase) -> None:
    need, images = trial.need, trial.images()
    need(len(trial.predict(images)) == BATCH, "predict answers for each image")
    least = usual_threshold(trial, images)
    everything = trial.predict(images, threshold=least)
    some = False
    for found in everything:
        some |= len(found.score) > 0
        for kept, promise in promises(found, classes=len(trial.detector.classes), three=trial.three, least=least):
            need(kept, promise)
    need(some, "predict finds something when the threshold is low")
    for few, found in zip(trial.predict(images, threshold=0.5 * (1 + least)), everything, strict=True):
        need(bool((few.score >= 0.5 * (1 + least)).all()), "no score lies under the threshold")
        need(len(few.score) <= len(found.score), "a higher threshold finds no more")
    again = trial.predict(images, threshold=least)
    same = all(
        torch.equal(a.score, b.score) and torch.equal(a.box, b.box) for a, b in zip(everything, again, strict=True)
    )
    need(same, "the same images give the same detections")
    need(len(trial.predict(images.double(), threshold=least)) == BATCH, "float64 images are taken")


def promises(found: Detections, *, classes: int, three: bool, least: float = 0.0) -> Iterator[tuple[bool, str]]:
    """What a detector promises of its detections in one image, and whether it is kept; shapes first."""
    count = len(found.score)
    yield found.score.shape == found.label.shape == (count,), "score and label of Detections are [N]"
    yield found.box.shape == (count, 4), "Detections.box is [N, 4]"
    yield (found.solid is not None) == three, 'Detections.solid is there for task "3d" and only then'
    yield not found.label.is_floating_point(), "labels are whole numbers"
    yield bool(((found.score >= least) & (found.score <= 1)).all()), "scores lie between the threshold and 1"
    yield bool((found.score.diff() <= 0).all()), "detections come best first"
    yield bool(((found.label >= 0) & (found.label < classes)).all()), "labels are within classes"
    ordered = bool((found.box[:, 2:] >= found.box[:, :2]).all()) and bool(found.box.isfinite().all())
    yield ordered, "boxes are x1, y1, x2, y2, finite, x1 <= x2 and y1 <= y2"
    yield not found.score.requires_grad and not found.box.requires_grad, "predict keeps no gradient"
    if found.solid is not None:
        yield from _solid_promises(found.solid, count)


def _solid_promises(solid: Solids, count: int) -> Iterator[tuple[bool, str]]:
    shapes = {
        "centre": (count, 3),
        "size_lhw": (count, 3),
        "yaw": (count,),
        "velocity": (count, 2),
        "attribute": (count,),
    }
    for name, shape in shapes.items():
        value = getattr(solid, name)
        yield tuple(value.shape) == shape, f"Solids.{name} is {['N', *shape[1:]]}"
        finite = not value.is_floating_point() or bool(value.isfinite().all())
        yield finite or name == "velocity", f"Solids.{name} is finite"
    yield bool((solid.size_lhw > 0).all()), "sizes are above 0"
    inside = bool(((solid.attribute >= 0) & (solid.attribute < len(MMDET3D_ATTRIBUTES))).all())
    yield inside, "attributes are within ssad.core.nuscenes_names.MMDET3D_ATTRIBUTES"


def _check_batch(trial: CheckCase) -> None:
    images = trial.images()
    with torch.no_grad():
        together = trial.dense(images)
        turned = trial.dense(images.flip(0))
        alone = [trial.dense(images[k : k + 1]) for k in range(BATCH)]
    for name in ("logit", "quality", "box"):
        whole = getattr(together, name)
        if whole is None:
            continue
        for k in range(BATCH):
            for other in (getattr(alone[k], name)[0], getattr(turned, name)[BATCH - 1 - k]):
                fits = other.shape == whole[k].shape and _apart(whole[k], other) <= FEW
                trial.need(fits, f"Dense.{name} of an image does not depend on its batch")
    least = usual_threshold(trial, images)
    both = trial.predict(images, threshold=least)
    for k in range(BATCH):
        (single,) = trial.predict(images[k : k + 1], threshold=least)
        trial.need(_alike(both[k], single), "detections of an image do not depend on its batch")


def _apart(a: Tensor, b: Tensor) -> float:
    """The share of rows that differ by more than rounding."""
    far = (a - b).abs() > RTOL * (1 + b.abs())
    return float(far.reshape(len(far), -1).any(-1).double().mean()) if far.numel() else 0.0


def _alike(a: Detections, b: Detections) -> bool:
    """Whether the best detections are the same but for rounding; of nearly equal scores any may suppress others."""
    count = min(10, len(a.score), len(b.score))
    if count == 0:
        return len(a.score) == len(b.score)
    if not torch.allclose(a.score[:count], b.score[:count], rtol=RTOL, atol=1e-5):
        return False
    near = (a.box[:count, None] - b.box).abs().amax(-1) < 2.0  # pixels
    match = near & (a.label[:count, None] == b.label)
    return float(match.any(1).double().mean()) > 0.6


def _check_losses(trial: CheckCase) -> None:
    need, detector = trial.need, trial.detector
    images, truth = trial.images().requires_grad_(), trial.truth()
    dense = trial.dense(images)
    assignment: Assignment = detector.assign(dense, truth)
    count = dense.logit.shape[1]
    shaped = assignment.label.shape == assignment.owner.shape == (BATCH, count)
    if not need(shaped, "Assignment.label and owner are [B, P]"):
        return
    for row, owner, one in zip(assignment.label, assignment.owner, truth, strict=True):
        owned = owner >= 0
        need(bool(((row >= -2) & (row < len(detector.classes))).all()), "Assignment.label is -2, -1 or a class")
        need(bool((owner < len(one.label)).all()) and bool((owner >= -1).all()), "Assignment.owner is -1 or an object")
        need(torch.equal(owned, row >= 0), "places with an owner have a class, others have none")
        need(bool((row[owned] == one.label[owner[owned]]).all()), "a place has the class of its owner")
        need(not len(one.label) or bool(owned.any()), "some place answers for a large object")
    held = (assignment.label, *assignment.extra.values())
    need(not any(value.requires_grad for value in held), "no gradient flows through assign")
    batch = detector.losses(dense, assignment)
    each = detector.losses(dense, assignment, reduction="image")
    need(batch.keys() == each.keys() and bool(batch), "losses have the same names for both reductions")
    need(all(v.shape == () for v in batch.values()), 'losses are scalars for "batch"')
    need(all(v.shape == (BATCH,) for v in each.values()), 'losses are [B] for "image"')
    finite = all(bool(v.isfinite().all()) for v in (*batch.values(), *each.values()))
    need(finite, "losses are finite, also for an image without objects")
    for name, values in (("batch", batch), ("image", each)):
        total = torch.stack([v.sum() for v in values.values()]).sum()
        (gradient,) = torch.autograd.grad(total, images, retain_graph=True)
        need(bool(gradient.isfinite().all()), f'the gradient of the "{name}" losses is finite')
        reached = gradient.flatten(1).any(1)
        told = [k for k, one in enumerate(truth) if len(one.label)]
        need(bool(reached[told].all()), f'the gradient of the "{name}" losses reaches every image with objects')
    for k in range(BATCH):
        with torch.no_grad():
            lone = trial.dense(images[k : k + 1])
            single = detector.losses(lone, detector.assign(lone, truth[k : k + 1]))
        for name, value in single.items():
            same = torch.allclose(value, each[name][k].detach(), rtol=10 * RTOL, atol=1e-4)
            need(same, f'"image" losses are those of each image alone ({name})')
    with torch.no_grad():
        none = trial.dense(images)
        empty = detector.losses(none, detector.assign(none, trial.truth((0, 0, 0))))
        moved = trial.dense((images * 0.9).clamp(0, 1))
        kept = detector.losses(moved, assignment)
    need(all(bool(v.isfinite()) for v in empty.values()), "losses are finite without any object")
    need(all(bool(v.isfinite()) for v in kept.values()), "a frozen assignment serves other pictures of the same size")


def _check_modes(trial: CheckCase) -> None:
    """In a mixture of modes, as training with frozen parts has it, predict changes nothing."""
    roots = modules_of(trial.detector)
    before = [(part, part.training) for root in roots for part in root.modules()]
    try:
        for number, (part, _) in enumerate(before):
            part.training = number % 3 != 1
        with trial.guarded("predict in training mode"):
            trial.predict(trial.images())
    finally:
        for part, mode in before:
            part.training = mode


def _check_sizes(trial: CheckCase) -> None:
    for size in ((67, 91), (33, 40)):
        images = trial.images(1, size).requires_grad_()
        with trial.guarded(f"pictures of {size[0]} x {size[1]}"):
            dense = trial.dense(images)
            trial.need(tuple(dense.size) == size, "Dense.size is height and width of the pictures")
            (gradient,) = torch.autograd.grad(dense.logit.square().mean(), images)
            trial.need(bool(gradient.any()), f"the gradient reaches pictures of {size[0]} x {size[1]}")
            trial.predict(images.detach())


def _check_refusals(trial: CheckCase) -> None:
    images, detector = trial.images(1), trial.detector
    lens = trial.lens(1)
    dense = trial.dense(images)

    def refused(what: str, call: Callable[[], object]) -> None:
        try:
            call()
        except ConfigError as error:
            trial.need("\n" not in str(error), f"{what}: refused in one line")
        except Exception as error:  # any other kind is the fault that is looked for
            trial.need(False, f"{what}: refused with ConfigError, not {type(error).__name__}")
        else:
            trial.need(False, f"{what}: refused with ConfigError")

    for what, bad in (
        ("greyscale images", images[:, :1]),
        ("a single image without a batch", images[0]),
        ("uint8 images", (images * 255).to(torch.uint8)),
        ("integer images", images.to(torch.int16)),
    ):
        refused(what, lambda bad=bad: detector.predict(bad, lens))  # type: ignore[misc]
        refused(what, lambda bad=bad: detector.dense(bad, lens))  # type: ignore[misc]
    if lens is not None:
        refused("images without an intrinsic", lambda: detector.predict(images))
        refused("intrinsics of another number", lambda: detector.predict(images, lens[:0]))
    refused("truth of another number of images", lambda: detector.assign(dense, trial.truth((1, 1))))
    (real,) = trial.truth((1,))
    wrong = Truth(real.label + len(detector.classes), real.box, real.solid, real.intrinsic)
    refused("labels that are none of the classes", lambda: detector.assign(dense, [wrong]))

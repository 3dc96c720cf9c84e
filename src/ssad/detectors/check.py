"""Conformance test of detectors: tries out all that attacks, training and evaluation rely on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ssad.core.detections import Assignment, Detections, Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.nuscenes_names import MMDET3D_ATTRIBUTES
from ssad.core.protocols import Detector
from ssad.core.seeding import seed32
from ssad.detectors.check_cases import BATCH, CheckCase, modules_of, typical_threshold
from ssad.detectors.check_geometry import check_boxes, check_places, check_solids
from ssad.detectors.check_gradients import check_loss_signs, check_ripples, check_slopes, check_small_changes

RTOL = 2e-3
MAX_DIFFERING = (
    0.01  # share of places that may differ in a batch: choices between values that are equal but for rounding
)


class DetectorCheckError(AssertionError):
    """A detector breaks promises; the message lists all of them, one a line."""


def check_detector(detector: Any, *, intrinsic: Tensor | None = None, size: tuple[int, int] = (96, 128)) -> None:
    """Check a detector against `ssad.core.protocols.Detector`.

    Args:
        detector: The detector.
        intrinsic: Camera matrix [3, 3] of the test images, for detectors of task "3d"; None for a focal length of
            0.8 times the width.
        size: Height and width of the random test images; other sizes follow.

    Raises:
        DetectorCheckError: The detector breaks promises; the message lists every one of them.
    """
    faults = find_faults(detector, intrinsic=intrinsic, size=size)
    if faults:
        raise DetectorCheckError(f"{len(faults)} broken promises:\n" + "\n".join(f"- {fault}" for fault in faults))


def find_faults(detector: Any, *, intrinsic: Tensor | None = None, size: tuple[int, int] = (96, 128)) -> list[str]:
    """Return the broken promises of a detector, a sentence each; an empty list if it keeps all."""
    return list(each_fault(detector, intrinsic=intrinsic, size=size))


def each_fault(detector: Any, *, intrinsic: Tensor | None = None, size: tuple[int, int] = (96, 128)) -> Iterator[str]:
    """Yield the faults of `find_faults` one by one, the cheap checks first, so that a caller can stop at the first.

    Args:
        detector: What may keep to `ssad.core.protocols.Detector`.
        intrinsic: [3, 3] of the camera, for detectors of task "3d"; by default a focal length of 0.8 times the width.
        size: Height and width of the pictures that are tried, pixels.

    Yields:
        A sentence for each broken promise.
    """
    if not isinstance(detector, Detector):
        required_members = ("name", "task", "classes", "predict", "dense", "assign", "losses")
        missing = [name for name in required_members if not hasattr(detector, name)]
        yield f"it lacks {', '.join(missing)} of ssad.core.protocols.Detector"
        return
    trial = CheckCase(detector, size, intrinsic)
    for run_check in (
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
        check_ripples,
        _check_modes,
        _check_sizes,
        _check_refusals,
    ):
        fault_count = len(trial.faults)
        name = run_check.__name__.strip("_").removeprefix("check_").replace("_", " ")
        with trial.record_errors(name), torch.random.fork_rng(devices=[]):
            # not the state that a caller left: where he has seeded with 0, a detector that does so too changes nothing
            torch.default_generator.manual_seed(seed32("check_detector", name))
            run_check(trial)
        yield from trial.faults[fault_count:]


# ---------------------------------------------------------------- the promises


def _check_names(trial: CheckCase) -> None:
    detector, need = trial.detector, trial.expect
    name: Any = detector.name
    need(isinstance(name, str) and name != "", "name is a text")
    task: Any = detector.task
    need(task in ("2d", "3d"), 'task is "2d" or "3d"')
    classes: Any = detector.classes
    are_names = (
        isinstance(classes, tuple) and len(classes) > 0 and all(isinstance(class_name, str) for class_name in classes)
    )
    need(are_names and len(set(classes)) == len(classes), "classes are a tuple of distinct names, at least one")
    trainable = [
        parameter_name
        for module in modules_of(detector)
        for parameter_name, parameter in module.named_parameters()
        if parameter.requires_grad
    ]
    if not any(module.training for module in modules_of(detector)):
        need(not trainable, f"parameters are frozen outside training; {trainable[:1]} has requires_grad")


def _check_dense(trial: CheckCase) -> None:
    need, images = trial.expect, trial.images()
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
    outputs = [dense.logit, dense.box, dense.place, *([] if dense.quality is None else [dense.quality])]
    need(all(bool(output.isfinite().all()) for output in outputs), "what Dense holds is finite")
    need(
        all(output.dtype in (torch.float32, torch.float64) for output in outputs),
        "what Dense holds is float32 or float64",
    )
    maps: Any = dense.maps
    are_lists = all(
        isinstance(tensors, list) and all(isinstance(tensor, Tensor) for tensor in tensors) for tensors in maps.values()
    )
    need(are_lists, "Dense.maps holds lists of tensors by name")
    need(
        all(feature.ndim == 4 and len(feature) == BATCH for feature in dense.features),
        "Dense.features are [B, K, h, w]",
    )
    heights = [feature.shape[2] for feature in dense.features]
    need(heights == sorted(heights, reverse=True), "Dense.features are ordered finest first")


def _check_gradient(trial: CheckCase) -> None:
    names = ["logit", "box"] + (["quality"] if trial.dense(trial.images(1)).quality is not None else [])
    for name in names:
        images = trial.images(2).requires_grad_()
        dense = trial.dense(images)
        value = getattr(dense, name)[0]
        if not trial.expect(value.requires_grad, f"Dense.{name} is differentiable to the images"):
            continue
        (gradient,) = torch.autograd.grad((value.double() ** 2).mean(), images)
        trial.expect(bool(gradient.isfinite().all()), f"the gradient of Dense.{name} is finite")
        limit = torch.tensor(dense.size[::-1], device=value.device)
        inner_pixels = ((dense.box[0, :, :2] > 0) & (dense.box[0, :, 2:] < limit)).any()  # all may be cut at the border
        reaches_image = bool(gradient[0].any()) or (name == "box" and not bool(inner_pixels))
        trial.expect(reaches_image, f"the gradient of Dense.{name} reaches the image")
        trial.expect(not bool(gradient[1].any()), f"Dense.{name} of an image does not depend on the others")


def _check_predict(trial: CheckCase) -> None:
    need, images = trial.expect, trial.images()
    need(len(trial.predict(images)) == BATCH, "predict answers for each image")
    threshold = typical_threshold(trial, images)
    batch_detections = trial.predict(images, threshold=threshold)
    any_detection = False
    for detections in batch_detections:
        any_detection |= len(detections.score) > 0
        for holds, promise in promises(
            detections, classes=len(trial.detector.classes), is_3d=trial.is_3d, min_score=threshold
        ):
            need(holds, promise)
    need(any_detection, "predict finds something when the threshold is low")
    for stricter, detections in zip(
        trial.predict(images, threshold=0.5 * (1 + threshold)), batch_detections, strict=True
    ):
        need(bool((stricter.score >= 0.5 * (1 + threshold)).all()), "no score lies under the threshold")
        need(len(stricter.score) <= len(detections.score), "a higher threshold finds no more")
    repeated = trial.predict(images, threshold=threshold)
    identical = all(
        torch.equal(first.score, second.score) and torch.equal(first.box, second.box)
        for first, second in zip(batch_detections, repeated, strict=True)
    )
    need(identical, "the same images give the same detections")
    need(len(trial.predict(images.double(), threshold=threshold)) == BATCH, "float64 images are taken")


def promises(
    detections: Detections, *, classes: int, is_3d: bool, min_score: float = 0.0
) -> Iterator[tuple[bool, str]]:
    """Yield the promises about the detections in one image, each with True if it is kept; shapes first."""
    count = len(detections.score)
    yield detections.score.shape == detections.label.shape == (count,), "score and label of Detections are [N]"
    yield detections.box.shape == (count, 4), "Detections.box is [N, 4]"
    yield (detections.solid is not None) == is_3d, 'Detections.solid is there for task "3d" and only then'
    yield not detections.label.is_floating_point(), "labels are whole numbers"
    yield (
        bool(((detections.score >= min_score) & (detections.score <= 1)).all()),
        "scores lie between the threshold and 1",
    )
    yield bool((detections.score.diff() <= 0).all()), "detections come best first"
    yield bool(((detections.label >= 0) & (detections.label < classes)).all()), "labels are within classes"
    is_ordered = bool((detections.box[:, 2:] >= detections.box[:, :2]).all()) and bool(detections.box.isfinite().all())
    yield is_ordered, "boxes are x1, y1, x2, y2, finite, x1 <= x2 and y1 <= y2"
    yield not detections.score.requires_grad and not detections.box.requires_grad, "predict keeps no gradient"
    if detections.solid is not None:
        yield from _solid_promises(detections.solid, count)


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
        # A detector may leave the velocity unknown, as NaN.
        yield finite or name == "velocity", f"Solids.{name} is finite"
    yield bool((solid.size_lhw > 0).all()), "sizes are above 0"
    valid_attribute = bool(((solid.attribute >= 0) & (solid.attribute < len(MMDET3D_ATTRIBUTES))).all())
    yield valid_attribute, "attributes are within ssad.core.nuscenes_names.MMDET3D_ATTRIBUTES"


def _check_batch(trial: CheckCase) -> None:
    images = trial.images()
    with torch.no_grad():
        batch_dense = trial.dense(images)
        reversed_dense = trial.dense(images.flip(0))
        single_denses = [trial.dense(images[image_index : image_index + 1]) for image_index in range(BATCH)]
    for name in ("logit", "quality", "box"):
        batch_values = getattr(batch_dense, name)
        if batch_values is None:
            continue
        for image_index in range(BATCH):
            for single_values in (
                getattr(single_denses[image_index], name)[0],
                getattr(reversed_dense, name)[BATCH - 1 - image_index],
            ):
                agrees = (
                    single_values.shape == batch_values[image_index].shape
                    and _share_of_differences(batch_values[image_index], single_values) <= MAX_DIFFERING
                )
                trial.expect(agrees, f"Dense.{name} of an image does not depend on its batch")
    threshold = typical_threshold(trial, images)
    batch_detections = trial.predict(images, threshold=threshold)
    for image_index in range(BATCH):
        (single_detections,) = trial.predict(images[image_index : image_index + 1], threshold=threshold)
        trial.expect(
            _detections_agree(batch_detections[image_index], single_detections),
            "detections of an image do not depend on its batch",
        )


def _share_of_differences(expected: Tensor, actual: Tensor) -> float:
    """Return the share of rows that differ by more than rounding."""
    differs = (expected - actual).abs() > RTOL * (1 + actual.abs())
    return float(differs.reshape(len(differs), -1).any(-1).double().mean()) if differs.numel() else 0.0


def _detections_agree(first: Detections, second: Detections) -> bool:
    """Return True if the best detections agree but for rounding; of nearly equal scores, any may suppress others."""
    count = min(10, len(first.score), len(second.score))
    if count == 0:
        return len(first.score) == len(second.score)
    if not torch.allclose(first.score[:count], second.score[:count], rtol=RTOL, atol=1e-5):
        return False
    is_near = (first.box[:count, None] - second.box).abs().amax(-1) < 2.0  # pixels
    is_match = is_near & (first.label[:count, None] == second.label)
    return float(is_match.any(1).double().mean()) > 0.6


def _check_losses(trial: CheckCase) -> None:
    need, detector = trial.expect, trial.detector
    images, truth = trial.images().requires_grad_(), trial.truth()
    dense = trial.dense(images)
    assignment: Assignment = detector.assign(dense, truth)
    count = dense.logit.shape[1]
    shapes_agree = assignment.label.shape == assignment.owner.shape == (BATCH, count)
    if not need(shapes_agree, "Assignment.label and owner are [B, P]"):
        return
    for labels, owner, image_truth in zip(assignment.label, assignment.owner, truth, strict=True):
        has_owner = owner >= 0
        need(bool(((labels >= -2) & (labels < len(detector.classes))).all()), "Assignment.label is -2, -1 or a class")
        need(
            bool((owner < len(image_truth.label)).all()) and bool((owner >= -1).all()),
            "Assignment.owner is -1 or an object",
        )
        need(torch.equal(has_owner, labels >= 0), "places with an owner have a class, others have none")
        need(
            bool((labels[has_owner] == image_truth.label[owner[has_owner]]).all()), "a place has the class of its owner"
        )
        need(not len(image_truth.label) or bool(has_owner.any()), "some place answers for a large object")
    tensors = (assignment.label, *assignment.extra.values())
    need(not any(value.requires_grad for value in tensors), "no gradient flows through assign")
    if not trial.has_losses:
        need(
            bool((detector.assign(dense, trial.truth((0, 0, 0))).owner == -1).all()), "without objects no place has one"
        )
        _expect_refusal(trial, "losses of a detector without any", lambda: detector.losses(dense, assignment))
        return
    batch_losses = detector.losses(dense, assignment)
    image_losses = detector.losses(dense, assignment, reduction="image")
    need(
        batch_losses.keys() == image_losses.keys() and bool(batch_losses),
        "losses have the same names for both reductions",
    )
    need(all(loss.shape == () for loss in batch_losses.values()), 'losses are scalars for "batch"')
    need(all(loss.shape == (BATCH,) for loss in image_losses.values()), 'losses are [B] for "image"')
    finite = all(bool(loss.isfinite().all()) for loss in (*batch_losses.values(), *image_losses.values()))
    # The second of the three test images has no objects.
    need(finite, "losses are finite, also for an image without objects")
    for name, values in (("batch", batch_losses), ("image", image_losses)):
        total = torch.stack([loss.sum() for loss in values.values()]).sum()
        (gradient,) = torch.autograd.grad(total, images, retain_graph=True)
        need(bool(gradient.isfinite().all()), f'the gradient of the "{name}" losses is finite')
        reached_images = gradient.flatten(1).any(1)
        images_with_objects = [image_index for image_index, image_truth in enumerate(truth) if len(image_truth.label)]
        need(
            bool(reached_images[images_with_objects].all()),
            f'the gradient of the "{name}" losses reaches every image with objects',
        )
    for image_index in range(BATCH):
        with torch.no_grad():
            single_dense = trial.dense(images[image_index : image_index + 1])
            single_losses = detector.losses(
                single_dense, detector.assign(single_dense, truth[image_index : image_index + 1])
            )
        for name, value in single_losses.items():
            agrees = torch.allclose(value, image_losses[name][image_index].detach(), rtol=10 * RTOL, atol=1e-4)
            need(agrees, f'"image" losses are those of each image alone ({name})')
    with torch.no_grad():
        fresh_dense = trial.dense(images)
        empty_losses = detector.losses(fresh_dense, detector.assign(fresh_dense, trial.truth((0, 0, 0))))
        darker_dense = trial.dense((images * 0.9).clamp(0, 1))
        darker_losses = detector.losses(darker_dense, assignment)
    need(all(bool(loss.isfinite()) for loss in empty_losses.values()), "losses are finite without any object")
    need(
        all(bool(loss.isfinite()) for loss in darker_losses.values()),
        "a frozen assignment serves other pictures of the same size",
    )


def _check_modes(trial: CheckCase) -> None:
    """Check that predict changes nothing in a mixture of modes, as in training with frozen parts."""
    modules = modules_of(trial.detector)
    modes = [(submodule, submodule.training) for module in modules for submodule in module.modules()]
    try:
        for index, (submodule, _) in enumerate(modes):
            submodule.training = index % 3 != 1
        with trial.record_errors("predict in training mode"):
            trial.predict(trial.images())
    finally:
        for submodule, mode in modes:
            submodule.training = mode


def _check_sizes(trial: CheckCase) -> None:
    for size in ((67, 91), (33, 40)):
        images = trial.images(1, size).requires_grad_()
        with trial.record_errors(f"pictures of {size[0]} x {size[1]}"):
            dense = trial.dense(images)
            trial.expect(tuple(dense.size) == size, "Dense.size is height and width of the pictures")
            (gradient,) = torch.autograd.grad(dense.logit.square().mean(), images)
            trial.expect(bool(gradient.any()), f"the gradient reaches pictures of {size[0]} x {size[1]}")
            trial.predict(images.detach())


def _expect_refusal(trial: CheckCase, description: str, call: Callable[[], object]) -> None:
    """Record a fault unless a call raises ConfigError of one line."""
    try:
        call()
    except ConfigError as error:
        trial.expect("\n" not in str(error), f"{description}: refused in one line")
    except Exception as error:  # any other exception is the fault in question
        trial.expect(False, f"{description}: refused with ConfigError, not {type(error).__name__}")
    else:
        trial.expect(False, f"{description}: refused with ConfigError")


def _check_refusals(trial: CheckCase) -> None:
    images, detector = trial.images(1), trial.detector
    intrinsic = trial.intrinsics(1)
    dense = trial.dense(images)

    expect_refusal = partial(_expect_refusal, trial)
    for description, bad_images in (
        ("greyscale images", images[:, :1]),
        ("a single image without a batch", images[0]),
        ("uint8 images", (images * 255).to(torch.uint8)),
        ("integer images", images.to(torch.int16)),
    ):
        expect_refusal(description, lambda bad_images=bad_images: detector.predict(bad_images, intrinsic))  # type: ignore[misc]
        expect_refusal(description, lambda bad_images=bad_images: detector.dense(bad_images, intrinsic))  # type: ignore[misc]
    if intrinsic is not None:
        expect_refusal("images without an intrinsic", lambda: detector.predict(images))
        expect_refusal("intrinsics of another number", lambda: detector.predict(images, intrinsic[:0]))
    expect_refusal("truth of another number of images", lambda: detector.assign(dense, trial.truth((1, 1))))
    (valid_truth,) = trial.truth((1,))
    invalid_truth = Truth(
        valid_truth.label + len(detector.classes), valid_truth.box, valid_truth.solid, valid_truth.intrinsic
    )
    expect_refusal("labels that are none of the classes", lambda: detector.assign(dense, [invalid_truth]))

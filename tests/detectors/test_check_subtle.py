"""The conformance test names detectors that are subtly wrong: in gradients, losses, places, boxes, conventions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Literal

import pytest
import torch
from helpers.mono3d import TINY, TINY_PGD, lively, perfect, some_truth
from helpers.quick import others_slow
from torch import Tensor

from ssad.core.detections import Assignment, Dense, Detections, Solids, Truth
from ssad.detectors import make_detector
from ssad.detectors.check import find_faults
from ssad.detectors.check_cases import CheckCase
from ssad.detectors.check_geometry import check_boxes, check_places, check_solids
from ssad.detectors.check_gradients import check_loss_signs, check_ripples, check_slopes, check_small_changes
from ssad.detectors.mono3d.detector import Mono3D
from ssad.detectors.yolo.detector import Yolo
from ssad.detectors.yolov5 import YOLOV5N

Reduction = Literal["batch", "image"]
SIZE = (48, 64)
SHIPPED = ["yolov5n", "yolov3-tiny", "fcos3d-light", "pgd-det-light"]


@pytest.mark.parametrize("name", others_slow(["yolov5n", "fcos3d-light"], ["yolov5n"]))  # all in the slow test below
def test_the_shipped_ones_keep_every_promise(name: str) -> None:
    detector = make_detector(name)
    if detector.task == "3d":
        detector.config = replace(detector.config, input_width=128)  # in place of 800, to be quick
    assert find_faults(detector, size=SIZE) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("weights", [None, "random"])
def test_the_shipped_ones_keep_every_promise_as_they_are(name: str, weights: str | None) -> None:
    assert find_faults(make_detector(name, weights=weights), size=(48, 128)) == []


class Wrapped:
    """Hands everything on to a detector, with places to go wrong."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner
        self.name, self.task, self.classes = inner.name, inner.task, inner.classes

    def see(self, images: Tensor) -> Tensor:
        """Changes the pictures before the detector sees them."""
        return images

    def change(self, dense: Dense) -> Dense:
        """Changes what `dense` gives."""
        return dense

    def alter(self, found: Detections) -> Detections:
        """Changes what `predict` gives."""
        return found

    def sum(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        """Changes what `losses` gives."""
        return values

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        return self.change(self.inner.dense(self.see(images), intrinsic))

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        found = self.inner.predict(self.see(images), intrinsic, threshold=threshold)
        return [self.alter(one) for one in found]

    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        found: Assignment = self.inner.assign(dense, truth)
        return found

    def losses(self, dense: Dense, assignment: Assignment, *, reduction: Reduction = "batch") -> dict[str, Tensor]:
        return self.sum(self.inner.losses(dense, assignment, reduction=reduction))


def is_picture(images: Tensor) -> bool:
    """Whether a detector would take it."""
    return images.ndim == 4 and images.shape[1] == 3 and images.is_floating_point()


# ---------------------------------------------------------------- gradients


class WithTheGradientTurned(Wrapped):
    def see(self, images: Tensor) -> Tensor:
        return 2 * images.detach() - images if is_picture(images) else images


class WithATenthOfTheGradient(Wrapped):
    def see(self, images: Tensor) -> Tensor:
        return 0.1 * images + 0.9 * images.detach() if is_picture(images) else images


class WithTheLogitsGradientTurned(Wrapped):
    def change(self, dense: Dense) -> Dense:
        return replace(dense, logit=2 * dense.logit.detach() - dense.logit)


class WithTwoChannelsDetached(Wrapped):
    def see(self, images: Tensor) -> Tensor:
        return torch.cat([images[:, :1], images[:, 1:].detach()], 1) if is_picture(images) else images


class WithObjectnessLossDetached(Wrapped):
    def sum(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        return {**values, "obj": values["obj"].detach()}


class WithClassLossDetached(Wrapped):
    def sum(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        return {**values, "cls": values["cls"].detach()}


class WithOneLossTurned(Wrapped):
    def sum(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        return {**values, "obj": -values["obj"]}


class WithLossesTurned(Wrapped):
    def sum(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        return {name: -value for name, value in values.items()}


class WithLossesTurnedAndLifted(Wrapped):
    def sum(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        return {name: 100 - value for name, value in values.items()}


class WithFourBits(Wrapped):
    def see(self, images: Tensor) -> Tensor:
        coarse = (images * 15).round() / 15 if is_picture(images) else images
        return images + (coarse - images).detach() if is_picture(images) else images


class WithThreeBitsCutOff(WithFourBits):
    def see(self, images: Tensor) -> Tensor:
        coarse = (images * 8).floor() / 8 if is_picture(images) else images
        return images + (coarse - images).detach() if is_picture(images) else images


# ---------------------------------------------------------------- places and boxes


class WithTheBestPlacesOnly(Wrapped):
    """By the first picture of the batch."""

    count = 30

    def change(self, dense: Dense) -> Dense:
        assert dense.quality is not None
        rows = dense.quality[0].topk(self.count).indices.sort().values
        self.rows, self.whole = rows, dense
        return replace(
            dense,
            logit=dense.logit[:, rows],
            quality=dense.quality[:, rows],
            box=dense.box[:, rows],
            place=dense.place[rows],
            stride=dense.stride[rows],
            level=dense.level[rows],
        )


class WithHolesInTheGrid(WithTheBestPlacesOnly):
    """The same ones in every picture."""

    def change(self, dense: Dense) -> Dense:
        assert dense.quality is not None
        ranked = replace(dense, quality=torch.linspace(1, 0, dense.logit.shape[1]).expand(dense.quality.shape))
        found = super().change(ranked)
        return replace(found, quality=dense.quality[:, self.rows])


class WithPredictionsAside(Wrapped):
    def alter(self, found: Detections) -> Detections:
        return replace(found, box=found.box + 10)


class WithSharesInDense(Wrapped):
    def change(self, dense: Dense) -> Dense:
        height, width = dense.size
        return replace(dense, box=dense.box / dense.box.new_tensor([width, height, width, height]))


class WithSharesAlone(WithSharesInDense):
    def alter(self, found: Detections) -> Detections:
        return replace(found, box=found.box / found.box.new_tensor([64, 48, 64, 48]))


class WithPixelsOfTheInput(Wrapped):
    """As if the picture had been resized to thrice its size."""

    def change(self, dense: Dense) -> Dense:
        return replace(dense, box=3 * dense.box)

    def alter(self, found: Detections) -> Detections:
        return replace(found, box=3 * found.box)


class WithYBeforeX(Wrapped):
    def change(self, dense: Dense) -> Dense:
        return replace(dense, box=dense.box[..., [1, 0, 3, 2]])

    def alter(self, found: Detections) -> Detections:
        return replace(found, box=found.box[..., [1, 0, 3, 2]])


SLOPE = "has the sign and roughly the size of its finite differences"
CONVENTION = "these fit better if read otherwise"


class WithRipples(Wrapped):
    """The picture shifted by a hundredth at most, to and fro a thousand times between black and white."""

    amplitude, frequency = 0.01, 1000.0

    def see(self, images: Tensor) -> Tensor:
        return images + self.amplitude * torch.sin(self.frequency * images) if is_picture(images) else images


class WithFineRipples(WithRipples):
    amplitude, frequency = 2.0 / 2300.0, 2300.0


class WithRoundedLogits(Wrapped):
    """Logits in whole numbers, as integer arithmetic gives them."""

    def change(self, dense: Dense) -> Dense:
        return replace(dense, logit=dense.logit.round())


SUBTLE: dict[str, tuple[Callable[[CheckCase], None], str, type[Wrapped], str]] = {
    f"{kind.__name__}-{name}": (part, name, kind, promise)
    for part, name, kind, promise in (
        (check_slopes, "yolov5n", WithTheGradientTurned, f"the gradient of Dense.logit {SLOPE} (these are -"),
        (check_slopes, "fcos", WithTheGradientTurned, f'the gradient of losses["size"] {SLOPE} (these are -'),
        (check_slopes, "yolov3-tiny", WithATenthOfTheGradient, f'the gradient of losses["obj"] {SLOPE}'),
        (check_slopes, "yolov3-tiny", WithTheLogitsGradientTurned, f"the gradient of Dense.logit {SLOPE} (these are -"),
        (
            check_slopes,
            "yolov5n",
            WithTwoChannelsDetached,
            'the gradient of losses["box"] reaches all three colour channels',
        ),
        (check_slopes, "yolov5n", WithObjectnessLossDetached, 'the gradient of losses["obj"] reaches the image'),
        (check_slopes, "fcos", WithClassLossDetached, 'the gradient of losses["cls"] reaches the image'),
        (check_loss_signs, "yolov5n", WithOneLossTurned, 'losses["obj"] rises above 0 when the truth is wrong'),
        (check_loss_signs, "fcos", WithLossesTurned, 'losses["size"] rises above 0 when the truth is wrong'),
        (
            check_loss_signs,
            "yolov3-tiny",
            WithLossesTurnedAndLifted,
            "the losses are lower for the classes that Dense.logit favours",
        ),
        (check_small_changes, "yolov5n", WithFourBits, "the image is not quantised inside"),
        (check_small_changes, "fcos", WithThreeBitsCutOff, "gradient masking by rounding"),
        (check_slopes, "yolov5n", WithRoundedLogits, "gradient masking: rounding or a detached tensor cuts it off"),
        (check_ripples, "yolov5n", WithRipples, "gradient masking by rippling"),
        (check_ripples, "yolov5n", WithFineRipples, "gradient masking by rippling"),
        (check_places, "yolov5n", WithTheBestPlacesOnly, "Dense.place depends on the size of the pictures alone"),
        (
            check_places,
            "yolov5n",
            WithHolesInTheGrid,
            "Dense has places all over the picture, not only the best; level(s) [0]",
        ),
        (check_boxes, "yolov5n", WithPredictionsAside, "the boxes of predict are among those of dense"),
        (check_boxes, "fcos", WithPredictionsAside, "the boxes of predict are among those of dense"),
        (check_boxes, "yolov3-tiny", WithSharesInDense, "Dense.box is in pixels of the picture"),
        (check_boxes, "yolov3-tiny", WithSharesAlone, "Dense.box is in pixels of the picture"),
        (check_boxes, "yolov3-tiny", WithPixelsOfTheInput, "Dense.box is in pixels of the picture"),
        (check_boxes, "fcos", WithYBeforeX, "Dense.box is x1, y1, x2, y2"),
        (check_boxes, "yolov5n", WithYBeforeX, "Dense.box is x1, y1, x2, y2"),
    )
}


@cache
def make(name: str) -> Any:
    """A real detector to wrap: trained ones of 2D boxes, of 3D boxes one whose layers all do something."""
    return lively(TINY) if name == "fcos" else make_detector(name)


LONG = ("WithTheGradientTurned-fcos", "WithATenthOfTheGradient-yolov3-tiny")


@pytest.mark.parametrize("case", others_slow(SUBTLE, [case for case in SUBTLE if case not in LONG]))
def test_it_names_what_is_wrong(case: str) -> None:
    part, name, kind, promise = SUBTLE[case]
    trial = CheckCase(kind(make(name)), SIZE, None)
    part(trial)
    assert any(promise in fault for fault in trial.faults), trial.faults


class WithEverythingWrong(WithFourBits, WithOneLossTurned, WithTheLogitsGradientTurned):
    """In each way that a part of the test is for."""

    def change(self, dense: Dense) -> Dense:
        dense = super().change(dense)
        return replace(dense, box=dense.box / 100, place=0.5 * dense.place)


def test_all_parts_are_tried() -> None:
    faults = find_faults(WithEverythingWrong(make("yolov5n")), size=SIZE)
    for promise in (
        f"the gradient of Dense.logit {SLOPE}",
        'losses["obj"] rises above 0',
        "the image is not quantised inside",
        "Dense has places all over the picture",
        "Dense.box is in pixels of the picture",
        "the boxes of predict are among those of dense",
    ):
        assert any(promise in fault for fault in faults), (promise, faults)
    faults = find_faults(WithAnotherConvention(make("fcos"), bottom), size=SIZE)
    assert len(faults) == 1, faults
    assert faults[0].endswith(f"{CONVENTION}: centre of the bottom face")


def test_a_wrapper_that_changes_nothing_keeps_every_promise() -> None:
    assert find_faults(Wrapped(make("yolov5n")), size=SIZE) == []


@pytest.mark.parametrize("seed", [3, 5])
def test_a_target_without_gradient_is_no_fault(seed: int) -> None:
    """Objectness of fresh weights falls along its gradient, or rises 8 times as fast: its target moves as well."""
    trial = CheckCase(Yolo(replace(YOLOV5N, width=0.125), ("car", "person"), seed=seed), (96, 128), None)
    check_slopes(trial)
    assert trial.faults == []


# ---------------------------------------------------------------- conventions of solids


def bottom(solid: Solids) -> Solids:
    """The centre of the bottom face in place of that of gravity, as KITTI has it."""
    down = torch.zeros_like(solid.centre)
    down[:, 1] = solid.size_lhw[:, 1] / 2
    return replace(solid, centre=solid.centre + down)


def kitti(solid: Solids) -> Solids:
    """The centre of the bottom face; height, width, length."""
    return replace(bottom(solid), size_lhw=solid.size_lhw[:, [1, 2, 0]])


CONVENTIONS: dict[str, tuple[Callable[[Solids], Solids], str]] = {
    "sign": (lambda solid: replace(solid, yaw=-solid.yaw), "yaw of the opposite sign"),
    "quarter": (lambda solid: replace(solid, yaw=solid.yaw + math.pi / 2), "yaw 90 degrees too large"),
    "wlh": (lambda solid: replace(solid, size_lhw=solid.size_lhw[:, [2, 0, 1]]), "size as width, length, height"),
    "hwl": (lambda solid: replace(solid, size_lhw=solid.size_lhw[:, [1, 2, 0]]), "size as height, width, length"),
    "bottom": (bottom, "centre of the bottom face"),
    "kitti": (kitti, "size as height, width, length and centre of the bottom face"),
}


class WithAnotherConvention(Wrapped):
    """Predicts in it; what `assign` takes is as documented."""

    def __init__(self, inner: Any, convert: Callable[[Solids], Solids]) -> None:
        super().__init__(inner)
        self.convert = convert

    def alter(self, found: Detections) -> Detections:
        assert found.solid is not None
        return replace(found, solid=self.convert(found.solid))


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_it_names_the_convention_by_the_boxes(convention: str) -> None:
    convert, reading = CONVENTIONS[convention]
    trial = CheckCase(WithAnotherConvention(make("fcos"), convert), SIZE, None)
    check_solids(trial)
    assert len(trial.faults) == 1, trial.faults
    assert trial.faults[0].endswith(f"{CONVENTION}: {reading}")


class ThatKnowsTheTruth:
    """Finds five solids, whatever the picture shows, and 2D boxes that are larger than their hulls."""

    task: Literal["2d", "3d"] = "3d"
    size = (192, 320)

    def __init__(self, convert: Callable[[Solids], Solids]) -> None:
        self.inner = Mono3D(TINY_PGD).double()
        self.name, self.classes, self.convert = "knowing", self.inner.classes, convert
        truth = some_truth(size=self.size, focal=0.8 * self.size[1])
        self.told, _ = perfect(self.inner, truth, self.size)
        for maps in self.told.maps["bbox_preds"]:
            maps[:, 9:] *= 1.25

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        maps = {name: [m.expand(len(images), *m.shape[1:]) for m in levels] for name, levels in self.told.maps.items()}
        assert self.told.quality is not None
        logit, quality = (v.expand(len(images), *v.shape[1:]) for v in (self.told.logit, self.told.quality))
        return replace(self.told, logit=logit, quality=quality, maps=maps)

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        found = self.inner.select(self.dense(images, intrinsic), threshold or 0.0)
        return [replace(one, solid=self.convert(one.solid)) for one in found if one.solid is not None]

    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        return self.inner.assign(dense, truth)

    def losses(self, dense: Dense, assignment: Assignment, *, reduction: Reduction = "batch") -> dict[str, Tensor]:
        return self.inner.losses(dense, assignment, reduction=reduction)


@pytest.mark.parametrize("convention", [None, "sign", "quarter", "wlh", "hwl", "bottom"])
def test_it_names_the_convention_by_the_losses(convention: str | None) -> None:
    """Of a detector whose 2D boxes are predicted, not hulls."""
    convert, reading = CONVENTIONS[convention] if convention is not None else (lambda solid: solid, "")
    trial = CheckCase(ThatKnowsTheTruth(convert), ThatKnowsTheTruth.size, None)
    check_solids(trial)
    assert len(trial.faults) == (convention is not None), trial.faults
    assert all(fault.endswith(f"{CONVENTION}: {reading}") for fault in trial.faults), trial.faults


@pytest.mark.parametrize("seed", [3, 6])
def test_weights_that_are_not_trained_are_no_other_convention(seed: int) -> None:
    trial = CheckCase(lively(TINY_PGD, seed=seed), (96, 128), None)
    check_solids(trial)
    assert trial.faults == []

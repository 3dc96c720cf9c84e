"""Models of the package `ultralytics` (YOLOv8, YOLO11, its anchor-free YOLOv3u and YOLOv5u, ...) as detectors.

LICENCE: `ultralytics` is AGPL-3.0. It is not a dependency of SSAD and is imported only when a detector of this module
is made; whoever installs it, and passes on work that uses it, answers for its licence. Nothing of it is copied here:
this module calls its published interface, and decoding, assignment and losses are written from the papers (Feng et al.
2021, TOOD; Li et al. 2020, generalised focal loss; Zheng et al. 2020, CIoU) and the published hyperparameters. Tried
with 8.4.190.

Importing the package has side effects: it looks up host names, writes a settings file, sets thread counts and
environment variables, changes how numpy and torch print, and replaces torch.save. Here it is imported offline, with its
settings in a temporary folder, and all of that is put back.
"""

from __future__ import annotations

import atexit
import importlib
import os
import shutil
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ssad.core.checkpoints import fit_state, load_weights
from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.errors import ConfigError, install_extra
from ssad.detectors.adapters.common import (
    Adapter,
    check_images,
    check_truth,
    label_owned,
    resize_and_pad,
    size_inside,
    sums,
)
from ssad.detectors.yolo.assign import Targets
from ssad.detectors.yolo.classes import COCO
from ssad.detectors.yolo.decode import select
from ssad.detectors.yolo.loss import ciou

GREY = 114 / 255
NMS_IOU, MOST, THRESHOLD = 0.7, 300, 0.25  # its published defaults for predictions
BOX_GAIN, CLASS_GAIN, DFL_GAIN = 7.5, 0.5, 1.5  # and for training
TOP, ALPHA, BETA = 10, 0.5, 6.0  # of the task-aligned assignment
INSTALL = f"{install_extra('ultralytics')} (licence AGPL-3.0; not a dependency of SSAD)"


def ultralytics_detector(
    model: str,
    *,
    classes: Sequence[str] = COCO,
    weights: str | Path | None = None,
    input_width: int | None = None,
    seed: int = 0,
) -> Ultralytics:
    """A model by the name of one of the package's own descriptions, such as yolov8n or yolov5nu.

    Args:
        model: Name of the description.
        classes: Names of the classes.
        weights: A file as `load_weights` takes it, including .pt files of the package (only their tensors are read, by
            their names; nothing in them runs); None: fresh ones.
        input_width: Width to which pictures are resized inside; None: they are not.
        seed: Of fresh weights.

    Raises:
        ConfigError: The package is not installed, or knows no such detection model.
        FormatError: The weights cannot be read, or do not fit.
    """
    package = load_package()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            network = package.DetectionModel(f"{model.removesuffix('.yaml')}.yaml", nc=len(classes), verbose=False)
        except Exception as error:  # what the package raises for an unknown name differs between versions
            text = " ".join(str(error).split())[:100]
            raise ConfigError(f"ultralytics: no detection model '{model}' could be built: {text}") from None
    detector = Ultralytics(network, classes, name=f"ultralytics:{model}", input_width=input_width)
    with torch.no_grad():
        detector.dense(torch.zeros(1, 3, 64, 64))  # heads of other kinds are refused here
    if weights is not None:
        state = load_weights(weights)
        named = {key if key.startswith("model.") else f"model.{key}": value for key, value in state.items()}
        fit_state(detector, {f"network.{key}": value for key, value in named.items()}, weights)
    return detector


def load_package() -> Any:
    """The package's module of networks, imported offline; what the import changes is restored.

    Raises:
        ConfigError: The package is not installed, or does not import.
    """
    import cv2

    held = dict(os.environ)
    folder = tempfile.mkdtemp(prefix="ssad-ultralytics-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    threads, cv_threads, numpy_print = torch.get_num_threads(), cv2.getNumThreads(), np.get_printoptions()
    torch_print = dict(vars(torch._tensor_str.PRINT_OPTS))
    save, filters = torch.save, list(warnings.filters)
    os.environ |= {"YOLO_OFFLINE": "true", "YOLO_VERBOSE": "false", "YOLO_CONFIG_DIR": folder}
    os.environ.setdefault("OMP_NUM_THREADS", str(threads))
    try:
        return importlib.import_module("ultralytics.nn.tasks")
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError) and str(error.name).split(".")[0] == "ultralytics"
        why = "the package is not installed" if missing else f"the package does not import: {error}"
        raise ConfigError(f"ultralytics: {why}; {INSTALL}") from None
    finally:
        os.environ.clear()
        os.environ.update(held)
        torch.set_num_threads(threads)
        cv2.setNumThreads(cv_threads)
        np.set_printoptions(**numpy_print)
        vars(torch._tensor_str.PRINT_OPTS).update(torch_print)
        torch.save = save
        warnings.filters[:] = filters  # type: ignore[index]


class Ultralytics(Adapter):
    """An anchor-free detection network of the package as a detector. Starts frozen and in eval mode.

    There is no objectness: `Dense.quality` is None, and an attack on objectness takes the largest class score. Places
    are the cells of all levels, finest first. maps: scores [B, C, P], boxes [B, 4 * bins, P], as the head gives them.
    Pictures are padded at the right and bottom with grey to a multiple of the coarsest stride.
    """

    def __init__(
        self,
        network: nn.Module,
        classes: Sequence[str],
        *,
        name: str = "ultralytics",
        input_width: int | None = None,
        threshold: float = THRESHOLD,
    ) -> None:
        strides = getattr(network, "stride", None)
        if not isinstance(strides, Tensor) or not len(classes) or len(set(classes)) != len(classes):
            raise ConfigError(f"{name}: needs a detection network with strides, and distinct names of classes")
        super().__init__(name, classes, threshold)
        self.network = network
        self.strides = tuple(int(stride) for stride in strides)
        self.input_width = input_width
        self.requires_grad_(False).eval()

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Raw outputs, differentiable with respect to the images.

        Args:
            images: [B, 3, H, W] in [0, 1].
            intrinsic: Not used.

        Raises:
            ConfigError: The images have another shape or type, or the head's output does not have the form of YOLOv8's
                and YOLO11's.
        """
        size = check_images(self.name, images)
        inside, scale = size_inside(size, self.input_width), self._scale(size, images.device)
        images = images.to(next(self.network.parameters()).dtype)
        step = max(32, *self.strides)
        scores, boxes, features = self._heads(resize_and_pad(images, inside, multiple=step, grey=GREY))
        place, stride, level = self._places(features)
        distance = _expectation(boxes) * stride
        middle = place.T
        low, high = middle - distance[:, :2], middle + distance[:, 2:]
        return Dense(
            logit=scores.transpose(1, 2),
            quality=None,
            box=torch.cat((low, high), 1).transpose(1, 2) / scale,
            place=place / scale[:2],
            stride=stride / scale[0],
            level=level,
            maps={"scores": [scores], "boxes": [boxes]},
            features=tuple(features),
            size=size,
        )

    def choose(self, dense: Dense, least: float) -> list[Detections]:
        """Score sigmoid(class), suppressed within a class."""
        return select(dense.logit.sigmoid(), dense.box, threshold=least, iou=NMS_IOU, limit=MOST, size=dense.size)

    @torch.no_grad()
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Task-aligned target assignment (TOOD), which depends on the predictions of the network.

        Of the cells inside an object, the ten with the largest score^0.5 * CIoU^6 are assigned to it; a cell that
        several objects claim goes to the one it overlaps most. extra: box [B, P, 4] in pixels of the picture; weight
        [B, P]: target score of each place.
        """
        scale = self._scale(dense.size, dense.box.device).to(dense.box)
        targets = check_truth(self.name, truth, len(dense.box), scale=scale, classes=len(self.classes))
        rows = [self._assign_one(dense, targets, k, scale) for k in range(len(truth))]
        label, owner, box, weight = (torch.stack(column) for column in zip(*rows, strict=True))
        return Assignment(label, owner, tuple(truth), {"box": box / scale, "weight": weight})

    def _assign_one(
        self, dense: Dense, targets: Targets, k: int, scale: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Label, owner, box and weight of the places of image k."""
        real = int(targets.real[k].sum())
        predicted, place = dense.box[k] * scale, dense.place * scale[:2]
        none = torch.full(place.shape[:1], -1, dtype=torch.int64, device=place.device)
        if not real:
            return none, none, torch.zeros_like(predicted), torch.zeros_like(predicted[:, 0])
        box, kind, crowd = targets.box[k, :real], targets.label[k, :real], targets.crowd[k, :real]
        inside = torch.cat((place[:, None] - box[:, :2], box[:, 2:] - place[:, None]), -1).amin(-1) > 1e-9
        pairs = (len(place), real, 4)
        overlap = (
            ciou(predicted[:, None].expand(pairs).reshape(-1, 4), box.expand(pairs).reshape(-1, 4))
            .clamp(min=0)
            .view(len(place), real)
        )
        overlap = overlap * inside
        aligned = dense.logit[k].sigmoid()[:, kind] ** ALPHA * overlap**BETA
        best = aligned.topk(min(TOP, len(place)), 0).indices
        wanted = torch.zeros_like(inside).scatter_(0, best, True) & inside
        contested = torch.where(wanted, overlap, -1.0)
        contested[wanted.sum(1) > 1] = overlap[wanted.sum(1) > 1]  # the most overlap of all, as the source does
        owner = torch.where(wanted.any(1), contested.argmax(1), -1)
        index = owner.clamp(min=0)
        mine = functional.one_hot(index, real).bool() & (owner >= 0)[:, None]
        strength = torch.where(mine, aligned, 0.0)
        norm = torch.where(mine, overlap, 0.0).amax(0) / (strength.amax(0) + 1e-9)
        weight = (strength * norm).amax(1)
        label, owner = label_owned(owner, kind, crowd)
        found = label >= 0
        return label, owner, torch.where(found[:, None], box[index], 0.0), torch.where(found, weight, 0.0)

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """Training losses with the gains of the source, each divided by the sum of the target scores (at least 1).

        The source multiplies by the batch size as well; this does not.

        Returns:
            Three losses. box: 7.5 * (1 - CIoU), weighted by the target scores; cls: 0.5 * cross-entropy; dfl: 1.5 *
            distribution focal loss, weighted by the target scores.

        Raises:
            ConfigError: The assignment was made for pictures of another number or size.
        """
        if assignment.label.shape != dense.box.shape[:2]:
            raise ConfigError(f"{self.name}: the assignment was made for pictures of another number or size")
        images = len(dense.box)
        scale = self._scale(dense.size, dense.box.device).to(dense.box)
        image, place = (assignment.label >= 0).nonzero(as_tuple=True)
        weight = assignment.extra["weight"].to(dense.box)[image, place]
        target = assignment.extra["box"].to(dense.box)[image, place] * scale
        predicted = dense.box[image, place] * scale
        wanted = torch.zeros_like(dense.logit)
        wanted[image, place, assignment.label[image, place]] = weight
        every = functional.binary_cross_entropy_with_logits(dense.logit, wanted, reduction="none").sum(-1)
        bins = dense.maps["boxes"][0].transpose(1, 2)[image, place]
        stride = dense.stride[place, None] * scale[0]
        middle = dense.place[place] * scale[:2]
        sides = torch.cat((middle - target[:, :2], target[:, 2:] - middle), 1) / stride
        parts = {
            "box": sums(BOX_GAIN * (1 - ciou(predicted, target)) * weight, image, images),
            "cls": CLASS_GAIN * torch.where(assignment.label != -2, every, 0.0).sum(1),
            "dfl": sums(DFL_GAIN * _distribution_loss(bins, sides) * weight, image, images),
        }
        total = sums(weight, image, images)
        if reduction == "image":
            return {name: part / total.clamp(min=1) for name, part in parts.items()}
        return {name: part.sum() / total.sum().clamp(min=1) for name, part in parts.items()}

    def _heads(self, images: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Raw class maps [B, C, P], raw distributions of the sides [B, 4 * bins, P], and the maps before the head."""
        answer: Any = self.network(images)
        if isinstance(answer, tuple) and len(answer) == 2:
            answer = answer[1]
        count = len(self.classes)
        if isinstance(answer, dict) and {"scores", "boxes", "feats"} <= answer.keys():
            scores, boxes, features = answer["scores"], answer["boxes"], list(answer["feats"])
        elif isinstance(answer, list) and all(isinstance(part, Tensor) and part.ndim == 4 for part in answer):
            whole = torch.cat([part.flatten(2) for part in answer], 2)
            boxes, scores = whole[:, :-count], whole[:, -count:]
            features = answer
        else:
            raise ConfigError(f"{self.name}: its head answers in a way that is not known here; use YOLOv8 or YOLO11")
        cells = sum(part.shape[2] * part.shape[3] for part in features)
        if scores.shape[1:] != (count, cells) or boxes.shape[1] % 4 or boxes.shape[1] < 8:
            raise ConfigError(f"{self.name}: its head has other outputs than those of YOLOv8 and YOLO11")
        return scores.float() if scores.dtype is not torch.float64 else scores, boxes.to(scores.dtype), features

    def _places(self, features: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Middle [P, 2] (x, y), stride [P] and level [P] of the cells, in the network's input."""
        place, stride, level = [], [], []
        for k, (part, step) in enumerate(zip(features, self.strides, strict=True)):
            rows, columns = part.shape[2:]
            y = (torch.arange(rows, device=part.device) + 0.5) * step
            x = (torch.arange(columns, device=part.device) + 0.5) * step
            place.append(torch.stack((x.expand(rows, columns), y[:, None].expand(rows, columns)), -1).reshape(-1, 2))
            stride.append(torch.full((rows * columns,), float(step), device=part.device))
            level.append(torch.full((rows * columns,), k, device=part.device))
        return torch.cat(place), torch.cat(stride), torch.cat(level)

    def _scale(self, size: tuple[int, int], device: torch.device) -> Tensor:
        height, width = size_inside(size, self.input_width)
        x, y = width / size[1], height / size[0]
        return torch.tensor([x, y, x, y], device=device)


def _expectation(boxes: Tensor) -> Tensor:
    """Distances [B, 4, P] in strides from their distributions [B, 4 * bins, P] (generalised focal loss, eq. 5)."""
    split = boxes.unflatten(1, (4, -1))  # type: ignore[no-untyped-call]
    values = torch.arange(split.shape[2], device=boxes.device, dtype=boxes.dtype)
    result: Tensor = (split.softmax(2) * values[:, None]).sum(2)
    return result


def _distribution_loss(bins: Tensor, sides: Tensor) -> Tensor:
    """Distribution focal loss [M] (the same, eq. 6), mean over the four sides: bins [M, 4 * n], sides [M, 4]."""
    count = bins.shape[1] // 4
    sides = sides.clamp(0, count - 1 - 0.01)
    low = sides.floor()
    share = low + 1 - sides
    logs = bins.view(len(bins), 4, count).log_softmax(-1)
    at = low.long()[..., None]
    near, far = logs.gather(-1, at)[..., 0], logs.gather(-1, at + 1)[..., 0]
    return -(near * share + far * (1 - share)).mean(-1)

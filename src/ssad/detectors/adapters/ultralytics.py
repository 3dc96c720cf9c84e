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

from ssad.core.checkpoints import copy_state, load_weights
from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.errors import ConfigError, install_extra
from ssad.detectors.adapters.common import (
    Adapter,
    check_images,
    check_truth,
    resize_and_pad,
    resized_size,
    sum_by_image,
)
from ssad.detectors.adapters.task_aligned import assign_by_alignment
from ssad.detectors.yolo.classes import COCO
from ssad.detectors.yolo.decode import select
from ssad.detectors.yolo.loss import ciou

GREY = 114 / 255
NMS_IOU, MAX_DETECTIONS, THRESHOLD = 0.7, 300, 0.25  # its published defaults for predictions
BOX_GAIN, CLASS_GAIN, DFL_GAIN = 7.5, 0.5, 1.5  # and for training
INSTALL = f"{install_extra('ultralytics')} (licence AGPL-3.0; not a dependency of SSAD)"


def ultralytics_detector(
    model: str,
    *,
    classes: Sequence[str] = COCO,
    weights: str | Path | None = None,
    input_width: int | None = None,
    seed: int = 0,
) -> Ultralytics:
    """Build a model from one of the package's own model descriptions, such as yolov8n or yolov5nu.

    Args:
        model: Name of the description.
        classes: Names of the classes.
        weights: A file as for `load_weights`, including .pt files of the package (only their tensors are read, by
            name; nothing in them runs); None for fresh weights.
        input_width: Width to which images are resized inside; None to keep their size.
        seed: Seed of fresh weights.

    Raises:
        ConfigError: The package is not installed, or has no such detection model.
        FormatError: The weights cannot be read, or do not fit.
    """
    networks = load_package()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            network = networks.DetectionModel(f"{model.removesuffix('.yaml')}.yaml", nc=len(classes), verbose=False)
        except Exception as error:  # what the package raises for an unknown name differs between versions
            reason = " ".join(str(error).split())[:100]
            raise ConfigError(f"ultralytics: no detection model '{model}' could be built: {reason}") from None
    detector = Ultralytics(network, classes, name=f"ultralytics:{model}", input_width=input_width)
    with torch.no_grad():
        detector.dense(torch.zeros(1, 3, 64, 64))  # heads of other kinds are refused here
    if weights is not None:
        state = load_weights(weights)
        prefixed = {key if key.startswith("model.") else f"model.{key}": value for key, value in state.items()}
        copy_state(detector, {f"network.{key}": value for key, value in prefixed.items()}, weights)
    return detector


def load_package() -> Any:
    """Import the package's module of networks offline, and restore what the import changes.

    Raises:
        ConfigError: The package is not installed, or does not import.
    """
    import cv2

    # Everything that the import changes, see the module.
    environment = dict(os.environ)
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
        reason = "the package is not installed" if missing else f"the package does not import: {error}"
        raise ConfigError(f"ultralytics: {reason}; {INSTALL}") from None
    finally:
        os.environ.clear()
        os.environ.update(environment)
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
        network_size, scale = resized_size(size, self.input_width), self._scale(size, images.device)
        images = images.to(next(self.network.parameters()).dtype)
        multiple = max(32, *self.strides)
        scores, boxes, features = self._heads(resize_and_pad(images, network_size, multiple=multiple, grey=GREY))
        place, stride, level = self._places(features)
        distance = _expectation(boxes) * stride
        centre = place.T
        low, high = centre - distance[:, :2], centre + distance[:, 2:]
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

    def choose(self, dense: Dense, min_score: float) -> list[Detections]:
        """Return the detections by the score sigmoid(class), suppressed within a class."""
        return select(
            dense.logit.sigmoid(), dense.box, threshold=min_score, iou=NMS_IOU, limit=MAX_DETECTIONS, size=dense.size
        )

    @torch.no_grad()
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Assign targets by task alignment (TOOD), which depends on the predictions of the network.

        Of the cells inside an object, the ten with the largest score^0.5 * CIoU^6 are assigned to it; a cell that
        several objects claim goes to the one it overlaps most. extra: box [B, P, 4] in pixels of the image; weight
        [B, P]: target score of each place.
        """
        scale = self._scale(dense.size, dense.box.device).to(dense.box)
        targets = check_truth(self.name, truth, len(dense.box), scale=scale, classes=len(self.classes))
        label, owner, box, weight = assign_by_alignment(
            dense.logit.sigmoid(), dense.box * scale, dense.place * scale[:2], targets
        )
        return Assignment(label, owner, tuple(truth), {"box": box / scale, "weight": weight})

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
        image_count = len(dense.box)
        scale = self._scale(dense.size, dense.box.device).to(dense.box)
        image, place = (assignment.label >= 0).nonzero(as_tuple=True)
        weight = assignment.extra["weight"].to(dense.box)[image, place]
        target = assignment.extra["box"].to(dense.box)[image, place] * scale
        predicted = dense.box[image, place] * scale
        target_scores = torch.zeros_like(dense.logit)
        target_scores[image, place, assignment.label[image, place]] = weight
        class_loss = functional.binary_cross_entropy_with_logits(dense.logit, target_scores, reduction="none").sum(-1)
        bins = dense.maps["boxes"][0].transpose(1, 2)[image, place]
        stride = dense.stride[place, None] * scale[0]
        centre = dense.place[place] * scale[:2]
        sides = torch.cat((centre - target[:, :2], target[:, 2:] - centre), 1) / stride
        parts = {
            "box": sum_by_image(BOX_GAIN * (1 - ciou(predicted, target)) * weight, image, image_count),
            "cls": CLASS_GAIN * torch.where(assignment.label != -2, class_loss, 0.0).sum(1),
            "dfl": sum_by_image(DFL_GAIN * _distribution_loss(bins, sides) * weight, image, image_count),
        }
        total = sum_by_image(weight, image, image_count)
        if reduction == "image":
            return {name: part / total.clamp(min=1) for name, part in parts.items()}
        return {name: part.sum() / total.sum().clamp(min=1) for name, part in parts.items()}

    def _heads(self, images: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Return raw class maps [B, C, P], raw side distributions [B, 4 * bins, P], and the maps before the head."""
        head_output: Any = self.network(images)
        # In eval mode the network returns (decoded boxes, raw outputs).
        if isinstance(head_output, tuple) and len(head_output) == 2:
            head_output = head_output[1]
        count = len(self.classes)
        if isinstance(head_output, dict) and {"scores", "boxes", "feats"} <= head_output.keys():
            scores, boxes, features = head_output["scores"], head_output["boxes"], list(head_output["feats"])
        elif isinstance(head_output, list) and all(
            isinstance(level_output, Tensor) and level_output.ndim == 4 for level_output in head_output
        ):
            flat_outputs = torch.cat([level_output.flatten(2) for level_output in head_output], 2)
            boxes, scores = flat_outputs[:, :-count], flat_outputs[:, -count:]
            features = head_output
        else:
            raise ConfigError(f"{self.name}: its head answers in a way that is not known here; use YOLOv8 or YOLO11")
        cells = sum(level_output.shape[2] * level_output.shape[3] for level_output in features)
        if scores.shape[1:] != (count, cells) or boxes.shape[1] % 4 or boxes.shape[1] < 8:
            raise ConfigError(f"{self.name}: its head has other outputs than those of YOLOv8 and YOLO11")
        return scores.float() if scores.dtype is not torch.float64 else scores, boxes.to(scores.dtype), features

    def _places(self, features: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return centre [P, 2] (x, y), stride [P] and level [P] of the cells, in the network's input."""
        place, stride, level = [], [], []
        for level_index, (feature, level_stride) in enumerate(zip(features, self.strides, strict=True)):
            rows, columns = feature.shape[2:]
            y = (torch.arange(rows, device=feature.device) + 0.5) * level_stride
            x = (torch.arange(columns, device=feature.device) + 0.5) * level_stride
            place.append(torch.stack((x.expand(rows, columns), y[:, None].expand(rows, columns)), -1).reshape(-1, 2))
            stride.append(torch.full((rows * columns,), float(level_stride), device=feature.device))
            level.append(torch.full((rows * columns,), level_index, device=feature.device))
        return torch.cat(place), torch.cat(stride), torch.cat(level)

    def _scale(self, size: tuple[int, int], device: torch.device) -> Tensor:
        height, width = resized_size(size, self.input_width)
        x, y = width / size[1], height / size[0]
        return torch.tensor([x, y, x, y], device=device)


def _expectation(boxes: Tensor) -> Tensor:
    """Distances [B, 4, P] in strides from their distributions [B, 4 * bins, P] (generalised focal loss, eq. 5)."""
    distributions = boxes.unflatten(1, (4, -1))  # type: ignore[no-untyped-call]
    values = torch.arange(distributions.shape[2], device=boxes.device, dtype=boxes.dtype)
    expected: Tensor = (distributions.softmax(2) * values[:, None]).sum(2)
    return expected


def _distribution_loss(bins: Tensor, sides: Tensor) -> Tensor:
    """Return the distribution focal loss [M] (eq. 6), mean over the four sides: bins [M, 4 * n], sides [M, 4]."""
    count = bins.shape[1] // 4
    # Below the last bin, so that there is always a bin above.
    sides = sides.clamp(0, count - 1 - 0.01)
    low = sides.floor()
    lower_share = low + 1 - sides
    log_probabilities = bins.view(len(bins), 4, count).log_softmax(-1)
    lower_bin = low.long()[..., None]
    log_lower, log_upper = (
        log_probabilities.gather(-1, lower_bin)[..., 0],
        log_probabilities.gather(-1, lower_bin + 1)[..., 0],
    )
    return -(log_lower * lower_share + log_upper * (1 - lower_share)).mean(-1)

"""Shared parts of 2D detectors: base class, input, truth, choice of detections, sums."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional
from torchvision.ops import batched_nms

from ssad.core.detections import Dense, Detections, Truth
from ssad.core.errors import ConfigError
from ssad.core.eval_mode import in_eval_mode
from ssad.detectors.yolo.assign import Targets, pad_truth


class Adapter(nn.Module, ABC):
    """Base class of 2D detectors.

    Args:
        name: Name in tables.
        classes: Names of the classes.
        threshold: Default of `predict`.

    Raises:
        ConfigError: The threshold is not in [0, 1).
    """

    task: Literal["2d", "3d"] = "2d"

    def __init__(self, name: str, classes: Sequence[str], threshold: float) -> None:
        super().__init__()
        self.name = name
        self.classes = tuple(classes)
        self.threshold = check_threshold(name, threshold)

    def forward(self, images: Tensor) -> Dense:
        """Return the raw outputs of `dense`."""
        return self.dense(images)

    @abstractmethod
    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Return raw outputs; see `ssad.core.protocols.Detector`."""

    @torch.no_grad()
    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """Return the detections of each image, best first, selected as in the source."""
        min_score = check_threshold(self.name, self.threshold if threshold is None else threshold)
        with in_eval_mode(self):
            dense = self.dense(images)
        return self.choose(dense, min_score)

    @abstractmethod
    def choose(self, dense: Dense, min_score: float) -> list[Detections]:
        """Return the detections of each image above a score."""


def labels_and_owners(owner: Tensor, label: Tensor, crowd: Tensor) -> tuple[Tensor, Tensor]:
    """Return labels and owners of places from the result of a matcher.

    Args:
        owner: [P] Index of the object of each place; -1 for none, -2 for places between the thresholds.
        label: [Q] Classes of the objects.
        crowd: [Q] Whether an object is a crowd; the places of a crowd are ignored.

    Returns:
        Label (-1 background, -2 ignored) and owner (-1 none) [P] as an `Assignment` has them.
    """
    index = owner.clamp(min=0)
    place_label = torch.where(owner >= 0, label[index], owner)
    place_label = torch.where((owner >= 0) & crowd[index], -2, place_label)
    return place_label, torch.where(place_label >= 0, owner, -1)


def check_images(name: str, images: Tensor, *, min_count: int = 1) -> tuple[int, int]:
    """Return height and width of images [B, 3, H, W].

    Args:
        name: Name of the detector, for the message.
        images: Images to check.
        min_count: Minimum number of images.

    Raises:
        ConfigError: Another shape or type.
    """
    shape = images.shape
    if len(shape) != 4 or shape[1] != 3 or not images.is_floating_point() or 0 in shape[2:] or shape[0] < min_count:
        dtype_name = str(images.dtype).removeprefix("torch.")
        raise ConfigError(
            f"{name}: images must be [B, 3, H, W] of floats in [0, 1] (RGB); got {list(images.shape)} of {dtype_name}"
        )
    return images.shape[2], images.shape[3]


def resized_size(size: tuple[int, int], input_width: int | None) -> tuple[int, int]:
    """Return height and width to which an image of `size` is resized before padding (None: unchanged)."""
    if input_width is None:
        return size
    return max(1, round(size[0] * input_width / size[1])), input_width


def input_scale(input_size: tuple[int, int], size: tuple[int, int], template: Tensor) -> Tensor:
    """Return the factors [4] from boxes in an image of `size` to boxes in the network's input of size `inside`."""
    x, y = input_size[1] / size[1], input_size[0] / size[0]
    return torch.tensor([x, y, x, y], device=template.device, dtype=template.dtype)


def resize_and_pad(images: Tensor, input_size: tuple[int, int], *, multiple: int, grey: float) -> Tensor:
    """Resize images [B, 3, H, W] to `input_size` and pad right and bottom to a multiple of `multiple` pixels."""
    if input_size != tuple(images.shape[2:]):
        images = functional.interpolate(images, input_size, mode="bilinear", align_corners=False)
    return functional.pad(images, (0, -input_size[1] % multiple, 0, -input_size[0] % multiple), value=grey)


def check_threshold(name: str, threshold: float) -> float:
    """Return the threshold after checking it.

    Raises:
        ConfigError: It is not in [0, 1).
    """
    if not 0 <= threshold < 1:
        raise ConfigError(f"{name}: threshold {threshold} is not in [0, 1)")
    return threshold


def check_truth(name: str, truth: Sequence[Truth], images: int, *, scale: Tensor, classes: int) -> Targets:
    """Return the truth of all images in one, with boxes in pixels of the network's input.

    Args:
        name: Name of the detector, for messages.
        truth: Truth of each image.
        images: Number of images.
        scale: Factor of the boxes [4].
        classes: Number of classes.

    Raises:
        ConfigError: The truth is of another number of images, or broken.
    """
    if len(truth) != images or not truth:
        raise ConfigError(f"{name}: truth of {len(truth)} images for a batch of {images}; it takes one each")
    return pad_truth(truth, scale, classes=classes)


def log_odds(logit: Tensor) -> Tensor:
    """Return logits whose sigmoid is the softmax of `logit` [..., C]: each class against all others together."""
    index = logit.argmax(-1, keepdim=True)
    largest = torch.zeros_like(logit, dtype=torch.bool).scatter_(-1, index, True)
    # all but the largest have a share of at most one half, so nothing cancels
    share = logit.softmax(-1).masked_fill(largest, 0.0)
    log_remainder = logit.logsumexp(-1, keepdim=True) + torch.log1p(-share)
    log_others = logit.masked_fill(largest, -torch.inf).logsumexp(-1, keepdim=True)
    return logit - torch.where(largest, log_others, log_remainder)


def suppress(score: Tensor, label: Tensor, box: Tensor, *, iou: float, limit: int, size: tuple[int, int]) -> Detections:
    """Suppress candidates of one image within each class, and return detections, best first.

    Args:
        score: Score of each candidate [N].
        label: Class index [N].
        box: Boxes [N, 4]; they are clipped to the image.
        iou: IoU above which the worse of two boxes of a class is dropped.
        limit: Maximum number of detections.
        size: Height and width of the image.
    """
    height, width = size
    image_corner = torch.tensor([width, height, width, height], device=box.device, dtype=box.dtype)
    clipped = box.clamp(min=0).minimum(image_corner)
    ranking = score.argsort(descending=True, stable=True)
    score, label, clipped = score[ranking], label[ranking], clipped[ranking]
    # float64: suppression by class shifts boxes far apart, and float32 would round them there.
    survivors = batched_nms(clipped.double(), score.double(), label, iou)[:limit]
    return Detections(score[survivors], label[survivors], clipped[survivors])


def sum_by_image(value: Tensor, image: Tensor, images: int) -> Tensor:
    """Return the sums [B] of values [N] by image [N]; no atomic additions, hence the same bits in every run."""
    is_in_image = torch.arange(images, device=image.device)[:, None] == image
    return torch.where(is_in_image, value, torch.zeros_like(value)).sum(1)

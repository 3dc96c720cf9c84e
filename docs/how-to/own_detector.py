"""A detector of your own: a small anchor-free network on cells of 8 pixels, with the protocol `Detector`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot, pad, softplus
from torchvision.ops import generalized_box_iou_loss, sigmoid_focal_loss

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.errors import ConfigError
from ssad.detectors.adapters.common import check_images, check_threshold, check_truth, sum_by_image, suppress

STRIDE = 8


class OwnDetector(nn.Module):
    """Each cell predicts class scores and the distances to the four sides of a box."""

    task: Literal["2d", "3d"] = "2d"

    def __init__(self, classes: Sequence[str] = ("car", "person"), *, seed: int = 0) -> None:
        super().__init__()
        self.name, self.classes = "own", tuple(classes)
        with torch.random.fork_rng(devices=[]):  # leaves the global random state unchanged
            torch.manual_seed(seed)
            parts: list[nn.Module] = []
            for before, after in ((3, 16), (16, 32), (32, 64)):
                parts += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.GroupNorm(4, after), nn.SiLU()]
            self.trunk = nn.Sequential(*parts)
            self.head = nn.Conv2d(64, len(self.classes) + 4, 1)
        self.requires_grad_(False).eval()

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Outputs at every location, before any threshold, differentiable with respect to the images."""
        height, width = check_images(self.name, images)
        inside = pad(images.to(self.head.weight.dtype) - 0.5, (0, -width % STRIDE, 0, -height % STRIDE))
        feature = self.trunk(inside)
        raw = self.head(feature).flatten(2).transpose(1, 2)
        logit, sides = raw[..., :-4] - 3.0, 2 * STRIDE * softplus(raw[..., -4:])
        rows, columns = (torch.arange(n, device=raw.device) for n in feature.shape[2:])
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        place = (torch.stack([x, y], -1).reshape(-1, 2) + 0.5) * STRIDE
        box = torch.cat([place - sides[..., :2], place + sides[..., 2:]], -1)
        stride, level = torch.full_like(place[:, 0], STRIDE), torch.zeros_like(place[:, 0], dtype=torch.int64)
        # None: no quality score that multiplies the class scores
        return Dense(logit, None, box, place, stride, level, {"raw": [raw]}, (feature,), size=(height, width))

    @torch.no_grad()
    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """Boxes above the threshold, sorted by score, after non-maximum suppression per class."""
        least = check_threshold(self.name, 0.3 if threshold is None else threshold)
        dense = self.dense(images)  # with BatchNorm or dropout: inside `eval_mode.in_eval_mode(self)`
        found = []
        for score, box in zip(dense.logit.sigmoid(), dense.box, strict=True):
            place, label = (score > least).nonzero(as_tuple=True)
            found.append(suppress(score[place, label], label, box[place], iou=0.5, limit=100, size=dense.size))
        return found

    @torch.no_grad()
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """A cell is assigned to the smallest box that contains its centre."""
        check_truth(self.name, truth, len(dense.box), scale=dense.box.new_ones(4), classes=len(self.classes))
        label = torch.full(dense.box.shape[:2], -1, device=dense.box.device)  # -1: background
        owner, target = label.clone(), torch.zeros_like(dense.box)
        for k, one in enumerate(truth):
            if not len(one.label):
                continue
            place, box = dense.place[:, None], one.box.to(dense.box)
            within = torch.cat([place - box[:, :2], box[:, 2:] - place], -1).amin(-1) > 0  # [P, Q]
            area, index = torch.where(within, (box[:, 2:] - box[:, :2]).prod(-1), torch.inf).min(1)
            crowd = torch.zeros_like(one.label, dtype=torch.bool) if one.crowd is None else one.crowd
            mine = area.isfinite() & ~crowd[index]
            label[k] = torch.where(mine, one.label[index], torch.where(area.isfinite(), -2, -1))  # -2: ignored
            owner[k], target[k] = torch.where(mine, index, -1), torch.where(mine[:, None], box[index], 0.0)
        return Assignment(label, owner, tuple(truth), {"box": target})

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """Focal loss of the classes and GIoU loss of the boxes, per assigned location."""
        label, count = assignment.label, len(dense.box)
        if label.shape != dense.box.shape[:2]:
            raise ConfigError(f"{self.name}: the assignment was made for images of another number or size")
        wanted = one_hot(label.clamp(min=0), len(self.classes)).to(dense.logit) * (label >= 0)[..., None]
        each = sigmoid_focal_loss(dense.logit, wanted).sum(-1) * (label != -2)
        image, place = (label >= 0).nonzero(as_tuple=True)
        near = generalized_box_iou_loss(dense.box[image, place], assignment.extra["box"][image, place])
        parts = {"class": each.sum(1), "box": sum_by_image(near, image, count)}
        places = (label >= 0).sum(1)
        if reduction == "image":
            return {name: value / places.clamp(min=1) for name, value in parts.items()}
        return {name: value.sum() / places.sum().clamp(min=1) for name, value in parts.items()}

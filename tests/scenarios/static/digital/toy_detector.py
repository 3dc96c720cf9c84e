"""A detector whose logits are linear in the picture, and pictures with objects that it finds: optima are known exactly.

A picture is cut into cells of 8 x 8 pixels; a class has a pattern of signs, known by its name, and an object is that
pattern in one cell, faint. The logit of a class in a cell is the pattern's weight times the pixels, less a bias. What
is computed for a picture never depends on its batch, to the bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from ssad.core.detections import Assignment, Dense, Detections, Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.scenarios.static.digital.objectives import Situation

CELL = 8
CLASSES = ("car", "pedestrian")
BIAS = 3.0
FAINT = 8  # code values by which an object differs from grey: its logit is about 3
DEPTH = 10.0  # m
LENS = torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]])


def pattern(name: str) -> Tensor:
    """Signs [3, 8, 8] of a class."""
    return torch.from_numpy(generator("toy class", name).choice([-1.0, 1.0], (3, CELL, CELL))).float()


class ToyDetector(nn.Module):
    """Finds the patterns of its classes; `seed` and `spread` make detectors that differ in their weights."""

    weight: Tensor
    offset: Tensor

    def __init__(
        self,
        classes: tuple[str, ...] = CLASSES,
        *,
        task: Literal["2d", "3d"] = "2d",
        seed: int = 0,
        spread: float = 0.3,
        threshold: float = 0.3,
    ) -> None:
        super().__init__()
        self.name, self.task, self.classes, self.threshold = f"toy-{task}-{seed}", task, classes, threshold
        chance = generator("toy weights", seed)
        signs = torch.stack([pattern(name) for name in classes])
        noise = torch.from_numpy(chance.standard_normal(signs.shape)).float()
        self.register_buffer("weight", signs + spread * noise)
        self.register_buffer("offset", torch.from_numpy(0.02 * chance.standard_normal((4, 3, CELL, CELL))).float())
        self.eval()

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        with torch.no_grad():
            dense = self.dense(images, intrinsic)
        found = []
        for k in range(len(images)):
            score, label = dense.logit[k].sigmoid().max(-1)
            order = score.argsort(descending=True, stable=True)
            order = order[score[order] >= (self.threshold if threshold is None else threshold)]
            solid = None
            if intrinsic is not None and self.task == "3d":
                solid = solids(dense.place[order], intrinsic[k])
            found.append(Detections(score[order], label[order], dense.box[k][order], solid))
        return found

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        if self.task == "3d" and intrinsic is None:
            raise ConfigError(f"{self.name}: intrinsic is missing")
        height, width = images.shape[2] // CELL, images.shape[3] // CELL
        row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        place = (torch.stack([column, row], -1).reshape(-1, 2) * CELL + CELL / 2).to(images)
        logits, shifts = zip(*(self._one(image) for image in images), strict=True)
        half = CELL / 2
        box = torch.cat([place - half, place + half], 1) + torch.stack(shifts)
        many = len(place)
        stride, level = torch.full((many,), float(CELL)), torch.zeros(many, dtype=torch.long)
        return Dense(torch.stack(logits), None, box, place, stride, level, {}, size=(images.shape[2], images.shape[3]))

    def _one(self, image: Tensor) -> tuple[Tensor, Tensor]:
        cells = image.unfold(1, CELL, CELL).unfold(2, CELL, CELL) - 128 / 255  # [3, h, w, 8, 8]
        cells = cells.permute(1, 2, 0, 3, 4).flatten(0, 1).flatten(1)
        return cells @ self.weight.flatten(1).T - BIAS, cells @ self.offset.flatten(1).T

    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        label = torch.full((len(truth), len(dense.place)), -1)
        owner = torch.full_like(label, -1)
        for k, one in enumerate(truth):
            for q in range(len(one.label)):
                box = one.box[q].to(dense.place)
                inside = ((dense.place >= box[:2]) & (dense.place < box[2:])).all(1)
                crowd = one.crowd is not None and bool(one.crowd[q])
                label[k][inside] = -2 if crowd else int(one.label[q])
                owner[k][inside] = -1 if crowd else q
        return Assignment(label, owner, tuple(truth))

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        label = assignment.label
        target = nn.functional.one_hot(label.clamp_min(0), len(self.classes)) * (label >= 0)[..., None]
        each = nn.functional.binary_cross_entropy_with_logits(dense.logit, target.to(dense.logit), reduction="none")
        many = (label >= 0).sum(1).clamp_min(1)
        classification = (each.sum(-1) * (label > -2)).sum(1) / many
        wanted = dense.box.detach().clone()
        for k, one in enumerate(assignment.truth):
            chosen = label[k] >= 0
            wanted[k][chosen] = one.box.to(wanted)[assignment.owner[k][chosen]]
        box = ((dense.box - wanted) ** 2).sum((1, 2)) / many
        found = {"cls": classification, "box": box}
        return found if reduction == "image" else {name: value.mean() for name, value in found.items()}


@dataclass(frozen=True, slots=True)
class TrueLogits:
    """Down with the logits of the true classes at the objects: linear, so one step is the optimum under L-infinity."""

    name: str = "true logits"
    needs_objects: bool = True

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        label = situation.assignment.label
        true = dense.logit.gather(-1, label.clamp_min(0)[..., None])[..., 0]
        return -torch.where(label >= 0, true, 0.0).sum(1)


def best_linf(detector: ToyDetector, images: Tensor, truth: Sequence[Truth], radius: float) -> Tensor:
    """The images [B, 3, H, W] that maximise `TrueLogits` within an L-infinity ball and [0, 1]; elsewhere clean."""
    found = images.clone()
    for k, one in enumerate(truth):
        for label, (left, top) in zip(one.label.tolist(), one.box[:, :2].long().tolist(), strict=True):
            cell = found[k, :, top : top + CELL, left : left + CELL]
            cell -= radius * detector.weight[label].sign()
    return found.clamp(0.0, 1.0)


def toy_scene(
    count: int = 2,
    *,
    objects: int = 4,
    size: tuple[int, int] = (48, 64),
    classes: tuple[str, ...] = CLASSES,
    solid: bool = False,
    seed: int = 0,
) -> tuple[Tensor, list[Truth]]:
    """Grey pictures [B, 3, H, W] of 8 bits with a little noise and some objects, and the truth of each.

    Args:
        count: B.
        objects: In each picture, at different cells.
        size: Height and width, multiples of 8.
        classes: Names; labels are indices into them.
        solid: Whether the truth has 3D boxes, seen through `LENS`.
        seed: Of everything.
    """
    images, truth = [], []
    across, down = size[1] // CELL, size[0] // CELL
    for k in range(count):
        chance = generator("toy scene", seed, k)
        codes = torch.from_numpy(128 + chance.integers(-2, 3, (3, *size))).float()
        cells = torch.from_numpy(chance.choice(across * down, objects, replace=False))
        label = torch.from_numpy(chance.integers(0, len(classes), objects))
        corner = torch.stack([cells % across, cells // across], 1) * CELL
        for one, (left, top) in zip(label.tolist(), corner.tolist(), strict=True):
            codes[:, top : top + CELL, left : left + CELL] += FAINT * pattern(classes[one])
        images.append(codes / 255)
        box = torch.cat([corner, corner + CELL], 1).float()
        boxes_3d = solids(corner + CELL / 2, LENS) if solid else None
        truth.append(Truth(label, box, boxes_3d, LENS if solid else None))
    return torch.stack(images), truth


def solids(place: Tensor, intrinsic: Tensor) -> Solids:
    """Boxes of one size whose centres are seen at places [N, 2], all at one depth."""
    many = len(place)
    across = (place - intrinsic[:2, 2]) / torch.stack([intrinsic[0, 0], intrinsic[1, 1]]) * DEPTH
    centre = torch.cat([across, torch.full((many, 1), DEPTH).to(across)], 1)
    return Solids(
        centre, torch.ones(many, 3), torch.zeros(many), torch.zeros(many, 2), torch.zeros(many, dtype=torch.long)
    )

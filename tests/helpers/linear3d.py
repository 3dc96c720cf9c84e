"""A 3D detector that knows a data set and whose scores are linear in the picture: what an attack can do is known in
closed form."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Literal, cast

import torch
from helpers.oracle3d import told
from torch import Tensor, nn

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.protocols import Detector
from ssad.training.batches import load_images
from ssad.training.data import nuscenes_items

CLEAN = 6.0  # logit of every object in a clean picture
GAINS = (200.0, 500.0, 800.0, 1400.0)  # how fast the logit of objects 0, 1, 2, 3, 0, ... falls with a change of 1


class Linear(nn.Module):
    """The logit of object k of the nearest known picture is CLEAN - gain[k] * mean(pattern * change), with a pattern of
    signs that is the same for all: the change pattern * radius is the best an attack can do."""

    name: str = "linear"
    task: Literal["3d"] = "3d"
    classes: tuple[str, ...] = MMDET3D_CLASSES

    def __init__(self, root: Path, seed: int = 0) -> None:
        super().__init__()
        self.known = load_images(list(nuscenes_items(root, None, "all")), threads=1)
        pictures = cast(Tensor, self.known.pictures)
        # no buffers: an attack keeps a copy of each for its time
        self.clean = pictures.permute(0, 3, 1, 2).float() / 255
        self.small = self.clean[:, :, ::8, ::8].contiguous()
        draws = torch.Generator().manual_seed(seed)
        pattern = torch.randint(0, 2, pictures.shape[1:3], generator=draws).float() * 2 - 1
        self.register_buffer("pattern", pattern.expand(3, -1, -1).clone(), persistent=False)
        self.most = max(len(truth.label) for truth in self.known.truth)
        self.scale = nn.Parameter(torch.ones(()))

    def which(self, images: Tensor) -> list[int]:
        """The known picture that is nearest each image."""
        seen = images.detach()[:, :, ::8, ::8].to(self.small)
        return (self.small[None] - seen[:, None]).abs().mean((2, 3, 4)).argmin(1).tolist()

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """One location an object."""
        rows = self.which(images)
        pattern = self.pattern.to(images)
        change = images - self.clean[rows].to(images)
        pull = self.scale * (change * pattern).mean((1, 2, 3))
        gain = torch.tensor(GAINS).repeat(self.most)[: self.most].to(images)
        logit = images.new_full((len(images), self.most, len(self.classes)), -20.0)
        for k, row in enumerate(rows):
            label = self.known.truth[row].label
            value = CLEAN - gain[: len(label)] * pull[k]
            logit = logit.index_put((torch.full_like(label, k), torch.arange(len(label)), label), value.to(logit))
        place = images.new_zeros(self.most, 2)
        return Dense(
            logit, None, images.new_zeros(len(images), self.most, 4), place, place[:, 0] + 8, place[:, 0].long(), {}
        )

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """The true boxes whose score is at least 0.05."""
        with torch.no_grad():
            score = self.dense(images).logit.sigmoid().amax(-1)
        found = []
        for k, row in enumerate(self.which(images)):
            truth = self.known.truth[row]
            own = score[k, : len(truth.label)]
            order = torch.argsort(own, descending=True, stable=True)
            order = order[own[order] >= 0.05]
            one = told(truth, order)
            found.append(Detections(own[order], one.label, one.box, one.solid))
        return found

    def assign(self, dense: Dense, truth: list[Truth]) -> Assignment:
        """Location k is for object k."""
        label = torch.full(dense.logit.shape[:2], -1)
        for k, one in enumerate(truth):
            label[k, : len(one.label)] = one.label
        owner = torch.where(label >= 0, torch.arange(self.most).expand_as(label), -1)
        return Assignment(label, owner, tuple(truth))

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """The mean logit of objects, negative."""
        at = dense.logit.gather(-1, assignment.label.clamp_min(0)[..., None])[..., 0]
        wanted = (assignment.label >= 0).to(at)
        return {"cls": -(at * wanted).sum(1) / wanted.sum(1).clamp_min(1)}


class Blind(Linear):
    """Cuts its gradient off."""

    name = "blind"

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Detached."""
        return super().dense(images.detach())


class Flat(Linear):
    """Finds the boxes in the picture alone; it knows one class more, and not all of the others."""

    name = "flat"
    task = "2d"  # type: ignore[assignment]
    classes = ("kiosk", *MMDET3D_CLASSES[::-1])

    def __init__(self, root: Path, seed: int = 0) -> None:
        super().__init__(root, seed)
        place = [self.classes.index(name) for name in MMDET3D_CLASSES]
        for truth in self.known.truth:
            truth.label[:] = torch.tensor(place)[truth.label]

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """Without what 3D boxes have."""
        return [replace(one, solid=None) for one in super().predict(images, intrinsic, threshold=threshold)]


class Stranger(Flat):
    """Knows none of nuScenes's classes."""

    classes = tuple(f"thing {k}" for k in range(11))

    def __init__(self, root: Path, seed: int = 0) -> None:
        Linear.__init__(self, root, seed)


def build_flat() -> Detector:
    """A 2D detector with the pattern of `build`: what fools one fools the other."""
    return cast(Detector, Flat(Path(os.environ["LINEAR_DATA"])))


def build_stranger() -> Detector:
    """A 2D detector of things that nuScenes does not have."""
    return cast(Detector, Stranger(Path(os.environ["LINEAR_DATA"])))


def build() -> Detector:
    """For the data set that LINEAR_DATA names."""
    return cast(Detector, Linear(Path(os.environ["LINEAR_DATA"])))


def build_other() -> Detector:
    """One whose pattern has nothing to do with that of `build`: what fools one does nothing to the other."""
    return cast(Detector, Linear(Path(os.environ["LINEAR_DATA"]), seed=1))


def build_blind() -> Detector:
    """For the data set that LINEAR_DATA names."""
    return cast(Detector, Blind(Path(os.environ["LINEAR_DATA"])))

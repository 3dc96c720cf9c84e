"""A 3D detector that knows a data set: it finds what is true where a picture looks as it should, less where it does
not."""

from __future__ import annotations

import os
import time
from pathlib import Path

import torch
from torch import Tensor

from ssad.core.detections import Detections, Solids, Truth
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.training.batches import load_images
from ssad.training.data import nuscenes_items


class Oracle:
    """Finds the picture of the data set that is most like what it is shown, and tells its truth; the more the two
    differ, the fewer objects."""

    name, task, classes = "oracle", "3d", MMDET3D_CLASSES

    def __init__(self, root: Path) -> None:
        items = list(nuscenes_items(root, None, "all"))
        self.bank = load_images(items, threads=1)
        self.small = self.bank.pictures[:, ::4, ::4].float() / 255

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        return [self.find(image) for image in images]

    def find(self, image: Tensor) -> Detections:
        seen = image.permute(1, 2, 0)[::4, ::4]
        damage = (self.small - seen).abs().mean((1, 2, 3))
        best = int(damage.argmin())
        truth = self.bank.truth[best]
        count = len(truth.label)
        kept = round(count * max(0.0, 1.0 - 4.0 * float(damage[best])))
        return told(truth, torch.arange(kept))


def told(truth: Truth, rows: Tensor) -> Detections:
    solid = truth.solid
    assert solid is not None
    part = Solids(
        solid.centre[rows], solid.size_lhw[rows], solid.yaw[rows], solid.velocity[rows], solid.attribute[rows]
    )
    return Detections(torch.linspace(0.9, 0.5, len(rows)), truth.label[rows], truth.box[rows], part)


class Bad(Oracle):
    """Fails in the way that ORACLE_WAY names, if it names one."""

    name = "bad"

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        found = super().predict(images, intrinsic)
        if os.environ["ORACLE_WAY"] == "raises":
            raise ZeroDivisionError("on\npurpose")
        for one in found if os.environ["ORACLE_WAY"] == "breaks a promise" else ():
            assert one.solid is not None
            one.solid.size_lhw.neg_()
        return found


class Deadly(Oracle):
    """Does to its process what it is made for."""

    def __init__(self, root: Path, deed: str) -> None:
        super().__init__(root)
        self.deed = deed

    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        if self.deed == "die":
            os._exit(9)
        if self.deed == "hang":
            time.sleep(1e6)
        if self.deed == "raise":
            raise ZeroDivisionError("on purpose")
        held = []
        while True:
            held.append(bytearray(b"x" * (64 << 20)))
            time.sleep(0.05)  # not faster than a busy parent looks at it


def build_dying() -> Deadly:
    """For the data set that ORACLE_DATA names."""
    return Deadly(Path(os.environ["ORACLE_DATA"]), "die")


def build_hanging() -> Deadly:
    """For the data set that ORACLE_DATA names."""
    return Deadly(Path(os.environ["ORACLE_DATA"]), "hang")


def build_raising() -> Deadly:
    """For the data set that ORACLE_DATA names."""
    return Deadly(Path(os.environ["ORACLE_DATA"]), "raise")


def build_hungry() -> Deadly:
    """For the data set that ORACLE_DATA names."""
    return Deadly(Path(os.environ["ORACLE_DATA"]), "eat")


def build_bad() -> Bad:
    """For the data set that ORACLE_DATA names."""
    return Bad(Path(os.environ["ORACLE_DATA"]))


def build() -> Oracle:
    """For the data set that ORACLE_DATA names."""
    return Oracle(Path(os.environ["ORACLE_DATA"]))


def build_flat() -> Oracle:
    """One that says it finds boxes in pictures."""
    found = build()
    found.task = "2d"
    return found

"""Boxes that detectors find in photographs, cached in a file for each detector and condition."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from ssad.core import safeio
from ssad.core.detections import to_images
from ssad.core.protocols import Detector
from ssad.core.seeding import digest
from ssad.core.types import F64, I32, U8
from ssad.datasets.photographs import CLASSES, Photograph, class_of
from ssad.engine.kind import CellError
from ssad.metrics.detection2d import Boxes2D
from ssad.metrics.target_attacks import THRESHOLD

COARSE: Final = {"trailer": "truck", "construction_vehicle": "truck"}
"""Class of `ssad.datasets.photographs` -> coarser class, which all forms and detectors distinguish."""
ROAD_CLASSES: Final = tuple(name for name in CLASSES if name not in COARSE)
CAR: Final = ROAD_CLASSES.index("car")


@dataclass(frozen=True, slots=True)
class PhotographBoxes:
    """Detections in some photographs, a row per box, best first in each photograph.

    Attributes:
        image: Index of the photograph [N].
        label: Index into `ROAD_CLASSES` [N].
        box: x1, y1, x2, y2, pixels [N, 4].
        score: [N].
    """

    image: I32
    label: I32
    box: F64
    score: F64

    def of(self, image: int, label: int) -> tuple[F64, F64]:
        """Return boxes [M, 4] and scores [M] of one class in one photograph."""
        chosen_rows = (self.image == image) & (self.label == label)
        return self.box[chosen_rows], self.score[chosen_rows]

    def as_table(self) -> Boxes2D:
        """Return the boxes as the metrics take them."""
        return Boxes2D(self.image, self.label, self.box, self.score)


def road_label(name: str) -> int:
    """Return the index into `ROAD_CLASSES` of a class of a form or of a detector; -1 for none."""
    class_name = class_of(name)
    class_name = COARSE.get(class_name, class_name)
    return ROAD_CLASSES.index(class_name) if class_name in ROAD_CLASSES else -1


def known_labels(detector: Detector) -> list[int]:
    """Return the classes that a detector finds, as indices into `ROAD_CLASSES`."""
    return sorted({road_label(name) for name in detector.classes} - {-1})


def true_boxes(photographs: Sequence[Photograph], labels: Sequence[int]) -> Boxes2D:
    """Return the objects of some classes; what a form ignores is ignored in each of them.

    Args:
        photographs: The photographs.
        labels: Indices into `ROAD_CLASSES`.
    """
    rows: list[tuple[int, int, F64, bool]] = []
    for number, photograph in enumerate(photographs):
        for box, fine_label in zip(photograph.box, photograph.label.tolist(), strict=True):
            if fine_label < 0:
                rows += [(number, label, box, True) for label in labels]
            elif (label := road_label(CLASSES[fine_label])) in labels:
                rows.append((number, label, box, False))
    return Boxes2D(
        np.array([row[0] for row in rows], np.int32),
        np.array([row[1] for row in rows], np.int32),
        np.array([row[2] for row in rows], np.float64).reshape(-1, 4),
        ignore=np.array([row[3] for row in rows], np.bool_),
    )


def find_boxes(detector: Detector, images: Iterable[tuple[int, U8, Photograph]], device: str) -> PhotographBoxes:
    """Find boxes in photographs.

    Args:
        detector: A 3D detector is given the camera matrix; the hulls of its boxes count.
        images: Index, pixels [H, W, 3] and photograph of each.
        device: Device of the detector.

    Raises:
        CellError: A 3D detector is shown a photograph without a camera matrix.
    """
    label_table = torch.tensor([road_label(name) for name in detector.classes])
    columns_by_image: list[tuple[Any, ...]] = []
    for number, image, photograph in images:
        intrinsic = None
        if detector.task == "3d":
            if photograph.intrinsic is None:
                raise CellError(
                    f"{photograph.name}: no camera matrix, which 3D detectors need; use photographs in the form of "
                    "KITTI (with calib) or nuScenes"
                )
            intrinsic = torch.from_numpy(photograph.intrinsic).float()[None].to(device)
        (detections,) = detector.predict(to_images([image], device), intrinsic, threshold=THRESHOLD)
        label = label_table[detections.label.cpu().long()]
        chosen_rows = label >= 0
        columns = (
            label[chosen_rows],
            detections.box.detach().cpu().double()[chosen_rows],
            detections.score.detach().cpu().double()[chosen_rows],
        )
        columns_by_image.append(
            (np.full(int(chosen_rows.sum()), number, np.int32), *(column.numpy() for column in columns))
        )
    image_index, labels, boxes, scores = (
        np.concatenate([image_columns[column] for image_columns in columns_by_image])
        if columns_by_image
        else np.zeros((0, 4) if column == 2 else 0)
        for column in range(4)
    )
    return PhotographBoxes(image_index.astype(np.int32), labels.astype(np.int32), boxes, scores)


def boxes_file(system: str, condition: str) -> str:
    """Return the file of the boxes of a system under a condition, below a results folder."""
    return f"boxes/{digest('photograph boxes', system, condition)[:16]}.npz"


def cached_boxes(path: Path, find: Callable[[], PhotographBoxes]) -> PhotographBoxes:
    """Return boxes from their file, which is written first if there is none.

    Args:
        path: The file.
        find: Finds the boxes.

    Raises:
        FormatError: The file is broken.
    """
    if not path.is_file():
        detections = find()
        safeio.make_folder(path.parent)
        safeio.save_npz(path, {name: getattr(detections, name) for name in PhotographBoxes.__dataclass_fields__})
    arrays = safeio.load_npz(path)
    return PhotographBoxes(arrays["image"], arrays["label"], arrays["box"], arrays["score"])

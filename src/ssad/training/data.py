"""Images and truth for training and evaluation of detectors, from data sets and photographs on disk."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import torch

from ssad.core.detections import Truth
from ssad.core.import_report import ImportReport
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.types import U8
from ssad.datasets.nuscenes.camera_truth import camera_truth, scenes_of
from ssad.datasets.nuscenes.files import read_frame_image
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.photographs import CLASSES, Photograph, read_photographs
from ssad.training.batches import GREY, TrainingImage

FLAT_CLASSES: Final = (*MMDET3D_CLASSES, "stop_sign")
"""Classes of SSAD's 2D detectors, in the order of their labels."""
MIN_SIDE: Final = 2.0  # pixels after resizing below which an object is ignored


def nuscenes_items(root: Path, version: str | None, split: str, *, limit: int | None = None) -> Iterator[TrainingImage]:
    """Yield every key image of every camera of a split.

    Args:
        root: Root folder of the nuScenes data set.
        version: Version of the data set; None: the only one.
        split: Name of the split.
        limit: Maximum number of scenes; None: all.

    Raises:
        ConfigError: The split is unknown.
    """
    with NuScenes(root, version) as dataset:
        names = scenes_of(dataset, split)
        for name in names[:limit]:
            scene = dataset.scene(name)
            for frame in scene.frames:
                if frame.modality == "camera" and frame.key_frame:
                    truth = camera_truth(frame, scene.annotations(frame.sample_token))
                    yield TrainingImage(partial(read_frame_image, root, frame), truth)


def photograph_items(
    folder: Path, split: str, size: tuple[int, int], report: ImportReport | None = None
) -> tuple[tuple[str, ...], list[TrainingImage]]:
    """Return classes and photographs of a split, fitted to one size.

    Args:
        folder: Photographs in the form of COCO, KITTI, nuScenes or BDD100K (`ssad.datasets.photographs`).
        split: Name of the split.
        size: Height and width of the images, pixels.
        report: Filled with what came in, what is not read, and what is doubtful.

    Returns:
        `FLAT_CLASSES`, and the photographs; traffic lights are left out, ignored objects are crowds.

    Raises:
        ConfigError: There are no annotated photographs, or no such split.
        FormatError: The annotations are broken, or a photograph cannot be read.
    """
    photograph_set = read_photographs(folder, split)
    if report is not None:
        report.extend(photograph_set.report)
    return FLAT_CLASSES, [_photograph_item(photograph, size) for photograph in photograph_set.photographs]


def _photograph_item(photograph: Photograph, size: tuple[int, int]) -> TrainingImage:
    width, height = photograph.size
    if not width:
        height, width = photograph.read().shape[:2]
    scale = min(size[0] / height, size[1] / width)
    labels = [
        FLAT_CLASSES.index(CLASSES[object_labels])
        if object_labels >= 0 and CLASSES[object_labels] in FLAT_CLASSES
        else -1
        for object_labels in photograph.label
    ]
    is_used = (photograph.label < 0) | (np.array(labels, np.int64) >= 0)
    scaled_box = photograph.box[is_used] * scale
    object_labels = np.array(labels, np.int64)[is_used]
    is_crowd = (object_labels < 0) | ((scaled_box[:, 2:] - scaled_box[:, :2]).min(1, initial=np.inf) < MIN_SIDE)
    truth = Truth(
        torch.from_numpy(object_labels.clip(min=0)),
        torch.from_numpy(scaled_box.astype(np.float32)),
        crowd=torch.from_numpy(is_crowd),
    )
    return TrainingImage(partial(_fitted_image, photograph, size), truth)


def _fitted_image(photograph: Photograph, size: tuple[int, int]) -> U8:
    """Return a photograph resized to fit into a size, and padded with grey at the right and the bottom."""
    image = photograph.read()
    scale = min(size[0] / image.shape[0], size[1] / image.shape[1])
    rows, columns = (max(1, round(scale * length)) for length in image.shape[:2])
    resized = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    fitted = np.full((*size, 3), round(255 * GREY), np.uint8)
    fitted[:rows, :columns] = resized
    return fitted

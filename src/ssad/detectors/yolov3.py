"""YOLOv3 and YOLOv3-tiny (Redmon and Farhadi 2018): presets and builders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ssad.detectors.yolo.classes import COCO
from ssad.detectors.yolo.darknet import read_darknet
from ssad.detectors.yolo.detector import Yolo
from ssad.detectors.yolo.models import YoloSpec

YOLOV3 = YoloSpec(
    name="yolov3",
    rule="v3",
    network="darknet53",
    anchors=(((10, 13), (16, 30), (33, 23)), ((30, 61), (62, 45), (59, 119)), ((116, 90), (156, 198), (373, 326))),
)
YOLOV3_TINY = YoloSpec(
    name="yolov3-tiny",
    rule="v3",
    network="tiny",
    anchors=(((10, 14), (23, 27), (37, 58)), ((81, 82), (135, 169), (344, 319))),
    strides=(16, 32),
)
# The official yolov3-tiny.weights were trained with the anchors 1, 2, 3 on the fine level (pjreddie/darknet issue 851)
YOLOV3_TINY_OFFICIAL = replace(
    YOLOV3_TINY, anchors=(((23, 27), (37, 58), (81, 82)), ((81, 82), (135, 169), (344, 319)))
)


def yolov3(
    classes: Sequence[str] = COCO,
    *,
    spec: YoloSpec = YOLOV3,
    weights: str | Path | None = None,
    input_width: int | None = None,
    seed: int = 0,
) -> Yolo:
    """YOLOv3 with fresh weights, or with those of a darknet `.weights` file.

    Args:
        classes: Names of the classes.
        spec: Architecture and anchors.
        weights: A darknet `.weights` file; None: fresh weights.
        input_width: Width to which pictures are resized inside; None: they are not.
        seed: Of fresh weights.

    Raises:
        FormatError: The file is broken or does not fit.
    """
    detector = Yolo(spec, classes, input_width=input_width, seed=seed)
    if weights is not None:
        read_darknet(detector, weights)
    return detector


def yolov3_tiny(
    classes: Sequence[str] = COCO,
    *,
    spec: YoloSpec = YOLOV3_TINY,
    weights: str | Path | None = None,
    input_width: int | None = None,
    seed: int = 0,
) -> Yolo:
    """YOLOv3-tiny with fresh weights, or with those of a darknet `.weights` file.

    Args:
        classes: Names of the classes.
        spec: Architecture and anchors; the official weights need `YOLOV3_TINY_OFFICIAL`.
        weights: A darknet `.weights` file; None: fresh weights.
        input_width: Width to which pictures are resized inside; None: they are not.
        seed: Of fresh weights.

    Raises:
        FormatError: The file is broken or does not fit.
    """
    return yolov3(classes, spec=spec, weights=weights, input_width=input_width, seed=seed)

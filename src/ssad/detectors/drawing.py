"""Drawing of detections into images."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from ssad.core.detections import Detections, Solids
from ssad.core.protocols import Detector
from ssad.core.tensor_boxes import solid_corners
from ssad.core.types import F64, U8
from ssad.datasets.drawing import draw_edges

LEAST = {"2d": 0.25, "3d": 0.15}  # score of a box that is drawn; those of 3D detectors are lower
TRUE, FOUND = (255, 255, 255), (255, 170, 30)


def draw_flat(canvas: U8, boxes: torch.Tensor, scale: float, *, colour: tuple[int, int, int], width: int) -> None:
    """Draw 2D boxes into an image."""
    # OpenCV takes fixed-point coordinates: 3 fractional bits are eighths of a pixel.
    for box in np.rint(boxes.cpu().double().numpy() * scale * 8).astype(int).tolist():
        cv2.rectangle(canvas, tuple(box[:2]), tuple(box[2:]), colour, width, cv2.LINE_AA, 3)


def draw_solids(
    canvas: U8, solid: Solids | None, intrinsic: F64, scale: float, *, colour: tuple[int, int, int], width: int
) -> None:
    """Draw the edges of 3D boxes in front of the camera into an image."""
    if solid is None or not len(solid.yaw):
        return
    corner_points = solid_corners(solid.centre.double(), solid.size_lhw.double(), solid.yaw.double()).cpu().numpy()
    draw_edges(canvas, corner_points, intrinsic, scale, colour=colour, width=width)


def clear_detections(detector: Detector, image: Tensor, intrinsic: Tensor | None) -> Detections:
    """Return the detections in an image [1, 3, H, W] whose scores are high enough to be drawn."""
    camera = None if intrinsic is None or detector.task == "2d" else intrinsic[None].to(image)
    (detections,) = detector.predict(image, camera, threshold=LEAST[detector.task])
    return detections


@torch.no_grad()
def draw_clear_detections(detector: Detector, image: Tensor, intrinsic: Tensor | None = None) -> U8:
    """Return an image with the detected boxes, RGB [H, W, 3].

    Args:
        detector: Detector of the boxes.
        image: [1, 3, H, W] in 0 to 1, on the detector's device.
        intrinsic: Camera matrix [3, 3], for a 3D detector.
    """
    detections = clear_detections(detector, image, intrinsic)
    canvas = np.ascontiguousarray((image[0].permute(1, 2, 0).cpu().numpy() * 255).round().astype(np.uint8))
    for box, label, score in zip(
        detections.box.tolist(), detections.label.tolist(), detections.score.tolist(), strict=True
    ):
        top_left, bottom_right = (round(box[0]), round(box[1])), (round(box[2]), round(box[3]))
        cv2.rectangle(canvas, top_left, bottom_right, FOUND, 2, cv2.LINE_AA)
        write_beside(canvas, f"{detector.classes[label]} {score:.2f}", box)
    return canvas


def write_beside(canvas: U8, text: str, box: Sequence[float] | F64) -> None:
    """Write a text above the upper left corner of a 2D box into an image, in the colour of detections."""
    position = (round(float(box[0])), max(round(float(box[1])) - 4, 12))
    # A dark outline first, so that the text is readable on any background.
    cv2.putText(canvas, text, position, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(canvas, text, position, cv2.FONT_HERSHEY_SIMPLEX, 0.4, FOUND, 1, cv2.LINE_AA)

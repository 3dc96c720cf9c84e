"""Boxes of detectors, drawn into images."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from ssad.core.detections import Detections, Solids
from ssad.core.protocols import Detector
from ssad.core.types import F64, U8
from ssad.datasets.drawing import draw_edges
from ssad.detectors.mono3d.decode import corners

LEAST = {"2d": 0.25, "3d": 0.15}  # score of a box that is drawn; those of 3D detectors are lower
TRUE, FOUND = (255, 255, 255), (255, 170, 30)


def draw_flat(canvas: U8, boxes: torch.Tensor, scale: float, *, colour: tuple[int, int, int], width: int) -> None:
    """2D boxes."""
    for box in np.rint(boxes.cpu().double().numpy() * scale * 8).astype(int).tolist():
        cv2.rectangle(canvas, tuple(box[:2]), tuple(box[2:]), colour, width, cv2.LINE_AA, 3)


def draw_solids(
    canvas: U8, solid: Solids | None, intrinsic: F64, scale: float, *, colour: tuple[int, int, int], width: int
) -> None:
    """Edges of boxes that lie before the camera."""
    if solid is None or not len(solid.yaw):
        return
    points = corners(solid.centre.double(), solid.size_lhw.double(), solid.yaw.double()).cpu().numpy()
    draw_edges(canvas, points, intrinsic, scale, colour=colour, width=width)


def clear_detections(detector: Detector, image: Tensor, intrinsic: Tensor | None) -> Detections:
    """Return the detections in an image [1, 3, H, W] whose scores are high enough to be drawn."""
    camera = None if intrinsic is None or detector.task == "2d" else intrinsic[None].to(image)
    (found,) = detector.predict(image, camera, threshold=LEAST[detector.task])
    return found


@torch.no_grad()
def marked(detector: Detector, image: Tensor, intrinsic: Tensor | None = None) -> U8:
    """A picture with the boxes that a detector finds, RGB [H, W, 3].

    Args:
        detector: Whose boxes are drawn.
        image: [1, 3, H, W] in 0 to 1, where the detector is.
        intrinsic: Camera matrix [3, 3], for a 3D detector.
    """
    found = clear_detections(detector, image, intrinsic)
    picture = np.ascontiguousarray((image[0].permute(1, 2, 0).cpu().numpy() * 255).round().astype(np.uint8))
    for box, label, score in zip(found.box.tolist(), found.label.tolist(), found.score.tolist(), strict=True):
        low, high = (round(box[0]), round(box[1])), (round(box[2]), round(box[3]))
        cv2.rectangle(picture, low, high, FOUND, 2, cv2.LINE_AA)
        text = f"{detector.classes[label]} {score:.2f}"
        place = (low[0], max(low[1] - 4, 12))
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, FOUND, 1, cv2.LINE_AA)
    return picture

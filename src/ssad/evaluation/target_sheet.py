"""Pictures of physical attacks: a target under several textures with what a detector finds."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from ssad.core.detections import Detections, Truth
from ssad.core.images import captioned
from ssad.core.protocols import Detector
from ssad.core.types import U8
from ssad.evaluation.pictures import FOUND

COLUMNS, WIDTH = 3, 640
LEAST = {"2d": 0.25, "3d": 0.15}  # score of a box that is drawn; those of 3D detectors are lower
AROUND = 4.0  # side of what is shown, in longer sides of the target's box


@torch.no_grad()
def target_sheet(
    detector: Detector, shown: Sequence[tuple[str, Tensor]], truth: Truth, device: str, columns: int = COLUMNS
) -> U8:
    """Parts of pictures side by side, each with its title and the boxes that a detector finds in the whole picture.

    Args:
        detector: Whose boxes are drawn.
        shown: Titles and pictures [1, 3, H, W] in 0 to 1.
        truth: What is in them, the target first; what is around it is shown.
        device: Where the detector is.
        columns: Pictures in a row.

    Returns:
        [H, W, 3] RGB.
    """
    tiles, box = [], truth.box[0].tolist()
    for title, image in shown:
        found = _found(detector, image.to(device), truth.intrinsic)
        whole = np.ascontiguousarray((image[0].permute(1, 2, 0).cpu().numpy() * 255).round().astype(np.uint8))
        left, top, side = _square(box, whole.shape[1], whole.shape[0])
        scale = WIDTH / side
        picture = cv2.resize(whole[top : top + side, left : left + side], (WIDTH, WIDTH), interpolation=cv2.INTER_CUBIC)
        for own, label, score in zip(found.box.tolist(), found.label.tolist(), found.score.tolist(), strict=True):
            x0, y0, x1, y1 = (round((v - o) * scale) for v, o in zip(own, (left, top, left, top), strict=True))
            cv2.rectangle(picture, (x0, y0), (x1, y1), FOUND, 3, cv2.LINE_AA)
            text, place = f"{detector.classes[label]} {score:.2f}", (max(x0, 4), max(y0 - 6, 20))
            for colour, width in (((0, 0, 0), 5), (FOUND, 2)):
                cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, width, cv2.LINE_AA)
        tiles.append(captioned(picture, title, WIDTH))
    while len(tiles) % columns:
        tiles.append(np.full_like(tiles[0], 255))
    rows = [np.concatenate(tiles[k : k + columns], 1) for k in range(0, len(tiles), columns)]
    return np.concatenate(rows)


def _square(box: Sequence[float], width: int, height: int) -> tuple[int, int, int]:
    """Left, top and side of the square around a box, inside the picture, px."""
    side = min(round(AROUND * max(box[2] - box[0], box[3] - box[1])), width, height)
    left = min(max(round(0.5 * (box[0] + box[2]) - side / 2), 0), width - side)
    top = min(max(round(0.5 * (box[1] + box[3]) - side / 2), 0), height - side)
    return left, top, side


def _found(detector: Detector, image: Tensor, intrinsic: Tensor | None) -> Detections:
    """What a detector finds in a picture [1, 3, H, W] that is clear enough to be drawn."""
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
    found = _found(detector, image, intrinsic)
    picture = np.ascontiguousarray((image[0].permute(1, 2, 0).cpu().numpy() * 255).round().astype(np.uint8))
    for box, label, score in zip(found.box.tolist(), found.label.tolist(), found.score.tolist(), strict=True):
        low, high = (round(box[0]), round(box[1])), (round(box[2]), round(box[3]))
        cv2.rectangle(picture, low, high, FOUND, 2, cv2.LINE_AA)
        text = f"{detector.classes[label]} {score:.2f}"
        place = (low[0], max(low[1] - 4, 12))
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, FOUND, 1, cv2.LINE_AA)
    return picture

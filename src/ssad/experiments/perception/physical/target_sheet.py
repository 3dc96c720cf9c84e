"""Sheets of physical attacks: a target under several textures with the detections."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.images import add_caption
from ssad.core.protocols import Detector
from ssad.core.types import U8
from ssad.detectors.drawing import FOUND, clear_detections

COLUMNS, WIDTH = 3, 640
AROUND = 4.0  # side of what is shown, in longer sides of the target's box


@torch.no_grad()
def target_sheet(
    detector: Detector, titled_pictures: Sequence[tuple[str, Tensor]], truth: Truth, device: str, columns: int = COLUMNS
) -> U8:
    """Parts of pictures side by side, each with its title and the boxes that a detector finds in the whole picture.

    Args:
        detector: Whose boxes are drawn.
        titled_pictures: Titles and pictures [1, 3, H, W] in 0 to 1.
        truth: What is in them, the target first; what is around it is shown.
        device: Where the detector is.
        columns: Pictures in a row.

    Returns:
        [H, W, 3] RGB.
    """
    tiles, target_box = [], truth.box[0].tolist()
    for title, image in titled_pictures:
        detections = clear_detections(detector, image.to(device), truth.intrinsic)
        full_image = np.ascontiguousarray((image[0].permute(1, 2, 0).cpu().numpy() * 255).round().astype(np.uint8))
        left, top, side = _square(target_box, full_image.shape[1], full_image.shape[0])
        scale = WIDTH / side
        crop = cv2.resize(
            full_image[top : top + side, left : left + side], (WIDTH, WIDTH), interpolation=cv2.INTER_CUBIC
        )
        for detected_box, label, score in zip(
            detections.box.tolist(), detections.label.tolist(), detections.score.tolist(), strict=True
        ):
            x0, y0, x1, y1 = (
                round((edge - origin) * scale)
                for edge, origin in zip(detected_box, (left, top, left, top), strict=True)
            )
            cv2.rectangle(crop, (x0, y0), (x1, y1), FOUND, 3, cv2.LINE_AA)
            text, text_position = f"{detector.classes[label]} {score:.2f}", (max(x0, 4), max(y0 - 6, 20))
            for colour, width in (((0, 0, 0), 5), (FOUND, 2)):
                cv2.putText(crop, text, text_position, cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, width, cv2.LINE_AA)
        tiles.append(add_caption(crop, title, WIDTH))
    while len(tiles) % columns:
        tiles.append(np.full_like(tiles[0], 255))
    rows = [np.concatenate(tiles[start : start + columns], 1) for start in range(0, len(tiles), columns)]
    return np.concatenate(rows)


def _square(box: Sequence[float], width: int, height: int) -> tuple[int, int, int]:
    """Return left, top and side of the square around a box, inside the image, px."""
    side = min(round(AROUND * max(box[2] - box[0], box[3] - box[1])), width, height)
    left = min(max(round(0.5 * (box[0] + box[2]) - side / 2), 0), width - side)
    top = min(max(round(0.5 * (box[1] + box[3]) - side / 2), 0), height - side)
    return left, top, side

"""Pictures of physical attacks: a scene under several textures with what a detector finds."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from ssad.core.images import captioned
from ssad.core.protocols import Detector
from ssad.core.types import U8
from ssad.evaluation.pictures import FOUND

COLUMNS, WIDTH, LEAST = 3, 640, 0.25


@torch.no_grad()
def target_sheet(detector: Detector, shown: Sequence[tuple[str, Tensor]], device: str) -> U8:
    """Pictures side by side, each with its title and the boxes that a detector finds.

    Args:
        detector: Whose boxes are drawn.
        shown: Titles and pictures [1, 3, H, W] in 0 to 1.
        device: Where the detector is.

    Returns:
        [H, W, 3] RGB.
    """
    tiles = []
    for title, image in shown:
        (found,) = detector.predict(image.to(device), threshold=LEAST)
        picture = np.ascontiguousarray((image[0].permute(1, 2, 0).cpu().numpy() * 255).round().astype(np.uint8))
        for box, label, score in zip(found.box.tolist(), found.label.tolist(), found.score.tolist(), strict=True):
            low, high = (round(box[0]), round(box[1])), (round(box[2]), round(box[3]))
            cv2.rectangle(picture, low, high, FOUND, 2, cv2.LINE_AA)
            text = f"{detector.classes[label]} {score:.2f}"
            place = (low[0], max(low[1] - 4, 12))
            cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, FOUND, 1, cv2.LINE_AA)
        tiles.append(captioned(picture, title, WIDTH))
    while len(tiles) % COLUMNS:
        tiles.append(np.full_like(tiles[0], 255))
    rows = [np.concatenate(tiles[k : k + COLUMNS], 1) for k in range(0, len(tiles), COLUMNS)]
    return np.concatenate(rows)

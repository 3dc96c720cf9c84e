"""Boxes and names drawn into pictures."""

from __future__ import annotations

import cv2
import numpy as np

from ssad.core.types import F64, U8

EDGES = tuple((a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit)  # corners that differ in one axis


def title_on(canvas: U8, text: str) -> None:
    """Writes a name into the upper left corner."""
    cv2.rectangle(canvas, (0, 0), (12 + 11 * len(text), 26), (0, 0, 0), -1)
    cv2.putText(canvas, text, (7, 19), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1, cv2.LINE_AA)


def draw_edges(
    canvas: U8, corners: F64, intrinsic: F64, scale: float, *, colour: tuple[int, int, int], width: int
) -> None:
    """Edges of the boxes that lie before the camera.

    Args:
        canvas: Picture [H, W, 3]; it is drawn into.
        corners: [N, 8, 3] in the camera's frame, m; bit 0, 1 and 2 of a corner's number tell it from its neighbours.
        intrinsic: Of the camera [3, 3].
        scale: Pixels of the canvas for one of the camera.
        colour: RGB.
        width: Of the lines, pixels.
    """
    for box in corners[(corners[..., 2] > 0.5).all(1)]:
        flat = box @ intrinsic.T
        place = np.rint(flat[:, :2] / flat[:, 2:] * scale * 8).clip(-1e6, 1e6).astype(int)
        for a, b in EDGES:
            first, last = (int(v) for v in place[a]), (int(v) for v in place[b])
            cv2.line(canvas, tuple(first), tuple(last), colour, width, cv2.LINE_AA, 3)

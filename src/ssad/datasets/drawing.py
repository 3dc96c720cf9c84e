"""Drawing of boxes and titles into images."""

from __future__ import annotations

import cv2
import numpy as np

from ssad.core.types import F64, U8

EDGES = tuple((a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit)  # corners that differ in one axis


def title_on(canvas: U8, text: str) -> None:
    """Write a title into the upper left corner."""
    cv2.rectangle(canvas, (0, 0), (12 + 11 * len(text), 26), (0, 0, 0), -1)
    cv2.putText(canvas, text, (7, 19), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1, cv2.LINE_AA)


def draw_edges(
    canvas: U8, corners: F64, intrinsic: F64, scale: float, *, colour: tuple[int, int, int], width: int
) -> None:
    """Draw the edges of the boxes that lie before the camera.

    Args:
        canvas: Image [H, W, 3]; it is drawn into.
        corners: [N, 8, 3] in the camera's frame, m; neighbours differ in one of the bits 0, 1 and 2 of their
            numbers.
        intrinsic: Camera matrix [3, 3].
        scale: Pixels of the canvas per pixel of the camera.
        colour: RGB.
        width: Width of the lines, pixels.
    """
    for box in corners[(corners[..., 2] > 0.5).all(1)]:
        projected = box @ intrinsic.T
        # OpenCV takes coordinates with 3 fractional bits (the factor 8 and the last argument below).
        fixed_point = np.rint(projected[:, :2] / projected[:, 2:] * scale * 8).clip(-1e6, 1e6).astype(int)
        for first_corner, second_corner in EDGES:
            line_start, line_end = (
                (int(coordinate) for coordinate in fixed_point[first_corner]),
                (int(coordinate) for coordinate in fixed_point[second_corner]),
            )
            cv2.line(canvas, tuple(line_start), tuple(line_end), colour, width, cv2.LINE_AA, 3)

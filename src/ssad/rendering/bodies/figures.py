"""Figures of speed-limit signs as polygons, in the proportions of DIN 1451 (medium width)."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssad.rendering.meshes.mesh import F64

STROKE: Final = 0.16  # share of the height of a figure
ADVANCE: Final = 0.62  # shares of its height from one figure to the next
FIGURE_WIDTH: Final = 0.52  # shares of its height
OVERLAP: Final = 15.0  # degrees by which two halves of a bowl overlap, so that no gap shows
HEIGHTS: Final = {1: 0.95, 2: 0.88, 3: 0.70}  # number of figures -> their height, in radii of the sign


def number_strokes(text: str, *, segments: int) -> list[F64]:
    """Return the strokes of a number about 0, 0 for a sign of radius 1.

    Args:
        text: One to three figures.
        segments: Number of segments of half an ellipse.

    Returns:
        Simple polygons [n, 2] (to the reader's right, up); strokes of a figure may overlap.
    """
    height = HEIGHTS[len(text)]
    start = -0.5 * (ADVANCE * (len(text) - 1) + FIGURE_WIDTH)
    return [
        height * (_outline(line) + np.array([start + ADVANCE * place, -0.5]))
        for place, figure in enumerate(text)
        for line in _centre_lines(figure, segments)
    ]


def _centre_lines(figure: str, segments: int) -> list[F64]:
    """Return the centre lines [n, 2] of the strokes of a figure of height 1."""

    def arc(centre: tuple[float, float], radii: tuple[float, float], start: float, end: float) -> F64:
        """Return an arc of an ellipse from one angle to another, degrees."""
        count = max(2, round(segments * abs(end - start) / 180.0) + 1)
        angles = np.deg2rad(np.linspace(start, end, count))
        return np.asarray(np.stack([np.cos(angles), np.sin(angles)], 1) * radii + centre)

    def line(*points: tuple[float, float]) -> F64:
        return np.array(points, np.float64)

    if figure == "0":
        upper, lower = arc((0.26, 0.72), (0.18, 0.20), 0.0, 180.0), arc((0.26, 0.28), (0.18, 0.20), 180.0, 360.0)
        ends = line((0.44, 0.5)), line((0.08, 0.5))
        return [np.concatenate([ends[0], upper, ends[1]]), np.concatenate([ends[1], lower, ends[0]])]
    if figure == "1":
        return [line((0.33, 0.0), (0.33, 1.0)), line((0.33, 0.92), (0.10, 0.70))]
    if figure == "2":
        bow = arc((0.26, 0.70), (0.18, 0.22), 170.0, -30.0)
        return [np.concatenate([bow, line((0.10, 0.12))]), line((0.02, 0.08), (0.48, 0.08))]
    if figure == "3":
        upper, lower = arc((0.25, 0.725), (0.17, 0.195), 160.0, -90.0), arc((0.25, 0.30), (0.19, 0.22), 90.0, -160.0)
        return [upper, lower]
    if figure == "4":
        return [line((0.32, 1.0), (0.09, 0.28)), line((0.02, 0.27), (0.52, 0.27)), line((0.37, 0.0), (0.37, 0.56))]
    if figure == "5":
        bow = arc((0.25, 0.31), (0.19, 0.23), 130.0, -155.0)
        return [line((0.09, 0.92), (0.46, 0.92)), line((0.15, 0.95), (0.12, 0.45)), bow]
    if figure == "7":
        return [line((0.03, 0.92), (0.50, 0.92)), line((0.43, 0.95), (0.19, 0.0))]
    if figure == "8":
        return [
            arc((0.26, y), (radius, height), start - OVERLAP, start + 180.0 + OVERLAP)
            for y, radius, height in ((0.735, 0.155, 0.185), (0.305, 0.18, 0.225))
            for start in (0.0, 180.0)
        ]
    six = [
        *(arc((0.26, 0.29), (0.18, 0.21), start - OVERLAP, start + 180.0 + OVERLAP) for start in (0.0, 180.0)),
        line((0.09, 0.33), (0.16, 0.58), (0.36, 1.0)),
    ]
    return six if figure == "6" else [np.array([FIGURE_WIDTH, 1.0]) - stroke for stroke in six]


def _outline(points: F64) -> F64:
    """Return the outline [2 n, 2] of a stroke along a centre line [n, 2], mitred at its corners."""
    directions = np.diff(points, axis=0)
    normals = np.stack([-directions[:, 1], directions[:, 0]], 1) / np.hypot(*directions.T)[:, None]
    before, after = np.concatenate([normals[:1], normals]), np.concatenate([normals, normals[-1:]])
    mitres = (before + after) / (1.0 + (before * after).sum(1, keepdims=True))
    return np.concatenate([points - 0.5 * STROKE * mitres, (points + 0.5 * STROKE * mitres)[::-1]])

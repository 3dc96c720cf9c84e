"""Stickers and covers on the plates of signs."""

from __future__ import annotations

from typing import Final

import numpy as np

from ssad.core.seeding import generator
from ssad.rendering.bodies.figures import ADVANCE, FIGURE_WIDTH, HEIGHTS, number_strokes
from ssad.rendering.bodies.furniture import SIGN_BACK, SIGN_INK
from ssad.rendering.meshes.mesh import F64, Material, Mesh, Point, build, merge, triangulate

PAPER: Final = Material("sticker", (0.74, 0.74, 0.73), specular=0.04, gloss=0.25)
LAYER: Final = 0.004  # m between a plate and what lies on it
BLOCKS: Final = (4, 7)  # columns and rows of a sticker of blocks
MARGIN: Final = 0.06  # share of the height of a figure by which a sticker extends beyond it
COVER_SIDE: Final = 2.06  # radii of the plate, side of a cover


def apply_sticker(body: Mesh, size: Point, figures: str, content: str) -> Mesh:
    """Return a speed-limit sign with a sticker on its first figure.

    Args:
        body: The sign.
        size: Its size, m.
        figures: Its figures.
        content: Figure on the sticker, "blank", or "blocks" of random black and white.
    """
    height = HEIGHTS[len(figures)]
    # The first of the figures stands on the left; those after it stay in view.
    start = -0.5 * (ADVANCE * (len(figures) - 1) + FIGURE_WIDTH)
    lower = height * np.array([start - MARGIN, -0.5 - MARGIN])
    upper = height * np.array([start + FIGURE_WIDTH + 0.04, 0.5 + MARGIN])
    ink: list[F64] = []
    if content == "blocks":
        is_black = generator("sticker blocks").random(BLOCKS) < 0.5
        step = (upper - lower) / BLOCKS
        corners = [lower + step * place for place in np.argwhere(is_black)]
        ink = [_rectangle(corner, corner + step) for corner in corners]
    elif content != "blank":
        scale, middle = height / HEIGHTS[1], height * np.array([start + 0.5 * FIGURE_WIDTH, 0.0])
        ink = [scale * stroke + middle for stroke in number_strokes(content, segments=6)]
    return _with_layers(body, size, [(_rectangle(lower, upper), PAPER)], [(outline, SIGN_INK) for outline in ink])


def cover_sign(body: Mesh, size: Point) -> Mesh:
    """Return a sign whose plate is covered by a grey square.

    Args:
        body: The sign.
        size: Its size, m.
    """
    half_side = np.full(2, 0.5 * COVER_SIDE)
    return _with_layers(body, size, [(_rectangle(-half_side, half_side), SIGN_BACK)])


def _rectangle(lower: F64, upper: F64) -> F64:
    return np.array([lower, (upper[0], lower[1]), upper, (lower[0], upper[1])])


def _with_layers(body: Mesh, size: Point, *layers: list[tuple[F64, Material]]) -> Mesh:
    """Return a sign with layers of polygons [n, 2], in radii about the middle of its plate, before its face."""
    radius, face = 0.5 * size[1], float(body.bounds()[1][0])
    parts = [body]
    for depth, layer in enumerate(layers, 1):
        for outline, material in layer:
            points = np.insert(radius * outline + [0.0, size[2] - radius], 0, face + LAYER * depth, axis=1)
            parts.append(build(points, triangulate(outline), materials=material, smooth=0.0))
    return merge(parts)

"""A found scenario from above: the road, how the ego and the adversary came, and where they met."""

from __future__ import annotations

import cv2
import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.lane_strips import strips
from ssad.core.types import F64, U8, EpisodeTrace

GROUND, ROAD, SIDE, MARK = (236, 240, 238), (196, 199, 203), (221, 222, 224), (255, 255, 255)
EGO, ADVERSARY, OTHER, DARK = (39, 106, 201), (205, 55, 47), (120, 126, 134), (40, 44, 48)
"""RGB."""
BEFORE = 6.0  # s of the motion that is shown
MARGIN = 14.0  # m


def found_view(
    trace: EpisodeTrace, graph: LaneGraph, adversaries: list[int], *, size: int = 420, last: int | None = None
) -> U8:
    """A square picture: paths of the last seconds, bodies each second faint, and at the end in full.

    Args:
        trace: What happened.
        graph: Its town.
        adversaries: Agents drawn as such.
        size: Of the picture, pixels.
        last: Step that is shown; None: the first contact, or the end.

    Returns:
        [size, size, 3] RGB.
    """
    hits = np.flatnonzero(trace.contact)
    if last is None:
        last = int(hits[0]) if len(hits) else len(trace.x) - 1
    first = max(0, last - round(BEFORE / trace.dt))
    path = np.stack([trace.x[first : last + 1], trace.y[first : last + 1]], -1).astype(np.float64)
    shown = path[:, [0, *adversaries]].reshape(-1, 2)
    centre = 0.5 * (shown.min(0) + shown.max(0))
    half = max(float(np.ptp(shown, axis=0).max()) / 2 + MARGIN, 22.0)
    scale = size / (2 * half)

    def at(xy: F64) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
        pixels = (np.asarray(xy) - centre) * [scale, -scale] + size / 2
        return np.asarray(np.round(pixels * 16), np.int32)  # in sixteenths of a pixel

    picture = np.full((size, size, 3), GROUND, np.uint8)
    near = [  # a straight strip may have no corner in the picture
        strip
        for strip in strips(graph)
        if (strip.ring.min(0) < centre + half).all() and (strip.ring.max(0) > centre - half).all()
    ]
    for strip in near:
        cv2.fillPoly(picture, [at(strip.ring)], ROAD if strip.layer >= 2 else SIDE, cv2.LINE_AA, 4)
    for strip in near:
        if strip.layer == 3 and not strip.junction:
            for edge in (strip.left, strip.right):
                cv2.polylines(picture, [at(edge)], False, MARK, 1, cv2.LINE_AA, 4)
    colours = {0: EGO, **dict.fromkeys(adversaries, ADVERSARY)}
    for agent in sorted(range(trace.x.shape[1]), key=lambda a: (a == 0, a in adversaries)):
        colour = colours.get(agent, OTHER)
        there = trace.active[first : last + 1, agent]
        if agent in colours and there.any():
            cv2.polylines(picture, [at(path[there, agent])], False, colour, 2, cv2.LINE_AA, 4)
        for row in [*(range(last, first, -round(1 / trace.dt))[1:] if agent in colours else []), last]:
            if not trace.active[row, agent]:
                continue
            ring = at(_corners(trace, row, agent))
            if row == last:
                cv2.fillPoly(picture, [ring], colour, cv2.LINE_AA, 4)
                nose = at(_corners(trace, row, agent)[[0, 3]])
                cv2.polylines(picture, [nose], False, DARK, 2, cv2.LINE_AA, 4)
            cv2.polylines(picture, [ring], True, colour if row < last else DARK, 1, cv2.LINE_AA, 4)
    return picture


def _corners(trace: EpisodeTrace, row: int, agent: int) -> F64:
    """Corners [4, 2] of a body: front left, rear left, rear right, front right."""
    cos, sin = np.cos(trace.yaw[row, agent]), np.sin(trace.yaw[row, agent])
    along = 0.5 * trace.length[agent] * np.array([1, -1, -1, 1])
    across = 0.5 * trace.width[agent] * np.array([1, 1, -1, -1])
    x, y = trace.x[row, agent], trace.y[row, agent]
    return np.asarray(np.stack([x + cos * along - sin * across, y + sin * along + cos * across], -1), np.float64)

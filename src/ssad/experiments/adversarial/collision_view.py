"""Top view of a scenario with a collision: the road, the paths of ego and adversary, and the contact."""

from __future__ import annotations

import cv2
import numpy as np

from ssad.core.geometry import corners
from ssad.core.lane_graph import LaneGraph
from ssad.core.lane_strips import make_lane_strips
from ssad.core.types import F64, U8, EpisodeTrace

GROUND, ROAD, SIDEWALK, MARKING = (236, 240, 238), (196, 199, 203), (221, 222, 224), (255, 255, 255)
EGO, ADVERSARY, BYSTANDER, DARK = (39, 106, 201), (205, 55, 47), (120, 126, 134), (40, 44, 48)
"""RGB."""
SHOWN_SECONDS = 6.0  # s of the motion that is shown
MARGIN = 14.0  # m


def draw_collision(
    trace: EpisodeTrace, graph: LaneGraph, adversaries: list[int], *, size: int = 420, last_step: int | None = None
) -> U8:
    """Draw a scenario from above: paths of the last seconds, bodies each second faint, and at the end in full.

    Args:
        trace: Trace of the episode.
        graph: Its town.
        adversaries: Agents drawn as adversaries.
        size: Size of the picture, pixels.
        last_step: Step that is shown; None: the first contact, or the end.

    Returns:
        [size, size, 3] RGB.
    """
    contact_steps = np.flatnonzero(trace.contact)
    if last_step is None:
        last_step = int(contact_steps[0]) if len(contact_steps) else len(trace.x) - 1
    first_step = max(0, last_step - round(SHOWN_SECONDS / trace.dt))
    positions = np.stack([trace.x[first_step : last_step + 1], trace.y[first_step : last_step + 1]], -1).astype(
        np.float64
    )
    visible_points = positions[:, [0, *adversaries]].reshape(-1, 2)
    centre = 0.5 * (visible_points.min(0) + visible_points.max(0))
    half_width = max(float(np.ptp(visible_points, axis=0).max()) / 2 + MARGIN, 22.0)
    scale = size / (2 * half_width)

    def to_pixels(xy: F64) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
        pixels = (np.asarray(xy) - centre) * [scale, -scale] + size / 2
        return np.asarray(np.round(pixels * 16), np.int32)  # in sixteenths of a pixel

    canvas = np.full((size, size, 3), GROUND, np.uint8)
    visible_strips = [  # a straight strip may have no corner in the picture
        strip
        for strip in make_lane_strips(graph)
        if (strip.outline.min(0) < centre + half_width).all() and (strip.outline.max(0) > centre - half_width).all()
    ]
    for strip in visible_strips:
        cv2.fillPoly(canvas, [to_pixels(strip.outline)], ROAD if strip.layer >= 2 else SIDEWALK, cv2.LINE_AA, 4)
    for strip in visible_strips:
        if strip.layer == 3 and not strip.junction:
            for edge in (strip.left, strip.right):
                cv2.polylines(canvas, [to_pixels(edge)], False, MARKING, 1, cv2.LINE_AA, 4)
    colours = {0: EGO, **dict.fromkeys(adversaries, ADVERSARY)}
    # Adversaries and then the ego last, so that they are drawn over other traffic.
    for agent in sorted(range(trace.x.shape[1]), key=lambda index: (index == 0, index in adversaries)):
        colour = colours.get(agent, BYSTANDER)
        is_present = trace.active[first_step : last_step + 1, agent]
        if agent in colours and is_present.any():
            cv2.polylines(canvas, [to_pixels(positions[is_present, agent])], False, colour, 2, cv2.LINE_AA, 4)
        for step in [*(range(last_step, first_step, -round(1 / trace.dt))[1:] if agent in colours else []), last_step]:
            if not trace.active[step, agent]:
                continue
            outline = to_pixels(_corners(trace, step, agent))
            if step == last_step:
                cv2.fillPoly(canvas, [outline], colour, cv2.LINE_AA, 4)
                front_edge = to_pixels(_corners(trace, step, agent)[[0, 3]])
                cv2.polylines(canvas, [front_edge], False, DARK, 2, cv2.LINE_AA, 4)
            cv2.polylines(canvas, [outline], True, colour if step < last_step else DARK, 1, cv2.LINE_AA, 4)
    return canvas


def _corners(trace: EpisodeTrace, row: int, agent: int) -> F64:
    """Return the corners [4, 2] of a body: front left, rear left, rear right, front right."""
    columns = trace.x[row, agent], trace.y[row, agent], trace.yaw[row, agent], trace.length[agent], trace.width[agent]
    return np.asarray(corners(*(np.float64(column) for column in columns)), np.float64)

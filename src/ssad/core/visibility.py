"""Visibility of objects from a viewpoint, in the plane: which of them a straight line reaches."""

from __future__ import annotations

import numpy as np

from ssad.core.driving import Belief
from ssad.core.types import F32, F64, AgentKind, Bool

RANGE = 100.0  # m
OCCLUDERS = (AgentKind.CAR, AgentKind.TRUCK, AgentKind.BUS)
MIN_OCCLUDING_PROP = 0.8  # m, minimum extent of a prop in both directions to occlude


def is_visible(eye: F32, belief: Belief, reach: float | F64 = RANGE) -> Bool:
    """Return which objects are visible.

    Args:
        eye: [B, 2] viewpoint, m.
        belief: The objects [B, K].
        reach: Visual range, m, of all viewpoints or of each [B].

    Returns:
        [B, K]; False for unused rows.
    """
    half = 0.5 * belief.size
    cosine, sine = np.cos(belief.pose[..., 2]), np.sin(belief.pose[..., 2])
    forward, lateral = np.stack([cosine, sine], -1), np.stack([-sine, cosine], -1)
    unit_points = np.array([(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)], np.float32)
    # [B, K, 5, 2]: the centre and the corners
    points = (
        belief.pose[..., None, :2]
        + (unit_points[:, 0] * half[..., :1])[..., None] * forward[..., None, :]
        + (unit_points[:, 1] * half[..., 1:])[..., None] * lateral[..., None, :]
    )
    present = belief.kind != AgentKind.NONE
    occludes = present & (
        np.isin(belief.kind, OCCLUDERS)
        | ((belief.kind == AgentKind.PROP) & (belief.size >= MIN_OCCLUDING_PROP).all(-1))
    )
    unobstructed = np.hypot(*np.moveaxis(points - eye[:, None, None], -1, 0)) <= np.reshape(reach, (-1, 1, 1))
    for occluder in np.flatnonzero(occludes.any(0)).tolist():
        axes = np.stack([forward[:, occluder], lateral[:, occluder]], 1)  # [B, 2, 2]
        start = np.einsum("bij,bj->bi", axes, eye - belief.pose[:, occluder, :2])
        direction = (
            np.einsum("bij,bknj->bkni", axes, points - belief.pose[:, None, None, occluder, :2]) - start[:, None, None]
        )
        # the part of the line, from 0 to 1, that lies between each pair of opposite sides
        step = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
        first_hit = (-half[:, None, None, occluder] - start[:, None, None]) / step
        second_hit = (half[:, None, None, occluder] - start[:, None, None]) / step
        entry = np.minimum(first_hit, second_hit).max(-1)
        departure = np.maximum(first_hit, second_hit).min(-1)
        blocked = (entry < departure) & (departure > 0.0) & (entry < 1.0)
        blocked[:, occluder] = False
        is_inside = (np.abs(start) <= half[:, occluder]).all(-1)  # an object at the viewpoint itself occludes nothing
        unobstructed &= ~(blocked & (occludes[:, occluder] & ~is_inside)[:, None, None])
    visible: Bool = present & unobstructed.any(-1)
    return visible

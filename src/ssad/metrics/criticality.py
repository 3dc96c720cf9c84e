"""How close an episode came to a collision: time to collision, post-encroachment time, distance of the bodies.

Bodies are oriented boxes in the plane. All functions take the ego (agent 0) against every other agent that is present.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ssad.core.geometry import obb_distance
from ssad.core.types import F64, Bool, EpisodeTrace

CAP = 10.0
"""Largest TTC and PET, s: nothing later counts as a conflict (the cap of FREA's PET)."""


def boxes(trace: EpisodeTrace) -> F64:
    """[T, A, 5] x, y, yaw, length, width."""
    shape = trace.x.shape
    size = [np.broadcast_to(value, shape) for value in (trace.length, trace.width)]
    return np.stack([trace.x, trace.y, trace.yaw, *size], axis=-1).astype(np.float64)


def time_to_collision(first: npt.ArrayLike, second: npt.ArrayLike, velocity: npt.ArrayLike) -> F64:
    """Time until two boxes touch, s; exact for boxes that move at constant velocity and do not turn.

    Along each of the four edge normals the shadows of the boxes overlap during one interval of time, and convex bodies
    overlap when all four do (separating axes, swept).

    Args:
        first: Boxes [..., 5]: x, y, yaw, length, width.
        second: Boxes of the same kind.
        velocity: Velocity of the first minus that of the second [..., 2], m/s.

    Returns:
        Times [...]: 0 if they overlap, inf if they never do.
    """
    a, b, v = (np.asarray(value, np.float64) for value in (first, second, velocity))
    gap = b[..., :2] - a[..., :2]
    shape = np.broadcast_shapes(gap.shape[:-1], v.shape[:-1])
    enter = np.zeros(shape)
    leave = np.full(shape, np.inf)
    for yaw in (a[..., 2], a[..., 2] + 0.5 * np.pi, b[..., 2], b[..., 2] + 0.5 * np.pi):
        cos, sin = np.cos(yaw), np.sin(yaw)
        centre = cos * gap[..., 0] + sin * gap[..., 1]
        speed = cos * v[..., 0] + sin * v[..., 1]
        reach = _shadow(a, yaw) + _shadow(b, yaw)
        # below a micrometre a second nothing moves along this axis
        moving = np.abs(speed) > 1e-6
        inverse = 1.0 / np.where(moving, speed, 1.0)
        middle, half = centre * inverse, np.abs(reach * inverse)
        inside = np.abs(centre) <= reach
        enter = np.maximum(enter, np.where(moving, middle - half, np.where(inside, 0.0, np.inf)))
        leave = np.minimum(leave, np.where(moving, middle + half, np.where(inside, np.inf, -np.inf)))
    return np.where(enter <= leave, enter, np.inf)


def ttc(trace: EpisodeTrace) -> F64:
    """Time to collision [T, A - 1] of the ego with each other agent, s; inf: not on course for one, or not present.

    Both keep their speed and heading of the step.
    """
    box = boxes(trace)
    speed = trace.speed.astype(np.float64)
    velocity = np.stack([speed * np.cos(box[..., 2]), speed * np.sin(box[..., 2])], axis=-1)
    result = time_to_collision(box[:, :1], box[:, 1:], velocity[:, :1] - velocity[:, 1:])
    return np.where(_present(trace), result, np.inf)


def min_ttc(trace: EpisodeTrace, *, cap: float = CAP) -> float:
    """Least time to collision over steps and agents, s, at most `cap`."""
    return min(float(ttc(trace).min(initial=np.inf)), cap)


def min_distance(trace: EpisodeTrace) -> float:
    """Least distance of the ego's box from another agent's, m; NaN if nobody else was ever present."""
    box = boxes(trace)
    present = _present(trace)
    step, agent = np.nonzero(present)
    if len(step) == 0:
        return math.nan
    return float(obb_distance(box[step, 0], box[step, agent + 1]).min())


def post_encroachment_time(trace: EpisodeTrace, *, cap: float = CAP) -> float:
    """Least post-encroachment time, s, at most `cap`: 0 if the ego touched somebody.

    At a point of the plane it is the time from when the first of two bodies leaves the point until the other reaches
    it; this is the least over all points and all other agents. It equals the least |t_i - t_j| for which the ego's box
    at t_i overlaps the other's at t_j, which is what is searched, in steps of the trace and with no grid. A car that
    follows on the same path counts: its value is the time gap.
    """
    box = boxes(trace)
    steps = len(box)
    active = trace.active
    radius = 0.5 * np.hypot(trace.length, trace.width).astype(np.float64)
    for lag in range(min(round(cap / trace.dt), steps - 1) + 1):
        early, late = slice(0, steps - lag), slice(lag, steps)
        for ego, other in ((early, late), (late, early)):
            offset = box[other, 1:, :2] - box[ego, :1, :2]
            near = np.hypot(offset[..., 0], offset[..., 1]) <= radius[0] + radius[1:]
            step, agent = np.nonzero(near & active[other, 1:] & active[ego, :1])
            if len(step) and _overlap(box[ego, 0][step], box[other, 1:][step, agent]).any():
                return min(lag * float(trace.dt), cap)
    return cap


def _present(trace: EpisodeTrace) -> Bool:
    return np.asarray(trace.active[:, 1:] & trace.active[:, :1])


def _shadow(box: F64, yaw: F64) -> F64:
    """Half the length [...] of a box's shadow on the axis of direction yaw."""
    turn = yaw - box[..., 2]
    return np.asarray(0.5 * (np.abs(np.cos(turn)) * box[..., 3] + np.abs(np.sin(turn)) * box[..., 4]))


def _overlap(a: F64, b: F64) -> Bool:
    return np.asarray(obb_distance(a, b) <= 0.0)

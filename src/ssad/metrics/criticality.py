"""Criticality of episodes: time to collision, post-encroachment time, distance of the bodies.

Bodies are oriented boxes in the plane. All functions compare the ego (agent 0) with every other active agent.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ssad.core.geometry import obb_distance
from ssad.core.types import F64, Bool, EpisodeTrace

DEFAULT_CAP = 10.0
"""Largest TTC and PET, s: nothing later counts as a conflict (the cap of FREA's PET)."""


def trace_boxes(trace: EpisodeTrace) -> F64:
    """Return the boxes [T, A, 5] of a trace: x, y, yaw, length, width."""
    shape = trace.x.shape
    size = [np.broadcast_to(value, shape) for value in (trace.length, trace.width)]
    return np.stack([trace.x, trace.y, trace.yaw, *size], axis=-1).astype(np.float64)


def time_to_collision(first: npt.ArrayLike, second: npt.ArrayLike, velocity: npt.ArrayLike) -> F64:
    """Return the time until two boxes touch, s; exact for boxes that move at constant velocity and do not turn.

    Along each of the four edge normals the projections of the boxes overlap during one interval of time; convex
    bodies overlap when all four do (swept separating axes).

    Args:
        first: Boxes [..., 5]: x, y, yaw, length, width.
        second: Boxes of the same kind.
        velocity: Velocity of the first minus that of the second [..., 2], m/s.

    Returns:
        Times [...]: 0 if they overlap, inf if they never do.
    """
    first_box, second_box, relative_velocity = (np.asarray(value, np.float64) for value in (first, second, velocity))
    offset = second_box[..., :2] - first_box[..., :2]
    shape = np.broadcast_shapes(offset.shape[:-1], relative_velocity.shape[:-1])
    entry_time = np.zeros(shape)
    exit_time = np.full(shape, np.inf)
    for yaw in (
        first_box[..., 2],
        first_box[..., 2] + 0.5 * np.pi,
        second_box[..., 2],
        second_box[..., 2] + 0.5 * np.pi,
    ):
        cos, sin = np.cos(yaw), np.sin(yaw)
        centre = cos * offset[..., 0] + sin * offset[..., 1]
        speed = cos * relative_velocity[..., 0] + sin * relative_velocity[..., 1]
        half_extent = _shadow(first_box, yaw) + _shadow(second_box, yaw)
        # slower than a micrometre a second counts as standing still along this axis
        moving = np.abs(speed) > 1e-6
        inverse = 1.0 / np.where(moving, speed, 1.0)
        centre_time, half_duration = centre * inverse, np.abs(half_extent * inverse)
        is_inside = np.abs(centre) <= half_extent
        entry_time = np.maximum(
            entry_time, np.where(moving, centre_time - half_duration, np.where(is_inside, 0.0, np.inf))
        )
        exit_time = np.minimum(
            exit_time, np.where(moving, centre_time + half_duration, np.where(is_inside, np.inf, -np.inf))
        )
    return np.where(entry_time <= exit_time, entry_time, np.inf)


def ttc(trace: EpisodeTrace) -> F64:
    """Return the time to collision [T, A - 1] of the ego with each other agent, s.

    Both keep their speed and heading of the step. inf: not on a collision course, or not present.
    """
    body_boxes = trace_boxes(trace)
    speed = trace.speed.astype(np.float64)
    velocity = np.stack([speed * np.cos(body_boxes[..., 2]), speed * np.sin(body_boxes[..., 2])], axis=-1)
    collision_time = time_to_collision(body_boxes[:, :1], body_boxes[:, 1:], velocity[:, :1] - velocity[:, 1:])
    return np.where(_presence(trace), collision_time, np.inf)


def min_ttc(trace: EpisodeTrace, *, cap: float = DEFAULT_CAP) -> float:
    """Return the minimum time to collision over steps and agents, s, at most `cap`."""
    return min(float(ttc(trace).min(initial=np.inf)), cap)


def min_distance(trace: EpisodeTrace) -> float:
    """Least distance of the ego's box from another agent's, m; NaN if nobody else was ever present."""
    body_boxes = trace_boxes(trace)
    present = _presence(trace)
    step, agent = np.nonzero(present)
    if len(step) == 0:
        return math.nan
    return float(obb_distance(body_boxes[step, 0], body_boxes[step, agent + 1]).min())


def post_encroachment_time(trace: EpisodeTrace, *, cap: float = DEFAULT_CAP) -> float:
    """Return the minimum post-encroachment time, s, at most `cap`; 0 if the ego touched another agent.

    At a point of the plane it is the time from when the first of two bodies leaves the point until the other
    reaches it, minimised over all points and all other agents. It equals the smallest |t_i - t_j| for which the
    ego's box at t_i overlaps the other's at t_j, which is searched in steps of the trace, without a grid. A car
    that follows on the same path counts: its value is the time gap.
    """
    body_boxes = trace_boxes(trace)
    steps = len(body_boxes)
    active = trace.active
    radius = 0.5 * np.hypot(trace.length, trace.width).astype(np.float64)
    # Lags ascend, so the first overlap is the minimum.
    for lag in range(min(round(cap / trace.dt), steps - 1) + 1):
        early_steps, late_steps = slice(0, steps - lag), slice(lag, steps)
        for ego, other_steps in ((early_steps, late_steps), (late_steps, early_steps)):
            offset = body_boxes[other_steps, 1:, :2] - body_boxes[ego, :1, :2]
            # Circles around the bodies rule out most pairs before the exact test.
            is_near = np.hypot(offset[..., 0], offset[..., 1]) <= radius[0] + radius[1:]
            step, agent = np.nonzero(is_near & active[other_steps, 1:] & active[ego, :1])
            if len(step) and _overlap(body_boxes[ego, 0][step], body_boxes[other_steps, 1:][step, agent]).any():
                return min(lag * float(trace.dt), cap)
    return cap


def _presence(trace: EpisodeTrace) -> Bool:
    return np.asarray(trace.active[:, 1:] & trace.active[:, :1])


def _shadow(box: F64, yaw: F64) -> F64:
    """Return half the length [...] of a box's projection on the axis of direction yaw."""
    relative_angle = yaw - box[..., 2]
    return np.asarray(
        0.5 * (np.abs(np.cos(relative_angle)) * box[..., 3] + np.abs(np.sin(relative_angle)) * box[..., 4])
    )


def _overlap(first: F64, second: F64) -> Bool:
    return np.asarray(obb_distance(first, second) <= 0.0)

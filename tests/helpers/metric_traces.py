"""Tiny traces whose metrics can be worked out by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ssad.core.types import EpisodeTrace

Body = tuple[Any, Any, Any, Any]
"""x, y, yaw, speed, each a number or one a step."""


def make_trace(
    steps: int = 11,
    bodies: Sequence[Body] = ((0.0, 0.0, 0.0, 0.0),),
    *,
    dt: float = 0.1,
    size: tuple[float, float] = (4.0, 2.0),
    **changes: Any,
) -> EpisodeTrace:
    """A trace of agents 4 m x 2 m that stand at the origin unless told otherwise; `changes` replace ego columns."""
    agents = len(bodies)
    column = [np.stack([np.broadcast_to(np.asarray(b[k], np.float32), steps) for b in bodies], 1) for k in range(4)]
    zero = np.zeros(steps, np.float32)
    none = np.zeros(steps, np.uint8)
    trace = EpisodeTrace(
        key="test",
        town="Nowhere",
        dt=dt,
        names=tuple(f"agent{i}" for i in range(agents)),
        models=("car",) * agents,
        kind=np.ones(agents, np.uint8),
        length=np.full(agents, size[0], np.float32),
        width=np.full(agents, size[1], np.float32),
        x=column[0],
        y=column[1],
        yaw=column[2],
        speed=column[3],
        active=np.ones((steps, agents), np.bool_),
        accel=zero,
        contact=none,
        contact_agent=np.full(steps, -1, np.int32),
        off_road=np.zeros(steps, np.bool_),
        route_distance=zero,
        route_complete=np.full(steps, 100.0, np.float32),
        driven=zero,
        lane_invasion=none,
        red_light=none,
        stop_sign=none,
        throttle=zero,
        brake=zero,
        steer=zero,
        signal_ids=np.zeros(0, np.int32),
        signal=np.zeros((steps, 0), np.uint8),
        route=np.array([[0.0, 0.0], [100.0, 0.0]], np.float32),
        end="complete",
    )
    for name, value in changes.items():
        now = getattr(trace, name)
        if isinstance(now, np.ndarray):
            changes[name] = np.broadcast_to(np.asarray(value, now.dtype), now.shape)
    return replace(trace, **changes)


def straight(x: float, y: float, yaw: float, speed: float, steps: int) -> Body:
    """A body that goes straight on at a constant speed, 0.1 s a step."""
    time = np.arange(steps) * 0.1
    return (x + speed * np.cos(yaw) * time, y + speed * np.sin(yaw) * time, yaw, speed)

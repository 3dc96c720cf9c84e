"""Checks of the tracks that a tracker returns, and the belief that they make."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from ssad.core.driving import Belief
from ssad.core.errors import ConfigError
from ssad.core.perception import I64, Tracks
from ssad.core.types import I32, AgentKind


def check_tracks(tracks: Any, scenes: I32 | I64, tracker: str) -> None:
    """Check the type, the shapes and the scenes of the tracks that a tracker returned.

    Args:
        tracks: Returned object.
        scenes: [n] scenes that it was asked for.
        tracker: Name of the tracker, for the message.

    Raises:
        ConfigError: It is no `Tracks`, or a column does not fit; the message names the column.
    """
    if not isinstance(tracks, Tracks):
        raise ConfigError(
            f"tracker {tracker}: confirmed returned {type(tracks).__name__}; return a ssad.core.perception.Tracks"
        )
    count = len(np.atleast_1d(tracks.scene))
    for column in fields(Tracks):
        shape = np.shape(getattr(tracks, column.name))
        expected = (count, 2) if column.name in ("place", "velocity", "size") else (count,)
        if shape != expected:
            raise ConfigError(f"tracker {tracker}: {column.name} has shape {shape}; expected {expected}")
    if count and not np.isin(tracks.scene, scenes).all():
        raise ConfigError(f"tracker {tracker}: confirmed returned a track of a scene that it was not asked for")


def belief_from_tracks(tracks: Tracks, scenes: I32 | I64) -> Belief:
    """Convert tracks to the belief of the planner: pose, speed, size and kind.

    Args:
        tracks: Tracks of exactly these scenes.
        scenes: [N] scene of each row of the belief.
    """
    row = np.full(int(np.max(scenes, initial=-1)) + 1, -1)
    row[scenes] = np.arange(len(scenes))
    belief_row = row[tracks.scene]
    order = np.argsort(belief_row, kind="stable")
    tracks, belief_row = tracks.take(order), belief_row[order]
    count = np.bincount(belief_row, minlength=len(scenes))
    slot = np.arange(len(tracks)) - np.repeat(np.cumsum(count) - count, count)
    shape = (len(scenes), max(int(count.max(initial=0)), 1))
    pose, size = np.zeros((*shape, 3), np.float32), np.ones((*shape, 2), np.float32)
    speed, kind = np.zeros(shape, np.float32), np.full(shape, int(AgentKind.NONE), np.int32)
    yaw = tracks.yaw
    pose[belief_row, slot, :2], pose[belief_row, slot, 2] = tracks.place, yaw
    speed[belief_row, slot] = tracks.velocity[:, 0] * np.cos(yaw) + tracks.velocity[:, 1] * np.sin(yaw)
    size[belief_row, slot], kind[belief_row, slot] = tracks.size, tracks.kind
    return Belief(pose, speed, size, kind)

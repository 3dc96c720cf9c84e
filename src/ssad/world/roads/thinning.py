"""Thinning of sampled lanes: few points whose chords stay close to the curve, for all lanes of a map at once."""

from __future__ import annotations

import numpy as np

from ssad.core.types import F64
from ssad.world.roads.reference_line import Index

STEP = 2.0  # m, most between two points of a lane
BEND = 0.01  # m, most that a chord leaves the curve


def thin(first: Index, s: F64, yaw: F64, width: F64) -> list[Index]:
    """Return the samples to keep of each lane: greedily, the fewest whose chords stay close to curve and width.

    Args:
        first: Samples of lane i are first[i]:first[i+1] [L+1].
        s: Arc length along the lane [P], m.
        yaw: Direction [P], rad, without jumps.
        width: [P], m.

    Returns:
        Sorted rows of the samples, for each lane; chords are at most `STEP` long and leave the curve by at most `BEND`.
    """
    count = len(s)
    last = np.repeat(first[1:] - 1, np.diff(first))
    following = np.minimum(np.arange(count) + 1, last)  # the furthest end of a chord that begins at a sample
    rows = np.flatnonzero(following < last)
    low, high = np.minimum(yaw[rows], yaw[rows + 1]), np.maximum(yaw[rows], yaw[rows + 1])
    reach = 1
    while len(rows):
        reach += 1
        end = rows + reach
        chord = s[end] - s[rows]
        low, high = np.minimum(low, yaw[end]), np.maximum(high, yaw[end])
        # The sagitta of an arc is chord times turn over 8.
        fits = (chord <= STEP + 1e-6) & (chord * (high - low) / 8.0 <= BEND)
        for inner in range(1, reach):
            middle = rows + inner
            linear = width[rows] + (width[end] - width[rows]) * (s[middle] - s[rows]) / chord
            fits &= np.abs(width[middle] - linear) <= 2.0 * BEND
        rows, low, high, end = rows[fits], low[fits], high[fits], end[fits]
        following[rows] = end
        open_rows = end < last[rows]
        rows, low, high = rows[open_rows], low[open_rows], high[open_rows]
    steps = following.tolist()
    selected = []
    for start, stop in zip(first[:-1].tolist(), first[1:].tolist(), strict=True):
        kept = [start]
        while kept[-1] < stop - 1:
            kept.append(steps[kept[-1]])
        selected.append(np.array(kept, np.int64))
    return selected

"""A driving system: follows its lane, and brakes for whoever is ahead."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Observation
from ssad.core.types import Episode


class Careful:
    """Follows its lane, and brakes for whoever is ahead.

    Args:
        reach: How far ahead it looks, m; in a suite `example-careful?reach=8`.
    """

    def __init__(self, reach: float = 15.0) -> None:
        self.reach = reach

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Nothing to forget; a system with a memory begins it anew, one row an episode."""

    def snapshot(self) -> Mapping[str, npt.NDArray[Any]]:
        """Nothing is remembered; a system with a memory returns its arrays by name, a row for each episode.

        With this and `restore`, `ssad run how-often` measures the system by splitting and importance sampling too.
        """
        return {}

    def restore(self, states: Mapping[str, npt.NDArray[Any]]) -> None:
        """Nothing to set; a system with a memory continues from these arrays."""

    def act(self, view: Observation) -> npt.NDArray[np.float32]:
        """Throttle, brake and steer [N, 3] (left is positive) of N egos, ten times a simulated second."""
        x, y, kind = view.others[..., 0], view.others[..., 1], view.others[..., 6]  # m, in the ego's frame; 0: nobody
        danger = ((kind > 0) & (x > 0) & (x < self.reach) & (np.abs(y) < 2)).any(1)
        slow = (view.speed < view.target_speed) & ~danger
        steer = np.clip(np.arctan2(view.route[:, 6, 1], view.route[:, 6, 0]) * 1.5, -1, 1)
        return np.stack([slow, danger, steer], 1).astype(np.float32)

"""A planner: follows the route, and brakes for whoever the driver believes ahead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Belief, Observation
from ssad.core.geometry import to_local
from ssad.core.types import Episode


class Brake:
    """Planner that brakes for every believed object in its lane.

    Args:
        reach: Distance ahead within which it brakes, m; in a suite `planner: {example-brake: {reach: 10}}`.
    """

    def __init__(self, reach: float = 15.0) -> None:
        self.reach = reach

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Do nothing: the planner has no memory."""

    def plan(self, view: Observation, belief: Belief) -> npt.NDArray[np.float32]:
        """Return throttle, brake and steer [N, 3] of N egos."""
        place = to_local(view.pose[:, None], belief.pose[..., :2])  # [N, K, 2] in the frames of the egos
        is_ahead = (place[..., 0] > 0) & (place[..., 0] < self.reach) & (np.abs(place[..., 1]) < 2)
        brake = (is_ahead & (belief.kind > 0)).any(1)
        throttle = (view.speed < view.target_speed) & ~brake
        steer = np.clip(np.arctan2(view.route[:, 6, 1], view.route[:, 6, 0]) * 1.5, -1, 1)
        return np.stack([throttle, brake, steer], 1).astype(np.float32)

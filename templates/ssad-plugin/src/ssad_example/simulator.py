"""A simulator: SSAD's world, in which the brakes of driven vehicles are worn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from ssad import World
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Episode


class WornBrakes(World):
    """World that scales the brake of every driver that `Driver.act` controls; the Autopilot keeps its own.

    A simulator need not derive from `World`: it is called with the episodes, the lane graphs of their towns and a
    device, and has the methods of `ssad.core.driving.Simulator`. `ssad.world.check.check_simulator` tests it.

    Args:
        episodes: Episodes to run side by side.
        graphs: Lane graph of each of their towns.
        device: cpu or cuda.
        brake: Share of the brake that is left; in a suite `simulator: example-worn-brakes?brake=0.5`.
        assign: Number of the episode of each scene; None: one scene an episode.
    """

    def __init__(
        self,
        episodes: Sequence[Episode],
        graphs: Mapping[str, LaneGraph],
        *,
        device: str = "cpu",
        brake: float = 0.3,
        assign: npt.ArrayLike | None = None,
    ) -> None:
        super().__init__(episodes, graphs, device=device, assign=None if assign is None else np.asarray(assign))
        self.brake = brake

    def set_controls(self, controls: npt.ArrayLike) -> None:
        """Take the controls [B, A, 3 or 4]: throttle, brake, steer, reverse."""
        worn = np.array(controls, np.float32)
        worn[..., 1] *= self.brake
        super().set_controls(worn)

"""The built-in planner of perceiving drivers."""

from __future__ import annotations

from collections.abc import Sequence

from ssad.core.driving import Belief, Observation
from ssad.core.types import F32, Controller, Episode


class AutopilotPlanner:
    """The planner and controller of the Autopilot, which run inside the world over the belief of the driver."""

    controller = Controller.AUTOPILOT

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Do nothing: the Autopilot runs inside the world."""

    def plan(self, view: Observation, belief: Belief) -> F32:
        """Raise RuntimeError: the Autopilot runs inside the world."""
        raise RuntimeError("the Autopilot runs inside the world")

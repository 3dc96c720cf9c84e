"""Driving systems that run inside the world: the privileged Autopilot and route followers."""

from __future__ import annotations

from collections.abc import Sequence

from ssad.core.driving import Observation
from ssad.core.types import F32, Controller, Episode


class Autopilot:
    """Privileged rule-based driver, the same as the background traffic: lane following, IDM, signals, yielding.

    Counterpart of the paper's Autopilot (CARLA's traffic manager). It reads the true state of all agents.
    """

    name = "autopilot"
    controller = Controller.AUTOPILOT

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Do nothing: the Autopilot runs inside the world."""

    def act(self, view: Observation) -> F32:
        """Raise RuntimeError: the Autopilot runs inside the world."""
        raise RuntimeError("the Autopilot runs inside the world")


class Blind:
    """Route follower at 10 m/s (36 km/h; slower in bends) that ignores all other agents: the lower bound."""

    name = "blind"
    controller = Controller.FOLLOW
    target_speed: float | None = 10.0

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Do nothing: the follower runs inside the world."""

    def act(self, view: Observation) -> F32:
        """Raise RuntimeError: the follower runs inside the world."""
        raise RuntimeError("the blind follower runs inside the world")


class NoAction(Blind):
    """Route follower at the scenario's target speed (slower in bends) that ignores all other agents: no action.

    The baseline of test protocols, in which the ego holds the test speed up to the impact.
    """

    name = "no-action"
    target_speed = None

"""The two systems that run inside the world: the privileged Autopilot and the blind route follower."""

from __future__ import annotations

from collections.abc import Sequence

from ssad.core.driving import Observation
from ssad.core.types import F32, Controller, Episode


class Autopilot:
    """Privileged rule-based driver, the same as the background traffic: lane following, IDM, signals, yielding.

    Counterpart of the paper's Autopilot (CARLA's traffic manager). It reads the true state of everybody.
    """

    name = "autopilot"
    controller = Controller.AUTOPILOT

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Nothing to forget: it runs inside the world."""

    def act(self, view: Observation) -> F32:
        """Never called: it runs inside the world."""
        raise RuntimeError("the Autopilot runs inside the world")


class Blind:
    """Keeps its route at 10 m/s (36 km/h; slower in bends) and sees nothing: the floor that any system must beat."""

    name = "blind"
    controller = Controller.FOLLOW
    target_speed = 10.0

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Nothing to forget: it runs inside the world."""

    def act(self, view: Observation) -> F32:
        """Never called: it runs inside the world."""
        raise RuntimeError("the blind follower runs inside the world")

"""An adversary of your own: a vehicle before the ego that brakes hard, as a generator."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Driver, Observation, Selector
from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.types import Controller, Episode
from ssad.world.selection import FreaSelection


class Braking:
    """A driver that brakes and steers straight on; a learned one reads `view.readings` of its `sensors`."""

    name, controller = "example-braking", Controller.EXTERNAL

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Nothing to forget."""

    def act(self, view: Observation) -> npt.NDArray[np.float32]:
        """Throttle, brake and steer [N, 3] of N adversaries."""
        return np.tile(np.array([0.0, 1.0, 0.0], np.float32), (len(view.speed), 1))


class BrakeTest:
    """The vehicle nearest to the ego brakes as soon as it is within a distance; one rollout for each base.

    Args:
        bases: Scenarios to start from.
        seeds: Not used: it draws nothing.
        budget: Not used beyond 1.
        radius: Distance from which it brakes, m; in a suite `example-brake-test?radius=15`.
    """

    name = "example-brake-test"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int, radius: float = 25.0) -> None:
        self._bases = bases
        # Bases that run side by side share a driver by sharing this mapping.
        self._drivers: dict[Selector, Driver] = {FreaSelection(count=1, radius=radius): Braking()}
        self._has_proposed = False

    def ask(self, count: int) -> list[list[Proposal]]:
        """Each base once, with the vehicle taken over."""
        first, self._has_proposed = not self._has_proposed, True
        return [[Proposal(base.scenario, drivers=self._drivers)] if first and count else [] for base in self._bases]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Nothing to learn; one that learns looks at `Outcome.proof_value`."""

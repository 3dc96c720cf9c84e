"""Base of the adapters of foreign simulators, backed by an embedded world that mirrors their state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ssad.core.driving import Belief, WorldState
from ssad.core.types import I32, Bool, Controller
from ssad.world.world import World


class MirroredSimulator:
    """A simulator whose state is copied into an embedded world at each step.

    Attributes:
        mirror: The world that mirrors it; it holds the drivers, the beliefs of egos and the outcomes of
            episodes.
    """

    mirror: World

    def state(self) -> WorldState:
        """Return the state of all agents."""
        return self.mirror.state()

    @property
    def measured(self) -> Mapping[str, Any]:
        """Return what the simulator's own sensors have measured in this episode, beyond the mirror's measurements."""
        return {}

    def ended(self) -> I32:
        """Return [B] the reasons why scenes ended, as indices into ENDS."""
        return self.mirror.ended()

    def take(
        self, agents: Bool, controller: Controller | None, *, policy: int = -1, target_speed: float | None = None
    ) -> None:
        """Hand agents over to another driver, as `World.take`."""
        self.mirror.take(agents, controller, policy=policy, target_speed=target_speed)

    def believe(self, belief: Belief | None, scenes: Bool | None = None) -> None:
        """Store the beliefs of egos, as `World.believe`."""
        self.mirror.believe(belief, scenes)

    def truth(self) -> Belief:
        """Return the truth as a belief, as `World.truth`."""
        return self.mirror.truth()

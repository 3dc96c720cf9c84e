"""What every adapter of a foreign simulator answers from the embedded world that follows it, its mirror."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ssad.core.driving import Belief, WorldState
from ssad.core.types import I32, Bool, Controller
from ssad.world.world import World


class Mirrored:
    """A simulator whose state is copied into an embedded world at each step.

    Attributes:
        mirror: The world that follows; it holds who drives whom, what egos believe and how episodes went.
    """

    mirror: World

    def state(self) -> WorldState:
        """Where everybody is."""
        return self.mirror.state()

    @property
    def measured(self) -> Mapping[str, Any]:
        """What it has counted in this episode by sensors of its own, beside what the mirror measures."""
        return {}

    def ended(self) -> I32:
        """[B] why scenes ended, an index into ENDS."""
        return self.mirror.ended()

    def take(
        self, agents: Bool, controller: Controller | None, *, policy: int = -1, target_speed: float | None = None
    ) -> None:
        """Let somebody else drive agents, as `World.take`."""
        self.mirror.take(agents, controller, policy=policy, target_speed=target_speed)

    def believe(self, belief: Belief | None, scenes: Bool | None = None) -> None:
        """Hand in what egos believe, as `World.believe`."""
        self.mirror.believe(belief, scenes)

    def truth(self) -> Belief:
        """The truth as a belief, as `World.truth`."""
        return self.mirror.truth()

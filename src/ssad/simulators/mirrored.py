"""Base of the adapters of foreign simulators, backed by an embedded world that mirrors their state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ssad.core.driving import Belief, WorldState
from ssad.core.errors import ConfigError
from ssad.core.types import I32, Bool, Controller, Episode, Phase
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


# Keys of a phase that state the course of a speed. A foreign simulator moves its vehicles by its own dynamics, so that
# pedals alone cannot keep to them.
_COURSE = ("acceleration", "jerk", "shape", "duration", "distance", "arrival", "gap")


def check_phases(episodes: Sequence[Episode], simulator: str) -> None:
    """Check that a foreign simulator can carry out the phases of all scripted agents.

    Args:
        episodes: The episodes.
        simulator: Name of the simulator, for the message.

    Raises:
        ConfigError: A phase states the course of its speed, or an agent has lateral phases.
    """
    for episode in episodes:
        for agent in episode.agents:
            stated = [
                f"{key} in phase {number + 1}"
                for number, phase in enumerate(agent.phases)
                for key in _COURSE
                if getattr(phase, key) != getattr(Phase, key)
            ]
            if agent.lateral:
                stated.append("lateral phases")
            if stated:
                raise ConfigError(
                    f"scenario {episode.scenario.name}: {simulator} cannot carry out the motion of actor {agent.name}"
                    f" ({stated[0]}); leave it out, or run the scenario in the embedded world"
                )

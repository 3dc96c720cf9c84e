"""Learned driving systems: a policy (`ssad.world.policy`) in the driver's seat."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ssad.core.driving import Observation
from ssad.core.types import F32, Controller, Episode
from ssad.world.policy import Policy, load_policy

SHIPPED = Path(__file__).parent / "weights"


class Learned:
    """Drives by a policy; deterministic, without memory, for any number of agents at once.

    Attributes:
        policy: What it does.
        version: Hash of its weights.
    """

    controller = Controller.EXTERNAL

    def __init__(self, name: str, weights: str | Path | None = None) -> None:
        """A driver.

        Args:
            name: ppo, sac or td3; with weights, whatever tables should call it.
            weights: NAME.safetensors with its card beside it, as `ssad train driver` writes them; None: the shipped
                ones.

        Raises:
            FormatError: The weights are missing or broken, or are not those of a policy.
        """
        self.name = name
        self.policy: Policy = load_policy(SHIPPED / f"{name}.safetensors" if weights is None else weights)
        self.version = self.policy.card.hash
        self.sensors = (self.policy.observation,)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Nothing to forget."""

    def act(self, view: Observation) -> F32:
        """Throttle, brake, steer and reverse [N, 4] from what its sensor shows."""
        return self.policy.controls(view.readings[self.policy.observation])


class PPO(Learned):
    """Proximal policy optimisation (Schulman et al. 2017), with the shipped weights."""

    def __init__(self) -> None:
        super().__init__("ppo")


class SAC(Learned):
    """Soft actor-critic (Haarnoja et al. 2018), with the shipped weights."""

    def __init__(self) -> None:
        super().__init__("sac")


class TD3(Learned):
    """Twin delayed DDPG (Fujimoto et al. 2018), with the shipped weights."""

    def __init__(self) -> None:
        super().__init__("td3")

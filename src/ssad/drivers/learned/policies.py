"""Learned driving systems: a policy (`ssad.world.policy`) in the driver's seat.

Each has the shipped weights, or others: NAME.safetensors with its card beside it, as `ssad train driver` writes them.
FormatError: they are missing or broken, or are not those of a policy.
"""

from __future__ import annotations

from pathlib import Path

from ssad.world.policy import PolicyDriver, load_policy

SHIPPED = Path(__file__).parent / "weights"


class PPO(PolicyDriver):
    """Proximal policy optimisation (Schulman et al. 2017)."""

    def __init__(self, weights: str | Path = SHIPPED / "ppo.safetensors") -> None:
        super().__init__(load_policy(weights), name="ppo")


class SAC(PolicyDriver):
    """Soft actor-critic (Haarnoja et al. 2018)."""

    def __init__(self, weights: str | Path = SHIPPED / "sac.safetensors") -> None:
        super().__init__(load_policy(weights), name="sac")


class TD3(PolicyDriver):
    """Twin delayed DDPG (Fujimoto et al. 2018)."""

    def __init__(self, weights: str | Path = SHIPPED / "td3.safetensors") -> None:
        super().__init__(load_policy(weights), name="td3")

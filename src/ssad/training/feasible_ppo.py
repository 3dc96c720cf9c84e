"""PPO with a feasible region as a second critic: the adversary seeks its goal while the ego can avoid a collision.

If the ego is outside the region before or after a step, the step counts by the decrease of the region's value instead
of its reward. Needs stable-baselines3.

Source: FREA (Chen et al. 2024, arXiv 2406.02983), the advantage of its constrained policy optimisation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.buffers import RolloutBuffer

from ssad.core.types import F32
from ssad.training.adversary_env import AdversaryEnv


class FeasibleBuffer(RolloutBuffer):  # type: ignore[misc]  # stable-baselines3 may not be installed
    """Rollout buffer with advantages of the reward or of the feasible region, each with unit standard deviation.

    Args:
        environment: Environment that the steps come from; it must have a feasible region.
    """

    def __init__(self, *arguments: Any, environment: AdversaryEnv, **options: Any) -> None:
        self.environment = environment
        self.advantages: F32
        super().__init__(*arguments, **options)

    def reset(self) -> None:
        """Empty the buffer."""
        self.region_values = np.zeros((self.buffer_size, 2, self.n_envs), np.float32)
        self.is_driven = np.zeros((self.buffer_size, self.n_envs), bool)
        super().reset()

    def add(self, *arguments: Any, **options: Any) -> None:
        """Store a step of all scenes, with the values of the region before and after it."""
        self.region_values[self.pos] = self.environment.region_values
        self.is_driven[self.pos] = self.environment.is_driven
        super().add(*arguments, **options)

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: npt.NDArray[Any]) -> None:
        """Compute the returns of the reward, and the advantages of reward and region."""
        super().compute_returns_and_advantage(last_values, dones)
        before, after = self.region_values[:, 0], self.region_values[:, 1]
        starts = np.concatenate([self.episode_starts[1:], dones[None].astype(np.float32)])
        feasibility = np.zeros_like(before)
        advantage = np.zeros(self.n_envs, np.float32)
        for step in reversed(range(self.buffer_size)):
            advantage = before[step] - after[step] + self.gamma * self.gae_lambda * (1.0 - starts[step]) * advantage
            feasibility[step] = advantage
        self.advantages = compose_advantages(self.advantages, feasibility, before, after, self.is_driven)


def compose_advantages(reward: F32, feasibility: F32, before: F32, after: F32, is_driven: npt.NDArray[np.bool_]) -> F32:
    """Return the advantages [T, N] of steps: those of the reward where the ego is in the region before and after.

    Args:
        reward: [T, N] advantages of the reward.
        feasibility: [T, N] advantages of the region: decrease of its value from this step on.
        before: [T, N] value of the region before each step; above 0 the ego is outside.
        after: [T, N] the same after it.
        is_driven: [T, N] whether the scene had an adversary; the advantage is 0 elsewhere.
    """
    scaled = []
    for values in (reward, feasibility):
        driven = values[is_driven] if is_driven.any() else np.zeros(1, np.float32)
        scaled.append((values - driven.mean()) / (driven.std() + 1e-5))
    composed: F32 = np.where((before <= 0.0) & (after <= 0.0), *scaled)
    return np.where(is_driven, composed, 0.0).astype(np.float32)

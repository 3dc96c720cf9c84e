"""Seeded randomness in a world's traffic: the argument of `World(noise=...)` and the arrays behind it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.seeding import digest
from ssad.core.types import Episode
from ssad.world.kernels.data import array_types
from ssad.world.kernels.noise import NoiseRule, NoiseState

Keys = npt.NDArray[np.uint64]
NAMES = tuple(array_types(NoiseState))
_NEVER = 1.0e9


@dataclass(frozen=True)
class Noise:
    """Amount of randomness in traffic; by default there is none.

    Background Autopilots (not the ego) accelerate unevenly and make careless lane changes. The ego, if the world
    drives it (Autopilot, route follower), has lapses: it keeps steering, but holds throttle and brake. Each agent has
    two processes (Ornstein-Uhlenbeck, mean 0, variance 1): one is the unevenness of the acceleration; the other
    causes a lapse or a lane change to the left in its upper tail, and one to the right in its lower tail.

    Attributes:
        accel: Standard deviation of the acceleration of background Autopilots, m/s^2.
        accel_time: Time constant of the acceleration, s.
        lapse: Share of the time in which the ego is inattentive, in [0, 0.5].
        careless: Share of the time in which a background Autopilot would change lanes without looking, in [0, 0.5].
        choice_time: Time constant of lapses and carelessness, s: about how long they last.
        ramp: Duration of a careless lane change, s.
        stretches: Number of stretches of time into which the normal numbers behind the processes are divided, so that
            their means can be shifted (`noise.push`) and their sums read (`noise.total`). The first is the first step
            alone, which determines where the processes begin.
        stretch: Steps of each of the others; the last one continues to the end.
    """

    accel: float = 0.0
    accel_time: float = 1.0
    lapse: float = 0.0
    careless: float = 0.0
    choice_time: float = 1.0
    ramp: float = 2.0
    stretches: int = 1
    stretch: int = 10

    def __post_init__(self) -> None:
        shares = self.lapse, self.careless
        if not all(0.0 <= share <= 0.5 for share in shares) or not (0.0 <= self.accel < math.inf):
            raise ConfigError(
                f"noise needs accel >= 0 and lapse and careless in [0, 0.5], not {self.accel}, {self.lapse} and "
                f"{self.careless}"
            )
        if min(self.accel_time, self.choice_time, self.ramp) <= 0.0 or min(self.stretches, self.stretch) < 1:
            raise ConfigError("noise needs times above 0, and at least one stretch of at least one step")

    def rule(self, dt: float) -> Any:
        """Return the parameters as the kernels read them."""

        def beyond(share: float) -> float:
            return NormalDist().inv_cdf(1.0 - share) if share > 0.0 else _NEVER

        parameters = NoiseRule()
        parameters.accel = self.accel
        parameters.keep = wp.vec2(math.exp(-dt / self.accel_time), math.exp(-dt / self.choice_time))
        # The left and the right tail share the probability of a careless lane change.
        parameters.lapse, parameters.careless, parameters.ramp = (
            beyond(self.lapse),
            beyond(self.careless / 2.0),
            self.ramp,
        )
        parameters.stretch, parameters.stretches = self.stretch, self.stretches
        return parameters


def noise_state(
    noise: Noise, episodes: Sequence[Episode], order: npt.NDArray[np.int32], agents: int, device: str
) -> Any:
    """The arrays of as many scenes as `order` names episodes; keys are those of the episodes."""
    state = NoiseState()
    shape = (len(order), agents, noise.stretches)
    for name, array_type in array_types(NoiseState).items():
        setattr(state, name, wp.zeros(shape[: array_type.ndim], dtype=array_type.dtype, device=device))
    state.key.assign(episode_keys(episodes)[order])
    return state


def episode_keys(episodes: Sequence[Episode]) -> Keys:
    """Return the default key of each episode's randomness."""
    return np.array([int(digest("noise", episode.key, episode.seed)[:16], 16) for episode in episodes], np.uint64)

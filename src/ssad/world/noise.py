"""Seeded chance in a world's traffic: what `World(noise=...)` takes, and the arrays behind it."""

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
    """How much chance there is in traffic; with nothing set there is none.

    Background Autopilots (not the ego) accelerate unevenly, and change lane without looking. The ego, if the world
    drives it (Autopilot, route follower), has lapses: it steers on, but leaves throttle and brake as they are. Each
    agent has two processes (Ornstein-Uhlenbeck, mean 0, variance 1): one is the unevenness, and while the other is in
    its upper tail the agent has a lapse or changes lane to the left; in its lower tail, to the right.

    Attributes:
        accel: Standard deviation of the acceleration of background Autopilots, m/s^2.
        accel_time: Time in which it forgets, s.
        lapse: Share of the time that the ego does not attend, in [0, 0.5].
        careless: Share of the time in which a background Autopilot would change lane without looking, in [0, 0.5].
        choice_time: Time in which lapses and carelessness forget, s: about how long they last.
        ramp: How long a careless lane change takes, s.
        stretches: Into how many stretches of time the normal numbers behind the processes are divided, so that their
            means can be moved (`noise.push`) and their sums be read (`noise.total`). The first is the first step alone,
            which says where the processes begin.
        stretch: Steps of each of the others; the last one goes on to the end.
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
        """As the kernels read it."""

        def beyond(share: float) -> float:
            return NormalDist().inv_cdf(1.0 - share) if share > 0.0 else _NEVER

        rule = NoiseRule()
        rule.accel = self.accel
        rule.keep = wp.vec2(math.exp(-dt / self.accel_time), math.exp(-dt / self.choice_time))
        rule.lapse, rule.careless, rule.ramp = beyond(self.lapse), beyond(self.careless / 2.0), self.ramp
        rule.stretch, rule.stretches = self.stretch, self.stretches
        return rule


def noise_state(
    noise: Noise, episodes: Sequence[Episode], order: npt.NDArray[np.int32], agents: int, device: str
) -> Any:
    """The arrays of as many scenes as `order` names episodes; keys are those of the episodes."""
    state = NoiseState()
    shape = (len(order), agents, noise.stretches)
    for name, array in array_types(NoiseState).items():
        setattr(state, name, wp.zeros(shape[: array.ndim], dtype=array.dtype, device=device))
    state.key.assign(episode_keys(episodes)[order])
    return state


def episode_keys(episodes: Sequence[Episode]) -> Keys:
    """The key of each episode's chance, where nobody gives another one."""
    return np.array([int(digest("noise", e.key, e.seed)[:16], 16) for e in episodes], np.uint64)

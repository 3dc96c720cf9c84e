"""Autopilots that plan on less than the truth: objects in line of sight, or those of a poor perceiver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Belief, Believer, Observation
from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.core.types import F32, Controller, Episode
from ssad.core.visibility import is_visible
from ssad.drivers.builtin import Autopilot

_SLOTS = 64  # more than the agents of any scene: with fixed draws per step none depends on the number of agents


class LineOfSight(Autopilot):
    """The Autopilot that knows of others only while it sees them: the truth, less what is hidden.

    The upper bound of every perceiver. It looks from the centre of its roof. An object is seen if a straight line to
    its centre or one of its corners, up to 100 m long, crosses no car, truck or bus, and no thing (a vending machine)
    at least 0.8 m wide both ways. Heights do not count. Towns have no buildings in the world, so none hides anything.
    What it sees it knows as well as the Autopilot, and it forgets at once what it no longer sees.
    """

    name = "line-of-sight"
    controller = Controller.AUTOPILOT
    sensors = ("truth",)

    def believe(self, view: Observation) -> Belief:
        """Return the truth without hidden objects."""
        truth: Belief = view.readings["truth"]
        return truth.keep(is_visible(view.pose[:, :2], truth))


class DegradedBelief(Autopilot):
    """Autopilot with a poor perceiver: it misses objects in bursts, misplaces them, and is late.

    Each object has its own two-state Markov chain (detected, missed). All draws come from the episode's key and seed,
    so they depend neither on the batch nor on the other objects.
    """

    name = "degraded"
    controller = Controller.AUTOPILOT

    def __init__(
        self,
        missed: float = 0.3,
        *,
        burst: float = 5.0,
        noise: float = 0.0,
        delay: int = 0,
        believer: Believer | None = None,
    ) -> None:
        """Set the degradation.

        Args:
            missed: Share of the steps in which an object is missed, 0 to 1.
            burst: Mean number of steps that an object stays missed, at least 1; longer where the share requires it.
            noise: Standard deviation of an object's position along x and y, m, independent in each step.
            delay: Age of the belief in steps.
            believer: Source of the belief to degrade; None: the truth.

        Raises:
            ConfigError: A value is out of its range.
        """
        if not 0.0 <= missed <= 1.0 or burst < 1.0 or noise < 0.0 or delay < 0:
            raise ConfigError(
                "a degraded belief needs missed in [0, 1], burst >= 1, noise >= 0 and delay >= 0, "
                f"not {missed}, {burst}, {noise} and {delay}"
            )
        self.missed, self.noise, self.delay, self.believer = missed, noise, delay, believer
        # Rates of a two-state chain with stationary share `missed` and mean burst length `burst`.
        self.found = 1.0 / max(burst, missed / max(1.0 - missed, 1e-9)) if missed < 1.0 else 0.0
        self.lost = missed * self.found / (1.0 - missed) if missed < 1.0 else 1.0
        self.sensors: tuple[str, ...] = ("truth",) if believer is None else tuple(getattr(believer, "sensors", ()))
        self._draws: list[np.random.Generator] = []
        self._missing: npt.NDArray[np.bool_] = np.zeros((0, _SLOTS), bool)
        self._past: list[Belief] = []

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget the past and restart the random draws for these episodes."""
        self._draws = [generator("belief", episode.key, episode.seed) for episode in episodes]
        self._missing = np.array([draws.random(_SLOTS) < self.missed for draws in self._draws]).reshape(-1, _SLOTS)
        self._past = []
        reset = getattr(self.believer, "reset", None)
        if reset is not None:
            reset(episodes)

    def believe(self, view: Observation) -> Belief:
        """Return the degraded belief. ConfigError for 64 objects or more."""
        belief: Belief = view.readings["truth"] if self.believer is None else self.believer.believe(view)
        count = belief.kind.shape[1]
        if count >= _SLOTS:
            raise ConfigError(f"a degraded belief has room for {_SLOTS - 1} objects, not {count}")
        scenes = view.scene
        draws = np.stack([self._draws[scene].random(_SLOTS) for scene in scenes.tolist()])
        missing = self._missing[scenes]
        missing = np.where(missing, draws >= self.found, draws < self.lost)
        self._missing[scenes] = missing
        if self.noise > 0.0:
            position_noise = np.stack([self._draws[scene].normal(size=(_SLOTS, 2)) for scene in scenes.tolist()])
            belief = move_objects(belief, (self.noise * position_noise[:, :count]).astype(np.float32))
        self._past = [*self._past, belief.keep(~missing[:, :count])][-(self.delay + 1) :]
        return self._past[0]


def move_objects(belief: Belief, displacement: F32) -> Belief:
    """The belief with its objects and their forecasts moved by [B, K, 2] m."""
    pose = belief.pose.copy()
    pose[..., :2] += displacement
    forecast = None if belief.forecast is None else belief.forecast.copy()
    if forecast is not None:
        forecast[..., :2] += displacement[:, :, None]
    return replace(belief, pose=pose, forecast=forecast)

"""Autopilots that plan over less than the truth: what is in line of sight, and what a poor perceiver would find."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Belief, Believer, Observation
from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.core.types import F32, AgentKind, Bool, Controller, Episode
from ssad.drivers.builtin import Autopilot

RANGE = 100.0  # m
_HIDE = (AgentKind.CAR, AgentKind.TRUCK, AgentKind.BUS)
_THING = 0.8  # m that a thing must be wide both ways to hide what is behind it
_SLOTS = 64  # a scene has fewer agents: draws for all, so that none depends on how many there are


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
        """The truth, less what is hidden."""
        truth: Belief = view.readings["truth"]
        return truth.keep(in_sight(view.pose[:, :2], truth))


class DegradedBelief(Autopilot):
    """The Autopilot with a poor perceiver: misses objects in bursts, places them wrongly, and comes late.

    Whether an object is missed is a Markov chain of two states, seen and missed, that each object has to itself. All
    draws come from the episode's key and seed, so they depend neither on the batch nor on the other objects.
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
        """Choose how poor it is.

        Args:
            missed: Share of the steps in which an object is missed, 0 to 1.
            burst: Steps that an object stays missed on average, at least 1; longer where the share asks for it.
            noise: Standard deviation of an object's place along x and y, m, drawn anew in each step.
            delay: Steps that what it believes is old.
            believer: Whose belief is degraded; None: the truth.

        Raises:
            ConfigError: A value is out of its range.
        """
        if not 0.0 <= missed <= 1.0 or burst < 1.0 or noise < 0.0 or delay < 0:
            raise ConfigError(
                "a degraded belief needs missed in [0, 1], burst >= 1, noise >= 0 and delay >= 0, "
                f"not {missed}, {burst}, {noise} and {delay}"
            )
        self.missed, self.noise, self.delay, self.believer = missed, noise, delay, believer
        self.found = 1.0 / max(burst, missed / max(1.0 - missed, 1e-9)) if missed < 1.0 else 0.0
        self.lost = missed * self.found / (1.0 - missed) if missed < 1.0 else 1.0
        self.sensors: tuple[str, ...] = ("truth",) if believer is None else tuple(getattr(believer, "sensors", ()))
        self._draws: list[np.random.Generator] = []
        self._missing: npt.NDArray[np.bool_] = np.zeros((0, _SLOTS), bool)
        self._past: list[Belief] = []

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Forget the past; draws begin anew for these episodes."""
        self._draws = [generator("belief", episode.key, episode.seed) for episode in episodes]
        self._missing = np.array([draws.random(_SLOTS) < self.missed for draws in self._draws]).reshape(-1, _SLOTS)
        self._past = []
        reset = getattr(self.believer, "reset", None)
        if reset is not None:
            reset(episodes)

    def believe(self, view: Observation) -> Belief:
        """What is left of the belief. ConfigError: it has 64 objects or more."""
        belief: Belief = view.readings["truth"] if self.believer is None else self.believer.believe(view)
        count = belief.kind.shape[1]
        if count >= _SLOTS:
            raise ConfigError(f"a degraded belief has room for {_SLOTS - 1} objects, not {count}")
        scenes = view.scene
        chance = np.stack([self._draws[k].random(_SLOTS) for k in scenes.tolist()])
        missing = self._missing[scenes]
        missing = np.where(missing, chance >= self.found, chance < self.lost)
        self._missing[scenes] = missing
        if self.noise > 0.0:
            drawn = np.stack([self._draws[k].normal(size=(_SLOTS, 2)) for k in scenes.tolist()])
            belief = moved(belief, (self.noise * drawn[:, :count]).astype(np.float32))
        self._past = [*self._past, belief.keep(~missing[:, :count])][-(self.delay + 1) :]
        return self._past[0]


def moved(belief: Belief, by: F32) -> Belief:
    """The belief with its objects and their forecasts moved by [B, K, 2] m."""
    pose = belief.pose.copy()
    pose[..., :2] += by
    forecast = None if belief.forecast is None else belief.forecast.copy()
    if forecast is not None:
        forecast[..., :2] += by[:, :, None]
    return replace(belief, pose=pose, forecast=forecast)


def in_sight(eye: F32, belief: Belief, reach: float = RANGE) -> Bool:
    """Which objects can be seen.

    Args:
        eye: [B, 2] where it is looked from, m.
        belief: The objects [B, K].
        reach: How far one sees, m.

    Returns:
        [B, K]; False for rows that are not used.
    """
    half = 0.5 * belief.size
    c, s = np.cos(belief.pose[..., 2]), np.sin(belief.pose[..., 2])
    forward, aside = np.stack([c, s], -1), np.stack([-s, c], -1)
    spots = np.array([(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)], np.float32)
    # [B, K, 5, 2]: the centre and the corners
    points = (
        belief.pose[..., None, :2]
        + (spots[:, 0] * half[..., :1])[..., None] * forward[..., None, :]
        + (spots[:, 1] * half[..., 1:])[..., None] * aside[..., None, :]
    )
    there = belief.kind != AgentKind.NONE
    hides = there & (np.isin(belief.kind, _HIDE) | ((belief.kind == AgentKind.PROP) & (belief.size >= _THING).all(-1)))
    free = np.hypot(*np.moveaxis(points - eye[:, None, None], -1, 0)) <= reach
    for k in np.flatnonzero(hides.any(0)).tolist():
        axes = np.stack([forward[:, k], aside[:, k]], 1)  # [B, 2, 2]
        start = np.einsum("bij,bj->bi", axes, eye - belief.pose[:, k, :2])
        way = np.einsum("bij,bknj->bkni", axes, points - belief.pose[:, None, None, k, :2]) - start[:, None, None]
        # the part of the line, from 0 to 1, that lies between each pair of opposite sides
        step = np.where(np.abs(way) < 1e-9, 1e-9, way)
        one = (-half[:, None, None, k] - start[:, None, None]) / step
        other = (half[:, None, None, k] - start[:, None, None]) / step
        enters = np.minimum(one, other).max(-1)
        leaves = np.maximum(one, other).min(-1)
        crosses = (enters < leaves) & (leaves > 0.0) & (enters < 1.0)
        crosses[:, k] = False
        within = (np.abs(start) <= half[:, k]).all(-1)  # who touches the eye hides nothing
        free &= ~(crosses & (hides[:, k] & ~within)[:, None, None])
    seen: Bool = there & free.any(-1)
    return seen

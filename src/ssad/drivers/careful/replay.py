"""Recorded drives again, up to a moment at which others take the wheel: many endings of many encounters at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ssad.core.driving import Observation, Policies, Sensor
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F32, Bool, Controller, End, Episode, EpisodeTrace
from ssad.world.observation import observe
from ssad.world.rollout import Loop
from ssad.world.world import World


class Hand(Protocol):
    """What takes the wheel of some scenes: the part of `Driver` that is needed.

    Attributes:
        sensors: As for `Driver`.
    """

    sensors: tuple[str, ...]

    def reset(self, episodes: Sequence[Episode]) -> None:
        """See `Driver`."""

    def act(self, view: Observation) -> F32:
        """See `Driver`."""


@dataclass(frozen=True)
class Takeover:
    """Whom a scene is handed to, and when.

    Attributes:
        hand: Who takes the wheel; one hand may take many scenes.
        start: s from which on it drives.
    """

    hand: Hand
    start: float


def recorded_controls(trace: EpisodeTrace) -> F32:
    """Controls of the ego [T, 4] that led to each row of a drive: throttle, brake, steer, reverse."""
    speed = trace.speed[:, 0]
    back = np.zeros(len(speed), np.float32)
    # the throttle of a vehicle in reverse makes it faster backwards
    back[1:] = (trace.throttle[1:] > 0) & (trace.brake[1:] == 0) & (speed[1:] < speed[:-1])
    return np.stack([trace.throttle, trace.brake, trace.steer, back], 1).astype(np.float32)


@dataclass(frozen=True)
class Ending:
    """A drive that is played once for each takeover.

    Attributes:
        episode: What was driven.
        graph: Its town.
        trace: How.
        takeovers: Who takes over, and when; a scene each.
        until: s at which all is stopped.
    """

    episode: Episode
    graph: LaneGraph
    trace: EpisodeTrace
    takeovers: Sequence[Takeover]
    until: float

    @property
    def steps(self) -> int:
        """Steps until then."""
        return round(self.until / self.trace.dt)


def play(
    endings: Sequence[Ending],
    *,
    device: str = "cpu",
    policies: Policies | None = None,
    sensors: Mapping[str, Sensor] | None = None,
    watch: Callable[[World], None] | None = None,
) -> list[Bool]:
    """Play drives side by side, each once for each of its takeovers; none depends on the others.

    Everybody but the ego does what the episode says: scripts and traffic react to the new ego as they did to the old.

    Args:
        endings: What is played; the world's scenes are their takeovers, in order. A hand may take scenes of several.
        device: Where the world computes.
        policies: As for `rollout`.
        sensors: As for `rollout`.
        watch: Looks at the world after each step.

    Returns:
        Of each scene of each drive, whether the ego touched anybody.
    """
    again = []
    for one in endings:
        limits = replace(one.episode.limits, max_steps=one.steps, max_time=1e6, max_distance=1e9, contact="end")
        again.append(replace(one.episode, limits=limits))
    count = [len(one.takeovers) for one in endings]
    scenes = np.repeat(np.arange(len(endings)), count)
    graphs = {one.episode.town: one.graph for one in endings}
    world = World(again, graphs, assign=scenes, device=device, ego=Controller.EXTERNAL)
    loop = Loop(world, {}, policies=policies, sensors=sensors)
    loop.reset()
    takeovers = [takeover for one in endings for takeover in one.takeovers]
    hands = list(dict.fromkeys(t.hand for t in takeovers))
    for hand in hands:
        hand.reset([again[k] for k in scenes])
    owner = np.array([hands.index(t.hand) for t in takeovers])
    start, dt = np.array([t.start for t in takeovers]), np.array([one.trace.dt for one in endings])[scenes]
    recorded = [recorded_controls(one.trace) for one in endings]
    controls = np.zeros((world.batch, world.agents, 4), np.float32)
    for step in range(max(one.steps for one in endings)):
        controls[:, 0] = np.stack([own[min(step + 1, len(own) - 1)] for own in recorded])[scenes]
        taken = (step * dt > start - 1e-4) & (world.ended() == End.RUNNING)
        for k, hand in enumerate(hands):
            mine = np.flatnonzero(taken & (owner == k))
            if len(mine):
                agents = np.stack([mine, np.zeros_like(mine)], 1).astype(np.int32)
                readings = {name: loop.sensors[name](world, agents) for name in hand.sensors}
                view = observe(world.state(), agents, world.ended() != End.RUNNING, readings)
                controls[mine, 0] = 0.0
                given = hand.act(view)
                controls[mine, 0, : given.shape[1]] = given
        loop.step(controls)
        if watch is not None:
            watch(world)
        if (world.ended() != End.RUNNING).all():
            break
    return np.split(np.asarray(world.ended() == End.COLLISION), np.cumsum(count)[:-1])

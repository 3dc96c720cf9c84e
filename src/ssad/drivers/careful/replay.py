"""Replays of recorded drives up to a moment at which other drivers take over: many endings side by side."""

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


class ReplacementDriver(Protocol):
    """Protocol of a driver that takes over: the required part of `Driver`.

    Attributes:
        sensors: As for `Driver`.
    """

    sensors: tuple[str, ...]

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Prepare for new episodes, as `Driver.reset`."""

    def act(self, view: Observation) -> F32:
        """Return the controls of the rows, as `Driver.act`."""


@dataclass(frozen=True)
class Takeover:
    """Driver that takes over a scene, and the time of the takeover.

    Attributes:
        driver: The driver; one driver may take many scenes.
        start: Time of the takeover, s.
    """

    driver: ReplacementDriver
    start: float


def recorded_controls(trace: EpisodeTrace) -> F32:
    """Return the controls of the ego [T, 4] that led to each row of a drive: throttle, brake, steer, reverse."""
    speed = trace.speed[:, 0]
    reverse = np.zeros(len(speed), np.float32)
    # the throttle of a vehicle in reverse makes it faster backwards
    reverse[1:] = (trace.throttle[1:] > 0) & (trace.brake[1:] == 0) & (speed[1:] < speed[:-1])
    return np.stack([trace.throttle, trace.brake, trace.steer, reverse], 1).astype(np.float32)


@dataclass(frozen=True)
class ReplayPlan:
    """Drive that is replayed once for each takeover.

    Attributes:
        episode: The driven episode.
        graph: Lane graph of its town.
        trace: Recording of the drive.
        takeovers: The takeovers, one scene each.
        until: End of the replay, s.
    """

    episode: Episode
    graph: LaneGraph
    trace: EpisodeTrace
    takeovers: Sequence[Takeover]
    until: float

    @property
    def steps(self) -> int:
        """Number of steps of the replay."""
        return round(self.until / self.trace.dt)


def run_replays(
    endings: Sequence[ReplayPlan],
    *,
    device: str = "cpu",
    policies: Policies | None = None,
    sensors: Mapping[str, Sensor] | None = None,
    watch: Callable[[World], None] | None = None,
) -> list[Bool]:
    """Replay drives side by side, once for each of their takeovers; the scenes are independent.

    All other agents follow the episode: scripts and traffic react to the new ego as they did to the recorded one.

    Args:
        endings: The replays; the world's scenes are their takeovers, in order. A driver may serve several endings.
        device: Device of the world.
        policies: As for `rollout`.
        sensors: As for `rollout`.
        watch: Called with the world after each step.

    Returns:
        For each drive, [scenes] True where the ego collided.
    """
    replayed = []
    for ending in endings:
        limits = replace(ending.episode.limits, max_steps=ending.steps, max_time=1e6, max_distance=1e9, contact="end")
        replayed.append(replace(ending.episode, limits=limits))
    scene_counts = [len(ending.takeovers) for ending in endings]
    scenes = np.repeat(np.arange(len(endings)), scene_counts)
    graphs = {ending.episode.town: ending.graph for ending in endings}
    world = World(replayed, graphs, assign=scenes, device=device, ego=Controller.EXTERNAL)
    loop = Loop(world, {}, policies=policies, sensors=sensors)
    loop.reset()
    takeovers = [takeover for ending in endings for takeover in ending.takeovers]
    drivers = list(dict.fromkeys(candidate.driver for candidate in takeovers))
    for driver in drivers:
        driver.reset([replayed[index] for index in scenes])
    driver_index = np.array([drivers.index(candidate.driver) for candidate in takeovers])
    start, dt = (
        np.array([candidate.start for candidate in takeovers]),
        np.array([ending.trace.dt for ending in endings])[scenes],
    )
    recorded = [recorded_controls(ending.trace) for ending in endings]
    controls = np.zeros((world.batch, world.agents, 4), np.float32)
    for step in range(max(ending.steps for ending in endings)):
        # Row 0 is the start state: the controls of step k are recorded in row k + 1.
        controls[:, 0] = np.stack(
            [ending_controls[min(step + 1, len(ending_controls) - 1)] for ending_controls in recorded]
        )[scenes]
        # The tolerance absorbs rounding of step * dt at the takeover time.
        taken_over = (step * dt > start - 1e-4) & (world.ended() == End.RUNNING)
        for index, driver in enumerate(drivers):
            scene_rows = np.flatnonzero(taken_over & (driver_index == index))
            if len(scene_rows):
                agents = np.stack([scene_rows, np.zeros_like(scene_rows)], 1).astype(np.int32)
                readings = {name: loop.sensors[name](world, agents) for name in driver.sensors}
                view = observe(world.state(), agents, world.ended() != End.RUNNING, readings)
                controls[scene_rows, 0] = 0.0
                driver_controls = driver.act(view)
                controls[scene_rows, 0, : driver_controls.shape[1]] = driver_controls
        loop.step(controls)
        if watch is not None:
            watch(world)
        if (world.ended() != End.RUNNING).all():
            break
    return np.split(np.asarray(world.ended() == End.COLLISION), np.cumsum(scene_counts)[:-1])

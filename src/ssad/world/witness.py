"""Could the collision have been avoided? A search over simple evasive manoeuvres, each run in the world itself.

A collision says little about the driving system if nobody could have avoided it. The witness is a driver that keeps
the route blindly until the danger begins (the moment the first scripted actor is triggered), then brakes, slows,
speeds up or swerves, and goes on. If one such driver stays clear, the episode is avoidable and that driver is named,
so that it can be run again. If none does, drivers that act before the trigger are tried, and at last the Autopilot.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any, Literal

import numpy as np

from ssad.core.driving import Policies, Sensor
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Condition, Controller, End, Episode, EpisodeAgent, Phase, Route
from ssad.world.rollout import Loop, run
from ssad.world.world import World

Verdict = Literal["harmless", "avoidable", "anticipation", "autopilot", "unavoidable"]
SHIFT_LENGTH = 12.0  # m over which a swerve is driven
HOLD = 25.0  # m a swerve is kept


@dataclass(frozen=True)
class Manoeuvre:
    """What the search tries: another speed for a while, and a swerve.

    Attributes:
        start: s from which on it is driven.
        speed: m/s.
        hold: s for which the speed is held; then the target speed again.
        offset: m left of the route that are kept for 25 m from the place reached at `start`.
    """

    start: float
    speed: float
    hold: float
    offset: float = 0.0


@dataclass(frozen=True)
class Witness:
    """What the search for a way out of an encounter found.

    Attributes:
        verdict: `harmless` (the blind driver already stays clear), `avoidable` (a manoeuvre after the trigger does),
            `anticipation` (only one before it), `autopilot` (only the Autopilot), `unavoidable` (none that was tried).
        trigger: s; NaN if nothing is triggered.
        manoeuvre: The gentlest one that stays clear; it completes the route if one can.
        route_complete: Percent with it.
        clear: How many manoeuvres stay clear.
        tried: How many were tried.
    """

    verdict: Verdict
    trigger: float
    manoeuvre: Manoeuvre | None
    route_complete: float
    clear: int
    tried: int

    def as_dict(self) -> dict[str, Any]:
        """Plain data for a record."""
        out = asdict(self)
        out["trigger"] = None if np.isnan(self.trigger) else self.trigger
        return out


def shifted(route: Route, start: float, offset: float) -> Route:
    """The route with a smooth lateral shift of `offset` m (left positive) that begins `start` m along it."""
    if offset == 0.0:
        return route
    u = np.arange(len(route.xy)) * route.spacing - start
    out = np.clip(u / SHIFT_LENGTH, 0, 1)
    back = np.clip((u - SHIFT_LENGTH - HOLD) / SHIFT_LENGTH, 0, 1)
    share = (out * out * (3 - 2 * out)) - (back * back * (3 - 2 * back))
    normal = np.stack([-np.sin(route.yaw), np.cos(route.yaw)], 1)
    xy = route.xy + (offset * share)[:, None] * normal
    step = np.gradient(xy, axis=0)
    return replace(route, xy=xy.astype(np.float32), yaw=np.arctan2(step[:, 1], step[:, 0]).astype(np.float32))


def _drive(ego: EpisodeAgent, m: Manoeuvre, place: float) -> EpisodeAgent:
    """The ego as a blind follower that carries out the manoeuvre, which begins `place` m along its route."""
    assert ego.route is not None
    cruise = ego.target_speed
    phases = (
        Phase(cruise),
        Phase(m.speed, Condition("time", m.start)),
        Phase(cruise, Condition("time", m.start + m.hold)),
    )
    return replace(ego, controller=Controller.FOLLOW, phases=phases, route=shifted(ego.route, place, m.offset))


def _manoeuvres(start: float, target: float) -> Iterator[Manoeuvre]:
    """Gentlest first: slow down, stop, speed up; straight on, then with a swerve."""
    delays = (0.0, 0.3, 0.8, 1.5)
    speeds = (0.75 * target, 0.5 * target, 0.25 * target, 0.0, 1.3 * target, 1.6 * target)
    holds = (1.0, 2.0, 4.0, 8.0, 30.0)
    offsets = (0.0, 1.2, -1.2, 2.4, -2.4, 3.6)
    for offset, speed, delay, hold in product(offsets, speeds, delays, holds):
        yield Manoeuvre(start + delay, speed, hold, offset)


def _run(
    episode: Episode,
    graphs: Mapping[str, LaneGraph],
    drivers: list[EpisodeAgent],
    device: str,
    others: Mapping[str, Any],
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Why each driver's episode ended (`End`) and its route completion in percent."""
    bank = [replace(episode, agents=(d, *episode.agents[1:])) for d in drivers]
    world = World(bank, graphs, device=device)
    run(Loop(world, {}, **others))
    return world.ended().copy(), world.state().route_complete.copy()


def find_witness(
    episode: Episode,
    graph: LaneGraph,
    *,
    device: str = "cpu",
    policies: Policies | None = None,
    sensors: Mapping[str, Sensor] | None = None,
) -> Witness:
    """Search for a driver that stays clear; see `Witness`. Deterministic; some hundred scenes run side by side.

    policies: makes the drivers that the episode names for other agents, as in `rollout`; sensors: what these ask for.
    """
    others: dict[str, Any] = {"policies": policies, "sensors": sensors}
    graphs = {episode.town: graph}
    ego = replace(episode.agents[0], controller=Controller.FOLLOW, phases=())
    blind = World([replace(episode, agents=(ego, *episode.agents[1:]))], graphs, device=device)
    loop = Loop(blind, {}, policies=policies, sensors=sensors)
    loop.reset()
    trigger = float("nan")
    place: list[float] = []
    scripted = [i for i, a in enumerate(episode.agents) if a.controller == Controller.SCRIPT and a.phases]
    for step in range(episode.limits.max_steps):
        place.append(float(blind.array("progress")[0, 0]))
        loop.step()
        if np.isnan(trigger) and any(blind.array("phase")[0, i] > 0 for i in scripted):
            trigger = step * blind.dt
        if blind.ended()[0]:
            break
    if blind.ended()[0] != End.COLLISION:
        return Witness("harmless", trigger, None, float(blind.state().route_complete[0]), 1, 1)
    tried = 1
    crash = len(place) * blind.dt
    begin = 0.0 if np.isnan(trigger) else trigger
    stages: list[tuple[Verdict, float]] = [("avoidable", begin)]
    stages += [("anticipation", max(begin - lead, 0.0)) for lead in (1.0, 2.0, 4.0) if begin > 0]
    for verdict, start in stages:
        options = [m for m in _manoeuvres(start, ego.target_speed) if m.start < crash]
        drivers = [_drive(ego, m, place[min(int(m.start / blind.dt), len(place) - 1)]) for m in options]
        ends, complete = _run(episode, graphs, drivers, device, others)
        tried += len(options)
        clear = np.flatnonzero(ends != End.COLLISION)
        if len(clear):
            best = max(clear, key=lambda k: (complete[k] >= 100.0, -abs(options[k].offset), complete[k], -k))
            return Witness(verdict, trigger, options[best], float(complete[best]), len(clear), tried)
    ends, complete = _run(episode, graphs, [replace(ego, controller=Controller.AUTOPILOT)], device, others)
    tried += 1
    if ends[0] != End.COLLISION:
        return Witness("autopilot", trigger, None, float(complete[0]), 1, tried)
    return Witness("unavoidable", trigger, None, float("nan"), 0, tried)

"""What happened in an episode as a scenario of its own: the ego is driven anew, all others do what they did."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, Actor, AgentKind, Episode, EpisodeTrace, Pose, Scenario
from ssad.scenarios.dynamic.catalog import CUSTOM, parameter_box, scenario_type

CLOSE: Final = 0.002, 0.001
"""How far a row may be off the line between its neighbours to be left out, m and rad."""
MOVED: Final = 0.05  # m; who moves less stands
BRAKING: Final = 4.0  # m/s^2 at which they stop who still moved when the recording ended

Rows = tuple[tuple[float, float, float, float], ...]


def frozen(episode: Episode, trace: EpisodeTrace, *, name: str | None = None) -> Scenario:
    """The scenario in which everybody but the ego repeats what was recorded.

    Whoever was still moving at the end of the recording brakes to a stop straight ahead, and stays there. It depends
    on no seed.

    Args:
        episode: The episode.
        trace: What happened in it.
        name: Of the scenario; None: that of the episode's.

    Returns:
        A scenario of type Custom with the same ego, signals and limits.
    """
    base = episode.scenario
    kind = scenario_type(base.type)
    box = parameter_box(CUSTOM)
    values = {key: value for key, value in kind.values(base.parameters).items() if key in box and value != 0.0}
    until = float(episode.limits.max_steps * trace.dt)
    actors = []
    for agent in range(1, len(trace.names)):
        rows = _rows(trace, agent)
        if rows is None:
            continue
        if np.hypot(*np.ptp(rows[:, 1:3], axis=0)) < MOVED and bool(trace.active[:, agent].all()):
            # things stand by themselves; a vehicle without phases is a parked one
            actors.append(Actor(trace.names[agent], trace.models[agent], agent_pose(rows[0])))
            continue
        told = told_rows(stopping(rows, until) if trace.active[-1, agent] else rows)
        actors.append(Actor(trace.names[agent], trace.models[agent], Pose(*told[0][1:]), trajectory=told))
    return replace(
        base,
        name=name or base.name,
        type=CUSTOM,
        trigger=None,
        placements=(),
        parameters=values,
        actors=tuple(actors),
        traffic=None,
        source=f"{base.name}, seed {episode.seed}",
    )


def with_motion(scenario: Scenario, name: str, rows: F64) -> Scenario:
    """A frozen scenario in which one actor moves otherwise.

    Args:
        scenario: As `frozen` makes it.
        name: Of the actor.
        rows: Its time s, x, y m and yaw rad [T, 4]; at their end it brakes to a stop.
    """
    told = told_rows(stopping(np.asarray(rows, np.float64), scenario.limits.max_steps * 0.1), thin=False)
    pose = Pose(*told[0][1:])
    return replace(
        scenario,
        actors=tuple(
            replace(actor, pose=pose, phases=(), path=(), trajectory=told) if actor.name == name else actor
            for actor in scenario.actors
        ),
    )


def agent_pose(row: F64) -> Pose:
    """The pose of a row of time, x, y and yaw, as scenario files give it."""
    return Pose(round(float(row[1]), 3), round(float(row[2]), 3), round(float(wrap_angle(row[3])), 4))


def told_rows(rows: F64, *, thin: bool = True) -> Rows:
    """Rows [T, 4] as a scenario file gives them: in mm; thin: without those on the line between their neighbours."""
    kept = np.array(thinned(rows)) if thin else rows
    told = np.concatenate([kept[:, :3].round(3), np.asarray(wrap_angle(kept[:, 3:])).round(4)], 1)
    return tuple((t, x, y, yaw) for t, x, y, yaw in told.tolist())


def thinned(rows: F64) -> list[list[float]]:
    """Rows [T, 4] of time, x, y and yaw without those that lie on the line between their neighbours."""
    unwrapped = rows.copy()
    unwrapped[:, 3] = np.unwrap(rows[:, 3])
    kept, last = [0], 0
    for n in range(2, len(rows)):
        between = unwrapped[last + 1 : n]
        share = (between[:, :1] - unwrapped[last, 0]) / (unwrapped[n, 0] - unwrapped[last, 0])
        off = np.abs(unwrapped[last] + share * (unwrapped[n] - unwrapped[last]) - between)
        if off[:, 1:3].max() > CLOSE[0] or off[:, 3].max() > CLOSE[1]:
            last = n - 1
            kept.append(last)
    kept.append(len(rows) - 1)
    found: list[list[float]] = rows[kept].tolist()
    return found


def _rows(trace: EpisodeTrace, agent: int) -> F64 | None:
    """Time, x, y, yaw [T, 4] of an agent from its first to its last row; None: it was never there."""
    there = np.flatnonzero(trace.active[:, agent])
    if len(there) < 2 or trace.kind[agent] == AgentKind.NONE:
        return None
    span = slice(int(there[0]), int(there[-1]) + 1)
    time = np.arange(len(trace.active)) * float(trace.dt)
    columns = [time[span], *(getattr(trace, name)[span, agent].astype(np.float64) for name in ("x", "y", "yaw"))]
    return np.stack(columns, 1)


def braked(speed: F64, time: F64) -> tuple[F64, F64]:
    """How far somebody has gone (m) who brakes from a speed (m/s) for a time (s), and its speed then (m/s).

    Args:
        speed: [...] before; below 0: backwards.
        time: [...] broadcast against it; below 0: not yet.
    """
    size = np.abs(speed)
    rolling = np.clip(time, 0.0, size / BRAKING)
    way = np.sign(speed) * (size * rolling - 0.5 * BRAKING * rolling**2)
    return way, np.sign(speed) * (size - BRAKING * rolling)


def stopping(rows: F64, until: float, *, step: float = 0.1) -> F64:
    """Rows [T, 4] of time, x, y and yaw, and after them a stop straight ahead, until a time s."""
    end, before = rows[-1], rows[-2]
    heading = np.array([np.cos(end[3]), np.sin(end[3])])
    speed = float((end[1:3] - before[1:3]) @ heading / (end[0] - before[0]))
    braking = np.arange(1, int(abs(speed) / BRAKING / step) + 2) * step
    time = np.append(braking, max(until - float(end[0]), braking[-1]) + 1.0)
    way, _ = braked(np.asarray(speed), time)
    more = np.stack([end[0] + time, *(end[1:3, None] + heading[:, None] * way), np.full(len(time), end[3])], 1)
    return np.concatenate([rows, more])

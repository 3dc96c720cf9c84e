"""What happened in an episode as a scenario of its own: the ego is driven anew, all others do what they did."""

from __future__ import annotations

from collections.abc import Mapping
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


def frozen(
    episode: Episode, trace: EpisodeTrace, *, name: str | None = None, motions: Mapping[int, F64] | None = None
) -> Scenario:
    """The scenario in which everybody but the ego repeats what was recorded.

    Whoever was still moving at the end of the recording brakes to a stop straight ahead, and stays there. It depends
    on no seed.

    Args:
        episode: The episode.
        trace: What happened in it.
        name: Of the scenario; None: that of the episode's.
        motions: Agent -> rows [T, 4] of time s, x, y m, yaw rad that it follows instead of what was recorded.

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
        given = None if motions is None else motions.get(agent)
        rows = _rows(trace, agent) if given is None else np.asarray(given, np.float64)
        if rows is None:
            continue
        if given is None and np.hypot(*np.ptp(rows[:, 1:3], axis=0)) < MOVED and bool(trace.active[:, agent].all()):
            still = agent_pose(rows[0])
            # things stand by themselves; a vehicle without phases is a parked one
            actors.append(Actor(trace.names[agent], trace.models[agent], still))
            continue
        if bool(trace.active[-1, agent]) or given is not None:
            rows = _stopping(rows, until)
        told = told_rows(rows)
        actors.append(Actor(trace.names[agent], trace.models[agent], Pose(*told[0][1:]), trajectory=told))
    return replace(
        base, name=name or base.name, type=CUSTOM, trigger=None, placements=(), parameters=values,
        actors=tuple(actors), traffic=None, source=f"{base.name}, seed {episode.seed}",
    )  # fmt: skip


def agent_pose(row: F64) -> Pose:
    """The pose of a row of time, x, y and yaw, as scenario files give it."""
    return Pose(round(float(row[1]), 3), round(float(row[2]), 3), round(float(wrap_angle(row[3])), 4))


def told_rows(rows: F64) -> Rows:
    """Rows [T, 4] as a scenario file gives them: in mm, without those on the line between their neighbours."""
    return tuple(
        (round(t, 3), round(x, 3), round(y, 3), round(float(wrap_angle(yaw)), 4)) for t, x, y, yaw in thinned(rows)
    )


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


def _stopping(rows: F64, until: float, *, step: float = 0.1) -> F64:
    """The rows, and after them a stop straight ahead, until a time s."""
    end, before = rows[-1], rows[-2]
    heading = np.array([np.cos(end[3]), np.sin(end[3])])
    speed = float((end[1:3] - before[1:3]) @ heading / (end[0] - before[0]))
    last = max(until, float(end[0])) + 1.0
    time = np.append(np.arange(1, int(abs(speed) / BRAKING / step) + 2) * step, last - end[0])
    rolling = np.minimum(time, abs(speed) / BRAKING)
    way = np.sign(speed) * (abs(speed) * rolling - 0.5 * BRAKING * rolling**2)
    more = np.stack([end[0] + time, *(end[1:3, None] + heading[:, None] * way), np.full(len(time), end[3])], 1)
    return np.concatenate([rows, more])

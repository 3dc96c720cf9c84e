"""Recorded episodes as scenarios of their own: the ego is driven anew, all other agents repeat the recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, Actor, AgentKind, Episode, EpisodeTrace, Pose, Scenario
from ssad.scenarios.dynamic.catalogue import CUSTOM, parameter_box, scenario_type

CLOSE: Final = 0.0005, 0.0005
"""Greatest distance from the line between its neighbours of a row that is left out, m and rad.

An error of 0.5 mm in the middle of a second difference at steps of 0.1 s is 0.1 m/s^2.
"""
SAMPLE: Final = 0.05  # s between the rows of a motion that a generator made: two for each step of the world
MIN_MOTION: Final = 0.05  # m; an agent that moves less counts as standing
BRAKING: Final = 4.0  # m/s^2 of agents that still move when the recording ends

Rows = tuple[tuple[float, float, float, float], ...]


def freeze_episode(episode: Episode, trace: EpisodeTrace, *, name: str | None = None) -> Scenario:
    """Return the scenario in which every agent but the ego repeats the recording.

    An agent that is still moving when the recording ends brakes to a stop straight ahead and stays there. The result
    depends on no seed.

    Args:
        episode: The recorded episode.
        trace: The recording.
        name: Name of the new scenario; None: that of the episode's scenario.

    Returns:
        A scenario of type Custom with the same ego, signals and limits.
    """
    base = episode.scenario
    scenario_kind = scenario_type(base.type)
    custom_parameters = parameter_box(CUSTOM)
    values = {
        parameter_name: value
        for parameter_name, value in scenario_kind.values(base.parameters).items()
        if parameter_name in custom_parameters and value != 0.0
    }
    end_time = float(episode.limits.max_steps * trace.dt)
    actors = []
    for agent_index in range(1, len(trace.names)):
        body = episode.agents[agent_index].body
        rows = _agent_rows(trace, agent_index)
        if rows is None:
            continue
        if np.hypot(*np.ptp(rows[:, 1:3], axis=0)) < MIN_MOTION and bool(trace.active[:, agent_index].all()):
            # an actor without phases and trajectory stands still
            actors.append(Actor(trace.names[agent_index], trace.models[agent_index], agent_pose(rows[0]), body=body))
            continue
        trajectory = round_rows(extend_by_stop(rows, end_time) if trace.active[-1, agent_index] else rows)
        actors.append(
            Actor(
                trace.names[agent_index],
                trace.models[agent_index],
                Pose(*trajectory[0][1:]),
                trajectory=trajectory,
                body=body,
            )
        )
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
        declared={},
        expressions={},
        constraints=(),
    )


def with_motion(scenario: Scenario, name: str, rows: F64) -> Scenario:
    """Return a frozen scenario in which one actor has another motion.

    Args:
        scenario: As `freeze_episode` makes it.
        name: Of the actor.
        rows: Its time s, x, y m and yaw rad [T, 4]; at their end it brakes to a stop. It follows the spline of these
            rows (`resample_motion`).
    """
    motion = resample_motion(np.asarray(rows, np.float64))
    trajectory = round_rows(extend_by_stop(motion, scenario.limits.max_steps * 0.1), thin=False)
    pose = Pose(*trajectory[0][1:])
    return replace(
        scenario,
        actors=tuple(
            replace(actor, pose=pose, phases=(), path=(), trajectory=trajectory, lateral=(), speed=0.0)
            if actor.name == name
            else actor
            for actor in scenario.actors
        ),
    )


def resample_motion(rows: F64, *, step: float = SAMPLE) -> F64:
    """Return a motion at a finer spacing, on the spline whose velocity is linear between those of the rows.

    The spline goes through the middle between two rows with the mean velocity between them. Of evenly spaced rows it is
    the uniform quadratic B-spline: its acceleration is nowhere beyond the second differences of the rows, and it passes
    a row by an eighth of the second difference (5 cm at 6 m/s^2 and rows of 0.25 s).

    Args:
        rows: Time s, x, y m and yaw rad [T, 4], at increasing times.
        step: Time between the rows that are returned, s.

    Returns:
        Rows of the same kind from the first time to the last; those that are `step` apart or less stay as they are.
    """
    from scipy.interpolate import CubicHermiteSpline

    time = rows[:, 0]
    if np.diff(time).max() <= step + 1e-9:
        return rows
    values = np.concatenate([rows[:, 1:3], np.unwrap(rows[:, 3])[:, None]], 1)
    velocity = np.diff(values, axis=0) / np.diff(time)[:, None]
    middle_time, middle = 0.5 * (time[1:] + time[:-1]), 0.5 * (values[1:] + values[:-1])
    spline = CubicHermiteSpline(
        np.concatenate([time[:1], middle_time, time[-1:]]),
        np.concatenate([values[:1], middle, values[-1:]]),
        np.concatenate([velocity[:1], velocity, velocity[-1:]]),
    )
    count = max(round(float(time[-1] - time[0]) / step), 1)
    sample_times = time[0] + (time[-1] - time[0]) * np.arange(count + 1) / count
    return np.concatenate([sample_times[:, None], spline(sample_times)], 1)


def agent_pose(row: F64) -> Pose:
    """Round a row of time, x, y and yaw to the pose that scenario files store."""
    return Pose(round(float(row[1]), 3), round(float(row[2]), 3), round(float(wrap_angle(row[3])), 4))


def round_rows(rows: F64, *, thin: bool = True) -> Rows:
    """Round rows [T, 4] to the precision of scenario files (mm), optionally without collinear rows."""
    selected_rows = np.array(drop_collinear_rows(rows)) if thin else rows
    rounded = np.concatenate([selected_rows[:, :3].round(3), np.asarray(wrap_angle(selected_rows[:, 3:])).round(4)], 1)
    return tuple((t, x, y, yaw) for t, x, y, yaw in rounded.tolist())


def drop_collinear_rows(rows: F64) -> list[list[float]]:
    """Drop the rows [T, 4] of time, x, y and yaw that lie on the line between their neighbours."""
    unwrapped = rows.copy()
    # Interpolation across the jump at pi would report a false deviation.
    unwrapped[:, 3] = np.unwrap(rows[:, 3])
    retained, last_retained = [0], 0
    for row in range(2, len(rows)):
        skipped = unwrapped[last_retained + 1 : row]
        share = (skipped[:, :1] - unwrapped[last_retained, 0]) / (unwrapped[row, 0] - unwrapped[last_retained, 0])
        deviation = np.abs(unwrapped[last_retained] + share * (unwrapped[row] - unwrapped[last_retained]) - skipped)
        if deviation[:, 1:3].max() > CLOSE[0] or deviation[:, 3].max() > CLOSE[1]:
            last_retained = row - 1
            retained.append(last_retained)
    retained.append(len(rows) - 1)
    simplified: list[list[float]] = rows[retained].tolist()
    return simplified


def _agent_rows(trace: EpisodeTrace, agent: int) -> F64 | None:
    """Return time, x, y and yaw [T, 4] of an agent while it is present, or None if it never is."""
    present_rows = np.flatnonzero(trace.active[:, agent])
    if len(present_rows) < 2 or trace.kind[agent] == AgentKind.NONE:
        return None
    active_span = slice(int(present_rows[0]), int(present_rows[-1]) + 1)
    time = np.arange(len(trace.active)) * float(trace.dt)
    columns = [
        time[active_span],
        *(getattr(trace, name)[active_span, agent].astype(np.float64) for name in ("x", "y", "yaw")),
    ]
    return np.stack(columns, 1)


def brake(speed: F64, time: F64) -> tuple[F64, F64]:
    """Return the distance covered (m) and the speed left (m/s) after braking from a speed for some time.

    Args:
        speed: Initial speed [...], m/s; negative: backwards.
        time: Time since braking began [...], s, broadcast against `speed`; negative: not braking yet.
    """
    magnitude = np.abs(speed)
    braking_time = np.clip(time, 0.0, magnitude / BRAKING)
    travelled = np.sign(speed) * (magnitude * braking_time - 0.5 * BRAKING * braking_time**2)
    return travelled, np.sign(speed) * (magnitude - BRAKING * braking_time)


def extend_by_stop(rows: F64, until: float, *, step: float = 0.1) -> F64:
    """Extend rows [T, 4] of time, x, y and yaw by a stop straight ahead, until a time, s."""
    last_row, previous_row = rows[-1], rows[-2]
    heading = np.array([np.cos(last_row[3]), np.sin(last_row[3])])
    speed = float((last_row[1:3] - previous_row[1:3]) @ heading / (last_row[0] - previous_row[0]))
    braking = np.arange(1, int(abs(speed) / BRAKING / step) + 2) * step
    # One row beyond the end keeps the agent present until the last step.
    time = np.append(braking, max(until - float(last_row[0]), braking[-1]) + 1.0)
    travelled, _ = brake(np.asarray(speed), time)
    stop_rows = np.stack(
        [last_row[0] + time, *(last_row[1:3, None] + heading[:, None] * travelled), np.full(len(time), last_row[3])], 1
    )
    return np.concatenate([rows, stop_rows])

"""What came of a proposal, measured from its trace: contact, adversaries off the road or with others, their limits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssad.core.generators import Outcome, Proposal
from ssad.core.geometry import obb_distance
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, AgentKind, EpisodeTrace
from ssad.metrics.criticality import boxes
from ssad.scenarios.dynamic.knowledge._remember import remembered
from ssad.world.models import GRIP, model
from ssad.world.roads.query import LaneQuery

WINDOW = 0.5  # s over which accelerations and jerks are means
MAX_JERK = 12.65  # m/s^3, of the careful and competent driver of UN Regulation 157
TOLERANCE = 1.1  # times a limit that counts as kept


def measure(proposal: Proposal, trace: EpisodeTrace, graph: LaneGraph, adversaries: Sequence[int]) -> Outcome:
    """The outcome of a proposal that was driven.

    Args:
        proposal: What was tried.
        trace: What happened.
        graph: Lane graph of the town.
        adversaries: Numbers of the agents that are adversaries.

    Returns:
        The outcome.
    """
    who = tuple(sorted({int(a) for a in adversaries if trace.active[:, a].any()}))
    hits = np.flatnonzero(np.isin(trace.contact_agent, who) & (trace.contact != 0)) if who else np.zeros(0, np.intp)
    box = boxes(trace)
    time = impact_speed = ego_speed = None
    if len(hits):
        row = int(hits[0])
        time, ego_speed = row * float(trace.dt), abs(float(trace.speed[row, 0]))
        impact_speed = _closing_speed(trace, row, int(trace.contact_agent[row]))
    motor = [a for a in who if trace.kind[a] <= AgentKind.MOTORCYCLE]
    acceleration, jerk, kept = _effort(trace, [a for a in who if trace.kind[a] <= AgentKind.BICYCLE])
    return Outcome(
        proposal,
        trace=trace,
        adversaries=who,
        collision=len(hits) > 0,
        time=time,
        impact_speed=impact_speed,
        ego_speed=ego_speed,
        gap=0.0 if len(hits) else _least_gap(trace, box, who),
        off_road=any(_leaves_road(trace, graph, a) for a in motor),
        hit_others=any(_hits_others(trace, box, a) for a in who),
        acceleration=acceleration,
        jerk=jerk,
        within_limits=kept,
    )


def _closing_speed(trace: EpisodeTrace, row: int, agent: int) -> float:
    """How fast the ego and an agent move against each other, m/s."""
    speed, yaw = trace.speed[row, [0, agent]].astype(np.float64), trace.yaw[row, [0, agent]].astype(np.float64)
    velocity = speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], 1)
    return float(np.hypot(*(velocity[0] - velocity[1])))


def _least_gap(trace: EpisodeTrace, box: F64, who: Sequence[int]) -> float | None:
    """Least distance of the ego's body from one of the agents', m."""
    gaps = [
        float(obb_distance(box[there, 0], box[there, agent]).min())
        for agent in who
        if len(there := np.flatnonzero(trace.active[:, agent] & trace.active[:, 0]))
    ]
    return min(gaps, default=None)


@remembered(16)
def _lanes(graph: LaneGraph) -> LaneQuery:
    return LaneQuery(graph)


def _leaves_road(trace: EpisodeTrace, graph: LaneGraph, agent: int) -> bool:
    """Whether the centre of an agent is off the road after it has been on it."""
    there = trace.active[:, agent]
    if not there.any():
        return False
    off = _lanes(graph).off_road(np.stack([trace.x[there, agent], trace.y[there, agent]], 1))
    return bool((np.diff(off.astype(np.int8)) > 0).any())


def _hits_others(trace: EpisodeTrace, box: F64, agent: int) -> bool:
    """Whether an agent touches anybody but the ego who was not in touch with it from the start."""
    reach = 0.5 * np.hypot(trace.length, trace.width)
    for other in range(1, len(trace.kind)):
        both = trace.active[:, agent] & trace.active[:, other]
        apart = np.hypot(*(box[:, agent, :2] - box[:, other, :2]).T)
        near = np.flatnonzero(both & (apart <= reach[agent] + reach[other]))
        if other != agent and len(near):
            touch = obb_distance(box[near, agent], box[near, other]) <= 0.0
            if touch.any() and not (touch[0] and near[0] == np.flatnonzero(both)[0]):
                return True
    return False


def _effort(trace: EpisodeTrace, agents: Sequence[int]) -> tuple[float | None, float | None, bool | None]:
    """Largest acceleration m/s^2 and jerk m/s^3 of vehicles, and whether all kept to what their bodies can do."""
    lag = max(1, round(WINDOW / trace.dt))
    largest, hardest, kept = 0.0, 0.0, True
    measured = False
    for agent in agents:
        there = np.flatnonzero(trace.active[:, agent])
        speed = trace.speed[there, agent].astype(np.float64)
        if len(speed) <= lag:
            continue
        measured = True
        body = model(trace.models[agent])
        along = (speed[lag:] - speed[:-lag]) / (lag * trace.dt)
        turn = np.asarray(wrap_angle(np.diff(trace.yaw[there, agent].astype(np.float64)))) / trace.dt
        across = np.abs(np.convolve(speed[1:] * turn, np.ones(lag) / lag, mode="valid"))
        jerk = np.abs(along[lag:] - along[:-lag]) / (lag * trace.dt)
        largest = max(largest, float(np.abs(along).max()), float(across.max()))
        hardest = max(hardest, float(jerk.max(initial=0.0)))
        kept &= bool(
            along.max() <= TOLERANCE * body.max_accel
            and along.min() >= -TOLERANCE * body.max_brake
            and across.max() <= TOLERANCE * GRIP
            and jerk.max(initial=0.0) <= TOLERANCE * MAX_JERK
        )
    return (largest, hardest, kept) if measured else (None, None, None)

"""Outcome of a proposal, measured from its trace: contact, gap, road departures and physical limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ssad.core.generators import Outcome, Proposal
from ssad.core.geometry import obb_distance
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, AgentKind, Body, EpisodeTrace, Model
from ssad.metrics.criticality import trace_boxes
from ssad.scenarios.dynamic.knowledge._caching import cached_by_identity
from ssad.world.models import acceleration_limits, lateral_grip, model, model_with_body
from ssad.world.roads.query import LaneQuery

WINDOW = 0.5  # s over which accelerations and jerks are means
MAX_JERK = 12.65  # m/s^3, of the careful and competent driver of UN Regulation 157
TOLERANCE = 1.1  # factor up to which a limit counts as respected


def measure(proposal: Proposal, trace: EpisodeTrace, graph: LaneGraph, adversaries: Sequence[int]) -> Outcome:
    """Measure the outcome of a driven proposal.

    Args:
        proposal: The proposal.
        trace: Recording of its episode.
        graph: Lane graph of the town.
        adversaries: Indices of the agents that are adversaries.

    Returns:
        The outcome.
    """
    # An agent that never appears cannot be an adversary of this rollout.
    agent_indices = tuple(sorted({int(agent) for agent in adversaries if trace.active[:, agent].any()}))
    contact_rows = (
        np.flatnonzero(np.isin(trace.contact_agent, agent_indices) & (trace.contact != 0))
        if agent_indices
        else np.zeros(0, np.intp)
    )
    agent_boxes = trace_boxes(trace)
    contact_time = impact_speed = ego_speed = None
    if len(contact_rows):
        row = int(contact_rows[0])
        contact_time, ego_speed = row * float(trace.dt), abs(float(trace.speed[row, 0]))
        impact_speed = _closing_speed(trace, row, int(trace.contact_agent[row]))
    motor_vehicles = [agent for agent in agent_indices if trace.kind[agent] <= AgentKind.MOTORCYCLE]
    stated_bodies = {actor.name: actor.body for actor in proposal.scenario.actors}
    models = {
        agent: model_with_body(model(trace.models[agent]), stated_bodies.get(trace.names[agent], Body()))
        for agent in agent_indices
        if trace.kind[agent] <= AgentKind.BICYCLE
    }
    acceleration, jerk, within_limits = _peak_effort(trace, models, proposal.scenario.friction)
    return Outcome(
        proposal,
        trace=trace,
        adversaries=agent_indices,
        collision=len(contact_rows) > 0,
        time=contact_time,
        impact_speed=impact_speed,
        ego_speed=ego_speed,
        gap=0.0 if len(contact_rows) else _min_gap(trace, agent_boxes, agent_indices),
        off_road=any(_leaves_road(trace, graph, agent) for agent in motor_vehicles),
        hit_others=any(_hits_others(trace, agent_boxes, agent) for agent in agent_indices),
        acceleration=acceleration,
        jerk=jerk,
        within_limits=within_limits,
    )


def _closing_speed(trace: EpisodeTrace, row: int, agent: int) -> float:
    """Return the magnitude of the relative velocity of the ego and an agent, m/s."""
    speed, yaw = trace.speed[row, [0, agent]].astype(np.float64), trace.yaw[row, [0, agent]].astype(np.float64)
    velocity = speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], 1)
    return float(np.hypot(*(velocity[0] - velocity[1])))


def _min_gap(trace: EpisodeTrace, box: F64, agents: Sequence[int]) -> float | None:
    """Return the minimum distance between the body of the ego and those of the agents, m."""
    gaps = [
        float(obb_distance(box[common_rows, 0], box[common_rows, agent]).min())
        for agent in agents
        if len(common_rows := np.flatnonzero(trace.active[:, agent] & trace.active[:, 0]))
    ]
    return min(gaps, default=None)


@cached_by_identity(16)
def _cached_lane_query(graph: LaneGraph) -> LaneQuery:
    return LaneQuery(graph)


def _leaves_road(trace: EpisodeTrace, graph: LaneGraph, agent: int) -> bool:
    """Return True if the centre of an agent leaves the road after having been on it."""
    present = trace.active[:, agent]
    if not present.any():
        return False
    off_road = _cached_lane_query(graph).off_road(np.stack([trace.x[present, agent], trace.y[present, agent]], 1))
    return bool((np.diff(off_road.astype(np.int8)) > 0).any())


def _hits_others(trace: EpisodeTrace, box: F64, agent: int) -> bool:
    """Return True if an agent touches another one, not the ego, that it did not touch from the start."""
    reach = 0.5 * np.hypot(trace.length, trace.width)
    for other_agent in range(1, len(trace.kind)):
        both_present = trace.active[:, agent] & trace.active[:, other_agent]
        centre_distance = np.hypot(*(box[:, agent, :2] - box[:, other_agent, :2]).T)
        # The circle test is cheap and excludes nearly all rows before the exact box distance.
        near_rows = np.flatnonzero(both_present & (centre_distance <= reach[agent] + reach[other_agent]))
        if other_agent != agent and len(near_rows):
            touching = obb_distance(box[near_rows, agent], box[near_rows, other_agent]) <= 0.0
            if touching.any() and not (touching[0] and near_rows[0] == np.flatnonzero(both_present)[0]):
                return True
    return False


def _peak_effort(
    trace: EpisodeTrace, models: Mapping[int, Model], friction: float
) -> tuple[float | None, float | None, bool | None]:
    """Return the largest acceleration m/s^2 and jerk m/s^3 of vehicles, and whether all respected their limits."""
    lag = max(1, round(WINDOW / trace.dt))
    max_acceleration, max_jerk, within_limits = 0.0, 0.0, True
    efforts = False
    for agent, body in models.items():
        present_rows = np.flatnonzero(trace.active[:, agent])
        speed = trace.speed[present_rows, agent].astype(np.float64)
        if len(speed) <= lag:
            continue
        efforts = True
        max_accel, max_brake = acceleration_limits(body, friction)
        longitudinal = (speed[lag:] - speed[:-lag]) / (lag * trace.dt)
        yaw_rate = np.asarray(wrap_angle(np.diff(trace.yaw[present_rows, agent].astype(np.float64)))) / trace.dt
        lateral = np.abs(np.convolve(speed[1:] * yaw_rate, np.ones(lag) / lag, mode="valid"))
        jerk = np.abs(longitudinal[lag:] - longitudinal[:-lag]) / (lag * trace.dt)
        max_acceleration = max(max_acceleration, float(np.abs(longitudinal).max()), float(lateral.max()))
        max_jerk = max(max_jerk, float(jerk.max(initial=0.0)))
        within_limits &= bool(
            longitudinal.max() <= TOLERANCE * max_accel
            and longitudinal.min() >= -TOLERANCE * max_brake
            and lateral.max() <= TOLERANCE * lateral_grip(friction)
            and jerk.max(initial=0.0) <= TOLERANCE * MAX_JERK
        )
    return (max_acceleration, max_jerk, within_limits) if efforts else (None, None, None)

"""Outcome of a proposal, measured from its trace: contact, gap, departures from the lawful road, and limits."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ssad.core.generators import Outcome, Proposal
from ssad.core.geometry import obb_distance
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, AgentKind, Body, EpisodeTrace, Model, Scenario
from ssad.metrics.criticality import trace_boxes
from ssad.metrics.driving import first_contact
from ssad.metrics.proven_collisions import (
    LIMIT_TOLERANCE,
    WRONG_WAY_TIME,
    Accelerations,
    CollisionProof,
    longest_run,
    peak_accelerations,
    prove_collision,
    touches_others,
    wrong_way_steps,
)
from ssad.scenarios.dynamic.knowledge._caching import cached_by_identity
from ssad.world.models import acceleration_limits, lateral_grip, model, model_with_body
from ssad.world.roads.query import LaneQuery

WINDOW = 0.5  # s over which jerks are means; accelerations are those of each step
MAX_JERK = 12.65  # m/s^3, of the careful and competent driver of UN Regulation 157


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
    vehicles = [agent for agent in agent_indices if trace.kind[agent] <= AgentKind.BICYCLE]
    stated_bodies = {actor.name: actor.body for actor in proposal.scenario.actors}
    models = {
        agent: model_with_body(model(trace.models[agent]), stated_bodies.get(trace.names[agent], Body()))
        for agent in vehicles
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
        off_road=any(_leaves_road(trace, graph, agent) for agent in vehicles),
        hit_others=any(touches_others(trace, agent, boxes=agent_boxes) for agent in agent_indices),
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
    """Return True if an agent leaves the road that is its own after having been on it.

    Its centre leaves the road, or comes to drive against traffic for 0.3 s or up to the end. Who has driven against
    traffic from the start has not left anything. Cyclists may leave the road, but not ride against traffic on it.
    """
    present = trace.active[:, agent]
    if not present.any():
        return False
    if trace.kind[agent] <= AgentKind.MOTORCYCLE:
        off_road = _cached_lane_query(graph).off_road(np.stack([trace.x[present, agent], trace.y[present, agent]], 1))
        if (np.diff(off_road.astype(np.int8)) > 0).any():
            return True
    wrong_way = wrong_way_steps(trace, graph, agent)[present]
    lawful_steps = np.flatnonzero(~wrong_way)
    if not len(lawful_steps):
        return False
    wrong_way = wrong_way[lawful_steps[0] :]
    return bool(wrong_way[-1]) or longest_run(wrong_way) >= round(WRONG_WAY_TIME / trace.dt)


def proof_of(
    scenario: Scenario,
    trace: EpisodeTrace,
    graph: LaneGraph,
    adversaries: Collection[str],
    *,
    avoidable: bool | None = None,
) -> CollisionProof:
    """Check the conditions of a proven collision in a drive that has a contact.

    Args:
        scenario: The driven scenario, which states bodies and the surface.
        trace: The drive.
        graph: Lane graph of the town.
        adversaries: Names of the agents that are adversaries.
        avoidable: Whether a careful driver avoids the collision; None: not graded.

    Returns:
        The conditions.
    """
    _, agent = first_contact(trace)
    limits = None
    if agent > 0 and trace.kind[agent] <= AgentKind.BICYCLE:
        body = next((actor.body for actor in scenario.actors if actor.name == trace.names[agent]), Body())
        limits = acceleration_budget(model_with_body(model(trace.models[agent]), body), scenario.friction)
    indices = [index for index, name in enumerate(trace.names) if name in adversaries]
    return prove_collision(trace, graph, indices, limits, avoidable=avoidable)


def adversary_names(outcome: Outcome) -> tuple[str, ...]:
    """Return the names of the adversaries of a driven proposal."""
    return tuple(outcome.trace.names[agent] for agent in outcome.adversaries) if outcome.trace is not None else ()


def is_candidate(outcome: Outcome, graph: LaneGraph) -> bool:
    """Return True if an outcome is a valid collision that would be proven if a careful driver avoids it."""
    return (
        outcome.is_valid
        and outcome.trace is not None
        and proof_of(outcome.proposal.scenario, outcome.trace, graph, adversary_names(outcome)).is_candidate
    )


def acceleration_budget(body: Model, friction: float) -> Accelerations:
    """Return the largest accelerations that a vehicle can have on a surface."""
    return Accelerations(*acceleration_limits(body, friction), lateral_grip(friction))


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
        peaks = peak_accelerations(trace, agent)
        if len(speed) <= lag or peaks is None:
            continue
        efforts = True
        longitudinal = (speed[lag:] - speed[:-lag]) / (lag * trace.dt)
        jerk = np.abs(longitudinal[lag:] - longitudinal[:-lag]) / (lag * trace.dt)
        max_acceleration = max(max_acceleration, peaks.forward, peaks.braking, peaks.lateral)
        max_jerk = max(max_jerk, float(jerk.max(initial=0.0)))
        within_limits &= peaks.within(acceleration_budget(body, friction)) and bool(
            jerk.max(initial=0.0) <= LIMIT_TOLERANCE * MAX_JERK
        )
    return (max_acceleration, max_jerk, within_limits) if efforts else (None, None, None)

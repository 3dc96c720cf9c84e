"""Results of a search for collisions: distinct collisions, and their similarity to ordinary traffic."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from ssad.core.generators import Outcome
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, MOVING, AgentKind, EpisodeTrace
from ssad.metrics.realism import motion_features, pool_motions, realism, wasserstein, within_published
from ssad.world.roads.edge import edge_distances
from ssad.world.roads.query import LaneQuery

MIN_TRAVEL: Final = 5.0  # m; who moves less is parked and says nothing
MIN_DIFFERENCE: Final = 1.0  # m by which motions before contact differ on average, to count as distinct
COMPARED_SECONDS: Final = 3.0  # s of motion that are compared
REPORTED_FEATURES: Final = ("speed", "acceleration", "yaw_rate", "nearest")


def summary(row: Sequence[Outcome]) -> dict[str, Any]:
    """The metrics of one search; means over collisions are None where there is none."""
    valid = [outcome for outcome in row if outcome.is_valid]
    completed = [outcome for outcome in row if outcome.trace is not None]
    first_rollout = next((rollout for rollout, outcome in enumerate(row, 1) if outcome.is_valid), None)

    def mean(values: Sequence[float | bool | None]) -> float | None:
        measured_values = [float(value) for value in values if value is not None]
        return float(np.mean(measured_values)) if measured_values else None

    return {
        "CR": bool(valid),
        "CR_any": any(outcome.collision for outcome in row),
        "rollouts": first_rollout,
        "share": mean([outcome.is_valid for outcome in row]),
        "distinct": len(distinct_collisions(valid)),
        "off_road": mean([outcome.off_road for outcome in completed]),
        "hit_others": mean([outcome.hit_others for outcome in completed]),
        "moving": mean([outcome.ego_speed is not None and outcome.ego_speed > MOVING for outcome in valid]),
        "impact_speed": mean([outcome.impact_speed for outcome in valid]),
        "acceleration": mean([outcome.acceleration for outcome in valid]),
        "jerk": mean([outcome.jerk for outcome in valid]),
        "within_limits": mean([outcome.within_limits for outcome in valid]),
    }


def distinct_collisions(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the distinct ones among some collisions, by the motion of the struck agent as the ego sees it.

    Motions are compared over the 3 s before contact; a mean difference below 1 m is the same collision.
    """
    distinct_approaches: list[tuple[Outcome, np.ndarray[Any, Any]]] = []
    for outcome in outcomes:
        motion = _approach_positions(outcome)
        if all(
            float(np.hypot(*(motion - other_motion).T).mean()) >= MIN_DIFFERENCE
            for _, other_motion in distinct_approaches
        ):
            distinct_approaches.append((outcome, motion))
    return [outcome for outcome, _ in distinct_approaches]


def _approach_positions(outcome: Outcome) -> np.ndarray[Any, Any]:
    """Return the positions of the struck agent in the ego's frame [30, 2], m, in the steps before contact."""
    trace = outcome.trace
    assert trace is not None
    assert outcome.time is not None
    contact_step = round(outcome.time / trace.dt)
    agent = int(trace.contact_agent[contact_step])
    # A contact in the first 3 s repeats the first step, so that all motions have one length.
    steps = np.clip(np.arange(contact_step - round(COMPARED_SECONDS / trace.dt) + 1, contact_step + 1), 0, None)
    x, y = (getattr(trace, name)[steps] for name in ("x", "y"))
    cos, sin = np.cos(trace.yaw[steps, 0]), np.sin(trace.yaw[steps, 0])
    dx, dy = x[:, agent] - x[:, 0], y[:, agent] - y[:, 0]
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx], 1)


def moving_vehicles(trace: EpisodeTrace, agents: Sequence[int]) -> list[int]:
    """Return the vehicles among some agents that travel 5 m or more."""
    travelled = np.hypot(np.ptp(trace.x, axis=0), np.ptp(trace.y, axis=0))
    return [
        agent
        for agent in agents
        if travelled[agent] >= MIN_TRAVEL and AgentKind.NONE < trace.kind[agent] <= AgentKind.BICYCLE
    ]


def motions(trace: EpisodeTrace, graph: LaneGraph, agents: Sequence[int]) -> list[dict[str, F64]]:
    """Return the features of the moving vehicles among some agents."""
    features = []
    query = LaneQuery(graph)
    for agent in moving_vehicles(trace, agents):
        path = np.stack([trace.x[:, agent], trace.y[:, agent]], 1).astype(np.float64)
        features.append(motion_features(trace, agent, edge_distances(query, path)))
    return features


def realism_scores(row: Sequence[Outcome], graph: LaneGraph, reference_motions: Mapping[str, F64]) -> dict[str, float]:
    """Return realism and distances of the adversaries that have collided with the ego; NaN if none has.

    Args:
        row: Outcomes of a search.
        graph: Lane graph of the town.
        reference_motions: Feature -> values of ordinary traffic (`traffic_reference`).

    Returns:
        `realism` and the distances `w_...` under that traffic; `within_published`, the share of the adversaries' time
        within published human driving.
    """
    traces = [(outcome.trace, outcome.adversaries) for outcome in row if outcome.is_valid and outcome.trace is not None]
    features = pool_motions([motion for trace, agents in traces for motion in motions(trace, graph, agents)])
    ordinary = [within_published(trace, agent) for trace, agents in traces for agent in moving_vehicles(trace, agents)]
    steps = np.concatenate([np.zeros(0, bool), *ordinary])
    feature_distances = wasserstein(features, reference_motions)
    return {
        "realism": realism(features, reference_motions),
        "within_published": float(steps.mean()) if len(steps) else math.nan,
        **{f"w_{name}": feature_distances[name] for name in REPORTED_FEATURES},
    }

"""Results of a search for collisions: distinct collisions, and their similarity to ordinary traffic.

The reference for ordinary traffic is that of SSAD's natural scenarios.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssad.core import safeio
from ssad.core.generators import Outcome
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, MOVING, AgentKind, EpisodeTrace
from ssad.metrics.realism import motion_features, pool_motions, realism, wasserstein
from ssad.world.roads.edge import edge_distances
from ssad.world.roads.query import LaneQuery

EPISODES: Final = 12  # of the reference
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


def motions(trace: EpisodeTrace, graph: LaneGraph, agents: Sequence[int]) -> list[dict[str, F64]]:
    """Return the features of the moving vehicles among some agents."""
    features = []
    query = LaneQuery(graph)
    for agent in agents:
        travelled = np.hypot(np.ptp(trace.x[:, agent]), np.ptp(trace.y[:, agent]))
        if travelled < MIN_TRAVEL or not AgentKind.NONE < trace.kind[agent] <= AgentKind.BICYCLE:
            continue
        path = np.stack([trace.x[:, agent], trace.y[:, agent]], 1).astype(np.float64)
        features.append(motion_features(trace, agent, edge_distances(query, path)))
    return features


def realism_scores(row: Sequence[Outcome], graph: LaneGraph, reference_motions: Mapping[str, F64]) -> dict[str, float]:
    """Realism score and distances of the adversaries that have collided with the ego; NaN if none has."""
    features = pool_motions(
        [
            motion
            for outcome in row
            if outcome.is_valid and outcome.trace is not None
            for motion in motions(outcome.trace, graph, outcome.adversaries)
        ]
    )
    feature_distances = wasserstein(features, reference_motions)
    return {
        "realism": realism(features, reference_motions),
        **{f"w_{name}": feature_distances[name] for name in REPORTED_FEATURES},
    }


def load_reference_motions(folder: Path, device: str) -> dict[str, F64]:
    """The features of the vehicles in natural scenarios driven by the Autopilot; made once for a results folder."""
    path = folder / "reference.npz"
    if not path.exists():
        safeio.save_npz(path, _natural_motions(device))
    return {name: np.asarray(values, np.float64) for name, values in safeio.load_npz(path).items()}


@lru_cache(maxsize=1)
def _natural_motions(device: str) -> dict[str, F64]:
    from ssad.drivers import make_system
    from ssad.scenarios.dynamic import load_scenarios
    from ssad.scenarios.dynamic.generate import Trials
    from ssad.world.roads import load_town

    scenarios = load_scenarios("natural")
    trials = Trials(lambda: make_system("autopilot"), make_system, device=device)
    selected = scenarios[:: max(1, len(scenarios) // EPISODES)][:EPISODES]
    features = []
    for base in trials.bases([(scenario, load_town(scenario.town), 0) for scenario in selected]):
        features += motions(base.trace, base.graph, range(1, len(base.trace.names)))
    return pool_motions(features)

"""What a search for collisions has found: how much of it is distinct, and how much it moves like ordinary traffic.

The reference of ordinary traffic is that of SSAD's natural scenarios.
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
from ssad.core.types import F64, AgentKind, EpisodeTrace
from ssad.metrics.realism import motion_features, pooled, realism, wasserstein
from ssad.world.roads.edge import edge_distances
from ssad.world.roads.query import LaneQuery

EPISODES: Final = 12  # of the reference
MOVED: Final = 5.0  # m; who moves less is parked and says nothing
APART: Final = 1.0  # m by which motions before contact differ on average, to count as distinct
BEFORE: Final = 3.0  # s of motion that are compared
MOVING: Final = 0.5  # m/s; an ego that is slower when it is hit stands
SHOWN: Final = ("speed", "acceleration", "yaw_rate", "nearest")


def summary(row: Sequence[Outcome]) -> dict[str, Any]:
    """The metrics of one search; means over collisions are None where there is none."""
    valid = [o for o in row if o.valid]
    ran = [o for o in row if o.trace is not None]
    first = next((n for n, o in enumerate(row, 1) if o.valid), None)

    def mean(values: Sequence[float | bool | None]) -> float | None:
        known = [float(v) for v in values if v is not None]
        return float(np.mean(known)) if known else None

    return {
        "CR": bool(valid),
        "CR_any": any(o.collision for o in row),
        "rollouts": first,
        "share": mean([o.valid for o in row]),
        "distinct": len(distinct(valid)),
        "off_road": mean([o.off_road for o in ran]),
        "hit_others": mean([o.hit_others for o in ran]),
        "moving": mean([o.ego_speed is not None and o.ego_speed > MOVING for o in valid]),
        "impact_speed": mean([o.impact_speed for o in valid]),
        "acceleration": mean([o.acceleration for o in valid]),
        "jerk": mean([o.jerk for o in valid]),
        "within_limits": mean([o.within_limits for o in valid]),
    }


def distinct(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Those of some collisions that are no copies: the motion of who is hit, as the ego sees it, differs.

    It is compared over the 3 s before contact; less than 1 m on average is the same collision.
    """
    kept: list[tuple[Outcome, np.ndarray[Any, Any]]] = []
    for outcome in outcomes:
        motion = _approach(outcome)
        if all(float(np.hypot(*(motion - other).T).mean()) >= APART for _, other in kept):
            kept.append((outcome, motion))
    return [outcome for outcome, _ in kept]


def _approach(outcome: Outcome) -> np.ndarray[Any, Any]:
    """Where the agent that was hit was in the ego's frame [30, 2], m, in the steps before contact."""
    trace = outcome.trace
    assert trace is not None
    assert outcome.time is not None
    row = round(outcome.time / trace.dt)
    agent = int(trace.contact_agent[row])
    rows = np.clip(np.arange(row - round(BEFORE / trace.dt) + 1, row + 1), 0, None)
    x, y = (getattr(trace, name)[rows] for name in ("x", "y"))
    cos, sin = np.cos(trace.yaw[rows, 0]), np.sin(trace.yaw[rows, 0])
    dx, dy = x[:, agent] - x[:, 0], y[:, agent] - y[:, 0]
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx], 1)


def motions(trace: EpisodeTrace, graph: LaneGraph, agents: Sequence[int]) -> list[dict[str, F64]]:
    """The features of the vehicles among some agents that move."""
    found = []
    query = LaneQuery(graph)
    for agent in agents:
        span = np.hypot(np.ptp(trace.x[:, agent]), np.ptp(trace.y[:, agent]))
        if span < MOVED or not AgentKind.NONE < trace.kind[agent] <= AgentKind.BICYCLE:
            continue
        path = np.stack([trace.x[:, agent], trace.y[:, agent]], 1).astype(np.float64)
        found.append(motion_features(trace, agent, edge_distances(query, path)))
    return found


def likeness(row: Sequence[Outcome], graph: LaneGraph, usual: Mapping[str, F64]) -> dict[str, float]:
    """Realism score and distances of the adversaries that have collided with the ego; NaN if none has."""
    collided = [o for o in row if o.valid and o.trace is not None]
    told = pooled([m for o in collided for m in motions(o.trace, graph, o.adversaries)])  # type: ignore[arg-type]
    apart = wasserstein(told, usual)
    return {"realism": realism(told, usual), **{f"w_{name}": apart[name] for name in SHOWN}}


def reference(folder: Path, device: str) -> dict[str, F64]:
    """The features of the vehicles in natural scenarios driven by the Autopilot; made once for a results folder."""
    path = folder / "reference.npz"
    if not path.exists():
        safeio.save_npz(path, _natural(device))
    return {name: np.asarray(values, np.float64) for name, values in safeio.load_npz(path).items()}


@lru_cache(maxsize=1)
def _natural(device: str) -> dict[str, F64]:
    from ssad.drivers import make_system
    from ssad.scenarios.dynamic import load_scenarios
    from ssad.scenarios.dynamic.generate import Trials
    from ssad.world.roads import load_town

    scenarios = load_scenarios("natural")
    trials = Trials(lambda: make_system("autopilot"), make_system, device=device)
    chosen = scenarios[:: max(1, len(scenarios) // EPISODES)][:EPISODES]
    found = []
    for base in trials.bases([(scenario, load_town(scenario.town), 0) for scenario in chosen]):
        found += motions(base.trace, base.graph, range(1, len(base.trace.names)))
    return pooled(found)

"""How much adversaries of a run move like ordinary traffic: that of SSAD's natural scenarios is the reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
import torch

from ssad.bench.kinds.driving import town
from ssad.core import safeio
from ssad.core.generators import Outcome
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, AgentKind, EpisodeTrace
from ssad.metrics.realism import motion_features, pooled, realism, wasserstein

EPISODES: Final = 12  # of the reference
MOVED: Final = 5.0  # m; who moves less is parked and says nothing
SHOWN: Final = ("speed", "acceleration", "yaw_rate", "nearest")


def motions(trace: EpisodeTrace, graph: LaneGraph, agents: Sequence[int]) -> list[dict[str, F64]]:
    """The features of the vehicles among some agents that move."""
    from ssad.scenarios.dynamic.transition.road import raster_of

    found = []
    for agent in agents:
        span = np.hypot(np.ptp(trace.x[:, agent]), np.ptp(trace.y[:, agent]))
        if span < MOVED or not AgentKind.NONE < trace.kind[agent] <= AgentKind.BICYCLE:
            continue
        path = np.stack([trace.x[:, agent], trace.y[:, agent]], 1).astype(np.float64)
        edge = raster_of([graph], [path])(torch.from_numpy(path)[:, None], torch.zeros(len(path), dtype=torch.long))
        found.append(motion_features(trace, agent, edge[:, 0].numpy()))
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

    scenarios = load_scenarios("natural")
    trials = Trials(lambda: make_system("autopilot"), make_system, device=device)
    found = []
    for scenario in scenarios[:: max(1, len(scenarios) // EPISODES)][:EPISODES]:
        base = trials.base(scenario, town(scenario.town), seed=0)
        found += motions(base.trace, base.graph, range(1, len(base.trace.names)))
    return pooled(found)

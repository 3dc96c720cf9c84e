"""What the Autopilot loses when it knows less: collisions and route completion over poorer and poorer beliefs.

`python -m benchmarks.belief` drives the 32 pre-crash and the 150 natural scenarios; `--scenarios safebench,frea` the
imported ones instead; `crowd` is dense traffic: 40 vehicles in Oldmarket and Crossgate for 90 s, 32 scenes each.
`--repetitions 5` draws five episodes of each scenario. Intervals count episodes of a scenario as one
cluster. `--json FILE` writes the figures, `--page` the table of docs/results/traffic.md.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.insert import insert
from benchmarks.traffic import ROUTES, town_routes, traffic
from ssad.core.driving import Belief, Driver, Observation
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import seed32
from ssad.core.traces import trace_hash
from ssad.core.types import Episode, EpisodeLimits, EpisodeTrace
from ssad.drivers.belief import DegradedBelief, LineOfSight
from ssad.drivers.builtin import Autopilot, Blind
from ssad.metrics.intervals import Clusters, bounded_limits
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World


class TruthHandedIn(Autopilot):
    """The Autopilot over the truth, which it gets through the door of beliefs."""

    sensors = ("truth",)

    def believe(self, view: Observation) -> Belief:
        """The truth as it is."""
        belief: Belief = view.readings["truth"]
        return belief


class SeenOnly(LineOfSight):
    """Line of sight without what only the world knows: paths, turns and who gives way are made up from the lanes."""

    def believe(self, view: Observation) -> Belief:
        """Pose, speed, size and kind of what is in sight."""
        belief = super().believe(view)
        return replace(belief, forecast=None, way=None, line_signal=None, standing_time=None, gives_way=None)


SYSTEMS: dict[str, Driver] = {
    "autopilot": Autopilot(),
    "truth handed in": TruthHandedIn(),
    "line-of-sight": LineOfSight(),
    "line of sight, pose and speed alone": SeenOnly(),
    "delay 0.5 s": DegradedBelief(0.0, delay=5),
    "position noise 0.5 m": DegradedBelief(0.0, noise=0.5),
    "30 % missed, 0.5 s at a time": DegradedBelief(0.3, burst=5.0),
    "30 % missed, 2 s at a time": DegradedBelief(0.3, burst=20.0),
    "all missed": DegradedBelief(1.0),
    "blind": Blind(),
}


TITLES = {name: name for name in SYSTEMS} | {
    "autopilot": "the truth inside the world",
    "truth handed in": "the truth handed in",
    "line-of-sight": "line of sight",
    "all missed": "nothing (all missed)",
    "blind": "nobody (`blind`, not the Autopilot)",
}


def crowd(repetitions: int) -> tuple[list[Episode], dict[str, LaneGraph]]:
    """Dense traffic, in which the ego is one of many."""
    graphs = {name: load_town(name) for name in ("Oldmarket", "Crossgate")}
    limits = EpisodeLimits(max_steps=10**6, max_time=90.0, max_distance=1e9)
    episodes = []
    for graph in graphs.values():
        routes = town_routes(graph, ROUTES, 1500.0)
        scenes = [traffic(graph, routes, 40, key=10_000 + k, green=False) for k in range(32 * repetitions)]
        episodes += [replace(scene, limits=limits) for scene in scenes]
    return episodes, graphs


def make_episodes(name: str, repetitions: int) -> tuple[list[Episode], dict[str, LaneGraph]]:
    """Episodes of a set, scenario by scenario, and the towns."""
    if name == "crowd":
        return crowd(repetitions)
    scenarios = load_scenarios(name)
    graphs = {s.town: load_town(s.town) for s in scenarios}
    seeds = [(s, seed32("belief", s.name, k)) for s in scenarios for k in range(repetitions)]
    return [build_episode(s, graphs[s.town], seed=seed) for s, seed in seeds], graphs


def share(values: np.ndarray, repetitions: int) -> dict[str, float]:
    """Mean of values in [0, 1] of all episodes, and its 95 % interval."""
    sums = values.reshape(-1, repetitions).sum(1)
    clusters = Clusters(np.full(len(sums), float(repetitions)), np.zeros(len(sums), np.intp))
    whole = bool(np.isin(values, (0.0, 1.0)).all())
    found = bounded_limits(sums, clusters, cap=2.0 * len(values) if whole else float("inf"))
    return {"mean": float(found.mean), "low": float(found.low), "high": float(found.high)}


def row(traces: list[EpisodeTrace], repetitions: int) -> dict[str, dict[str, float]]:
    """Collision rate and route completion."""
    hit = np.array([trace.end == "collision" for trace in traces], np.float64)
    complete = np.array([float(trace.route_complete[-1]) for trace in traces]) / 100.0
    return {"CR": share(hit, repetitions), "RC": share(complete, repetitions)}


def text(value: dict[str, float]) -> str:
    """A mean with its interval."""
    return f"{value['mean']:.3f} [{value['low']:.3f}, {value['high']:.3f}]"


def page(figures: dict[str, dict[str, Any]]) -> None:
    """Write the table between its markers in the document."""
    sets = list(figures)
    heads = [f"CR, {name} (n = {figures[name]['episodes']}) | RC" for name in sets]
    total = sum(figures[name]["episodes"] for name in sets)
    lines = [
        "| Autopilot over | " + " | ".join([*heads, "episodes driven otherwise"]) + " |",
        "|---" * (2 * len(sets) + 2) + "|",
    ]
    for system, title in TITLES.items():
        rows = [figures[name][system] for name in sets]
        cells = [f"{text(row['CR'])} | {text(row['RC'])}" for row in rows]
        lines.append(f"| {title} | {' | '.join(cells)} | {sum(row['other'] for row in rows)} of {total} |")
    insert("results/traffic.md", "beliefs", lines)


def main() -> None:
    """Drive, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenarios", default="precrash,natural", help="sets, with commas")
    parser.add_argument("--repetitions", type=int, default=1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--page", action="store_true", help="write docs/results/traffic.md")
    given = parser.parse_args()
    figures: dict[str, dict[str, Any]] = {}
    for name in given.scenarios.split(","):
        episodes, graphs = make_episodes(name, given.repetitions)
        figures[name] = {"episodes": len(episodes)}
        print(f"\n{name}: {len(episodes)} episodes")
        print("| Autopilot over | CR | RC | episodes driven otherwise |\n|---|---|---|---|")
        first: list[str] = []
        for system, driver in SYSTEMS.items():
            traces = rollout(World(episodes, graphs), driver)
            told = [trace_hash(trace) for trace in traces]
            first = first or told
            other = sum(a != b for a, b in zip(first, told, strict=True))
            found = row(traces, given.repetitions)
            figures[name][system] = found | {"other": other}
            print(f"| {system} | {text(found['CR'])} | {text(found['RC'])} | {other} |", flush=True)
    if given.json:
        given.json.write_text(json.dumps(figures, indent=1))
    if given.page:
        page(figures)


if __name__ == "__main__":
    main()

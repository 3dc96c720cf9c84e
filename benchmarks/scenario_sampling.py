"""Draws of the pre-crash scenarios: how fast they become episodes, and how dangerous they are.

    uv run python benchmarks/scenario_sampling.py speed
    uv run python benchmarks/scenario_sampling.py speed --baseline OTHER_CHECKOUT/src
    uv run python benchmarks/scenario_sampling.py danger

speed: for every class the milliseconds of CPU time a draw, median of runs, of the slowest of its four scenarios.
`build`: the parameters are given and the episode is built; `draw and build`: `build_episode(..., spread=1.0)`. With
--baseline the same parameters are built with another version of the package as well, in processes that take turns;
`ratio` is its time over ours.
danger: for every class the share of episodes in which the ego collides: its four scenarios as they are (nominal), and
drawn with 50 seeds each at spread 1.
"""

from __future__ import annotations

import argparse
import inspect
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ssad.core.types import Episode, EpisodeTrace, Scenario
from ssad.scenarios.dynamic import PRECRASH, build_episode, load_scenarios, scenario_type
from ssad.world.roads import load_town


def parameter_samples(scenario: Scenario, count: int) -> list[Scenario]:
    """The scenario with its class's parameters drawn within a tenth of their ranges around its own values."""
    kind = scenario_type(scenario.type)
    random = np.random.default_rng(0)
    samples = []
    for _ in range(count):
        values = {}
        for parameter in kind.parameters:
            half = 0.1 * (parameter.high - parameter.low)
            value = scenario.parameters.get(parameter.name, parameter.default) + half * random.uniform(-1.0, 1.0)
            values[parameter.name] = float(np.clip(value, parameter.low, parameter.high))
        samples.append(replace(scenario, parameters=values))
    return samples


def milliseconds(build: Callable[[int], Episode], count: int) -> float:
    """CPU time per call of `build`, called with 1 to `count` after a first call that does not count."""
    build(0)
    began = time.process_time()
    for index in range(1, count + 1):
        build(index)
    return 1e3 * (time.process_time() - began) / count


def measure(count: int) -> dict[str, dict[str, float]]:
    """Class -> ms a sample of the slowest of its scenarios, for each way of building."""
    drawn = "spread" in inspect.signature(build_episode).parameters
    result: dict[str, dict[str, float]] = {}
    for name in PRECRASH:
        row: dict[str, float] = {}
        for scenario in load_scenarios(name):
            graph = load_town(scenario.town)
            samples = parameter_samples(scenario, count + 1)
            times = {"build": milliseconds(lambda k, g=graph, s=samples: build_episode(s[k], g, seed=0), count)}
            if drawn:
                times["draw and build"] = milliseconds(
                    lambda k, g=graph, s=scenario: build_episode(s, g, seed=k, spread=1.0), count
                )
            row = {way: max(value, row.get(way, 0.0)) for way, value in times.items()}
        result[name] = row
    return result


def measure_apart(source: Path, count: int) -> dict[str, dict[str, float]]:
    """`measure` in a process of its own, with the package in folder `source`."""
    command = [sys.executable, __file__, "speed", "--once", "--count", str(count)]
    environment = {**os.environ, "PYTHONPATH": str(source.resolve())}
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    result: dict[str, dict[str, float]] = json.loads(done.stdout)
    return result


def drive(episodes: Sequence[Episode], system: str) -> list[EpisodeTrace]:
    """What happens in the episodes with a driving system by name."""
    from ssad.core.machine import start_warp_quietly
    from ssad.drivers import make_system
    from ssad.world.rollout import rollout
    from ssad.world.world import World

    start_warp_quietly()
    return rollout(World(episodes, {e.town: load_town(e.town) for e in episodes}), make_system(system))


def danger(seeds: int, systems: Sequence[str] = ("blind", "autopilot")) -> dict[str, dict[str, dict[str, Any]]]:
    """Class -> system -> what `seeds` draws of each of its scenarios come to.

    nominal, drawn: share of episodes that end with a collision; motions: number of different motions among the draws
    of each scenario; contact_at_start: number of draws in which the ego touches something before it moves.
    """
    scenarios = [scenario for name in PRECRASH for scenario in load_scenarios(name)]
    seed_of = [None, *range(seeds)]  # None: the nominal case
    episodes = [
        build_episode(s, load_town(s.town), seed=seed or 0, spread=0.0 if seed is None else 1.0)
        for s in scenarios
        for seed in seed_of
    ]
    result: dict[str, dict[str, dict[str, Any]]] = {name: {} for name in PRECRASH}
    for system in systems:
        traces = drive(episodes, system)
        for name in PRECRASH:
            rows = [
                traces[k * len(seed_of) : (k + 1) * len(seed_of)] for k, s in enumerate(scenarios) if s.type == name
            ]
            drawn = [trace for row in rows for trace in row[1:]]
            result[name][system] = {
                "nominal": statistics.mean(row[0].end == "collision" for row in rows),
                "drawn": statistics.mean(trace.end == "collision" for trace in drawn),
                "motions": [len({t.x.tobytes() + t.y.tobytes() + t.yaw.tobytes() for t in row[1:]}) for row in rows],
                "contact_at_start": sum(bool(trace.contact[0]) for trace in drawn),
            }
    return result


def show_danger(seeds: int) -> None:
    """Print the table of `danger`."""
    rates = danger(seeds)
    print("| Class | blind, nominal | blind, drawn | Autopilot, nominal | Autopilot, drawn |")
    print("|---|---|---|---|---|")
    for name, systems in rates.items():
        cells = [f"{systems[s][case]:.2f}" for s in ("blind", "autopilot") for case in ("nominal", "drawn")]
        print(f"| {name} | {' | '.join(cells)} |")


def main() -> None:
    """Print the table that was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("speed", "danger"))
    parser.add_argument("--seeds", type=int, default=50, help="danger: draws of a scenario")
    parser.add_argument("--count", type=int, default=1000, help="speed: draws of a scenario")
    parser.add_argument("--runs", type=int, default=5, help="speed: runs that the median is taken of")
    parser.add_argument("--baseline", type=Path, help="speed: folder of another version of the package (its src)")
    parser.add_argument("--baseline-count", type=int, default=10, help="speed: draws of a scenario for the baseline")
    parser.add_argument("--once", action="store_true", help="speed: one run, as JSON")
    options = parser.parse_args()
    if options.what == "danger":
        show_danger(options.seeds)
    elif options.once:
        print(json.dumps(measure(options.count)))
    else:
        show_speed(options.count, options.runs, options.baseline, options.baseline_count)


def show_speed(count: int, repeats: int, baseline: Path | None, baseline_count: int) -> None:
    """Print the table of `measure`."""
    here = Path(inspect.getfile(build_episode)).parents[3]
    ours, theirs = [], []
    for _ in range(repeats):
        ours.append(measure_apart(here, count))
        if baseline:
            theirs.append(measure_apart(baseline, baseline_count))

    def median(runs: list[dict[str, dict[str, float]]], name: str, way: str) -> float:
        return statistics.median(run[name][way] for run in runs)

    print("| Class | build, ms | draw and build, ms |" + (" baseline: build, ms | ratio |" if theirs else ""))
    print("|---|---|---|" + ("---|---|" if theirs else ""))
    for name in PRECRASH:
        build = median(ours, name, "build")
        row = f"| {name} | {build:.3f} | {median(ours, name, 'draw and build'):.3f} |"
        if theirs:
            before = median(theirs, name, "build")
            row += f" {before:.2f} | {before / build:.0f} |"
        print(row)


if __name__ == "__main__":
    main()

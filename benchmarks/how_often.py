"""How often a driver fails: brute force beside splitting and importance sampling, in car following with lapses.

    uv run python -m benchmarks.how_often brute --lapse 0.2 --crashes 10000 --device cuda --json FILE
    uv run python -m benchmarks.how_often coverage --lapse 0.2 --repeats 1000 --truth FILE --json FILE

`brute` runs episodes of one scenario of the set lane-traffic until so many have ended in a collision, and saves after
each batch. `coverage` repeats both accelerated estimates and counts how many intervals hold the probability of `brute`.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from ssad.core.seeding import generator
from ssad.drivers import make_system
from ssad.jobs.machine import quiet_warp
from ssad.roads import load_town
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.noise import Noise
from ssad.world.rare.brute import monte_carlo
from ssad.world.rare.process import WorldProcess
from ssad.world.rollout import Loop
from ssad.world.world import World

SCENARIO = "lane-traffic/05"


def noise_of(given: argparse.Namespace) -> Noise:
    """The noise of a command line."""
    return Noise(
        accel=given.accel, accel_time=1.5, lapse=given.lapse, choice_time=given.choice_time, stretches=9, stretch=10
    )


def make_process(batch: int, noise: Noise, *, device: str, scenario: str = SCENARIO) -> WorldProcess:
    """Rows of one scenario, the ego driven by the Autopilot."""
    (found,) = load_scenarios(scenario)
    graphs = {found.town: load_town(found.town)}
    bank = [build_episode(found, graphs[found.town], seed=0)]
    world = World(bank, graphs, assign=np.zeros(batch, int), device=device, noise=noise)
    return WorldProcess(Loop(world, {0: make_system("autopilot")}))


def write(path: Path | None, data: dict[str, Any]) -> None:
    """Write figures if asked to."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def brute(given: argparse.Namespace) -> None:
    """Plain Monte Carlo."""
    process = make_process(given.batch, noise_of(given), device=given.device)
    random = generator("how often", "brute", given.lapse, given.accel, given.choice_time, given.seed)
    began = time.perf_counter()
    processor = time.process_time()
    crashes: list[str] = []
    for found, keys in monte_carlo(process, random, episodes=given.episodes, events=given.crashes):
        crashes += [str(k) for k in keys[: max(0, 8 - len(crashes))]]
        spent = time.perf_counter() - began
        data = {
            "scenario": SCENARIO, "device": given.device, "batch": given.batch, "noise": vars(noise_of(given)),
            "seconds": spent, "processor_s": time.process_time() - processor, "steps_per_s": found.work / spent,
            "crash_keys": crashes, **found.as_dict(),
        }  # fmt: skip
        write(given.json, data)
        if spent > given.seconds:
            break
    print(
        f"{found.events} crashes in {found.episodes:,} episodes: {found.probability:.4g} ({found.low:.4g} to "
        f"{found.high:.4g}), {found.work:.3g} agent-steps in {spent:.1f} s ({found.work / spent:,.0f} a second)"
    )


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("brute", "coverage"))
    parser.add_argument("--lapse", type=float, default=0.2)
    parser.add_argument("--accel", type=float, default=2.0)
    parser.add_argument("--choice-time", type=float, default=2.0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=4096)
    parser.add_argument("--crashes", type=int, default=None)
    parser.add_argument("--episodes", type=int, default=10**10)
    parser.add_argument("--seconds", type=float, default=1e9, help="no new batch after so long")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    quiet_warp()
    brute(given)


if __name__ == "__main__":
    main()

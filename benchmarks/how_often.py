"""How often a driver fails: brute force beside splitting and importance sampling, in car following with lapses.

    uv run python -m benchmarks.how_often brute --lapse 0.04 --crashes 10000 --device cuda --json FILE
    uv run python -m benchmarks.how_often coverage --lapse 0.04 --repeats 1000 --json FILE

`brute` runs episodes of one scenario of the set lane-traffic until so many have ended in a collision, and saves after
each batch; what FILE has of the same case is added to. `coverage` repeats both accelerated estimates (with other seeds
in several processes), and prints how many intervals of importance sampling hold their mean.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from ssad.core.machine import start_warp_quietly
from ssad.core.seeding import generator
from ssad.drivers import make_system
from ssad.metrics.rare_events import weighted_limits
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.noise import Noise
from ssad.world.rare.brute import monte_carlo
from ssad.world.rare.importance import importance, learn
from ssad.world.rare.process import WorldProcess
from ssad.world.rare.splitting import splitting
from ssad.world.roads import load_town
from ssad.world.rollout import Loop
from ssad.world.world import World

SCENARIO = "lane-traffic/05"
COLUMNS = ["probability", "low", "high", "effective", "work"]


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
    about = {"scenario": SCENARIO, "device": given.device, "batch": given.batch, "noise": vars(noise_of(given))}
    names = ("events", "episodes", "work", "seconds", "processor_s")
    old: dict[str, Any] = dict.fromkeys(names, 0)
    if given.json is not None and given.json.exists():
        kept = json.loads(given.json.read_text(encoding="utf-8"))
        old = kept if {name: kept[name] for name in about} == about else old
    data = about | old
    process = make_process(given.batch, noise_of(given), device=given.device)
    chance = [given.lapse, given.accel, given.choice_time, given.seed, *([old["episodes"]] if old["episodes"] else [])]
    random = generator("how often", "brute", *chance)
    began, processor = time.perf_counter(), time.process_time()
    wanted = None if given.crashes is None else given.crashes - old["events"]
    for found, keys in monte_carlo(process, random, episodes=given.episodes - old["episodes"], events=wanted):
        spent = time.perf_counter() - began
        now = found.events, found.episodes, found.work, spent, time.process_time() - processor
        sums = {name: old[name] + value for name, value in zip(names, now, strict=True)}
        low, high = (float(v) for v in weighted_limits(sums["events"], sums["events"], 1.0, sums["episodes"]))
        data = about | found.as_dict() | {"probability": sums["events"] / sums["episodes"], "low": low, "high": high}
        data |= {"effective": float(sums["events"]), "steps_per_s": sums["work"] / sums["seconds"]} | sums
        data["crash_keys"] = old.get("crash_keys") or [str(key) for key in keys[:8]]
        write(given.json, data)
        if spent > given.seconds:
            break
    print(
        f"{data['events']} crashes in {data['episodes']:,} episodes: {data['probability']:.4g} ({data['low']:.4g} to "
        f"{data['high']:.4g}), {data['work']:.3g} agent-steps in {data['seconds']:.1f} s "
        f"({data['work'] / data['seconds']:,.0f} a second)"
    )


def coverage(given: argparse.Namespace) -> None:
    """Repeat both accelerated estimates, and keep every interval."""
    sampling: list[list[float]] = []
    training: list[float] = []
    branching: list[list[float]] = []
    began = time.perf_counter()
    learning: dict[str, Any] = {"components": 4, "rounds": 2, "episodes": 3000, "defence": given.defence}
    batches = -(-given.each // (16_384 if given.device == "cpu" else 65_536))
    process = make_process(-(-given.each // batches), noise_of(given), device=given.device)
    for number in range(given.repeats):
        random = generator("how often", "importance", given.lapse, given.seed, number)
        if number % given.share == 0:  # a proposal serves so many estimates, each of which counts its whole training
            pupil = make_process(1000, noise_of(given), device="cpu")  # it branches on the host
            proposal = learn(pupil, random, **learning)
            training.append(pupil.work())
        found, _ = importance(process, proposal, random, episodes=given.each, training=training[-1])
        sampling.append([found.probability, found.low, found.high, found.effective, found.work])
        if number % given.share == given.share - 1 and len(branching) < given.splittings:
            branch = splitting(make_process(3000, noise_of(given), device="cpu"), random, repeats=20).estimate()
            branching.append([branch.probability, branch.low, branch.high, branch.effective, branch.work])
        if number % 20 == 19 or number == given.repeats - 1:
            data = {
                "scenario": SCENARIO,
                "noise": vars(noise_of(given)),
                "repeats": number + 1,
                "share": given.share,
                "each": given.each,
                "device": given.device,
                "room": 1.0,
                "learning": learning,
                "training": training,
                "seconds": time.perf_counter() - began,
                "columns": COLUMNS,
                "importance": rounded(sampling),
                "splitting": rounded(branching),
            }
            write(given.json, data)
            mean = float(np.mean(sampling, axis=0)[0])
            held = np.mean([low <= mean <= high for _, low, high, _, _ in sampling])
            print(f"{number + 1} repeats: mean {mean:.4g}, held by {held:.1%}, {data['seconds']:.0f} s", flush=True)


def rounded(rows: list[list[float]]) -> list[list[float]]:
    """To five digits."""
    return [[float(f"{value:.5g}") for value in row] for row in rows]


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
    parser.add_argument("--share", type=int, default=10, help="estimates that share a proposal")
    parser.add_argument("--each", type=int, default=15_000, help="episodes of an estimate")
    parser.add_argument("--defence", type=float, default=0.1, help="share of the proposal that is not moved")
    parser.add_argument("--splittings", type=int, default=40)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    start_warp_quietly()
    {"brute": brute, "coverage": coverage}[given.what](given)


if __name__ == "__main__":
    main()

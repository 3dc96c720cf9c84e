"""Speed of the world's step beside that of another version, in turn on the same machine and the same scenarios.

    git worktree add ../before 2dc730f
    uv run python -m benchmarks.world_ratio ../before --json benchmarks/results/world-ratio.json

Each version runs in a process of its own. Both go through the same steps again and again; the figure is the median of
the ratios of processor times, which counts also where the machine has other things to do. On a GPU (`--device cuda`)
it is the wall clock, and the machine must be idle.

Both drive the scenarios of the other version, of which this one gives each vehicle a driver of its own with `--drivers
population`. Vehicles are then at other places after the first seconds; their number is the same.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SCENARIOS = Path("src") / "ssad" / "scenarios" / "dynamic" / "data" / "natural-unselected.yaml"
WARM = 60  # steps before the first that counts, for traffic to be awake


def serve(scenario_file: Path, drivers: str, batch: int, steps: int, device: str) -> None:
    """In a process of its own: for each line that comes, drive the same steps and answer with the s that they took."""
    import warp

    from ssad.core.types import Controller, TrafficPlan
    from ssad.scenarios.dynamic import build_episode, load_scenarios
    from ssad.world.roads import load_town
    from ssad.world.world import World

    scenarios = load_scenarios(scenario_file)
    if drivers == "population":  # the other version may not know the field
        plan = TrafficPlan(drivers="population")  # otherwise that of the set's scenarios, which name none
        scenarios = tuple(replace(scenario, traffic=plan) for scenario in scenarios)
    graphs = {s.town: load_town(s.town) for s in scenarios}
    bank = [build_episode(s, graphs[s.town], seed=k) for k, s in enumerate(scenarios)]
    assign = [k % len(bank) for k in range(batch)]
    world = World(bank, graphs, assign=assign, ego=Controller.AUTOPILOT, autoreset=True, device=device)
    clock = time.process_time if device == "cpu" else time.perf_counter
    for _ in range(WARM):
        world.step()
    if device != "cpu":
        world.capture()
    start = world.snapshot()
    for _ in sys.stdin:
        world.restore(start)
        warp.synchronize_device(device)
        began = clock()
        for _ in range(steps):
            world.step()
        warp.synchronize_device(device)
        print(f"took {clock() - began}", flush=True)


def ask(process: subprocess.Popen[str]) -> float:
    """One round of a process."""
    assert process.stdin is not None
    assert process.stdout is not None
    print("go", file=process.stdin, flush=True)
    for line in process.stdout:  # Warp prints, too
        if line.startswith("took "):
            return float(line[5:])
    raise SystemExit("a version has failed")


def measure(before: Path, *, drivers: str, batch: int, steps: int, rounds: int, device: str) -> dict[str, Any]:
    """Speed of this version over that of another, as the median of the rounds and the middle half of them."""
    words = [sys.executable, __file__, str(before), "--serve", "--batch", str(batch), "--steps", str(steps)]
    words += ["--device", device]
    others = [os.environ["PYTHONPATH"]] if "PYTHONPATH" in os.environ else []
    pair = [
        subprocess.Popen(
            [*words, "--drivers", style],
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tree / "src"), *others])},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for tree, style in ((before, "uniform"), (ROOT, drivers))
    ]
    ratios = []
    for number in range(-1, rounds):
        order = (0, 1) if number % 2 else (1, 0)
        took = {k: ask(pair[k]) for k in order}
        if number >= 0:  # the first also loads code
            ratios.append(took[0] / took[1])
    for process in pair:
        process.communicate()
    low, middle, high = statistics.quantiles(ratios, n=4)
    sizes = {"batch": batch, "steps": steps, "rounds": rounds}
    about = {"device": name_of(device), "drivers": drivers, **sizes, "commit": commit()}
    return {**about, "ratio": middle, "low": low, "high": high}


def name_of(device: str) -> str:
    """Of a GPU as it calls itself."""
    import warp

    return device if device == "cpu" else str(warp.get_device(device).name)


def commit() -> str:
    """Of this version; "unknown" outside a checkout."""
    words = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    result = subprocess.run(words, capture_output=True, text=True, check=False)
    return result.stdout.strip() or "unknown"


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="folder of a checkout of the other version")
    parser.add_argument("--drivers", choices=("uniform", "population"), default="uniform", help="of this version")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        serve(given.before / SCENARIOS, given.drivers, given.batch, given.steps, given.device)
        return
    sizes = {"batch": given.batch, "steps": given.steps, "rounds": given.rounds}
    result = measure(given.before.resolve(), drivers=given.drivers, **sizes, device=given.device)
    print(f"{result['ratio']:.3f} times the speed of {given.before} ({result['low']:.3f} to {result['high']:.3f})")
    if given.json:
        given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

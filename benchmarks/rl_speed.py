"""Speed of training with stable-baselines3: PPO's environment steps a second, beside highway-env in the same run.

    uv run --extra train --group bench python -m benchmarks.rl_speed --adversary --page

64 scenes, 4 epochs, batches of 1,024, two layers of 64. highway-env runs 8 environments in one process (DummyVecEnv),
as its users do; its step is one decision, as ours. torch takes one thread: networks this small lose by a second one.
Wall clock, medians over interleaved repeats; processor time beside it, which counts also where the machine has other
things to do. `--adversary` also trains Adv.PPO from nothing, as `ssad train adversary` does; `--page` writes what is
kept into docs/results/drivers.md.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from ssad.core.checkpoints import load_card
from ssad.envs import make_sb3
from ssad.training.adversary import AdversaryPlan, run_adversary_training

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "rl-speed.json"
DOCUMENT = ROOT / "docs" / "results" / "drivers.md"
BEGIN, END = "<!-- speed: begin -->", "<!-- speed: end -->"


def train(make: Callable[[], object], steps: int, *, n_steps: int, batch: int) -> Callable[[], tuple[float, float]]:
    """A function that trains for `steps` more and says how many steps it made a second, and a second of processor."""
    from stable_baselines3 import PPO

    model = PPO("MlpPolicy", make(), n_steps=n_steps, batch_size=batch, n_epochs=4, seed=0, device="cpu")
    model.learn(n_steps * 8)

    def once() -> tuple[float, float]:
        began, used = time.perf_counter(), time.process_time()
        model.learn(steps)
        return steps / (time.perf_counter() - began), steps / (time.process_time() - used)

    return once


def highway() -> object:
    """highway-env's own intersection, eight times."""
    import gymnasium
    import highway_env  # noqa: F401  registers its environments
    from stable_baselines3.common.vec_env import DummyVecEnv

    return DummyVecEnv([lambda: gymnasium.make("intersection-v2")] * 8)


def train_adversary() -> dict[str, float]:
    """Adv.PPO from nothing, validation and final test included: time, and what its card says."""
    began, used = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        list(run_adversary_training(AdversaryPlan("adv-ppo-paper", Path(folder))))
        card, _ = load_card(Path(folder) / "adv-ppo.safetensors")
    return {"seconds": time.perf_counter() - began, "processor_s": time.process_time() - used, **card.metrics}


def page(found: dict[str, Any]) -> None:
    """Write the table between its markers in the document."""
    lines = ["| PPO's steps of the environment | a second | a second of processor time |", "|---|---:|---:|"]
    for name in ("ssad", "highway-env"):
        lines.append(f"| {name} | {found[name]['steps_per_s']:,.0f} | {found[name]['per_processor_s']:,.0f} |")
    busy = ": other processes ran beside it" if found["load"] > found["cores"] else ""
    lines += ["", f"({found['cores']} cores, load {found['load']:.1f}{busy}.)"]
    if "adversary" in found:
        own = found["adversary"]
        lines.append(
            f"Adv.PPO from nothing, validation and test included, takes {own['processor_s']:,.0f} s of one core's "
            f"time; against the Autopilot it then collides in {own['natural_CR']:.2f} of the set `natural`, in "
            f"{own['natural_valid']:.2f} on the road and hitting nobody else."
        )
    whole = DOCUMENT.read_text(encoding="utf-8")
    before, _, rest = whole.partition(BEGIN)
    DOCUMENT.write_text("\n".join([before + BEGIN, *lines, END + rest.partition(END)[2]]), encoding="utf-8")


def main() -> None:
    """Print the rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", default="natural-uniform")
    parser.add_argument("--steps", type=int, default=64 * 128)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--no-highway", action="store_true")
    parser.add_argument("--adversary", action="store_true", help="train Adv.PPO, too")
    parser.add_argument("--json", type=Path, default=RESULTS)
    parser.add_argument("--page", action="store_true", help="write docs/results/drivers.md")
    args = parser.parse_args()
    torch.set_num_threads(1)
    began = time.perf_counter()
    ours = train(lambda: make_sb3(num_envs=64, scenarios=args.scenarios), args.steps, n_steps=128, batch=1024)
    print(f"first start, episodes and kernels included: {time.perf_counter() - began:.1f} s")
    began = time.perf_counter()
    make_sb3(num_envs=64, scenarios=args.scenarios)
    print(f"second start, from the cache: {time.perf_counter() - began:.2f} s")
    theirs = None if args.no_highway else train(highway, 512, n_steps=64, batch=256)
    rates: dict[str, list[tuple[float, float]]] = {"ssad": [], "highway-env": []}
    for _ in range(args.repeats):
        rates["ssad"].append(ours())
        if theirs is not None:
            rates["highway-env"].append(theirs())
    load = os.getloadavg()[0]
    print(f"{os.cpu_count()} cores, {torch.get_num_threads()} torch thread, load {load:.1f}")
    found: dict[str, Any] = {"cores": os.cpu_count(), "load": load}
    if not args.adversary and args.json.is_file():
        found |= {k: v for k, v in json.loads(args.json.read_text(encoding="utf-8")).items() if k == "adversary"}
    for name, values in rates.items():
        if values:
            wall, own = ([value[k] for value in values] for k in (0, 1))
            found[name] = {"steps_per_s": statistics.median(wall), "per_processor_s": statistics.median(own)}
            print(
                f"{name}: {statistics.median(wall):,.0f} steps/s ({min(wall):,.0f} to {max(wall):,.0f}); "
                f"{statistics.median(own):,.0f} a second of processor time"
            )
    if args.adversary:
        found["adversary"] = train_adversary()
        print(found["adversary"])
    args.json.write_text(json.dumps(found, indent=1) + "\n")
    if args.page:
        page(found)


if __name__ == "__main__":
    main()

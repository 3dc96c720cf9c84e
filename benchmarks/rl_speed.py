"""Speed of training with stable-baselines3: PPO's environment steps a second, beside highway-env in the same run.

    uv run --extra train --group bench python benchmarks/rl_speed.py --json benchmarks/results/rl-speed.json

64 scenes, 4 epochs, batches of 1,024, two layers of 64. highway-env runs 8 environments in one process (DummyVecEnv),
as its users do; its step is one decision, as ours. torch takes one thread: networks this small lose by a second one.
Wall clock, medians over interleaved repeats; processor time beside it, which counts also where the machine has other
things to do.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from ssad.envs import make_sb3


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


def main() -> None:
    """Print the rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", default="natural")
    parser.add_argument("--steps", type=int, default=64 * 128)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--no-highway", action="store_true")
    parser.add_argument("--json", type=Path)
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
    found: dict[str, object] = {"cores": os.cpu_count(), "load": load}
    for name, values in rates.items():
        if values:
            wall, own = ([value[k] for value in values] for k in (0, 1))
            found[name] = {"steps_per_s": statistics.median(wall), "per_processor_s": statistics.median(own)}
            print(
                f"{name}: {statistics.median(wall):,.0f} steps/s ({min(wall):,.0f} to {max(wall):,.0f}); "
                f"{statistics.median(own):,.0f} a second of processor time"
            )
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Speed of the world: the full step with traffic, signals, observation and reset, in agent-steps a second.

    uv run --group bench python benchmarks/world_speed.py                  CPU, beside highway-env's intersection-v1
    uv run python benchmarks/world_speed.py --device cuda --no-highway     GPU

An agent-step is one present agent advanced by 0.1 s (two sub-steps); absent slots of a batch do not count. For
highway-env it is one vehicle advanced by one of its simulation sub-steps, which flatters it. Medians over repeats;
CPU figures are process CPU time of one thread.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from ssad.core.types import Controller
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.kernels.look import OBSERVATION, look
from ssad.world.roads import load_town
from ssad.world.sensors import launcher
from ssad.world.world import World


def make_look(world: World) -> Any:
    """The launch that observes every ego."""
    egos = np.stack([np.arange(world.batch), np.zeros(world.batch)], 1).astype(np.int32)
    return launcher(world, look, egos, (world.batch, OBSERVATION), world.batch)[0]


def make_world(batch: int, device: str, episodes: int) -> World:
    """`batch` scenes over a bank of natural episodes, egos on Autopilot, started again when they end."""
    scenarios = load_scenarios("natural-uniform")
    graphs = {s.town: load_town(s.town) for s in scenarios}
    bank = [build_episode(s, graphs[s.town], seed=k) for k, s in enumerate(scenarios)]
    # the busiest first, so that one scene alone holds about as many vehicles as highway-env's
    bank = sorted(bank, key=lambda e: -len(e.agents))[: max(episodes, 1)]
    assign = np.arange(batch) % len(bank)
    return World(bank, graphs, assign=assign, device=device, ego=Controller.AUTOPILOT, autoreset=True)


def timed(work: Callable[[], None], clock: Callable[[], float], repeats: int) -> list[float]:
    """Seconds of each repeat."""
    out = []
    for _ in range(repeats):
        start = clock()
        work()
        out.append(clock() - start)
    return out


def measure(batch: int, device: str, *, observe: bool, repeats: int, budget: float) -> dict[str, float]:
    """Median agent-steps a second at one batch size."""
    world = make_world(batch, device, min(batch, 150))
    see = make_look(world)
    cuda = device != "cpu"
    clock = time.perf_counter if cuda else time.process_time

    def once(n: int) -> None:
        for _ in range(n):
            world.step()
            if observe:
                see.launch()
        if cuda:
            wp.synchronize_device(device)

    once(20)
    if cuda:
        world.capture(more=[see] if observe else [])

        def once(n: int) -> None:
            for _ in range(n):
                wp.capture_launch(world._graph)
            wp.synchronize_device(device)

    present = float((world.array("active") != 0).sum())
    probe = timed(lambda: once(10), clock, 3)
    n = max(10, int(budget / max(min(probe) / 10, 1e-6) / repeats))
    runs = timed(lambda: once(n), clock, repeats)
    present = 0.5 * (present + float((world.array("active") != 0).sum()))
    per_step = statistics.median(runs) / n
    return {
        "batch": batch,
        "agents": round(present / batch, 2),
        "us_per_step": per_step * 1e6,
        "agent_steps_per_s": present / per_step,
        "spread": (max(runs) - min(runs)) / statistics.median(runs),
    }


def parts(batch: int, device: str, repeats: int = 5) -> dict[str, float]:
    """Share of the step that each kernel takes, in microseconds."""
    world = make_world(batch, device, min(batch, 150))
    view = make_look(world)
    for _ in range(50):
        world.step()
    names = ["restart", "restart_record", "see", "sight", "meet", "change_lanes", "drive"]
    names += ["move", "contact", "record", "look"]
    spent: dict[str, list[float]] = {n: [] for n in names}
    for _ in range(repeats * 10):
        for name, command in zip(names, [*world._plan, *world._advance, view], strict=True):
            wp.synchronize_device(device)
            start = time.perf_counter()
            command.launch()
            wp.synchronize_device(device)
            spent[name].append(time.perf_counter() - start)
    return {name: statistics.median(values) * 1e6 for name, values in spent.items()}


def highway(repeats: int, steps: int) -> dict[str, float]:
    """highway-env's intersection-v1 with random actions, resets included."""
    import gymnasium as gym
    import highway_env

    highway_env._register_highway_envs() if hasattr(highway_env, "_register_highway_envs") else None
    env = gym.make("intersection-v1").unwrapped
    env.reset(seed=0)
    env.action_space.seed(0)
    substeps = int(env.config["simulation_frequency"] // env.config["policy_frequency"])
    rates, vehicles = [], []
    for _ in range(repeats):
        start = time.process_time()
        count = 0
        for _ in range(steps):
            _, _, done, cut, _ = env.step(env.action_space.sample())
            count += len(env.road.vehicles) * substeps
            vehicles.append(len(env.road.vehicles))
            if done or cut:
                env.reset()
        rates.append(count / (time.process_time() - start))
    return {
        "agents": statistics.mean(vehicles),
        "substeps": substeps,
        "agent_steps_per_s": statistics.median(rates),
    }


def main() -> None:
    """Print a table and, with --json, write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, nargs="*", default=None)
    parser.add_argument("--no-highway", action="store_true")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--budget", type=float, default=5.0, help="seconds for one batch size")
    parser.add_argument("--json", default=None)
    args = parser.parse_args()
    sizes = args.batch or ([1, 64, 1024] if args.device == "cpu" else [1, 64, 1024, 16384, 65536])
    rows = [measure(b, args.device, observe=True, repeats=args.repeats, budget=args.budget) for b in sizes]
    for row in rows:
        print(
            f"B={row['batch']:>6}  {row['agents']:5.1f} agents a scene  {row['us_per_step']:>12.1f} us/step  "
            f"{row['agent_steps_per_s']:>15,.0f} agent-steps/s  (spread {row['spread']:.0%})"
        )
    result: dict[str, object] = {"device": args.device, "rows": rows}
    for b in (sizes[-1], 64):
        share = parts(b, args.device)
        result[f"parts_us_B{b}"] = share
        total = sum(share.values())
        print(f"B={b}: " + "  ".join(f"{k} {v:.0f} us ({v / total:.0%})" for k, v in share.items()))
    if not args.no_highway:
        other = highway(args.repeats, 20)
        one = next(r for r in rows if r["batch"] == min(sizes))
        ratio = one["agent_steps_per_s"] / other["agent_steps_per_s"]
        result["highway"] = other
        result["ratio_at_B1"] = ratio
        print(
            f"highway-env intersection-v1: {other['agent_steps_per_s']:,.0f} vehicle sub-steps/s "
            f"({other['agents']:.1f} vehicles); ratio at B={one['batch']}: {ratio:.0f}x"
        )
    if args.json:
        with open(args.json, "w") as file:
            json.dump(result, file, indent=1)


if __name__ == "__main__":
    main()

"""Write docs/benchmarks.md from the measurements in benchmarks/results: python benchmarks/page.py"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RUNS = {
    "world-cpu": "One core of a 2-core AMD EPYC machine (process CPU time)",
    "world-h200": "One NVIDIA H200 (wall clock, CUDA graph)",
}
# agent-steps/s that the bare step (bicycle, contacts, nearest lane) could reach: estimates from byte and cycle counts
CEILING = {"cpu": (35e6, "ideal SIMD on one core"), "cuda": (8e9, "L2 bandwidth")}


def section(name: str, data: dict[str, Any]) -> list[str]:
    """One machine: speed by batch size, and where the time goes."""
    lines = [f"## {RUNS[name]}", ""]
    lines += ["| scenes | agents a scene | µs a step | agent-steps/s | spread |", "|---:|---:|---:|---:|---:|"]
    for row in data["rows"]:
        lines.append(
            f"| {row['batch']:,} | {row['agents']:.1f} | {row['us_per_step']:,.1f} | {row['agent_steps_per_s']:,.0f} | "
            f"{row['spread']:.0%} |"
        )
    best = max(row["agent_steps_per_s"] for row in data["rows"])
    limit, what = CEILING["cpu" if data["device"] == "cpu" else "cuda"]
    lines += [
        "",
        f"The best row is {best / limit:.0%} of {limit:.0e} agent-steps/s, the estimated bound by {what}",
        "of a bare step (bicycle, contacts and nearest lane alone).",
    ]
    if "highway" in data:
        other = data["highway"]
        lines += [
            "",
            f"highway-env's intersection-v1 in the same run: {other['agent_steps_per_s']:,.0f} vehicle sub-steps/s",
            f"with {other['agents']:.1f} vehicles. One scene of ours gives {data['ratio_at_B1']:.0f} times as many",
            "agent-steps/s.",
        ]
    parts = {key: value for key, value in data.items() if key.startswith("parts_us_B")}
    names = list(next(iter(parts.values())))
    lines += ["", "| kernel | " + " | ".join(f"{key[10:]} scenes" for key in parts) + " |"]
    lines.append("|---|" + "---:|" * len(parts))
    for kernel in names:
        shares = [f"{p[kernel]:,.0f} µs ({p[kernel] / sum(p.values()):.0%})" for p in parts.values()]
        lines.append(f"| {kernel} | " + " | ".join(shares) + " |")
    return [*lines, ""]


def main() -> None:
    """Write the page."""
    lines = [
        "# Speed of the world",
        "",
        "Made by `benchmarks/page.py` from `benchmarks/results`, which `benchmarks/world_speed.py --json` writes.",
        "The full step: Autopilot traffic, signals, motion, contacts, the ego's record, restart of ended scenes,",
        "and the observation of 28 numbers a scene, on natural junction episodes. Medians of five repeats.",
        "",
    ]
    for name in RUNS:
        lines += section(name, json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text()))
    (ROOT / "docs" / "benchmarks.md").write_text("\n".join(lines))


if __name__ == "__main__":
    main()

"""Write docs/results/how-often.md from what was measured: python -m benchmarks.how_often_page

It reads benchmarks/results/how-often-*.json: brute force, and the estimates of one or several processes.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ssad.metrics.intervals import share_limits
from ssad.scenarios.dynamic import load_scenarios

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
TEXT = """# Rare failures: results

Failure probabilities of the Autopilot, measured by brute force and estimated by the suite `how-often`.
[How to measure them](../how-to/measure-failure-rates.md) and [how the estimators work](../explanation/failure-rates.md)
stand on pages of their own. `python -m benchmarks.how_often_page` makes this page from
`benchmarks/results/how-often-*.json`. These files name the device and the settings, but neither commit nor versions.

"""


def read(name: str) -> dict[str, Any] | None:
    """A measurement, if it is there."""
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def brute_row(data: dict[str, Any]) -> str:
    """One line of brute force."""
    seconds = data["processor_s" if data["device"] == "cpu" else "seconds"]  # others may use the machine, too
    return (
        f"| {data['noise']['lapse']:.1%} | {data['device']} | {data['episodes']:,} | {data['events']:,} | "
        f"{data['probability']:.3g} | {data['low']:.3g} to {data['high']:.3g} | {data['work']:.3g} | "
        f"{data['work'] / seconds:,.0f} |"
    )


def estimates() -> list[dict[str, Any]]:
    """What `coverage` measured, by the share of lapses, the largest first; several processes' estimates in one."""
    found: dict[float, dict[str, Any]] = {}
    for path in sorted(RESULTS.glob("how-often-coverage*.json")):
        data = json.loads(path.read_text(encoding="utf-8"))
        known = found.setdefault(data["noise"]["lapse"], data)
        if known is not data:
            if any(
                known.get(key) != data.get(key) for key in ("noise", "share", "each", "scenario", "room", "learning")
            ):
                raise ValueError(f"{path}: of another case, or of estimates of another size, than those beside it")
            for key in ("training", "importance", "splitting", "repeats", "seconds"):
                known[key] += data[key]
    return [found[lapse] for lapse in sorted(found, reverse=True)]


def page() -> str:
    """The page, from what is kept in benchmarks/results."""
    lines = [TEXT + "## Cases measured"]
    covered = estimates()
    brutes = [data for data in (read("how-often-4"), read("how-often-6")) if data]
    noise = (covered or brutes)[0]["noise"]
    (scenario,) = load_scenarios((covered or brutes)[0]["scenario"])
    lines += [
        f"`{scenario.name}`: on a straight road of {scenario.town}, the Autopilot follows two vehicles at "
        f"{scenario.parameters['ego_speed']:g} m/s for {0.1 * scenario.limits.max_steps:g} s. They accelerate and "
        f"brake with a standard deviation of {noise['accel']:g} m/s^2; its lapses forget in {noise['choice_time']:g} s."
        " How rare a collision is hangs on the share of lapses. Brute force (`python -m benchmarks.how_often brute "
        "--lapse 0.04 --crashes 10000` and `--lapse 0.004`):",
        "",
        "| share of lapses | device | episodes | collisions | probability | 95 % limits | agent-steps | a second |",
        "|---:|---|---:|---:|---:|---|---:|---:|",
        *map(brute_row, brutes),
        "",
        "The last column counts processor time of one core on CPU, and time by the clock on a GPU.",
        "",
    ]
    for data in covered:
        lines += coverage(data, brutes)
    return "\n".join(lines).rstrip() + "\n"


def coverage(data: dict[str, Any], brutes: list[dict[str, Any]]) -> list[str]:
    """The accelerated estimates beside each other, and how often their intervals hold."""
    same = [b for b in brutes if b["noise"]["lapse"] == data["noise"]["lapse"]]
    best = max(same, key=lambda b: b["events"], default=None)
    rows = {name: np.array(data[name]) for name in ("importance", "splitting") if data[name]}
    pooled = float(rows["importance"][:, 0].mean())
    truth, named = pooled, "the mean of all estimates of importance sampling"
    if best is not None and best["events"] >= 5000:
        truth, named = best["probability"], "brute force"
    place = f" --device {data['device']}" if data.get("device", "cpu") != "cpu" else ""
    steps = best["work"] / best["episodes"] if best else float("nan")
    beside = f"; brute force: {best['probability']:.4g} ({best['low']:.3g} to {best['high']:.3g})" if best else ""
    lines = [
        f"### Lapses {data['noise']['lapse']:.1%} of the time: near {10 ** round(math.log10(pooled)):.0e}",
        f"`python -m benchmarks.how_often coverage --lapse {data['noise']['lapse']:g} --repeats {data['repeats']} "
        f"--share {data['share']} --each {data['each']}{place}`: every estimate has its own {data['each']:,} episodes; "
        f"{data['share']} of importance sampling share a proposal, of which each counts the whole training. An "
        f"interval holds if it contains {named} ({truth:.4g}{beside}). What brute force would need is "
        "1.96^2 (1 - p) / (p h^2) episodes for the half-width h, relative to p, that the estimates have in the mean.",
        "",
        "| method | estimates | mean probability | intervals that hold | relative half-width | agent-steps each | of "
        "these learning | fewer than brute force |",
        "|---|---:|---:|---|---:|---:|---:|---:|",
    ]
    for name, found in rows.items():
        good = ~np.isnan(found[:, 1])
        p, low, high, _, work = found[good].T
        held = int(((low <= truth) & (truth <= high)).sum())
        half = float(np.mean(0.5 * (high - low)) / truth)
        needed = steps * 1.96**2 * (1.0 - truth) / truth / half**2
        learned = float(np.mean(data["training"])) if name == "importance" else 0.0
        low, high = (float(v) for v in share_limits(held / len(p), len(p)))
        holds = f"{held / len(p):.1%} ({low:.1%} to {high:.1%})" if len(p) >= 20 else f"{held} of {len(p)}"
        lines.append(
            f"| {name} | {len(p)} | {p.mean():.4g} | {holds} | "
            f"{half:.0%} | {work.mean():.3g} | {learned:.2g} | {needed / work.mean():,.0f} times |"
        )
        if name == "importance":
            rest = float((work - learned).mean())
            fine = needed * (half / 0.02) ** 2
            long = fine / (learned + rest * (half / 0.02) ** 2)
            last = (
                f"The advantage of importance sampling grows with what is wanted, since learning is paid once: for "
                f"a half-width of 2 %, for which brute force needs about 10,000 collisions, it needs {long:,.0f} times "
                "fewer agent-steps."
            )
    if "room" not in data:
        last += " These estimates are from before the upper limits left room for a whole event more: half of one then."
    if "learning" not in data:
        last += (
            " They are of an earlier learning: two components, from the failures of the last round alone, no copies."
        )
    return [*lines, "", last, ""]


if __name__ == "__main__":
    (ROOT / "docs" / "results" / "how-often.md").write_text(page(), encoding="utf-8")

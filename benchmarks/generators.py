"""Proven collisions of generators against the Autopilot and PPO: the first table of docs/results/generators.md.

`python -m benchmarks.generators --out RUN --page` runs the suite `adversarial` with each generator against each system
in SSAD's own natural set and in FREA's, which must have been imported (docs/how-to/import-scenarios.md), keeps the
shares in benchmarks/results/generators.json, and writes the table. Repeat the command to resume a
run; `--sets`, `--systems` and `--generators` choose parts, and parts add up. Intervals are of 95 %, a route with
all its draws of traffic is a cluster, and differences to random search are paired by base.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import ssad
from benchmarks.drivers import EGOS, plain, provenance, text
from benchmarks.insert import insert
from ssad.metrics import CaseValue, estimate, paired_difference
from ssad.metrics.intervals import MIN_ROUTES
from ssad.report.records import metric_of, scenario_of

RESULTS = Path(__file__).resolve().parent / "results" / "generators.json"
GENERATORS = ("random", "l2c", "adv-ppo-paper", "adv-ppo", "king", "cat", "bayesian", "frea")
SETS = ("natural", "frea")
RANDOM = "random"
COLUMNS = {
    "proven": "proven",
    "less": "proven, less random's",
    "CR_any": "raw CR",
    "CR": "CR, lawful",
    "moving": "ego moves",
    "seconds": "CPU s a base",
}


def measure(
    folder: Path, *, set_name: str, systems: Sequence[str], generators: Sequence[str], budget: int, **options: Any
) -> dict[str, Any]:
    """Run the suite in one set, or resume it; return the row of each system and generator.

    Args:
        folder: Folder of the runs.
        set_name: Set of natural traffic.
        systems: Driving systems.
        generators: Generators.
        budget: Rollouts of each base.
        options: `workers` and `device` of `ssad.run`.
    """
    # The suite is the same whatever part of it is run, so that the parts add up in one folder.
    changes = {
        "scenarios": [set_name],
        "systems": list(dict.fromkeys([*EGOS, *systems])),
        "generators": list(dict.fromkeys([*GENERATORS, *generators])),
        "transfer": [],
        "budget": budget,
        "chunk": 75,
    }
    only = {"system": list(systems), "generator": list(generators)}
    results = ssad.run("adversarial", set=changes, out=folder / set_name, only=only, **options)
    lines: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for line in results.rows:
        lines.setdefault((str(line["system"]), str(line["generator"])), []).append(line)
    return {
        system: rows_of({name: lines.get((system, name), []) for name in changes["generators"]})
        for system in changes["systems"]
        if any(measured_system == system for measured_system, _ in lines)
    }


def rows_of(lines: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """Return the shares of each generator from the records of its searches, with the difference to random's."""
    random_cases = _cases(lines.get(RANDOM, ()), "proven")
    return {
        name: {
            "bases": sum(metric_of(line, "survived") == 1.0 for line in searches),
            "proven": _share(_cases(searches, "proven").values(), "share"),
            "less": plain(
                paired_difference(_cases(searches, "proven"), random_cases, kind="share", min_clusters=MIN_ROUTES)
            )
            if random_cases and name != RANDOM
            else None,
            "CR_any": _share(_cases(searches, "CR_any").values(), "share"),
            "CR": _share(_cases(searches, "CR").values(), "share"),
            "moving": _share(_cases(searches, "moving").values(), "bounded"),
            "seconds": _mean([metric_of(line, "seconds") for line in searches]),
        }
        for name, searches in lines.items()
        if searches
    }


def _cases(lines: Iterable[Mapping[str, Any]], metric: str) -> dict[str, CaseValue]:
    """Return a metric of each search that has measured it, by base."""
    return {
        scenario_of(line): CaseValue(
            metric_of(line, metric), str(line["cluster"]), scenario_of(line), failed=line["status"] != "ok"
        )
        for line in lines
        if line["status"] != "ok" or not math.isnan(metric_of(line, metric))
    }


def _share(values: Iterable[CaseValue], kind: Literal["share", "bounded"]) -> dict[str, Any] | None:
    """Return a mean with its limits, which need ten routes; None without values."""
    cases = list(values)
    return plain(estimate(cases, kind, min_clusters=MIN_ROUTES)) if cases else None


def _mean(values: Sequence[float]) -> float | None:
    """Return the mean of the values that are numbers; None without any."""
    numbers = [value for value in values if not math.isnan(value)]
    return sum(numbers) / len(numbers) if numbers else None


def table(data: Mapping[str, Any]) -> list[str]:
    """Return the rows of all sets, systems and generators."""
    lines = [
        f"| set | system | generator | bases | {' | '.join(COLUMNS.values())} |",
        "|---|---|---|---:|" + "---|" * (len(COLUMNS) - 1) + "---:|",
    ]
    for set_name, systems in data["sets"].items():
        for system, rows in systems.items():
            for name, row in rows.items():
                cells = [_cell(row[column]) for column in COLUMNS]
                lines.append(f"| `{set_name}` | `{system}` | `{name}` | {row['bases']} | {' | '.join(cells)} |")
    return [*lines, ""]


def _cell(value: Any) -> str:
    """Return an estimate, a number, or nothing as it stands in the table."""
    if value is None:
        return ""
    return text(value) if isinstance(value, Mapping) else f"{value:.2f}"


def page(data: Mapping[str, Any]) -> None:
    """Write the table between its markers in docs/results/generators.md."""
    made = data["made"]
    weights = ", ".join(f"`{name}` {digest}" for name, digest in made["weights"].items())
    sentence = f"Commit {made['commit']}, torch {made['torch']}, {data['budget']} rollouts, weights {weights}."
    insert("results/generators.md", "proven", [sentence, "", *table(data), *findings(data)])


def findings(data: Mapping[str, Any]) -> list[str]:
    """Return a line for each system and set: what random search proves, what most, and the most raw collisions.

    A generator proves more than random search only if the interval of the paired difference lies above 0.
    """
    lines = []
    for set_name, systems in data["sets"].items():
        for system, rows in systems.items():
            proofs = {name: row["proven"] for name, row in rows.items() if row["proven"] is not None}
            if RANDOM not in proofs:
                continue
            best = max(proofs, key=lambda name: proofs[name]["mean"])
            raw = max(proofs, key=lambda name: rows[name]["CR_any"]["mean"])
            better = [
                f"`{name}`"
                for name, row in rows.items()
                if row["less"] is not None and row["less"]["method"] not in ("none", "range") and row["less"]["low"] > 0
            ]
            more = f"More than random search, with an interval above 0: {', '.join(better)}." if better else ""
            lines.append(
                f"* `{system}` in `{set_name}`: random search proves {text(proofs[RANDOM])} of the bases, `{best}` the "
                f"most, {text(proofs[best])}. The highest raw CR is that of `{raw}`, {text(rows[raw]['CR_any'])}; it "
                f"proves {text(proofs[raw])}. {more}".rstrip()
            )
    return [*lines, ""] if lines else []


def names(given: str) -> list[str]:
    """Return the names of a list with commas."""
    return [name.strip() for name in given.split(",") if name.strip()]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run, keep, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs; repeat the command to go on")
    parser.add_argument("--sets", default=",".join(SETS), help="sets of natural traffic, with commas")
    parser.add_argument("--systems", default=",".join(EGOS), help="driving systems, with commas")
    parser.add_argument("--generators", default=",".join(GENERATORS), help="generators, with commas")
    parser.add_argument("--budget", type=int, default=24, help="rollouts of each base")
    parser.add_argument("--workers", type=int, default=None, help="worker processes; by default one per core")
    parser.add_argument("--device", default="auto", help="where the world computes: auto, cpu or cuda")
    parser.add_argument("--json", type=Path, default=RESULTS, help="where the shares are kept")
    parser.add_argument("--page", action="store_true", help="write docs/results/generators.md")
    given = parser.parse_args(arguments)
    data: dict[str, Any] = json.loads(given.json.read_text()) if given.json.is_file() else {}
    if data.get("budget") != given.budget:
        data = {"budget": given.budget, "sets": {}}
    for set_name in names(given.sets):
        data["sets"][set_name] = measure(
            given.out,
            set_name=set_name,
            systems=names(given.systems),
            generators=names(given.generators),
            budget=given.budget,
            workers=given.workers,
            device=given.device,
        )
        data["made"] = provenance([*names(given.systems), *names(given.generators)])
        given.json.write_text(json.dumps(data, indent=1) + "\n")
    print("\n".join(table(data)))
    if given.page:
        page(data)


if __name__ == "__main__":
    main()

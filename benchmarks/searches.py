"""Do searches that learn find collisions sooner than random points? The table of docs/results/generators.md.

`python -m benchmarks.searches --generators random,cma-es,bayesian,l2c` lets each search the pre-crash scenarios that
the system survives as they are, with the same seeds and the same budget, and keeps what came of it in
benchmarks/results/searches.json; `--page` writes the table of what is there. A search that is kept is not run again
without `--anew`. A route with all its base scenarios is a cluster; the searches of a base with several seeds are one
case, and differences to random search are paired by base.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from ssad.drivers import make_system
from ssad.experiments.adversarial.found_collisions import proven_bases
from ssad.experiments.scenario_kind import route_key
from ssad.metrics import CaseValue, Estimate, estimate, paired_difference
from ssad.scenarios.dynamic import load_scenarios
from ssad.scenarios.dynamic.generate import Trials, generator_factory, search
from ssad.world.roads import load_town

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "searches.json"
DOCUMENT = ROOT / "docs" / "results" / "generators.md"
KEPT = 3  # distinct collisions of a search that are driven again and graded, as in kind `adversarial`
BEGIN, END = "<!-- searches: begin -->", "<!-- searches: end -->"


def measure(name: str, *, system: str, set_name: str, seeds: int, budget: int) -> dict[str, Any]:
    """Rollouts to the first collision that counts (None: not found), and proofs, of each base and seed."""
    trials = Trials(lambda: make_system(system), make_system)
    scenarios = load_scenarios(set_name)
    bases = [trials.base(scenario, load_town(scenario.town), seed=0) for scenario in scenarios]
    alive = [base for base in bases if base.trace.end != "collision"]
    factory = generator_factory(name)
    check = getattr(factory, "check", lambda episode: None)
    found: dict[str, list[int | None]] = {}
    share: dict[str, list[float]] = {}
    for base in alive:
        check(base.episode)
    many = [base for base in alive for _ in range(seeds)]
    roots = [seed for _ in alive for seed in range(seeds)]
    outcomes = search(factory(many, seeds=roots, budget=budget), many, trials, budget=budget)
    proven: dict[str, list[bool]] = {}
    collided: dict[str, list[bool]] = {}
    for base, row, is_proven in zip(many, outcomes, proven_bases(many, outcomes, trials, limit=KEPT), strict=True):
        proven.setdefault(base.scenario.name, []).append(is_proven)
        collided.setdefault(base.scenario.name, []).append(any(outcome.collision for outcome in row))
        first = next((k for k, outcome in enumerate(row, 1) if outcome.is_valid), None)
        found.setdefault(base.scenario.name, []).append(first)
        share.setdefault(base.scenario.name, []).append(float(np.mean([outcome.is_valid for outcome in row])))
    routes = {base.scenario.name: route_key(base.scenario) for base in alive}
    return {"first": found, "share": share, "proven": proven, "any": collided, "routes": routes}


def cases(measured: dict[str, Any], column: str, value: Any = float) -> dict[str, CaseValue]:
    """A mean over seeds for each base; its cluster is its route."""
    routes = measured.get("routes", {})
    return {
        name: CaseValue(float(np.mean([value(v) for v in row])), routes.get(name, name), name)
        for name, row in measured[column].items()
    }


def text(found: Estimate, *, sign: bool = False) -> str:
    """A mean with its interval."""
    form = "+.2f" if sign else ".2f"
    return f"{found.mean:{form}} [{found.low:{form}}, {found.high:{form}}]"


def headline_cells(measured: dict[str, Any], name: str) -> list[str]:
    """Share of the bases with a proven collision, the same less random's, and the raw CR; n/a: not measured."""
    row, random = measured[name], measured["random"]
    proven = cases(row, "proven") if "proven" in row else None
    less = "" if name == "random" else "n/a"
    if proven is not None and "proven" in random and name != "random":
        less = text(paired_difference(proven, cases(random, "proven")), sign=True)
    raw = text(estimate(cases(row, "any").values(), "bounded")) if "any" in row else "n/a"
    return ["n/a" if proven is None else text(estimate(proven.values(), "bounded")), less, raw]


def table(data: dict[str, Any]) -> list[str]:
    """Generators by how much of the bases they break, and how much sooner than random search."""
    budget = data["budget"]
    parts = [budget // 4, budget]
    heads = [
        "proven",
        "proven, less random's",
        "raw CR",
        *(f"CR within {n}" for n in parts),
        *(f"CR within {n}, less random's" for n in parts),
        "share of rollouts",
        "share, less random's",
    ]
    lines = [f"| | {' | '.join(heads)} |", "|---|" + "---|" * len(heads)]
    measured = data["generators"]
    for name in measured:
        cells, more = [], []
        headline = headline_cells(measured, name)
        for most in parts:
            own, random = (
                cases(measured[who], "first", lambda first, most=most: first is not None and first <= most)
                for who in (name, "random")
            )
            cells.append(text(estimate(own.values(), "bounded")))
            more.append("" if name == "random" else text(paired_difference(own, random), sign=True))
        own, random = (cases(measured[who], "share") for who in (name, "random"))
        last = ["" if name == "random" else text(paired_difference(own, random), sign=True)]
        lines.append(
            f"| `{name}` | {' | '.join([*headline, *cells, *more, text(estimate(own.values(), 'bounded')), *last])} |"
        )
    bases = len(measured["random"]["first"])
    head = f"{bases} bases of `{data['set']}`, {data['seeds']} seeds each, {budget} rollouts, `{data['system']}`:"
    return [head, "", *lines, ""]


def main() -> None:
    """Measure, keep, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--generators", default="", help="names with commas; random must be among those kept")
    parser.add_argument("--system", default="autopilot")
    parser.add_argument("--set", default="precrash", dest="set_name")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--budget", type=int, default=32)
    parser.add_argument("--anew", action="store_true", help="search again with generators that are kept")
    parser.add_argument("--page", action="store_true", help="write docs/results/generators.md")
    given = parser.parse_args()
    about = {"system": given.system, "set": given.set_name, "seeds": given.seeds, "budget": given.budget}
    data: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    if {key: data.get(key) for key in about} != about:
        data = about | {"generators": {}}
    for name in filter(None, given.generators.split(",")):
        if name in data["generators"] and "proven" in data["generators"][name] and not given.anew:
            continue
        data["generators"][name] = measure(
            name, system=given.system, set_name=given.set_name, seeds=given.seeds, budget=given.budget
        )
        RESULTS.write_text(json.dumps(data, separators=(",", ":")) + "\n")
    print("\n".join(table(data)))
    if given.page:
        whole = DOCUMENT.read_text()
        before, _, rest = whole.partition(BEGIN)
        DOCUMENT.write_text("\n".join([before + BEGIN, *table(data), END + rest.partition(END)[2]]))


if __name__ == "__main__":
    main()

"""What learned drivers do, and what adversaries do to them: the tables of docs/results/drivers.md.

`python -m benchmarks.drivers --sets precrash,natural` measures driving systems, `--adversaries natural,frea` egos with
and without adversaries; `safebench` and `frea` must have been imported (docs/how-to/import-scenarios.md). Each set is
kept in benchmarks/results/drivers.json, and `--page` writes the tables of what is there into docs/results/drivers.md
and adversaries.md. Intervals are of 95 %; each scenario is a cluster, as in reports, but where all towns of a set are
taken together, each route with its draws of traffic.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.insert import insert
from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.types import Episode
from ssad.drivers import LEARNED, make_system
from ssad.drivers import SYSTEMS as REGISTERED
from ssad.metrics import CaseValue, Estimate, episode_metrics, estimate, paired_difference
from ssad.scenarios.dynamic.generate import Trials
from ssad.scenarios.dynamic.policy.adv_ppo import SHIPPED, Adversary
from ssad.training.driver import draw_episodes, find_scenarios
from ssad.world.rollout import rollout
from ssad.world.selection import FreaSelection
from ssad.world.world import World

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "drivers.json"
SYSTEMS = ("autopilot", "blind", *(name for name in LEARNED if name in REGISTERED))
EGOS = ("autopilot", "ppo")
PUBLISHED = {
    "autopilot": {"Town02": (0.01, 0.17), "Town05": (0.00, 0.21)},
    "ppo": {"Town02": (0.34, 0.81), "Town05": (0.11, 0.59)},
}


def episodes_of(name: str) -> tuple[list[Episode], dict[str, Any]]:
    """The nominal episodes of a set, and the lane graphs of its towns."""
    scenarios, graphs = find_scenarios([name])
    return draw_episodes(scenarios, graphs, draws=1, seed=0), graphs


def case(episode: Episode, value: float, *, by_route: bool = False) -> CaseValue:
    """A value of an episode; its cluster is its scenario, or its route with all draws of traffic."""
    return CaseValue(float(value), repr(episode.scenario.route) if by_route else episode.scenario.name, episode.key)


def plain(found: Estimate) -> dict[str, float]:
    """Mean and limits."""
    return {"mean": found.mean, "low": found.low, "high": found.high, "n": found.n}


def drive(name: str) -> dict[str, Any]:
    """CR, RC and share of metres off the road of each system in a set."""
    episodes, graphs = episodes_of(name)
    table: dict[str, Any] = {}
    for system in SYSTEMS:
        rows = []
        for first in range(0, len(episodes), 64):
            part = episodes[first : first + 64]
            rows += [episode_metrics(trace) for trace in rollout(World(part, graphs), make_system(system))]
        cases = list(zip(episodes, rows, strict=True))
        table[system] = {
            "CR": plain(estimate([case(e, r.collision) for e, r in cases], "share")),
            "RC": plain(estimate([case(e, r.route_completion) for e, r in cases], "bounded")),
            "off": plain(estimate([case(e, r.off_road_fraction) for e, r in cases], "bounded")),
            "speed": float(np.mean([r.driven / r.time for r in rows])),
        }
        print(
            name,
            system,
            {key: value for key, value in table[system].items() if key == "speed"},
            *(f"{key} {text(table[system][key])}" for key in ("CR", "RC", "off")),
            flush=True,
        )
    return table


def attack(name: str, adversaries: Sequence[str]) -> dict[str, Any]:
    """What each adversary does to each ego in a set, by town."""
    episodes, graphs = episodes_of(name)
    table: dict[str, Any] = {}
    for ego in EGOS:
        trials = Trials(lambda ego=ego: make_system(ego), policies=make_system)
        natural = outcomes(trials, episodes, graphs, {})
        for adversary in ("", *adversaries):
            for count in (1, 2) if adversary else (0,):
                drivers = {FreaSelection(count=count): Adversary(name=adversary)} if adversary else {}
                found = outcomes(trials, episodes, graphs, drivers) if adversary else natural
                for town in (*sorted(graphs), " + ".join(sorted(graphs))):
                    here = [k for k, e in enumerate(episodes) if town in (e.town, " + ".join(sorted(graphs)))]
                    parts = ([rows[k] for k in here] for rows in (episodes, found, natural))
                    row = measured(*parts, by_route="+" in town)
                    table.setdefault(town, {}).setdefault(ego, {})[f"{adversary} x {count}" if adversary else ""] = row
                    print(
                        town, ego, adversary, count, *(f"{key} {text(value)}" for key, value in row.items()), flush=True
                    )
    return table


def outcomes(trials: Trials, episodes: Sequence[Episode], graphs: Any, drivers: Any) -> list[Outcome]:
    """What came of episodes with drivers of adversaries in them."""
    bases = [(Base(e, graphs[e.town], None), Proposal(e.scenario, drivers=drivers)) for e in episodes]
    return trials.run(bases)


def measured(
    episodes: Sequence[Episode], found: Sequence[Outcome], natural: Sequence[Outcome], *, by_route: bool
) -> dict[str, Any]:
    """Shares of the episodes, and how many more collisions than in natural traffic."""

    def crashed(outcome: Outcome) -> bool:
        return outcome.trace is not None and outcome.trace.end == "collision"

    values = {
        "CR": [crashed(o) for o in found],
        "valid": [o.is_valid for o in found],
        "off": [o.off_road for o in found],
        "others": [o.hit_others for o in found],
    }
    rows = {
        key: plain(estimate([case(e, v, by_route=by_route) for e, v in zip(episodes, column, strict=True)], "share"))
        for key, column in values.items()
    }
    pair = [
        {e.key: case(e, crashed(o), by_route=by_route) for e, o in zip(episodes, side, strict=True)}
        for side in (found, natural)
    ]
    return rows | {"more": plain(paired_difference(pair[0], pair[1], kind="share"))}


def text(value: Any) -> str:
    """A mean with its interval."""
    return f"{value['mean']:.2f} [{value['low']:.2f}, {value['high']:.2f}]"


def driver_table(data: dict[str, Any]) -> list[str]:
    """Systems by set."""
    lines = []
    for name, table in data.items():
        n = table["blind"]["CR"]["n"]
        lines += [f"`{name}` ({n} episodes):", "", "| system | CR | RC | off the road | mean speed, m/s |"]
        lines += ["|---|---|---|---|---:|"]
        for system, row in table.items():
            cells = " | ".join(text(row[key]) for key in ("CR", "RC", "off"))
            lines.append(f"| {system} | {cells} | {row['speed']:.1f} |")
        lines.append("")
    return lines


def adversary_table(data: dict[str, Any]) -> list[str]:
    """Egos and adversaries by town."""
    head = "| town | ego | adversaries | CR | more than without | collides on the road, hitting nobody else "
    lines = [head + "| adversary leaves the road | published CR |", "|---|---|---|---|---|---|---|---|"]
    for towns in data.values():
        for town, egos in towns.items():
            for ego, rows in egos.items():
                for adversary, row in rows.items():
                    cells = [text(row["CR"]), *(text(row[k]) if adversary else "" for k in ("more", "valid", "off"))]
                    known = PUBLISHED.get(ego, {}).get(town)
                    other = f"{known[bool(adversary)]:.2f}" if known and adversary in ("", "adv-ppo x 1") else ""
                    lines.append(f"| {town} | {ego} | {adversary or 'none'} | {' | '.join(cells)} | {other} |")
    return [*lines, ""]


def page(data: dict[str, Any]) -> None:
    """Write the tables between their markers in the document."""
    for part, make in (("drivers", driver_table), ("adversaries", adversary_table)):
        if part in data:
            insert(f"results/{part}.md", part, make(data[part]))


def main() -> None:
    """Measure, keep, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", default="", help="sets to drive, with commas")
    parser.add_argument("--adversaries", default="", help="sets of natural traffic to put adversaries into")
    parser.add_argument("--json", type=Path, default=RESULTS, help="where the results are kept")
    parser.add_argument("--page", action="store_true", help="write docs/results/drivers.md")
    given = parser.parse_args()
    data: dict[str, Any] = json.loads(given.json.read_text()) if given.json.is_file() else {}
    shipped = sorted(path.stem for path in SHIPPED.glob("*.safetensors"))
    for name in filter(None, given.sets.split(",")):
        data.setdefault("drivers", {})[name] = drive(name)
        given.json.write_text(json.dumps(data, indent=1) + "\n")
    for name in filter(None, given.adversaries.split(",")):
        data.setdefault("adversaries", {})[name] = attack(name, shipped)
        given.json.write_text(json.dumps(data, indent=1) + "\n")
    if given.page:
        page(data)


if __name__ == "__main__":
    main()

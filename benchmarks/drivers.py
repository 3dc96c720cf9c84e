"""What learned drivers do, and what adversaries do to them: the tables of docs/results/drivers.md.

`python -m benchmarks.drivers --sets precrash,natural` measures driving systems, `--adversaries natural,frea` egos with
and without adversaries, by proven collisions first; what is kept of the same world and weights is not measured again.
`safebench` and `frea` must have been imported (docs/how-to/import-scenarios.md). Each set is kept in
benchmarks/results/drivers.json, and `--page` writes the tables of what is there into docs/results/drivers.md and
adversaries.md. Intervals are of 95 %; a route with all its draws of traffic is a cluster, as in reports, and fewer than
ten routes have no interval, but the range over them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import subprocess
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from benchmarks.insert import DOCS, insert
from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.types import Episode
from ssad.drivers import LEARNED, make_system
from ssad.drivers import SYSTEMS as REGISTERED
from ssad.experiments.adversarial.found_collisions import proven_bases
from ssad.experiments.scenario_kind import route_key
from ssad.metrics import CaseValue, Estimate, episode_metrics, estimate, paired_difference
from ssad.metrics.intervals import MIN_ROUTES
from ssad.scenarios.dynamic.generate import Trials
from ssad.scenarios.dynamic.policy.adv_ppo import SHIPPED, Adversary
from ssad.training.driver import draw_episodes, find_scenarios
from ssad.world.rollout import rollout
from ssad.world.selection import FreaSelection
from ssad.world.world import VERSION, World

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


def case(episode: Episode, value: float) -> CaseValue:
    """Return a value of an episode; its cluster is its route with all draws of traffic."""
    return CaseValue(float(value), route_key(episode.scenario), episode.key)


def plain(estimated: Estimate) -> dict[str, Any]:
    """Return mean and limits, the number of cases and of routes, and what the limits are."""
    return {
        "mean": estimated.mean,
        "low": estimated.low,
        "high": estimated.high,
        "n": estimated.n,
        "routes": estimated.clusters,
        "method": estimated.method,
    }


def provenance(systems: Sequence[str]) -> dict[str, Any]:
    """Return commit, versions of torch and of the world, and the hash of the weights of what is measured."""
    commit = subprocess.run(
        ["git", "log", "-1", "--format=%h (%cs)"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    folders = [ROOT / "src" / "ssad" / "drivers" / "learned" / "weights", SHIPPED]
    files = [folder / f"{system}.safetensors" for folder in folders for system in systems]
    weights = {file.stem: hashlib.sha256(file.read_bytes()).hexdigest()[:12] for file in files if file.is_file()}
    return {"commit": commit, "torch": torch.__version__.partition("+")[0], "world": VERSION, "weights": weights}


def rate(values: Sequence[CaseValue], kind: Literal["share", "bounded"]) -> dict[str, Any]:
    """Return the mean of values with its limits, which need ten routes."""
    return plain(estimate(values, kind, min_clusters=MIN_ROUTES))


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
            "CR": rate([case(e, r.collision) for e, r in cases], "share"),
            "RC": rate([case(e, r.route_completion) for e, r in cases], "bounded"),
            "off": rate([case(e, r.off_road_fraction) for e, r in cases], "bounded"),
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


def attack(
    name: str, adversaries: Sequence[str], table: dict[str, Any], *, keep: Callable[[], None] = lambda: None
) -> None:
    """Measure what each adversary does to each ego in a set, by town.

    Args:
        name: The set.
        adversaries: Names of shipped adversaries.
        table: Rows by town, ego and adversary, which are added to; rows that are there are not measured again.
        keep: Called after each adversary.
    """
    episodes, graphs = episodes_of(name)
    together = " + ".join(sorted(graphs))
    towns = (*sorted(graphs), together)
    bases = [Base(e, graphs[e.town], None) for e in episodes]
    for ego in EGOS:
        trials = Trials(lambda ego=ego: make_system(ego), policies=make_system)
        natural: list[Outcome] = []
        for adversary, count in [("", 0), *((adversary, count) for adversary in adversaries for count in (1, 2))]:
            label = f"{adversary} x {count}" if adversary else ""
            if label in table.get(together, {}).get(ego, {}):
                continue
            natural = natural or outcomes(trials, episodes, graphs, {})
            drivers = {FreaSelection(count=count): Adversary(name=adversary)} if adversary else {}
            trial_outcomes = outcomes(trials, episodes, graphs, drivers) if adversary else natural
            proven = proven_bases(bases, [[o] for o in trial_outcomes], trials, limit=1) if adversary else None
            for town in towns:
                here = [k for k, e in enumerate(episodes) if town in (e.town, together)]
                parts = ([rows[k] for k in here] for rows in (episodes, trial_outcomes, natural))
                row = measured(*parts, None if proven is None else [proven[k] for k in here])
                table.setdefault(town, {}).setdefault(ego, {})[label] = row
                print(town, ego, label, *(f"{key} {text(value)}" for key, value in row.items()), flush=True)
            keep()


def outcomes(trials: Trials, episodes: Sequence[Episode], graphs: Any, drivers: Any) -> list[Outcome]:
    """What came of episodes with drivers of adversaries in them."""
    bases = [(Base(e, graphs[e.town], None), Proposal(e.scenario, drivers=drivers)) for e in episodes]
    return trials.run(bases)


def measured(
    episodes: Sequence[Episode],
    trial_outcomes: Sequence[Outcome],
    natural: Sequence[Outcome],
    proven: Sequence[bool] | None = None,
) -> dict[str, Any]:
    """Shares of the episodes, and how many more collisions than in natural traffic; proven: None without adversary."""

    def crashed(outcome: Outcome) -> bool:
        return outcome.trace is not None and outcome.trace.end == "collision"

    values = {
        "CR": [crashed(o) for o in trial_outcomes],
        "valid": [o.is_valid for o in trial_outcomes],
        "off": [o.off_road for o in trial_outcomes],
        "others": [o.hit_others for o in trial_outcomes],
    } | ({} if proven is None else {"proven": list(proven)})
    rows = {
        key: rate([case(e, v) for e, v in zip(episodes, column, strict=True)], "share")
        for key, column in values.items()
    }
    pair = [
        {e.key: case(e, crashed(o)) for e, o in zip(episodes, side, strict=True)} for side in (trial_outcomes, natural)
    ]
    return rows | {"more": plain(paired_difference(pair[0], pair[1], kind="share", min_clusters=MIN_ROUTES))}


def text(value: Any) -> str:
    """Return a mean with its interval, or with the range over its routes where they are too few for one."""
    limits = f"{value['low']:.2f}, {value['high']:.2f}"
    if value.get("method") == "range":
        return f"{value['mean']:.2f} ({limits.replace(',', ' to')} over {value['routes']} routes)"
    return f"{value['mean']:.2f} [{limits}]" if value.get("method") != "none" else f"{value['mean']:.2f}"


def driver_table(data: dict[str, Any]) -> list[str]:
    """Systems by set."""
    lines = []
    for name, table in data.items():
        n = table["blind"]["CR"]["n"]
        routes = table["blind"]["CR"].get("routes")
        lines += [
            f"`{name}` ({n} episodes{f' on {routes} routes' if routes else ''}):",
            "",
            "| system | CR | RC | off the road | mean speed, m/s |",
        ]
        lines += ["|---|---|---|---|---:|"]
        for system, row in table.items():
            cells = " | ".join(text(row[key]) for key in ("CR", "RC", "off"))
            lines.append(f"| {system} | {cells} | {row['speed']:.1f} |")
        lines.append("")
    return lines


def adversary_table(data: dict[str, Any]) -> list[str]:
    """Egos and adversaries by town."""
    head = (
        "| town | ego | adversaries | proven | raw CR | more than without | collides on the road, hitting nobody else "
    )
    lines = [head + "| adversary leaves its side of the road | published CR |", "|---|---|---|---|---|---|---|---|---|"]
    for towns in data.values():
        for town, egos in towns.items():
            for ego, rows in egos.items():
                for adversary, row in rows.items():
                    proven = (text(row["proven"]) if "proven" in row else "n/a") if adversary else ""
                    cells = [
                        proven,
                        text(row["CR"]),
                        *(text(row[k]) if adversary else "" for k in ("more", "valid", "off")),
                    ]
                    known = PUBLISHED.get(ego, {}).get(town)
                    other = f"{known[bool(adversary)]:.2f}" if known and adversary in ("", "adv-ppo-paper x 1") else ""
                    lines.append(f"| {town} | {ego} | {adversary or 'none'} | {' | '.join(cells)} | {other} |")
    return [*lines, ""]


def page(data: dict[str, Any]) -> None:
    """Write the tables between their markers in the document."""
    for part, make in (("drivers", driver_table), ("adversaries", adversary_table)):
        if part in data:
            made = data.get("made", {}).get(part, {})
            insert(f"results/{part}.md", part, [*made_lines(made), *make(data[part])])
            if made:
                state_origin(DOCS / "results" / f"{part}.md", list(made.values())[-1])


def state_origin(file: Path, origin: Mapping[str, Any]) -> None:
    """State the commit, weights and torch version of the latest set in the header of a page of stored results."""
    weights = ", ".join(f"`{system}` {digest}" for system, digest in origin["weights"].items())
    commit, _, date = origin["commit"].partition(" ")
    header = f"Commit: {commit[:7]} {date}. Weights: {weights}. Torch: {origin['torch']}. Make"
    text = file.read_text(encoding="utf-8")
    file.write_text(re.sub(r"Commit: .*? Make", lambda _: header, text, count=1), encoding="utf-8")


def store(path: Path, data: dict[str, Any]) -> None:
    """Write what has been measured."""
    path.write_text(json.dumps(data, indent=1) + "\n")


def made_lines(made: dict[str, Any]) -> list[str]:
    """Return a sentence for each set that says of which commit, weights and torch version its numbers are."""
    sets: dict[str, list[str]] = {}
    for name, origin in made.items():
        weights = ", ".join(f"`{system}` {digest}" for system, digest in origin["weights"].items())
        sentence = f"commit {origin['commit']}, torch {origin['torch']}, weights {weights}"
        sets.setdefault(sentence, []).append(f"`{name}`")
    return [f"{', '.join(names)}: {sentence}.\n" for sentence, names in sets.items()]


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
        data.setdefault("made", {}).setdefault("drivers", {})[name] = provenance(SYSTEMS)
        store(given.json, data)
    for name in filter(None, given.adversaries.split(",")):
        made, origin = data.setdefault("made", {}).setdefault("adversaries", {}), provenance([*EGOS, *shipped])
        if {**made.get(name, {}), "commit": ""} != {**origin, "commit": ""}:
            data.setdefault("adversaries", {})[name] = {}
        made[name] = origin
        keep = partial(store, given.json, data)
        attack(name, shipped, data["adversaries"][name], keep=keep)
    if given.page:
        page(data)


if __name__ == "__main__":
    main()

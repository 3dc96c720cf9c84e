"""How avoidable are the collisions of a system in the pre-crash set? `python benchmarks/careful_grades.py --write`

Drives a system (default: the blind follower) through scenarios (default: the pre-crash set), grades each collision and
prints how many each careful driver avoids. `--write` puts the table into docs/results/careful-drivers.md.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from ssad.core.machine import start_warp_quietly
from ssad.drivers import make_system
from ssad.drivers.careful.grade import Grade, grade_collision
from ssad.drivers.careful.models import MODELS
from ssad.metrics.driving import impact_speed
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

PAGE = Path(__file__).parents[1] / "docs" / "results" / "careful-drivers.md"
BEGIN, END = "<!-- grades: begin -->", "<!-- grades: end -->"


def table(system: str, reference: str) -> str:
    """The collisions of each group, and how many are avoided, as Markdown."""
    scenarios = load_scenarios(reference)
    towns = {name: load_town(name) for name in sorted({s.town for s in scenarios})}
    episodes = [build_episode(s, towns[s.town], seed=0) for s in scenarios]
    traces = rollout(World(episodes, towns), make_system(system))
    rows: dict[str, Counter[str]] = {}
    speeds: dict[str, list[float]] = {}
    for episode, trace in zip(episodes, traces, strict=True):
        group = episode.scenario.group or episode.scenario.type
        row = rows.setdefault(group, Counter())
        row["episodes"] += 1
        if (trace.contact != 0).any():
            found: Grade = grade_collision(episode, towns[episode.town], trace)
            row["collisions"] += 1
            row.update({name: int(fine) for name, fine in found.avoids.items()})
            row["limit"] += found.verdict != "unavoidable"
            speeds.setdefault(group, []).append(impact_speed(trace))
    rows["all"] = sum(rows.values(), Counter())
    speeds["all"] = [v for values in speeds.values() for v in values]
    heads = ["Scenario", "Episodes", "Collisions", "Impact speed, m/s", *MODELS, "any manoeuvre"]
    lines = ["", f"| {' | '.join(heads)} |", "|---|" + "---:|" * (len(heads) - 1)]
    for group, row in rows.items():
        own = speeds.get(group, [])
        mean = f"{sum(own) / len(own):.1f}" if own else "–"
        counts = [str(row[name]) for name in (*MODELS, "limit")]
        lines.append(f"| {group} | {row['episodes']} | {row['collisions']} | {mean} | {' | '.join(counts)} |")
    return "\n".join([*lines, ""])


def main() -> None:
    """Print the table, or write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--system", default="blind", help="what drives")
    parser.add_argument("--scenarios", default="precrash", help="a set, a type, a name or a YAML file")
    parser.add_argument("--write", action="store_true", help="put the table into docs/results/careful-drivers.md")
    given = parser.parse_args()
    start_warp_quietly()
    text = table(given.system, given.scenarios)
    print(text)
    if given.write:
        before, _, rest = PAGE.read_text().partition(BEGIN)
        PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()

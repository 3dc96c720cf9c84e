"""Towns of the map reader beside those of the reader through carla.Map: lanes, and outcomes of drives.

    python -m benchmarks.map_readers --page      # with the extra carla; SSAD_DATA and imported sets for CARLA's towns

The earlier reader is that of a commit, run from an archive of its source on the same OpenDRIVE files. The towns of the
two then stand in one world, that of this version, so that nothing but the reader differs. `--page` writes the list of
changed outcomes into docs/results/map-imports.md.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from benchmarks.insert import insert, store_commit
from ssad import World, build_episode, load_scenarios, make_system, rollout
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph, load_graph
from ssad.core.traces import motion_hash
from ssad.core.types import EpisodeTrace, LaneType, Scenario
from ssad.simulators.closed_loop import policies_of
from ssad.world.roads import bake, town_xodr
from ssad.world.roads.library import BUILT_IN

ROOT = Path(__file__).parents[1]
EARLIER = "2a689a18"  # the last commit that read maps through carla.Map
CARLA_TOWNS = ("Town02", "Town05")
SETS = {"precrash": ("autopilot", "blind", "ppo", "sac", "td3"), "natural": ("autopilot", "blind", "ppo", "sac", "td3")}
SETS |= {"frea": ("autopilot", "blind")}
TOPOLOGY = ("kind", "road", "section", "lane_id", "junction", "left", "right", "succ_offset", "succ", "stop_lane")
BAKE = """
import sys
from pathlib import Path
from ssad.core.lane_graph import save_graph
from ssad.world.roads import bake
for path in map(Path, sys.argv[1:]):
    save_graph(bake(path), path.with_suffix(".npz"))
"""


@dataclass(frozen=True)
class Outcome:
    """The end of a drive.

    Attributes:
        end: Reason of the end.
        collision: The ego touched something.
        off_road: It left the road.
        red_light: It ran a red light.
    """

    end: str
    collision: bool
    off_road: bool
    red_light: bool


def outcome(trace: EpisodeTrace) -> Outcome:
    """Return the outcome of a drive."""
    return Outcome(trace.end, bool(trace.contact.any()), bool(trace.off_road.any()), bool(trace.red_light.any()))


def line_distance(graph: LaneGraph, other: LaneGraph, lane: int) -> float:
    """Return the greatest distance of the points of a lane from its line in another graph, m."""
    points, line = (member.xy[member.points(lane)].astype(float) for member in (graph, other))
    start, step = line[:-1], np.diff(line, axis=0)
    offset = points[:, None] - start
    share = np.clip((offset * step).sum(-1) / (step * step).sum(-1), 0.0, 1.0)
    return float(np.hypot(*np.moveaxis(offset - share[..., None] * step, -1, 0)).min(1).max())


def differing_topology(graph: LaneGraph, other: LaneGraph) -> list[str]:
    """Return the names of the arrays of lanes, neighbours, successors and stop lines that differ."""
    return [name for name in TOPOLOGY if not np.array_equal(getattr(graph, name), getattr(other, name))]


def read_twice(names: Sequence[str], revision: str) -> tuple[dict[str, LaneGraph], dict[str, LaneGraph]]:
    """Return the towns of the earlier reader and of this one, from the same files."""
    with tempfile.TemporaryDirectory(prefix="ssad-readers-") as folder:
        source, maps = Path(folder) / "source", Path(folder) / "maps"
        source.mkdir()
        maps.mkdir()
        paths = [maps / f"{name}.xodr" for name in names]
        for path in paths:
            path.write_text(town_xodr(path.stem), encoding="utf-8")
        archive = subprocess.run(
            ["git", "-C", str(ROOT), "archive", revision, "src/ssad"], capture_output=True, check=True
        )
        subprocess.run(["tar", "-x", "-C", str(source)], input=archive.stdout, check=True)
        subprocess.run(
            [sys.executable, "-c", BAKE, *map(str, paths)],
            env=os.environ | {"PYTHONPATH": str(source / "src")},
            cwd=folder,
            check=True,
        )
        earlier = {path.stem: load_graph(path.with_suffix(".npz")) for path in paths}
        return earlier, {path.stem: bake(path) for path in paths}


def drive(scenarios: Sequence[Scenario], graphs: Mapping[str, LaneGraph], system: str) -> list[EpisodeTrace]:
    """Return the drive of a system in each scenario."""
    episodes = [build_episode(scenario, graphs[scenario.town], seed=0) for scenario in scenarios]
    policies = {name: make_system(name) for scenario in scenarios for name in policies_of(scenario)}
    towns = {town: graphs[town] for town in {scenario.town for scenario in scenarios}}
    return rollout(World(episodes, towns), make_system(system), policies=policies.__getitem__)


def is_same_drive(first: EpisodeTrace, second: EpisodeTrace) -> bool:
    """Return whether two drives are equal to the bit in the motion of all agents."""
    return motion_hash(first) == motion_hash(second)


def town_rows(earlier: Mapping[str, LaneGraph], current: Mapping[str, LaneGraph]) -> Iterator[str]:
    """Yield the table of towns."""
    yield "| town | lanes | drivable | topology | greatest distance of a lane, mm |"
    yield "|---|---:|---:|---|---:|"
    for name, graph in current.items():
        other = earlier[name]
        difference = differing_topology(graph, other)
        distance = "-"
        if not difference:
            lanes = range(graph.lane_count)
            greatest = max(max(line_distance(graph, other, i), line_distance(other, graph, i)) for i in lanes)
            distance = f"{1000 * greatest:.2f}"
        same = f"other: {', '.join(difference)}" if difference else "the same"
        count = int((graph.kind == LaneType.DRIVING).sum())
        yield f"| {name} | {graph.lane_count} | {count} | {same} | {distance} |"


def set_rows(earlier: Mapping[str, LaneGraph], current: Mapping[str, LaneGraph]) -> Iterator[str]:
    """Yield the table of sets, and the list of changed outcomes."""
    yield "| set | drivers | drives | equal to the bit | changed outcomes | share |"
    yield "|---|---|---:|---:|---:|---:|"
    changes = []
    for reference, systems in SETS.items():
        scenarios = load_scenarios(reference)
        if not {scenario.town for scenario in scenarios} <= set(current):
            raise ConfigError(f"set '{reference}' is on towns that are not compared")
        changed = equal = 0
        for system in systems:
            print(f"{reference}: {system}", file=sys.stderr)
            before, after = (drive(scenarios, graphs, system) for graphs in (earlier, current))
            for scenario, *traces in zip(scenarios, before, after, strict=True):
                first, second = map(outcome, traces)
                equal += is_same_drive(*traces)
                if first != second:
                    changed += 1
                    changes.append(f"* {scenario.name}, {system}: {_difference(first, second)}")
        count = len(scenarios) * len(systems)
        yield f"| {reference} | {', '.join(systems)} | {count} | {equal} | {changed} | {100 * changed / count:.1f} % |"
    yield ""
    yield from changes or ["No outcome changed."]


def _difference(first: Outcome, second: Outcome) -> str:
    parts = []
    for member in fields(Outcome):
        before, after = (getattr(each, member.name) for each in (first, second))
        if before != after:
            values = (before, after) if member.name == "end" else ("yes" if x else "no" for x in (before, after))
            parts.append(f"{member.name.replace('_', ' ')} " + " -> ".join(values))
    return "; ".join(parts)


def main() -> None:
    """Compare, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--earlier", default=EARLIER, help="commit of the earlier reader")
    parser.add_argument("--page", action="store_true", help="write docs/results/map-imports.md")
    arguments = parser.parse_args()
    earlier, current = read_twice((*BUILT_IN, *CARLA_TOWNS), arguments.earlier)
    lines = [*town_rows(earlier, current), "", *set_rows(earlier, current)]
    print("\n".join(lines))
    if arguments.page:
        insert("results/map-imports.md", "readers", ["", *lines, ""])
        store_commit("results/map-imports.md")


if __name__ == "__main__":
    main()

"""Import of public Lanelet2 maps, and comparison with the library Lanelet2.

    LANELET2_PYTHON=... python -m benchmarks.lanelet2_maps --page OWNER/REPOSITORY@COMMIT=FOLDER...

Each folder, such as a checkout of a public repository at the commit that its name states, is searched for `.osm` files
that have a lanelet. The files are no part of SSAD. `--page` writes docs/results/map-imports.md.

The library is looked for in the Python that the environment variable LANELET2_PYTHON names (`pip install lanelet2`), by
default in this one. It reads the same file, projects it around the same place, and says bounds, centre lines and the
lanelets that a vehicle can follow.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from benchmarks.insert import insert
from ssad.core.errors import SSADError
from ssad.core.import_report import ImportReport
from ssad.core.types import LaneType
from ssad.world.roads.bake import bake
from ssad.world.roads.lanelet2 import Lanelet2Options, read_lanelet_map
from ssad.world.roads.lanelet2_lanes import LaneletLanes
from ssad.world.roads.lanelet2_lines import nearest_points

Array = npt.NDArray[np.float64]
CLOSE = 0.05  # m
TIMEOUT = 120.0  # s for the library
LANELET = re.compile(rb"""v=["']lanelet["']""")  # in every Lanelet2 map, and in no other data of OpenStreetMap

READER = """
import json, sys
import lanelet2
from lanelet2.io import Origin, loadRobust
from lanelet2.projection import UtmProjector
lanelet_map, _ = loadRobust(sys.argv[1], UtmProjector(Origin(float(sys.argv[2]), float(sys.argv[3]))))
rules = lanelet2.traffic_rules.create(
    lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
)
graph = lanelet2.routing.RoutingGraph(lanelet_map, rules)
json.dump(
    {
        str(lanelet.id): {
            "left": [(p.x, p.y) for p in lanelet.leftBound],
            "right": [(p.x, p.y) for p in lanelet.rightBound],
            "centre": [(p.x, p.y) for p in lanelet.centerline],
            "following": [str(other.id) for other in graph.following(lanelet)] if rules.canPass(lanelet) else None,
            "one_way": rules.isOneWay(lanelet),
        }
        for lanelet in lanelet_map.laneletLayer
    },
    open(sys.argv[4], "w"),
)
"""
HEAD = (
    "| Maps of | commit | files | import | share | compared | in the middle | apart, m | links | longest import, s |",
    "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|",
)


@dataclass
class LaneletResult:
    """Import of one Lanelet2 map.

    Attributes:
        path: The file.
        error: Why it does not import.
        seconds: CPU time of the import, s.
        offsets: Distance of each point of the lanes from the middle of the library's bounds, m; None: not compared.
        library_offsets: The same of the library's centre lines.
        apart: Distance of each point of the lanes from the library's centre line, m.
        links: Numbers of links here and there, here alone, and there alone.
        places: Links that only one has.
    """

    path: Path
    error: str = ""
    seconds: float = 0.0
    offsets: Array | None = None
    library_offsets: Array = field(default_factory=lambda: np.zeros(0))
    apart: Array = field(default_factory=lambda: np.zeros(0))
    links: tuple[int, int, int] = (0, 0, 0)
    places: list[str] = field(default_factory=list)


def has_lanelets(path: Path) -> bool:
    """Return whether a file of OpenStreetMap's format is a Lanelet2 map."""
    return LANELET.search(path.read_bytes()) is not None


def check_lanelet_map(path: Path) -> LaneletResult:
    """Import a Lanelet2 map, and compare it with what the library reads."""
    result = LaneletResult(path)
    started = time.process_time()
    try:
        bake(path)
    except SSADError as error:
        result.error = str(error).replace(str(path), path.name)
        return result
    result.seconds = time.process_time() - started
    places = [
        (float(node.get("lat", "")), float(node.get("lon", "")))
        for node in ElementTree.parse(path).getroot().iterfind("node")
        if node.get("lat")
    ]
    if not places:
        return result
    latitude, longitude = np.round(np.median(places, axis=0), 5).tolist()
    options = Lanelet2Options(origin=(latitude, longitude))
    answers = _library(path, latitude, longitude)
    if answers is not None:
        lanes = LaneletLanes(path, read_lanelet_map(path, options), options, ImportReport(str(path)))
        _compare(result, lanes, answers)
    return result


def _library(path: Path, latitude: float, longitude: float) -> dict[str, dict[str, Any]] | None:
    """Return what the library says of each lanelet; None if it is not there or cannot read the map."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "answer.json"
        python = os.environ.get("LANELET2_PYTHON", sys.executable)
        command = [python, "-c", READER, str(path), str(latitude), str(longitude), str(answer)]
        try:
            subprocess.run(command, capture_output=True, timeout=TIMEOUT, check=True)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
            return None
        content: dict[str, dict[str, Any]] = json.loads(answer.read_text(encoding="utf-8"))
        return content


def _compare(result: LaneletResult, lanes: LaneletLanes, answers: Mapping[str, Mapping[str, Any]]) -> None:
    offsets, library_offsets, apart = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    both = here = there = 0
    for row, lanelet in enumerate(lanes.lanelets):
        answer = answers.get(lanelet.id)
        if answer is None:
            continue
        left, right, centre = (np.array(answer[name], np.float64) for name in ("left", "right", "centre"))
        points = lanes.lines[row][:, :2]
        offsets.append(_off_middle(points, left, right))
        apart.append(np.hypot(*(points - nearest_points(points, centre)).T))
        library_offsets.append(_off_middle(_dense(centre), left, right))
        if lanes.kinds[row] != LaneType.DRIVING or answer["following"] is None:
            continue
        mine, others = {lanes.lanelets[follower].id for follower in lanes.successors[row]}, set(answer["following"])
        both, here, there = both + len(mine & others), here + len(mine - others), there + len(others - mine)
        result.places += [f"{lanelet.id} to {other} here alone" for other in sorted(mine - others)]
        result.places += [f"{lanelet.id} to {other} there alone" for other in sorted(others - mine)]
    result.offsets, result.library_offsets = np.concatenate(offsets), np.concatenate(library_offsets)
    result.apart, result.links = np.concatenate(apart), (both, here, there)


def _off_middle(points: Array, left: Array, right: Array) -> Array:
    """Return half the difference of the distances from both bounds [N], m, of points [N, 2]."""
    distances = [np.hypot(*(points - nearest_points(points, side)).T) for side in (left, right)]
    off: Array = 0.5 * np.abs(distances[0] - distances[1])
    return off


def _dense(line: Array) -> Array:
    """Return points of a line [., 2] about every half metre."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    places = np.linspace(0.0, along[-1], max(2, round(2.0 * float(along[-1]))))
    return np.stack([np.interp(places, along, line[:, axis]) for axis in (0, 1)], axis=1)


def table(folders: Mapping[str, Sequence[LaneletResult]]) -> list[str]:
    """Return the rows of the table on the maps of folders, by names such as owner/repository@commit."""
    everything = [result for results in folders.values() for result in results]
    rows = list(HEAD)
    for name, results in [*folders.items(), ("all", everything)]:
        good = [result for result in results if not result.error]
        compared = [result for result in good if result.offsets is not None]
        offsets = np.concatenate([np.zeros(0), *(result.offsets for result in compared if result.offsets is not None)])
        library = np.concatenate([np.zeros(0), *(result.library_offsets for result in compared)])
        apart = np.concatenate([np.zeros(0), *(result.apart for result in compared)])
        links = [sum(result.links[index] for result in compared) for index in range(3)]
        repository, _, commit = name.partition("@")
        cells = (
            repository,
            commit[:10],
            str(len(results)),
            str(len(good)),
            f"{100 * len(good) / max(len(results), 1):.1f} %",
            str(len(compared)),
            f"{_share(offsets)} ({_share(library)})" if len(offsets) else "",
            f"{np.median(apart):.3f}, {np.percentile(apart, 99):.2f}" if len(apart) else "",
            ", ".join(map(str, links)) if compared else "",
            f"{max((result.seconds for result in good), default=0.0):.1f}",
        )
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def faults(folders: Mapping[str, Sequence[LaneletResult]]) -> list[str]:
    """Return a line for each file that does not import."""
    return [
        f"* {name.partition('@')[0]}: {result.error}"
        for name, results in folders.items()
        for result in results
        if result.error
    ]


def other_links(folders: Mapping[str, Sequence[LaneletResult]]) -> list[str]:
    """Return a line for each map with links that only one of the two has."""
    return [
        f"* {name.partition('@')[0]}, {result.path.name}: {len(result.places)} links, such as {result.places[0]}"
        for name, results in folders.items()
        for result in results
        if result.places
    ]


def _share(offsets: Array) -> str:
    return f"{100 * float((offsets <= CLOSE).mean()):.1f} %"


def main(arguments: Sequence[str] | None = None) -> None:
    """Check the maps of NAME=FOLDER arguments, and print the results or write them into the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="+", metavar="NAME@COMMIT=FOLDER")
    parser.add_argument("--page", action="store_true", help="write docs/results/map-imports.md")
    options = parser.parse_args(arguments)
    results: dict[str, list[LaneletResult]] = {}
    for argument in options.folders:
        name, _, folder = argument.rpartition("=")
        paths = [path for path in sorted(Path(folder).rglob("*.osm")) if has_lanelets(path)]
        for number, path in enumerate(paths, 1):
            results.setdefault(name or Path(folder).name, []).append(check_lanelet_map(path))
            print(f"{name}: {number} of {len(paths)}", file=sys.stderr)
    parts = {"lanelet2": table(results), "lanelet2-faults": faults(results), "lanelet2-links": other_links(results)}
    for mark, lines in parts.items():
        if options.page:
            insert("results/map-imports.md", mark, ["", *lines, ""])
        else:
            print("\n".join(lines))


if __name__ == "__main__":
    main()

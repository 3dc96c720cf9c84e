"""Import of a large map: size, time and lanes.

    python -m benchmarks.large_map --page               # 20 MB, made of copies of a built-in town side by side
    python -m benchmarks.large_map FILE.xodr            # a map of yours

The time is that of all that `ssad import map` does, on one core: reading, baking, storing and the page with the report.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from pathlib import Path
from xml.etree import ElementTree

os.environ.setdefault("OMP_NUM_THREADS", "1")

from benchmarks.insert import insert, store_commit
from ssad.core.lane_graph import load_graph
from ssad.core.types import LaneType
from ssad.world.roads import import_map, town_xodr

TOWN = "Oldmarket"
SPACING = 1000.0  # m between the copies of the town
COLUMNS = 10
REPEATS = 3  # the least time counts: other work on the machine only adds to it
OFFSET = 100_000  # between the ids of one copy and of the next
NUMBERED = {  # attributes that name roads, junctions and signals
    "road": ("id", "junction"),
    "junction": ("id",),
    "connection": ("incomingRoad", "connectingRoad"),
    "predecessor": ("elementId",),
    "successor": ("elementId",),
    "signal": ("id",),
    "signalReference": ("id",),
    "controller": ("id",),
    "control": ("signalId",),
}


def large_map(size: float) -> bytes:
    """Return an OpenDRIVE text of at least `size` bytes: copies of a town on a grid, each with ids of its own."""
    text = town_xodr(TOWN).encode()
    network = ElementTree.fromstring(text)
    for number in range(1, math.ceil(size / len(text))):
        network.extend(_copy(text, number))
    return ElementTree.tostring(network, encoding="utf-8", xml_declaration=True)


def _copy(text: bytes, number: int) -> list[ElementTree.Element]:
    town = ElementTree.fromstring(text)
    for element in town.iter():
        for name in NUMBERED.get(element.tag, ()):
            value = element.get(name, "-1")
            if value != "-1":
                element.set(name, str(int(value) + number * OFFSET))
        if element.tag == "geometry":
            for name, step in (("x", number % COLUMNS), ("y", number // COLUMNS)):
                element.set(name, repr(float(element.get(name, "0")) + step * SPACING))
    return [element for element in town if element.tag != "header"]


def measure(path: Path) -> tuple[float, int, float]:
    """Import a map; return the processor time, s, the number of drivable lanes and their length, km."""
    with tempfile.TemporaryDirectory(prefix="ssad-large-") as home:
        started = time.process_time()
        stored = import_map(path, None, Path(home), progress=lambda stage: print(f"{stage} ...", file=sys.stderr))
        seconds = time.process_time() - started
        graph = load_graph(stored)
    driving = graph.kind == LaneType.DRIVING
    return seconds, int(driving.sum()), float(graph.length[driving].sum()) / 1000.0


def main() -> None:
    """Measure, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", nargs="?", type=Path, metavar="FILE.xodr", help="a map instead of the copies")
    parser.add_argument("--megabytes", type=float, default=20.0, help="size of the map of copies")
    parser.add_argument("--page", action="store_true", help="write docs/results/map-imports.md")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ssad-large-") as folder:
        path = arguments.map or Path(folder) / "copies.xodr"
        if arguments.map is None:
            path.write_bytes(large_map(1e6 * arguments.megabytes))
        seconds, count, kilometres = min(measure(path) for _ in range(REPEATS))
        size = path.stat().st_size / 1e6
    name = arguments.map.name if arguments.map else f"copies of {TOWN}"
    lines = ["| map | size, MB | time, s | drivable lanes | their length, km |", "|---|---:|---:|---:|---:|"]
    lines.append(f"| {name} | {size:.1f} | {seconds:.1f} | {count} | {kilometres:.0f} |")
    print("\n".join(lines))
    if arguments.page:
        insert("results/map-imports.md", "large", ["", *lines, ""])
        store_commit("results/map-imports.md")


if __name__ == "__main__":
    main()

"""`python benchmarks/opendrive_maps.py OUT.md FOLDER...` imports all OpenDRIVE maps of folders, and checks them.

For each folder, such as a checkout of a public repository, the table counts the maps that import. Where the extra
`carla` is installed, the centre of every drivable lane is compared with that of carla.Map at the same s. Maps that
do not import, and lanes that lie elsewhere, are named below the table.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ssad.core.errors import SSADError
from ssad.core.import_report import ImportReport
from ssad.core.safeio import write_atomic
from ssad.core.types import LaneType
from ssad.world.roads.bake import bake
from ssad.world.roads.lane_sampling import LaneSampler
from ssad.world.roads.xodr import read_network

CLOSE = 0.05  # m
TIMEOUT = 60.0  # s for carla.Map

READER = """
import sys, numpy as np, carla
from pathlib import Path
road_map = carla.Map("map", Path(sys.argv[1]).read_text(encoding="utf-8-sig"))
rows = []
for road, lane, s in np.load(sys.argv[2]).tolist():
    place = road_map.get_waypoint_xodr(int(road), int(lane), s)
    rows.append((np.nan,) * 2 if place is None else (place.transform.location.x, -place.transform.location.y))
np.save(sys.argv[3], np.array(rows, np.float64).reshape(-1, 2))
"""


@dataclass
class Result:
    """Import of one map: the error, its duration, s, and the distances from carla.Map of its lanes' samples, m."""

    path: Path
    error: str = ""
    seconds: float = 0.0
    places: tuple[str, ...] = ()
    distance: np.ndarray | None = None


def check_map(path: Path) -> Result:
    """Import a map, and compare it with carla.Map."""
    result = Result(path)
    started = time.process_time()
    try:
        bake(path)
    except SSADError as error:
        result.error = str(error).replace(str(path), path.name)
        return result
    result.seconds = time.process_time() - started
    network = read_network(path, report := ImportReport(str(path)))
    sampler = LaneSampler(network)
    names = {number: name for name, number in network.road_names.items()}
    keys = [
        (road.id, index, lane)
        for road in network.roads.values()
        for index, section in enumerate(road.sections)
        for lane in sorted(section.lanes)
    ]
    samples = sampler.lanes(keys)
    rows, request = [], []
    for index, key in enumerate(keys):
        lane = network.roads[key[0]].sections[key[1]].lanes[key[2]]
        part = np.arange(samples.first[index], samples.first[index + 1])
        if lane.kind != LaneType.DRIVING or not names[key[0]].isdecimal():
            continue
        part = part[samples.width[part] > CLOSE]
        rows.append(part)
        request += [(int(names[key[0]]), key[2], s) for s in samples.s[part].tolist()]
    centres = _carla_centres(path, np.array(request, np.float64).reshape(-1, 3))
    if centres is not None:
        own = samples.xy[np.concatenate(rows)] + network.shift
        result.distance = np.hypot(*(own - centres).T)
        result.places = tuple(f"road {road:.0f}, lane {lane:.0f}, s {s:.1f}" for road, lane, s in request)
    del report
    return result


def _carla_centres(path: Path, request: np.ndarray) -> np.ndarray | None:
    """Return the centres [n, 2] by carla.Map of lanes by road, lane and s [n, 3]; None if it cannot read the map."""
    with tempfile.TemporaryDirectory() as folder:
        question, answer = Path(folder) / "question.npy", Path(folder) / "answer.npy"
        np.save(question, request)
        try:
            subprocess.run(
                [sys.executable, "-c", READER, str(path), str(question), str(answer)],
                capture_output=True,
                timeout=TIMEOUT,
                check=True,
            )
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
            return None
        return np.asarray(np.load(answer))


def summary(folders: dict[str, list[Result]]) -> str:
    """Return the page: a table of the folders, then the maps that need a word."""
    lines = [
        "| Maps of | files | import | share | compared with carla.Map | centres within 0.05 m | longest import, s |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    everything = [result for results in folders.values() for result in results]
    for name, results in [*folders.items(), ("all", everything)]:
        good = [result for result in results if not result.error]
        compared = [result for result in good if result.distance is not None and np.isfinite(result.distance).any()]
        close = sum(bool(np.nanmax(result.distance) <= CLOSE) for result in compared)  # type: ignore[arg-type]
        longest = max((result.seconds for result in good), default=0.0)
        lines.append(
            f"| {name} | {len(results)} | {len(good)} | {100 * len(good) / max(len(results), 1):.1f} % |"
            f" {len(compared)} | {close} | {longest:.1f} |"
        )
    lines += ["", "Maps that do not import, with the fault of the file:", ""]
    lines += [f"* {name}: {result.error}" for name, results in folders.items() for result in results if result.error]
    lines += ["", "Maps with lanes elsewhere than in carla.Map, or that it lacks:", ""]
    for name, results in folders.items():
        for result in results:
            if result.distance is None or not len(result.distance):
                continue
            missing = int(np.isnan(result.distance).sum())
            worst = float(np.nanmax(result.distance, initial=0.0))
            if missing or worst > CLOSE:
                remarks = []
                if worst > CLOSE:
                    where = result.places[int(np.nanargmax(result.distance))]
                    away = int((result.distance > CLOSE).sum())
                    remarks.append(f"{away} of {len(result.distance)} samples up to {worst:.2f} m away ({where})")
                if missing:
                    remarks.append(f"{missing} samples that it lacks")
                lines.append(f"* {name}, {result.path.name}: {', '.join(remarks)}")
    return "\n".join(lines) + "\n"


def main(out: str, *folders: str) -> None:
    """Check the maps of folders and write the page."""
    results: dict[str, list[Result]] = {}
    for folder in folders:
        paths = [path for path in sorted(Path(folder).rglob("*.xodr")) if path.stat().st_size]
        results[Path(folder).name] = []
        for number, path in enumerate(paths, 1):
            results[Path(folder).name].append(check_map(path))
            print(f"{folder}: {number} of {len(paths)}", end="\r", file=sys.stderr)
    write_atomic(Path(out), summary(results))


if __name__ == "__main__":
    main(*sys.argv[1:])

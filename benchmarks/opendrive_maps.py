"""Import of public OpenDRIVE and Lanelet2 maps, and comparison with carla.Map and the library Lanelet2.

    python -m benchmarks.opendrive_maps docs/results/map-imports.md esmini/esmini@COMMIT=FOLDER...

Each folder, such as a checkout of a public repository at the commit that its name states, is searched for `.xodr` and
`.osm` files (`lanelet2_maps`). Where the extra `carla` is installed, the centres of all drivable lanes are compared
with those of carla.Map at the same s, every half metre. The files are no part of SSAD.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.lanelet2_maps import LaneletResult, check_lanelet_map, has_lanelets, lanelet_section
from ssad.core.errors import SSADError
from ssad.core.import_report import ImportReport
from ssad.core.safeio import write_atomic
from ssad.core.types import LaneType
from ssad.world.roads.bake import bake
from ssad.world.roads.lane_sampling import Key, LaneSampler
from ssad.world.roads.reference_line import CLOTHOID
from ssad.world.roads.xodr import Network, read_network

CLOSE = 0.05  # m
FAR = 1e5  # m; carla.Map's float32 coordinates are coarser than 8 mm beyond it
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
PAGE = """# Public maps

> **Stored result.** Weights: none. Torch: not used. Make it anew: `python -m benchmarks.opendrive_maps OUT.md \
NAME@COMMIT=FOLDER...`, with checkouts of the repositories below, and the package lanelet2 in the Python that \
LANELET2_PYTHON names.

## OpenDRIVE maps
*Import*: `ssad import map` makes a town of the file. *Close*: every drivable lane, sampled each half metre, lies within
{close:g} m of where carla.Map has it. Times are CPU seconds of one core.

| Maps of | commit | files | import | share | compared | close | longest import, s |
|---|---|---:|---:|---:|---:|---:|---:|
{rows}

### OpenDRIVE files that do not import
Each message names the fault of the file.

{errors}

### OpenDRIVE maps on which the two readers differ
carla.Map does not read `<border>`, loses lanes on arcs of no curvature and spirals of constant curvature, has
coordinates in single precision, and steps along polynomial curves. Where a curve is not as long as the file says, SSAD
stretches its parameter to the stated length, so that the next piece begins where the curve ends.

{differences}
"""


@dataclass
class Result:
    """Import of one map.

    Attributes:
        path: The file.
        error: Why it does not import.
        seconds: CPU time of the import, s.
        places: Name of each sample.
        distance: Distance of each sample from carla.Map's, m, nan where that has no lane; None: not compared.
        reasons: Features of the file on which the readers differ.
    """

    path: Path
    error: str = ""
    seconds: float = 0.0
    places: tuple[str, ...] = ()
    distance: npt.NDArray[np.float64] | None = None
    reasons: list[str] = field(default_factory=list)

    @property
    def worst(self) -> float:
        """Greatest distance, m; 0 where nothing is compared."""
        finite = np.zeros(0) if self.distance is None else self.distance[np.isfinite(self.distance)]
        return float(finite.max(initial=0.0))

    @property
    def missing(self) -> int:
        """Number of samples that carla.Map does not have."""
        return 0 if self.distance is None else int(np.isnan(self.distance).sum())


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
    report = ImportReport(str(path))
    network = read_network(path, report)
    sampler = LaneSampler(network)
    sampler.check(report)
    names = {number: name for name, number in network.road_names.items()}
    keys = [
        (road.id, index, lane)
        for road in network.roads.values()
        for index, section in enumerate(road.sections)
        for lane in sorted(section.lanes)
    ]
    samples = sampler.lanes(keys)
    rows, request = [np.zeros(0, np.int64)], []
    for index, key in enumerate(keys):
        if not _is_compared(network, key, names):
            continue
        part = np.arange(samples.first[index], samples.first[index + 1])
        rows.append(part[samples.width[part] > CLOSE])
        request += [(int(names[key[0]]), key[2], s) for s in samples.s[rows[-1]].tolist()]
    centres = _carla_centres(path, np.array(request, np.float64).reshape(-1, 3))
    if centres is not None and len(centres):
        result.distance = np.hypot(*(samples.xy[np.concatenate(rows)] + network.shift - centres).T)
        result.places = tuple(f"road {road}, lane {lane}, s {s:.1f}" for road, lane, s in request)
        result.reasons = list(_reasons(network, report))
    return result


def _is_compared(network: Network, key: Key, names: dict[int, str]) -> bool:
    lane = network.roads[key[0]].sections[key[1]].lanes[key[2]]
    return lane.kind == LaneType.DRIVING and names[key[0]].isdecimal()


def _reasons(network: Network, report: ImportReport) -> Iterator[str]:
    """Yield the features of a map on which the readers are known to differ."""
    pieces = [piece for road in network.roads.values() for piece in road.plan if piece.kind == CLOTHOID]
    lanes = [lane for road in network.roads.values() for section in road.sections for lane in section.lanes.values()]
    if any(lane.borders for lane in lanes):
        yield "borders"
    if any(
        piece.written_as in ("arc", "spiral")
        and piece.values[0] == piece.values[1]
        and (piece.written_as == "spiral" or piece.values[0] == 0.0)
        for piece in pieces
    ):
        yield "an arc of no curvature, or a spiral of constant curvature"
    if max(map(abs, network.shift)) > FAR:
        yield "coordinates beyond single precision"
    for doubt in report.doubts:
        if "as long as" in doubt or "do not meet" in doubt:
            yield doubt


def _carla_centres(path: Path, request: npt.NDArray[np.float64]) -> npt.NDArray[np.float64] | None:
    """Return the centres [n, 2] by carla.Map of lanes by road, lane and s [n, 3]; None if it cannot read the map."""
    with tempfile.TemporaryDirectory() as folder:
        question, answer = Path(folder) / "question.npy", Path(folder) / "answer.npy"
        np.save(question, request)
        command = [sys.executable, "-c", READER, str(path), str(question), str(answer)]
        try:
            subprocess.run(command, capture_output=True, timeout=TIMEOUT, check=True)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
            return None
        return np.asarray(np.load(answer), np.float64)


def page(folders: dict[str, list[Result]]) -> str:
    """Return the page on the maps of folders, by names such as owner/repository@commit."""
    everything = [result for results in folders.values() for result in results]
    rows, errors, differences = [], [], []
    for name, results in [*folders.items(), ("all", everything)]:
        good = [result for result in results if not result.error]
        compared = [result for result in good if result.distance is not None and len(result.distance) > result.missing]
        repository, _, commit = name.partition("@")
        cells = (
            repository,
            commit[:10],
            str(len(results)),
            str(len(good)),
            f"{100 * len(good) / max(len(results), 1):.1f} %",
            str(len(compared)),
            str(sum(result.worst <= CLOSE for result in compared)),
            f"{max((result.seconds for result in good), default=0.0):.1f}",
        )
        rows.append(f"| {' | '.join(cells)} |")
    for name, results in folders.items():
        repository = name.partition("@")[0]
        for result in results:
            if result.error:
                errors.append(f"* {repository}: {result.error}")
            elif result.worst > CLOSE or result.missing:
                differences.append(f"* {repository}, {result.path.name}: {_difference(result)}")
    return PAGE.format(close=CLOSE, rows="\n".join(rows), errors="\n".join(errors), differences="\n".join(differences))


def _difference(result: Result) -> str:
    """Return a sentence on where a map differs from carla.Map's."""
    parts = []
    if result.distance is not None and result.worst > CLOSE:
        place = result.places[int(np.nanargmax(result.distance))]
        count = int((result.distance > CLOSE).sum())
        parts.append(f"{count} of {len(result.distance)} samples up to {result.worst:.2f} m away ({place})")
    if result.missing:
        parts.append(f"{result.missing} samples that carla.Map lacks")
    return ", ".join(parts) + (f". In the file: {'; '.join(result.reasons)}" if result.reasons else "")


def main(out: str, *folders: str) -> None:
    """Check the maps of NAME=FOLDER arguments and write the page."""
    results: dict[str, list[Result]] = {}
    lanelet_results: dict[str, list[LaneletResult]] = {}
    for argument in folders:
        name, _, folder = argument.rpartition("=")
        name = name or Path(folder).name
        paths = [path for path in sorted(Path(folder).rglob("*.xodr")) if path.stat().st_size]
        lanelet_paths = [path for path in sorted(Path(folder).rglob("*.osm")) if has_lanelets(path)]
        for number, path in enumerate(paths, 1):
            results.setdefault(name, []).append(check_map(path))
            print(f"{name}: {number} of {len(paths)}", file=sys.stderr)
        for number, path in enumerate(lanelet_paths, 1):
            lanelet_results.setdefault(name, []).append(check_lanelet_map(path))
            print(f"{name}, Lanelet2: {number} of {len(lanelet_paths)}", file=sys.stderr)
    write_atomic(Path(out), page(results) + (lanelet_section(lanelet_results) if lanelet_results else ""))


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Import of public OpenDRIVE maps, and comparison with carla.Map.

    python -m benchmarks.opendrive_maps --page esmini/esmini@COMMIT=FOLDER...

Each folder, such as a checkout of a public repository at the commit that its name states, is searched for `.xodr`
files. Where the extra `carla` is installed, the centres of all drivable lanes are compared with those of carla.Map at
the same s, every half metre. Where the two differ most, the reference line is integrated by adaptive quadrature too.
The files are no part of SSAD. `--page` writes docs/results/map-imports.md.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.integrate import quad
from scipy.optimize import brentq

from benchmarks.insert import insert, store_commit
from ssad.core.errors import SSADError
from ssad.core.import_report import ImportReport
from ssad.core.types import LaneType
from ssad.world.roads.bake import bake
from ssad.world.roads.lane_sampling import Key, LaneSampler
from ssad.world.roads.reference_line import CLOTHOID, CURVE, PlanPiece
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
LENGTH_ERROR = 0.01  # m between the length of a polynomial curve and that in the file
KINK = 0.01  # rad between two pieces of a reference line
UNEVEN = 1.5  # ratio of the fastest to the slowest parameter of a polynomial curve
HEAD = (
    "| Maps of | commit | files | import | share | compared | close | longest import, s |",
    "|---|---|---:|---:|---:|---:|---:|---:|",
)


@dataclass
class Result:
    """Import of one map.

    Attributes:
        path: The file.
        error: Why it does not import.
        seconds: CPU time of the import, s.
        places: Name of each sample.
        distance: Distance of each sample from carla.Map's, m, nan where that has no lane; None: not compared.
        reasons: Features of the roads on which the readers differ.
        judged: Distances of SSAD and of carla.Map from quadrature where they differ most, m; None: not computed.
    """

    path: Path
    error: str = ""
    seconds: float = 0.0
    places: tuple[str, ...] = ()
    distance: npt.NDArray[np.float64] | None = None
    reasons: list[str] = field(default_factory=list)
    judged: tuple[float, float] | None = None

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
        sample = np.concatenate(rows)
        ours = samples.xy[sample]
        result.distance = np.hypot(*(ours + network.shift - centres).T)
        result.places = tuple(f"road {road}, lane {lane}, s {s:.1f}" for road, lane, s in request)
        differing = np.flatnonzero(~(result.distance <= CLOSE))
        roads = {network.road_names[str(request[index][0])] for index in differing.tolist()}
        result.reasons = list(_reasons(network, report, sampler, roads))
        if result.worst > CLOSE and "borders" not in result.reasons:
            index = int(np.nanargmax(result.distance))
            road = network.road_names[str(request[index][0])]
            exact = integrated_centre(sampler, road, request[index][2], ours[index])
            of_carla = centres[index] - network.shift
            result.judged = (float(np.hypot(*(ours[index] - exact))), float(np.hypot(*(of_carla - exact))))
    return result


def integrated_centre(
    sampler: LaneSampler, road: int, s: float, centre: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return the centre [2] of a lane at s, with the reference line by adaptive quadrature.

    Args:
        sampler: Geometry of the map.
        road: Number of the road.
        s: Position along it, m.
        centre: Centre by the sampler [2], m, whose lateral position is taken.
    """
    x, y, heading = (
        float(values[0]) for values in sampler.at(np.array([sampler.row[road]]), np.array([s]), np.zeros(1))
    )
    lateral = float((centre - [x, y]) @ [-np.sin(heading), np.cos(heading)])
    piece = [piece for piece in sampler.network.roads[road].plan if piece.s <= s][-1]
    u, v, turn = _integrated(piece, min(s - piece.s, piece.length))
    cosine, sine = np.cos(piece.heading), np.sin(piece.heading)
    heading = piece.heading + turn
    place = [piece.x + cosine * u - sine * v, piece.y + sine * u + cosine * v]
    return np.array(place) + lateral * np.array([-np.sin(heading), np.cos(heading)])


def _integrated(piece: PlanPiece, distance: float) -> tuple[float, float, float]:
    """Return u, v and turn of a piece at a distance from its start; polynomial curves end at the stated length."""
    if piece.kind == CLOTHOID:
        first, last = piece.values
        rate = (last - first) / max(piece.length, 1e-12)

        def turn(at: float) -> float:
            return at * (first + 0.5 * rate * at)

        u = quad(lambda at: np.cos(turn(at)), 0.0, distance, limit=200)[0]
        v = quad(lambda at: np.sin(turn(at)), 0.0, distance, limit=200)[0]
        return u, v, turn(distance)
    u_curve, v_curve, end = np.poly1d(piece.values[3::-1]), np.poly1d(piece.values[7:3:-1]), piece.values[8]

    def arc(parameter: float) -> float:
        speed = quad(lambda p: np.hypot(u_curve.deriv()(p), v_curve.deriv()(p)), 0.0, parameter, limit=200)
        return float(speed[0])

    scale = arc(end) / piece.length if end > 0.0 else 1.0
    parameter = brentq(lambda p: arc(p) - scale * distance, 0.0, 1.001 * (end or piece.length), xtol=1e-13)
    slope = v_curve.deriv()(parameter), u_curve.deriv()(parameter)
    return float(u_curve(parameter)), float(v_curve(parameter)), float(np.arctan2(*slope))


def _is_compared(network: Network, key: Key, names: dict[int, str]) -> bool:
    lane = network.roads[key[0]].sections[key[1]].lanes[key[2]]
    return lane.kind == LaneType.DRIVING and names[key[0]].isdecimal()


def _reasons(network: Network, report: ImportReport, sampler: LaneSampler, numbers: set[int]) -> Iterator[str]:
    """Yield the features of roads, by their numbers, on which the readers are known to differ."""
    roads = [network.roads[number] for number in numbers]
    pieces = [piece for road in roads for piece in road.plan]
    if any(lane.borders for road in roads for section in road.sections for lane in section.lanes.values()):
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
    reference = sampler.reference
    rows = {sampler.row[number] for number in numbers}
    if any(row in rows and abs(length - arc) > LENGTH_ERROR for row, _, length, arc in reference.length_errors()):
        yield "a polynomial curve is not as long as the file says"
    if any(piece.kind == CURVE and _speed_ratio(piece) > UNEVEN for piece in pieces):
        yield "a polynomial curve whose parameter runs unevenly"
    inner = np.flatnonzero((reference.road[1:] == reference.road[:-1]) & np.isin(reference.road[1:], list(rows)))
    if len(inner):
        _, _, heading, _ = reference.evaluate_pieces(inner, reference.start[inner, 4])
        turn = np.abs(np.angle(np.exp(1j * (reference.start[inner + 1, 3] - heading))))
        if turn.max() > KINK:
            yield f"pieces of a reference line meet at angles of up to {np.degrees(turn.max()):.1f} degrees"
    names = {name for name, number in network.road_names.items() if number in numbers} | set(map(str, numbers))
    for doubt, places in report.doubts.items():
        is_geometry = "as long as the road" in doubt or "do not meet" in doubt
        if is_geometry and any(_road_name(place) in names for place in places):
            yield doubt


def _road_name(place: str) -> str:
    match = re.match(r"road ([^,:]+)", place)
    return match[1] if match else ""


def _speed_ratio(piece: PlanPiece) -> float:
    """Return by how much the fastest parameter of a polynomial curve outruns the slowest."""
    parameter = np.linspace(0.0, piece.values[8] or piece.length, 50)
    speed = np.hypot(*(np.poly1d(piece.values[k + 3 : k - 1 if k else None : -1]).deriv()(parameter) for k in (0, 4)))
    return float(speed.max() / max(speed.min(), 1e-9))


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


def report_lines(folders: dict[str, list[Result]]) -> dict[str, list[str]]:
    """Return the parts of the page on the maps of folders, by names such as owner/repository@commit.

    Returns:
        "maps": the table; "faults": the files that do not import; "differences": those on which the readers differ.
    """
    everything = [result for results in folders.values() for result in results]
    rows, errors, differences = [*HEAD], [], []
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
    return {"maps": rows, "faults": errors, "differences": differences}


def _difference(result: Result) -> str:
    """Return a sentence on where a map differs from carla.Map's."""
    parts = []
    if result.distance is not None and result.worst > CLOSE:
        place = result.places[int(np.nanargmax(result.distance))]
        count = int((result.distance > CLOSE).sum())
        parts.append(f"{count} of {len(result.distance)} samples up to {result.worst:.2f} m away ({place})")
    if result.missing:
        parts.append(f"{result.missing} samples that carla.Map lacks")
    text = ", ".join(parts)
    if result.judged is not None:
        text += f"; from quadrature, SSAD {result.judged[0]:.3f} m and carla.Map {result.judged[1]:.3f} m"
    return f"{text}. In the file: {'; '.join(result.reasons) or 'nothing known'}"


def main() -> None:
    """Check the maps of NAME=FOLDER arguments, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", metavar="NAME@COMMIT=FOLDER")
    parser.add_argument("--page", action="store_true", help="write docs/results/map-imports.md")
    arguments = parser.parse_args()
    results: dict[str, list[Result]] = {}
    for argument in arguments.folders:
        name, _, folder = argument.rpartition("=")
        paths = [path for path in sorted(Path(folder).rglob("*.xodr")) if path.stat().st_size]
        name = name or Path(folder).name
        results[name] = []
        for number, path in enumerate(paths, 1):
            results[name].append(check_map(path))
            print(f"{name}: {number} of {len(paths)}", file=sys.stderr)
    parts = report_lines(results)
    print("\n".join(line for lines in parts.values() for line in lines))
    if arguments.page:
        for mark, lines in parts.items():
            insert("results/map-imports.md", mark, ["", *lines, ""])
        store_commit("results/map-imports.md")


if __name__ == "__main__":
    main()

"""Conversion of maps to lane graphs: OpenDRIVE here, Lanelet2 in `lanelet2_graph`."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ssad.core.errors import MapError
from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph, Marking, load_graph, save_graph
from ssad.core.rotations import wrap_angle
from ssad.core.safeio import read_bytes, write_atomic
from ssad.core.types import F64, I32, LaneType
from ssad.core.wording import counted
from ssad.world.roads.graph_report import describe
from ssad.world.roads.import_page import import_page, import_page_path
from ssad.world.roads.lane_links import Key, LaneLinks
from ssad.world.roads.lane_sampling import LaneSampler, LaneSamples
from ssad.world.roads.lanelet2 import Lanelet2Options
from ssad.world.roads.lanelet2_graph import bake_lanelet2
from ssad.world.roads.signals import Approaches, place_signals, place_signs
from ssad.world.roads.thinning import thin
from ssad.world.roads.xodr import MAX_BYTES, Lane, Network, local_coordinates, read_network

NARROW = 0.05  # m; a lane that never gets wider is not there
SHORT = 0.1  # m; shorter pieces of lane are passed over
JOIN = 1.0  # m, most between the end of a lane and the start of its successor
JOIN_MARGIN = 0.1  # m beyond half the width of a lane across which one that would end is joined
WIDE = 100.0  # m; a wider lane is a mistake
MAX_LANE_METRES = 5.0e6  # of all lanes: bounds the memory of the reader
LANELET2 = ".osm"  # suffix of Lanelet2 maps
DEFAULT_SPEED = 50.0 / 3.6  # m/s, where a map says nothing
UNCONTROLLED_SPEED = 50.0 / 3.6  # m/s, across junctions without lights and signs

Progress = Callable[[str], None]
Uncontrolled = Literal["keep", "slow", "signals"]


@dataclass
class _Shape:
    """Samples of one lane in the direction of traffic."""

    xy: F64
    z: F64
    yaw: F64
    width: F64
    s: F64


@contextlib.contextmanager
def _paused_collection() -> Iterator[None]:
    """Pause the garbage collector, which would visit the millions of objects of a large map again and again."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@_paused_collection()
def bake(
    map_file: Path,
    name: str | None = None,
    *,
    report: ImportReport | None = None,
    progress: Progress | None = None,
    lanelet2: Lanelet2Options | None = None,
) -> LaneGraph:
    """Return the lane graph of an OpenDRIVE file (.xodr) or a Lanelet2 map (.osm).

    Args:
        map_file: The file.
        name: Name of the town; None: that of the file.
        report: Filled with what came in, what was left out, and what is doubtful.
        progress: Called with the name of each stage when it begins.
        lanelet2: Origin, projection and rule of the road of a Lanelet2 map.

    Raises:
        MapError: The file is invalid.
    """
    path = Path(map_file)
    account = ImportReport(str(path)) if report is None else report
    stage = progress or (lambda text: None)
    stage(f"reading {path.name}")
    if path.suffix == LANELET2:
        return bake_lanelet2(path, name, options=lanelet2, report=account)
    _refuse_options(path, lanelet2)
    network = read_network(path, account)
    keys = [
        (road.id, index, lane)
        for road in network.roads.values()
        for index, section in enumerate(road.sections)
        for lane in sorted(section.lanes)
    ]
    metres = sum(
        (section.s1 - section.s0) * len(section.lanes) for road in network.roads.values() for section in road.sections
    )
    if metres > MAX_LANE_METRES:
        raise MapError(f"{path}: {metres:.0f} m of lanes, the limit is {MAX_LANE_METRES:.0f} m; divide the map")
    stage(f"evaluating {counted(len(keys), 'lane')} of {len(network.roads)} roads")
    # Absurd coefficients overflow; lanes without a finite shape are left out below.
    with np.errstate(all="ignore"):
        sampler = LaneSampler(network)
        sampler.check(account)
        shapes = _shapes(network, keys, sampler.lanes(keys), account)
    if not any(_lane(network, key).kind == LaneType.DRIVING for key in shapes):
        raise MapError(f"{path}: no drivable lane in it has an area; correct the map and import it again")
    stage("linking lanes, placing signals")
    return _assemble(name or path.stem, network, shapes, sampler, account)


def import_map(
    path: Path,
    name: str | None,
    home: Path,
    *,
    report: ImportReport | None = None,
    strict: bool = False,
    turn_on_red: bool | None = None,
    uncontrolled: Uncontrolled = "keep",
    progress: Progress | None = None,
    lanelet2: Lanelet2Options | None = None,
) -> Path:
    """Bake an OpenDRIVE file or a Lanelet2 map into HOME/towns/NAME.npz, atomically.

    A copy of an OpenDRIVE file is stored beside it, with the coordinates of the town. A page with the report and a
    picture from above is written to HOME/imports/NAME.html.

    Args:
        path: The file; a town that is baked already (.npz) is copied.
        name: Name of the town; None: that of the file.
        home: Parent of the towns' folder.
        report: Filled with what came in, what was left out, and what is doubtful.
        strict: Refuse a file with doubts.
        turn_on_red: Turns to the near side are allowed on red; None: as the file suggests.
        uncontrolled: Junctions where ways meet and the file has neither lights nor signs: `keep` them; `slow` traffic
            across them to 50 km/h; or do so and add traffic lights (`signals`).
        progress: Called with the name of each stage when it begins.
        lanelet2: Origin, projection and rule of the road of a Lanelet2 map.

    Returns:
        Path of the lane graph.

    Raises:
        MapError: See `bake`; or the file is doubtful, if `strict`.
    """
    town_name = name or Path(path).stem
    if not town_name or town_name.startswith(".") or set(town_name) & set('/\\:*?"<>|\0'):
        raise MapError(f"'{town_name}' cannot be the name of a town; use letters, digits, _ and -")
    target = Path(home) / "towns" / f"{town_name}.npz"
    account = ImportReport(str(path)) if report is None else report
    is_baked = Path(path).suffix == ".npz"
    if is_baked:
        _refuse_options(path, lanelet2)
    graph = (
        replace(load_graph(path), name=town_name)
        if is_baked
        else bake(path, town_name, report=account, progress=progress, lanelet2=lanelet2)
    )
    if strict:
        account.refuse_doubts(MapError)
    if turn_on_red is not None:
        graph = replace(graph, turn_on_red=np.array([turn_on_red]))
    if uncontrolled != "keep":
        graph = _control_junctions(graph, account, has_lights=uncontrolled == "signals")
    if progress:
        progress(f"writing town {town_name}")
    source = Path(path).with_suffix(".xodr")
    # An OpenDRIVE file of the same name beside a Lanelet2 map is another map.
    has_source = source.is_file() and Path(path).suffix != LANELET2
    xodr_bytes = read_bytes(source, limit=MAX_BYTES) if has_source else None
    save_graph(graph, target)
    if xodr_bytes is not None:
        has_shift = not is_baked and graph.origin.any()
        write_atomic(target.with_suffix(".xodr"), local_coordinates(xodr_bytes) if has_shift else xodr_bytes)
    else:
        target.with_suffix(".xodr").unlink(missing_ok=True)  # remove the source of an earlier map of this name
    write_atomic(import_page_path(home, town_name), import_page(graph, account))
    return target


def _refuse_options(path: Path, lanelet2: Lanelet2Options | None) -> None:
    """Raise MapError for options of Lanelet2 maps with another file."""
    if lanelet2 is not None:
        raise MapError(f"{path}: --origin, --projection and --left-hand are for Lanelet2 maps (.osm)")


def _shapes(network: Network, keys: list[Key], samples: LaneSamples, report: ImportReport) -> dict[Key, _Shape]:
    """Return the shapes of the lanes that have an area, with the superfluous samples left out."""
    first, lane_count = samples.first, len(keys)
    lane = np.repeat(np.arange(lane_count), np.diff(first))
    spacing = np.hypot(*np.diff(samples.xy, axis=0, prepend=samples.xy[:1]).T)
    is_start = np.zeros(len(lane), bool)
    is_start[first[:-1][np.diff(first) > 0]] = True
    distinct = is_start | (spacing > 1e-3)
    rows = np.flatnonzero(distinct)
    lane = lane[rows]
    first = np.searchsorted(lane, np.arange(lane_count + 1))
    xy, z, yaw, width = samples.xy[rows], samples.z[rows], samples.yaw[rows], samples.width[rows]
    tangent = samples.tangent[rows]
    spacing = np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T)
    is_start = is_start[rows]
    spacing[is_start] = 0.0
    # Arc length from the start of each lane, and direction without jumps along it.
    total = np.cumsum(spacing)
    arc_length = total - total[first[:-1][lane]] if len(lane) else total
    turn = np.diff(tangent, prepend=tangent[:1])
    turn[is_start] = 0.0
    smooth_tangent = np.cumsum(np.asarray(wrap_angle(turn), np.float64))
    counts = np.diff(first)
    widest = np.zeros(lane_count)
    np.maximum.at(widest, lane, width)
    lengths = np.zeros(lane_count)
    lengths[counts > 0] = arc_length[first[1:][counts > 0] - 1]
    is_finite = np.ones(lane_count, bool)
    is_finite[lane[~(np.isfinite(xy).all(1) & np.isfinite(z) & (width <= WIDE))]] = False
    is_present = is_finite & (widest >= NARROW) & (counts >= 2) & (lengths >= SHORT)
    wrapped_yaw = np.asarray(wrap_angle(yaw), np.float64)
    shapes: dict[Key, _Shape] = {}
    selected = thin(first, arc_length, smooth_tangent, width)
    for index in np.flatnonzero(is_present).tolist():
        part = selected[index]
        shapes[keys[index]] = _Shape(xy[part], z[part], wrapped_yaw[part], width[part], arc_length[part])
    for index in np.flatnonzero(~is_present).tolist():
        kind = _lane(network, keys[index]).kind
        if not is_finite[index]:
            report.doubt(f"a lane is wider than {WIDE:g} m or has no finite shape; it is left out", _place(keys[index]))
        elif kind != LaneType.NONE:
            limit = f"narrower than {NARROW:g} m" if widest[index] < NARROW else f"shorter than {SHORT:g} m"
            report.note(f"{kind.name.lower()} lanes {limit} are passed over", _place(keys[index]))
    for index in np.flatnonzero(samples.folded).tolist():
        if _lane(network, keys[index]).kind == LaneType.DRIVING:
            report.doubt("a drivable lane runs backwards, inside the centre of its curve", _place(keys[index]))
    return shapes


def _place(key: Key) -> str:
    return f"road {key[0]}, section {key[1]}, lane {key[2]}"


def _lane(network: Network, key: Key) -> Lane:
    return network.roads[key[0]].sections[key[1]].lanes[key[2]]


def _assemble(
    name: str, network: Network, shapes: dict[Key, _Shape], sampler: LaneSampler, report: ImportReport
) -> LaneGraph:
    keys = list(shapes)
    index = {key: row for row, key in enumerate(keys)}
    lane_links = LaneLinks(network, sampler.road_ends(), report)
    successors = [_following_lanes(lane_links, key, shapes, report) for key in keys]
    links = [sorted({index[successor] for successor in targets if successor in index}) for targets in successors]
    lane_entries = [_lane(network, key) for key in keys]
    junctions = [network.roads[key[0]].junction for key in keys]
    speed_limits = _speeds(network, keys, lane_entries, links)
    neighbours = [[index.get(key, -1) for key in _sides(network, key)] for key in keys]
    markings = [_paint(network, key) for key in keys]
    shape_list = list(shapes.values())
    point_counts = [len(shape.s) for shape in shape_list]
    offset = np.concatenate([[0], np.cumsum(point_counts)])
    crosswalks = sampler.crosswalks()
    signal_poses = sampler.places(list(network.signal_places.values()))
    approaches = Approaches(
        network=network,
        keys=keys,
        kind=np.array([lane.kind for lane in lane_entries]),
        junction=np.array(junctions),
        links=links,
        end=np.array([[*shape.xy[-1], shape.yaw[-1]] for shape in shape_list]),
        begin=np.array([[*shape.xy[0], shape.yaw[0]] for shape in shape_list]),
        width=np.array([shape.width[-1] for shape in shape_list]),
        line=[(shape.xy, shape.s) for shape in shape_list],
        crosswalks=crosswalks,
        lights=dict(zip(network.signal_places, signal_poses.tolist(), strict=True)),
        forward=np.array([lane.forward for lane in lane_entries]),
        left_hand=network.left_hand,
        stop_lines=sampler.places([line for road in network.roads.values() for line in road.stop_lines])[:, :2],
    )
    graph = LaneGraph(
        name=name,
        xy=np.concatenate([shape.xy for shape in shape_list]),
        z=np.concatenate([shape.z for shape in shape_list]),
        yaw=np.concatenate([shape.yaw for shape in shape_list]),
        width=np.concatenate([shape.width for shape in shape_list]),
        s=np.concatenate([shape.s for shape in shape_list]),
        offset=offset,
        kind=np.array([lane.kind for lane in lane_entries]),
        road=_ints(key[0] for key in keys),
        section=_ints(key[1] for key in keys),
        lane_id=_ints(key[2] for key in keys),
        junction=_ints(junctions),
        speed_limit=speed_limits.astype(np.float32),
        left=_ints(sides[0] for sides in neighbours),
        right=_ints(sides[1] for sides in neighbours),
        left_marking=np.array([sides[0] for sides in markings]),
        right_marking=np.array([sides[1] for sides in markings]),
        succ_offset=np.concatenate([[0], np.cumsum([len(targets) for targets in links])]),
        succ=_ints(lane for targets in links for lane in targets),
        crosswalk_offset=np.concatenate([[0], np.cumsum([len(corners) for corners in crosswalks])]),
        crosswalk_xy=np.concatenate([np.zeros((0, 2)), *crosswalks]),
        **place_signals(approaches),
        **place_signs(approaches),
        forward=approaches.forward,
        origin=np.array(network.origin),
        left_hand=np.array([network.left_hand]),
        turn_on_red=np.array([network.turn_on_red]),
    )
    roads = f"{len(network.roads)} roads, {len(network.junctions)} junctions"
    describe(graph, roads, report, lambda lane: _name(graph, lane))
    return graph


def _control_junctions(graph: LaneGraph, report: ImportReport, *, has_lights: bool) -> LaneGraph:
    """Return the graph with at most `UNCONTROLLED_SPEED` across junctions without lights and signs.

    Priority to the near side does not work at the speed of a main road: whoever turns across it needs longer than
    faster traffic is in sight.

    Args:
        graph: The town.
        report: Takes the junctions that change.
        has_lights: Add traffic lights to these junctions.
    """
    leads_from_sign = np.isin(np.repeat(np.arange(graph.lane_count), np.diff(graph.succ_offset)), graph.rule_lane)
    signed = graph.junction[graph.succ[leads_from_sign]]
    uncontrolled = np.setdiff1d(graph.signal_junction[graph.signal_virtual], signed)
    across = np.isin(graph.junction, uncontrolled) & (graph.kind == LaneType.DRIVING)
    speed_limit = np.minimum(graph.speed_limit, np.float32(UNCONTROLLED_SPEED))
    for junction in np.unique(graph.junction[across & (speed_limit < graph.speed_limit)]).tolist():
        report.note(
            f"the speed limit across junctions without lights and signs is {UNCONTROLLED_SPEED * 3.6:.0f} km/h",
            f"junction {junction}",
        )
    if has_lights:
        for junction in uncontrolled.tolist():
            report.note("traffic lights are added at junctions without lights and signs", f"junction {junction}")
    return replace(
        graph,
        speed_limit=np.where(across, speed_limit, graph.speed_limit),
        signal_virtual=graph.signal_virtual & ~(np.isin(graph.signal_junction, uncontrolled) & has_lights),
    )


def _name(graph: LaneGraph, lane: int) -> str:
    return _place((int(graph.road[lane]), int(graph.section[lane]), int(graph.lane_id[lane])))


def _ints(values: Any) -> I32:
    return np.array(list(values), np.int32)


def _sides(network: Network, key: Key) -> tuple[Key, Key]:
    """Return the keys of the lanes to the left and right in driving direction, existing or not."""
    road, section, lane = key
    # Lane 0 is the centre line: inside lane 1 lies lane -1. Ids grow to the left of the road's direction.
    higher, lower = (road, section, lane + 1 or 1), (road, section, lane - 1 or -1)
    return (higher, lower) if _lane(network, key).forward else (lower, higher)


def _paint(network: Network, key: Key) -> tuple[Marking, Marking]:
    """Return the markings to the left and right of a lane in driving direction."""
    section = network.roads[key[0]].sections[key[1]]
    lane = section.lanes[key[2]]
    inner = key[2] - (1 if key[2] > 0 else -1)
    inner_mark = section.lanes[inner].mark if inner in section.lanes else Marking.NONE
    marks = (section.centre_mark if inner == 0 else inner_mark, lane.mark)
    # The centre lies to the left of traffic that keeps to the right.
    return marks if lane.forward == (key[2] < 0) else marks[::-1]


def _following_lanes(links: LaneLinks, key: Key, shapes: dict[Key, _Shape], report: ImportReport) -> list[Key]:
    """Return the lanes that begin where a lane ends, passing through lanes without area (sections of no length).

    A lane that would end otherwise goes on across a step of up to half a lane, as where it splits in two.
    """
    gaps: list[tuple[float, Key]] = []
    queue, visited = [key], {key}
    while queue:
        for candidate in links.following(queue.pop()):
            if candidate in visited:
                continue
            visited.add(candidate)
            if candidate in shapes:
                gaps.append((float(np.hypot(*(shapes[candidate].xy[0] - shapes[key].xy[-1]))), candidate))
            else:
                queue.append(candidate)
    successors = [candidate for gap, candidate in gaps if gap <= JOIN]
    is_driving = links.lane(key).kind == LaneType.DRIVING
    for gap, candidate in gaps:
        if gap <= JOIN or not is_driving or links.lane(candidate).kind != LaneType.DRIVING:
            continue
        place = f"{_place(key)} to {_place(candidate)}: {gap:.1f} m"
        half_width = 0.5 * max(float(shapes[key].width[-1]), float(shapes[candidate].width[0]))
        if not any(near <= JOIN for near, _ in gaps) and gap <= half_width + JOIN_MARGIN:
            successors.append(candidate)
            report.note("lanes are joined across a step aside", place)
        else:
            report.doubt(f"linked lanes whose ends are more than {JOIN:g} m apart are not joined", place)
    return successors


def _speeds(network: Network, keys: list[Key], lanes: list[Lane], links: list[list[int]]) -> F64:
    """Return speed limits; a lane without one takes that of its predecessors, then that of its successors."""
    speed_limits = np.full(len(keys), np.nan)
    for index, (key, lane) in enumerate(zip(keys, lanes, strict=True)):
        limit = lane.speed or network.roads[key[0]].sections[key[1]].speed
        if limit:
            speed_limits[index] = limit
    lane_pairs = np.array(
        [(lane_index, successor) for lane_index, successors in enumerate(links) for successor in successors], int
    ).reshape(-1, 2)
    for source, target in ((0, 1), (1, 0)):
        # Each round passes limits on by one lane, so chains of lanes need several.
        for _ in range(100):
            donors, receivers = lane_pairs[:, source], lane_pairs[:, target]
            fillable = np.isnan(speed_limits[receivers]) & ~np.isnan(speed_limits[donors])
            if not fillable.any():
                break
            lowest = np.full(len(keys), np.inf)
            np.minimum.at(lowest, receivers[fillable], speed_limits[donors[fillable]])
            speed_limits = np.where(np.isfinite(lowest), lowest, speed_limits)
    return np.where(np.isnan(speed_limits), DEFAULT_SPEED, speed_limits)

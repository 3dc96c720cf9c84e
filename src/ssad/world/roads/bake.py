"""Conversion of OpenDRIVE to lane graphs.

The XML defines the links of lanes; carla.Map, in a process of its own, gives their geometry.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.errors import MapError, install_extra
from ssad.core.lane_graph import LaneGraph, Marking, load_graph, save_graph
from ssad.core.rotations import wrap_angle
from ssad.core.safeio import read_bytes, write_atomic
from ssad.core.types import F64, I32, LaneType
from ssad.world.roads.signals import Approaches, place_signals, place_signs
from ssad.world.roads.xodr import MAX_BYTES, Connection, Lane, Link, MapRoad, Network, read_network

TIMEOUT = 120.0  # s; Town05 takes about 3
STEP = 2.0  # m, most between two points of a lane
BEND = 0.01  # m, most that a chord leaves the curve
NARROW = 0.05  # m; a lane that never gets wider is not there
SHORT = 0.1  # m; shorter pieces of lane are passed over
JOIN = 1.0  # m, most between the end of a lane and the start of its successor
DEFAULT_SPEED = 50.0 / 3.6  # m/s, where a map says nothing

Key = tuple[int, int, int]  # road, section, lane id
Answer = dict[str, npt.NDArray[Any]]


@dataclass
class _Shape:
    """Samples of one lane in the direction of traffic."""

    xy: F64
    z: F64
    yaw: F64
    width: F64
    s: F64


def bake(xodr: Path, name: str | None = None) -> LaneGraph:
    """Return the lane graph of an OpenDRIVE file.

    Args:
        xodr: The file.
        name: Name of the town; None: that of the file.

    Raises:
        MapError: The file is invalid, or carla is not installed.
    """
    path = Path(xodr)
    network = read_network(path)
    keys = [
        (road.id, index, lane)
        for road in network.roads.values()
        for index, section in enumerate(road.sections)
        for lane in sorted(section.lanes)
    ]
    answer = _sample(path, network, keys)
    shapes: dict[Key, _Shape] = {}
    ends = np.cumsum(answer["count"])
    for key, end, count in zip(keys, ends.tolist(), answer["count"].tolist(), strict=True):
        shape = _shape(answer, slice(end - count, end), reverse=key[2] > 0)
        if shape is not None:
            shapes[key] = shape
    if not any(_lane(network, key).kind == LaneType.DRIVING for key in shapes):
        raise MapError(f"{path}: carla.Map finds no drivable lane in it; correct the map and import it again")
    return _assemble(name or path.stem, network, shapes, answer)


def import_map(path: Path, name: str | None, home: Path) -> Path:
    """Bake an OpenDRIVE file into HOME/towns/NAME.npz, atomically; a copy of the file is stored beside it.

    Args:
        path: The file; a town that is baked already (.npz) is copied.
        name: Name of the town; None: that of the file.
        home: Parent of the towns' folder.

    Returns:
        Path of the lane graph.

    Raises:
        MapError: See `bake`.
    """
    town_name = name or Path(path).stem
    if not town_name or town_name.startswith(".") or set(town_name) & set('/\\:*?"<>|\0'):
        raise MapError(f"'{town_name}' cannot be the name of a town; use letters, digits, _ and -")
    target = Path(home) / "towns" / f"{town_name}.npz"
    baked = Path(path).suffix == ".npz"
    graph = replace(load_graph(path), name=town_name) if baked else bake(path, town_name)
    source = Path(path).with_suffix(".xodr")
    xodr_bytes = read_bytes(source, limit=MAX_BYTES) if source.is_file() else None
    save_graph(graph, target)
    if xodr_bytes is not None:
        write_atomic(target.with_suffix(".xodr"), xodr_bytes)
    else:
        target.with_suffix(".xodr").unlink(missing_ok=True)  # remove the source of an earlier map of this name
    return target


def _sample(path: Path, network: Network, keys: list[Key]) -> Answer:
    """Sample the lanes with carla.Map in a process of its own."""
    if importlib.util.find_spec("carla") is None:
        raise MapError(f"{path}: reading OpenDRIVE needs the package carla; {install_extra('carla')}")
    sections = [network.roads[road].sections[section_index] for road, section_index, _ in keys]
    with tempfile.TemporaryDirectory(prefix="ssad-map-") as folder:
        request, answer = Path(folder) / "request.npz", Path(folder) / "answer.npz"
        np.savez(
            request,
            road=np.array([key[0] for key in keys]),
            lane=np.array([key[2] for key in keys]),
            s0=np.array([section.s0 for section in sections]),
            s1=np.array([section.s1 for section in sections]),
        )
        reader_command = [sys.executable, "-m", "ssad.world.roads._carla_reader", str(path), str(request), str(answer)]
        try:
            process = subprocess.run(
                reader_command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired:
            raise MapError(f"{path}: carla.Map did not read it in {TIMEOUT:.0f} s; make it smaller") from None
        if process.returncode != 0 or not answer.exists():
            lines = [line for line in process.stderr.strip().splitlines() if not line.startswith("WARNING")]
            message = (lines or ["no message"])[-1][:200]
            reason = f"signal {-process.returncode}" if process.returncode < 0 else f"code {process.returncode}"
            raise MapError(f"{path}: carla.Map cannot read it and stopped ({reason}: {message}); correct the map")
        with np.load(answer, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}


def _shape(answer: Answer, part: slice, *, reverse: bool) -> _Shape | None:
    """Samples of a lane in driving order with the superfluous ones left out; None if there is no lane."""
    step = -1 if reverse else 1
    column = dict(zip(("x", "y", "z", "yaw", "width"), answer["table"][part][::step, 1:].T, strict=True))
    if (
        len(column["x"]) < 2
        or column["width"].max() < NARROW
        or not all(np.isfinite(values).all() for values in column.values())
    ):
        return None
    xy = np.stack([column["x"], column["y"]], axis=1)
    shifted_xy = np.concatenate([[True], np.hypot(*np.diff(xy, axis=0).T) > 1e-3])
    if shifted_xy.sum() < 2:
        return None
    xy, z, yaw, width = (
        xy[shifted_xy],
        column["z"][shifted_xy],
        np.unwrap(column["yaw"][shifted_xy]),
        column["width"][shifted_xy],
    )
    arc_length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    if arc_length[-1] < SHORT:
        return None
    # On unwrapped yaw, which has no jump at pi.
    selected = _thin(arc_length, yaw, width)
    wrapped_yaw = np.asarray(wrap_angle(yaw), np.float64)
    return _Shape(
        xy[selected], z[selected], wrapped_yaw[selected], np.maximum(width[selected], 0.0), arc_length[selected]
    )


def _thin(s: F64, yaw: F64, width: F64) -> list[int]:
    """Return the fewest samples (greedy) with chords up to STEP that deviate from curve and width by at most BEND."""
    selected = [0]
    start, count = 0, len(s)
    while start < count - 1:
        end = start + 1
        while end + 1 < count and s[end + 1] - s[start] <= STEP + 1e-6:
            chord = s[end + 1] - s[start]
            heading_change = np.ptp(yaw[start : end + 2])
            linear_width = width[start] + (width[end + 1] - width[start]) * (s[start : end + 2] - s[start]) / chord
            # The sagitta of an arc is chord times turn over 8.
            if chord * heading_change / 8.0 > BEND or np.abs(width[start : end + 2] - linear_width).max() > 2.0 * BEND:
                break
            end += 1
        selected.append(end)
        start = end
    return selected


def _lane(network: Network, key: Key) -> Lane:
    return network.roads[key[0]].sections[key[1]].lanes[key[2]]


def _assemble(name: str, network: Network, shapes: dict[Key, _Shape], answer: Answer) -> LaneGraph:
    keys = list(shapes)
    index = {key: row for row, key in enumerate(keys)}
    successors = [_following_lanes(network, key, shapes) for key in keys]
    links = [sorted({index[successor] for successor in targets if successor in index}) for targets in successors]
    lane_entries = [_lane(network, key) for key in keys]
    junctions = [network.roads[key[0]].junction for key in keys]
    speed_limits = _speeds(network, keys, lane_entries, links)
    neighbours = [[index.get(key, -1) for key in _sides(network, key)] for key in keys]
    markings = [_paint(network, key) for key in keys]
    shape_list = list(shapes.values())
    point_counts = [len(shape.s) for shape in shape_list]
    offset = np.concatenate([[0], np.cumsum(point_counts)])
    crosswalk_corners = answer["crosswalk"]
    corner_count = np.bincount(crosswalk_corners[:, 0].astype(int)) if len(crosswalk_corners) else np.zeros(0, int)
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
        crosswalks=[crosswalk_corners[crosswalk_corners[:, 0] == row, 1:] for row in range(len(corner_count))],
        lights=dict(zip(answer["light_id"].tolist(), answer["light"].tolist(), strict=True)),
    )
    return LaneGraph(
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
        crosswalk_offset=np.concatenate([[0], np.cumsum(corner_count)]),
        crosswalk_xy=crosswalk_corners[:, 1:],
        **place_signals(approaches),
        **place_signs(approaches),
    )


def _ints(values: Any) -> I32:
    return np.array(list(values), np.int32)


def _sides(network: Network, key: Key) -> tuple[Key, Key]:
    """Return the keys of the lanes to the left and right in driving direction, existing or not."""
    road, section, lane = key
    sign = 1 if lane > 0 else -1
    # Lane 0 is the centre line: inside lane 1 lies lane -1.
    inner = lane - sign or -sign
    return (road, section, inner), (road, section, lane + sign)


def _paint(network: Network, key: Key) -> tuple[Marking, Marking]:
    """Return the markings to the left and right of a lane in driving direction."""
    section = network.roads[key[0]].sections[key[1]]
    inner = key[2] - (1 if key[2] > 0 else -1)
    if inner == 0:
        return section.centre_mark, section.lanes[key[2]].mark
    left = section.lanes[inner].mark if inner in section.lanes else Marking.NONE
    return left, section.lanes[key[2]].mark


def _following_lanes(network: Network, key: Key, shapes: dict[Key, _Shape]) -> list[Key]:
    """Return the lanes that begin where a lane ends, passing through lanes without area (sections of no length)."""
    successors, queue, visited = [], [key], {key}
    while queue:
        for candidate in _linked_lanes(network, queue.pop()):
            if candidate in visited or candidate[2] not in network.roads[candidate[0]].sections[candidate[1]].lanes:
                continue
            visited.add(candidate)
            if candidate not in shapes:
                queue.append(candidate)
            elif np.hypot(*(shapes[candidate].xy[0] - shapes[key].xy[-1])) <= JOIN:
                successors.append(candidate)
    return successors


def _linked_lanes(network: Network, key: Key) -> list[Key]:
    """Return the lanes that the map links to the end of a lane, in its driving direction."""
    road, index, lane_id = network.roads[key[0]], key[1], key[2]
    forward = lane_id < 0
    lane_entry = road.sections[index].lanes[lane_id]
    target = lane_entry.successor if forward else lane_entry.predecessor
    next_section = index + (1 if forward else -1)
    if 0 <= next_section < len(road.sections):
        return [] if target is None else [(road.id, next_section, target)]
    road_link = road.successor if forward else road.predecessor
    if road_link is None:
        return []
    if road_link.kind == "road":
        return [] if target is None else [_lane_at_end(network.roads[road_link.id], road_link.contact, target)]
    return [
        _lane_at_end(network.roads[connection.connecting], connection.contact, target_lane)
        for connection in _connections(network, road_link, road)
        for source_lane, target_lane in connection.lanes
        if source_lane == lane_id
    ]


def _connections(network: Network, link: Link, road: MapRoad) -> list[Connection]:
    return [connection for connection in network.junctions[link.id] if connection.incoming == road.id]


def _lane_at_end(road: MapRoad, contact: str, lane: int) -> Key:
    """Return the key of a lane at one end of a road."""
    return (road.id, len(road.sections) - 1 if contact == "end" else 0, lane)


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

"""OpenDRIVE to lane graph.

The XML says how lanes are linked; carla.Map, in a process of its own, says where they are.
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
from ssad.core.safeio import read_bytes, write_atomic
from ssad.core.types import F64, I32, LaneType
from ssad.world.roads.signals import Approaches, place_signals, place_signs
from ssad.world.roads.xodr import MAX_BYTES, Connection, Lane, Link, Network, Road, read_network

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
    """Lane graph of an OpenDRIVE file.

    Args:
        xodr: The file.
        name: Name of the town; None: that of the file.

    Raises:
        MapError: The file is wrong in some way, or carla is not installed.
    """
    path = Path(xodr)
    network = read_network(path)
    keys = [
        (road.id, i, lane)
        for road in network.roads.values()
        for i, section in enumerate(road.sections)
        for lane in sorted(section.lanes)
    ]
    answer = _sample(path, network, keys)
    shapes: dict[Key, _Shape] = {}
    last = np.cumsum(answer["count"])
    for key, end, count in zip(keys, last.tolist(), answer["count"].tolist(), strict=True):
        shape = _shape(answer, slice(end - count, end), reverse=key[2] > 0)
        if shape is not None:
            shapes[key] = shape
    if not any(_lane(network, key).kind == LaneType.DRIVING for key in shapes):
        raise MapError(f"{path}: carla.Map finds no drivable lane in it; correct the map and import it again")
    return _assemble(name or path.stem, network, shapes, answer)


def import_map(path: Path, name: str | None, home: Path) -> Path:
    """Bake an OpenDRIVE file into HOME/towns/NAME.npz, whole or not at all; a copy of the file lies beside it.

    Args:
        path: The file; a town that is baked already (.npz) is copied.
        name: Name of the town; None: that of the file.
        home: Folder of the towns' folder.

    Returns:
        Path of the lane graph.

    Raises:
        MapError: See `bake`.
    """
    label = name or Path(path).stem
    if not label or label.startswith(".") or set(label) & set('/\\:*?"<>|\0'):
        raise MapError(f"'{label}' cannot be the name of a town; use letters, digits, _ and -")
    target = Path(home) / "towns" / f"{label}.npz"
    baked = Path(path).suffix == ".npz"
    graph = replace(load_graph(path), name=label) if baked else bake(path, label)
    source = Path(path).with_suffix(".xodr")
    copy = read_bytes(source, limit=MAX_BYTES) if source.is_file() else None
    save_graph(graph, target)
    if copy is not None:
        write_atomic(target.with_suffix(".xodr"), copy)
    else:
        target.with_suffix(".xodr").unlink(missing_ok=True)  # of another map that was called so
    return target


def _sample(path: Path, network: Network, keys: list[Key]) -> Answer:
    """Ask carla.Map, in a process of its own, where the lanes are."""
    if importlib.util.find_spec("carla") is None:
        raise MapError(f"{path}: reading OpenDRIVE needs the package carla; {install_extra('carla')}")
    sections = [network.roads[road].sections[i] for road, i, _ in keys]
    with tempfile.TemporaryDirectory(prefix="ssad-map-") as folder:
        request, answer = Path(folder) / "request.npz", Path(folder) / "answer.npz"
        np.savez(
            request,
            road=np.array([key[0] for key in keys]),
            lane=np.array([key[2] for key in keys]),
            s0=np.array([section.s0 for section in sections]),
            s1=np.array([section.s1 for section in sections]),
        )
        command = [sys.executable, "-m", "ssad.world.roads._carla_reader", str(path), str(request), str(answer)]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired:
            raise MapError(f"{path}: carla.Map did not read it in {TIMEOUT:.0f} s; make it smaller") from None
        if done.returncode != 0 or not answer.exists():
            lines = [line for line in done.stderr.strip().splitlines() if not line.startswith("WARNING")]
            said = (lines or ["no message"])[-1][:200]
            how = f"signal {-done.returncode}" if done.returncode < 0 else f"code {done.returncode}"
            raise MapError(f"{path}: carla.Map cannot read it and stopped ({how}: {said}); correct the map")
        with np.load(answer, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}


def _shape(answer: Answer, part: slice, *, reverse: bool) -> _Shape | None:
    """Samples of a lane in driving order with the superfluous ones left out; None if there is no lane."""
    step = -1 if reverse else 1
    column = dict(zip(("x", "y", "z", "yaw", "width"), answer["table"][part][::step, 1:].T, strict=True))
    if len(column["x"]) < 2 or column["width"].max() < NARROW or not all(np.isfinite(v).all() for v in column.values()):
        return None
    xy = np.stack([column["x"], column["y"]], axis=1)
    new = np.concatenate([[True], np.hypot(*np.diff(xy, axis=0).T) > 1e-3])
    if new.sum() < 2:
        return None
    xy, z, yaw, width = xy[new], column["z"][new], np.unwrap(column["yaw"][new]), column["width"][new]
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    if s[-1] < SHORT:
        return None
    keep = _thin(s, yaw, width)
    yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
    return _Shape(xy[keep], z[keep], yaw[keep], np.maximum(width[keep], 0.0), s[keep])


def _thin(s: F64, yaw: F64, width: F64) -> list[int]:
    """Fewest samples (greedy) with chords up to STEP that leave neither curve nor width by more than BEND."""
    keep = [0]
    i, n = 0, len(s)
    while i < n - 1:
        j = i + 1
        while j + 1 < n and s[j + 1] - s[i] <= STEP + 1e-6:
            run = s[j + 1] - s[i]
            turn = np.ptp(yaw[i : j + 2])
            line = width[i] + (width[j + 1] - width[i]) * (s[i : j + 2] - s[i]) / run
            if run * turn / 8.0 > BEND or np.abs(width[i : j + 2] - line).max() > 2.0 * BEND:
                break
            j += 1
        keep.append(j)
        i = j
    return keep


def _lane(network: Network, key: Key) -> Lane:
    return network.roads[key[0]].sections[key[1]].lanes[key[2]]


def _assemble(name: str, network: Network, shapes: dict[Key, _Shape], answer: Answer) -> LaneGraph:
    keys = list(shapes)
    index = {key: i for i, key in enumerate(keys)}
    follow = [_following(network, key, shapes) for key in keys]
    links = [sorted({index[k] for k in found if k in index}) for found in follow]
    lanes = [_lane(network, key) for key in keys]
    joint = [network.roads[key[0]].junction for key in keys]
    speed = _speeds(network, keys, lanes, links)
    beside = [[index.get(key, -1) for key in _sides(network, key)] for key in keys]
    paint = [_paint(network, key) for key in keys]
    parts = list(shapes.values())
    count = [len(part.s) for part in parts]
    offset = np.concatenate([[0], np.cumsum(count)])
    walk = answer["crosswalk"]
    corner_count = np.bincount(walk[:, 0].astype(int)) if len(walk) else np.zeros(0, int)
    approaches = Approaches(
        network=network,
        keys=keys,
        kind=np.array([lane.kind for lane in lanes]),
        junction=np.array(joint),
        links=links,
        end=np.array([[*part.xy[-1], part.yaw[-1]] for part in parts]),
        begin=np.array([[*part.xy[0], part.yaw[0]] for part in parts]),
        width=np.array([part.width[-1] for part in parts]),
        line=[(part.xy, part.s) for part in parts],
        crosswalks=[walk[walk[:, 0] == i, 1:] for i in range(len(corner_count))],
        lights=dict(zip(answer["light_id"].tolist(), answer["light"].tolist(), strict=True)),
    )
    return LaneGraph(
        name=name,
        xy=np.concatenate([part.xy for part in parts]),
        z=np.concatenate([part.z for part in parts]),
        yaw=np.concatenate([part.yaw for part in parts]),
        width=np.concatenate([part.width for part in parts]),
        s=np.concatenate([part.s for part in parts]),
        offset=offset,
        kind=np.array([lane.kind for lane in lanes]),
        road=_ints(key[0] for key in keys),
        section=_ints(key[1] for key in keys),
        lane_id=_ints(key[2] for key in keys),
        junction=_ints(joint),
        speed_limit=speed.astype(np.float32),
        left=_ints(pair[0] for pair in beside),
        right=_ints(pair[1] for pair in beside),
        left_marking=np.array([pair[0] for pair in paint]),
        right_marking=np.array([pair[1] for pair in paint]),
        succ_offset=np.concatenate([[0], np.cumsum([len(found) for found in links])]),
        succ=_ints(lane for found in links for lane in found),
        crosswalk_offset=np.concatenate([[0], np.cumsum(corner_count)]),
        crosswalk_xy=walk[:, 1:],
        **place_signals(approaches),
        **place_signs(approaches),
    )


def _ints(values: Any) -> I32:
    return np.array(list(values), np.int32)


def _sides(network: Network, key: Key) -> tuple[Key, Key]:
    """Keys of the lanes to the left and right in driving direction, whether they exist or not."""
    road, section, lane = key
    sign = 1 if lane > 0 else -1
    inner = lane - sign or -sign
    return (road, section, inner), (road, section, lane + sign)


def _paint(network: Network, key: Key) -> tuple[Marking, Marking]:
    """Markings to the left and right of a lane in driving direction."""
    section = network.roads[key[0]].sections[key[1]]
    inner = key[2] - (1 if key[2] > 0 else -1)
    if inner == 0:
        return section.centre_mark, section.lanes[key[2]].mark
    left = section.lanes[inner].mark if inner in section.lanes else Marking.NONE
    return left, section.lanes[key[2]].mark


def _following(network: Network, key: Key, shapes: dict[Key, _Shape]) -> list[Key]:
    """Lanes that begin where a lane ends; lanes without area (sections of no length) are passed through."""
    found, queue, seen = [], [key], {key}
    while queue:
        for other in _linked(network, queue.pop()):
            if other in seen or other[2] not in network.roads[other[0]].sections[other[1]].lanes:
                continue
            seen.add(other)
            if other not in shapes:
                queue.append(other)
            elif np.hypot(*(shapes[other].xy[0] - shapes[key].xy[-1])) <= JOIN:
                found.append(other)
    return found


def _linked(network: Network, key: Key) -> list[Key]:
    """What the map says follows a lane, in its driving direction."""
    road, i, lane = network.roads[key[0]], key[1], key[2]
    forward = lane < 0
    entry = road.sections[i].lanes[lane]
    target = entry.successor if forward else entry.predecessor
    after = i + (1 if forward else -1)
    if 0 <= after < len(road.sections):
        return [] if target is None else [(road.id, after, target)]
    link = road.successor if forward else road.predecessor
    if link is None:
        return []
    if link.kind == "road":
        return [] if target is None else [_door(network.roads[link.id], link.contact, target)]
    return [
        _door(network.roads[way.connecting], way.contact, to)
        for way in _ways(network, link, road)
        for start, to in way.lanes
        if start == lane
    ]


def _ways(network: Network, link: Link, road: Road) -> list[Connection]:
    return [way for way in network.junctions[link.id] if way.incoming == road.id]


def _door(road: Road, contact: str, lane: int) -> Key:
    """The lane at one end of a road."""
    return (road.id, len(road.sections) - 1 if contact == "end" else 0, lane)


def _speeds(network: Network, keys: list[Key], lanes: list[Lane], links: list[list[int]]) -> F64:
    """Speed limits; a lane without one takes that of the lanes before it, then of those after it."""
    speed = np.full(len(keys), np.nan)
    for i, (key, lane) in enumerate(zip(keys, lanes, strict=True)):
        value = lane.speed or network.roads[key[0]].sections[key[1]].speed
        if value:
            speed[i] = value
    pairs = np.array([(a, b) for a, found in enumerate(links) for b in found], int).reshape(-1, 2)
    for source, target in ((0, 1), (1, 0)):
        for _ in range(100):
            give, take = pairs[:, source], pairs[:, target]
            ready = np.isnan(speed[take]) & ~np.isnan(speed[give])
            if not ready.any():
                break
            least = np.full(len(keys), np.inf)
            np.minimum.at(least, take[ready], speed[give[ready]])
            speed = np.where(np.isfinite(least), least, speed)
    return np.where(np.isnan(speed), DEFAULT_SPEED, speed)

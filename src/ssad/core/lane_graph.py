"""The lane graph of a town: frozen arrays, checked, stored as one small .npz without pickle."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.errors import FormatError, MapError
from ssad.core.rotations import wrap_angle, wrap_scalar
from ssad.core.safeio import load_npz, save_npz
from ssad.core.types import F32, F64, I32, U8, Bool, LaneType, array_dtypes

FORMAT = 1  # of the .npz file
TURN = np.deg2rad(25.0)  # heading change over a junction that makes it a turn
MAX_FILE = 64 * 2**20  # bytes, unpacked; the largest town here has about 3 MB


class SignKind(IntEnum):
    """Meaning of a sign at a junction."""

    STOP = 0
    YIELD = 1


class Marking(IntEnum):
    """Marking between a lane and its neighbour. Only BROKEN may be crossed."""

    NONE = 0  # nothing painted or nothing known
    BROKEN = 1
    SOLID = 2
    DOUBLE = 3
    CURB = 4
    OTHER = 5


@dataclass(frozen=True)
class LaneGraph:
    """Lanes of a town as polylines that run in the direction of traffic. Arrays are read-only.

    L lanes, P points, E links, S signals, K stop lines, C crosswalks, G signs, R rules; metres, radians, m/s, world
    frame. A lane is one lane of one OpenDRIVE lane section; sidewalks and shoulders run in the direction of the driving
    lanes beside them.

    Attributes:
        name: Name of the town.
        xy: Points of the centre lines [P, 2].
        z: Height of each point [P].
        yaw: Heading of the centre line at each point [P].
        width: Width of the lane at each point [P].
        s: Arc length from the lane's start to each point [P].
        offset: Points of lane i are offset[i]:offset[i+1], at least two [L+1].
        kind: `LaneType` [L].
        road: OpenDRIVE id of the road [L].
        section: Number of the OpenDRIVE lane section [L].
        lane_id: OpenDRIVE id of the lane [L].
        junction: Junction that the lane crosses [L]; -1 for none.
        speed_limit: [L].
        left: Lane on the left as seen in its own direction, of any kind and direction [L]; -1 for none.
        right: The same on the right [L].
        left_marking: `Marking` towards the left lane [L].
        right_marking: `Marking` towards the right lane [L].
        succ_offset: Lanes that follow lane i are succ[succ_offset[i]:succ_offset[i+1]] [L+1].
        succ: See `succ_offset` [E].
        signal_xy: [S, 2].
        signal_yaw: Direction of the traffic that the signal faces [S].
        signal_junction: Junction of the signal [S].
        signal_phase: Signals of a junction with equal phase are green together [S].
        signal_virtual: Signals that are not in the map, and are off unless forced [S].
        stop_signal: Signal that controls a lane [K].
        stop_lane: The lane that it controls [K].
        stop_s: Arc length of the stop line on that lane, near its end [K].
        crosswalk_offset: Corners of crosswalk i are crosswalk_xy[crosswalk_offset[i]:crosswalk_offset[i+1]] [C+1].
        crosswalk_xy: See `crosswalk_offset` [., 2].
        sign_kind: `SignKind` [G].
        sign_xy: [G, 2].
        sign_yaw: Direction of the traffic that the sign faces [G].
        rule_sign: Sign that rules a lane [R].
        rule_lane: The lane that it rules [R].
        rule_s: Arc length of the stop line on that lane [R].
        forward: Traffic runs along the road's reference line, as OpenDRIVE measures s [L]; without it, it does so on
            lanes of negative id, as in right-hand traffic.
        origin: What is added to x and y to get the coordinates of the map's projection, m [2].
        left_hand: Traffic keeps to the left [1].
        turn_on_red: Turns to the near side are allowed on red, after a stop [1].
        length: Length of each lane [L].
        pred_offset: As `succ_offset`, for the lanes that lead to lane i [L+1].
        pred: As `succ`, for the lanes that lead to lane i [E].
    """

    name: str
    xy: F32
    z: F32
    yaw: F32
    width: F32
    s: F32
    offset: I32
    kind: U8
    road: I32
    section: I32
    lane_id: I32
    junction: I32
    speed_limit: F32
    left: I32
    right: I32
    left_marking: U8
    right_marking: U8
    succ_offset: I32
    succ: I32
    signal_xy: F32
    signal_yaw: F32
    signal_junction: I32
    signal_phase: I32
    signal_virtual: Bool
    stop_signal: I32
    stop_lane: I32
    stop_s: F32
    crosswalk_offset: I32
    crosswalk_xy: F32
    sign_kind: U8 = field(default_factory=lambda: np.zeros(0, np.uint8))
    sign_xy: F32 = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    sign_yaw: F32 = field(default_factory=lambda: np.zeros(0, np.float32))
    rule_sign: I32 = field(default_factory=lambda: np.zeros(0, np.int32))
    rule_lane: I32 = field(default_factory=lambda: np.zeros(0, np.int32))
    rule_s: F32 = field(default_factory=lambda: np.zeros(0, np.float32))
    forward: Bool = field(default_factory=lambda: np.zeros(0, bool))
    origin: F64 = field(default_factory=lambda: np.zeros(2))
    left_hand: Bool = field(default_factory=lambda: np.zeros(1, bool))
    turn_on_red: Bool = field(default_factory=lambda: np.ones(1, bool))
    length: F32 = field(init=False)
    pred_offset: I32 = field(init=False)
    pred: I32 = field(init=False)

    def __post_init__(self) -> None:
        if not len(self.forward):
            object.__setattr__(self, "forward", np.asarray(self.lane_id) < 0)
        for name, dtype in _DTYPES.items():
            value = np.ascontiguousarray(getattr(self, name), dtype)
            # The caller's array would otherwise become read-only.
            if value is getattr(self, name) and value.flags.writeable:
                value = value.copy()
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        _check(self)
        length = self.s[self.offset[1:] - 1]
        predecessors = np.repeat(np.arange(self.lane_count, dtype=np.int32), np.diff(self.succ_offset))
        by_successor = np.argsort(self.succ, kind="stable")
        pred_counts = np.bincount(self.succ, minlength=self.lane_count)
        pred_offsets = np.concatenate([[0], np.cumsum(pred_counts)]).astype(np.int32)
        for name, value in (("length", length), ("pred", predecessors[by_successor]), ("pred_offset", pred_offsets)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @property
    def lane_count(self) -> int:
        """Number of lanes L."""
        return len(self.kind)

    @cached_property
    def cache(self) -> dict[Any, Any]:
        """Cache of results derived from these lanes."""
        return {}

    def points(self, lane: int) -> slice:
        """Return the slice of the point arrays that holds a lane's centre line."""
        return slice(int(self.offset[lane]), int(self.offset[lane + 1]))

    def successors(self, lane: int) -> I32:
        """Return the lanes that traffic can enter from the end of a lane."""
        return self.succ[self.succ_offset[lane] : self.succ_offset[lane + 1]]

    def predecessors(self, lane: int) -> I32:
        """Return the lanes from which traffic enters a lane."""
        return self.pred[self.pred_offset[lane] : self.pred_offset[lane + 1]]

    def crosswalk(self, index: int) -> F32:
        """Return the corners [., 2] of a crosswalk."""
        return self.crosswalk_xy[self.crosswalk_offset[index] : self.crosswalk_offset[index + 1]]

    def at(self, lane: int, s: float) -> tuple[float, float, float, float]:
        """Return x, y, yaw and width at arc length s of a lane; s is clamped to the lane."""
        lane_points = self.points(lane)
        arc_lengths = self.s[lane_points]
        point_index = min(max(int(arc_lengths.searchsorted(s, side="right")) - 1, 0), len(arc_lengths) - 2)
        t = float(
            min(
                max(
                    (s - arc_lengths[point_index])
                    / max(float(arc_lengths[point_index + 1] - arc_lengths[point_index]), 1e-9),
                    0.0,
                ),
                1.0,
            )
        )
        point_index += lane_points.start
        x, y = (1.0 - t) * self.xy[point_index] + t * self.xy[point_index + 1]
        yaw_change = wrap_scalar(float(self.yaw[point_index + 1] - self.yaw[point_index]))
        width = (1.0 - t) * float(self.width[point_index]) + t * float(self.width[point_index + 1])
        return float(x), float(y), float(self.yaw[point_index]) + t * yaw_change, width

    def along(self, lane: int, s: npt.ArrayLike) -> F64:
        """Return rows [n, 4] of x, y, yaw and width at arc lengths s [n] of a lane, equal to `at` to the bit."""
        lane_points = self.points(lane)
        arc_lengths = self.s[lane_points]
        positions = np.asarray(s, np.float32)
        point_indices = np.clip(np.searchsorted(arc_lengths, positions, side="right") - 1, 0, len(arc_lengths) - 2)
        spacing = np.maximum(arc_lengths[point_indices + 1] - arc_lengths[point_indices], np.float32(1e-9))
        t = np.clip((positions - arc_lengths[point_indices]) / spacing, 0.0, 1.0).astype(np.float64)
        point_indices += lane_points.start
        # float32 weights: `at` multiplies float32 points by Python floats, which numpy does in float32.
        start_weight, end_weight = ((1.0 - t).astype(np.float32)[:, None], t.astype(np.float32)[:, None])
        xy = start_weight * self.xy[point_indices] + end_weight * self.xy[point_indices + 1]
        yaw_change = wrap_angle((self.yaw[point_indices + 1] - self.yaw[point_indices]).astype(np.float64))
        width = (1.0 - t) * self.width[point_indices].astype(np.float64) + t * self.width[point_indices + 1].astype(
            np.float64
        )
        return np.column_stack([xy, self.yaw[point_indices].astype(np.float64) + t * yaw_change, width])

    def is_divided(self, lane: int) -> bool:
        """Return whether no oncoming lane lies beside those of a lane's direction: a one-way road, or a median."""
        while (left := int(self.left[lane])) >= 0 and self.is_same_direction(lane, left):
            lane = left
        return left < 0 or self.kind[left] != LaneType.DRIVING

    def is_same_direction(self, lane: int, other_lane: int) -> bool:
        """Return whether two lanes of one road carry traffic the same way."""
        return bool(self.forward[lane] == self.forward[other_lane] and self.road[lane] == self.road[other_lane])


def empty_signal_arrays() -> dict[str, Any]:
    """Return the arrays of a `LaneGraph` without signals, stop lines and crosswalks, by name."""
    no_indices = np.zeros(0, np.int32)
    return {
        "signal_xy": np.zeros((0, 2), np.float32),
        "signal_yaw": np.zeros(0, np.float32),
        "signal_junction": no_indices,
        "signal_phase": no_indices,
        "signal_virtual": np.zeros(0, bool),
        "stop_signal": no_indices,
        "stop_lane": no_indices,
        "stop_s": np.zeros(0, np.float32),
        "crosswalk_offset": np.zeros(1, np.int32),
        "crosswalk_xy": np.zeros((0, 2), np.float32),
    }


_DTYPES = array_dtypes(LaneGraph)
_ARRAYS_BY_LENGTH = {
    "P": ("z", "yaw", "width", "s"),
    "L": (
        "road",
        "section",
        "lane_id",
        "junction",
        "speed_limit",
        "left",
        "right",
        "left_marking",
        "right_marking",
        "forward",
    ),
    "S": ("signal_yaw", "signal_junction", "signal_phase", "signal_virtual"),
    "K": ("stop_signal", "stop_lane", "stop_s"),
    "G": ("sign_kind", "sign_yaw"),
    "R": ("rule_sign", "rule_lane", "rule_s"),
}
# absent from older files, whose towns have no signs
_OPTIONAL = frozenset({"sign_kind", "sign_xy", "sign_yaw", "rule_sign", "rule_lane", "rule_s"})
# stored where they differ from their defaults, so that the bytes of other towns stay the same
_RARE = ("forward", "origin", "left_hand", "turn_on_red")


def _check(graph: LaneGraph) -> None:
    """Raise MapError for arrays that contradict each other; it names the first."""

    def require(holds: bool, problem: str) -> None:
        if not holds:
            raise MapError(f"town '{graph.name}': {problem}; bake the map again with ssad import map")

    for array_name in ("xy", "signal_xy", "crosswalk_xy", "sign_xy"):
        value = getattr(graph, array_name)
        require(value.ndim == 2 and value.shape[1] == 2, f"{array_name} is not [n, 2]")
    array_lengths = {
        "P": len(graph.xy),
        "L": len(graph.kind),
        "S": len(graph.signal_xy),
        "K": len(graph.stop_signal),
        "G": len(graph.sign_xy),
        "R": len(graph.rule_sign),
    }
    for dimension, array_names in _ARRAYS_BY_LENGTH.items():
        for array_name in array_names:
            require(
                getattr(graph, array_name).shape == (array_lengths[dimension],),
                f"{array_name} does not have {array_lengths[dimension]} rows",
            )
    for array_name in (array_name for array_name, dtype in _DTYPES.items() if dtype == np.float32):
        require(bool(np.isfinite(getattr(graph, array_name)).all()), f"{array_name} holds a number that is not finite")
    for array_name, rows, total in (
        ("offset", array_lengths["L"], array_lengths["P"]),
        ("succ_offset", array_lengths["L"], len(graph.succ)),
        ("crosswalk_offset", len(graph.crosswalk_offset) - 1, len(graph.crosswalk_xy)),
    ):
        value = getattr(graph, array_name)
        is_partition = value.shape == (rows + 1,) and len(value) > 0 and value[0] == 0 and value[-1] == total
        require(bool(is_partition and (np.diff(value) >= 0).all()), f"{array_name} does not partition its rows")
    require(array_lengths["L"] > 0, "it has no lane")
    for array_name, rows in (("origin", 2), ("left_hand", 1), ("turn_on_red", 1)):
        require(getattr(graph, array_name).shape == (rows,), f"{array_name} does not have {rows} rows")
    require(bool(np.isfinite(graph.origin).all()), "origin holds a number that is not finite")
    require(bool((np.diff(graph.offset) >= 2).all()), "a lane has fewer than two points")
    for array_name, low, high in (
        ("left", -1, array_lengths["L"]),
        ("right", -1, array_lengths["L"]),
        ("succ", 0, array_lengths["L"]),
        ("stop_lane", 0, array_lengths["L"]),
        ("stop_signal", 0, array_lengths["S"]),
        ("kind", 0, len(LaneType)),
        ("sign_kind", 0, len(SignKind)),
        ("rule_sign", 0, array_lengths["G"]),
        ("rule_lane", 0, array_lengths["L"]),
    ):
        value = getattr(graph, array_name)
        require(bool(((value >= low) & (value < high)).all()), f"{array_name} points outside the table")
    within_lane = np.ones(array_lengths["P"] - 1, bool)
    # Arc length restarts at each lane, so steps between lanes do not count.
    within_lane[graph.offset[1:-1] - 1] = False
    require(bool((np.diff(graph.s)[within_lane] > 0).all()), "s does not grow along a lane")
    require(bool((graph.kind == LaneType.DRIVING).any()), "it has no drivable lane")


def town_file(town: str) -> str:
    """Return the name of a town's file in a results folder; a town may itself be the path of a file."""
    is_plain_name = Path(town).name == town
    return f"{town}.npz" if is_plain_name else f"{Path(town).stem}-{hashlib.sha256(town.encode()).hexdigest()[:8]}.npz"


def save_graph(graph: LaneGraph, path: Path | str) -> None:
    """Write a lane graph as .npz without pickle, whole or not at all; equal graphs give equal bytes.

    Raises:
        StoreError: The file cannot be written.
    """
    # A text array, since npz has no place for metadata.
    header = np.array([f"ssad-lane-graph {FORMAT}", graph.name])
    defaults = {
        "forward": graph.lane_id < 0,
        "origin": np.zeros(2),
        "left_hand": np.zeros(1, bool),
        "turn_on_red": np.ones(1, bool),
    }
    names = [name for name in _DTYPES if name not in _RARE or not np.array_equal(getattr(graph, name), defaults[name])]
    save_npz(path, {"header": header} | {name: getattr(graph, name) for name in names})


def load_graph(path: Path | str) -> LaneGraph:
    """Read a lane graph written by `save_graph`.

    Raises:
        MapError: The file is missing, broken, too large, or not a lane graph.
    """
    source, remedy = Path(path), "bake the map again with ssad import map"
    try:
        arrays = load_npz(source, limit=MAX_FILE)
    except FormatError as error:
        raise MapError(f"{error}; {remedy}") from None
    header = arrays.pop("header", None)
    if header is None or header.shape != (2,) or str(header[0]) != f"ssad-lane-graph {FORMAT}":
        raise MapError(f"{source}: not a baked town of format {FORMAT}; {remedy}")
    wrong_names = ", ".join(
        sorted((set(_DTYPES) - _OPTIONAL - set(_RARE) - set(arrays)) | (set(arrays) - set(_DTYPES)))
    )
    if wrong_names:
        raise MapError(f"{source}: missing or unknown arrays: {wrong_names}; {remedy}")
    for name, value in arrays.items():
        if value.dtype != _DTYPES[name]:
            raise MapError(f"{source}: array {name} is {value.dtype}; {remedy}")
    return LaneGraph(name=str(header[1]), **arrays)


def are_equal(first: LaneGraph, second: LaneGraph) -> bool:
    """Return whether two graphs hold the same numbers."""
    return first.name == second.name and all(
        np.array_equal(getattr(first, graph_field.name), getattr(second, graph_field.name))
        for graph_field in fields(LaneGraph)
        if graph_field.name != "name"
    )

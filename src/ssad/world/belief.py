"""From a belief to what the planner's kernels read: checks, and what a perceiver left open, made up from the lanes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Belief
from ssad.core.errors import ConfigError
from ssad.core.geometry import to_local
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F32, F64, I32, AgentKind, Bool, LaneType, SignalState
from ssad.world.episode_arrays import TURN
from ssad.world.kernels.belief import CLEARING
from ssad.world.kernels.data import FAR, HORIZON, STRIDE, TurnRank
from ssad.world.kernels.shared import BRIDGE
from ssad.world.roads.query import CELL, DRIVABLE, grid_of

FITS = 0.5  # cosine of the angle between an object and a lane that goes its way
RESTS = 0.5  # m/s: who is slower is at rest
SAME = 1.0  # m between the places of one who is at rest, in two beliefs
HOPS = 24  # lanes that a forecast may run through
VEHICLES = (AgentKind.CAR, AgentKind.TRUCK, AgentKind.BUS, AgentKind.MOTORCYCLE, AgentKind.BICYCLE)


def check(belief: Belief, batch: int, signals: int, scenes: Bool) -> None:
    """Refuse a belief that does not fit.

    Args:
        belief: The belief [B, K].
        batch: B.
        signals: S.
        scenes: [B] whose rows count.

    Raises:
        ConfigError: What does not fit.
    """
    kind = np.asarray(belief.kind)
    if kind.ndim != 2 or kind.shape[0] != batch:
        raise ConfigError(f"belief: kind has shape {kind.shape}; expected ({batch}, K): K objects in each scene")
    tails: dict[str, tuple[int, ...]] = {"pose": (3,), "size": (2,), "change": (2,)}
    tails |= {"forecast": (int(HORIZON), 3), "way": (4,)}
    used = (kind != AgentKind.NONE) & scenes[:, None]
    if not ((kind >= 0) & (kind < len(AgentKind)))[scenes].all():
        raise ConfigError(f"belief: kind must be an AgentKind, 0 to {len(AgentKind) - 1}")
    for field in fields(belief):
        value = getattr(belief, field.name)
        if value is None:
            continue
        value = np.asarray(value)
        of_scene = {"signal": (batch, signals), "stop_sign": (batch,)}
        expected = of_scene.get(field.name) or (*kind.shape, *tails.get(field.name, ()))
        if value.shape != expected:
            raise ConfigError(f"belief: {field.name} has shape {value.shape}; expected {expected}")
        if field.name not in (*of_scene, "height") and not np.isfinite(value[used]).all():
            raise ConfigError(f"belief: {field.name} holds a number that is not finite")
    if not (np.asarray(belief.size)[used] > 0).all():
        raise ConfigError("belief: size must be above 0 m")
    if belief.stop_sign is not None and not np.isin(np.asarray(belief.stop_sign)[scenes], (0, 1)).all():
        raise ConfigError("belief: stop_sign must be 1 (known) or 0 (not known); None: all signs of the map are known")
    for name, value, limit in (
        ("signal", belief.signal, len(SignalState)),
        ("line_signal", belief.line_signal, signals),
    ):
        if value is not None:
            counts: npt.NDArray[Any] = np.asarray(value)[scenes if name == "signal" else used]
            if not ((counts >= -1) & (counts < limit)).all():
                raise ConfigError(f"belief: {name} must lie between -1 and {limit - 1}")


def complete(belief: Belief, lanes: Sequence[Lanes], scenes: Bool) -> dict[str, npt.NDArray[Any]]:
    """The arrays of `Seen` [B, K, ...] that hold a checked belief.

    Args:
        belief: The belief [B, K].
        lanes: The lanes of each scene's town.
        scenes: [B] whose rows are wanted; the others hold nothing that counts.

    Returns:
        Array by name.
    """
    kind = np.asarray(belief.kind, np.int32)
    used = (kind != AgentKind.NONE) & scenes[:, None]
    pose, speed = np.asarray(belief.pose, np.float32), np.asarray(belief.speed, np.float32)
    gives_way = np.isin(kind, VEHICLES) if belief.gives_way is None else np.asarray(belief.gives_way, bool)
    out: dict[str, npt.NDArray[Any]] = {
        "kind": kind,
        "pose": pose,
        "speed": speed,
        "half": np.float32(0.5) * np.asarray(belief.size, np.float32),
        "gives_way": gives_way.astype(np.int32),
    }
    forecast, way, signal = belief.forecast, belief.way, belief.line_signal
    if forecast is None or way is None or signal is None:
        made = _made_up(pose, speed, kind, out["half"][..., 0], gives_way, used, lanes, forecast)
        forecast = made[0] if forecast is None else forecast
        way = made[1] if way is None else way
        signal = made[2] if signal is None else signal
    out["forecast"] = np.asarray(forecast, np.float32)
    out["way"] = np.asarray(way, np.float32)
    out["signal"] = np.asarray(signal, np.int32)
    height = _heights(pose, used, lanes) if belief.height is None else belief.height
    out["height"] = np.asarray(height, np.float32)
    out["waited"] = np.zeros(kind.shape, np.float32) if belief.stood is None else np.asarray(belief.stood, np.float32)
    change = np.zeros((*kind.shape, 2), np.int32) if belief.change is None else np.asarray(belief.change, np.int32)
    out["change"] = change
    places = np.concatenate([pose[:, :, None, :2], out["forecast"][..., :2]], 2)
    out["span"] = np.concatenate([places.min(2), places.max(2)], -1)
    return out


def rested(
    now: Mapping[str, npt.NDArray[Any]], before: Mapping[str, npt.NDArray[Any]], seconds: npt.NDArray[Any]
) -> F32:
    """How long objects have been at rest: as long as somebody has stood where they stand.

    Args:
        now: `pose` [B, K, 3], `speed` and `kind` [B, K] of a belief.
        before: The same of the belief before, [B, L], and `waited` [B, L] s there.
        seconds: [B] s from that one to this.

    Returns:
        [B, K] s; 0 for who moves.
    """
    rest = [(one["kind"] != AgentKind.NONE) & (np.abs(one["speed"]) < RESTS) for one in (now, before)]
    away = np.hypot(*np.moveaxis(now["pose"][:, :, None, :2] - before["pose"][:, None, :, :2], -1, 0))
    same = rest[0][:, :, None] & rest[1][:, None] & (away < SAME)
    known = before["waited"] + np.asarray(seconds)[:, None]
    out: F32 = np.where(same, known[:, None], 0.0).max(-1, initial=0.0).astype(np.float32)
    return out


def _heights(pose: F32, used: Bool, lanes: Sequence[Lanes]) -> F32:
    """[B, K] height of the lane under each object, NaN where it is on none that goes its way; 0 without bridges."""
    out = np.zeros(used.shape, np.float32)
    for town in dict.fromkeys(one for one in lanes if one.hilly):
        scene, row = np.nonzero(used & np.array([one is town for one in lanes])[:, None])
        lane, s, _ = town.match(pose[scene, row].astype(np.float64))
        out[scene, row] = town.height(lane, s)
    return out


def _made_up(  # noqa: PLR0917
    pose: F32,
    speed: F32,
    kind: I32,
    half: F32,
    gives_way: Bool,
    used: Bool,
    lanes: Sequence[Lanes],
    given: F32 | None,
) -> tuple[F32, F32, I32]:
    """Forecast [B, K, 8, 3], way [B, K, 4] and signal of the stop line [B, K], from what can be seen."""
    forecast = np.zeros((*kind.shape, int(HORIZON), 3), np.float32)
    way = np.tile(np.array([FAR, FAR, float(TurnRank.STRAIGHT), 0.0], np.float32), (*kind.shape, 1))
    signal = np.full(kind.shape, -1, np.int32)
    for town in dict.fromkeys(lanes):
        scene, row = np.nonzero(used & np.array([one is town for one in lanes])[:, None])
        at, goes = pose[scene, row].astype(np.float64), speed[scene, row].astype(np.float64)
        lane, s, left = town.match(at)
        lane[kind[scene, row] == AgentKind.WALKER] = -1
        lane[kind[scene, row] == AgentKind.PROP] = -1
        ahead, signal[scene, row] = town.ahead(lane, s)
        stuck = gives_way[scene, row] & (ahead[:, 1] < half[scene, row] - 1.0)
        goes = np.where(stuck, np.maximum(goes, float(CLEARING)), goes)
        found = town.follow(at, goes, lane, s, left)
        forecast[scene, row] = found
        way[scene, row, :3] = ahead
        if given is not None:
            found = np.asarray(given, np.float64)[scene, row]
        aside = np.abs(to_local(at[:, None], found[..., :2])[..., 1]).max(-1, initial=0.0)
        way[scene, row, 3] = np.where(aside > 0.05, aside + 0.5, 0.0)
    return forecast, way, signal


class Lanes:
    """The driving lanes of a town, to tell where somebody goes who keeps to the lane under it."""

    def __init__(self, graph: LaneGraph) -> None:
        self.graph = graph
        self._grid = grid_of(graph, DRIVABLE)
        seg = self._grid.seg
        self._yaw = np.arctan2(seg[:, 3] - seg[:, 1], seg[:, 2] - seg[:, 0])
        count = graph.lanes
        first, last = graph.offset[:-1], graph.offset[1:] - 1
        self._next = np.full(count, -1, np.int64)
        for lane in range(count):
            after = [n for n in graph.successors(lane).tolist() if graph.kind[n] == LaneType.DRIVING]
            turns = [abs(_wrap(float(graph.yaw[last[n]] - graph.yaw[last[lane]]))) for n in after]
            if after:
                self._next[lane] = after[int(np.argmin(turns))]
        self._length = graph.length.astype(np.float64)
        # places of all lanes on one axis, so that one search finds them
        self._gap = float(self._length.max()) + 10.0
        owner = np.repeat(np.arange(count), np.diff(graph.offset))
        self._axis = owner * self._gap + graph.s.astype(np.float64)
        self.hilly = bool(np.ptp(graph.z) > BRIDGE)
        self._line = np.full(count, FAR)
        self._lamp = np.full(count, -1, np.int32)
        for k in range(len(graph.stop_lane)):
            self._line[graph.stop_lane[k]] = graph.stop_s[k]
            self._lamp[graph.stop_lane[k]] = graph.stop_signal[k]
        self._junction, self._rank = self._to_junction(first, last)

    def _to_junction(self, first: I32, last: I32) -> tuple[F64, F64]:
        """For every lane: m from its start to the next junction (0 inside, FAR: none), and `TurnRank` there."""
        graph = self.graph
        inside = graph.junction >= 0
        turn = _wrap((graph.yaw[last] - graph.yaw[first]).astype(np.float64))
        own = np.where(np.abs(turn) < TURN, TurnRank.STRAIGHT, np.where(turn > 0, TurnRank.LEFT, TurnRank.RIGHT))
        distance, rank = np.where(inside, 0.0, FAR), np.where(inside, own, 0).astype(np.float64)
        after = np.maximum(self._next, 0)
        enters = ~inside & (self._next >= 0) & inside[after]
        ruled = np.isin(np.arange(graph.lanes), graph.rule_lane)
        for _ in range(HOPS):
            ahead = np.where(self._next >= 0, distance[after], FAR)
            distance = np.where(inside, 0.0, np.minimum(self._length + ahead, FAR))
            more = np.where(enters & ruled, float(TurnRank.YIELD), 0.0)
            rank = np.where(inside, own, np.where(self._next >= 0, rank[after] + more, 0.0))
        return distance, rank

    def match(self, pose: F64) -> tuple[npt.NDArray[np.int64], F64, F64]:
        """The lane under each pose [n, 3] that goes its way.

        Returns:
            lane [n], -1 none; m along it [n]; m left of its centre line [n].
        """
        grid, n = self._grid, len(pose)
        lane, s, left = np.full(n, -1, np.int64), np.zeros(n), np.zeros(n)
        cell = np.floor((pose[:, :2] - np.array(grid.origin)) / CELL).astype(np.int64)
        known = np.flatnonzero(((cell >= 0) & (cell < [grid.nx, grid.ny])).all(1))
        cell = cell[known, 1] * grid.nx + cell[known, 0]
        count = (grid.cell_offset[cell + 1] - grid.cell_offset[cell]).astype(np.int64)
        owner = np.repeat(known, count)
        first = np.cumsum(count) - count
        pick = grid.cell_seg[np.arange(len(owner)) - np.repeat(first - grid.cell_offset[cell], count)]
        seg, half = grid.seg[pick].astype(np.float64), grid.seg_half[pick]
        dx, dy = seg[:, 2] - seg[:, 0], seg[:, 3] - seg[:, 1]
        px, py = pose[owner, 0] - seg[:, 0], pose[owner, 1] - seg[:, 1]
        square = np.maximum(dx * dx + dy * dy, 1e-12)
        t = np.clip((px * dx + py * dy) / square, 0.0, 1.0)
        away = np.hypot(px - t * dx, py - t * dy)
        fit = np.cos(pose[owner, 2] - self._yaw[pick])
        good = np.flatnonzero((fit > FITS) & (away <= half[:, 0] + t * (half[:, 1] - half[:, 0])))
        cost = away[good] + 4.0 * (1.0 - fit[good])
        good = good[np.lexsort((pick[good], cost, owner[good]))]
        good = good[np.concatenate([[True], np.diff(owner[good]) != 0])[: len(good)]]
        who = owner[good]
        lane[who] = grid.seg_lane[pick[good]]
        s[who] = grid.seg_s[pick[good]] + t[good] * np.sqrt(square[good])
        left[who] = np.copysign(away[good], dx[good] * py[good] - dy[good] * px[good])
        return lane, s, left

    def height(self, lane: npt.NDArray[np.int64], s: F64) -> F64:
        """Height [n] of places on lanes, m; NaN on none."""
        return np.where(lane >= 0, np.interp(np.maximum(lane, 0) * self._gap + s, self._axis, self.graph.z), np.nan)

    def ahead(self, lane: npt.NDArray[np.int64], s: F64) -> tuple[F64, I32]:
        """The first three columns of `Belief.way` [n, 3], and `Belief.line_signal` [n], for places on lanes."""
        on = np.maximum(lane, 0)
        inside = self.graph.junction[on] >= 0
        junction = np.where(inside, 0.0, np.minimum(np.maximum(self._junction[on] - s, 0.0), FAR))
        line, lamp = np.full(len(lane), FAR), np.full(len(lane), -1, np.int32)
        at, start = on.copy(), -s
        open_ = (lane >= 0) & ~inside
        for _ in range(HOPS):
            here = start + self._line[at]
            hit = open_ & (self._line[at] < FAR) & (here > -0.75)
            line[hit], lamp[hit] = here[hit], self._lamp[at[hit]]
            start = start + self._length[at]
            open_ &= ~hit & (self._next[at] >= 0)
            at = np.where(open_, self._next[at], at)
            open_ &= self.graph.junction[at] < 0
            if not open_.any():
                break
        out = np.stack([np.minimum(line, junction), junction, self._rank[on]], 1)
        return np.where((lane >= 0)[:, None], out, [FAR, FAR, float(TurnRank.STRAIGHT)]), lamp

    def follow(self, pose: F64, speed: F64, lane: npt.NDArray[np.int64], s: F64, left: F64) -> F64:
        """Forecasts [n, 8, 3] along lanes, at a steady speed and distance from their centre lines; else straight on."""
        go = speed[:, None] * float(STRIDE) * np.arange(1, int(HORIZON) + 1)
        heading = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], 1)
        out = np.empty((*go.shape, 3))
        out[..., :2] = pose[:, None, :2] + go[..., None] * heading[:, None]
        out[..., 2] = pose[:, 2:]
        along = np.flatnonzero((lane >= 0) & (speed > 0.1))
        at = np.repeat(np.maximum(lane[along], 0)[:, None], int(HORIZON), 1)
        where = s[along, None] + go[along]
        for _ in range(HOPS):
            over = (where > self._length[at]) & (self._next[at] >= 0)
            if not over.any():
                break
            where = np.where(over, where - self._length[at], where)
            at = np.where(over, self._next[at], at)
        graph = self.graph
        held = np.minimum(where, self._length[at])
        i = np.searchsorted(self._axis, at * self._gap + held, side="right") - 1
        i = np.clip(i, graph.offset[at], graph.offset[at + 1] - 2)
        x, y = graph.xy[:, 0].astype(np.float64), graph.xy[:, 1].astype(np.float64)
        dx, dy = x[i + 1] - x[i], y[i + 1] - y[i]
        length = np.maximum(np.hypot(dx, dy), 1e-9)
        rest = where - graph.s[i]  # beyond the end of the last lane: straight on
        yaw = np.arctan2(dy, dx)
        out[along, :, 0] = x[i] + rest * dx / length - left[along, None] * dy / length
        out[along, :, 1] = y[i] + rest * dy / length + left[along, None] * dx / length
        out[along, :, 2] = yaw
        return out


def _wrap(angle: Any) -> Any:
    """Angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def lanes_of(graphs: Mapping[str, LaneGraph], towns: Sequence[str], known: dict[str, Lanes]) -> list[Lanes]:
    """`Lanes` of each town; those that are not `known` yet are made and kept there."""
    for town in dict.fromkeys(towns):
        if town not in known:
            known[town] = Lanes(graphs[town])
    return [known[town] for town in towns]

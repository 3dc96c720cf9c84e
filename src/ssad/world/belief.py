"""Conversion of a belief into the planner's arrays: validates it and infers the open fields from the lanes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Belief
from ssad.core.errors import ConfigError
from ssad.core.geometry import to_local
from ssad.core.lane_graph import TURN, LaneGraph
from ssad.core.rotations import wrap_angle, wrap_scalar
from ssad.core.types import F32, F64, I32, AgentKind, Bool, LaneType, SignalState
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
    """Validate a belief.

    Args:
        belief: The belief [B, K].
        batch: B.
        signals: S.
        scenes: [B] mask of the scenes whose rows count.

    Raises:
        ConfigError: The belief does not fit; the message names the field.
    """
    kind = np.asarray(belief.kind)
    if kind.ndim != 2 or kind.shape[0] != batch:
        raise ConfigError(f"belief: kind has shape {kind.shape}; expected ({batch}, K): K objects in each scene")
    field_shapes: dict[str, tuple[int, ...]] = {"pose": (3,), "size": (2,), "change": (2,)}
    field_shapes |= {"forecast": (int(HORIZON), 3), "way": (4,)}
    occupied = (kind != AgentKind.NONE) & scenes[:, None]
    if not ((kind >= 0) & (kind < len(AgentKind)))[scenes].all():
        raise ConfigError(f"belief: kind must be an AgentKind, 0 to {len(AgentKind) - 1}")
    for field in fields(belief):
        value = getattr(belief, field.name)
        if value is None:
            continue
        value = np.asarray(value)
        scene_shapes = {"signal": (batch, signals), "stop_sign": (batch,)}
        expected = scene_shapes.get(field.name) or (*kind.shape, *field_shapes.get(field.name, ()))
        if value.shape != expected:
            raise ConfigError(f"belief: {field.name} has shape {value.shape}; expected {expected}")
        if field.name not in (*scene_shapes, "height") and not np.isfinite(value[occupied]).all():
            raise ConfigError(f"belief: {field.name} holds a number that is not finite")
    if not (np.asarray(belief.size)[occupied] > 0).all():
        raise ConfigError("belief: size must be above 0 m")
    if belief.stop_sign is not None and not np.isin(np.asarray(belief.stop_sign)[scenes], (0, 1)).all():
        raise ConfigError("belief: stop_sign must be 1 (known) or 0 (not known); None: all signs of the map are known")
    for name, value, limit in (
        ("signal", belief.signal, len(SignalState)),
        ("line_signal", belief.line_signal, signals),
    ):
        if value is not None:
            relevant: npt.NDArray[Any] = np.asarray(value)[scenes if name == "signal" else occupied]
            if not ((relevant >= -1) & (relevant < limit)).all():
                raise ConfigError(f"belief: {name} must lie between -1 and {limit - 1}")


def complete_belief(belief: Belief, lanes: Sequence[Lanes], scenes: Bool) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of `PerceivedAgents` [B, K, ...] for a validated belief.

    Args:
        belief: The belief [B, K].
        lanes: The lanes of each scene's town.
        scenes: [B] mask of the scenes to fill; rows of the others are undefined.

    Returns:
        Array by name.
    """
    kind = np.asarray(belief.kind, np.int32)
    occupied = (kind != AgentKind.NONE) & scenes[:, None]
    pose, speed = np.asarray(belief.pose, np.float32), np.asarray(belief.speed, np.float32)
    gives_way = np.isin(kind, VEHICLES) if belief.gives_way is None else np.asarray(belief.gives_way, bool)
    arrays: dict[str, npt.NDArray[Any]] = {
        "kind": kind,
        "pose": pose,
        "speed": speed,
        "half": np.float32(0.5) * np.asarray(belief.size, np.float32),
        "gives_way": gives_way.astype(np.int32),
    }
    forecast, junction_info, signal = belief.forecast, belief.way, belief.line_signal
    if forecast is None or junction_info is None or signal is None:
        inferred = _infer_forecasts(pose, speed, kind, arrays["half"][..., 0], gives_way, occupied, lanes, forecast)
        forecast = inferred[0] if forecast is None else forecast
        junction_info = inferred[1] if junction_info is None else junction_info
        signal = inferred[2] if signal is None else signal
    arrays["forecast"] = np.asarray(forecast, np.float32)
    arrays["way"] = np.asarray(junction_info, np.float32)
    arrays["signal"] = np.asarray(signal, np.int32)
    height = _lane_heights(pose, occupied, lanes) if belief.height is None else belief.height
    arrays["height"] = np.asarray(height, np.float32)
    arrays["waited"] = (
        np.zeros(kind.shape, np.float32)
        if belief.standing_time is None
        else np.asarray(belief.standing_time, np.float32)
    )
    change = np.zeros((*kind.shape, 2), np.int32) if belief.change is None else np.asarray(belief.change, np.int32)
    arrays["change"] = change
    positions = np.concatenate([pose[:, :, None, :2], arrays["forecast"][..., :2]], 2)
    # The bounding box by which the kernels rule out distant agents.
    arrays["span"] = np.concatenate([positions.min(2), positions.max(2)], -1)
    return arrays


def rest_times(
    now: Mapping[str, npt.NDArray[Any]], previous: Mapping[str, npt.NDArray[Any]], seconds: npt.NDArray[Any]
) -> F32:
    """Return how long objects have been at rest: as long as their place has been occupied.

    Args:
        now: `pose` [B, K, 3], `speed` and `kind` [B, K] of a belief.
        previous: The same of the belief before, [B, L], and `waited` [B, L] s there.
        seconds: [B] s from that one to this.

    Returns:
        [B, K] s; 0 for moving objects.
    """
    at_rest = [(belief["kind"] != AgentKind.NONE) & (np.abs(belief["speed"]) < RESTS) for belief in (now, previous)]
    distance = np.hypot(*np.moveaxis(now["pose"][:, :, None, :2] - previous["pose"][:, None, :, :2], -1, 0))
    is_same = at_rest[0][:, :, None] & at_rest[1][:, None] & (distance < SAME)
    accumulated = previous["waited"] + np.asarray(seconds)[:, None]
    durations: F32 = np.where(is_same, accumulated[:, None], 0.0).max(-1, initial=0.0).astype(np.float32)
    return durations


def _lane_heights(pose: F32, is_used: Bool, lanes: Sequence[Lanes]) -> F32:
    """[B, K] height of the lane under each object, NaN where it is on none that goes its way; 0 without bridges."""
    heights = np.zeros(is_used.shape, np.float32)
    for current_town in dict.fromkeys(town_lanes for town_lanes in lanes if town_lanes.hilly):
        scene, row = np.nonzero(is_used & np.array([town_lanes is current_town for town_lanes in lanes])[:, None])
        lane, s, _ = current_town.match(pose[scene, row].astype(np.float64))
        heights[scene, row] = current_town.height(lane, s)
    return heights


def _infer_forecasts(  # noqa: PLR0917
    pose: F32,
    speed: F32,
    kind: I32,
    half: F32,
    gives_way: Bool,
    is_used: Bool,
    lanes: Sequence[Lanes],
    forecasts: F32 | None,
) -> tuple[F32, F32, I32]:
    """Forecast [B, K, 8, 3], way [B, K, 4] and signal of the stop line [B, K], from what can be seen."""
    forecast = np.zeros((*kind.shape, int(HORIZON), 3), np.float32)
    junction_info = np.tile(np.array([FAR, FAR, float(TurnRank.STRAIGHT), 0.0], np.float32), (*kind.shape, 1))
    signal = np.full(kind.shape, -1, np.int32)
    for current_town in dict.fromkeys(lanes):
        scene, row = np.nonzero(is_used & np.array([town_lanes is current_town for town_lanes in lanes])[:, None])
        poses, expected_speed = pose[scene, row].astype(np.float64), speed[scene, row].astype(np.float64)
        lane, s, lateral = current_town.match(poses)
        lane[kind[scene, row] == AgentKind.WALKER] = -1
        lane[kind[scene, row] == AgentKind.PROP] = -1
        approach, signal[scene, row] = current_town.ahead(lane, s)
        # A vehicle that stands in a junction is expected to clear it, as in `kernels.belief`.
        in_junction = gives_way[scene, row] & (approach[:, 1] < half[scene, row] - 1.0)
        expected_speed = np.where(in_junction, np.maximum(expected_speed, float(CLEARING)), expected_speed)
        paths = current_town.follow(poses, expected_speed, lane, s, lateral)
        forecast[scene, row] = paths
        junction_info[scene, row, :3] = approach
        if forecasts is not None:
            paths = np.asarray(forecasts, np.float64)[scene, row]
        deviation = np.abs(to_local(poses[:, None], paths[..., :2])[..., 1]).max(-1, initial=0.0)
        junction_info[scene, row, 3] = np.where(deviation > 0.05, deviation + 0.5, 0.0)
    return forecast, junction_info, signal


class Lanes:
    """Driving lanes of a town, used to predict an object that follows the lane under it."""

    def __init__(self, graph: LaneGraph) -> None:
        self.graph = graph
        self._grid = grid_of(graph, DRIVABLE)
        segments = self._grid.seg
        self._yaw = np.arctan2(segments[:, 3] - segments[:, 1], segments[:, 2] - segments[:, 0])
        count = graph.lane_count
        first_vertices, last_vertices = graph.offset[:-1], graph.offset[1:] - 1
        self._next = np.full(count, -1, np.int64)
        for lane in range(count):
            successors = [
                successor for successor in graph.successors(lane).tolist() if graph.kind[successor] == LaneType.DRIVING
            ]
            heading_changes = [
                abs(wrap_scalar(float(graph.yaw[last_vertices[successor]] - graph.yaw[last_vertices[lane]])))
                for successor in successors
            ]
            if successors:
                # Without knowing the intention, assume the successor that turns least.
                self._next[lane] = successors[int(np.argmin(heading_changes))]
        self._length = graph.length.astype(np.float64)
        # places of all lanes on one axis, so that one search finds them
        self._gap = float(self._length.max()) + 10.0
        owners = np.repeat(np.arange(count), np.diff(graph.offset))
        self._axis = owners * self._gap + graph.s.astype(np.float64)
        self.hilly = bool(np.ptp(graph.z) > BRIDGE)
        self._line = np.full(count, FAR)
        self._lamp = np.full(count, -1, np.int32)
        for row in range(len(graph.stop_lane)):
            self._line[graph.stop_lane[row]] = graph.stop_s[row]
            self._lamp[graph.stop_lane[row]] = graph.stop_signal[row]
        self._junction, self._rank = self._to_junction(first_vertices, last_vertices)

    def _to_junction(self, first: I32, last: I32) -> tuple[F64, F64]:
        """For every lane: m from its start to the next junction (0 inside, FAR: none), and `TurnRank` there."""
        graph = self.graph
        in_junction = graph.junction >= 0
        heading_change = wrap_angle((graph.yaw[last] - graph.yaw[first]).astype(np.float64))
        turn_rank = np.where(
            np.abs(heading_change) < TURN,
            TurnRank.STRAIGHT,
            np.where((heading_change > 0) ^ bool(graph.left_hand[0]), TurnRank.LEFT, TurnRank.RIGHT),
        )
        distance, rank_ahead = np.where(in_junction, 0.0, FAR), np.where(in_junction, turn_rank, 0).astype(np.float64)
        successor = np.maximum(self._next, 0)
        enters_junction = ~in_junction & (self._next >= 0) & in_junction[successor]
        signed = np.isin(np.arange(graph.lane_count), graph.rule_lane)
        # Each round looks one lane further ahead.
        for _ in range(HOPS):
            remaining = np.where(self._next >= 0, distance[successor], FAR)
            distance = np.where(in_junction, 0.0, np.minimum(self._length + remaining, FAR))
            yield_rank = np.where(enters_junction & signed, float(TurnRank.YIELD), 0.0)
            rank_ahead = np.where(
                in_junction, turn_rank, np.where(self._next >= 0, rank_ahead[successor] + yield_rank, 0.0)
            )
        return distance, rank_ahead

    def match(self, pose: F64) -> tuple[npt.NDArray[np.int64], F64, F64]:
        """Match each pose [n, 3] to the lane under it that runs in its direction.

        Returns:
            lane [n], -1: none; distance along it [n], m; distance left of its centre line [n], m.
        """
        grid, pose_count = self._grid, len(pose)
        lane, along, lateral = np.full(pose_count, -1, np.int64), np.zeros(pose_count), np.zeros(pose_count)
        cell = np.floor((pose[:, :2] - np.array(grid.origin)) / CELL).astype(np.int64)
        candidates = np.flatnonzero(((cell >= 0) & (cell < [grid.nx, grid.ny])).all(1))
        cell = cell[candidates, 1] * grid.nx + cell[candidates, 0]
        segment_count = (grid.cell_offset[cell + 1] - grid.cell_offset[cell]).astype(np.int64)
        owner = np.repeat(candidates, segment_count)
        first_row = np.cumsum(segment_count) - segment_count
        segment_rows = grid.cell_seg[
            np.arange(len(owner)) - np.repeat(first_row - grid.cell_offset[cell], segment_count)
        ]
        segments, half_widths = grid.seg[segment_rows].astype(np.float64), grid.seg_half[segment_rows]
        dx, dy = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
        px, py = pose[owner, 0] - segments[:, 0], pose[owner, 1] - segments[:, 1]
        squared_length = np.maximum(dx * dx + dy * dy, 1e-12)
        share = np.clip((px * dx + py * dy) / squared_length, 0.0, 1.0)
        distance = np.hypot(px - share * dx, py - share * dy)
        alignment = np.cos(pose[owner, 2] - self._yaw[segment_rows])
        valid = np.flatnonzero(
            (alignment > FITS) & (distance <= half_widths[:, 0] + share * (half_widths[:, 1] - half_widths[:, 0]))
        )
        # Where lanes overlap in a junction, the heading tells them apart better than the distance.
        cost = distance[valid] + 4.0 * (1.0 - alignment[valid])
        valid = valid[np.lexsort((segment_rows[valid], cost, owner[valid]))]
        valid = valid[np.concatenate([[True], np.diff(owner[valid]) != 0])[: len(valid)]]
        matched_lanes = owner[valid]
        lane[matched_lanes] = grid.seg_lane[segment_rows[valid]]
        along[matched_lanes] = grid.seg_s[segment_rows[valid]] + share[valid] * np.sqrt(squared_length[valid])
        lateral[matched_lanes] = np.copysign(distance[valid], dx[valid] * py[valid] - dy[valid] * px[valid])
        return lane, along, lateral

    def height(self, lane: npt.NDArray[np.int64], s: F64) -> F64:
        """Return the height [n] of places on lanes, m; NaN where the lane is -1."""
        return np.where(lane >= 0, np.interp(np.maximum(lane, 0) * self._gap + s, self._axis, self.graph.z), np.nan)

    def ahead(self, lane: npt.NDArray[np.int64], s: F64) -> tuple[F64, I32]:
        """Return the first three columns of `Belief.way` [n, 3] and `Belief.line_signal` [n] for places on lanes."""
        valid_lane = np.maximum(lane, 0)
        in_junction = self.graph.junction[valid_lane] >= 0
        junction = np.where(in_junction, 0.0, np.minimum(np.maximum(self._junction[valid_lane] - s, 0.0), FAR))
        line_distance, signal = np.full(len(lane), FAR), np.full(len(lane), -1, np.int32)
        current, offset = valid_lane.copy(), -s
        searching = (lane >= 0) & ~in_junction
        for _ in range(HOPS):
            position = offset + self._line[current]
            reached = searching & (self._line[current] < FAR) & (position > -0.75)
            line_distance[reached], signal[reached] = position[reached], self._lamp[current[reached]]
            offset = offset + self._length[current]
            searching &= ~reached & (self._next[current] >= 0)
            current = np.where(searching, self._next[current], current)
            searching &= self.graph.junction[current] < 0
            if not searching.any():
                break
        approach = np.stack([np.minimum(line_distance, junction), junction, self._rank[valid_lane]], 1)
        return np.where((lane >= 0)[:, None], approach, [FAR, FAR, float(TurnRank.STRAIGHT)]), signal

    def follow(self, pose: F64, speed: F64, lane: npt.NDArray[np.int64], s: F64, left: F64) -> F64:
        """Forecast poses [n, 8, 3] along lanes at constant speed and lateral offset; off the lanes straight ahead."""
        travel = speed[:, None] * float(STRIDE) * np.arange(1, int(HORIZON) + 1)
        heading = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], 1)
        forecasts = np.empty((*travel.shape, 3))
        forecasts[..., :2] = pose[:, None, :2] + travel[..., None] * heading[:, None]
        forecasts[..., 2] = pose[:, 2:]
        on_lane = np.flatnonzero((lane >= 0) & (speed > 0.1))
        lane_at = np.repeat(np.maximum(lane[on_lane], 0)[:, None], int(HORIZON), 1)
        position = s[on_lane, None] + travel[on_lane]
        for _ in range(HOPS):
            beyond_end = (position > self._length[lane_at]) & (self._next[lane_at] >= 0)
            if not beyond_end.any():
                break
            position = np.where(beyond_end, position - self._length[lane_at], position)
            lane_at = np.where(beyond_end, self._next[lane_at], lane_at)
        graph = self.graph
        clamped = np.minimum(position, self._length[lane_at])
        vertex = np.searchsorted(self._axis, lane_at * self._gap + clamped, side="right") - 1
        vertex = np.clip(vertex, graph.offset[lane_at], graph.offset[lane_at + 1] - 2)
        x, y = graph.xy[:, 0].astype(np.float64), graph.xy[:, 1].astype(np.float64)
        dx, dy = x[vertex + 1] - x[vertex], y[vertex + 1] - y[vertex]
        length = np.maximum(np.hypot(dx, dy), 1e-9)
        remainder = position - graph.s[vertex]  # beyond the end of the last lane: straight on
        yaw = np.arctan2(dy, dx)
        forecasts[on_lane, :, 0] = x[vertex] + remainder * dx / length - left[on_lane, None] * dy / length
        forecasts[on_lane, :, 1] = y[vertex] + remainder * dy / length + left[on_lane, None] * dx / length
        forecasts[on_lane, :, 2] = yaw
        return forecasts


def lanes_of(graphs: Mapping[str, LaneGraph], towns: Sequence[str], cache: dict[str, Lanes]) -> list[Lanes]:
    """Return the `Lanes` of each town; missing ones are built and stored in `cache`."""
    for town in dict.fromkeys(towns):
        if town not in cache:
            cache[town] = Lanes(graphs[town])
    return [cache[town] for town in towns]

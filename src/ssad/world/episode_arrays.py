"""From episodes and lane graphs to the arrays that the kernels read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import warp as wp

from ssad.core.driving import RoadTables
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.lane_graph import LaneGraph, Marking, SignKind
from ssad.core.types import F32, I32, AgentKind, Controller, Episode, EpisodeAgent, LaneType, Model, Route
from ssad.world.kernels.data import FAR, ContactPolicy, EpisodeArrays, Roads, TurnRank, When, array_types
from ssad.world.kernels.shared import BRIDGE
from ssad.world.roads.query import CELL, DRIVABLE, grid_of

MAX_AGENTS = 63  # contacts are kept as one bit an agent
LATERAL_COMFORT = 2.5  # m/s^2 in bends, sets the speed profile of a route
SLOW_DOWN = 2.0  # m/s^2 at which a route's speed profile falls towards a bend
CAREFUL = 6.0  # m/s at most into a turn without a signal
BEFORE = 15  # points of a route before a junction between which its stop line lies
GREEN, YELLOW, ALL_RED = 12.0, 3.0, 1.0  # s of a signal phase
ON_AND_ON = 1000.0  # m that a lane goes on beyond the end of a route
FADE = 30  # m over which a lane that ends is led back to the route
TURN = np.deg2rad(25.0)  # heading change over a junction that makes it a turn


@dataclass(frozen=True)
class PathTable:
    """A route as the kernels want it.

    Attributes:
        path: [N, 4] x, y, yaw, curvature.
        rule: [N, 4] speed cap m/s, m to the next stop line, m to the next junction (0 inside), TurnRank there.
        signal: [N] of the next stop line, -1 none.
        bend: [N] m that the next 64 m leave the straight line along the point's heading.
        ahead: [N, 3] m to the line of the next stop sign and the route point there (FAR: none), m to the end of the
            next junction.
        height: [N] m.
        lane: [N] of the town, -1 none.
        beside: [N, 4] as in `Roads`.
        town: Name of the town.
    """

    path: F32
    rule: F32
    signal: npt.NDArray[np.int32]
    bend: F32
    ahead: F32
    height: F32
    lane: npt.NDArray[np.int32]
    beside: F32
    town: str


def _bend(route: Route) -> F32:
    """[N] greatest lateral distance of the next 64 m of path from the line through each point along its heading."""
    x, y = np.pad(route.xy, ((0, 64), (0, 0)), mode="edge").T
    n, c, s = len(route.xy), np.cos(route.yaw), np.sin(route.yaw)
    out = np.zeros(n, np.float32)
    for k in range(1, 65):
        np.maximum(out, np.abs((y[k : n + k] - y[:n]) * c - (x[k : n + k] - x[:n]) * s), out=out)
    return out


def path_table(route: Route, graph: LaneGraph) -> PathTable:
    """Curvature, speed profile, stop lines and junctions along a route of at least two points."""
    n = len(route.xy)
    yaw = np.unwrap(route.yaw.astype(np.float64))
    kappa = np.gradient(yaw, route.spacing) if n > 2 else np.zeros(n)
    kernel = np.ones(3) / 3.0
    smooth = np.convolve(np.pad(kappa, 1, mode="edge"), kernel, mode="valid")
    cap = np.minimum(route.speed_limit, np.sqrt(LATERAL_COMFORT / np.maximum(np.abs(smooth), 1e-4)))
    entry, leave, rank = _junctions(route, graph, yaw)
    stop, signal = _next_line(route, graph, graph.stop_lane, graph.stop_s, graph.stop_signal)
    # who turns where no signal tells when comes slowly
    lit = np.append(~graph.signal_virtual, False)[signal]
    enters = np.flatnonzero((entry[1:] == 0.0) & (entry[:-1] > 0.0) & (rank[:-1] % TurnRank.YIELD != TurnRank.STRAIGHT))
    before = np.maximum(enters - BEFORE, 0)
    free = enters[~lit[before] | (stop[before] > entry[before] + 3.0)]
    cap[free] = np.minimum(cap[free], CAREFUL)
    # v^2 may fall by 2 a a metre: the least over all points ahead, in one sweep
    fall = 2.0 * SLOW_DOWN * route.spacing * np.arange(n)
    cap = np.sqrt(np.minimum.accumulate((cap.astype(np.float64) ** 2 + fall)[::-1])[::-1] - fall)
    signs = graph.sign_kind[graph.rule_sign] == SignKind.STOP
    distance, _ = _next_line(route, graph, graph.rule_lane[signs], graph.rule_s[signs], graph.rule_sign[signs])
    line = np.floor(np.arange(n) * route.spacing + distance + 0.5)
    path = np.stack([route.xy[:, 0], route.xy[:, 1], route.yaw, smooth], 1)
    return PathTable(
        path.astype(np.float32),
        np.stack([cap, stop, entry, rank], 1).astype(np.float32),
        signal,
        _bend(route),
        np.stack([distance, line, leave], 1).astype(np.float32),
        _height(route, graph),
        route.lane.astype(np.int32),
        _beside(route, graph),
        graph.name,
    )


def _next_line(
    route: Route, graph: LaneGraph, lanes: I32, along: F32, what: I32
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
    """M from every route point to the next line (FAR: none) and what stands there (-1: nothing).

    Lines lie across `lanes` at the arc lengths `along`; a route may come past one more than once.
    """
    distance, found = np.full(len(route.xy), FAR), np.full(len(route.xy), -1, np.int32)
    marks: list[tuple[float, int]] = []
    for k in np.flatnonzero(np.isin(lanes, route.lane)).tolist():
        lane = int(lanes[k])
        on = np.flatnonzero(route.lane == lane)
        a, b = int(graph.offset[lane]), int(graph.offset[lane + 1])
        at = [np.interp(along[k], graph.s[a:b], graph.xy[a:b, d]) for d in (0, 1)]
        for visit in np.split(on, np.flatnonzero(np.diff(on) > 1) + 1):
            i = int(visit[np.argmin(np.hypot(*(route.xy[visit] - at).T))])
            c, s = np.cos(route.yaw[i]), np.sin(route.yaw[i])
            ahead = (at[0] - route.xy[i, 0]) * c + (at[1] - route.xy[i, 1]) * s
            marks.append((i * route.spacing + float(ahead), int(what[k])))
    u = np.arange(len(route.xy)) * route.spacing
    for position, index in sorted(marks, reverse=True):
        before = u <= position + 0.75
        distance[before] = position - u[before]
        found[before] = index
    return distance, found


def _junctions(
    route: Route, graph: LaneGraph, yaw: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Distances to the next junction and to its end, and turn rank there, for every route point."""
    ruled = set(graph.rule_lane.tolist())
    n = len(route.xy)
    inside = np.zeros(n, bool)
    known = route.lane >= 0
    inside[known] = graph.junction[route.lane[known]] >= 0
    entry, leave = np.full(n, FAR), np.full(n, FAR)
    rank = np.zeros(n)
    edge = np.diff(np.concatenate([[0], inside.astype(np.int8), [0]]))
    runs = zip(np.flatnonzero(edge == 1).tolist(), np.flatnonzero(edge == -1).tolist(), strict=True)
    for start, stop in reversed(list(runs)):
        turn = yaw[min(stop, n - 1)] - yaw[max(start - 1, 0)]
        kind = int(TurnRank.STRAIGHT) if abs(turn) < TURN else (TurnRank.LEFT if turn > 0 else TurnRank.RIGHT)
        if start > 0 and int(route.lane[start - 1]) in ruled:
            kind += TurnRank.YIELD
        entry[: start + 1] = (start - np.arange(start + 1)) * route.spacing
        leave[:stop] = (stop - np.arange(stop)) * route.spacing
        rank[: start + 1] = kind
        entry[start:stop] = 0.0
        rank[start:stop] = kind
    return entry, leave, rank


def _height(route: Route, graph: LaneGraph) -> F32:
    """[N] height of the lane under each point of a route; 0 where the town has no bridge."""
    out = np.zeros(len(route.xy), np.float32)
    if np.ptp(graph.z) > BRIDGE:
        for lane in np.unique(route.lane[route.lane >= 0]).tolist():
            part, span = np.flatnonzero(route.lane == lane), graph.points(lane)
            away = route.xy[part, None] - graph.xy[span]
            out[part] = graph.z[span][(away**2).sum(-1).argmin(1)]
        out[route.lane < 0] = np.nan
    return out


def _lane_left(
    route: Route, part: npt.NDArray[np.intp], graph: LaneGraph, lane: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """How far the centre of a lane is to the left of some points of a route (negative: right), and its width there."""
    span = graph.points(lane)
    x, y = graph.xy[span].astype(np.float64).T
    step_x, step_y = np.diff(x), np.diff(y)
    from_x, from_y = (route.xy[part, d, None].astype(np.float64) - v[:-1] for d, v in enumerate((x, y)))
    t = np.clip((from_x * step_x + from_y * step_y) / np.maximum(step_x**2 + step_y**2, 1e-12), 0.0, 1.0)
    off_x, off_y = from_x - t * step_x, from_y - t * step_y
    rows, best = np.arange(len(part)), (off_x**2 + off_y**2).argmin(1)
    t, off_x, off_y = t[rows, best], off_x[rows, best], off_y[rows, best]
    width = graph.width[span].astype(np.float64)
    yaw = route.yaw[part].astype(np.float64)
    left = off_x * np.sin(yaw) - off_y * np.cos(yaw)
    return np.copysign(np.hypot(off_x, off_y), left), width[best] + t * (width[best + 1] - width[best])


def _beside(route: Route, graph: LaneGraph) -> F32:
    """Lanes to both sides that a vehicle may use: `Roads.beside`.

    To the left a lane of the same direction or, where the line may be crossed, an oncoming one; to the right only one
    of the same direction. A lane is given up where a junction begins. Where the route ends, a lane of the same
    direction goes on.
    """
    n = len(route.xy)
    out = np.zeros((n, 4))
    edges = np.flatnonzero(np.diff(route.lane)) + 1
    for part in np.split(np.arange(n), edges):
        lane = int(route.lane[part[0]])
        if lane < 0 or graph.junction[lane] >= 0 or graph.kind[lane] != LaneType.DRIVING:
            continue
        for column, other, marking in (
            (0, int(graph.left[lane]), int(graph.left_marking[lane])),
            (2, int(graph.right[lane]), int(graph.right_marking[lane])),
        ):
            if other < 0 or graph.kind[other] != LaneType.DRIVING or marking not in (Marking.NONE, Marking.BROKEN):
                continue
            same = graph.same_direction(lane, other)
            if column == 2 and not same:
                continue
            away, width = _lane_left(route, part, graph, other)
            # not where the route itself changes lane
            there = np.abs(np.abs(away) - 0.5 * (route.width[part] + width)) < 0.4
            out[part, column] = np.where(there, np.abs(away), 0.0)
            out[part, column + 1] = 1.0 if same else -1.0
    for column in (0, 2):
        away, way = out[:, column].copy(), out[:, column + 1].copy()
        goes_on = (away[1:] != 0.0) & (np.abs(np.diff(away)) < 0.3) & (way[:-1] == way[1:])
        run = ON_AND_ON if way[-1] > 0.0 else 0.0
        runs = [run if away[-1] != 0.0 else 0.0]
        for there, on in zip((away[-2::-1] != 0.0).tolist(), goes_on[::-1].tolist(), strict=True):
            runs.append(runs[-1] + route.spacing if there and on else 0.0)
        out[:, column + 1] = way * runs[::-1]
        # who has not come back in time is led back to the route
        for k in np.flatnonzero((away[:-1] != 0.0) & (away[1:] == 0.0)).tolist():
            fade = np.arange(1, min(FADE, n - 1 - k) + 1)
            rest = away[k + 1 : k + 1 + len(fade)] == 0.0
            stop = len(fade) if rest.all() else int(np.argmin(rest))
            out[k + 1 : k + 1 + stop, column] = away[k] * (1.0 - fade[:stop] / FADE)
    return out.astype(np.float32)


def signal_programs(graph: LaneGraph) -> F32:
    """[S, 4] cycle, start of green, green, yellow in s: a junction's phases take turns; virtual signals are off."""
    out = np.zeros((len(graph.signal_phase), 4), np.float32)
    for order, junction in enumerate(np.unique(graph.signal_junction)):
        mine = np.flatnonzero((graph.signal_junction == junction) & ~graph.signal_virtual)
        phases = {int(p): k for k, p in enumerate(np.unique(graph.signal_phase[mine]).tolist())}
        one = GREEN + YELLOW + ALL_RED
        cycle = one * max(len(phases), 2)  # a lone phase still shows red now and then
        for s in mine:
            begin = (phases[int(graph.signal_phase[s])] * one + 5.0 * order) % cycle
            out[s] = cycle, begin, GREEN, YELLOW
    return out


@dataclass
class _Pool:
    """Routes of all agents, each stored once."""

    tables: list[PathTable] = field(default_factory=list)
    size: int = 0
    where: dict[tuple[str, bytes], tuple[int, int]] = field(default_factory=dict)
    tracks: list[tuple[float, float, float, float]] = field(default_factory=list)

    def add(self, route: Route, graph: LaneGraph) -> tuple[int, int]:
        key = (graph.name, route.xy.tobytes() + route.speed_limit.tobytes())
        if key not in self.where:
            table = path_table(route, graph)
            self.tables.append(table)
            self.where[key] = (self.size, len(table.path))
            self.size += len(table.path)
        return self.where[key]

    def follow(self, agent: EpisodeAgent) -> tuple[int, int]:
        """First row and number of rows of an agent's trajectory."""
        first = len(self.tracks)
        self.tracks += agent.trajectory
        return first, len(agent.trajectory)


def _check(episode: Episode) -> None:
    if not episode.agents:
        raise ConfigError(f"episode {episode.key}: no agents; agent 0 must be the ego")
    if len(episode.agents) > MAX_AGENTS:
        raise ConfigError(f"episode {episode.key}: {len(episode.agents)} agents, at most {MAX_AGENTS}")
    route = episode.agents[0].route
    if route is None or len(route.xy) < 2:
        raise ConfigError(f"episode {episode.key}: the ego needs a route of at least two points")


def _put_agent(  # noqa: PLR0917
    a: dict[str, npt.NDArray[np.generic]],
    e: int,
    i: int,
    agent: EpisodeAgent,
    names: dict[str, int],
    route: tuple[int, int],
    track: tuple[int, int],
) -> None:
    if agent.model not in names:
        raise unknown_name("model", agent.model, names)
    a["model"][e, i] = names[agent.model]
    a["controller"][e, i] = int(agent.controller)
    a["start"][e, i] = agent.pose.x, agent.pose.y, agent.pose.yaw, agent.speed
    a["cruise"][e, i] = agent.target_speed, agent.wake_distance
    a["route"][e, i] = route
    a["track"][e, i] = track
    a["phase_count"][e, i] = len(agent.phases)
    for k, phase in enumerate(agent.phases):
        a["phase_when"][e, i, k] = When[phase.when.kind.upper()], phase.when.value, phase.when.actor + 1
        a["phase_speed"][e, i, k] = phase.speed


@dataclass(frozen=True)
class Bank:
    """What does not change while a world runs: for the kernels, and for `WorldState`.

    kind [E, A] AgentKind of every slot, size [E, A, 2] length and width m, route [E, A, 2] as in `EpisodeArrays`;
    program [E, S, 4] of the town's signals and forced [E, S] states (-1 none) until [E] s.
    """

    episodes: EpisodeArrays
    roads: Roads
    tables: RoadTables
    agents: int
    kind: npt.NDArray[np.int32]
    size: F32
    route: npt.NDArray[np.int32]
    program: npt.NDArray[np.float64]
    forced: npt.NDArray[np.int32]
    until: F32


def build(
    episodes: Sequence[Episode],
    graphs: Mapping[str, LaneGraph],
    device: str,
    ego: Controller | None,
    models: Mapping[str, Model],
) -> Bank:
    """Arrays of all episodes on `device`.

    `ego` replaces the egos' controller.
    """
    if not episodes:
        raise ConfigError("a world needs at least one episode")
    for episode in episodes:
        _check(episode)
    towns = sorted({e.town for e in episodes})
    count = max(len(e.agents) for e in episodes)
    phases = max(1, *(len(a.phases) for e in episodes for a in e.agents))
    signals = max(1, *(len(graphs[t].signal_phase) for t in towns))
    names = {name: k for k, name in enumerate(models)}
    shape = (len(episodes), count)
    a: dict[str, npt.NDArray[np.generic]] = {
        "model": np.full(shape, -1, np.int32),
        "controller": np.zeros(shape, np.int32),
        "start": np.zeros((*shape, 4), np.float32),
        "cruise": np.zeros((*shape, 2), np.float32),
        "route": np.zeros((*shape, 2), np.int32),
        "track": np.zeros((*shape, 2), np.int32),
        "phase_count": np.zeros(shape, np.int32),
        "phase_when": np.zeros((*shape, phases, 3), np.float32),
        "phase_speed": np.zeros((*shape, phases), np.float32),
        "town": np.zeros(len(episodes), np.int32),
        "signal": np.full((len(episodes), signals), -1, np.int32),
        "limits": np.zeros((len(episodes), 4), np.float32),
        "contact": np.zeros(len(episodes), np.int32),
    }
    pool = _Pool()
    for e, episode in enumerate(episodes):
        graph = graphs[episode.town]
        for i, agent in enumerate(episode.agents):
            route = (0, 0)
            if agent.route is not None and len(agent.route.xy) > 1:
                route = pool.add(agent.route, graph)
            _put_agent(a, e, i, agent, names, route, pool.follow(agent))
        if ego is not None:
            a["controller"][e, 0] = int(ego)
        a["town"][e] = towns.index(episode.town)
        for index, state in episode.signal_override.items():
            a["signal"][e, index] = int(state)
        limits = episode.limits
        a["contact"][e] = ContactPolicy[limits.contact.upper()]
        a["limits"][e] = limits.max_steps, limits.max_time, limits.max_distance, episode.override_until
    body = [(m.length / 2, m.width / 2, max(m.wheelbase, 0.1), m.max_steer) for m in models.values()]
    power = [(m.max_accel, m.max_brake, m.max_speed, 0.0) for m in models.values()]
    a["kind"] = np.array([int(m.kind) for m in models.values()], np.int32)
    a["body"] = np.array(body, np.float32)
    a["power"] = np.array(power, np.float32)
    bank = EpisodeArrays()
    for name, array in array_types(EpisodeArrays).items():
        setattr(bank, name, wp.array(a[name], dtype=array.dtype, device=device))
    found = [graphs[t] for t in towns]
    program = np.zeros((len(towns), signals, 4))
    for k, graph in enumerate(found):
        program[k, : len(graph.signal_phase)] = signal_programs(graph)
    rows = np.asarray(a["model"])
    return Bank(
        bank,
        _roads(found, pool, device),
        _tables(found, pool),
        count,
        np.where(rows < 0, int(AgentKind.NONE), np.asarray(a["kind"])[np.maximum(rows, 0)]).astype(np.int32),
        (2 * np.asarray(a["body"])[np.maximum(rows, 0), :2]).astype(np.float32),
        np.asarray(a["route"]),
        program[np.asarray(a["town"])],
        np.asarray(a["signal"]),
        np.asarray(a["limits"])[:, 3],
    )


def _tables(graphs: Sequence[LaneGraph], pool: _Pool) -> RoadTables:
    """The same routes for the host; lanes are counted over all towns, as in `Roads`."""
    first = dict(zip([g.name for g in graphs], np.cumsum([0, *(len(g.kind) for g in graphs)]), strict=False))

    def shifted(lanes: npt.NDArray[np.int32], town: str) -> npt.NDArray[np.int32]:
        return np.where(lanes >= 0, lanes + first[town], -1).astype(np.int32)

    return RoadTables(
        path=np.concatenate([t.path for t in pool.tables]),
        rule=np.concatenate([t.rule for t in pool.tables]),
        signal=np.concatenate([t.signal for t in pool.tables]),
        lane=np.concatenate([shifted(t.lane, t.town) for t in pool.tables]),
        left=np.concatenate([shifted(g.left, g.name) for g in graphs]),
        right=np.concatenate([shifted(g.right, g.name) for g in graphs]),
        side=np.concatenate([np.sign(g.lane_id).astype(np.int32) for g in graphs]),
        junction=np.concatenate([g.junction >= 0 for g in graphs]),
    )


def _roads(graphs: Sequence[LaneGraph], pool: _Pool, device: str) -> Roads:
    parts: dict[str, list[npt.NDArray[np.generic]]] = {name: [] for name in array_types(Roads)}
    segments = lanes = cells = entries = signals = 0
    for graph in graphs:
        grid = grid_of(graph, DRIVABLE)  # only lanes that a car may be on count as road under its centre
        parts["segment"].append(grid.seg)
        parts["segment_half"].append(grid.seg_half)
        parts["segment_lane"].append(grid.seg_lane + lanes)
        parts["lane_junction"].append((graph.junction >= 0).astype(np.int32))
        parts["cell_first"].append(grid.cell_offset + entries)
        parts["cell_segment"].append(grid.cell_seg + segments)
        parts["grid"].append(np.array([[*grid.origin, 1.0 / CELL, 0.0]]))
        parts["grid_size"].append(np.array([[grid.nx, grid.ny, cells]]))
        parts["signal_first"].append(np.array([signals]))
        parts["signal_program"].append(signal_programs(graph))
        segments += len(grid.seg)
        lanes += len(graph.kind)
        cells += len(grid.cell_offset)
        entries += len(grid.cell_seg)
        signals += len(graph.signal_phase)
    roads = Roads()
    parts["path"] = [t.path for t in pool.tables]
    parts["rule"] = [t.rule for t in pool.tables]
    parts["height"] = [t.height for t in pool.tables]
    parts["path_signal"] = [t.signal for t in pool.tables]
    parts["bend"] = [t.bend for t in pool.tables]
    parts["track"] = [np.array(pool.tracks or [(0.0,) * 4])]
    parts["beside"] = [t.beside for t in pool.tables]
    parts["ahead"] = [t.ahead for t in pool.tables]
    for name, array in array_types(Roads).items():
        joined = np.concatenate(parts[name])
        if len(joined) == 0:  # a town without signals
            joined = np.zeros((1, *joined.shape[1:]), joined.dtype)
        setattr(roads, name, wp.array(np.ascontiguousarray(joined), dtype=array.dtype, device=device))
    return roads

"""Conversion of episodes and lane graphs into the arrays that the kernels read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import warp as wp

from ssad.core.driving import RoadTables
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import TURN, LaneGraph, Marking, SignKind
from ssad.core.types import F32, I8, I32, AgentKind, Controller, Episode, EpisodeAgent, LaneType, Model, Route
from ssad.world.kernels.data import FAR, ContactPolicy, EpisodeArrays, Roads, Scripts, TurnRank, Walkers, array_types
from ssad.world.kernels.shared import BRIDGE
from ssad.world.models import GRAVITY, agent_model, lateral_grip
from ssad.world.roads.query import CELL, DRIVABLE, grid_of
from ssad.world.scripts import ScriptTables
from ssad.world.turn_signals import turn_sides
from ssad.world.walkers import build_walkers, has_walkers

MAX_AGENTS = 63  # contacts are kept as one bit an agent
LATERAL_COMFORT = 2.5  # m/s^2 in bends, sets the speed profile of a route
SLOW_DOWN = 2.0  # m/s^2 at which a route's speed profile falls towards a bend
CAREFUL = 6.0  # m/s at most into a turn without a signal
BEFORE = 15  # points of a route before a junction between which its stop line lies
GREEN, YELLOW, ALL_RED = 12.0, 3.0, 1.0  # s of a signal phase
ON_AND_ON = 1000.0  # m that a lane goes on beyond the end of a route
LONGEST = 5.2  # m, half length of the longest body that every episode reckons with
FADE = 30  # m over which a lane that ends is led back to the route


@dataclass(frozen=True)
class PathTable:
    """Arrays of one route, as the kernels read them.

    Attributes:
        path: [N, 4] x, y, yaw, curvature.
        rule: [N, 4] speed cap m/s, m to the next stop line, m to the next junction (0 inside), TurnRank there.
        signal: [N] signal of the next stop line, -1: none.
        bend: [N] m by which the next 64 m leave the straight line along the point's heading.
        ahead: [N, 3] m to the line of the next stop sign and the route point there (FAR: none), m to the end of the
            next junction.
        height: [N] m.
        lane: [N] lane of the town, -1: none.
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
    """Return the largest lateral distance [N] of the next 64 m of path from the tangent at each point."""
    x, y = np.pad(route.xy, ((0, 64), (0, 0)), mode="edge").T
    count, cos, sin = len(route.xy), np.cos(route.yaw), np.sin(route.yaw)
    deviation = np.zeros(count, np.float32)
    for shift in range(1, 65):
        np.maximum(
            deviation,
            np.abs((y[shift : count + shift] - y[:count]) * cos - (x[shift : count + shift] - x[:count]) * sin),
            out=deviation,
        )
    return deviation


def path_table(route: Route, graph: LaneGraph) -> PathTable:
    """Compute curvature, speed profile, stop lines and junctions along a route of at least two points."""
    count = len(route.xy)
    yaw = np.unwrap(route.yaw.astype(np.float64))
    curvature = np.gradient(yaw, route.spacing) if count > 2 else np.zeros(count)
    kernel = np.ones(3) / 3.0
    smooth_curvature = np.convolve(np.pad(curvature, 1, mode="edge"), kernel, mode="valid")
    speed_cap = np.minimum(route.speed_limit, np.sqrt(LATERAL_COMFORT / np.maximum(np.abs(smooth_curvature), 1e-4)))
    entry_distance, exit_distance, turn_rank = _junctions(route, graph, yaw)
    line_distance, signal = _next_line(route, graph, graph.stop_lane, graph.stop_s, graph.stop_signal)
    # Turns without a signal are approached slowly, because nothing else grants the right of way.
    signalled = np.append(~graph.signal_virtual, False)[signal]
    entry_points = np.flatnonzero(
        (entry_distance[1:] == 0.0)
        & (entry_distance[:-1] > 0.0)
        & (turn_rank[:-1] % TurnRank.YIELD != TurnRank.STRAIGHT)
    )
    approach_points = np.maximum(entry_points - BEFORE, 0)
    unsignalled = entry_points[
        ~signalled[approach_points] | (line_distance[approach_points] > entry_distance[approach_points] + 3.0)
    ]
    speed_cap[unsignalled] = np.minimum(speed_cap[unsignalled], CAREFUL)
    # v^2 falls by at most 2 a per metre, so a running minimum from the end gives the profile in one sweep.
    square_drop = 2.0 * SLOW_DOWN * route.spacing * np.arange(count)
    speed_cap = np.sqrt(
        np.minimum.accumulate((speed_cap.astype(np.float64) ** 2 + square_drop)[::-1])[::-1] - square_drop
    )
    is_stop_sign = graph.sign_kind[graph.rule_sign] == SignKind.STOP
    sign_distance, _ = _next_line(
        route, graph, graph.rule_lane[is_stop_sign], graph.rule_s[is_stop_sign], graph.rule_sign[is_stop_sign]
    )
    sign_point = np.floor(np.arange(count) * route.spacing + sign_distance + 0.5)
    path = np.stack([route.xy[:, 0], route.xy[:, 1], route.yaw, smooth_curvature], 1)
    return PathTable(
        path.astype(np.float32),
        np.stack([speed_cap, line_distance, entry_distance, turn_rank], 1).astype(np.float32),
        signal,
        _bend(route),
        np.stack([sign_distance, sign_point, exit_distance], 1).astype(np.float32),
        _height(route, graph),
        route.lane.astype(np.int32),
        _beside(route, graph),
        graph.name,
    )


def _next_line(
    route: Route, graph: LaneGraph, lanes: I32, along: F32, values: I32
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
    """M from every route point to the next line (FAR: none) and what stands there (-1: nothing).

    Lines lie across `lanes` at the arc lengths `along`; a route may come past one more than once.
    """
    distance, indices = np.full(len(route.xy), FAR), np.full(len(route.xy), -1, np.int32)
    crossings: list[tuple[float, int]] = []
    for row in np.flatnonzero(np.isin(lanes, route.lane)).tolist():
        lane = int(lanes[row])
        lane_points = np.flatnonzero(route.lane == lane)
        start, stop = int(graph.offset[lane]), int(graph.offset[lane + 1])
        line_point = [np.interp(along[row], graph.s[start:stop], graph.xy[start:stop, axis]) for axis in (0, 1)]
        # Each consecutive run of points is one visit of the lane; a loop may visit it again.
        for visit in np.split(lane_points, np.flatnonzero(np.diff(lane_points) > 1) + 1):
            nearest = int(visit[np.argmin(np.hypot(*(route.xy[visit] - line_point).T))])
            cos, sin = np.cos(route.yaw[nearest]), np.sin(route.yaw[nearest])
            ahead = (line_point[0] - route.xy[nearest, 0]) * cos + (line_point[1] - route.xy[nearest, 1]) * sin
            crossings.append((nearest * route.spacing + float(ahead), int(values[row])))
    positions = np.arange(len(route.xy)) * route.spacing
    # From the last line backwards, so that the nearest line ahead is written last.
    for position, index in sorted(crossings, reverse=True):
        upstream = positions <= position + 0.75
        distance[upstream] = position - positions[upstream]
        indices[upstream] = index
    return distance, indices


def _junctions(
    route: Route, graph: LaneGraph, yaw: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the distances to the next junction and to its end, and the turn rank there, for every route point."""
    signed_lanes = set(graph.rule_lane.tolist())
    count = len(route.xy)
    inside = np.zeros(count, bool)
    on_lane = route.lane >= 0
    inside[on_lane] = graph.junction[route.lane[on_lane]] >= 0
    near_side = 1.0 if graph.left_hand[0] else -1.0
    entry_distance, exit_distance = np.full(count, FAR), np.full(count, FAR)
    turn_rank = np.zeros(count)
    edges = np.diff(np.concatenate([[0], inside.astype(np.int8), [0]]))
    runs = zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True)
    # From the last junction backwards, so that nearer junctions overwrite farther ones.
    for first_inside, first_outside in reversed(list(runs)):
        heading_change = yaw[min(first_outside, count - 1)] - yaw[max(first_inside - 1, 0)]
        turn_kind = (
            int(TurnRank.STRAIGHT)
            if abs(heading_change) < TURN
            else (TurnRank.RIGHT if heading_change * near_side > 0 else TurnRank.LEFT)
        )
        if first_inside > 0 and int(route.lane[first_inside - 1]) in signed_lanes:
            turn_kind += TurnRank.YIELD
        entry_distance[: first_inside + 1] = (first_inside - np.arange(first_inside + 1)) * route.spacing
        exit_distance[:first_outside] = (first_outside - np.arange(first_outside)) * route.spacing
        turn_rank[: first_inside + 1] = turn_kind
        entry_distance[first_inside:first_outside] = 0.0
        turn_rank[first_inside:first_outside] = turn_kind
    return entry_distance, exit_distance, turn_rank


def _height(route: Route, graph: LaneGraph) -> F32:
    """Return the height [N] of the lane under each route point; 0 where the town has no bridge."""
    heights = np.zeros(len(route.xy), np.float32)
    if np.ptp(graph.z) > BRIDGE:
        for lane in np.unique(route.lane[route.lane >= 0]).tolist():
            points, lane_points = np.flatnonzero(route.lane == lane), graph.points(lane)
            offsets = route.xy[points, None] - graph.xy[lane_points]
            heights[points] = graph.z[lane_points][(offsets**2).sum(-1).argmin(1)]
        # Off the lanes the height is unknown, and NaN never counts as being on another level.
        heights[route.lane < 0] = np.nan
    return heights


def lane_left(
    route: Route, part: npt.NDArray[np.intp], graph: LaneGraph, lane: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the offset of a lane's centre to the left of some route points (negative: right), and its width."""
    lane_points = graph.points(lane)
    x, y = graph.xy[lane_points].astype(np.float64).T
    step_x, step_y = np.diff(x), np.diff(y)
    from_x, from_y = (route.xy[part, axis, None].astype(np.float64) - values[:-1] for axis, values in enumerate((x, y)))
    share = np.clip((from_x * step_x + from_y * step_y) / np.maximum(step_x**2 + step_y**2, 1e-12), 0.0, 1.0)
    off_x, off_y = from_x - share * step_x, from_y - share * step_y
    point_index, nearest = np.arange(len(part)), (off_x**2 + off_y**2).argmin(1)
    share, off_x, off_y = share[point_index, nearest], off_x[point_index, nearest], off_y[point_index, nearest]
    lane_width = graph.width[lane_points].astype(np.float64)
    yaw = route.yaw[part].astype(np.float64)
    lateral = off_x * np.sin(yaw) - off_y * np.cos(yaw)
    return np.copysign(np.hypot(off_x, off_y), lateral), lane_width[nearest] + share * (
        lane_width[nearest + 1] - lane_width[nearest]
    )


def _beside(route: Route, graph: LaneGraph) -> F32:
    """Return the usable lanes on both sides of a route: `Roads.beside`.

    To the left a lane of the same direction or, where the marking may be crossed, an oncoming one; to the right only
    one of the same direction. A lane ends where a junction begins. At the end of the route, a lane of the same
    direction continues.
    """
    count = len(route.xy)
    table = np.zeros((count, 4))
    edges = np.flatnonzero(np.diff(route.lane)) + 1
    for points in np.split(np.arange(count), edges):
        lane = int(route.lane[points[0]])
        if lane < 0 or graph.junction[lane] >= 0 or graph.kind[lane] != LaneType.DRIVING:
            continue
        for column, neighbour, marking in (
            (0, int(graph.left[lane]), int(graph.left_marking[lane])),
            (2, int(graph.right[lane]), int(graph.right_marking[lane])),
        ):
            if (
                neighbour < 0
                or graph.kind[neighbour] != LaneType.DRIVING
                or marking not in (Marking.NONE, Marking.BROKEN)
            ):
                continue
            same_direction = graph.is_same_direction(lane, neighbour)
            if column == 2 and not same_direction:
                continue
            distance, width = lane_left(route, points, graph, neighbour)
            # not where the route itself changes lane
            adjacent = np.abs(np.abs(distance) - 0.5 * (route.width[points] + width)) < 0.4
            table[points, column] = np.where(adjacent, np.abs(distance), 0.0)
            table[points, column + 1] = 1.0 if same_direction else -1.0
    for column in (0, 2):
        distance, direction = table[:, column].copy(), table[:, column + 1].copy()
        persists = (distance[1:] != 0.0) & (np.abs(np.diff(distance)) < 0.3) & (direction[:-1] == direction[1:])
        continuation = ON_AND_ON if direction[-1] > 0.0 else 0.0
        lengths = [continuation if distance[-1] != 0.0 else 0.0]
        for adjacent, continues in zip((distance[-2::-1] != 0.0).tolist(), persists[::-1].tolist(), strict=True):
            lengths.append(lengths[-1] + route.spacing if adjacent and continues else 0.0)
        table[:, column + 1] = direction * lengths[::-1]
        # An agent that is still on a lane that ends is led back to the route.
        for index in np.flatnonzero((distance[:-1] != 0.0) & (distance[1:] == 0.0)).tolist():
            fade_steps = np.arange(1, min(FADE, count - 1 - index) + 1)
            is_free = distance[index + 1 : index + 1 + len(fade_steps)] == 0.0
            stop = len(fade_steps) if is_free.all() else int(np.argmin(is_free))
            table[index + 1 : index + 1 + stop, column] = distance[index] * (1.0 - fade_steps[:stop] / FADE)
    return table.astype(np.float32)


def signal_programs(graph: LaneGraph) -> F32:
    """Return cycle, start of green, green and yellow [S, 4], s. Phases of a junction alternate."""
    programs = np.zeros((len(graph.signal_phase), 4), np.float32)
    for order, junction in enumerate(np.unique(graph.signal_junction)):
        junction_signals = np.flatnonzero((graph.signal_junction == junction) & ~graph.signal_virtual)
        phases = {
            int(phase): index for index, phase in enumerate(np.unique(graph.signal_phase[junction_signals]).tolist())
        }
        phase_length = GREEN + YELLOW + ALL_RED
        cycle = phase_length * max(len(phases), 2)  # a lone phase still shows red now and then
        for signal in junction_signals:
            # Neighbouring junctions are offset, so that they do not all switch at once.
            green_start = (phases[int(graph.signal_phase[signal])] * phase_length + 5.0 * order) % cycle
            programs[signal] = cycle, green_start, GREEN, YELLOW
    return programs


@dataclass
class _Pool:
    """Routes and trajectories of all agents; a route that several agents share is stored once."""

    tables: list[PathTable] = field(default_factory=list)
    size: int = 0
    route_rows: dict[tuple[str, bytes], tuple[int, int]] = field(default_factory=dict)
    tracks: list[tuple[float, float, float, float]] = field(default_factory=list)

    def add(self, route: Route, graph: LaneGraph) -> tuple[int, int]:
        key = (graph.name, route.xy.tobytes() + route.speed_limit.tobytes())
        if key not in self.route_rows:
            table = path_table(route, graph)
            self.tables.append(table)
            self.route_rows[key] = (self.size, len(table.path))
            self.size += len(table.path)
        return self.route_rows[key]

    def follow(self, agent: EpisodeAgent) -> tuple[int, int]:
        """Add an agent's trajectory; return its first row and number of rows."""
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
    model_row: int,
    route: tuple[int, int],
    track: tuple[int, int],
) -> None:
    a["model"][e, i] = model_row
    a["controller"][e, i] = int(agent.controller)
    a["start"][e, i] = agent.pose.x, agent.pose.y, agent.pose.yaw, agent.speed
    a["cruise"][e, i] = agent.target_speed, agent.wake_distance
    a["manner"][e, i] = 1.0, 0.0, 0.0, 0.0
    driver = agent.driver
    if driver is not None:
        a["population"][e] = 1
        a["style"][e, i] = driver.time_gap, driver.standstill_gap, driver.acceleration, driver.deceleration
        a["manner"][e, i] = driver.pace, driver.jerk, driver.reaction_time, driver.estimation_error
        a["habit"][e, i] = driver.lane_offset, driver.errors, driver.key
        a["courtesy"][e, i] = driver.politeness, driver.change_duration
    a["route"][e, i] = route
    a["track"][e, i] = track


@dataclass(frozen=True)
class Bank:
    """Arrays that do not change while a world runs, for the kernels and for `WorldState`.

    Attributes:
        episodes: Arrays of the episodes on the device.
        roads: Arrays of the roads on the device.
        scripts: Phases of scripted agents on the device.
        script_rows: Rows of phases and words of history that the widest episode needs; (0, 0): no agent is scripted.
        script_sizes: [E, 2] The same for each episode.
        tables: The same routes for the host.
        turn: `TurnSignal` [R] of the turn at the next junction of each route point.
        agents: A, slots per scene.
        kind: [E, A] AgentKind of every slot.
        size: [E, A, 2] length and width, m.
        route: [E, A, 2] first point and number of points, as in `EpisodeArrays`.
        program: [E, S, 4] programmes of the town's signals, see `signal_programs`.
        forced: [E, S] forced signal states, -1: none.
        until: [E] time until which they are forced, s.
        walkers: Walkers of natural traffic on the device; None: there are none.
        has_drivers: An agent is a driver of the population.
    """

    episodes: EpisodeArrays
    roads: Roads
    scripts: Scripts
    script_rows: tuple[int, int]
    script_sizes: npt.NDArray[np.int32]
    tables: RoadTables
    turn: I8
    agents: int
    kind: npt.NDArray[np.int32]
    size: F32
    route: npt.NDArray[np.int32]
    program: npt.NDArray[np.float64]
    forced: npt.NDArray[np.int32]
    until: F32
    walkers: Walkers | None = None
    has_drivers: bool = False


def build(  # noqa: PLR0917
    episodes: Sequence[Episode],
    graphs: Mapping[str, LaneGraph],
    device: str,
    ego: Controller | None,
    models: Mapping[str, Model],
    dt: float = 0.1,
) -> Bank:
    """Build the arrays of all episodes on a device.

    Args:
        episodes: The bank.
        graphs: Lane graphs by town.
        device: Warp device.
        ego: Controller that replaces the egos'; None: as the episodes say.
        models: Bodies by name.
        dt: Length of a step, s.

    Raises:
        ConfigError: There is no episode, or one of them cannot be built.
    """
    if not episodes:
        raise ConfigError("a world needs at least one episode")
    for episode in episodes:
        _check(episode)
    towns = sorted({episode_index.town for episode_index in episodes})
    agent_count = max(len(episode_index.agents) for episode_index in episodes)
    signal_count = max(1, *(len(graphs[town].signal_phase) for town in towns))
    # Agents whose body differs from that of their model get a row of their own.
    model_rows = {model: index for index, model in enumerate(models.values())}
    shape = (len(episodes), agent_count)
    arrays: dict[str, npt.NDArray[np.generic]] = {
        "model": np.full(shape, -1, np.int32),
        "controller": np.zeros(shape, np.int32),
        "start": np.zeros((*shape, 4), np.float32),
        "style": np.zeros((*shape, 4), np.float32),
        "population": np.zeros(len(episodes), np.int32),
        "manner": np.zeros((*shape, 4), np.float32),
        "habit": np.zeros((*shape, 3), np.float32),
        "courtesy": np.zeros((*shape, 2), np.float32),
        "cruise": np.zeros((*shape, 2), np.float32),
        "route": np.zeros((*shape, 2), np.int32),
        "track": np.zeros((*shape, 2), np.int32),
        "script": np.zeros((*shape, 4), np.int32),
        "town": np.zeros(len(episodes), np.int32),
        "signal": np.full((len(episodes), signal_count), -1, np.int32),
        "limits": np.zeros((len(episodes), 4), np.float32),
        "contact": np.zeros(len(episodes), np.int32),
        "surface": np.zeros((len(episodes), 3), np.float32),
    }
    pool, scripts = _Pool(), ScriptTables(dt)
    for episode_index, episode in enumerate(episodes):
        graph = graphs[episode.town]
        bodies = [agent_model(agent, models) for agent in episode.agents]
        longest = max(LONGEST, *(0.5 * body.length for body in bodies))
        arrays["surface"][episode_index] = GRAVITY * episode.friction, lateral_grip(episode.friction), longest
        for agent_index, (agent, body) in enumerate(zip(episode.agents, bodies, strict=True)):
            route = (0, 0)
            if agent.route is not None and len(agent.route.xy) > 1:
                route = pool.add(agent.route, graph)
            model_row = model_rows.setdefault(body, len(model_rows))
            _put_agent(arrays, episode_index, agent_index, agent, model_row, route, pool.follow(agent))
        scripts.add(episode, arrays["script"][episode_index])
        if ego is not None:
            arrays["controller"][episode_index, 0] = int(ego)
        arrays["town"][episode_index] = towns.index(episode.town)
        for signal_index, state in episode.signal_override.items():
            arrays["signal"][episode_index, signal_index] = int(state)
        limits = episode.limits
        arrays["contact"][episode_index] = ContactPolicy[limits.contact.upper()]
        arrays["limits"][episode_index] = limits.max_steps, limits.max_time, limits.max_distance, episode.override_until
    footprints = [
        (model.length / 2, model.width / 2, max(model.wheelbase, 0.1), model.max_steer) for model in model_rows
    ]
    power = [(model.max_accel, model.max_brake, model.max_speed, model.brake_build_up) for model in model_rows]
    arrays["kind"] = np.array([int(model.kind) for model in model_rows], np.int32)
    arrays["body"] = np.array(footprints, np.float32)
    arrays["power"] = np.array(power, np.float32)
    bank = EpisodeArrays()
    for name, array_type in array_types(EpisodeArrays).items():
        setattr(bank, name, wp.array(arrays[name], dtype=array_type.dtype, device=device))
    town_graphs = [graphs[town] for town in towns]
    programs = np.zeros((len(towns), signal_count, 4))
    for index, graph in enumerate(town_graphs):
        programs[index, : len(graph.signal_phase)] = signal_programs(graph)
    model_indices = np.asarray(arrays["model"])
    tables = _tables(town_graphs, pool)
    # `graphs` may name a town by the path of its map, tables name it by the graph
    left_hand = {graph.name: bool(graph.left_hand[0]) for graph in town_graphs}
    walkers = None
    if has_walkers(episodes):
        walkers = build_walkers(episodes, graphs, np.asarray(arrays["route"]), tables.path, tables.rule, device)
    return Bank(
        bank,
        _roads(town_graphs, pool, device),
        scripts.build(device),
        scripts.sizes,
        scripts.episode_sizes,
        tables,
        np.concatenate([turn_sides(table.rule[:, 3], left_hand=left_hand[table.town]) for table in pool.tables]),
        agent_count,
        np.where(
            model_indices < 0, int(AgentKind.NONE), np.asarray(arrays["kind"])[np.maximum(model_indices, 0)]
        ).astype(np.int32),
        (2 * np.asarray(arrays["body"])[np.maximum(model_indices, 0), :2]).astype(np.float32),
        np.asarray(arrays["route"]),
        programs[np.asarray(arrays["town"])],
        np.asarray(arrays["signal"]),
        np.asarray(arrays["limits"])[:, 3],
        walkers,
        bool((np.asarray(arrays["style"])[..., 0] > 0.0).any()),
    )


def _tables(graphs: Sequence[LaneGraph], pool: _Pool) -> RoadTables:
    """Return the routes for the host; lanes are numbered over all towns, as in `Roads`."""
    first_lane = dict(
        zip([graph.name for graph in graphs], np.cumsum([0, *(len(graph.kind) for graph in graphs)]), strict=False)
    )

    def shifted(lanes: npt.NDArray[np.int32], town: str) -> npt.NDArray[np.int32]:
        return np.where(lanes >= 0, lanes + first_lane[town], -1).astype(np.int32)

    return RoadTables(
        path=np.concatenate([table.path for table in pool.tables]),
        rule=np.concatenate([table.rule for table in pool.tables]),
        signal=np.concatenate([table.signal for table in pool.tables]),
        lane=np.concatenate([shifted(table.lane, table.town) for table in pool.tables]),
        left=np.concatenate([shifted(graph.left, graph.name) for graph in graphs]),
        right=np.concatenate([shifted(graph.right, graph.name) for graph in graphs]),
        side=np.concatenate([np.where(graph.forward, -1, 1).astype(np.int32) for graph in graphs]),
        junction=np.concatenate([graph.junction >= 0 for graph in graphs]),
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
        parts["grid"].append(np.array([[*grid.origin, 1.0 / CELL, float(graph.turn_on_red[0])]]))
        parts["grid_size"].append(np.array([[grid.nx, grid.ny, cells]]))
        parts["signal_first"].append(np.array([signals]))
        parts["signal_program"].append(signal_programs(graph))
        segments += len(grid.seg)
        lanes += len(graph.kind)
        cells += len(grid.cell_offset)
        entries += len(grid.cell_seg)
        signals += len(graph.signal_phase)
    roads = Roads()
    parts["path"] = [table.path for table in pool.tables]
    parts["rule"] = [table.rule for table in pool.tables]
    parts["height"] = [table.height for table in pool.tables]
    parts["path_signal"] = [table.signal for table in pool.tables]
    parts["bend"] = [table.bend for table in pool.tables]
    parts["track"] = [np.array(pool.tracks or [(0.0,) * 4])]
    parts["beside"] = [table.beside for table in pool.tables]
    parts["ahead"] = [table.ahead for table in pool.tables]
    for name, array_type in array_types(Roads).items():
        joined_tables = np.concatenate(parts[name])
        if len(joined_tables) == 0:  # a town without signals
            joined_tables = np.zeros((1, *joined_tables.shape[1:]), joined_tables.dtype)
        setattr(roads, name, wp.array(np.ascontiguousarray(joined_tables), dtype=array_type.dtype, device=device))
    return roads

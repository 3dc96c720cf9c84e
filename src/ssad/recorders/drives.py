"""Drives worth recording: a long random route of the ego through a town, with traffic all around it."""

from __future__ import annotations

import math

import numpy as np

from ssad.core.errors import ConfigError, MapError
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import generator
from ssad.core.types import (
    F64,
    Controller,
    Episode,
    EpisodeAgent,
    EpisodeLimits,
    LaneType,
    Pose,
    Route,
    Scenario,
    SignalState,
)
from ssad.rendering.scene_objects import thin_shares
from ssad.rendering.street import STYLES, Street, build_street, cached_street
from ssad.scenarios.dynamic.knowledge.natural_junction import fits_route
from ssad.world.episode_arrays import YELLOW, signal_programs
from ssad.world.models import model
from ssad.world.roads.router import random_route
from ssad.world.world import signal_states

TRAFFIC_RANGE = 120.0  # m from the ego's way within which traffic starts
ROUTE_RANGE = 260.0  # m of the ego's way that counts for this: what is driven in 30 s
MAX_VEHICLES = 44  # vehicles
TOWN_SPEED = 12.0  # m/s that a driver who wants the most drives in town
FAST = 21.0  # m/s: on roads with a higher limit everybody wants to drive faster in proportion
EGO_ACCELERATION = 2.0  # m/s^2 from its start to the speed that it wants
ARRIVAL_MARGIN = 3.0  # s before the end of green from which the ego may come too late
MAX_WAIT = 5.0  # s that the ego waits at red
MAX_CYCLE = 3600.0  # s within which the moments of short drives are drawn: many cycles
ROUTE_TRIES = 8  # ways that are tried for a long vehicle, whose nose must stay in its lane
# body -> share; long vehicles and two-wheelers are more frequent than on real roads, so that each class is seen
MIX = {
    "car": 0.25,
    "suv": 0.14,
    "coupe": 0.06,
    "compact": 0.13,
    "van": 0.06,
    "motorcycle": 0.10,
    "bicycle": 0.09,
    "truck": 0.10,
    "bus": 0.07,
}

STREETS = ("town", "any")


def check_streets(streets: str) -> None:
    """Raise ConfigError for an unknown kind of streets."""
    if streets not in STREETS:
        raise ConfigError(f"streets '{streets}'; choose from: {', '.join(STREETS)}")


def drive_street(graph: LaneGraph, streets: str, *, key: tuple[object, ...]) -> Street:
    """Return the buildings and objects along the roads in a drive.

    Args:
        graph: Lane graph of the town.
        streets: "town": the town's permanent street. "any": a street in any style, built for this key alone, so
            that a detector cannot learn a town by heart.
        key: Key of the random draws.

    Raises:
        ConfigError: Unknown kind of streets.
    """
    check_streets(streets)
    if streets == "town":
        return cached_street(graph)
    rng = generator("drive street", graph.name, *key)
    return build_street(graph, seed=int(rng.integers(1, 2**31)), style=str(rng.choice(sorted(STYLES))))


def make_drive(graph: LaneGraph, *, key: tuple[object, ...], seconds: float, streets: str = "town") -> Episode:
    """One drive: ego first, all on Autopilot, signals as `drive_signals` has them. Deterministic in the key.

    streets: see `thin_shares`. MapError: the town has no road to drive on.
    """
    body_shares = thin_shares(MIX, streets)
    rng = generator("drive", graph.name, *key)
    lanes = np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0) & (graph.length > 25.0))
    if not len(lanes):
        raise MapError(f"town '{graph.name}' has no driving lane of 25 m or more; nothing can be recorded there")
    route = _long_route(graph, lanes, rng)
    ego_speed = float(rng.uniform(7, 10)) * _speed_factor(route)
    ego = EpisodeAgent("ego", "car", Controller.EXTERNAL, _pose(route), target_speed=ego_speed, route=route)
    agents = [ego]
    # Route points are 1 m apart; every fifth is enough to measure distances of 120 m.
    route_points = route.xy[: int(ROUTE_RANGE) : 5]
    density = float(rng.uniform(0.25, 0.8))
    start_places = [
        (int(lane), float(distance))
        for lane in lanes
        for distance in np.arange(6.0 + rng.uniform(0, 8), float(graph.length[lane]) - 6.0, 15.0)
    ]
    for place_index in rng.permutation(len(start_places)).tolist():
        if len(agents) > MAX_VEHICLES:
            break
        lane, distance = start_places[place_index]
        x, y, yaw, _ = graph.at(lane, distance)
        # Free places are drawn in random order with a density per drive, so that traffic varies.
        if np.hypot(route_points[:, 0] - x, route_points[:, 1] - y).min() > TRAFFIC_RANGE or rng.random() > density:
            continue
        body = str(rng.choice(list(body_shares), p=list(body_shares.values())))
        agent_route = random_route(graph, lane, distance, 400.0, rng)
        for _ in range(ROUTE_TRIES):
            if fits_route(body, agent_route):
                break
            agent_route = random_route(graph, lane, distance, 400.0, rng)
        else:
            body = "compact"
        if body == "bicycle" and _speed_factor(agent_route) > 1.0:
            body = "motorcycle"  # nobody cycles on a motorway
        clearance = 0.5 * model(body).length + 4.0
        if any(
            math.hypot(other_agent.pose.x - x, other_agent.pose.y - y)
            < clearance + 0.5 * model(other_agent.model).length
            for other_agent in agents
        ):
            continue
        desired_speed = 5.0 if body == "bicycle" else float(rng.uniform(5.5, 11.0)) * _speed_factor(agent_route)
        speed_limit = float(graph.speed_limit[lane])
        pose = Pose(x, y, yaw)
        agents.append(
            EpisodeAgent(
                f"{body} {len(agents)}",
                body,
                Controller.AUTOPILOT,
                pose,
                min(desired_speed, speed_limit) * 0.6,
                min(desired_speed, speed_limit),
                route=agent_route,
            )
        )
    drive_name = "/".join(str(piece) for piece in key)
    end_poses = (agents[0].pose, Pose(float(route.xy[-1, 0]), float(route.xy[-1, 1]), float(route.yaw[-1])))
    steps = math.ceil(seconds / 0.1) + 2
    limits = EpisodeLimits(max_steps=steps, max_time=2 * seconds + 60)
    scenario = Scenario(f"drive/{drive_name}", "Custom", graph.name, end_poses, limits=limits)
    signals = drive_signals(graph, route, speed=ego_speed, seconds=seconds, key=key)
    return Episode(f"drive/{graph.name}/{drive_name}", scenario, graph.name, tuple(agents), signals, 1e6, limits)


def drive_signals(
    graph: LaneGraph, route: Route, *, speed: float, seconds: float, key: tuple[object, ...]
) -> dict[int, SignalState]:
    """Return the states that signals are forced to, so that the ego need not stand at red for long.

    All signals follow their programs, except at junctions that the ego reaches at the wrong moment: there its phase
    stays green and the others stay red. Programs start with the drive, so that short drives would all show the same
    states. In those, each junction stays as it is at a drawn moment.

    Args:
        graph: Lane graph of the town.
        route: The ego's route.
        speed: Speed that the ego wants to drive, m/s; it starts from rest.
        seconds: Length of the drive, s.
        key: Key of the random draws.

    Returns:
        Signal index of the town -> state; signals that follow their program are omitted.
    """
    programs = signal_programs(graph).astype(np.float64)
    is_short = seconds < YELLOW
    forced = _drawn_states(graph, programs, generator("drive signals", graph.name, *key)) if is_short else {}
    junction = np.where(route.lane >= 0, graph.junction[np.maximum(route.lane, 0)], -1)
    distances = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route.xy, axis=0).T))])
    reached_junctions: set[int] = set()
    for entry in (np.flatnonzero((junction[1:] >= 0) & (junction[1:] != junction[:-1])) + 1).tolist():
        arrival = float(distances[entry]) / speed + 0.5 * speed / EGO_ACCELERATION
        junction_signals = np.flatnonzero((graph.signal_junction == junction[entry]) & ~graph.signal_virtual)
        approach_signals = graph.stop_signal[graph.stop_lane == route.lane[entry - 1]]
        ego_signals = np.intersect1d(approach_signals, junction_signals)
        if arrival > seconds or not len(ego_signals) or int(junction[entry]) in reached_junctions:
            continue
        reached_junctions.add(int(junction[entry]))
        cycle, green_start, green, _ = programs[ego_signals[0]].tolist()
        time_since_green = (arrival - green_start) % cycle
        is_passable = time_since_green < green - ARRIVAL_MARGIN or time_since_green > cycle - MAX_WAIT
        if is_passable and not is_short:
            continue
        for signal in junction_signals.tolist():
            is_ego_phase = graph.signal_phase[signal] == graph.signal_phase[ego_signals[0]]
            forced[signal] = SignalState.GREEN if is_ego_phase else SignalState.RED
    return forced


def _drawn_states(graph: LaneGraph, programs: F64, draws: np.random.Generator) -> dict[int, SignalState]:
    """Return the states of all signals with a program, each junction at a moment of its own."""
    signal_count = len(programs)
    junctions, junction_index = np.unique(graph.signal_junction, return_inverse=True)
    moments = draws.uniform(0.0, MAX_CYCLE, len(junctions))[junction_index]
    unforced = np.full((signal_count, 1), -1, np.int32)
    states = signal_states(programs[:, None], unforced, np.zeros(signal_count, np.float32), moments)[:, 0]
    return {signal: SignalState(int(states[signal])) for signal in np.flatnonzero(programs[:, 0] > 0.0).tolist()}


def _long_route(graph: LaneGraph, lanes: np.ndarray, draws: np.random.Generator) -> Route:
    """The longest of a few random ways."""
    longest_route: Route | None = None
    for _ in range(8):
        lane = int(draws.choice(lanes))
        candidate = random_route(graph, lane, float(draws.uniform(4.0, 20.0)), 400.0, draws)
        if longest_route is None or candidate.length > longest_route.length:
            longest_route = candidate
        if longest_route.length > 395.0:
            break
    assert longest_route is not None
    return longest_route


def _speed_factor(route: Route) -> float:
    """Return the factor on town speeds that agents want to drive on this route, where roads and bends allow it."""
    max_limit = float(route.speed_limit.max())
    return max_limit / TOWN_SPEED if max_limit > FAST else 1.0


def _pose(route: Route) -> Pose:
    return Pose(float(route.xy[0, 0]), float(route.xy[0, 1]), float(route.yaw[0]))

"""Drives that are recorded: states of traffic lights, stop lamps and indicators."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pytest

from ssad.core.seeding import generator
from ssad.core.types import EpisodeTrace, Route, SignalState, TurnSignal
from ssad.recorders.drives import ARRIVAL_MARGIN, MAX_WAIT, drive_signals, make_drive
from ssad.recorders.nuscenes import drive_with_autopilot
from ssad.rendering.camera.scene import LampSignal
from ssad.rendering.vehicle_signals import trace_signals, with_lamps
from ssad.world.episode_arrays import signal_programs
from ssad.world.roads import load_town
from ssad.world.roads.router import random_route
from ssad.world.world import signal_states

TOWN = "Crossgate"
SECONDS = 12.0


@cache
def routes(length: float = 150.0) -> tuple[Route, ...]:
    """Routes that start 40 m before a line with a light, where the lane is that long."""
    graph = load_town(TOWN)
    lines = [row for row, signal in enumerate(graph.stop_signal) if not graph.signal_virtual[signal]]
    return tuple(
        random_route(
            graph,
            int(graph.stop_lane[row]),
            max(float(graph.stop_s[row]) - 40.0, 0.0),
            length,
            generator("test route", row),
        )
        for row in lines
    )


def first_signal(route: Route) -> tuple[float, int]:
    """Return the distance to the first junction on a route, m, and the light of the route's lane there."""
    graph = load_town(TOWN)
    entry = int(np.flatnonzero(graph.junction[route.lane] >= 0)[0])
    signal = int(graph.stop_signal[graph.stop_lane == route.lane[entry - 1]][0])
    return float(np.hypot(*np.diff(route.xy[: entry + 1], axis=0).T).sum()), signal


def test_the_ego_has_green_when_it_arrives_or_soon_after_and_the_cross_street_has_red() -> None:
    graph, speed, kinds = load_town(TOWN), 8.0, Counter[bool]()
    programs = signal_programs(graph).astype(np.float64)
    for number, route in enumerate(routes()):
        distance, signal = first_signal(route)
        arrival = distance / speed + speed / 4.0  # from rest, at 2 m/s^2
        override = drive_signals(graph, route, speed=speed, seconds=SECONDS, key=(number,))
        forced = np.full((1, len(programs)), -1, np.int32)
        forced[0, list(override)] = list(override.values())
        states = np.concatenate(
            [
                signal_states(programs[None], forced, np.full(1, 1e6, np.float32), np.array([time]))
                for time in np.arange(arrival, arrival + MAX_WAIT + 0.1, 0.1)
            ]
        )
        kinds[signal in override] += 1
        is_green = states[:, signal] == SignalState.GREEN
        assert is_green.any(), number
        is_crossing = (graph.signal_junction == graph.signal_junction[signal]) & ~graph.signal_virtual
        is_crossing &= graph.signal_phase != graph.signal_phase[signal]
        assert (states[is_green][:, is_crossing] == SignalState.RED).all(), number
    assert kinds[True], "some junctions stand still for the ego"
    assert kinds[False], "others follow their programs"


def test_a_junction_that_shows_green_in_time_follows_its_program_whatever_came_before() -> None:
    graph, speed, kinds = load_town(TOWN), 8.0, Counter[bool]()
    programs = signal_programs(graph).astype(np.float64)
    free, never = np.full((1, len(programs)), -1, np.int32), np.full(1, 1e6, np.float32)
    for number, route in enumerate(routes(400.0)):
        override = drive_signals(graph, route, speed=speed, seconds=60.0, key=(number,))
        if not override:
            continue
        distances = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(route.xy, axis=0).T))])
        junction = graph.junction[route.lane]
        for entry in np.flatnonzero((junction[1:] >= 0) & (junction[1:] != junction[:-1])) + 1:
            arrival = float(distances[entry]) / speed + speed / 4.0
            signals = graph.stop_signal[graph.stop_lane == route.lane[entry - 1]]
            times = (arrival, arrival + ARRIVAL_MARGIN)
            states = [signal_states(programs[None], free, never, np.array([time]))[0] for time in times]
            is_green_in_time = all((state[signals] == SignalState.GREEN).all() for state in states)
            if arrival < 60.0 and len(signals) == 1 and is_green_in_time:
                kinds[int(signals[0]) in override] += 1
    assert kinds[False], "some routes have a junction that is green in time"
    assert not kinds[True]


def test_short_drives_show_each_state_and_not_always_the_same() -> None:
    graph = load_town(TOWN)
    drives = [drive_signals(graph, routes()[0], speed=8.0, seconds=1.2, key=(number,)) for number in range(40)]
    with_program = np.flatnonzero(signal_programs(graph)[:, 0] > 0).tolist()
    assert all(sorted(states) == with_program for states in drives)
    for signal in with_program:
        counts = Counter(states[signal] for states in drives)
        # Of 32 s, the light is green for 12 and amber for 3.
        assert counts[SignalState.GREEN] >= 5
        assert counts[SignalState.RED] >= 5
    assert sum(state == SignalState.YELLOW for states in drives for state in states.values()) > 20


@pytest.fixture(scope="module")
def trace() -> EpisodeTrace:
    return drive_with_autopilot(make_drive(load_town(TOWN), key=("signals", 0), seconds=SECONDS), load_town(TOWN))


def test_a_recorded_drive_has_all_lights_of_the_town_in_all_states(trace: EpisodeTrace) -> None:
    graph = load_town(TOWN)
    assert trace.signal_ids.tolist() == list(range(len(graph.signal_phase)))
    assert trace.signal.shape == (len(trace.x), len(graph.signal_phase))
    assert set(trace.signal[:, ~graph.signal_virtual].ravel().tolist()) == {
        SignalState.RED,
        SignalState.YELLOW,
        SignalState.GREEN,
    }
    is_standing = trace.speed[20:, 0] < 0.2
    assert is_standing.mean() < 0.5, "the ego drives"


def test_vehicles_of_a_recorded_drive_indicate_turns_and_brake(trace: EpisodeTrace) -> None:
    bits = trace_signals(trace)
    turning = Counter(trace.turn_signal.ravel().tolist())
    assert turning[TurnSignal.LEFT] > 20
    assert turning[TurnSignal.RIGHT] > 20
    has_lamps = with_lamps(trace.models)
    yaw_change = np.unwrap(trace.yaw, axis=0)[-1] - trace.yaw[0]
    for side, other, sign in (
        (LampSignal.LEFT, LampSignal.RIGHT, 1.0),
        (LampSignal.RIGHT, LampSignal.LEFT, -1.0),
    ):
        # Bends of a road are not indicated, so that some who turn show nothing.
        turned = bits[:, has_lamps & (sign * yaw_change > 1.2)]
        shown_count = np.count_nonzero(turned & int(side))
        assert shown_count > 20
        assert shown_count > 2 * np.count_nonzero(turned & int(other))
    assert (bits & int(LampSignal.BRAKE)).any()

"""Films of traffic: the record of a drive, what it finds worth a look, and the pictures."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.traffic_film import (
    BRAKE_LIGHT,
    TURN_LIGHT,
    Drive,
    View,
    busiest_junctions,
    contact_sheet,
    frames,
    recorded,
    remarks,
    summary,
)
from ssad.core.top_view import BODY, LAMP, ROAD, VEHICLE
from ssad.core.types import AgentKind, SignalState
from ssad.world.roads import load_town

STEPS = 400
AT = (120.0, 60.0)  # a junction of Twinford


def still_drive(**changes: object) -> Drive:
    """Return a car and a walker who stand far from each other on Twinford's roads, 40 s."""
    shape = (STEPS, 2)
    pose = np.zeros((*shape, 3), np.float32)
    pose[:, 0] = (122.0, 45.0, 0.5 * np.pi)
    pose[:, 1] = (100.0, 45.0, 0.0)
    graph = load_town("Twinford")
    drive = Drive(
        pose=pose,
        speed=np.zeros(shape, np.float32),
        acceleration=np.zeros(shape, np.float32),
        present=np.ones(shape, bool),
        turn=np.zeros(shape, np.int8),
        gap=np.full(shape, np.inf, np.float32),
        leader=np.full(shape, -1, np.int32),
        line=np.full(shape, 5.0, np.float32),
        lane=np.zeros(shape, np.int32),
        signal=np.full((STEPS, len(graph.signal_xy)), SignalState.RED, np.uint8),
        size=np.array([[4.5, 1.9], [0.5, 0.5]], np.float32),
        kind=np.array([AgentKind.CAR, AgentKind.WALKER], np.int32),
        names=np.array(["car 0", "walker 1"]),
        dt=np.array([0.1]),
    )
    return replace(drive, **changes)  # type: ignore[arg-type]


def changed(name: str, steps: slice, value: float) -> dict[str, object]:
    array = getattr(still_drive(), name).copy()
    array[steps, 0] = value
    return {name: array}


@pytest.mark.parametrize(
    ("changes", "texts"),
    [
        ({}, []),
        (changed("acceleration", slice(150, 160), -5.0), [(15.1, "brakes by up to 5.0 m/s²")]),
        (changed("acceleration", slice(50, 60), -5.0), []),  # before the traffic has settled
        (changed("line", slice(120, 300), 50.0), [(12.1, "stands for 18 s, nothing within 20 m")]),
        (changed("lane", slice(200, 220), -1), [(20.1, "off the lanes for 2.0 s")]),
    ],
)
def test_what_is_worth_a_look_is_told_with_its_time(changes: dict[str, object], texts: list[tuple[float, str]]) -> None:
    remark_lines = remarks(load_town("Twinford"), still_drive(**changes))
    assert [time for time, _ in remark_lines] == pytest.approx([time for time, _ in texts])
    for (_, line), (_, text) in zip(remark_lines, texts, strict=True):
        assert line.startswith("0 (car 0) at (122, 45): ")
        assert text in line


def test_bodies_that_nearly_touch_are_told_once() -> None:
    drive = still_drive()
    pose, speed = drive.pose.copy(), drive.speed.copy()
    pose[200:250, 1, :2] = (122.0 + 0.95 + 0.25 + 0.1, 45.0)  # 0.1 m beside the car
    speed[200:250, 1] = 1.0
    remark_lines = remarks(load_town("Twinford"), replace(drive, pose=pose, speed=speed))
    assert [line for time, line in remark_lines if time == pytest.approx(20.1)] == [
        "0 (car 0) at (122, 45): 0.10 m from 1 (walker 1), 0.0 and 1.0 m/s"
    ]
    assert len(remark_lines) == 1


def test_the_summary_counts_stops_creeping_and_sideways_acceleration() -> None:
    drive = still_drive()
    speed, pose = drive.speed.copy(), drive.pose.copy()
    speed[:, 0] = 4.0
    speed[150:165, 0], speed[200:250, 0], speed[300:330, 0] = 0.0, 0.0, 0.3
    pose[390, 0, 2] += 0.05  # 0.05 rad in 0.1 s at 4 m/s
    assert summary(replace(drive, speed=speed, pose=pose)) == (
        "creeping (below 0.6 m/s) 10.0% of the time; 2 stops, 1 of them below 2 s; up to 2.0 m/s² to the side"
    )


@pytest.mark.parametrize(("turn", "state", "is_told"), [(0, "RED", True), (-1, "RED", False), (0, "GREEN", False)])
def test_a_start_on_red_is_told_unless_it_turns_to_the_near_side(turn: int, state: str, is_told: bool) -> None:
    graph, drive = load_town("Twinford"), still_drive()
    lane, s, signal = int(graph.stop_lane[0]), float(graph.stop_s[0]), int(graph.stop_signal[0])
    points = graph.points(lane)
    x, y = (float(np.interp(s, graph.s[points], graph.xy[points, axis])) for axis in (0, 1))
    yaw = float(graph.yaw[points][-1])
    pose = drive.pose.copy()
    ahead = np.clip(0.1 * (np.arange(STEPS) - 200) + 0.03, 0.0, 8.0) - 0.5 * drive.size[0, 0]
    pose[:, 0] = np.stack([x + ahead * np.cos(yaw), y + ahead * np.sin(yaw), np.full(STEPS, yaw)], axis=1)
    signals = np.full_like(drive.signal, SignalState[state])
    signals[:100, signal] = SignalState.GREEN
    remark_lines = remarks(graph, replace(drive, pose=pose, signal=signals, turn=np.full_like(drive.turn, turn)))
    expected = [(22.6, "passes its stop line 12.6 s after red began")] * is_told
    assert [time for time, _ in remark_lines] == pytest.approx([time for time, _ in expected])
    assert all(text in line for (_, line), (_, text) in zip(remark_lines, expected, strict=True))


def colours(image: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(int(value) for value in colour) for colour in np.unique(image.reshape(-1, 3), axis=0)}


def test_pictures_show_bodies_lights_and_signals() -> None:
    graph = load_town("Twinford")
    view = View(graph, AT, (480, 320), 60.0)
    image = view.draw(still_drive(), 0, "")
    assert {ROAD, VEHICLE, BODY[AgentKind.WALKER], BRAKE_LIGHT, LAMP[SignalState.RED]} <= colours(image)
    moving = still_drive(**changed("speed", slice(None), 5.0))
    green = replace(moving, signal=np.full_like(moving.signal, SignalState.GREEN), turn=np.ones_like(moving.turn))
    shown = colours(view.draw(green, 0, ""))
    assert {TURN_LIGHT, LAMP[SignalState.GREEN]} <= shown
    assert not {BRAKE_LIGHT, LAMP[SignalState.RED]} & shown
    assert TURN_LIGHT not in colours(view.draw(green, 7, ""))  # it blinks
    four = [*frames([view] * 3, moving, [0, 1])]
    assert [picture.shape for picture in four] == [(640, 960, 3)] * 2
    assert contact_sheet([*four, four[0]], 2).shape == (1280, 1920, 3)
    (followed,) = frames([view], moving, [5], agent=0)
    assert view.centre == pytest.approx((122.0, 45.0))
    assert tuple(followed[160, 240]) == VEHICLE


def test_a_scene_is_driven_once_and_read_again(tmp_path: Path) -> None:
    """All kinds of agents are in it, and the busiest junction is one that vehicles visit."""
    graph = load_town("Twinford")
    agents = {"drivers": "population", "vehicles": 3, "walkers": 2, "cyclists": 1}
    given = Namespace(minutes=1 / 60, seed=5000, anew=False, device="cpu", out=tmp_path, **agents)
    drive, is_new = recorded(graph, given)
    assert is_new
    assert drive.speed.shape == (10, 6)
    assert np.bincount(drive.kind)[AgentKind.WALKER] == 2
    assert (drive.speed[-1, :3] > 0.0).all()
    again, is_new = recorded(graph, given)
    assert not is_new
    assert (again.pose == drive.pose).all()
    assert recorded(graph, Namespace(**vars(given) | {"seed": 5001}))[1]
    inside = replace(drive, lane=np.full_like(drive.lane, int(np.flatnonzero(graph.junction >= 0)[0])))
    (middle,) = busiest_junctions(graph, inside, 4)
    junction = graph.junction[graph.junction >= 0][0]
    points = np.concatenate([graph.xy[graph.points(int(lane))] for lane in np.flatnonzero(graph.junction == junction)])
    assert (points.min(axis=0) < middle).all()
    assert (points.max(axis=0) > middle).all()

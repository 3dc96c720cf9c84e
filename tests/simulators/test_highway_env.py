"""highway-env behind the protocols: the same drivers, sensors and metrics as in the embedded world."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

pytest.importorskip("highway_env", reason="needs the extra highway")

from highway_env.vehicle.behavior import IDMVehicle

from ssad.core.traces import trace_hash
from ssad.core.types import Controller, Episode, EpisodeLimits
from ssad.drivers.builtin import Autopilot, Blind
from ssad.engine.kind import Resources
from ssad.engine.run import run
from ssad.experiments.driving.kind import Driving, DrivingSuite
from ssad.experiments.runs import write_report
from ssad.metrics import episode_metrics
from ssad.scenarios.dynamic import scenario_from
from ssad.scenarios.dynamic.schema import scenario_data
from ssad.simulators import highway_env
from ssad.simulators.highway_env import PLACES, HighwayEnv, highway_episode, highway_scenarios, highway_town
from ssad.world.check import check_driver, check_simulator
from ssad.world.rollout import Loop, rollout

GRAPHS = {name: highway_town(name) for name in PLACES}


@lru_cache
def episodes() -> tuple[Episode, ...]:
    return tuple(highway_episode(scenario) for scenario in highway_scenarios(2))


def make(assign, steps: int = 200) -> HighwayEnv:
    short = [replace(e, limits=EpisodeLimits(max_steps=steps)) for e in episodes()]
    return HighwayEnv(short, GRAPHS, assign=assign)


def test_it_keeps_the_promises_of_a_simulator() -> None:
    check_simulator(make, episodes=3, steps=10)


@pytest.mark.slow
@pytest.mark.parametrize("driver", [Autopilot, Blind])
def test_our_drivers_keep_theirs_in_it(driver) -> None:
    check_driver(driver, make, episodes=3, steps=12)


def test_what_a_scene_does_depends_on_no_other() -> None:
    """Also though highway-env's intersection changes parameters of all vehicles of a process."""
    together = [trace_hash(t) for t in rollout(make([0, 2], 40), Autopilot())]
    for k, told in zip((2, 0), together[::-1], strict=True):
        for name, value in highway_env._DEFAULTS.items():  # as in a process of its own
            setattr(IDMVehicle, name, value)
        assert trace_hash(rollout(make([k], 40), Autopilot())[0]) == told


def test_lanes_lie_where_highway_env_has_them() -> None:
    graph = GRAPHS["HighwayIntersection"]
    for episode in episodes()[:2]:
        route = episode.agents[0].route
        assert route is not None
        np.testing.assert_allclose(np.hypot(*np.diff(route.xy, axis=0).T), 1.0, atol=0.01)
        along = np.arctan2(*np.diff(route.xy, axis=0).T[::-1])
        turn = np.angle(np.exp(1j * (along - route.yaw[:-1])))
        assert np.abs(turn).max() < 0.1
        for point, lane in zip(route.xy, route.lane, strict=True):
            assert np.hypot(*(graph.xy[graph.points(lane)] - point).T).min() < 2.6
        # from the south to the west: a left turn
        assert np.angle(np.exp(1j * (route.yaw[-1] - route.yaw[0]))) == pytest.approx(np.pi / 2, abs=0.05)
        assert {int(graph.junction[lane]) for lane in route.lane} == {-1, 0}
    highway = GRAPHS["HighwayStraight"]
    assert highway.left.tolist() == [-1, 0, 1]
    assert highway.right.tolist() == [1, 2, -1]
    assert np.diff(highway.xy[highway.offset[:-1], 1]).tolist() == [-4.0, -4.0]


def test_metrics_and_mirror_say_what_highway_env_does() -> None:
    simulator = make([2])
    loop = Loop(simulator, {0: Blind()})
    loop.reset()
    env = simulator._environments[0]
    for _ in range(30):
        loop.step()
        for i, vehicle in enumerate(simulator._slots[0]):
            if vehicle is not None:
                pose = simulator.state().pose[0, i]
                np.testing.assert_allclose(pose[:2] * [1, -1], vehicle.position, rtol=1e-6, atol=1e-3)
    assert simulator.state().driven[0] == pytest.approx(
        env.vehicle.position[0] - episodes()[2].agents[0].pose.x, abs=0.1
    )
    for trace in rollout(make([0, 2]), Blind()):
        found = episode_metrics(trace)
        assert found.off_road == 0.0
        assert found.distance_to_route < 1.0
        assert found.driven > 100.0
        assert trace.end in ("complete", "max_steps")


def test_steering_left_turns_left() -> None:
    class Left:
        name, controller = "left", Controller.EXTERNAL

        def reset(self, episodes): ...

        def act(self, view):
            return np.tile(np.array([0.2, 0.0, 0.05], np.float32), (len(view.agent), 1))

    simulator = make([2])
    loop = Loop(simulator, {0: Left()})
    loop.reset()
    for _ in range(5):
        loop.step()
    assert simulator.state().pose[0, 0, 2] > 0.02
    assert simulator.state().pose[0, 0, 1] > float(episodes()[2].agents[0].pose.y)


def test_a_driver_takes_over_a_vehicle_of_highway_env() -> None:
    class Stop:
        name, controller = "stop", Controller.EXTERNAL

        def reset(self, episodes): ...

        def act(self, view):
            return np.tile(np.array([0.0, 1.0, 0.0], np.float32), (len(view.agent), 1))

    def third(state):
        mask = np.zeros(state.active.shape, bool)
        mask[:, 3] = state.time < 8.0 - 1e-6
        return mask

    plain = rollout(make([2], 130), {0: Autopilot()})[0]
    trace = rollout(make([2], 130), {0: Autopilot(), third: Stop()})[0]
    assert plain.speed[79, 3] > 15.0
    assert trace.speed[79, 3] == 0.0
    assert trace.speed[120, 3] > 5.0  # highway-env drives it again


def test_scenarios_round_trip() -> None:
    for scenario in highway_scenarios(1):
        assert scenario_from(json.loads(json.dumps(scenario_data(scenario)))) == scenario


def test_the_engine_runs_both_simulators_into_one_report_and_replays_to_the_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = EpisodeLimits(max_steps=20)
    monkeypatch.setattr(
        highway_env, "highway_scenarios", lambda: [replace(s, limits=short) for s in highway_scenarios(1)]
    )
    kind = Driving()
    said = {"name": "both", "systems": ["blind"], "scenarios": ["RightTurn/00", "highway-env"]}
    plan = kind.plan(DrivingSuite.model_validate(said))
    assert sorted(len(batch) for batch in kind.batches(plan, plan.cells, 1)) == [1, 2]
    records = run(plan, tmp_path, Resources(0, console=Console(file=io.StringIO())))
    assert [record["status"] for record in records] == ["ok"] * 3
    write_report(tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert "highway-env: HighwayIntersection" in page
    assert "Right-turn" in page
    by_key = {record["key"]: record for record in records}
    for cell in plan.cells:
        assert kind.replay(plan, cell, by_key[cell.key], tmp_path).difference is None

"""CARLA: over a stand-in of its client, whose names are checked against the stubs of the real wheel."""

from __future__ import annotations

import ast
import csv
import importlib.util
import inspect
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.command import ssad_process
from helpers.quick import others_slow
from matplotlib.path import Path as Path2D

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import (
    Actor,
    AgentKind,
    Controller,
    Episode,
    EpisodeLimits,
    EpisodeTrace,
    Pose,
    Scenario,
    SignalState,
)
from ssad.drivers import make_system
from ssad.drivers.leaderboard.sensors import camera_of, lidar_of, radar_of
from ssad.metrics import episode_metrics
from ssad.rendering.lidar import Lidar
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.simulators.carla import simulator as adapter
from ssad.simulators.carla.sensors import CarlaSensor, sensor_blueprints
from ssad.simulators.carla.server import WEATHERS, Server
from ssad.simulators.carla.simulator import Carla
from ssad.simulators.closed_loop import drive, requested_sensors, scenario_json
from ssad.world.roads import load_town, town_signals
from ssad.world.rollout import rollout
from ssad.world.world import World

ROOT = Path(__file__).parent.parent.parent
STAND_IN = Path(__file__).parent.parent / "helpers" / "carla_stand_in"
SERVER = Server("here", 2000, timeout=5.0)
FEW = ("StraightObstacle/00",)


@pytest.fixture
def carla(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The stand-in as the module carla."""
    source = STAND_IN / "carla" / "__init__.py"
    spec = importlib.util.spec_from_file_location("carla", source)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "carla", module)
    spec.loader.exec_module(module)
    adapter._CONNECTIONS.clear()
    yield module
    adapter._CONNECTIONS.clear()


def built(scenarios: Sequence[Scenario]) -> list[Episode]:
    return [build_episode(scenario, load_town(scenario.town), seed=0) for scenario in scenarios]


def drive_there(episodes: Sequence[Episode], system: str) -> list[EpisodeTrace]:
    traces = []
    for episode in episodes:
        simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=SERVER)
        traces += rollout(simulator, make_system(system))
        simulator.close()
    return traces


def same(episodes: Sequence[Episode], system: str) -> None:
    here = rollout(World(episodes, {e.town: load_town(e.town) for e in episodes}), make_system(system))
    for one, other in zip(here, drive_there(episodes, system), strict=True):
        assert one.end == other.end, one.key
        assert abs(len(one.accel) - len(other.accel)) <= 1, one.key
        rows = min(len(one.accel), len(other.accel))
        off = np.hypot(one.x[:rows] - other.x[:rows], one.y[:rows] - other.y[:rows]) * one.active[:rows]
        walks = one.kind == AgentKind.WALKER
        assert off[:, ~walks].max() < 0.05, one.key
        # a walker of the embedded world changes its speed within a step, one of CARLA from the next on
        assert off[:, walks].max(initial=0.0) < 0.3, one.key
        measured, again = (episode_metrics(trace).as_dict() for trace in (one, other))
        for name in ("collision", "route_distance", "route_complete", "red_lights", "off_road_distance"):
            if name in measured:
                assert again[name] == pytest.approx(measured[name], rel=0.01, abs=0.05), (one.key, name)


@pytest.mark.parametrize(
    ("names", "system"),
    [
        (FEW, "blind"),
        pytest.param(("precrash",), "blind", marks=pytest.mark.slow),
        pytest.param(("precrash",), "autopilot", marks=pytest.mark.slow),
    ],
)
def test_episodes_go_as_in_the_embedded_world(carla: ModuleType, names: Sequence[str], system: str) -> None:
    same(built([scenario for name in names for scenario in load_scenarios(name)]), system)
    assert carla.CALLS["Client.generate_opendrive_world"] + carla.CALLS["Client.load_world"] == 1  # one town, one load


def test_a_driver_of_twenty_decisions_a_second_gets_them(carla: ModuleType) -> None:
    """The server has steps of 0.05 s for it, and the trace steps of 0.1 s."""
    times, steps = [], []

    def act(view: Any) -> Any:
        times.append(float(view.time[0]))
        steps.append(carla.SERVERS["here", 2000].get_settings().fixed_delta_seconds)
        return np.zeros((1, 3), np.float32)

    driver = SimpleNamespace(
        name="often", controller=Controller.EXTERNAL, period=0.05, reset=lambda episodes: None, act=act
    )
    scenario = replace(load_scenarios(FEW[0])[0], limits=EpisodeLimits(max_steps=4))
    spec = {"scenario": scenario_json(scenario), "repetition": 0, "spread": 0.0, "simulator": "carla://here:2000"}
    _, (trace,), _ = drive([SimpleNamespace(key="a", system="often", seed=0, spec=spec)], device="cpu", driver=driver)
    assert times == pytest.approx(np.arange(8) / 20)
    assert set(steps) == {0.05}
    assert (trace.dt, len(trace.x)) == (0.1, 5)


def test_natural_traffic_comes_and_goes(carla: ModuleType) -> None:
    """Traffic that sleeps, that the Autopilot drives, that leaves at the end of its route."""
    same(built(load_scenarios("natural")[:1]), "autopilot")


def test_trajectories_are_put_and_leave(carla: ModuleType) -> None:
    rows = ((1.0, 230.0, -1.75, 0.0), (3.0, 250.0, -1.75, 0.0))
    late = Actor("late", "coupe", Pose(*rows[0][1:]), trajectory=rows)
    route = (Pose(217.0, -5.25), Pose(260.0, -5.25))
    scenario = Scenario("late", "Custom", "ProvingGround", route, actors=(late,), limits=EpisodeLimits(max_steps=40))
    (trace,) = drive_there(built([scenario]), "autopilot")
    there = np.flatnonzero(trace.active[:, 1])
    assert (there[0], there[-1]) == (10, 30)
    assert trace.x[20, 1] == pytest.approx(240.0, abs=0.01)
    assert trace.speed[20, 1] == pytest.approx(10.0, abs=0.01)
    assert len(carla.SERVERS["here", 2000]._actors) == 0


def test_reset_signals_and_settings(carla: ModuleType) -> None:
    """A reset gives the same episode again; CARLA's lights show what ours say; the server's settings come back."""
    (episode,) = built(load_scenarios("RedlightRunning/00"))
    simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=SERVER)
    world = carla.SERVERS["here", 2000]
    first = rollout(simulator, make_system("blind"))[0]
    again = rollout(simulator, make_system("blind"))[0]
    assert np.array_equal(first.x, again.x)
    names = town_signals(episode.town)
    assert episode.signal_override
    for signal, state in episode.signal_override.items():
        shown = world._lights[names[signal]]._state
        assert shown.name.upper() == SignalState(state).name
    assert world._settings.synchronous_mode
    assert world._weather == "ClearNoon"
    simulator.close()
    assert not world._settings.synchronous_mode
    rain = replace(SERVER, weather="HardRainNoon")
    Carla([episode], {episode.town: load_town(episode.town)}, server=rain).close()
    assert carla.SERVERS["here", 2000]._weather == "HardRainNoon"


def test_what_only_carla_feels_ends_the_episode(carla: ModuleType) -> None:
    """A wall of the town, or a body of another shape."""
    (episode,) = built(load_scenarios("StraightObstacle/00"))
    simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=SERVER)
    mask = np.zeros((1, simulator.agents), bool)
    mask[0, 0] = True
    simulator.take(mask, Controller.FOLLOW, target_speed=5.0)
    simulator._events.collisions.append((999, "static.road"))
    simulator.step()
    assert simulator.ended()[0] == 0
    simulator._events.collisions.append((998, "static.wall"))
    simulator.step()
    assert simulator.ended()[0] == 1
    assert simulator.state().contact[0] == 8
    assert simulator.state().contact_agent[0] == -2


def test_the_lane_sensor_counts_what_the_body_crosses(carla: ModuleType) -> None:
    """A change to the lane on the left: each corner crosses the broken line once; the mirror counts the body once."""
    route = (Pose(230.0, -5.25), Pose(300.0, -5.25))
    scenario = Scenario("changes", "Custom", "ProvingGround", route, limits=EpisodeLimits(max_steps=80))
    (episode,) = built([scenario])
    simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=SERVER)
    nothing = {"lane_crossings": 0, "lane_markings": {}}
    for _ in range(2):  # after a reset again
        assert simulator.measured == nothing
        invasions, crossed = 0, []
        for step in range(70):
            yaw, y = float(simulator.state().pose[0, 0, 2]), float(simulator.state().pose[0, 0, 1])
            turn = min(max(0.4 * (-1.75 - y if step > 15 else -5.25 - y), -0.25), 0.25) - yaw
            simulator.step(np.array([[[0.6, 0.0, 0.6 * turn]] + [[0.0] * 3] * (simulator.agents - 1)], np.float32))
            invasions += int(simulator.state().lane_invasion[0])
            crossed.append(simulator.measured["lane_crossings"])
            if step == 15:
                assert simulator.measured == nothing
        assert simulator.state().pose[0, 0, 1] == pytest.approx(-1.75, abs=0.3)
        assert simulator.measured["lane_markings"] == {"Broken": 4}
        assert 2 <= simulator.measured["lane_crossings"] <= 4
        assert invasions == 1
        assert crossed == sorted(crossed)
        simulator.reset()
    simulator._events.lane_crossings.append((simulator._frame, ("Solid",)))  # told late, of the drop onto the road
    assert simulator.measured == nothing
    simulator.close()
    assert not carla_world()._actors
    assert carla.CALLS["Sensor.listen"] == carla.CALLS["Sensor.stop"] == 6


# ---------------------------------------------------------------- CARLA's own sensors, and its Traffic Manager

CENTRES = np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(90) + 0.5), -1).reshape(-1, 2)
CAMERAS = {
    "front": {"x": 1.5, "y": 0.0, "z": 1.6, "fov": 90.0},
    "aside": {"x": 0.5, "y": 0.7, "z": 1.7, "yaw": 40.0, "pitch": -6.0, "roll": 12.0, "fov": 80.0},
}
PLACES = ((16.0, 0.0, 0.0), (11.0, -9.5, 0.6))  # ahead, left, turn: of the things that the ego sees


def looked(system: object, names: Sequence[str], *, server: Server = SERVER, steps: int = 4) -> list[dict[str, object]]:
    """What CARLA's own sensors show an ego that drives off among two cars."""
    pose, route = Pose(230.0, -1.75, 0.0), (Pose(230.0, -1.75), Pose(300.0, -1.75))
    actors = tuple(
        Actor(f"car {k}", "suv", Pose(pose.x + x, pose.y + y, turn)) for k, (x, y, turn) in enumerate(PLACES)
    )
    scenario = Scenario("looks", "Custom", "ProvingGround", route, actors=actors, limits=EpisodeLimits(max_steps=steps))
    (episode,) = built([scenario])
    eyes = sensor_blueprints(requested_sensors([system]), 0.1)
    simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=server, blueprints=eyes)
    seen = []
    mask = np.zeros((1, simulator.agents), bool)
    mask[0, 0] = True
    simulator.take(mask, Controller.FOLLOW, target_speed=8.0)
    sensors = {name: CarlaSensor(name) for name in eyes}
    try:
        while simulator.ended()[0] == 0:
            got = {name: sensors[name](simulator, np.zeros((1, 2), np.int32))[0] for name in names}
            seen.append(got | {"pose": simulator.state().pose[0].copy(), "speed": simulator.state().speed[0].copy()})
            simulator.step()
        assert all(not sensors[name](simulator, np.zeros((1, 2), np.int32))[0][..., :3].any() for name in names)
    finally:
        simulator.close()
    assert not carla_world()._actors
    return seen


def carla_world() -> object:
    return sys.modules["carla"].SERVERS["here", 2000]


class Eyes:
    """A driver that looks through a camera of a leaderboard, one whose axis is off the middle, a LiDAR and a radar."""

    def __init__(self) -> None:
        size = {"width": 160, "height": 90}
        self.cameras = {name: camera_of({"id": name, **size, **item}) for name, item in CAMERAS.items()}
        front = self.cameras["front"]
        off = front.intrinsic + np.array([[0.0, 0.0, 24.0], [0.0, 0.0, -9.0], [0.0, 0.0, 0.0]])
        self.cameras["off"] = Camera(front.width, front.height, off, front.to_ego, "off")
        self.lidars = {"lidar": lidar_of({"id": "lidar", "z": 2.0, "yaw": -90.0})}
        self.radars = {"radar": radar_of({"id": "radar", "x": 2.0, "z": 0.7})}
        self.sensors = (*self.cameras, "lidar", "radar")


@pytest.fixture
def seen(carla: ModuleType) -> list[dict[str, object]]:
    return looked(Eyes(), Eyes().sensors)


def test_carla_s_cameras_see_what_stands_where(seen: list[dict[str, object]]) -> None:
    """Middles of the two cars' silhouettes are where the camera's own geometry has them, at every step."""
    eyes = Eyes()
    half = np.array([[a, b, c] for a in (-2.3, 2.3) for b in (-0.965, 0.965) for c in (0.0, 1.85)])
    checked = 0
    for row in seen:
        pose = row["pose"]
        for name, camera in eyes.cameras.items():
            picture = row[name]
            assert picture.shape == (3, 90, 160)
            assert picture.dtype == np.uint8
            bodies, mask = picture[0] == 200, np.zeros((90, 160), bool)
            for x, y, yaw in pose[1:3].tolist():
                c, s = np.cos(yaw), np.sin(yaw)
                world = half @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + (x, y, 0.0)
                c, s = np.cos(pose[0, 2]), np.sin(pose[0, 2])
                ego = (world - (*pose[0, :2], 0.0)) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
                local = (ego - camera.to_ego[:3, 3]) @ camera.to_ego[:3, :3]
                if local[:, 2].min() < 0.5:
                    continue
                spot = (local / local[:, 2:]) @ camera.intrinsic.T
                hull = cv2.convexHull(spot[:, None, :2].astype(np.float32))[:, 0]
                mask |= Path2D(hull).contains_points(CENTRES).reshape(90, 160)
            both, either = (mask & bodies).sum(), (mask | bodies).sum()
            if either > 60:
                assert both / either > 0.93, name
                checked += 1
    assert checked > 8


def test_carla_s_lidar_and_radar(seen: list[dict[str, object]]) -> None:
    """Points lie on the ground or on bodies; their rings are those of their beams; the radar tells who comes nearer."""
    eyes = Eyes()
    lidar = eyes.lidars["lidar"]
    for row in seen[1:]:
        points, hits, pose = row["lidar"], row["radar"], row["pose"]
        assert points.shape == (64 * 937, 5)
        real = points[points[:, 4] >= 0.0]
        assert len(real) > 20_000
        assert not points[points[:, 4] < 0.0, :4].any()
        up = np.arctan2(real[:, 2], np.hypot(real[:, 0], real[:, 1]))
        assert np.abs(up - lidar.beams[real[:, 4].astype(int)]).max() < 1e-3
        ego = real[:, :3].astype(np.float64) @ lidar.to_ego[:3, :3].T + lidar.to_ego[:3, 3]
        c, s = np.cos(pose[0, 2]), np.sin(pose[0, 2])
        world = ego @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + (*pose[0, :2], 0.0)
        above = world[world[:, 2] > 0.05]
        assert len(above) > 100
        off = np.min([np.hypot(*(above[:, :2] - pose[k, :2]).T) for k in (1, 2)], axis=0)
        assert off.max() < 2.6  # half the diagonal of the bodies
        v = float(row["speed"][0])
        ahead = hits[(hits[:, 0] > 0.0) & (abs(hits[:, 2]) < 0.05) & (hits[:, 1] > -0.02)]
        gap = float(pose[1, 0] - pose[0, 0]) - 2.3 - 2.0
        assert ahead[:, 0].min() == pytest.approx(gap, abs=0.1)
        assert ahead[:, 3] == pytest.approx(-v * np.cos(ahead[:, 1]) * np.cos(ahead[:, 2]), abs=0.05)


def test_what_carla_s_sensors_cannot_be_is_refused(carla: ModuleType) -> None:
    camera = Camera.typical(64, 32)
    wide = Camera(64, 32, camera.intrinsic * [[1.2], [1.0], [1.0]])
    with pytest.raises(ConfigError, match="pixels are not square"):
        sensor_blueprints({"wide": wide}, 0.1)
    with pytest.raises(ConfigError, match="not evenly spaced"):
        sensor_blueprints({"lidar": ("lidar", Lidar(np.array([-0.2, 0.0, 0.1]), 100))}, 0.1)
    (episode,) = built(load_scenarios("StraightObstacle/00"))
    simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=SERVER, blueprints={})
    with pytest.raises(ConfigError, match="only the ego carries its sensors, not agent 1"):
        CarlaSensor("front")(simulator, np.array([[0, 1]]))


def test_the_traffic_manager_drives_the_traffic(carla: ModuleType) -> None:
    """Along the routes of the episode, whose speed they have; the ego and who is not traffic is left alone."""
    (episode,) = built(load_scenarios("natural")[:1])
    server = Server("here", 2000, timeout=5.0, traffic="manager")
    simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=server)
    (trace,) = rollout(simulator, make_system("blind"))
    traffic = simulator._traffic
    assert traffic is not None
    assert traffic.driven_bodies
    assert carla.CALLS["synchronous managers"] == 1
    simulator.close()
    assert carla.CALLS["synchronous managers"] == 0
    assert carla.CALLS["Vehicle.set_autopilot"] == len(traffic.driven_bodies)
    assert max(np.hypot(*np.ptp(np.stack([trace.x, trace.y]), axis=1))[sorted(traffic.driven_bodies)]) > 20.0
    for number in traffic.driven_bodies:
        assert episode.agents[number].controller == Controller.AUTOPILOT
        route = episode.agents[number].route
        assert route is not None
        way = np.stack([trace.x[:, number], trace.y[:, number]], 1)[trace.active[:, number]]
        gap = np.hypot(*(way[:, None] - route.xy[None]).transpose(2, 0, 1)).min(1)
        assert gap.max() < 1.5


FAULTS = (
    "Client.get_server_version",
    "version",
    "Client.get_world",
    "Client.get_available_maps",
    "Client.load_world",
    "World.get_map",
    "roads",
    "World.get_traffic_light_from_opendrive_id",
    "World.get_settings",
    "World.apply_settings",
    "World.freeze_all_traffic_lights",
    "World.set_weather",
    "World.get_blueprint_library",
    "World.try_spawn_actor",
    "nothing",
    "World.spawn_actor:3",
    "Sensor.listen",
    "World.tick",
    "World.tick:20",
    "World.get_snapshot:7",
    "Vehicle.apply_control:9",
    "Walker.apply_control",
    "TrafficLight.set_state",
    "Actor.destroy",
    "World.spawn_actor:4",
    "World.spawn_actor:5",
    "Sensor.listen:2",
    "Sensor.stop:2",
    "gone sensor.other.lane_invasion",
    "gone sensor.other.collision",
)


QUICK = ("version", "nothing", "World.tick:20", "World.spawn_actor:5", "gone sensor.other.lane_invasion")


@pytest.mark.parametrize("fault", others_slow(FAULTS, QUICK))
def test_a_server_that_fails_ends_in_a_line(carla: ModuleType, fault: str) -> None:
    (episode,) = built(load_scenarios("StraightObstacle/00"))
    carla.FAULT = fault

    def drive_twice() -> None:
        simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=SERVER)
        rollout(simulator, make_system("blind"))
        simulator.reset()

    with pytest.raises(ConfigError, match=r"^CARLA at here:2000: ") as error:
        drive_twice()
    assert len(str(error.value)) < 400
    carla.FAULT = ""
    adapter._CONNECTIONS.clear()
    carla.SERVERS.clear()
    if fault in QUICK:
        assert drive_there([episode], "blind")[0].end == "collision"  # the next one runs


SENSOR_FAULTS = (
    "silent sensors",
    "broken sensors",
    "World.spawn_actor:7",
    "Sensor.listen:3",
    "Sensor.stop:3",
    "Actor.destroy:3",
    "Client.get_trafficmanager",
    "TrafficManager.set_synchronous_mode",
    "TrafficManager.set_random_device_seed",
    "Vehicle.set_autopilot",
    "TrafficManager.set_desired_speed",
    "TrafficManager.set_path",
)


@pytest.mark.parametrize("fault", others_slow(SENSOR_FAULTS, ("silent sensors", "TrafficManager.set_path")))
def test_sensors_and_managers_that_fail_end_in_a_line(carla: ModuleType, fault: str) -> None:
    (episode,) = built(load_scenarios("natural")[:1])
    carla.FAULT = fault
    server = Server("here", 2000, timeout=0.5, sensors="carla", traffic="manager")
    eyes = sensor_blueprints({"front": Camera.typical(32, 18), "lidar": ("lidar", lidar_of({"id": "lidar"}))}, 0.1)

    def drive() -> None:
        simulator = Carla([episode], {episode.town: load_town(episode.town)}, server=server, blueprints=eyes)
        mask = np.zeros((1, simulator.agents), bool)
        mask[0, 0] = True
        simulator.take(mask, Controller.FOLLOW, target_speed=10.0)
        simulator.step()
        for name in eyes:
            CarlaSensor(name)(simulator, np.zeros((1, 2), np.int32))
        for _ in range(60 if "Manager" in fault or "autopilot" in fault else 0):
            simulator.step()  # until traffic that sleeps wakes
        simulator.reset()

    with pytest.raises(ConfigError, match=r"^CARLA at here:2000: ") as error:
        drive()
    assert len(str(error.value)) < 400


def test_a_batch_and_a_bad_address_are_refused(carla: ModuleType) -> None:
    episodes = built(load_scenarios("StraightObstacle")[:2])
    with pytest.raises(ConfigError, match="one scene at a time, not 2"):
        Carla(episodes, {episodes[0].town: load_town(episodes[0].town)}, server=SERVER)
    for address in (
        "carla:/x",
        "carla://",
        "carla://a:0",
        "carla://a:99999",
        "http://a",
        "carla://a b",
        "carla://a:-1",
        "carla://a?sensors",
        "carla://a?sensors=lidar",
        "carla://a?eyes=carla",
        "carla://a?sensors=carla&traffic=mine",
        "carla://a?weather=Snow",
    ):
        with pytest.raises(ConfigError, match=r"expected carla://HOST|there is no .*; there are sensors="):
            Server.of(address)
    both = Server.of("carla://a:3000/?sensors=carla&traffic=manager")
    assert both == Server("a", 3000, sensors="carla", traffic="manager")
    assert Server.of("carla://a?weather=HardRainNoon").weather == "HardRainNoon"
    assert Server.of("carla://a.b:3000") == Server("a.b", 3000)
    assert Server.of("carla://[::1]") == Server("::1")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "code", "more"),
    [
        ("", 0, ""),
        ("World.tick:100", 1, ""),
        ("version", 2, ""),
        ("Client.get_server_version", 2, ""),
        ("", 0, "?sensors=carla&traffic=manager"),
    ],
)
def test_a_run_goes_on(fault: str, code: int, more: str, tmp_path: Path) -> None:
    """Through the command: a server that dies fails episodes, and one that never answers is a line."""
    path = f"{STAND_IN}:{Path(adapter.__file__).parents[3]}"
    done = ssad_process(
        "run",
        "precrash",
        "--out",
        str(tmp_path / "run"),
        "--set",
        f"simulator=carla://here:2000{more}",
        "--set",
        "systems=[blind]",
        "--set",
        "scenarios=[StraightObstacle]",
        "--set",
        "repetitions=1",
        PYTHONPATH=path,
        CARLA_STAND_IN_FAULT=fault,
    )
    assert done.returncode == code, done.stdout + done.stderr
    if code == 2:
        assert len(done.stderr.splitlines()) == 1
        return
    records = [json.loads(line) for line in (tmp_path / "run" / "results.jsonl").read_text().splitlines()]
    assert len(records) == 4
    bad = [record for record in records if record["status"] != "ok"]
    assert (len(bad) > 0) == bool(fault)
    assert all("CARLA at here:2000: cannot" in record["reason"] for record in bad)
    for record in records:  # what CARLA's lane sensor counts stands beside what the mirror measures
        if record["status"] == "ok":
            assert {"lane_invasions", "off_road"} <= set(record["metrics"])
            assert record["metrics"]["lane_crossings"] == record["measured"]["lane_crossings"]
            assert sum(record["measured"]["lane_markings"].values()) >= record["metrics"]["lane_crossings"]
    with (tmp_path / "run" / "tables" / "metrics.csv").open(newline="") as file:
        assert {"OR", "LI", "LC"} <= {row["column"] for row in csv.DictReader(file)}


# ---------------------------------------------------------------- the real wheel


def _wheel() -> Path:
    spec = importlib.util.find_spec("carla")
    if spec is None or not spec.submodule_search_locations:
        pytest.skip("the package carla is not installed (it has no wheel for this Python)")
    return Path(spec.submodule_search_locations[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "old", "new", "code"),
    [
        ("simulator", "hand_brake=", "hand_brake=", 0),
        ("simulator", "hand_brake=", "handbrake=", 1),
        ("simulator", "set_target_velocity(", "set_speed(", 1),
        ("sensors", "a", "a", 0),
        ("sensors", "raw_data", "data", 1),
        ("traffic", "a", "a", 0),
        ("server", "a", "a", 0),
        ("events", "a", "a", 0),
        ("events", "crossed_lane_markings", "markings", 1),
        ("traffic", "set_path", "set_way", 1),
    ],
)
def test_mypy_checks_the_stubs(part: str, old: str, new: str, code: int, tmp_path: Path) -> None:
    """Every class, method, argument and attribute; mypy does not find the wheel's stubs by itself."""
    place = tmp_path / "stubs" / "carla"
    place.mkdir(parents=True)
    for name in ("libcarla", "command"):
        text = (_wheel() / f"{name}.pyi").read_text(encoding="utf-8")
        (place / f"{name.replace('libcarla', '__init__')}.pyi").write_text(text, encoding="utf-8")
    source = Path(adapter.__file__).with_name(f"{part}.py")
    changed = tmp_path / "adapter.py"
    changed.write_text(source.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    words = ["--strict", "--cache-dir", str(tmp_path.parent / "mypy"), str(changed)]
    path = f"{tmp_path / 'stubs'}:{source.parents[3]}"
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), *words],
        env=os.environ | {"MYPYPATH": path},
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == code, done.stdout + done.stderr


def _stubs() -> dict[str, ast.ClassDef]:
    text = (_wheel() / "libcarla.pyi").read_text(encoding="utf-8")
    return {node.name: node for node in ast.parse(text).body if isinstance(node, ast.ClassDef)}


def _members(stubs: dict[str, ast.ClassDef], name: str) -> dict[str, list[ast.AST]]:
    """Members of a class of the stubs and of its bases."""
    found: dict[str, list[ast.AST]] = {}
    for base in stubs[name].bases:
        if isinstance(base, ast.Name) and base.id in stubs:
            found |= _members(stubs, base.id)
    for node in stubs[name].body:
        if isinstance(node, ast.FunctionDef):
            found.setdefault(node.name, []).append(node)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[node.target.id] = [node]
        elif isinstance(node, ast.Assign):
            found |= {target.id: [node] for target in node.targets if isinstance(target, ast.Name)}
    return found


@pytest.mark.slow
def test_the_wheel_has_the_weathers() -> None:
    _wheel()
    code = "import carla; print(*(name for name in dir(carla.WeatherParameters) if name[0].isupper()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert {*WEATHERS, "Default"} == set(done.stdout.split())


def test_the_stand_in_has_nothing_that_the_wheel_has_not() -> None:
    """Classes, methods, arguments with their order, attributes: what runs here runs on no invented name."""
    stubs = _stubs()
    spec = importlib.util.spec_from_file_location("carla_stand_in", STAND_IN / "carla" / "__init__.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["carla_stand_in"] = module
    spec.loader.exec_module(module)
    del sys.modules["carla_stand_in"]
    own = {
        name: kind
        for name, kind in vars(module).items()
        if inspect.isclass(kind) and kind.__module__ == "carla_stand_in"
    }
    assert len(own) > 20
    checked = 0
    for name, kind in own.items():
        assert name in stubs, f"carla has no {name}"
        members = _members(stubs, name)
        listed = {k for k in vars(kind) if not k.startswith("_")} | set(getattr(kind, "__dataclass_fields__", ()))
        for member in listed:
            told = ast.unparse(stubs[name])  # the presets of the weather stand in its text
            assert member in members or (name, member in told) == ("WeatherParameters", True), f"{name}.{member}"
            checked += 1
        for member in (*listed, *(["__init__"] if hasattr(kind, "__dataclass_fields__") else [])):
            method = vars(kind).get(member)
            wanted = [n for n in members.get(member, ()) if isinstance(n, ast.FunctionDef)]
            if not inspect.isfunction(method) or not wanted or name in ("WorldSettings", "CollisionEvent"):
                continue
            mine = list(inspect.signature(method).parameters)
            theirs = [[a.arg for a in node.args.args] for node in wanted]
            assert any(mine == other[: len(mine)] for other in theirs), f"carla.{name}.{member}: {mine} {theirs}"
            checked += 1
    assert checked > 80

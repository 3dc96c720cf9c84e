"""An agent of the CARLA leaderboard drives: what it is told, what it answers, what is refused."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.command import ssad

from ssad.core.driving import Observation, step_options, with_finer_steps
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.traces import first_difference
from ssad.core.types import Actor, Episode, EpisodeLimits, Pose, Scenario
from ssad.drivers import make_system
from ssad.drivers.leaderboard import Leaderboard
from ssad.drivers.leaderboard.carla_types import RoadOption
from ssad.drivers.leaderboard.driver import _global_plan
from ssad.drivers.leaderboard.sensors import encode_depth, geolocation
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.simulators.closed_loop import drive, onboard_sensors, scenario_json
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

# as somebody wrote it for leaderboard 2.0: nothing of SSAD in it
AGENT = """
import math
import carla
from leaderboard.autoagents.autonomous_agent import AutonomousAgent, Track


def get_entry_point():
    return "Follower"


class Follower(AutonomousAgent):
    def setup(self, path_to_conf_file):
        self.track, self.speed, self.at = Track.SENSORS, 6.0, 0

    def set_global_plan(self, global_plan_gps, global_plan_world_coord):
        self.plan = [(t.location.x, t.location.y) for t, option in global_plan_world_coord]

    def sensors(self):
        return [{"type": kind, "id": kind.split(".")[-1]} for kind in
                ("sensor.other.gnss", "sensor.other.imu", "sensor.speedometer")]

    def run_step(self, input_data, timestamp):
        latitude, longitude, _ = input_data["gnss"][1]
        x, y = math.radians(longitude) * 6378137, -math.log(math.tan((90 + latitude) * math.pi / 360)) * 6378137
        away = lambda k: math.dist((x, y), self.plan[k])
        self.at = min(range(self.at, min(self.at + 10, len(self.plan))), key=away)
        tx, ty = self.plan[min(self.at + 6, len(self.plan) - 1)]
        heading = input_data["imu"][1][6] - math.pi / 2
        turn = math.remainder(math.atan2(ty - y, tx - x) - heading, 2 * math.pi)
        slow = input_data["speedometer"][1]["speed"] < self.speed
        return carla.VehicleControl(throttle=0.6 * slow, steer=max(-1.0, min(1.0, 1.2 * turn)), brake=0.0)
"""


def world_of_agents(episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph]) -> World:
    """Return a world with the steps of the leaderboard."""
    return World(with_finer_steps(episodes, 2), graphs, **step_options(2))


EYES = [
    {"type": "sensor.lidar.ray_cast", "id": "lidar", "x": 0.0, "y": 0.0, "z": 2.0, "roll": 0, "pitch": 0, "yaw": 0},
    {
        "type": "sensor.other.radar",
        "id": "radar",
        "x": 2.45,
        "y": 0.0,
        "z": 0.7,
        "roll": 0,
        "pitch": 0,
        "yaw": 0,
        "horizontal_fov": 30,
        "vertical_fov": 20,
    },
]


@pytest.fixture
def agent(tmp_path: Path) -> Path:
    path = tmp_path / "agent.py"
    path.write_text(AGENT)
    return path


@pytest.mark.parametrize("every", [9, pytest.param(1, marks=pytest.mark.slow)])
def test_an_agent_of_thirty_lines_drives(agent: Path, every: int) -> None:
    """It keeps to its route on every town's roads, and hits who comes into its way, since it looks at nobody."""
    assert len(AGENT.strip().splitlines()) <= 32
    scenarios = load_scenarios("precrash")[::every]
    episodes = [build_episode(s, load_town(s.town), seed=0) for s in scenarios]
    traces = rollout(
        world_of_agents(episodes, {e.town: load_town(e.town) for e in episodes}), make_system(f"leaderboard:{agent}")
    )
    for trace in traces:
        assert trace.route_distance.max() < 2.0, trace.key
        assert not trace.off_road.any(), trace.key
        assert trace.end in ("collision", "complete", "max_distance"), trace.key
        assert trace.speed[:, 0].max() < 7.5
    assert any(trace.end == "collision" for trace in traces)


@pytest.mark.slow
def test_the_command_drives_it(agent: Path, tmp_path: Path) -> None:
    done = ssad(
        "run",
        "precrash",
        "--out",
        tmp_path / "run",
        "--workers",
        "1",
        "--set",
        f"systems=[leaderboard:{agent}]",
        "--set",
        "scenarios=[StraightObstacle/00]",
        "--set",
        "repetitions=1",
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "run" / "report.html").is_file()


def _view(yaw: float, time: float, speed: float) -> Observation:
    one = np.ones(1, np.float32)
    pose = np.array([[30.0, 40.0, yaw]], np.float32)
    rest = dict.fromkeys(("route", "lane_offset", "heading_error", "others_lane"))
    return Observation(
        scene=np.zeros(1, np.int32),
        agent=np.zeros(1, np.int32),
        time=one * time,
        speed=one * speed,
        accel=one * 0.5,
        pose=pose,
        target_speed=one * 8,
        done=np.zeros(1, bool),
        others=np.zeros((1, 16, 7), np.float32),
        signal=np.array([[0.0, 1e6]], np.float32),
        readings={"front": np.arange(12, dtype=np.uint8).reshape(1, 3, 2, 2)},
        **rest,
    )


def test_what_an_agent_is_told(tmp_path: Path) -> None:
    """Frames are CARLA's: y to the right, yaw clockwise, pictures BGRA; the plan says where it turns."""
    path = tmp_path / "told.py"
    camera = {
        "type": "sensor.camera.rgb",
        "id": "front",
        "x": 1,
        "y": 0.5,
        "z": 2,
        "yaw": 90,
        "width": 64,
        "height": 32,
    }
    text = AGENT.replace('("sensor.other.gnss",', '("sensor.opendrive_map", "sensor.other.gnss",')
    text = text.replace("return [{", f"return [{camera | {'height': 32, 'fov': 90}}] + [{{")
    step = "def run_step(self, input_data, timestamp):\n        "
    seen = "self.seen = input_data, timestamp\n        return carla.VehicleControl(0.25, 0.5, 0.125)\n        "
    path.write_text(text.replace(step, step + seen))
    driver = Leaderboard(str(path))
    turn = load_scenarios("UnprotectedLeftTurn/00")[0]
    driver.reset([build_episode(turn, load_town(turn.town), seed=0)])
    driver.act(_view(0.0, 1.0, 5.0))
    assert driver.act(_view(0.1, 1.1, 5.0)).tolist() == [[0.25, 0.125, -0.5, 0.0]]
    data, timestamp = driver._agents[0].seen
    assert timestamp == pytest.approx(1.1)
    assert {key: value[0] for key, value in data.items()} == dict.fromkeys(data, 22)  # 20 Hz
    assert data["front"][1].shape == (2, 2, 4)
    assert data["front"][1][0, 0].tolist() == [8, 4, 0, 255]
    assert data["gnss"][1] == pytest.approx(geolocation(30.0, 40.0), abs=5e-5)  # ten standard deviations
    imu = data["imu"][1]
    assert imu[5] == pytest.approx(-1.0, abs=1e-2)  # to the left is against the clock
    assert imu[6] == pytest.approx(math.pi / 2 - 0.1, abs=1e-6)  # east is a quarter turn from north
    assert "<OpenDRIVE>" in data["opendrive_map"][1]["opendrive"]
    eye = driver.cameras["front"]
    assert eye.to_ego[:3, 2] == pytest.approx([0.0, -1.0, 0.0], abs=1e-9)  # it looks to the right
    assert eye.to_ego[:3, 3].tolist() == [1.0, -0.5, 2.0]
    assert eye.intrinsic[0, 0] == pytest.approx(32.0)
    episode = build_episode(turn, load_town(turn.town), seed=0)
    told = {int(option) for _, option in _global_plan(episode.agents[0].route, load_town(turn.town))[1]}
    assert told == {int(RoadOption.LEFT), int(RoadOption.LANEFOLLOW)}


def _readings(driver: Leaderboard, key: str = "") -> np.ndarray:
    """GNSS and IMU [400, 10] of an ego that drives straight on at 5 m/s, east."""
    scenario = load_scenarios("StraightObstacle/00")[0]
    episode = build_episode(scenario, load_town(scenario.town), seed=0)
    driver.reset([replace(episode, key=key or episode.key)])
    rows = []
    for step in range(400):
        driver.act(_view(0.0, 0.05 * step, 5.0))
        data = driver._agents[0].seen[0]
        rows.append(np.concatenate([data["gnss"][1], data["imu"][1]]))
    return np.array(rows)


def test_gnss_and_imu_have_the_noise_of_the_leaderboard(tmp_path: Path) -> None:
    """Source: agent_wrapper.py of leaderboard 1.0 to 2.1."""
    path = tmp_path / "noise.py"
    step = "def run_step(self, input_data, timestamp):\n        "
    path.write_text(AGENT.replace(step, step + "self.seen = input_data, timestamp\n        "))
    rows = _readings(Leaderboard(str(path)))
    expected = np.array([5e-6, 5e-6, 5e-6, 1e-3, 1e-3, 1.5e-2, 1e-3, 1e-3, 1e-3])
    assert rows[:, :9].std(0) == pytest.approx(expected, rel=0.2)
    mean = [*geolocation(30.0, 40.0), 0.5, 0.0, 9.81, 0.0, 0.0, 0.0]
    assert (np.abs(rows[:, :9].mean(0) - mean) < 0.25 * expected).all(), "five standard errors"
    assert rows[:, 9].std() == 0.0, "the compass is exact"
    assert np.array_equal(_readings(Leaderboard(str(path))), rows), "the same episode, the same noise"
    assert not np.array_equal(_readings(Leaderboard(str(path)), "another")[:, :9], rows[:, :9])


def test_gnss_is_where_it_is_mounted(tmp_path: Path) -> None:
    path = tmp_path / "mounted.py"
    step = "def run_step(self, input_data, timestamp):\n        "
    text = AGENT.replace(step, step + "self.seen = input_data, timestamp\n        ")
    path.write_text(
        text.replace('"id": kind.split(".")[-1]}', '"id": kind.split(".")[-1], "x": -1.4, "y": 0.5, "z": 2}')
    )
    rows = _readings(Leaderboard(str(path)))
    assert rows[:, :2].mean(0) == pytest.approx(geolocation(28.6, 39.5)[:2], abs=2e-6)
    assert rows[:, 2].mean() == pytest.approx(2.0, abs=1e-3)


# imports what agents import of scenario_runner, and asks it while it drives
SRUNNER = """
import carla
from leaderboard.autoagents import autonomous_agent
from srunner.scenariomanager.carla_data_provider import CarlaDataProvider
from srunner.scenariomanager.timer import GameTime


def get_entry_point():
    return "A"


class A(autonomous_agent.AutonomousAgent):
    def setup(self, path):
        self.track = autonomous_agent.Track.SENSORS
        self.facts = []

    def sensors(self):
        return [dict(type="sensor.speedometer", reading_frequency=20, id="s")]

    def run_step(self, data, timestamp):
        hero = CarlaDataProvider.get_hero_actor()
        vehicles = CarlaDataProvider.get_world().get_actors().filter("vehicle.*")
        waypoint = CarlaDataProvider.get_map().get_waypoint(hero.get_location())
        self.facts.append((hero, waypoint, vehicles, GameTime.get_time(), timestamp))
        return carla.VehicleControl(throttle=0.3)
"""


def test_an_agent_asks_scenario_runner(tmp_path: Path) -> None:
    """The ego, the agents near it, the lane under it and the time, in CARLA's frame, each agent of its own scene."""
    path = tmp_path / "agent.py"
    path.write_text(SRUNNER)
    episodes = [build_episode(load_scenarios(name)[0], load_town("ProvingGround"), seed=0) for name in LEFT_AND_AHEAD]
    episodes = [replace(episode, limits=replace(episode.limits, max_steps=12)) for episode in episodes]
    driver = make_system(f"leaderboard:{path}")
    traces = rollout(world_of_agents(episodes, {"ProvingGround": load_town("ProvingGround")}), driver)
    for trace, agent in zip(traces, driver.act.__self__._agents, strict=True):
        hero, waypoint, vehicles, time, timestamp = agent.facts[20]
        x, y, yaw = (float(values[20, 0]) for values in (trace.x, trace.y, trace.yaw))
        location, rotation = hero.get_location(), hero.get_transform().rotation
        assert (location.x, location.y) == pytest.approx((x, -y), abs=1e-4)
        assert rotation.yaw == pytest.approx(-math.degrees(yaw), abs=1e-3)
        speed = float(trace.speed[20, 0])
        assert hero.get_velocity().x == pytest.approx(speed * math.cos(yaw), abs=1e-3)
        assert hero.get_velocity().y == pytest.approx(-speed * math.sin(yaw), abs=1e-3)
        assert waypoint.transform.location.distance(location) < 0.5
        assert waypoint.lane_width > 3.0
        assert time == timestamp == pytest.approx(1.0)
        others = {(round(float(trace.x[20, k]), 2), round(-float(trace.y[20, k]), 2)) for k in range(len(trace.names))}
        asked = {(round(actor.get_location().x, 2), round(actor.get_location().y, 2)) for actor in vehicles}
        assert asked <= others
        assert vehicles.find(1) is hero


LEFT_AND_AHEAD = ("UnprotectedLeftTurn/00", "StraightObstacle/00")

# the leaderboard's own example: a BasicAgent along the plan
NPC = """
import carla
from agents.navigation.basic_agent import BasicAgent
from leaderboard.autoagents.autonomous_agent import AutonomousAgent, Track
from srunner.scenariomanager.carla_data_provider import CarlaDataProvider


def get_entry_point():
    return "Npc"


class Npc(AutonomousAgent):
    def setup(self, path_to_conf_file):
        self.track, self.agent, self.red = Track.SENSORS, None, []

    def sensors(self):
        return [{"type": "sensor.speedometer", "id": "speed"}]

    def run_step(self, input_data, timestamp):
        if self.agent is None:
            for actor in CarlaDataProvider.get_world().get_actors():
                if actor.attributes.get("role_name") == "hero":
                    self.agent = BasicAgent(actor, 20)
            plan, previous = [], None
            for transform, _ in self._global_plan_world_coord:
                waypoint = CarlaDataProvider.get_map().get_waypoint(transform.location)
                if previous:
                    plan.extend(self.agent.trace_route(previous, waypoint))
                previous = waypoint
            self.agent.set_global_plan(plan)
        return self.agent.run_step()
"""


def test_a_basic_agent_drives_the_plan(tmp_path: Path) -> None:
    """It keeps to the route through turns at 20 km/h, stops at a red light and behind what stands in its lane."""
    path = tmp_path / "npc.py"
    path.write_text(NPC)
    names = ("UnprotectedLeftTurn/00", "LaneChanging/00", "RightTurn/00")
    town = load_town("ProvingGround")
    routes = [build_episode(load_scenarios(name)[0], town, seed=0) for name in names]
    alone = [replace(episode, agents=episode.agents[:1]) for episode in routes]
    parked = Actor("parked", "van", Pose(249.0, -5.25, 0.0))
    route = (Pose(217.0, -5.25), Pose(300.0, -5.25))
    blocked = Scenario("blocked", "Custom", town.name, route, actors=(parked,), limits=EpisodeLimits(max_steps=200))
    episodes = [*alone, build_episode(blocked, town, seed=0)]
    *free, red, waits = rollout(world_of_agents(episodes, {town.name: town}), make_system(f"leaderboard:{path}"))
    for trace in free:
        assert trace.end in ("complete", "max_distance"), trace.key
        assert trace.route_distance.max() < 2.0, trace.key
        assert not trace.off_road.any(), trace.key
        assert 4.5 < trace.speed[:, 0].max() < 6.5
    assert red.end == "max_steps"
    assert red.speed[-1, 0] < 0.1
    assert not red.red_light.any()
    assert not waits.contact.any()
    assert waits.speed[-1, 0] < 0.1
    assert 1.0 < 249.0 - 0.5 * waits.length[1] - waits.x[-1, 0] - 0.5 * waits.length[0] < 10.0


# what agents import of other modules, and what they do with it
IMPORTS = """
import carla
import srunner.scenariomanager.carla_data_provider as provider
from agents.navigation.basic_agent import *
from agents.navigation.behavior_agent import BehaviorAgent
from agents.navigation.controller import VehiclePIDController
from agents.navigation.local_planner import LocalPlanner, LocalPlannerBehavior, RoadOption
from agents.tools.misc import compute_distance, draw_waypoints, get_speed, is_within_distance
from carla import ColorConverter
from leaderboard.autoagents.autonomous_agent import AutonomousAgent, Track
from leaderboard.envs.sensor_interface import SensorInterface, SensorReceivedNoData
from leaderboard.utils.route_manipulation import interpolate_trajectory
from leaderboard.utils.statistics_manager import StatisticsManager
from srunner.scenariomanager.carla_data_provider import CarlaActorPool, CarlaDataProvider
from srunner.scenariomanager.scenarioatomics.atomic_criteria import CollisionTest
from srunner.tools.scenario_helper import get_waypoint_in_distance


class OwnCriterion(CollisionTest):
    pass


def get_entry_point():
    return "Mixed"


class Mixed(AutonomousAgent):
    def setup(self, path_to_conf_file):
        self.track, self.driver, self.facts = Track.SENSORS, None, []

    def sensors(self):
        return [{"type": "sensor.speedometer", "id": "speed"}]

    def run_step(self, input_data, timestamp):
        hero = CarlaDataProvider.get_hero_actor()
        self.facts.append((get_speed(hero), 3.6 * input_data["speed"][1]["speed"], hasattr(CarlaActorPool, "x")))
        if self.driver is None:
            locations = [transform.location for transform, _ in self._global_plan_world_coord]
            self.gps, route = interpolate_trajectory(locations)
            route = [(provider.CarlaDataProvider.get_map().get_waypoint(t.location), option) for t, option in route]
            self.driver = KIND
            self.driver.set_global_plan(route)
        try:
            return self.driver.run_step()
        except SensorReceivedNoData:
            return carla.VehicleControl(brake=1.0)


class Pid:
    def __init__(self, hero):
        gains = {"K_P": 1.0, "K_D": 0.1, "dt": 0.05}
        self.hero, self.controller = hero, VehiclePIDController(hero, gains, gains)

    def set_global_plan(self, route):
        self.route = route

    def run_step(self):
        transform = CarlaDataProvider.get_hero_actor().get_transform()
        ahead = [w for w, _ in self.route if is_within_distance(w.transform, transform, 50.0, (-1.0, 90.0))]
        aims = [w for w in ahead if compute_distance(w.transform.location, transform.location) > 4.0]
        return self.controller.run_step(20.0, aims[0])
"""


@pytest.mark.parametrize(
    ("kind", "speed"),
    [("LocalPlanner(hero)", 20.0), ("BehaviorAgent(hero, behavior='cautious')", 40.0), ("Pid(hero)", 20.0)],
)
def test_agents_import_what_they_may_not_need(tmp_path: Path, kind: str, speed: float) -> None:
    """Planners and controllers drive along the plan; further names of the packages can be imported."""
    path = tmp_path / "mixed.py"
    path.write_text(IMPORTS.replace("KIND", kind))
    town = load_town("ProvingGround")
    episode = build_episode(load_scenarios("StraightObstacle/00")[0], town, seed=0)
    episode = replace(episode, agents=episode.agents[:1], limits=replace(episode.limits, max_steps=60))
    driver = make_system(f"leaderboard:{path}")
    (trace,) = rollout(world_of_agents([episode], {town.name: town}), driver)
    agent = driver.act.__self__._agents[0]
    assert trace.route_distance.max() < 0.5
    assert 3.6 * trace.speed[-1, 0] == pytest.approx(speed, abs=1.5)
    for told, measured, has_name in agent.facts:
        assert told == pytest.approx(measured, abs=0.01)
        assert not has_name
    (place, _), (start, _) = agent.gps[0], agent._global_plan[0]
    assert (place["lat"], place["lon"]) == pytest.approx((start["lat"], start["lon"]), abs=1e-5)


@pytest.mark.parametrize(
    ("deed", "message"),
    [
        ("StatisticsManager()", r"leaderboard\.utils\.statistics_manager\.StatisticsManager has no stand-in"),
        ("OwnCriterion()", r"srunner\.scenariomanager\.scenarioatomics\.atomic_criteria\.CollisionTest has no"),
        ("LocalPlannerBehavior.OVERTAKE", r"local_planner\.LocalPlannerBehavior\.OVERTAKE has no stand-in"),
        ("CarlaDataProvider.request_new_actor('car', None)", r"CarlaDataProvider\.request_new_actor has no stand-in"),
        ("CarlaDataProvider.get_hero_actor().apply_control(None)", r"carla\.Actor\.apply_control needs a CARLA"),
    ],
)
def test_the_use_of_what_has_no_stand_in_is_one_line(tmp_path: Path, deed: str, message: str) -> None:
    path = tmp_path / "mixed.py"
    path.write_text(IMPORTS.replace("KIND", deed))
    town = load_town("ProvingGround")
    episode = build_episode(load_scenarios("StraightObstacle/00")[0], town, seed=0)
    driver = make_system(f"leaderboard:{path}")
    with pytest.raises(ConfigError, match=message) as error:
        rollout(world_of_agents([episode], {town.name: town}), driver)
    assert "\n" not in str(error.value)


NETWORK = """
import carla
import torch
from leaderboard.autoagents.autonomous_agent import AutonomousAgent, Track

LOADED = []


def get_entry_point():
    return "Network"


class Network(AutonomousAgent):
    def setup(self, path_to_conf_file):
        LOADED.append(1)
        self.track, self.steps, self.parts = Track.SENSORS, [], {"net": torch.nn.Linear(1, 1)}
        torch.nn.init.constant_(self.parts["net"].weight, 0.1)
        torch.nn.init.constant_(self.parts["net"].bias, 0.2)

    def sensors(self):
        return [{"type": "sensor.speedometer", "id": "speed"}]

    def run_step(self, input_data, timestamp):
        speed = input_data["speed"][1]["speed"]
        self.steps.append(timestamp)
        throttle = float(self.parts["net"](torch.tensor([speed])).detach())
        return carla.VehicleControl(throttle=throttle * (len(self.steps) > 3))
"""


def test_a_batch_shares_its_networks(tmp_path: Path) -> None:
    """`share=true`: one setup and one network for all episodes, but a state of its own for each."""
    pytest.importorskip("torch")
    path = tmp_path / "network.py"
    path.write_text(NETWORK)
    town = load_town("ProvingGround")
    episodes = [build_episode(load_scenarios(name)[0], town, seed=0) for name in (*LEFT_AND_AHEAD, "RightTurn/00")]
    episodes = [replace(episode, limits=replace(episode.limits, max_steps=10)) for episode in episodes]
    plain, shared = make_system(f"leaderboard:{path}"), make_system(f"leaderboard:{path}?share=true@shared")
    assert shared.name == "shared"
    loaded = plain.act.__self__._agent_class.setup.__globals__["LOADED"]
    traces = rollout(world_of_agents(episodes, {town.name: town}), plain)
    assert len(loaded) >= len(episodes)
    loaded = shared.act.__self__._agent_class.setup.__globals__["LOADED"]
    count = len(loaded)
    for trace, other in zip(traces, rollout(world_of_agents(episodes, {town.name: town}), shared), strict=True):
        assert first_difference(trace, other) is None
    assert len(loaded) == count, "no further setup"
    agents = shared.act.__self__._agents
    assert len({id(agent.parts["net"]) for agent in agents}) == 1
    assert len({id(agent.steps) for agent in agents}) == 3
    assert all(len(agent.steps) == 20 for agent in agents)
    assert agents[0]._global_plan != agents[1]._global_plan
    with pytest.raises(ConfigError, match="share is true or false, not 3"):
        make_system(f"leaderboard:{path}?share=3")
    with pytest.raises(ConfigError, match="unexpected keyword argument 'shared'"):
        make_system(f"leaderboard:{path}?shared=true")
    path.write_text(
        NETWORK.replace(
            "self.steps, self.parts = Track.SENSORS, [],", "self.steps, self.parts, self.lock = Track.SENSORS, [],"
        ).replace("Linear(1, 1)}", 'Linear(1, 1)}, __import__("threading").Lock()')
    )
    with pytest.raises(ConfigError, match=r"share=true: it cannot be copied: TypeError.*leave share out"):
        make_system(f"leaderboard:{path}?share=true").reset(episodes[:1])


def test_the_plan_is_there_in_setup(tmp_path: Path) -> None:
    """As in the leaderboard, which gives the plan before it sets an agent up."""
    path = tmp_path / "agent.py"
    line = "self.track, self.speed, self.at = Track.SENSORS, 6.0, 0"
    path.write_text(AGENT.replace(line, line + "; self.early = len(getattr(self, 'plan', []))"))
    driver = Leaderboard(str(path))
    scenario = load_scenarios("StraightObstacle/00")[0]
    driver.reset([build_episode(scenario, load_town(scenario.town), seed=0)])
    assert driver._agents[0].early == len(driver._agents[0].plan) > 50


def test_lidar_and_radar(tmp_path: Path) -> None:
    """A car ahead and to the right, and one on the left that comes nearer: where they are, and how fast."""
    path = tmp_path / "eyes.py"
    text = AGENT.replace("return [{", f"return {EYES} + [{{")
    step = "def run_step(self, input_data, timestamp):\n        "
    path.write_text(text.replace(step, step + "self.seen = getattr(self, 'seen', []) + [input_data]\n        "))
    drives = ((0.0, 249.0, -5.25, 0.0), (3.0, 249.0, -5.25, 0.0))
    nearer = ((0.0, 260.0, -1.75, math.pi), (3.0, 239.0, -1.75, math.pi))
    actors = (
        Actor("stands", "van", Pose(249.0, -5.25, 0.0), trajectory=drives),
        Actor("comes", "van", Pose(260.0, -1.75, math.pi), trajectory=nearer),
    )
    route = (Pose(229.0, -3.5), Pose(300.0, -5.25))
    scenario = Scenario("eyes", "Custom", "ProvingGround", route, actors=actors, limits=EpisodeLimits(max_steps=6))
    episode = build_episode(scenario, load_town("ProvingGround"), seed=0)
    driver = make_system(f"leaderboard:{path}")
    world = world_of_agents([episode], {episode.town: load_town(episode.town)})
    (trace,) = rollout(world, driver, sensors=onboard_sensors([driver], "cpu"))
    seen = driver.act.__self__._agents[0].seen[4]
    points, hits = seen["lidar"][1], seen["radar"][1]
    assert points.dtype == hits.dtype == np.float32
    assert points.shape[1] == hits.shape[1] == 4
    assert 12_000 < len(points) < 40_000  # of 59,968, of which 45 % are lost, and those into the sky
    assert np.hypot(points[:, 0], points[:, 1]).max() < 85.1
    assert points[:, 3] == pytest.approx(np.exp(-0.004 * np.linalg.norm(points[:, :3], axis=1)), rel=1e-5)
    x, y, yaw, v = trace.x[4, 0], trace.y[4, 0], trace.yaw[4, 0], trace.speed[4, 0]
    for number, model in ((1, 0.5 * 5.2), (2, 0.5 * 5.2)):
        dx, dy = trace.x[4, number] - x, trace.y[4, number] - y
        ahead, right = dx * math.cos(yaw) + dy * math.sin(yaw), dx * math.sin(yaw) - dy * math.cos(yaw)
        on = (abs(points[:, 0] - ahead) < model + 0.1) & (abs(points[:, 1] - right) < 1.1) & (points[:, 2] > -1.5)
        assert on.sum() > 30
        assert points[on, 0].min() == pytest.approx(ahead - model, abs=0.4)
    speeds = np.unique(np.round(hits[hits[:, 3] != 0.0, 3] / np.cos(hits[hits[:, 3] != 0.0, 2]), 0))
    stands = hits[(hits[:, 2] > 0.0) & (abs(hits[:, 0] - 17.0) < 2.0)]
    comes = hits[(hits[:, 2] < 0.0) & (hits[:, 3] < -v - 4.0)]
    assert len(stands) > 2
    assert stands[:, 3] == pytest.approx(-v * np.cos(stands[:, 1]) * np.cos(stands[:, 2]), abs=0.05)
    assert len(comes) > 2, speeds
    assert comes[:, 3] == pytest.approx((-v - 7.0) * np.cos(comes[:, 1]) * np.cos(comes[:, 2]), abs=0.15)


@dataclass(frozen=True)
class Request:
    """Request for an episode, as plain data."""

    key: str
    system: str
    seed: int
    spec: Mapping[str, Any]


def test_agents_are_asked_twenty_times_a_second(tmp_path: Path) -> None:
    """With half a turn of the LiDAR each time, right and left by turns; the trace has steps of 0.1 s."""
    path = tmp_path / "often.py"
    text = AGENT.replace("return [{", f"return {EYES[:1]} + [{{")
    step = "def run_step(self, input_data, timestamp):\n        "
    record = "self.seen = getattr(self, 'seen', []) + [(timestamp, input_data['lidar'])]\n        "
    path.write_text(text.replace(step, step + record))
    scenario = load_scenarios("StraightObstacle/00")[0]
    spec = {"repetition": 0, "spread": 0.0}
    requests = [
        Request(
            str(steps), f"leaderboard:{path}", 0, spec | {"scenario": scenario_json(replace(scenario, limits=limits))}
        )
        for steps, limits in ((4, EpisodeLimits(max_steps=4)), (6, EpisodeLimits(max_time=0.6)))
    ]
    system = make_system(f"leaderboard:{path}")
    _, traces, _ = drive(requests, device="cpu", driver=system)
    assert [trace.dt for trace in traces] == [0.1, 0.1]
    assert [len(trace.x) for trace in traces] == [5, 7]
    assert [trace.end for trace in traces] == ["max_steps", "max_time"]
    for agent, count in zip(system.act.__self__._agents, (8, 12), strict=True):
        times = [time for time, _ in agent.seen]
        assert times == pytest.approx(np.arange(count) / 20)
        assert [number for _, (number, _) in agent.seen] == list(range(count))
        for number, (_, (_, points)) in enumerate(agent.seen):
            side = -1.0 if number % 2 == 0 else 1.0
            assert len(points) > 5_000
            assert (side * points[:, 1] >= -1e-3).all(), "left, then right"
    distance = np.hypot(np.diff(traces[1].x[:, 0]), np.diff(traces[1].y[:, 0]))
    assert distance == pytest.approx(np.diff(traces[1].driven), abs=1e-3)
    with pytest.raises(ConfigError, match=r"its period is 0\.03 s; it must divide 0\.1 s"):
        drive(requests, device="cpu", driver=SimpleNamespace(name="odd", period=0.03))


def test_depth_and_semantic_cameras(tmp_path: Path) -> None:
    """24 bits over 1000 m: the rear of a van ahead, the road below, and the sky."""
    path = tmp_path / "depth.py"
    mount = {"x": 1.0, "y": 0.0, "z": 2.0, "roll": 0.0, "pitch": 0.0, "yaw": 0.0}
    depth = {"type": "sensor.camera.depth", "id": "depth", "width": 80, "height": 60, "fov": 90} | mount
    labels = depth | {"type": "sensor.camera.semantic_segmentation", "id": "labels"}
    step = "def run_step(self, input_data, timestamp):\n        "
    text = AGENT.replace("return [{", f"return {[depth, labels]} + [{{")
    path.write_text(
        text.replace(step, step + "self.seen, self.labels = input_data['depth'], input_data['labels']\n        ")
    )
    van = Actor("van", "van", Pose(249.0, -5.25, 0.0))
    route = (Pose(229.0, -5.25), Pose(300.0, -5.25))
    scenario = Scenario("depth", "Custom", "ProvingGround", route, actors=(van,), limits=EpisodeLimits(max_steps=1))
    episode = build_episode(scenario, load_town("ProvingGround"), seed=0)
    driver = make_system(f"leaderboard:{path}")
    world = world_of_agents([episode], {episode.town: load_town(episode.town)})
    (trace,) = rollout(world, driver, sensors=onboard_sensors([driver], "cpu"))
    image = driver.act.__self__._agents[0].seen[1]
    assert (image.shape, image.dtype) == ((60, 80, 4), np.uint8)
    values = image.astype(np.float64)
    metres = 1000.0 * (values[..., 2] + 256.0 * values[..., 1] + 65536.0 * values[..., 0]) / (256**3 - 1)
    rear = 249.0 - 0.5 * float(trace.length[1]) - float(trace.x[0, 0]) - 1.0
    assert metres[31:34, 38:42] == pytest.approx(rear, abs=0.3)
    # 2 m above a level road, focal length 40 pixels: row r is at 2 * 40 / (r + 0.5 - 30)
    assert metres[59, 30:50] == pytest.approx(2.0 * 40.0 / 29.5, abs=0.05)
    assert (metres[0] == 1000.0).mean() > 0.5, "sky"
    label_image = driver.act.__self__._agents[0].labels[1]
    assert label_image[32, 40].tolist() == [0, 0, 14, 255], "a car, in red"
    assert (label_image[59, 30:50, 2] == 1).all(), "road"
    assert (label_image[0, :, 2] == 11).mean() > 0.5, "sky"


def test_depths_are_encoded_as_in_carla() -> None:
    image = encode_depth(np.array([[0.0, 1000.0, np.inf, 1000.0 / (256**3 - 1), 500.0]], np.float32))
    assert image[0, :, :3].tolist() == [[0, 0, 0], [255] * 3, [255] * 3, [0, 0, 1], [128, 0, 0]]


BAD = {
    "missing": (None, "no such file"),
    "broken": ("def", "importing it failed: SyntaxError"),
    "no entry": ("x = 1", "names no class"),
    "wrong entry": ("def get_entry_point(): return 'x'", "names no class"),
    "setup fails": (AGENT.replace("self.track, ", "1 / 0; self.track, "), "setup failed: ZeroDivisionError"),
    "flow": (
        AGENT.replace("sensor.other.gnss", "sensor.camera.optical_flow"),
        "asks for the sensor sensor.camera.optical_flow",
    ),
    "no list": (AGENT.replace("return [{", "return 7; [{"), "must give a list, not int"),
    "sensors fails": (AGENT.replace("return [{", "return 1 / 0; [{"), "sensors.. failed: ZeroDivisionError"),
    "no type": (AGENT.replace("return [{", "return [{}] + [{"), "asks for the sensor None"),
    "one name twice": (
        AGENT.replace("return [{", 'return [{"type": "sensor.speedometer", "id": "imu"}] + [{'),
        "the id 'imu'",
    ),
    "two of one": (
        AGENT.replace("return [{", 'return [{"type": "sensor.speedometer", "id": "b"}] + [{'),
        "more than 1 sensors",
    ),
    "nine cameras": (
        AGENT.replace("return [{", 'return [{"type": "sensor.camera.rgb", "id": k} for k in range(9)] + [{'),
        "more than 8 sensors",
    ),
    "a place that is none": (
        AGENT.replace("return [{", 'return [{"type": "sensor.lidar.ray_cast", "id": "l", "z": "up"}] + [{'),
        "z is not a number",
    ),
    "far away": (
        AGENT.replace("return [{", 'return [{"type": "sensor.lidar.ray_cast", "id": "l", "z": float("nan")}] + [{'),
        "outside -100 to 100",
    ),
    "a field beyond all": (
        AGENT.replace("return [{", 'return [{"type": "sensor.other.radar", "id": "r", "horizontal_fov": 400}] + [{'),
        "outside 0.1 to 170",
    ),
    "huge": (
        AGENT.replace("return [{", 'return [{"type": "sensor.camera.rgb", "id": "c", "width": 10**6}] + [{'),
        "outside 1 to 4096",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_agent_is_refused_in_a_line(name: str, tmp_path: Path) -> None:
    text, message = BAD[name]
    path = tmp_path / "agent.py"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=message) as error:
        make_system(f"leaderboard:{path}")
    assert "\n" not in str(error.value)


def test_it_drives_where_nothing_of_carla_is_installed(agent: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(sys.modules):
        if name.partition(".")[0] in ("carla", "leaderboard", "agents", "srunner"):
            monkeypatch.delitem(sys.modules, name)
    real = __import__("importlib").import_module

    def without(name: str, *rest: object, **options: object) -> object:
        if name == "carla":
            raise ImportError(name)
        return real(name, *rest, **options)

    monkeypatch.setattr("importlib.import_module", without)
    driver = Leaderboard(str(agent))
    scenario = load_scenarios("StraightObstacle/00")[0]
    driver.reset([build_episode(scenario, load_town(scenario.town), seed=0)])
    assert sys.modules["carla"].VehicleControl.__module__ == "ssad.drivers.leaderboard.carla_types"
    for name in ("carla", "leaderboard", "agents", "srunner"):
        monkeypatch.delitem(sys.modules, name, raising=False)

"""An agent of the CARLA leaderboard drives: what it is told, what it answers, what is refused."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad

from ssad.core.driving import Observation
from ssad.core.errors import ConfigError
from ssad.drivers import make_system
from ssad.drivers.leaderboard import Leaderboard, RoadOption, _plan, geolocation
from ssad.roads import load_town
from ssad.scenarios.dynamic import build_episode, load_scenarios
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
        World(episodes, {e.town: load_town(e.town) for e in episodes}), make_system(f"leaderboard:{agent}")
    )
    for trace in traces:
        assert trace.route_distance.max() < 1.5, trace.key
        assert not trace.off_road.any(), trace.key
        assert trace.end in ("collision", "complete", "max_distance"), trace.key
        assert trace.speed[:, 0].max() < 7.5
    assert any(trace.end == "collision" for trace in traces)


@pytest.mark.slow
def test_the_command_drives_it(agent: Path, tmp_path: Path) -> None:
    done = ssad(
        "run", "precrash", "--out", tmp_path / "run", "--workers", "1", "--set", f"systems=[leaderboard:{agent}]",
        "--set", "scenarios=[StraightObstacle/00]", "--set", "repetitions=1",
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "run" / "report.html").is_file()


def _view(yaw: float, time: float, speed: float) -> Observation:
    one = np.ones(1, np.float32)
    pose = np.array([[30.0, 40.0, yaw]], np.float32)
    rest = dict.fromkeys(("route", "lane_offset", "heading_error", "others", "others_lane", "signal"))
    return Observation(
        scene=np.zeros(1, np.int32), agent=np.zeros(1, np.int32), time=one * time, speed=one * speed, accel=one * 0.5,
        pose=pose, target_speed=one * 8, done=np.zeros(1, bool),
        readings={"front": np.arange(12, dtype=np.uint8).reshape(1, 3, 2, 2)}, **rest,
    )  # fmt: skip


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
    assert {key: value[0] for key, value in data.items()} == dict.fromkeys(data, 11)
    assert data["front"][1].shape == (2, 2, 4)
    assert data["front"][1][0, 0].tolist() == [8, 4, 0, 255]
    assert data["gnss"][1] == pytest.approx(geolocation(30.0, 40.0), abs=1e-12)
    imu = data["imu"][1]
    assert imu[5] == pytest.approx(-1.0, abs=1e-4)  # to the left is against the clock
    assert imu[6] == pytest.approx(math.pi / 2 - 0.1, abs=1e-6)  # east is a quarter turn from north
    assert "<OpenDRIVE>" in data["opendrive_map"][1]["opendrive"]
    eye = driver.cameras["front"]
    assert eye.to_ego[:3, 2] == pytest.approx([0.0, -1.0, 0.0], abs=1e-9)  # it looks to the right
    assert eye.to_ego[:3, 3].tolist() == [1.0, -0.5, 2.0]
    assert eye.intrinsic[0, 0] == pytest.approx(32.0)
    episode = build_episode(turn, load_town(turn.town), seed=0)
    told = {int(option) for _, option in _plan(episode.agents[0].route, load_town(turn.town))[1]}
    assert told == {int(RoadOption.LEFT), int(RoadOption.LANEFOLLOW)}


BAD = {
    "missing": (None, "no such file"),
    "broken": ("def", "importing it failed: SyntaxError"),
    "no entry": ("x = 1", "names no class"),
    "wrong entry": ("def get_entry_point(): return 'x'", "names no class"),
    "setup fails": (AGENT.replace("self.track, ", "1 / 0; self.track, "), "setup failed: ZeroDivisionError"),
    "radar": (AGENT.replace("sensor.other.gnss", "sensor.other.radar"), "asks for the sensor sensor.other.radar"),
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
        if name.partition(".")[0] in ("carla", "leaderboard", "agents"):
            monkeypatch.delitem(sys.modules, name)
    real = __import__("importlib").import_module

    def without(name: str, *rest: object) -> object:
        if name == "carla":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr("importlib.import_module", without)
    driver = Leaderboard(str(agent))
    scenario = load_scenarios("StraightObstacle/00")[0]
    driver.reset([build_episode(scenario, load_town(scenario.town), seed=0)])
    assert sys.modules["carla"].VehicleControl.__module__ == "ssad.drivers.leaderboard"
    for name in ("carla", "leaderboard", "agents"):
        monkeypatch.delitem(sys.modules, name, raising=False)

"""The lane keeper as a driver: it steers by its image, and stops where it shows no lane."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ssad import World, build_episode, load_scenarios, load_town
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import U8, EpisodeLimits
from ssad.drivers.lane_keeping.driver import CHANNEL, LaneKeeper
from ssad.drivers.lane_keeping.limit_signs import LIMITS, Plate
from ssad.drivers.lane_keeping.markings import RoadGrid, RoadMap
from ssad.drivers.perceiving.driver import LaneEvent
from ssad.drivers.perceiving.planner import AutopilotPlanner
from ssad.drivers.perceiving.recorder import PerceptionRecorder
from ssad.metrics.lane_keeping import lane_metrics, lane_position
from ssad.world.rollout import rollout

PLATE = Plate((200.0, 60.0), 20.0, np.where(np.array(LIMITS) == 20, 0.95, 0.5))
CAMERA = Camera.typical(320, 192, channel=CHANNEL)
GRID = RoadGrid(row_step=0.5, column_step=0.1)


class DrawnRoad:
    """Camera that draws the two lines of the ego's lane as its route has them, with their perspective."""

    def __init__(self, graph: Any, shift: float = 0.0, lines: bool = True) -> None:
        self.graph, self.shift, self.lines = graph, shift, lines

    def __call__(self, simulator: Any, agents: Any) -> U8:
        images = np.full((len(agents), 3, CAMERA.height, CAMERA.width), 70, np.uint8)
        state = simulator.state()
        for row, (scene, agent) in enumerate(agents.tolist()):
            x, y, yaw = state.pose[scene, agent].astype(float).tolist()
            first, count = state.route[scene, agent].tolist()
            path = state.roads.path[first : first + count].astype(float)
            points = [
                (path[:, 0] - offset * np.sin(path[:, 2]), path[:, 1] + offset * np.cos(path[:, 2]))
                for offset in (1.75 + self.shift, -1.75 + self.shift)
            ]
            for line_x, line_y in points if self.lines else ():
                ahead = (line_x - x) * np.cos(yaw) + (line_y - y) * np.sin(yaw)
                lateral = (line_y - y) * np.cos(yaw) - (line_x - x) * np.sin(yaw)
                # Finer than the route, so that near lines have no gaps.
                order = np.argsort(ahead)
                depth = np.exp(np.linspace(np.log(3.0), np.log(45.0), 400))
                side = np.interp(depth, ahead[order], lateral[order])
                for part in np.linspace(-0.06, 0.06, 5):
                    camera = np.linalg.inv(CAMERA.to_ego) @ [depth, side + part, 0 * depth, 1 + 0 * depth]
                    u, v, _ = CAMERA.intrinsic @ camera[:3] / camera[2]
                    inside = (u >= 0) & (u < CAMERA.width) & (v >= 0) & (v < CAMERA.height)
                    images[row, :, v[inside].astype(int), u[inside].astype(int)] = 230
        return images


def drive(steps: int, **settings: Any) -> tuple[Any, Any, PerceptionRecorder]:
    (scenario,) = load_scenarios("lane-keeping/ProvingGround_straight_00")
    town = load_town(scenario.town)
    episode = replace(build_episode(scenario, town, seed=0), limits=EpisodeLimits(max_steps=steps))
    recorder = PerceptionRecorder({}, 1)
    driver = LaneKeeper(camera=CAMERA, grid=GRID, watch=recorder)
    world = World([episode], {town.name: town})
    (trace,) = rollout(world, driver, sensors={CHANNEL: DrawnRoad(town, **settings)})
    return trace, town, recorder


def test_it_keeps_the_middle_of_the_drawn_lane() -> None:
    trace, town, recorder = drive(75)
    metrics = lane_metrics(trace, town, recorder.lanes[0])
    assert trace.speed[-1, 0] > 8.0
    assert metrics["lane_deviation_max"] < 0.25
    assert metrics["lane_departure"] == 0.0
    assert metrics["lane_detection_rate"] == 1.0
    assert metrics["lane_error"] < 0.2
    assert len(recorder.images(0)) > 10


def test_it_follows_lines_that_are_not_where_the_map_has_them() -> None:
    trace, town, _ = drive(75, shift=0.6)
    assert lane_position(trace, town).deviation[-1] == pytest.approx(0.6, abs=0.25)


def test_it_stays_where_it_sees_no_lane() -> None:
    trace, _, recorder = drive(20, lines=False)
    assert trace.speed[:, 0].max() < 0.1
    assert recorder.lanes[0][-1][1] is None


def test_it_drives_at_the_limit_that_it_has_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readings are those of a reader that sees 30 km/h from the second second on."""
    monkeypatch.setattr("ssad.drivers.lane_keeping.driver.find_plates", lambda image, camera: [PLATE])
    (scenario,) = load_scenarios("lane-keeping/ProvingGround_straight_00")
    town = load_town(scenario.town)
    episode = replace(build_episode(scenario, town, seed=0), limits=EpisodeLimits(max_steps=75))
    tops = {}
    for set_speed in (None, 12.0):
        recorder = PerceptionRecorder({}, 1)
        driver = LaneKeeper(camera=CAMERA, grid=GRID, watch=recorder, set_speed=set_speed)
        world = World([episode], {town.name: town})
        (trace,) = rollout(world, driver, sensors={CHANNEL: DrawnRoad(town)})
        tops[set_speed] = float(trace.speed[:, 0].max())
        limits = [limit for _, limit in recorder.limits[0]]
        assert limits[:1] + limits[5:6] == ([] if set_speed is None else [None, 20])
    assert tops[12.0] == pytest.approx(20.0 / 3.6, abs=0.4)
    assert tops[None] > 8.0


def test_a_snapshot_keeps_the_lane() -> None:
    (scenario,) = load_scenarios("lane-keeping/ProvingGround_straight_00")
    town = load_town(scenario.town)
    episode = replace(build_episode(scenario, town, seed=0), limits=EpisodeLimits(max_steps=4))
    driver = LaneKeeper(camera=CAMERA, grid=GRID)
    rollout(World([episode], {town.name: town}), driver, sensors={CHANNEL: DrawnRoad(town)})
    snapshot = driver.snapshot_batch()
    states = [scene.filter.state.copy() for scene in driver._scenes if scene.filter.state is not None]
    driver.reset([episode])
    assert driver._scenes[0].filter.state is None
    driver.restore_batch(snapshot)
    np.testing.assert_array_equal([scene.filter.state for scene in driver._scenes], states)


def test_what_it_reads_and_refuses() -> None:
    driver = LaneKeeper(camera=CAMERA)
    assert driver.sensors[-1] == CHANNEL
    assert driver.cameras[CHANNEL] is CAMERA
    assert not hasattr(driver, "believe")
    assert RoadMap(CAMERA, GRID).pixels[0].shape == (len(GRID.row_distance), len(GRID.column_offset))
    assert LaneEvent(0, 0.0, None, np.zeros((3, 1, 1), np.uint8)).lane is None
    with pytest.raises(ConfigError, match="a lane keeper plans its own motion"):
        LaneKeeper(planner=AutopilotPlanner())

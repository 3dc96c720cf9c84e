"""The lane keeper: it steers by the lane markings that it detects in its camera, and keeps distance.

    camera -> road seen from above -> markings -> lane filter -> pure pursuit -> steering
    perceiver -> tracker -> belief -> distance -> throttle and brake

It perceives other road users as every perceiving driver does. It steers without the map; speed limit and traffic lights
are those of the observation. With a set speed it reads the speed limit from signs in its camera instead
(`ssad.drivers.lane_keeping.limit_signs`). Where no markings are in view, it extrapolates the last lane by its own
motion. After `PATIENCE` it slows down and stops, as systems do whose driver does not take over.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, Final

import numpy as np

from ssad.core.driving import Observation
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.perception import LANE_CONFIDENCE, PerceivedLane
from ssad.core.rotations import upright_pose
from ssad.core.types import F32, F64, U8, Controller, Episode
from ssad.drivers.lane_keeping.control import (
    COMFORT,
    MAX_ACCELERATION,
    MAX_DECELERATION,
    RESPONSE,
    bend_speed,
    following_acceleration,
    line_acceleration,
    pursuit_curvature,
    steer_for,
)
from ssad.drivers.lane_keeping.lane import LaneFilter
from ssad.drivers.lane_keeping.limit_signs import LimitMemory, LimitReading, find_plates
from ssad.drivers.lane_keeping.markings import RoadGrid, RoadMap, marking_strength
from ssad.drivers.perceiving.driver import LaneEvent, LimitEvent, PerceivingDriver
from ssad.drivers.perceiving.parts import Perceiver, make_perceiver, part_version
from ssad.drivers.perceiving.perceivers import PerfectPerceiver, nuscenes_cameras
from ssad.world.models import agent_model

CHANNEL: Final = "CAM_FRONT"
PATIENCE: Final = 1.5  # s without markings after which it slows down


class _Scene:
    """Memory of one episode."""

    def __init__(self, grid: RoadGrid, size: F64, power: F64, wheel: F64, limits: LimitReading) -> None:
        self.filter = LaneFilter(grid)
        self.limits = LimitMemory(limits)
        self.size, self.power, self.wheel = size, power, wheel
        self.pose: F64 | None = None
        self.time = 0.0
        self.lost_since: float | None = None
        self.lane: PerceivedLane | None = None


class LaneKeeper(PerceivingDriver):
    """Lane keeper with one front camera.

    Args:
        perceiver: Source of detections of other road users, or its name (`ssad list perceivers`); None: a perfect
            detector, so that all errors are those of the lane.
        camera: Camera of the lane markings; None: the front camera of the nuScenes rig, 640 px wide.
        grid: Top view in which markings are detected; None: `RoadGrid()`.
        set_speed: Speed before the first speed-limit sign that it reads, m/s; then it drives at the limit of the last
            sign that it has read. None: it reads none, and drives at the target speed of the observation.
        limits: Settings of reading speed-limit signs; None: `LimitReading()`.
        **settings: Further arguments of `PerceivingDriver`.

    Raises:
        ConfigError: A planner is given, or a set speed that is not above 0 and at most 70 m/s.
    """

    name = "lane-keeper"

    def __init__(
        self,
        perceiver: Perceiver | str | None = None,
        *,
        camera: Camera | None = None,
        grid: RoadGrid | None = None,
        set_speed: float | None = None,
        limits: LimitReading | None = None,
        **settings: Any,
    ) -> None:
        if set_speed is not None and not 0.0 < set_speed <= 70.0:
            raise ConfigError(f"lane-keeper: set_speed {set_speed:g} m/s; give a speed above 0, at most 70 m/s")
        if settings.get("planner") is not None:
            raise ConfigError("lane-keeper: a lane keeper plans its own motion; leave out the planner")
        parts = make_perceiver(perceiver) if isinstance(perceiver, str) else perceiver or PerfectPerceiver()
        super().__init__(parts, **settings)
        self.controller = Controller.EXTERNAL
        self.__dict__.pop("believe", None)  # the Autopilot does not plan for it
        self.lane_camera = camera or nuscenes_cameras()[CHANNEL]
        self.road_map = RoadMap(self.lane_camera, grid or RoadGrid())
        self.sensors = tuple(dict.fromkeys((*self.sensors, CHANNEL)))
        self.set_speed, self.limits = set_speed, limits or LimitReading()
        self._scenes: list[_Scene] = []

    @staticmethod
    def version_of_parts(*, perceiver: str = "", **_: object) -> str:
        """Return the version of a perceiver that is named, for the keys of results; arguments as of the class."""
        return part_version("perceiver", perceiver, make_perceiver(perceiver), {}) if perceiver else ""

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras among its sensors, which the engine renders."""
        return {**super().cameras, CHANNEL: self.lane_camera}

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Begin new episodes: forget lanes and poses."""
        super().reset(episodes)
        bodies = [agent_model(episode.agents[0]) for episode in episodes]
        self._scenes = [
            _Scene(
                self.road_map.grid,
                np.array([body.length, body.width]),
                np.array([body.max_accel, body.max_brake]),
                np.array([body.wheelbase, body.max_steer]),
                self.limits,
            )
            for body in bodies
        ]

    def snapshot_batch(self) -> Any:
        """Return the state of the whole batch, see `PerceivingDriver.snapshot_batch`."""
        return super().snapshot_batch(), deepcopy(self._scenes)

    def restore_batch(self, snapshot: Any) -> None:
        """Continue from an earlier snapshot of the same batch."""
        perceiving, scenes = snapshot
        super().restore_batch(perceiving)
        self._scenes = deepcopy(scenes)

    def act(self, view: Observation) -> F32:
        """Return the controls [N, 3]."""
        belief = self._perceived_belief(view)
        images = view.readings[CHANNEL]
        controls = np.zeros((len(view.scene), 3), np.float32)
        for row in np.flatnonzero(~view.done).tolist():
            scene = self._scenes[int(view.scene[row])]
            pixels = _pixels(images[row])
            lane = self._lane(scene, view, row, pixels)
            if self.set_speed is not None:
                self._read_limit(scene, view, row, pixels)
            acceleration, steer = self._cruise(scene, view, row, lane)
            if lane is not None:
                following = following_acceleration(view, belief, row, lane, scene.size)
                acceleration = max(min(acceleration, following), -MAX_DECELERATION)
            throttle, brake = acceleration / scene.power[0], -acceleration / scene.power[1]
            controls[row] = np.clip([throttle, brake, steer], [0.0, 0.0, -1.0], 1.0)
        return controls

    def _read_limit(self, scene: _Scene, view: Observation, row: int, pixels: U8) -> None:
        """Read the speed-limit signs in an image."""
        if pixels.any():
            pose = upright_pose(*view.pose[row].astype(np.float64).tolist()) @ self.lane_camera.to_ego
            scene.limits.update(find_plates(pixels, self.lane_camera), self.lane_camera, pose)
        if self.watch is not None:
            self.watch(LimitEvent(int(view.scene[row]), float(view.time[row]), scene.limits.limit))

    def _target_speed(self, scene: _Scene, view: Observation, row: int) -> float:
        """Return the speed on a free straight road, m/s."""
        if self.set_speed is None:
            return float(view.target_speed[row])
        return self.set_speed if scene.limits.limit is None else scene.limits.limit / 3.6

    def _lane(self, scene: _Scene, view: Observation, row: int, pixels: U8) -> PerceivedLane | None:
        """Return the present lane, predicted and, where there is an image, corrected with it."""
        pose, time = view.pose[row].astype(np.float64), float(view.time[row])
        if scene.pose is not None:
            forward = float(np.hypot(*(pose[:2] - scene.pose[:2])))
            turn = float(np.angle(np.exp(1j * (pose[2] - scene.pose[2]))))
            scene.filter.predict(forward, turn, time - scene.time)
        scene.pose, scene.time = pose, time
        lane = scene.filter.prediction()
        if pixels.any():  # an image of zeros is a loss of signal
            grid = self.road_map.grid
            lane = scene.filter.correct(marking_strength(self.road_map.brightness(pixels), grid))
        is_lost = lane is None or lane.confidence < LANE_CONFIDENCE
        scene.lost_since = None if not is_lost else scene.lost_since if scene.lost_since is not None else time
        if self.watch is not None:
            self.watch(LaneEvent(int(view.scene[row]), time, lane, pixels))
        return lane

    def _cruise(self, scene: _Scene, view: Observation, row: int, lane: PerceivedLane | None) -> tuple[float, float]:
        """Return the acceleration on a free road, m/s^2, and the steering."""
        speed = float(view.speed[row])
        if lane is None:
            return -COMFORT, 0.0
        target = min(self._target_speed(scene, view, row), bend_speed(lane))
        acceleration = float(np.clip((target - speed) / RESPONSE, -COMFORT, MAX_ACCELERATION))
        if scene.lost_since is not None and scene.time - scene.lost_since > PATIENCE:
            acceleration = -COMFORT
        acceleration = min(acceleration, line_acceleration(view, row, 0.5 * float(scene.size[0])))
        wheelbase, lock = scene.wheel.tolist()
        return acceleration, steer_for(pursuit_curvature(lane, speed), wheelbase, lock)


def _pixels(image: Any) -> U8:
    """Return an image [3, H, W], which may lie on a GPU, as an array."""
    pixels: U8 = image.cpu().numpy() if hasattr(image, "cpu") else np.asarray(image)
    return pixels

"""A radar that agents carry in the closed loop: where its rays end, and how fast that comes nearer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssad.core.driving import Simulator
from ssad.core.types import F32, F64, I32
from ssad.rendering.lidar import Lidar, sweep
from ssad.rendering.onboard import Onboard


@dataclass(frozen=True, slots=True)
class OnboardRadar:
    """A radar as a sensor: detections float32 [N, P, 4], see `__call__`.

    Args:
        onboard: What it shares its scenes with.
        rays: Its rays, as a `Lidar` whose `width` is the radar's horizontal field; its frame is x right, y forward.
    """

    onboard: Onboard
    rays: Lidar

    def follow(self, simulator: Simulator) -> None:
        """See `Onboard.follow`."""
        self.onboard.follow(simulator)

    def __call__(self, simulator: Simulator, agents: I32) -> F32:
        """Detections of agents [N, 2] (scene, agent): distance m, elevation, azimuth to the right, speed m/s.

        The speed is that of the thing relative to the radar along the ray, negative where it comes nearer. Rows after
        the last detection are 0: none is so near.
        """
        found = np.zeros((len(agents), len(self.rays.beams) * self.rays.azimuths, 4), np.float32)
        state = simulator.state()
        for sight in self.onboard.sights(simulator, agents):
            scene = int(agents[sight.row, 0])
            key = ("onboard radar", sight.looks.key, sight.moment.step, sight.agent)
            points, tag = sweep(sight.town.scene, self.rays, sight.pose, self.onboard.things(sight), key=key)
            speed = state.speed[scene].astype(np.float64)
            yaw = state.pose[scene, :, 2].astype(np.float64)
            moves = speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], 1)
            theirs = np.where((tag > 0)[:, None], moves[np.maximum(tag - 1, 0)], 0.0)
            found[sight.row, : len(points)] = self._read(points, theirs - moves[sight.agent], sight.pose)
        return found

    def _read(self, points: F32, relative: F64, pose: F64) -> F32:
        """Rows of points [P, 5] in the sensor frame, of relative velocities [P, 3] in the world frame."""
        ray = points[:, :3].astype(np.float64)
        away = np.maximum(np.linalg.norm(ray, axis=1), 1e-9)
        along = (ray / away[:, None]) @ (pose[:3, :3] @ self.rays.to_ego[:3, :3]).T
        up, across = np.arcsin(ray[:, 2] / away), np.arctan2(ray[:, 0], ray[:, 1])
        return np.column_stack([away, up, across, (along * relative).sum(1)]).astype(np.float32)

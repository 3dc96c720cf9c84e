"""A radar that agents carry in the closed loop: the ends of its rays, and their range rates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssad.core.driving import Simulator
from ssad.core.types import F32, F64, I32
from ssad.rendering.lidar import Lidar, sweep
from ssad.rendering.onboard import Onboard


@dataclass(frozen=True, slots=True)
class OnboardRadar:
    """Radar as a sensor: detections float32 [N, P, 4], see `__call__`.

    Args:
        onboard: Source of the scenes, shared with other sensors.
        rays: Its rays, as a `Lidar` whose `width` is the radar's horizontal field; its frame is x right, y forward.
    """

    onboard: Onboard
    rays: Lidar

    def follow(self, simulator: Simulator) -> None:
        """Record the poses of this step for the shared scenes."""
        self.onboard.follow(simulator)

    def __call__(self, simulator: Simulator, agents: I32) -> F32:
        """Detections of agents [N, 2] (scene, agent): distance m, elevation, azimuth to the right, speed m/s.

        The speed is that of the thing relative to the radar along the ray, negative where it comes nearer. Rows after
        the last detection are 0: none is so near.
        """
        detections = np.zeros((len(agents), len(self.rays.beams) * self.rays.azimuths, 4), np.float32)
        state = simulator.state()
        for agent_view in self.onboard.agent_views(simulator, agents):
            scene = int(agents[agent_view.row, 0])
            key = ("onboard radar", agent_view.appearance.key, agent_view.moment.step, agent_view.agent)
            points, tags = sweep(
                agent_view.town.scene, self.rays, agent_view.pose, self.onboard.visible_objects(agent_view), key=key
            )
            speeds = state.speed[scene].astype(np.float64)
            yaw = state.pose[scene, :, 2].astype(np.float64)
            velocities = speeds[:, None] * np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], 1)
            # Tag 0 is the street, which stands still; agent a has the tag a + 1.
            target_velocity = np.where((tags > 0)[:, None], velocities[np.maximum(tags - 1, 0)], 0.0)
            detections[agent_view.row, : len(points)] = self._read(
                points, target_velocity - velocities[agent_view.agent], agent_view.pose
            )
        return detections

    def _read(self, points: F32, relative: F64, pose: F64) -> F32:
        """Return rows for points [P, 5] in the sensor frame, of relative velocities [P, 3] in the world frame."""
        ray = points[:, :3].astype(np.float64)
        distance = np.maximum(np.linalg.norm(ray, axis=1), 1e-9)
        direction = (ray / distance[:, None]) @ (pose[:3, :3] @ self.rays.to_ego[:3, :3]).T
        elevation, azimuth = np.arcsin(ray[:, 2] / distance), np.arctan2(ray[:, 0], ray[:, 1])
        return np.column_stack([distance, elevation, azimuth, (direction * relative).sum(1)]).astype(np.float32)

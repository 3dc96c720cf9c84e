"""Distribution shifts in the camera of a drive: one weather per drive, which evolves from image to image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ssad.core.boxes import TrackedBoxes
from ssad.core.frames import Frame, SceneContext
from ssad.core.rotations import upright_pose, yaw_to_quaternion
from ssad.core.types import F32, F64, I32, U8, Episode
from ssad.rendering.onboard import AgentView, OnboardCamera
from ssad.scenarios.static.shifts import ShiftSpec, shift_images, sky_light
from ssad.scenarios.static.shifts.anomaly import place_objects
from ssad.world.models import agent_size


class ShiftedCamera:
    """Camera that agents carry (a sensor of `ssad.world.rollout.rollout`), with its images under a shift.

    Fog, rain and the occlusion of objects use the depth of the rendered image. The brightness of the sky is
    measured in the first image of a drive; the weather is drawn from the drive's key, and its clock is the
    drive's. Objects are deformed or blurred in the images alone, each as drawn for it once per drive. The objects
    of an anomaly stand beside the ego's route, clear of all agents in the first image; they have no contact with
    the world.

    Args:
        camera: The camera.
        spec: The shift.
    """

    def __init__(self, camera: OnboardCamera, spec: ShiftSpec) -> None:
        self.camera, self.spec = camera, spec
        self._contexts: dict[str, SceneContext] = {}

    def follow(self, simulator: Any) -> None:
        """Record the poses of this step for the scenes of the camera."""
        self.camera.follow(simulator)

    def __call__(self, simulator: Any, agents: I32) -> U8:
        """Return images [N, 3, H, W] of agents [N, 2] (scene, agent); black if the episode has ended."""
        camera_model = self.camera.camera
        shifted_images = np.zeros((len(agents), camera_model.height, camera_model.width, 3), np.uint8)
        speed = simulator.state().speed
        for batch, rendering in self.camera.render_batches(self.camera.onboard.agent_views(simulator, agents)):
            images = rendering.image.numpy()  # type: ignore[attr-defined]
            depth = rendering.depth.numpy()  # type: ignore[attr-defined]
            scenes = [int(agents[agent_view.row, 0]) for agent_view in batch]
            frames = [
                self._frame(agent_view, depth[row], speed[scenes[row]], simulator.dt)
                for row, agent_view in enumerate(batch)
            ]
            episodes = [simulator.episodes[simulator.assigned[scene]] for scene in scenes]
            shifted = self._shift_batch(batch, frames, images, episodes)
            shifted_images[[agent_view.row for agent_view in batch]] = shifted
        return np.moveaxis(shifted_images, -1, 1)

    def _shift_batch(
        self, sights: Sequence[AgentView], frames: Sequence[Frame], images: U8, episodes: Sequence[Episode]
    ) -> U8:
        """Return the images [N, H, W, 3] under the shift."""
        self._measure_contexts(sights, frames, images, episodes)
        device = self.camera.onboard.device  # images and depths are on the host, but the kernels are fast there
        shifted: U8 = shift_images(images, frames, self.spec, contexts=self._contexts, device=device)[0]
        return shifted

    @property
    def _needs_boxes(self) -> bool:
        """True if the shift uses the boxes of objects, which take time to build."""
        return self.spec.family == "object" or self.spec.places_objects

    def _frame(self, sight: AgentView, depth: Any, speed: F32, dt: float) -> Frame:
        key, step = sight.appearance.key, sight.moment.step
        sample = f"{key}/{step}/{sight.agent}/{self.camera.camera.channel}"
        boxes, ego_velocity = boxes_of(sight, speed) if self._needs_boxes else (TrackedBoxes.empty(), np.zeros(3))
        return Frame(self.camera.camera, key, sample, step * dt, sight.pose, ego_velocity, boxes, depth=depth)

    def _measure_contexts(
        self, sights: Sequence[AgentView], frames: Sequence[Frame], images: U8, episodes: Sequence[Episode]
    ) -> None:
        """Measure the constants of each drive on its first image."""
        for agent_view, frame, image, episode in zip(sights, frames, images, episodes, strict=True):
            if frame.scene not in self._contexts:
                heading = float(agent_view.moment.pose[agent_view.agent, 2])
                light, objects = sky_light([image], [frame.depth]), None
                if self.spec.places_objects:
                    objects = place_objects(self.spec, frame.scene, _route(episode), [frame.boxes])
                self._contexts[frame.scene] = SceneContext(frame.scene, light, heading, objects=objects)


class UserShiftedCamera(ShiftedCamera):
    """Camera that agents carry, with its images under a shift of the user's own.

    Args:
        camera: The camera.
        shift: Shifts images [N, H, W, 3], given their descriptions.
    """

    def __init__(self, camera: OnboardCamera, shift: Callable[[U8, Sequence[Frame]], U8]) -> None:
        super().__init__(camera, ShiftSpec("uniform", 0))
        self.shift = shift

    @property
    def _needs_boxes(self) -> bool:
        """True: nothing is known of what the shift uses."""
        return True

    def _shift_batch(
        self, sights: Sequence[AgentView], frames: Sequence[Frame], images: U8, episodes: Sequence[Episode]
    ) -> U8:
        """Return the images [N, H, W, 3] under the shift, each by itself: no result depends on the batch."""
        return np.stack([self.shift(image[None], [frame])[0] for image, frame in zip(images, frames, strict=True)])


def boxes_of(sight: AgentView, speed: F32) -> tuple[TrackedBoxes, F64]:
    """Return the boxes of all other agents, and the velocity [3] of the observing agent, m/s.

    Args:
        sight: View of the observing agent.
        speed: Speeds [A] of all agents, m/s.
    """
    pose = sight.moment.pose.astype(np.float64)
    heading_vectors = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2]), np.zeros(len(pose))], 1)
    velocity = speed[: len(pose), None].astype(np.float64) * heading_vectors
    rows = np.flatnonzero(sight.moment.active)
    rows = rows[rows != sight.agent]
    sizes = np.array([agent_size(sight.appearance.models[agent], sight.appearance.sizes[agent]) for agent in rows])
    sizes = sizes.reshape(-1, 3).astype(np.float64)
    centre = np.column_stack([pose[rows, :2], 0.5 * sizes[:, 2]]).reshape(-1, 3)
    names = tuple(str(agent) for agent in rows)
    boxes = TrackedBoxes(centre, sizes, yaw_to_quaternion(pose[rows, 2]), velocity[rows], names, np.ones(len(rows)))
    return boxes, velocity[sight.agent]


def _route(episode: Episode) -> F64:
    """Return poses [N, 4, 4] along the ego's route, 1 m apart."""
    route = episode.agents[0].route
    assert route is not None  # checked when the world was built
    return np.array([upright_pose(*route_pose) for route_pose in np.column_stack([route.xy, route.yaw]).tolist()])

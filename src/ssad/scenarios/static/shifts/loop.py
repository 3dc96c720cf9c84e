"""Distribution shifts in the camera of a drive: one weather a drive, which goes on from picture to picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from ssad.core.boxes import TrackedBoxes
from ssad.core.frames import Frame, SceneContext
from ssad.core.rotations import upright_pose, yaw_to_quaternion
from ssad.core.types import F32, F64, I32, U8, Episode
from ssad.rendering.onboard import OnboardCamera, Sight
from ssad.scenarios.static.shifts import ShiftSpec, shift_images, sky_light
from ssad.scenarios.static.shifts.anomaly import place_objects
from ssad.scenarios.static.shifts.spec import KNOWN
from ssad.world.models import MODELS

LOOP_SHIFTS: Final = tuple(KNOWN)


class ShiftedCamera:
    """A camera that agents carry (a sensor of `ssad.world.rollout.rollout`), its pictures under a shift.

    The depth that fog and rain need, and that hides objects, is that of the rendered picture. The brightness of the sky
    is measured in the first picture of a drive; the weather is drawn from the drive's key, and its clock is the
    drive's. Objects are deformed or blurred in the pictures alone, each as it is drawn for it once a drive. What an
    anomaly places stands beside the ego's route, clear of where everybody is in the first picture; nobody can touch it.

    Args:
        camera: The camera.
        spec: The shift.
    """

    def __init__(self, camera: OnboardCamera, spec: ShiftSpec) -> None:
        self.camera, self.spec = camera, spec
        self._contexts: dict[str, SceneContext] = {}

    def follow(self, simulator: Any) -> None:
        """See `ssad.rendering.onboard.Onboard.follow`."""
        self.camera.follow(simulator)

    def __call__(self, simulator: Any, agents: I32) -> U8:
        """Pictures [N, 3, H, W] of agents [N, 2] (scene, agent); black where the episode has ended."""
        lens = self.camera.camera
        found = np.zeros((len(agents), lens.height, lens.width, 3), np.uint8)
        speed = simulator.state().speed
        for part, picture in self.camera.shots(self.camera.onboard.sights(simulator, agents)):
            images = picture.image.numpy()  # type: ignore[attr-defined]
            depth = picture.depth.numpy()  # type: ignore[attr-defined]
            scenes = [int(agents[sight.row, 0]) for sight in part]
            frames = [self._frame(sight, depth[k], speed[scenes[k]], simulator.dt) for k, sight in enumerate(part)]
            episodes = [simulator.episodes[simulator.assigned[scene]] for scene in scenes]
            self._learn(part, frames, images, episodes)
            device = self.camera.onboard.device  # where it is fast: pictures and depths were brought to the host
            shifted, _ = shift_images(images, frames, self.spec, contexts=self._contexts, device=device)
            found[[sight.row for sight in part]] = shifted
        return np.moveaxis(found, -1, 1)

    def _frame(self, sight: Sight, depth: Any, speed: F32, dt: float) -> Frame:
        key, step = sight.looks.key, sight.moment.step
        sample = f"{key}/{step}/{sight.agent}/{self.camera.camera.channel}"
        moves = self.spec.family == "object" or self.spec.places_objects
        boxes, own = boxes_of(sight, speed) if moves else (TrackedBoxes.empty(), np.zeros(3))
        return Frame(self.camera.camera, key, sample, step * dt, sight.pose, own, boxes, depth=depth)

    def _learn(self, sights: Sequence[Sight], frames: Sequence[Frame], images: U8, episodes: Sequence[Episode]) -> None:
        """What stays as it is over a drive, from its first picture."""
        for sight, frame, image, episode in zip(sights, frames, images, episodes, strict=True):
            if frame.scene not in self._contexts:
                heading = float(sight.moment.pose[sight.agent, 2])
                light, objects = sky_light([image], [frame.depth]), None
                if self.spec.places_objects:
                    objects = place_objects(self.spec, frame.scene, _route(episode), [frame.boxes])
                self._contexts[frame.scene] = SceneContext(frame.scene, light, heading, objects=objects)


def boxes_of(sight: Sight, speed: F32) -> tuple[TrackedBoxes, F64]:
    """Who is there but who looks, as boxes, and the velocity [3] of who looks, m/s.

    Args:
        sight: What can be seen.
        speed: [A] of all agents, m/s.
    """
    pose = sight.moment.pose.astype(np.float64)
    ahead = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2]), np.zeros(len(pose))], 1)
    velocity = speed[: len(pose), None].astype(np.float64) * ahead
    rows = np.flatnonzero(sight.moment.active)
    rows = rows[rows != sight.agent]
    sizes = np.array([(m.length, m.width, m.height) for m in (MODELS[sight.looks.models[k]] for k in rows)])
    sizes = sizes.reshape(-1, 3).astype(np.float64)
    centre = np.column_stack([pose[rows, :2], 0.5 * sizes[:, 2]]).reshape(-1, 3)
    names = tuple(str(k) for k in rows)
    boxes = TrackedBoxes(centre, sizes, yaw_to_quaternion(pose[rows, 2]), velocity[rows], names, np.ones(len(rows)))
    return boxes, velocity[sight.agent]


def _route(episode: Episode) -> F64:
    """Poses [N, 4, 4] along the ego's route, m by m."""
    route = episode.agents[0].route
    assert route is not None  # checked when the world was built
    return np.array([upright_pose(*place) for place in np.column_stack([route.xy, route.yaw]).tolist()])

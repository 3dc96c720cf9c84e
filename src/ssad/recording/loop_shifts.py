"""Distribution shifts in the camera of a drive: one weather a drive, which goes on from picture to picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from ssad.core.errors import unknown_name
from ssad.core.frames import Frame, SceneContext
from ssad.core.types import I32, U8
from ssad.recording.loop_sensors import OnboardCamera, Sight
from ssad.scenarios.static.shifts import ShiftSpec, shift_images, sky_light
from ssad.scenarios.static.shifts.spec import KNOWN, PLACING

# those that change what is between objects and picture; the others change objects or place them
LOOP_SHIFTS: Final = tuple(n for n, (family, _) in KNOWN.items() if family != "object" and n not in PLACING)


class ShiftedCamera:
    """A camera that agents carry (a sensor of `ssad.world.rollout.rollout`), its pictures under a shift.

    The depth that fog and rain need is that of the rendered picture. The brightness of the sky is measured in the first
    picture of a drive; the weather is drawn from the drive's key, and its clock is the drive's.

    Args:
        camera: The camera.
        spec: The shift.

    Raises:
        UnknownNameError: The shift is none of `LOOP_SHIFTS`.
    """

    def __init__(self, camera: OnboardCamera, spec: ShiftSpec) -> None:
        if spec.name not in LOOP_SHIFTS:
            raise unknown_name("shift in the loop", spec.name, LOOP_SHIFTS)
        self.camera, self.spec = camera, spec
        self._contexts: dict[str, SceneContext] = {}

    def follow(self, simulator: Any) -> None:
        """See `ssad.recording.loop_sensors.Onboard.follow`."""
        self.camera.follow(simulator)

    def __call__(self, simulator: Any, agents: I32) -> U8:
        """Pictures [N, 3, H, W] of agents [N, 2] (scene, agent); black where the episode has ended."""
        lens = self.camera.camera
        found = np.zeros((len(agents), lens.height, lens.width, 3), np.uint8)
        for part, picture in self.camera.shots(self.camera.onboard.sights(simulator, agents)):
            images = picture.image.numpy()  # type: ignore[attr-defined]
            depth = picture.depth.numpy()  # type: ignore[attr-defined]
            frames = [self._frame(sight, depth[k], simulator.dt) for k, sight in enumerate(part)]
            self._learn(part, frames, images)
            shifted, _ = shift_images(images, frames, self.spec, contexts=self._contexts)
            found[[sight.row for sight in part]] = shifted
        return np.moveaxis(found, -1, 1)

    def _frame(self, sight: Sight, depth: Any, dt: float) -> Frame:
        key, step = sight.looks.key, sight.moment.step
        sample = f"{key}/{step}/{sight.agent}/{self.camera.camera.channel}"
        return Frame(self.camera.camera, key, sample, step * dt, sight.pose, depth=depth)

    def _learn(self, sights: Sequence[Sight], frames: Sequence[Frame], images: U8) -> None:
        """What stays as it is over a drive, from its first picture."""
        for sight, frame, image in zip(sights, frames, images, strict=True):
            if frame.scene not in self._contexts:
                heading = float(sight.moment.pose[sight.agent, 2])
                light = sky_light([image], [frame.depth])
                self._contexts[frame.scene] = SceneContext(frame.scene, light, heading)

"""Camera faults in the loop: frozen, lost, black or late images, or a dirty lens.

A fault changes readings (`ssad.core.driving.ReadingChange`). The output depends on earlier images, so an instance
belongs to one camera of one batch of episodes that begin together; all draws of an episode come from the generator of
its first image.
"""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np

from ssad.core.driving import Frames, Generators
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.types import F32, U8

FAULTS: Final[dict[str, str]] = {
    "frozen": "the last picture again and again, for a while, now and then",
    "dropped": "no signal for a while, now and then; pictures are 0 everywhere, so that a driver can tell",
    "blackout": "a dark picture with noise for a while, now and then",
    "delayed": "pictures come late",
    "dirt": "dirt on the lens, out of focus",
}
LENGTHS: Final = (0.4, 0.8, 1.6, 3.2, 6.4)  # s: mean duration of a fault, by severity
PAUSE: Final = 2.0  # s: mean interval between two faults
DELAYS: Final = (0.2, 0.4, 0.6, 0.8, 1.2)  # s
COVERED: Final = (0.05, 0.1, 0.2, 0.35, 0.5)  # share of the lens covered by dirt
_TIME_TOLERANCE = 1e-4  # s: tolerance for times, which are sums of steps


class CameraFault:
    """Fault of one camera.

    Args:
        name: Key of `FAULTS`.
        severity: 1 to 5.

    Raises:
        UnknownNameError: There is no such fault.
        ConfigError: There is no such severity.
    """

    def __init__(self, name: str, severity: int = 3) -> None:
        if name not in FAULTS:
            raise unknown_name("fault", name, FAULTS)
        if severity not in range(1, 6):
            raise ConfigError(f"severity {severity!r} of fault '{name}': expected 1 to 5")
        self.name, self.severity = name, severity
        self._states: list[_SceneState] = []

    def apply(self, frames: Frames, victim: Any, truth: Any, generators: Generators) -> Frames:
        """Apply the fault to the images of all scenes.

        Args:
            frames: uint8 [N, 3, H, W].
            victim: Ignored.
            truth: A `WorldState` of the N scenes; only its clock is read.
            generators: One for each image.

        Returns:
            uint8 [N, 3, H, W].

        Raises:
            ConfigError: The number of images differs from the number of scenes.
        """
        times = np.asarray(truth.time, np.float64)
        if len(times) != len(frames):
            raise ConfigError(f"fault '{self.name}': {len(frames)} pictures of {len(times)} scenes; give one of each")
        if len(self._states) != len(frames):
            self._states = [_SceneState(random_generator, self.severity) for random_generator in generators]
        faulty_frames = frames.copy()
        for scene_index, time in enumerate(times.tolist()):
            if self._states[scene_index].times and time < self._states[scene_index].times[-1] - _TIME_TOLERANCE:
                self._states[scene_index] = _SceneState(
                    generators[scene_index], self.severity
                )  # the scene has started again
            state = self._states[scene_index]
            state.times.append(time)
            faulty_frames[scene_index] = getattr(self, f"_{self.name}")(
                state, time, frames[scene_index], generators[scene_index]
            )
        return faulty_frames

    def _frozen(self, state: _SceneState, time: float, frame: U8, random: np.random.Generator) -> U8:
        if not state.is_faulty(time) or not state.images:
            state.images = [frame.copy()]
        frozen_frame: U8 = state.images[0]
        return frozen_frame

    def _dropped(self, state: _SceneState, time: float, frame: U8, random: np.random.Generator) -> U8:
        return np.zeros_like(frame) if state.is_faulty(time) else frame

    def _blackout(self, state: _SceneState, time: float, frame: U8, random: np.random.Generator) -> U8:
        return random.integers(0, 6, frame.shape, np.uint8) if state.is_faulty(time) and frame.any() else frame

    def _delayed(self, state: _SceneState, time: float, frame: U8, random: np.random.Generator) -> U8:
        state.images.append(frame.copy())
        due_indices = [
            index
            for index, frame_time in enumerate(state.times)
            if frame_time <= time - DELAYS[self.severity - 1] + _TIME_TOLERANCE
        ]
        shown_index = due_indices[-1] if due_indices else 0
        late_frame = state.images[shown_index]
        del state.times[:shown_index], state.images[:shown_index]  # older images are no longer needed
        return late_frame

    def _dirt(self, state: _SceneState, time: float, frame: U8, random: np.random.Generator) -> U8:
        if not frame.any():
            return frame
        if state.mask is None or state.mask.shape != frame.shape[1:]:
            state.mask = dirt(frame.shape[1], frame.shape[2], COVERED[self.severity - 1], state.draws)
        blurred = cv2.GaussianBlur(np.moveaxis(frame, 0, -1), (0, 0), frame.shape[2] / 40)
        # Dirt is out of focus: it passes a blurred quarter of the light and adds a brown tone.
        dirt_colour = 0.25 * blurred.astype(np.float32) + np.array([32.0, 27.0, 20.0], np.float32)
        dirty_frame = frame + state.mask * (np.moveaxis(dirt_colour, -1, 0) - frame)
        return np.asarray(np.rint(dirty_frame).clip(0, 255), np.uint8)


class _SceneState:
    """State of one scene: the schedule of its fault, and its earlier images."""

    def __init__(self, random: np.random.Generator, severity: int) -> None:
        self.draws, self.length = random, LENGTHS[severity - 1]
        # stationary distribution, as if the camera had run for a long time
        self.state = bool(random.random() < self.length / (self.length + PAUSE))
        self.until = float(random.exponential(self.length if self.state else PAUSE))
        self.times: list[float] = []
        self.images: list[U8] = []
        self.mask: F32 | None = None

    def is_faulty(self, time: float) -> bool:
        """Advance the schedule to a time and return the state of the fault."""
        while time >= self.until:
            self.state = not self.state
            self.until += float(self.draws.exponential(self.length if self.state else PAUSE))
        return self.state


def dirt(height: int, width: int, coverage: float, random: np.random.Generator) -> F32:
    """Return the opacity of the dirt on a lens, [H, W] in 0 to 0.95, with soft edges.

    Args:
        height: H.
        width: W.
        coverage: Share of the image in which the dirt absorbs more than half of the light.
        random: Generator of the positions of the dirt.
    """
    octaves = np.zeros((9, 16), np.float32)
    # Three octaves of value noise: spots of several sizes.
    for size, weight in (((9, 16), 1.0), ((5, 8), 1.5), ((3, 4), 1.0)):
        lattice = random.normal(size=size).astype(np.float32)
        octaves += weight * cv2.resize(lattice, (16, 9), interpolation=cv2.INTER_CUBIC)
    thickness = cv2.resize(octaves, (width, height), interpolation=cv2.INTER_CUBIC)
    threshold = np.quantile(thickness, 1.0 - coverage)
    return np.asarray(0.95 / (1.0 + np.exp(-(thickness - threshold) / (0.08 * thickness.std()))), np.float32)

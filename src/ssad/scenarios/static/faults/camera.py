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
_SOON = 1e-4  # s: tolerance for times, which are sums of steps


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
        self._rows: list[_Row] = []

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
        if len(self._rows) != len(frames):
            self._rows = [_Row(random_generator, self.severity) for random_generator in generators]
        faulty = frames.copy()
        for scene_index, time in enumerate(times.tolist()):
            if self._rows[scene_index].times and time < self._rows[scene_index].times[-1] - _SOON:
                self._rows[scene_index] = _Row(generators[scene_index], self.severity)  # the scene has started again
            scene = self._rows[scene_index]
            scene.times.append(time)
            faulty[scene_index] = getattr(self, f"_{self.name}")(
                scene, time, frames[scene_index], generators[scene_index]
            )
        return faulty

    def _frozen(self, row: _Row, time: float, frame: U8, draws: np.random.Generator) -> U8:
        if not row.faulty(time) or not row.kept:
            row.kept = [frame.copy()]
        frozen_frame: U8 = row.kept[0]
        return frozen_frame

    def _dropped(self, row: _Row, time: float, frame: U8, draws: np.random.Generator) -> U8:
        return np.zeros_like(frame) if row.faulty(time) else frame

    def _blackout(self, row: _Row, time: float, frame: U8, draws: np.random.Generator) -> U8:
        return draws.integers(0, 6, frame.shape, np.uint8) if row.faulty(time) and frame.any() else frame

    def _delayed(self, row: _Row, time: float, frame: U8, draws: np.random.Generator) -> U8:
        row.kept.append(frame.copy())
        due_indices = [
            index
            for index, frame_time in enumerate(row.times)
            if frame_time <= time - DELAYS[self.severity - 1] + _SOON
        ]
        shown_index = due_indices[-1] if due_indices else 0
        late_frame = row.kept[shown_index]
        del row.times[:shown_index], row.kept[:shown_index]  # older images are no longer needed
        return late_frame

    def _dirt(self, row: _Row, time: float, frame: U8, draws: np.random.Generator) -> U8:
        if not frame.any():
            return frame
        if row.mask is None or row.mask.shape != frame.shape[1:]:
            row.mask = dirt(frame.shape[1], frame.shape[2], COVERED[self.severity - 1], row.draws)
        blurred = cv2.GaussianBlur(np.moveaxis(frame, 0, -1), (0, 0), frame.shape[2] / 40)
        # Dirt is out of focus: it passes a blurred quarter of the light and adds a brown tone.
        dirt_colour = 0.25 * blurred.astype(np.float32) + np.array([32.0, 27.0, 20.0], np.float32)
        dirty_frame = frame + row.mask * (np.moveaxis(dirt_colour, -1, 0) - frame)
        return np.asarray(np.rint(dirty_frame).clip(0, 255), np.uint8)


class _Row:
    """State of one scene: the schedule of its fault, and its earlier images."""

    def __init__(self, draws: np.random.Generator, severity: int) -> None:
        self.draws, self.length = draws, LENGTHS[severity - 1]
        # stationary distribution, as if the camera had run for a long time
        self.state = bool(draws.random() < self.length / (self.length + PAUSE))
        self.until = float(draws.exponential(self.length if self.state else PAUSE))
        self.times: list[float] = []
        self.kept: list[U8] = []
        self.mask: F32 | None = None

    def faulty(self, time: float) -> bool:
        """Advance the schedule to a time and return the state of the fault."""
        while time >= self.until:
            self.state = not self.state
            self.until += float(self.draws.exponential(self.length if self.state else PAUSE))
        return self.state


def dirt(height: int, width: int, covered: float, draws: np.random.Generator) -> F32:
    """How opaque the dirt on a lens is, [H, W] in 0..0.95, with soft edges; a share of the picture is covered.

    Args:
        height: H.
        width: W.
        covered: Share of the picture where more than half of the light is kept back.
        draws: Where the dirt is.
    """
    octaves = np.zeros((9, 16), np.float32)
    # Three octaves of value noise: spots of several sizes.
    for size, weight in (((9, 16), 1.0), ((5, 8), 1.5), ((3, 4), 1.0)):
        lattice = draws.normal(size=size).astype(np.float32)
        octaves += weight * cv2.resize(lattice, (16, 9), interpolation=cv2.INTER_CUBIC)
    thickness = cv2.resize(octaves, (width, height), interpolation=cv2.INTER_CUBIC)
    threshold = np.quantile(thickness, 1.0 - covered)
    return np.asarray(0.95 / (1.0 + np.exp(-(thickness - threshold) / (0.08 * thickness.std()))), np.float32)

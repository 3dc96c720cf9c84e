"""Faults of a camera in the loop: its picture stands still, is lost, black or late, or its lens is dirty.

They are `ssad.core.driving.Perturbation`s: what is shown depends on the pictures before, so an instance belongs to one
camera of one batch of drives, which begin together; a drive's draws all come from the generator of its first picture.
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
LENGTHS: Final = (0.4, 0.8, 1.6, 3.2, 6.4)  # s that a fault lasts on average, by severity
PAUSE: Final = 2.0  # s between two faults, on average
DELAYS: Final = (0.2, 0.4, 0.6, 0.8, 1.2)  # s
COVERED: Final = (0.05, 0.1, 0.2, 0.35, 0.5)  # share of the lens under dirt
_SOON = 1e-4  # s: times are sums of steps


class CameraFault:
    """A fault of one camera.

    Args:
        name: Which (`FAULTS`).
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
        """See `ssad.core.driving.Perturbation`.

        Args:
            frames: uint8 [N, 3, H, W].
            victim: Not asked.
            truth: A `WorldState` whose N scenes these are; its clock alone is read.
            generators: One for each picture.

        Returns:
            uint8 [N, 3, H, W].

        Raises:
            ConfigError: The pictures are not those of all scenes.
        """
        times = np.asarray(truth.time, np.float64)
        if len(times) != len(frames):
            raise ConfigError(f"fault '{self.name}': {len(frames)} pictures of {len(times)} scenes; give one of each")
        if len(self._rows) != len(frames):
            self._rows = [_Row(g, self.severity) for g in generators]
        shown = frames.copy()
        for k, time in enumerate(times.tolist()):
            if self._rows[k].times and time < self._rows[k].times[-1] - _SOON:
                self._rows[k] = _Row(generators[k], self.severity)  # the scene has started again
            row = self._rows[k]
            row.times.append(time)
            shown[k] = getattr(self, f"_{self.name}")(row, time, frames[k], generators[k])
        return shown

    def _frozen(self, row: _Row, time: float, frame: U8, draws: np.random.Generator) -> U8:
        if not row.faulty(time) or not row.kept:
            row.kept = [frame.copy()]
        kept: U8 = row.kept[0]
        return kept

    def _dropped(self, row: _Row, time: float, frame: U8, draws: np.random.Generator) -> U8:
        return np.zeros_like(frame) if row.faulty(time) else frame

    def _blackout(self, row: _Row, time: float, frame: U8, draws: np.random.Generator) -> U8:
        return draws.integers(0, 6, frame.shape, np.uint8) if row.faulty(time) and frame.any() else frame

    def _delayed(self, row: _Row, time: float, frame: U8, draws: np.random.Generator) -> U8:
        row.kept.append(frame.copy())
        due = [k for k, then in enumerate(row.times) if then <= time - DELAYS[self.severity - 1] + _SOON]
        shown = due[-1] if due else 0
        found = row.kept[shown]
        del row.times[:shown], row.kept[:shown]  # what is older is not needed any more
        return found

    def _dirt(self, row: _Row, time: float, frame: U8, draws: np.random.Generator) -> U8:
        if not frame.any():
            return frame
        if row.mask is None or row.mask.shape != frame.shape[1:]:
            row.mask = dirt(frame.shape[1], frame.shape[2], COVERED[self.severity - 1], row.draws)
        soft = cv2.GaussianBlur(np.moveaxis(frame, 0, -1), (0, 0), frame.shape[2] / 40)
        film = 0.25 * soft.astype(np.float32) + np.array([32.0, 27.0, 20.0], np.float32)
        mixed = frame + row.mask * (np.moveaxis(film, -1, 0) - frame)
        return np.asarray(np.rint(mixed).clip(0, 255), np.uint8)


class _Row:
    """One scene: when its fault comes and goes, and which pictures came before."""

    def __init__(self, draws: np.random.Generator, severity: int) -> None:
        self.draws, self.length = draws, LENGTHS[severity - 1]
        # as if the camera had run for long
        self.state = bool(draws.random() < self.length / (self.length + PAUSE))
        self.until = float(draws.exponential(self.length if self.state else PAUSE))
        self.times: list[float] = []
        self.kept: list[U8] = []
        self.mask: F32 | None = None

    def faulty(self, time: float) -> bool:
        """Whether the fault is there."""
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
    total = np.zeros((9, 16), np.float32)
    for size, weight in (((9, 16), 1.0), ((5, 8), 1.5), ((3, 4), 1.0)):
        noise = draws.normal(size=size).astype(np.float32)
        total += weight * cv2.resize(noise, (16, 9), interpolation=cv2.INTER_CUBIC)
    field = cv2.resize(total, (width, height), interpolation=cv2.INTER_CUBIC)
    edge = np.quantile(field, 1.0 - covered)
    return np.asarray(0.95 / (1.0 + np.exp(-(field - edge) / (0.08 * field.std()))), np.float32)

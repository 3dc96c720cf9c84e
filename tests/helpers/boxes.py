"""Boxes for tests."""

from __future__ import annotations

import numpy as np

from ssad.core.boxes import TrackedBoxes


def cars(*centres: tuple[float, float, float], velocity: tuple[float, float, float] = (0, 4, 0)) -> TrackedBoxes:
    """Cars that look along x."""
    n = len(centres)
    return TrackedBoxes(
        np.array(centres, float),
        np.tile([4.0, 1.8, 1.6], (n, 1)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.tile(np.array(velocity, float), (n, 1)),
        tuple(f"car {k}" for k in range(n)),
        np.ones(n),
    )

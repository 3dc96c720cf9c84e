"""Boxes for tests."""

from __future__ import annotations

import numpy as np

from ssad.core.frames import Boxes3D


def cars(*centres: tuple[float, float, float], velocity: tuple[float, float, float] = (0, 4, 0)) -> Boxes3D:
    """Cars that look along x."""
    n = len(centres)
    return Boxes3D(
        tuple(f"car {k}" for k in range(n)),
        np.array(centres, float),
        np.tile([1.8, 4.0, 1.6], (n, 1)),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.tile(np.array(velocity, float), (n, 1)),
        np.ones(n),
    )

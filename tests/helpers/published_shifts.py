"""A picture, and what is compared of the published snow, rain and fog and ours over it.

Stands alone (numpy and OpenCV): `benchmarks/make_shift_reference.py` runs it in the environment of the originals.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

WIDTH, HEIGHT = 1600, 900
NAMES = ("mean", "contrast", "fine", "middle", "coarse")


def picture() -> Any:
    """uint8 [HEIGHT, WIDTH, 3]: a sky over blocks of many greys and colours, up to 250."""
    rng = np.random.default_rng(5)
    image = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    image[:] = np.linspace(250, 40, HEIGHT)[:, None, None]
    for _ in range(250):
        x, y = int(rng.integers(0, WIDTH - 60)), int(rng.integers(250, HEIGHT - 50))
        colour = [int(v) for v in rng.integers(10, 220, 3)]
        cv2.rectangle(image, (x, y), (x + int(rng.integers(20, 160)), y + int(rng.integers(20, 110))), colour, -1)
    return image


def statistics(out: Any, image: Any) -> list[float]:
    """Mean grey level; slope of the line from the picture's grey levels to those after the shift; deviation of what
    that line leaves, under 2, from 2 to 12 and over 12 pixels."""
    before, after = (v.astype(np.float64).mean(2) for v in (image, out))
    slope, start = np.polyfit(before.ravel(), after.ravel(), 1)
    rest = (after - slope * before - start).astype(np.float32)
    low, lower = (cv2.GaussianBlur(rest, (0, 0), sigma) for sigma in (2.0, 12.0))
    bands = [float(v.std()) for v in (rest - low, low - lower, lower)]
    return [float(after.mean()), float(slope), *bands]

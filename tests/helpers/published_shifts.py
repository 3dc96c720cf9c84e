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
    """uint8 [HEIGHT, WIDTH, 3]: squares of grey level 60 and 180, small beside clouds, and one white corner."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] // 40
    image = np.repeat(np.where((x + y) % 2, 180, 60).astype(np.uint8)[..., None], 3, axis=2)
    image[:2, :2] = 250
    return image


def statistics(out: Any, image: Any) -> list[float]:
    """Mean grey level; slope of the line from the picture's grey levels to those after the shift; and the logarithms of
    the deviation of what that line leaves, under 2, from 2 to 12 and over 12 pixels."""
    grey = np.full((1, 3), 1 / 3, np.float32)
    before, after = (cv2.transform(v.astype(np.float32), grey).astype(np.float64) for v in (image, out))
    before -= before.mean()
    mean = after.mean()
    slope = np.vdot(before, after) / np.vdot(before, before)
    rest = (after - mean - slope * before).astype(np.float32)
    low, lower = (cv2.GaussianBlur(rest, (0, 0), sigma) for sigma in (2.0, 12.0))
    bands = [float(np.log(v.std())) for v in (rest - low, low - lower, lower)]
    return [float(mean), float(slope), *bands]

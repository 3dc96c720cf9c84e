"""A camera fault: water on the lens, which blurs the image until the wiper comes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np


class WetLens:
    """Blurs every image, except for a short time after each stroke of the wiper.

    A fault has one or several of the methods `apply` (readings of sensors), `observe` (what the ego knows of its own
    state) and `command` (its commands); see `ssad.core.driving`. Its attribute `sensors` names what `apply` changes:
    here every camera. An object belongs to one sensor.

    Args:
        severity: 1 to 5; a class without this argument has no severities.
        period: Seconds from one stroke of the wiper to the next.
    """

    sensors = ("camera",)

    def __init__(self, severity: int = 3, period: float = 1.5) -> None:
        self.radius, self.period = 0.6 * severity, period

    def apply(self, images: Any, victim: Any, truth: Any, generators: Any) -> Any:
        """Return the images uint8 [N, 3, H, W], blurred; `truth.time` is the time of each scene, s."""
        blurred = images.copy()
        for row, time in enumerate(np.asarray(truth.time).tolist()):
            if time % self.period > 0.2:
                image = np.moveaxis(images[row], 0, -1)
                blurred[row] = np.moveaxis(cv2.GaussianBlur(image, (0, 0), self.radius), -1, 0)
        return blurred

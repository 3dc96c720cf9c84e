"""Detectors for the closed loop: one finds a car where the picture is bright, one nothing, and three go wrong."""

from __future__ import annotations

import os
import time
from typing import Any

import torch

from ssad.core.detections import Detections, Solids


class Bright:
    """A car 14 m ahead, as sure as the picture is bright."""

    name, task, classes = "bright", "3d", ("car", "pedestrian")

    def __init__(self) -> None:
        self.looks = 0

    def predict(self, images: Any, intrinsic: Any = None, *, threshold: float | None = None) -> list[Detections]:
        self.looks += 1
        return [self.found(float(image.mean())) for image in images]

    def found(self, score: float) -> Detections:
        one = torch.zeros(1)
        solid = Solids(
            torch.tensor([[0.0, 0.8, 14.0]]), torch.tensor([[4.5, 1.6, 1.9]]), one, torch.zeros(1, 2), one.long()
        )
        return Detections(one + score, one.long(), torch.zeros(1, 4), solid)


class Nothing(Bright):
    """It finds nothing that it is sure of."""

    def found(self, score: float) -> Detections:
        return super().found(0.0)


class Spoilt(Bright):
    """From its third look on it returns NaN."""

    def found(self, score: float) -> Detections:
        return super().found(score if self.looks < 3 else float("nan"))


class Dying(Bright):
    """At its third look its process dies."""

    def found(self, score: float) -> Detections:
        if self.looks >= 3:
            os._exit(1)
        return super().found(score)


class Hanging(Bright):
    """At its third look it hangs."""

    def found(self, score: float) -> Detections:
        if self.looks >= 3:
            time.sleep(600)
        return super().found(score)

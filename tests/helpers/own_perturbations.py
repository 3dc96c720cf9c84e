"""Perturbations of a user's own, one of each kind of object, named in suites as helpers.own_perturbations:NAME."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ssad.scenarios.static.perturbation import Perturbation, PerturbedScene


class Haze:
    """A shift: images fade to white with their severity."""

    def __init__(self, severity: int = 3, share: float = 0.1) -> None:
        self.share = share * severity

    def shift(self, images: Any, frames: Any, generators: Any) -> Any:
        assert len(frames) == len(images) == len(generators)
        return (images + self.share * (255.0 - images)).round().astype(np.uint8)


class Smear:
    """A fault of the cameras, of the ego's speed and of its brake."""

    sensors = ("camera",)

    def __init__(self, width: int = 4) -> None:
        self.width = width

    def apply(self, images: Any, victim: Any, truth: Any, generators: Any) -> Any:
        assert len(truth.time) == len(images)
        return np.repeat(images[..., :: self.width], self.width, axis=-1)[..., : images.shape[-1]]

    def observe(self, observation: Any, generators: Any) -> Any:
        return replace(observation, speed=observation.speed * np.float32(0.5))

    def command(self, controls: Any, time: Any, generators: Any) -> Any:
        changed = controls.copy()
        changed[:, 0], changed[:, 1] = 0.0, 1.0
        return changed


class LidarLoss:
    """A fault of a sensor that the system may not have."""

    sensors = ("lidar",)

    def apply(self, points: Any, victim: Any, truth: Any, generators: Any) -> Any:
        return np.zeros_like(points)


class Wrong:
    """An object without any method of a perturbation."""


@dataclass(frozen=True)
class Mirror(Perturbation):
    """A perturbation of a family of its own: images are turned left to right."""

    name: str = "mirror"
    family: str = "geometry"

    def apply(self, images: Any, victim: Any, truth: Any, generators: Any) -> Any:
        return np.ascontiguousarray(images[..., ::-1])

    def in_loop(self, suite: Any, *, target: int, victim: Any, seed: int) -> Any:
        for name in suite.cameras:
            suite = suite.with_reading_change(name, self)
        return suite

    def on_scene(self, scene: Any, victim: Any) -> PerturbedScene:
        from ssad.core.images import read_image

        return PerturbedScene(
            lambda frames: [np.ascontiguousarray(read_image(scene.root / f.filename)[:, ::-1]) for f in frames]
        )


MIRROR = Mirror()

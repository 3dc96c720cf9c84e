"""A perturbation of a family of its own: a sticker on the windscreen hides a part of every image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ssad.core.images import read_image
from ssad.scenarios.static.perturbation import Perturbation, PerturbedScene


@dataclass(frozen=True)
class Sticker(Perturbation):
    """Grey square in the middle of every image, larger with its severity.

    Attributes:
        severity: 1 to 5; a class without this argument has no severities.
        name: Name in tables.
        family: Name of the family.
    """

    severity: int = 3
    name: str = "example-sticker"
    family: str = "occlusion"

    def apply(self, images: Any, victim: Any, truth: Any, generators: Any) -> Any:
        """Return the images uint8 [N, 3, H, W] of a camera, covered; the closed loop calls this at every step."""
        covered, (height, width) = images.copy(), images.shape[-2:]
        half = height * self.severity // 20
        covered[..., height // 2 - half : height // 2 + half, width // 2 - half : width // 2 + half] = 128
        return covered

    def in_loop(self, suite: Any, *, target: int, victim: Any, seed: int) -> Any:
        """Return the sensors of a driver with the sticker before each camera."""
        for name in suite.cameras:
            suite = suite.with_reading_change(name, self)
        return suite

    def on_scene(self, scene: Any, victim: Any) -> PerturbedScene:
        """Return a recorded scene with the sticker in each image [H, W, 3]."""

        def look(frames: Any) -> list[Any]:
            images = [read_image(scene.root / frame.filename) for frame in frames]
            return [self.apply(image.transpose(2, 0, 1), None, None, None).transpose(1, 2, 0) for image in images]

        return PerturbedScene(look)

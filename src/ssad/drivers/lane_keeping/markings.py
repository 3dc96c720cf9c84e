"""Lane markings in a camera image: the road seen from above, and bright ridges on it.

The image is mapped to the plane of the road with the known pose of the camera (inverse perspective mapping; Mallot et
al., Biological Cybernetics 64, 1991). A marking is a bright ridge as wide as a line: a pixel brighter than the road at
both of its sides (Veit et al., Evaluation of road marking feature extraction, ITSC 2008, symmetrical local threshold).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import cv2
import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import F32, F64, U8

SIDE: Final = 0.28  # m from a marking to the road that it is compared with
CONTRAST: Final = 0.10  # smallest ridge that counts, as a share of the brightness of the row
FULL_CONTRAST: Final = 0.35  # ridge from which on a marking counts fully
DARKEST: Final = 4.0  # code values: darker rows show nothing


@dataclass(frozen=True, slots=True, eq=False)
class RoadGrid:
    """Grid on the road in the frame of the ego, in front of it.

    Attributes:
        near: First row, m ahead of the middle of the ego.
        far: Last row, m ahead.
        half_width: From the middle column to the outermost ones, m.
        row_step: Distance of rows, m.
        column_step: Distance of columns, m.
    """

    near: float = 7.0
    far: float = 38.0
    half_width: float = 8.0
    row_step: float = 0.25
    column_step: float = 0.05

    def __post_init__(self) -> None:
        if not (0.0 < self.near < self.far and min(self.half_width, self.row_step, self.column_step) > 0.0):
            raise ConfigError(
                f"lane keeping: a top view from {self.near:g} to {self.far:g} m, {self.half_width:g} m to either side, "
                f"in steps of {self.row_step:g} and {self.column_step:g} m; give 0 < near < far, and all others above 0"
            )

    @property
    def row_distance(self) -> F64:
        """Distance of each row in front of the ego [R], m."""
        return np.arange(self.near, self.far + 1e-9, self.row_step, dtype=np.float64)

    @property
    def column_offset(self) -> F64:
        """Offset of each column from the middle of the ego [C], m to the left."""
        count = round(self.half_width / self.column_step)
        return np.arange(count, -count - 1, -1, dtype=np.float64) * self.column_step


@dataclass(frozen=True, eq=False)
class RoadMap:
    """Map from the image of a camera to a top view of the road.

    Attributes:
        camera: The camera.
        grid: The top view.
    """

    camera: Camera
    grid: RoadGrid

    @cached_property
    def pixels(self) -> tuple[F32, F32]:
        """Column and row of the image under each place of the grid [R, C]; -1 outside the image."""
        ahead, lateral = np.meshgrid(self.grid.row_distance, self.grid.column_offset, indexing="ij")
        points = np.stack([ahead, lateral, np.zeros_like(ahead), np.ones_like(ahead)])
        x, y, z, _ = np.tensordot(np.linalg.inv(self.camera.to_ego), points, 1)
        u, v, _ = np.tensordot(self.camera.intrinsic, np.stack([x, y, z]) / np.maximum(z, 1e-6), 1)
        # Intrinsics count from the corner of the first pixel, OpenCV from its middle.
        is_inside = (z > 0.1) & (u >= 0.5) & (u <= self.camera.width - 0.5)
        is_inside &= (v >= 0.5) & (v <= self.camera.height - 0.5)
        return np.where(is_inside, u - 0.5, -1.0).astype(np.float32), np.where(is_inside, v - 0.5, -1.0).astype(
            np.float32
        )

    def brightness(self, image: U8) -> F32:
        """Return the brightness of the road [R, C], code values; NaN outside the image.

        Red and green alone, so that yellow markings are as bright as white ones.

        Args:
            image: uint8 [3, H, W], RGB.

        Raises:
            ConfigError: The image is not of the size of the camera.
        """
        if image.shape != (3, self.camera.height, self.camera.width):
            raise ConfigError(
                f"lane keeping: an image of shape {list(image.shape)}; camera {self.camera.channel} gives "
                f"{[3, self.camera.height, self.camera.width]}"
            )
        grey = image[:2].astype(np.float32).mean(0)
        columns, rows = self.pixels
        road_pixels = cv2.remap(grey, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.where(columns < 0.0, np.float32(np.nan), road_pixels)


def marking_strength(brightness: F32, grid: RoadGrid) -> F32:
    """Return how clearly each place shows a marking, [R, C] in 0 to 1.

    Args:
        brightness: [R, C], code values; NaN outside the image, where no marking is detected.
        grid: Their grid.
    """
    shift = max(1, round(SIDE / grid.column_step))
    padded = np.pad(brightness, ((0, 0), (shift, shift)), constant_values=np.nan)
    sides = np.fmax(padded[:, : -2 * shift], padded[:, 2 * shift :])
    sides = np.where(np.isnan(padded[:, : -2 * shift] + padded[:, 2 * shift :]), np.nan, sides)
    # Noise would be a ridge in a dark row: its infinite level leaves no contrast.
    is_inside = ~np.isnan(brightness)
    level = np.where(is_inside, brightness, 0.0).sum(1) / np.maximum(is_inside.sum(1), 1)
    level = np.where(level < DARKEST, np.inf, level)[:, None]
    contrast = (brightness - sides) / level
    strength = (contrast - CONTRAST) / (FULL_CONTRAST - CONTRAST)
    return np.nan_to_num(strength, nan=0.0).clip(0.0, 1.0).astype(np.float32)

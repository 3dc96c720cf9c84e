"""Speed-limit signs read from the pixels of a front camera.

    image -> red mask -> round holes in it -> square of the plate -> correlation with the figures of each limit -> limit

A plate (C 14 of the Vienna convention) is a bright disc that red surrounds, so it is a round hole in the mask of red
pixels, also in front of a red wall. Figures are compared by normalised cross-correlation with drawings of the figures
at the size of the plate in the image, which is invariant to brightness and contrast. Location by colour and shape with
figures by template is the classical design of de la Escalera et al. (1997). The reader gets neither the map nor the
positions of signs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import F32, F64, U8
from ssad.rendering.bodies.figures import number_strokes

LIMITS: Final = tuple(range(10, 150, 10))  # km/h
WHITE: Final = 0.76  # radius of the white disc, as a share of that of the plate
PLATE: Final = 0.62  # m, diameter from which the distance of a plate follows
CELLS: Final = 28  # side of the square in which figures are compared
LEFT_EDGE: Final = 0.42  # share of the width from which plates are read: signs stand on the right of the road
ZOOM: Final = 2  # the upper half of an image is enlarged before plates are located
SMOOTH: Final = 1.2  # pixels of the enlarged image, width of the blur before the mask of red
MIN_PIXELS: Final = 14.0  # minimum diameter of a plate in the image
REDNESS: Final = (0.41, 0.46, 0.52)  # thresholds of R / (R + G + B), tried in turn
FORM: Final = (0.72, 1.39)  # width by height of a hole
ROUNDNESS: Final = (0.68, 0.87)  # share of its box that a hole covers; a disc has 0.79, a window 1


@dataclass(frozen=True, slots=True, kw_only=True)
class LimitReading:
    """Settings of reading speed-limit signs.

    Attributes:
        confirm: Number of readings of a sign that confirm it.
        score: Minimum correlation of a reading.
        margin: Minimum lead of a limit over the next one in the sum of the correlations of a sign, as a share of it.
    """

    confirm: int = 2
    score: float = 0.84
    margin: float = 0.03

    def __post_init__(self) -> None:
        if self.confirm < 1 or not 0.0 < self.score < 1.0 or not 0.0 <= self.margin < 1.0:
            raise ConfigError(
                "LimitReading needs confirm >= 1, a score between 0 and 1 and a margin from 0 to below 1, not "
                f"{self.confirm}, {self.score:g} and {self.margin:g}"
            )


@dataclass(frozen=True, slots=True)
class Plate:
    """Plate in an image.

    Attributes:
        centre: Column and row of its middle, pixels.
        diameter: Pixels.
        correlations: Correlation with the figures of each of `LIMITS`.
    """

    centre: tuple[float, float]
    diameter: float
    correlations: F64

    @property
    def limit(self) -> int:
        """Limit with the highest correlation, km/h."""
        return LIMITS[int(self.correlations.argmax())]

    @property
    def score(self) -> float:
        """Correlation with the figures of that limit."""
        return float(self.correlations.max())


def find_plates(image: U8, camera: Camera) -> list[Plate]:
    """Return the plates of speed-limit signs in an image.

    Args:
        image: uint8 [3, H, W], RGB.
        camera: Its camera; plates are looked for above the horizon and right of `LEFT_EDGE`.
    """
    horizon_row = int(min(camera.intrinsic[1, 2] + 0.02 * camera.height, camera.height))
    first_column = int(LEFT_EDGE * camera.width)
    picture = np.ascontiguousarray(np.moveaxis(image[:, :horizon_row, first_column:], 0, -1))
    enlarged = cv2.resize(picture, None, fx=ZOOM, fy=ZOOM, interpolation=cv2.INTER_LINEAR).astype(np.float32)
    # The colour filter of the sensor breaks thin rings into dots.
    smoothed = cv2.GaussianBlur(enlarged, (0, 0), SMOOTH)
    red_share = smoothed[..., 0] / (smoothed.sum(-1) + 1.0)
    red_lead = smoothed[..., 0] - np.maximum(smoothed[..., 1], smoothed[..., 2])
    plates: list[Plate] = []
    for threshold in REDNESS:
        red_mask = ((red_share > threshold) & (red_lead > 8.0)).astype(np.uint8)
        for column, row, diameter in _round_holes(red_mask):
            if all(
                np.hypot(first_column + column - plate.centre[0], row - plate.centre[1]) > 0.5 * plate.diameter
                for plate in plates
            ):
                correlations = _compare(enlarged, column * ZOOM, row * ZOOM, diameter * ZOOM)
                plates.append(Plate((first_column + column, row), diameter, correlations))
    return plates


def _round_holes(red: U8) -> list[tuple[float, float, float]]:
    """Return x, y and diameter, pixels of the image, of each plate whose white disc is a hole of a red mask."""
    contours, hierarchy = cv2.findContours(red, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    holes = []
    for contour, (_, _, _, parent) in zip(contours, [] if hierarchy is None else hierarchy[0], strict=False):
        x, y, width, height = cv2.boundingRect(contour)
        # The contour of a hole runs on the red pixels around it.
        width, height = width - 1, height - 1
        diameter = 0.5 * (width + height) / WHITE / ZOOM
        if parent < 0 or diameter < MIN_PIXELS or not FORM[0] < width / max(height, 1) < FORM[1]:
            continue
        if ROUNDNESS[0] < cv2.contourArea(contour) / (width * height) < ROUNDNESS[1]:
            holes.append(((x + 0.5 * width) / ZOOM, (y + 0.5 * height) / ZOOM, diameter))
    return holes


def _compare(picture: F32, x: float, y: float, diameter: float) -> F64:
    """Return the correlation of a plate with the figures of each limit; the best of nine places and three sizes."""
    grey_image = picture.mean(-1)
    highest = np.full(len(LIMITS), -1.0)
    for size in (0.94, 1.0, 1.06):
        disc_side = size * diameter * WHITE
        templates, weights = _templates(min(round(disc_side / ZOOM), 64))
        for shift_x, shift_y in ((i, j) for i in (-0.04, 0.0, 0.04) for j in (-0.04, 0.0, 0.04)):
            left_edge, top_edge = x + shift_x * diameter - 0.5 * disc_side, y + shift_y * diameter - 0.5 * disc_side
            scale = disc_side / CELLS
            matrix = np.array([[scale, 0.0, left_edge + 0.5 * scale - 0.5], [0.0, scale, top_edge + 0.5 * scale - 0.5]])
            square = cv2.warpAffine(
                grey_image,
                matrix,
                (CELLS, CELLS),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            )
            values = square.astype(np.float64)[weights]
            values -= values.mean()
            highest = np.maximum(highest, templates @ values / max(float(np.linalg.norm(values)), 1e-6))
    return np.asarray(highest)


@lru_cache(maxsize=64)
def _templates(pixels: int) -> tuple[F64, F64]:
    """Return the normalised figures [L, n] of each limit and the mask [CELLS, CELLS] of the n cells of a disc."""
    drawing_side = 280
    axis = (np.arange(CELLS) + 0.5) / CELLS * 2.0 - 1.0
    mask = np.hypot(*np.meshgrid(axis, axis)) < 0.9
    figure_rows = []
    for limit in LIMITS:
        drawing = np.full((drawing_side, drawing_side), 255, np.uint8)
        for stroke in number_strokes(str(limit), segments=8):
            points = 0.5 * drawing_side * (1.0 + stroke / WHITE * [1.0, -1.0])
            cv2.fillPoly(drawing, [np.round(points * 16.0).astype(np.int32)], 0, shift=4)
        size = max(pixels, 6)
        small_drawing = cv2.resize(drawing, (size, size), interpolation=cv2.INTER_AREA)
        # The lens and the colour filter spread an edge over about a pixel.
        small_drawing = cv2.GaussianBlur(small_drawing, (0, 0), 0.6)
        square = cv2.resize(small_drawing, (CELLS, CELLS), interpolation=cv2.INTER_LINEAR).astype(np.float64)[mask]
        square -= square.mean()
        figure_rows.append(square / np.linalg.norm(square))
    return np.array(figure_rows), np.asarray(mask)


class LimitMemory:
    """Speed limit that a driver has read from the signs of a drive so far.

    Args:
        settings: Settings of the reading.
    """

    def __init__(self, settings: LimitReading) -> None:
        self.settings = settings
        self.limit: int | None = None
        self._place: F64 | None = None
        self._sums, self._count = np.zeros(len(LIMITS)), 0

    def update(self, plates: list[Plate], camera: Camera, pose: F64) -> None:
        """Take in the plates of an image: the largest legible one counts.

        Args:
            plates: The plates.
            camera: The camera.
            pose: Pose of the camera in the world [4, 4].
        """
        legible = [plate for plate in plates if plate.score >= self.settings.score]
        if not legible:
            return
        plate = max(legible, key=lambda entry: entry.diameter)
        depth = camera.intrinsic[1, 1] * PLATE / plate.diameter
        ray = np.linalg.solve(camera.intrinsic, [*plate.centre, 1.0]) * depth
        place = (pose[:3, :3] @ ray + pose[:3, 3])[:2]
        if self._place is None or np.hypot(*(place - self._place)) > 0.35 * depth + 1.0:
            self._sums, self._count = np.zeros(len(LIMITS)), 0
        # Nearer plates are sharper, and count more.
        self._place, self._sums = place, self._sums + plate.correlations * plate.diameter
        self._count += 1
        order = np.sort(self._sums)
        if self._count >= self.settings.confirm and order[-1] - order[-2] >= self.settings.margin * order[-1]:
            self.limit = LIMITS[int(self._sums.argmax())]

"""The lane around the ego: a model of four numbers, fitted to markings and filtered over time.

Lines of the lane in the ego's frame: y(x) = offset + heading x + curvature x^2 / 2 +- width / 2. A Kalman filter
predicts them by the ego's motion and corrects them with one measurement a row and line: the mean place of the markings
near the predicted line, weighted by their strength (Dickmanns and Mysliwetz, PAMI 14, 1992; McCall and Trivedi, IEEE
Trans. ITS 7, 2006).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from ssad.core.perception import LANE_CONFIDENCE, PerceivedLane
from ssad.core.types import F32, F64
from ssad.drivers.lane_keeping.markings import RoadGrid

# reach, m, and half width of the window around the predicted line, m: each fit extends the one before
FITS: Final = ((14.0, 0.7), (20.0, 0.6), (28.0, 0.5), (np.inf, 0.4))
NOISE: Final = 0.35  # m, standard deviation of the place of a marking in one row; neighbouring rows err together
NOISE_STEP: Final = 0.25  # m from one of these rows to the next
FULL_WEIGHT: Final = 12.0  # m up to which rows count fully; further ones as they shrink in the image
CHANGE: Final = (0.05, 0.02, 0.004, 0.02)  # standard deviation of the change of each number in a `STEP`
INITIAL: Final = (0.6, 0.08, 0.01, 0.3)  # the same at the start
STEP: Final = 0.1  # s
USUAL_WIDTH: Final = 3.5  # m
WIDTHS: Final = (2.6, 4.4)  # m
HALF_ROWS: Final = 12  # rows of full strength at which the confidence in a lane is one half
SEARCH: Final = (  # values of offset, heading, curvature and width of the search for a lane
    np.arange(-1.2, 1.21, 0.15),
    np.array([-0.06, -0.03, 0.0, 0.03, 0.06]),
    np.array([-0.03, -0.015, -0.006, 0.0, 0.006, 0.015, 0.03]),
    np.array([3.0, 3.25, 3.5, 3.75]),
)


class LaneFilter:
    """Estimate of the lane of one ego over time.

    Args:
        grid: Top view that markings are given in.
    """

    def __init__(self, grid: RoadGrid) -> None:
        self.grid = grid
        self.state: F64 | None = None
        self.covariance: F64 = np.diag(np.square(INITIAL))
        self._is_sure = True
        distances = grid.row_distance
        ones = np.ones_like(distances)
        self._row_weight = np.minimum(FULL_WEIGHT / distances, 1.0) ** 2 * grid.row_step / NOISE_STEP
        # Rows of the measurement matrix of the left line; the right line differs in the sign of the width.
        self._left = np.stack([ones, distances, 0.5 * distances**2, 0.5 * ones], 1)
        self._right = self._left * [1.0, 1.0, 1.0, -1.0]

    def predict(self, forward: float, turn: float, seconds: float) -> None:
        """Move the lane by the motion of the ego.

        Args:
            forward: Distance driven, m.
            turn: Change of the ego's heading, rad to the left.
            seconds: Time that it took.
        """
        if self.state is None:
            return
        motion = np.eye(4)
        motion[0, 1], motion[0, 2], motion[1, 2] = forward, 0.5 * forward**2, forward
        self.state = motion @ self.state
        # The ego turns evenly on its way: its mean heading is that after half of the turn.
        self.state[0] -= 0.5 * forward * turn
        self.state[1] -= turn
        steps = seconds / STEP if self._is_sure else 0.0
        self.covariance = motion @ self.covariance @ motion.T + np.diag(np.square(CHANGE)) * steps

    def prediction(self) -> PerceivedLane | None:
        """Return the predicted lane, with a confidence of 0; None before the first detection."""
        return None if self.state is None else _lane_of(self.state, 0.0)

    def correct(self, strength: F32) -> PerceivedLane | None:
        """Correct the lane with the markings of an image.

        Args:
            strength: [R, C], as `ssad.drivers.lane_keeping.markings.marking_strength` returns it.

        Returns:
            The lane; None before the first detection.
        """
        if self.state is None:
            self.state = search_lane(strength, self.grid)
            if self.state is None:
                return None
            self.covariance = np.diag(np.square(INITIAL))
        confidence = 0.0
        prior, prior_information = self.state, np.linalg.inv(self.covariance)
        for reach, window in FITS:
            information, pull = prior_information.copy(), prior_information @ prior
            weights = []
            for design in (self._left, self._right):
                place, weight = line_places(strength, self.grid, design @ self.state, window)
                weight = np.where(self.grid.row_distance <= reach, weight, 0.0)
                precision = weight * self._row_weight / NOISE**2
                information += (design * precision[:, None]).T @ design
                pull += design.T @ (precision * place)
                weights.append(float(weight.sum()))
            self.state = np.linalg.solve(information, pull)
            self.state[3] = np.clip(self.state[3], *WIDTHS)
            total = sum(weights) * self.grid.row_step / NOISE_STEP
            confidence = total / (total + HALF_ROWS)
            covariance = np.linalg.inv(information)
        self._is_sure = confidence >= LANE_CONFIDENCE
        if not self._is_sure:
            # Where there are no lines, a few spurious ridges would pull the lane away: it moves with the ego alone.
            self.state = prior
        else:
            self.covariance = 0.5 * (covariance + covariance.T)
        return _lane_of(self.state, confidence)


def _lane_of(state: F64, confidence: float) -> PerceivedLane:
    """Return the lane of a state [4]."""
    offset, heading, curvature, width = state.tolist()
    return PerceivedLane(offset, heading, curvature, width, confidence)


def line_places(strength: F32, grid: RoadGrid, line: F64, window: float) -> tuple[F64, F64]:
    """Return the mean place of the markings near a line in each row, and their weight.

    Args:
        strength: [R, C].
        grid: Its grid.
        line: Place of the line in each row [R], m to the left.
        window: m around it.

    Returns:
        Places [R], m, and weights [R], 0 to 1.
    """
    offsets = grid.column_offset[None] - line[:, None]
    inside = np.where(np.abs(offsets) <= window, strength, 0.0)
    total = inside.sum(1)
    place = line + (inside * offsets).sum(1) / np.maximum(total, 1e-9)
    # A line of 0.12 m at full strength has the weight 1.
    return place, (total * grid.column_step / 0.1).clip(0.0, 1.0)


def search_lane(strength: F32, grid: RoadGrid) -> F64 | None:
    """Return the lane [4] of offset, heading, curvature and width with the clearest lines; None without lines.

    Both lines must be visible. Of two lanes, the one nearer to the middle of the ego scores higher.

    Args:
        strength: [R, C].
        grid: Its grid.
    """
    offsets, headings, curvatures, widths = (values.ravel() for values in np.meshgrid(*SEARCH, indexing="ij"))
    rows = np.arange(0, len(grid.row_distance), 2)
    distances = grid.row_distance[rows]
    blurred = _widened(strength[rows])
    middle = offsets[:, None] + headings[:, None] * distances + 0.5 * curvatures[:, None] * distances**2
    support = []
    for side in (0.5, -0.5):
        columns = np.rint((grid.column_offset[0] - (middle + side * widths[:, None])) / grid.column_step).astype(int)
        is_inside = (columns >= 0) & (columns < strength.shape[1])
        values = blurred[np.arange(len(rows)), columns.clip(0, strength.shape[1] - 1)]
        support.append(np.where(is_inside, values, 0.0).sum(1))
    left, right = support
    score = left + right - 2.0 * np.abs(offsets) - np.abs(widths - USUAL_WIDTH)
    score = np.where(np.minimum(left, right) < 3.0, -np.inf, score)
    best = int(score.argmax())
    if not np.isfinite(score[best]):
        return None
    return np.array([offsets[best], headings[best], curvatures[best], widths[best]])


def _widened(strength: F32) -> F32:
    """Return the strongest marking within 0.1 m of each place: the values of the search are coarse."""
    padded = np.pad(strength, ((0, 0), (2, 2)))
    width = strength.shape[1]
    widened: F32 = np.max([padded[:, shift : shift + width] for shift in range(5)], axis=0)
    return widened

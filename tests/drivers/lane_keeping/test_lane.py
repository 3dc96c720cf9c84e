"""The lane filter: it finds drawn lanes, follows the ego's motion and holds a lane that vanishes."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.types import F32
from ssad.drivers.lane_keeping.lane import LaneFilter, line_places, search_lane
from ssad.drivers.lane_keeping.markings import RoadGrid

GRID = RoadGrid(row_step=0.5)


def drawn(offset: float, heading: float, curvature: float, width: float, *, gaps: bool = False) -> F32:
    """Return markings [R, C] of a lane; with gaps, the left line is dashed."""
    strength = np.zeros((len(GRID.row_distance), len(GRID.column_offset)), np.float32)
    middle = offset + heading * GRID.row_distance + 0.5 * curvature * GRID.row_distance**2
    for side in (0.5, -0.5):
        columns = np.rint((GRID.column_offset[0] - middle - side * width) / GRID.column_step).astype(int)
        for row, column in enumerate(columns.tolist()):
            is_gap = gaps and side > 0.0 and GRID.row_distance[row] % 9.0 > 3.0
            if 1 <= column < strength.shape[1] - 1 and not is_gap:
                strength[row, column - 1 : column + 2] = 1.0
    return strength


@pytest.mark.parametrize(
    "lane", [(0.2, 0.0, 0.0, 3.5), (-0.4, 0.03, 0.0, 3.25), (0.0, 0.0, 0.012, 3.5), (0.3, -0.02, -0.006, 3.75)]
)
@pytest.mark.parametrize("gaps", [False, True])
def test_it_finds_a_drawn_lane(lane: tuple[float, float, float, float], gaps: bool) -> None:
    lane_filter = LaneFilter(GRID)
    for _ in range(4):
        perceived = lane_filter.correct(drawn(*lane, gaps=gaps))
        lane_filter.predict(0.0, 0.0, 0.1)
    assert perceived is not None
    for ahead in (8.0, 15.0, 25.0):
        truth = lane[0] + lane[1] * ahead + 0.5 * lane[2] * ahead**2
        assert perceived.middle(ahead) == pytest.approx(truth, abs=0.1)
    assert perceived.width == pytest.approx(lane[3], abs=0.1)
    assert perceived.confidence > 0.7


def test_without_two_lines_there_is_no_lane() -> None:
    nothing = np.zeros((len(GRID.row_distance), len(GRID.column_offset)), np.float32)
    assert search_lane(nothing, GRID) is None
    assert LaneFilter(GRID).correct(nothing) is None
    assert LaneFilter(GRID).prediction() is None


def test_a_lane_that_vanishes_is_held_by_the_motion_of_the_ego() -> None:
    lane_filter = LaneFilter(GRID)
    lane_filter.correct(drawn(0.0, 0.0, 0.0, 3.5))
    random = np.random.default_rng(0)
    noise = (random.random((len(GRID.row_distance), len(GRID.column_offset))) < 0.002).astype(np.float32)
    for _ in range(10):  # 10 m straight on, turned by 0.02 rad to the left in all
        lane_filter.predict(1.0, 0.002, 0.1)
        held = lane_filter.correct(noise)
    assert held is not None
    assert held.confidence < 0.7
    # The ego has turned to the left, so the lane runs to the right of it.
    assert held.heading == pytest.approx(-0.02, abs=1e-3)
    assert held.offset == pytest.approx(-0.1, abs=0.02)


def test_a_circle_that_is_driven_stays_the_same_lane() -> None:
    curvature, lane_filter = 0.01, LaneFilter(GRID)
    for _ in range(5):
        lane_filter.correct(drawn(0.0, 0.0, curvature, 3.5))
        lane_filter.predict(1.0, curvature * 1.0, 0.1)
    predicted = lane_filter.prediction()
    assert predicted is not None
    assert predicted.offset == pytest.approx(0.0, abs=0.05)
    assert predicted.heading == pytest.approx(0.0, abs=0.01)


def test_places_of_a_line_are_the_mean_of_the_markings_near_it() -> None:
    strength = np.zeros((len(GRID.row_distance), len(GRID.column_offset)), np.float32)
    column = int(np.argmin(np.abs(GRID.column_offset - 1.5)))
    strength[:, column] = 1.0
    strength[:, column + 40] = 1.0  # 2 m further right: it does not belong to the line
    place, weight = line_places(strength, GRID, np.full(len(GRID.row_distance), 1.3), 0.5)
    np.testing.assert_allclose(place, 1.5, atol=1e-6)
    np.testing.assert_allclose(weight, 0.5)  # one column of 0.05 m of a line that is 0.1 m wide

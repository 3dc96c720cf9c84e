"""The grid of views by hand: cells of distance and azimuth, their AP50, the worst of them."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.metrics.target_attacks import TargetSighting
from ssad.metrics.target_grid import grid_scores

TARGET = np.array([[10.0, 10.0, 50.0, 40.0]])


def seen(score: float) -> TargetSighting:
    """A picture whose target is found with a score; 0: it is not."""
    found = TARGET if score else np.zeros((0, 4))
    return TargetSighting("a", found, np.full(len(found), score), TARGET, np.zeros(1, bool))


def row(distance: float, azimuth: float, weather: str = "day") -> dict[str, object]:
    return {"distance": distance, "azimuth": azimuth, "elevation": 15.0, "weather": weather, "file_name": "x"}


def test_cells_are_scored_apart_and_the_worst_is_where_the_attack_does_least() -> None:
    rows = [row(5.0, 0.0), row(5.0, 0.0, "night"), row(5.0, 180.0), row(20.0, 180.0)]
    clean = [seen(0.9), seen(0.8), seen(0.9), seen(0.0)]
    attacked = [seen(0.0), seen(0.4), seen(0.0), seen(0.5)]
    found = grid_scores(rows, clean, attacked, floor=0.9)
    half = pytest.approx(51 / 101, abs=1e-6)
    assert found["cells"] == [[5.0, 0.0, 2, 1.0, half], [5.0, 180.0, 1, 1.0, 0.0], [20.0, 180.0, 1, 0.0, None]]
    assert found["worst"] == [5.0, 0.0, half]
    assert found["views"][1] == [5.0, 0.0, 15.0, "night", 0.8, 0.4]
    assert grid_scores(rows[3:], clean[3:], attacked[3:], floor=0.9)["worst"] is None, "no cell reaches the floor"


def test_without_an_attack_the_worst_cell_is_the_detectors() -> None:
    rows = [row(5.0, 0.0), row(20.0, 180.0)]
    found = grid_scores(rows, [seen(0.9), seen(0.0)], None, floor=0.9)
    assert found["worst"] == [20.0, 180.0, 0.0]
    assert [view[5] for view in found["views"]] == [None, None]


def test_scores_are_rounded() -> None:
    """Confidences to four places, AP50 to six."""
    found = grid_scores([row(5.0, 0.0)] * 2, [seen(0.91234567)] * 2, [seen(0.12345678), seen(0.0)], floor=0.9)
    assert found["views"][0][4:] == [0.9123, 0.1235]
    assert found["cells"][0][4] == round(51 / 101, 6)

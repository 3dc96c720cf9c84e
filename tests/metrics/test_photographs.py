"""Scores on photographs: counted by hand, by class and by height."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ssad.metrics.detection2d import Boxes2D
from ssad.metrics.photographs import HeightBand, photograph_scores, worn_scores

BANDS = [HeightBand(10.0, 50.0), HeightBand(50.0)]
TRUTH = Boxes2D(
    np.array([0, 0, 0, 1, 1], np.int32),
    np.array([0, 0, 1, 0, 0], np.int32),
    np.array([[0, 0, 40, 40], [100, 0, 160, 60], [0, 100, 20, 140], [0, 0, 5, 5], [50, 50, 90, 90]], np.float64),
    ignore=np.array([False, False, False, False, True]),
)
FOUND = Boxes2D(
    np.array([0, 0, 0, 1, 1], np.int32),
    np.array([0, 0, 0, 0, 0], np.int32),
    np.array([[0, 0, 40, 40], [100, 0, 160, 60], [200, 0, 240, 40], [0, 0, 5, 5], [50, 50, 90, 90]], np.float64),
    np.array([0.9, 0.2, 0.5, 0.8, 0.7]),
)


def scores(**changes: Any) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "images": 2,
        "classes": ["car", "bus"],
        "bands": BANDS,
        "threshold": 0.25,
        "replicates": 0,
    }
    return photograph_scores(TRUTH, FOUND, **settings | changes)


def test_scores_are_those_counted_by_hand() -> None:
    record = scores()
    # objects: two cars and a bus; the tiny car and the ignored one do not count, nor do the boxes on them
    assert record["n"] == 3
    assert record["metrics"]["recall"] == pytest.approx(1 / 3, abs=1e-6)
    assert record["metrics"]["precision"] == pytest.approx(1 / 2)
    assert record["metrics"]["margin"] == pytest.approx((0.9 + 0.2) / 3 - 0.25, abs=1e-6)
    assert record["metrics"]["boxes"] == pytest.approx(1.0)
    assert record["metrics"]["wrong"] == pytest.approx(0.5)
    # of the cars: right, wrong, right; precision 1 up to a recall of one half, then 2 / 3
    assert record["metrics"]["AP50"] == pytest.approx((51 + 50 * 2 / 3) / 101 / 2, abs=1e-6)
    assert record["intervals"] == {}


def test_parts_by_class_and_by_height() -> None:
    parts = {(part["by"], part["name"]): part for part in scores()["parts"]}
    assert parts["class", "car"]["metrics"]["recall"] == pytest.approx(1 / 2)
    assert parts["class", "bus"]["metrics"]["recall"] == 0
    assert parts["class", "bus"]["metrics"]["precision"] is None
    low, high = parts["height", "10 to 50 px"], parts["height", "50 px and more"]
    assert (low["n"], high["n"]) == (2, 1)
    assert low["metrics"]["precision"] == pytest.approx(1 / 2)
    assert high["metrics"]["recall"] == 0
    assert high["metrics"]["precision"] is None
    assert high["metrics"]["AP50"] == pytest.approx(1.0)


def test_intervals_are_by_photograph() -> None:
    images = 12
    truth = Boxes2D(
        np.arange(images, dtype=np.int32), np.zeros(images, np.int32), np.tile([0.0, 0, 40, 40], (images, 1))
    )
    rows = np.arange(0, images, 2, dtype=np.int32)
    found = Boxes2D(
        rows, np.zeros(len(rows), np.int32), np.tile([0.0, 0, 40, 40], (len(rows), 1)), np.full(len(rows), 0.6)
    )
    settings: dict[str, Any] = {"classes": ["car"], "bands": BANDS[:1], "threshold": 0.25, "replicates": 100}
    record = photograph_scores(truth, found, images=images, **settings)
    for name in ("recall", "AP50", "margin"):
        low, high = record["intervals"][name]
        assert low < record["metrics"][name] < high
    doubled = photograph_scores(
        Boxes2D(
            np.repeat(truth.image, 2),
            np.repeat(truth.label, 2),
            np.concatenate([truth.box, truth.box + 100])[np.argsort(np.tile(np.arange(images), 2), kind="stable")],
        ),
        Boxes2D(
            np.repeat(found.image, 2),
            np.repeat(found.label, 2),
            np.concatenate([found.box, found.box + 100])[np.argsort(np.tile(np.arange(len(rows)), 2), kind="stable")],
            np.full(2 * len(rows), 0.6),
        ),
        images=images,
        **settings,
    )
    # twice as many objects in the same photographs say nothing more
    assert doubled["intervals"]["recall"] == pytest.approx(record["intervals"]["recall"])
    few = photograph_scores(truth, found, images=images, **settings | {"replicates": 0})
    assert few["intervals"] == {}


def test_worn_scores() -> None:
    clean, worn = np.array([0.9, 0.8, 0.1, 0.6]), np.array([0.0, 0.7, 0.3, 0.1])
    record = worn_scores(clean, worn, np.zeros(4, np.int32), threshold=0.25, replicates=10)
    assert record["metrics"] == pytest.approx(
        {"found": 0.5, "score": 0.275, "change": -0.325, "hidden": 2 / 3}, abs=1e-6
    )
    assert record["intervals"] == {}
    spread = worn_scores(
        np.tile(clean, 5), np.tile(worn, 5), np.repeat(np.arange(5, dtype=np.int32), 4), threshold=0.25, replicates=20
    )
    low, high = spread["intervals"]["change"]
    assert -1 <= low <= spread["metrics"]["change"] <= high <= 1
    none = worn_scores(np.zeros(2), np.zeros(2), np.arange(2, dtype=np.int32), threshold=0.25, replicates=10)
    assert none["metrics"]["hidden"] is None

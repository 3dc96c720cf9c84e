"""What an attack takes of a score has an interval that a share can have, whether it takes nothing or all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.experiments.perception.digital.run import DigitalRun, Setting, gained_cell, lost_cell
from ssad.report.load import Run

CLEAN, PGD = Setting(), Setting("pgd", "margin", "linf", 5.0, 10)


def run_of(records: dict[tuple[str, Setting], Any]) -> DigitalRun:
    return DigitalRun(Run(Path(), {"suite": {"detectors": ["one", "two"]}}, (), {}, 0), records)


def record(mean: float, spread: float, seed: int) -> dict[str, Any]:
    draws = np.clip(mean + spread * np.random.default_rng(seed).normal(size=200), 0.0, 1.0)
    return {"status": "ok", "metrics": {"mAP": mean}, "replicates": {"mAP": draws.tolist()}, "n": 32, "scenes": 8}


@pytest.mark.parametrize(
    ("left", "spread", "low", "high"),
    [(0.400, 0.004, -5.0, 5.0), (0.404, 0.004, -6.0, 4.0), (0.2, 0.02, 35.0, 65.0), (0.01, 0.005, 85.0, 100.0)],
)
def test_what_an_attack_takes_has_an_interval_around_it(left: float, spread: float, low: float, high: float) -> None:
    run = run_of({("one", CLEAN): record(0.4, 0.0, 0), ("one", PGD): record(left, spread, 1)})
    cell = lost_cell(run, "one", PGD, "mAP")
    assert cell.mean == pytest.approx(100 * (1 - left / 0.4), abs=1e-9)
    assert low < cell.low < cell.mean < cell.high <= high


def test_a_score_that_more_than_doubles_has_no_interval() -> None:
    run = run_of({("one", CLEAN): record(0.1, 0.01, 0), ("one", PGD): record(0.3, 0.01, 1)})
    cell = lost_cell(run, "one", PGD, "mAP")
    assert cell.mean == pytest.approx(-200.0)
    assert np.isnan(cell.low)


def test_a_difference_of_two_detectors_is_mirrored_with_them() -> None:
    run = run_of({("one", PGD): record(0.06, 0.02, 0), ("two", PGD): record(0.01, 0.01, 1)})
    there, back = (gained_cell(run, names, PGD, "mAP") for names in (("one", "two"), ("two", "one")))
    assert there.mean == pytest.approx(5.0)
    assert there.low < 5.0 < there.high
    assert (back.mean, back.low, back.high) == pytest.approx((-there.mean, -there.high, -there.low))

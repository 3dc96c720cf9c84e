"""Rates of collisions in sentences."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.run_folder import write_run

from ssad.experiments.how_often.verdict import _million, without_interval
from ssad.report.load import load_run


@pytest.mark.parametrize(
    ("value", "text"), [(0.0123, "0.012"), (9.94, "9.9"), (10.0, "10"), (10.6, "11"), (12345.4, "12,345")]
)
def test_small_numbers_have_two_digits_and_large_ones_none_behind_the_point(value: float, text: str) -> None:
    assert _million(value) == text


@pytest.mark.parametrize(("high", "remarks"), [(None, 1), (50.0, 0)])
def test_the_table_says_why_splitting_has_no_limits(high: float | None, remarks: int, tmp_path: Path) -> None:
    metrics = {"per_million": 10.0, "low": None if high is None else 1.0, "high": high}
    line = {"key": "a", "system": "autopilot", "method": "splitting", "status": "ok", "metrics": metrics}
    run = load_run(write_run(tmp_path / "run", {"kind": "how-often"}, [line]))
    sentences = without_interval(run)
    assert len(sentences) == remarks
    assert all("repeats=8 or more" in sentence for sentence in sentences)

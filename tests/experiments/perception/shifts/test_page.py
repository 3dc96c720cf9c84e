"""Page of a detection run: the order of the shifts beside the published one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.run_folder import write_run

from ssad.experiments.perception.shifts.page import load_detection_run, order_table
from ssad.report.load import load_run
from ssad.report.paper import SHIFTS as PUBLISHED

DETECTOR = "fcos3d-light"


def table_of(folder: Path, scores: dict[str, float], **suite: Any) -> Any:
    """The table of order of a run with these scores by shift ("": clean)."""
    lines = [
        {
            "key": shift or "clean",
            "detector": DETECTOR,
            "shift": shift or None,
            "severity": "random" if shift else 0,
            "family": "environment",
            "status": "ok",
            "metrics": {"mAP": score, "NDS": -score},
            "n": 4,
            "scenes": 4,
        }
        for shift, score in scores.items()
    ]
    told = {"name": "x", "detectors": [DETECTOR], "severities": ["random"], "reference": "shifts"}
    shifts = [shift for shift in scores if shift]
    header = {"kind": "detection", "suite": told | {"shifts": shifts} | suite, "command": "ssad run x"}
    return order_table(load_detection_run(load_run(write_run(folder, header, lines))))


def test_the_order_of_the_shifts_is_held_against_the_published_one(tmp_path: Path) -> None:
    published = {shift: numbers["FCOS3D"][0] / 1000 for shift, numbers in PUBLISHED.items()}
    table = table_of(tmp_path / "same", published | {"mine": 0.5})
    (row,) = table.rows
    assert row.head == (DETECTOR,)
    assert row.cells[0].mean == pytest.approx(1.0)
    assert row.cells[1].mean < 0  # NDS runs the other way here
    assert (row.cells[0].n, row.cells[0].method) == (len(PUBLISHED) - 1, "bootstrap")
    few = dict(list(published.items())[:4])
    assert table_of(tmp_path / "few", few).rows[0].cells[0].method == "none"


def test_there_is_no_order_without_published_numbers(tmp_path: Path) -> None:
    scores = {"": 0.5, "fog": 0.4, "snow": 0.3, "mine": 0.2}
    assert table_of(tmp_path / "few", scores) is None
    scores |= {"gaussian": 0.1}
    assert table_of(tmp_path / "plain", scores, reference=None) is None
    assert table_of(tmp_path / "with", scores) is not None

"""Sheets of drives: which moments they show."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from helpers.metric_traces import make_trace

from ssad.core.perception import DrivePerception
from ssad.experiments.gap import drive_sheet as module
from ssad.experiments.gap.drive_sheet import drive_sheet

STEPS = 41


@pytest.mark.parametrize(
    ("contact_step", "times"),
    [(None, [1.0, 2.0, 3.0]), (35, [1.5, 2.5, 3.5]), (12, [0.0, 0.2, 1.2])],
)
def test_a_sheet_shows_the_last_two_seconds_before_a_contact(
    contact_step: int | None, times: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    touched = np.full(STEPS, -1)
    if contact_step is not None:
        touched[contact_step:] = 1
    shown: list[float] = []

    def row(drive: Any, time: float, graph: Any) -> Any:
        shown.append(time)
        return np.zeros((2, 3, 3), np.uint8)

    monkeypatch.setattr(module, "_draw_moment", row)
    bodies = ((0.0, 0.0, 0.0, 0.0), (9.0, 0.0, 0.0, 0.0))
    trace = make_trace(STEPS, bodies, contact_agent=touched)
    assert drive_sheet(trace, DrivePerception([], [], {}), [], cast("Any", None)).shape == (6, 3, 3)
    assert shown == pytest.approx(times)

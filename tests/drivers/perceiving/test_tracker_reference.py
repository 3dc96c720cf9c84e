"""Our tracker beside those of Roboflow's package `trackers`, on boxes that YOLOv5n found in drives."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[3]
STORED = json.loads((ROOT / "benchmarks" / "results" / "trackers.json").read_text())


@pytest.fixture(scope="module")
def reference() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "benchmarks" / "tracker_reference.py"))


def test_the_association_is_as_good_as_bytetracks_on_the_same_boxes(reference: dict[str, Any]) -> None:
    drives = reference["load"]()
    assert sum(map(len, drives)) == STORED["pictures"]
    own, byte, sort = (STORED["scores"][name] for name in ("ours", "ByteTrack", "SORT"))
    found = reference["Mean"].of(reference["scored"](drives, reference["ours"]))
    for name in ("hota", "association", "idf1", "mota"):
        assert getattr(found, name) == pytest.approx(own[name], abs=0.01), name
    assert found.hota > byte["hota"] - 0.02
    assert found.idf1 > byte["idf1"] - 0.02
    assert found.association > sort["association"] + 0.05  # the second stage is what SORT lacks


def test_the_stored_scores_of_the_others_are_those_of_the_package(reference: dict[str, Any]) -> None:
    pytest.importorskip("trackers", reason="trackers is not installed (docs/results/gap.md)")
    found = reference["compare"](reference["load"]())
    for name in ("ByteTrack", "SORT"):
        for score in ("hota", "mota", "idf1"):
            assert found[name][score] == pytest.approx(STORED["scores"][name][score], abs=0.01), (name, score)

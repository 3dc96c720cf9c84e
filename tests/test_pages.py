"""Pages of numbers are what the measurements in benchmarks/results say, of the weights that are shipped."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

from ssad.bench.kinds.detection import state_hash
from ssad.evaluation.scene_boxes import detector_of
from ssad.scenarios.static.shifts import VERSIONS

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(("script", "name"), [("page", "benchmarks"), ("shift_page", "results")])
def test_a_page_is_made_from_the_measurements(script: str, name: str) -> None:
    page = runpy.run_path(str(ROOT / "benchmarks" / f"{script}.py"))["page"]()
    assert page == (ROOT / "docs" / f"{name}.md").read_text(), f"run python benchmarks/{script}.py"


@pytest.mark.parametrize("run", ["shifts", "shifts-paper"])
def test_results_are_those_of_the_shipped_weights_and_of_these_shifts(run: str) -> None:
    told = json.loads((ROOT / "benchmarks" / "results" / run / "run.json").read_text())
    assert told["versions"]["shifts"] == str(VERSIONS[told["suite"]["calibration"]])
    assert told["weights"] == {
        name: state_hash(detector_of(name, "", "cpu")) for name in ("fcos3d-light", "pgd-det-light")
    }

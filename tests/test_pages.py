"""Pages of numbers are what the measurements in benchmarks/results say, and tell when these are out of date."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

from ssad.core.checkpoints import state_hash
from ssad.evaluation.scene_boxes import detector_of
from ssad.scenarios.static.shifts import VERSIONS

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("script", "name"),
    [
        ("page", "benchmarks"),
        ("shift_page", "results"),
        ("digital_page", "digital"),
        ("physical_page", "physical_results"),
        ("detector_accuracy", "accuracy"),
    ],
)
def test_a_page_is_made_from_the_measurements(script: str, name: str) -> None:
    page = runpy.run_path(str(ROOT / "benchmarks" / f"{script}.py"))["page"]()
    assert page == (ROOT / "docs" / f"{name}.md").read_text(), f"run python benchmarks/{script}.py"


@pytest.mark.parametrize("run", ["shifts", "shifts-paper"])
def test_a_page_says_which_results_are_older_than_weights_and_shifts(run: str) -> None:
    told = json.loads((ROOT / "benchmarks" / "results" / run / "run.json").read_text())
    current = told["versions"]["shifts"] == str(VERSIONS[told["suite"]["calibration"]])
    current &= told["weights"] == {
        name: state_hash(detector_of(name, "", "cpu")) for name in ("fcos3d-light", "pgd-det-light")
    }
    warnings = [line for line in (ROOT / "docs" / "results.md").read_text().splitlines() if line.startswith("> **")]
    assert any(f"`{run}` with" in line for line in warnings) is not current


def test_the_page_of_attacks_says_whether_weights_have_changed() -> None:
    told = json.loads((ROOT / "benchmarks" / "results" / "digital" / "run.json").read_text())
    current = told["weights"] == {name: state_hash(detector_of(name, "", "cpu")) for name in told["weights"]}
    assert ("**Measured with earlier weights" in (ROOT / "docs" / "digital.md").read_text()) is not current

"""The number of packages that one cell passes through, and the script that traces it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.cell_trace import Call, count, first_calls, report, trace_cell, upward_calls
from ssad.core.rotations import wrap_angle
from ssad.experiments.suites import kind_of

SHORT = """
name: short
type: StraightObstacle
town: ProvingGround
route: [{x: 217.0, y: -5.25}, {x: 317.0, y: -5.25}]
limits: {max_steps: 12}
"""
BRIGHT = {"name": "bright", "detector": "helpers.gap_detectors:Bright", "width": 64, "rate": 5.0}
SUITES: dict[str, dict[str, Any]] = {
    "driving": {"systems": ["autopilot"]},
    "gap": {"systems": [BRIGHT], "ceilings": [], "perturbations": [{"fog": 3}]},
}
MOST_PACKAGES = 20
MOST_UPWARD_CALLS = 5


@pytest.mark.parametrize("kind_name", SUITES)
def test_a_cell_passes_through_few_packages(kind_name: str, tmp_path: Path) -> None:
    """Budget of the spec's rule 6; a package counts down to the second level, `ssad.scenarios.static`."""
    (tmp_path / "short.yaml").write_text(SHORT)
    kind = kind_of(kind_name)
    values = {"kind": kind_name, "name": "t", "scenarios": [str(tmp_path / "short.yaml")], **SUITES[kind_name]}
    plan = kind.plan(kind.suite.model_validate(values))
    calls = trace_cell(plan, plan.cells[-1], tmp_path)
    packages = {call.package for call in calls}
    assert len(packages) <= MOST_PACKAGES, sorted(packages)
    path = [call for call in calls if call.depth <= 4]
    assert sum(call in path for _, call in upward_calls(calls)) <= MOST_UPWARD_CALLS
    assert f"in all    {len(packages)} packages" in report(calls, 4)


def test_counts_of_a_path_that_is_known() -> None:
    path = [
        Call("experiments/gap/kind.py", "a", None, 0),
        Call("experiments/gap/page.py", "b", 0, 1),
        Call("world/world.py", "c", 0, 1),
        Call("experiments/gap/kind.py", "d", 2, 2),  # upward
        Call("core/types.py", "e", 3, 3),
    ]
    by_package = count(path, lambda call: call.package)
    assert (by_package.visits, by_package.units, by_package.returns) == (4, 3, 1)
    by_module = count(path, lambda call: call.module)
    assert (by_module.visits, by_module.units) == (5, 4)
    assert [(caller.function, call.function) for caller, call in upward_calls(path)] == [("c", "d")]


def test_functions_count_once_and_others_do_not() -> None:
    calls = first_calls(lambda: [wrap_angle(4.0), wrap_angle(5.0), sorted([2, 1])])
    assert [(call.module, call.function) for call in calls] == [("core/rotations.py", "wrap_angle")]

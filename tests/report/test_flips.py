"""Flip rates between the conditions of runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.run_folder import DRIVING_HEADER, driving_line, write_run

from ssad.report.flips import pair_flips
from ssad.report.load import Run, load_run

RATES = {"CR": "collision", "IF": "in_route_failure"}


def line(system: str, route: int, collided: bool, **fields: Any) -> dict[str, Any]:
    scenario = f"S/{route}"
    key = "".join([system, str(route), *(str(value) for value in fields.values())])
    return driving_line(key, "S", scenario, system=system, collision=collided) | fields


def run_of(folder: Path, lines: list[dict[str, Any]], kind: str = "driving") -> Run:
    return load_run(write_run(folder, DRIVING_HEADER | {"kind": kind}, lines))


def test_all_pairs_of_systems_are_compared_in_the_same_cases(tmp_path: Path) -> None:
    lines = [line("a", k, k < 2) for k in range(6)] + [line("b", k, k in (1, 2, 3)) for k in range(6)]
    lines += [line("c", k, False) for k in range(3)]
    found = {
        (pair.rate, pair.first, pair.second): pair.flips
        for pair in pair_flips([run_of(tmp_path / "r", lines)], RATES, ("system", "group"))
    }
    assert set(found) == {(rate, *pair) for rate in RATES for pair in (("a", "b"), ("a", "c"), ("b", "c"))}
    assert (found["CR", "a", "b"].flips, found["CR", "a", "b"].sample.cases) == (3, 6)
    assert (found["CR", "a", "c"].flips, found["CR", "a", "c"].sample.cases) == (2, 3)
    assert found["IF", "a", "b"].flips == 0


def test_another_seed_is_another_case(tmp_path: Path) -> None:
    lines = [line("a", k, True, seed=1) for k in range(4)] + [line("b", k, False, seed=k // 2) for k in range(4)]
    (found,) = pair_flips([run_of(tmp_path / "r", lines)], {"CR": "collision"}, ("system",))
    assert found.flips.sample.cases == 2


def test_perturbations_are_paired_within_a_system_and_systems_within_a_perturbation(tmp_path: Path) -> None:
    lines = [
        line(system, k, system == "a" and perturbation == "fog", perturbation=perturbation, severity=severity)
        for system in "ab"
        for perturbation, severity in (("none", 0), ("fog", 3))
        for k in range(3)
    ]
    found = pair_flips(
        [run_of(tmp_path / "r", lines, "gap")], {"CR": "collision"}, ("system", "perturbation", "severity")
    )
    assert {(pair.first, pair.second): pair.flips.flips for pair in found} == {
        ("a none", "a fog 3"): 3,
        ("b none", "b fog 3"): 0,
        ("a none", "b none"): 0,
        ("a fog 3", "b fog 3"): 3,
    }


def test_a_system_of_two_runs_is_named_by_its_folder(tmp_path: Path) -> None:
    runs = [run_of(tmp_path / name, [line("a", k, k < hits) for k in range(4)]) for name, hits in (("x", 1), ("y", 3))]
    (found,) = pair_flips(runs, {"CR": "collision"}, ("system", "group"))
    assert (found.first, found.second) == (f"a ({tmp_path}/x)", f"a ({tmp_path}/y)")
    assert (found.flips.flips, found.flips.difference) == (2, pytest.approx(-0.5))

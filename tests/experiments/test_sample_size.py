"""`ssad plan`: cells and cases of a suite, and the cases that a difference needs."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest
from helpers.command import ssad
from helpers.run_folder import DRIVING_HEADER, driving_line, write_run

from benchmarks.flip_rates import measurements
from ssad.core import safeio
from ssad.experiments.sample_size import REFERENCE, pair_from
from ssad.experiments.suites import KINDS, kind_of
from ssad.report.load import load_run

RIGHT_TURN = ("precrash", "--set", "scenarios=[RightTurn]", "--set", "repetitions=3", "--device", "cpu")


def flips_run(folder: Path, *, clusters: int = 20, kind: str = "driving", flips: int = 6) -> Path:
    """A run of two systems in two cases a route: the first collides once on some routes, the second never."""
    lines: list[dict[str, Any]] = []
    for system in ("mine", "other"):
        for k in range(2 * clusters):
            collided = system == "mine" and k % 2 == 0 and k < 2 * flips
            one = driving_line(f"{system}{k}", "RightTurn", f"route{k // 2}", system=system, collision=collided)
            one["spec"]["scenario"]["name"] = f"scenario{k}"
            lines.append(one)
    return write_run(folder, DRIVING_HEADER | {"kind": kind}, lines)


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rows(text: str, rate: str) -> list[list[str]]:
    """Cells of the table's lines of one rate."""
    return [re.split(r"\s{2,}", line) for line in text.splitlines() if line.startswith(f"{rate} ")]


def test_a_plan_counts_cells_cases_and_clusters_and_writes_nothing(work: Path) -> None:
    done = ssad("plan", *RIGHT_TURN)
    assert done.returncode == 0, done.stderr
    assert "cells: 60, of which 0 are there already and 60 would run" in done.stdout
    assert "cases: 12 in 4 clusters, each met by up to 5 cells" in done.stdout
    assert "power" not in done.stdout
    assert os.listdir(work) == []


def test_flip_rates_of_runs_say_how_many_cases_a_difference_needs(work: Path) -> None:
    folder = flips_run(work / "measured")
    found = {d: ssad("plan", *RIGHT_TURN, "--detect", d, "--runs", folder).stdout for d in ("0.05", "0.1")}
    (small,), (large,) = rows(found["0.05"], "CR"), rows(found["0.1"], "CR")
    rate, pair, difference, flips, _, cases, clusters, unpaired, suite = large
    assert (rate, pair, difference, flips) == ("CR", "mine, other", "0.15", "0.15 (6 of 40)")
    assert int(cases) == 3 * int(clusters) > 100, "three cases a route, as in the suite"
    assert int(small[5].replace(",", "")) > 2 * int(cases)
    assert int(unpaired) > 0
    assert suite == "nothing"
    assert f"Flip rates: measured in {folder}" in found["0.1"]
    assert "with fewer than 10 there is no interval" in found["0.1"]
    assert "Unknown: CR_vehicle, CR_walker, CR_cyclist, CR_static, IF; no outcome differs in 40 cases" in found["0.1"]
    more = rows(ssad("plan", *RIGHT_TURN, "--detect", "0.1", "--power", "0.95", "--runs", folder).stdout, "CR")
    assert int(more[0][5]) > int(cases)


def test_two_folders_of_one_system_are_compared(work: Path) -> None:
    first, second = flips_run(work / "first"), flips_run(work / "second", flips=2)
    text = ssad("plan", *RIGHT_TURN, "--detect", "0.1", "--runs", first, "--runs", second).stdout
    assert f"mine ({first}), mine ({second})" in text


def test_the_reference_is_of_the_scenarios_and_systems_of_the_suite(work: Path) -> None:
    words = ("precrash", "--device", "cpu", "--set", "systems=[ppo,sac]", "--detect", "0.1")
    text = ssad("plan", *words, "--set", "scenarios=[natural]").stdout
    assert [row[1] for row in rows(text, "CR")] == ["ppo, sac"]
    data = safeio.read_json(REFERENCE)
    natural = next(entry for entry in data["measurements"] if entry["scenarios"] == ["natural"])
    pair = next(one for one in map(pair_from, natural["pairs"]) if (one.first, one.second) == ("ppo", "sac"))
    assert f"({pair.flips.flips} of 150)" in text
    assert f"measured on natural (150 cases), commit {data['commit']}" in text
    assert "others" not in text
    unlike = ssad("plan", *words, "--set", "scenarios=[RightTurn]", "--set", "systems=[autopilot]").stdout
    assert "the scenarios of this suite are others" in unlike
    assert "those of this suite were not measured" in unlike


def test_the_largest_suite_detects_what_it_says(work: Path) -> None:
    words = ("plan", "precrash", "--device", "cpu", "--set", "systems=[ppo,sac]")
    least = rows(ssad(*words, "--detect", "0.3").stdout, "CR")[0][-1]
    text = ssad(*words, "--detect", least).stdout
    assert "enough for 1 of 1 pairs in CR" in text
    assert "enough for 0 of 1 pairs in CR" in ssad(*words, "--detect", f"{float(least) - 0.02:.2f}").stdout


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (("tour", "--detect", "0.1"), ("kind 'tour'", "driving, adversarial, gap")),
        (("gap-quick", "--detect", "0.1"), ("no flip rates of kind 'gap'", "--runs FOLDER")),
        ((*RIGHT_TURN, "--runs", "."), ("--runs can only be used with --detect",)),
        ((*RIGHT_TURN, "--detect", "0.1", "--runs", "nowhere"), ("nowhere: no such file or folder",)),
        ((*RIGHT_TURN, "--detect", "0.1", "--runs", "gap"), ("a run of kind 'gap' says nothing about kind 'driving'",)),
        ((*RIGHT_TURN, "--detect", "0.1", "--runs", "alone"), ("no two systems or perturbations met the same cases",)),
        (("quik", "--detect", "0.1"), ("unknown suite 'quik'",)),
    ],
)
def test_what_cannot_be_planned_is_one_line(work: Path, words: tuple[str, ...], parts: tuple[str, ...]) -> None:
    flips_run(work / "gap", kind="gap")
    write_run(work / "alone", DRIVING_HEADER, [driving_line("k", "RightTurn", "c")])
    done = ssad("plan", *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1
    for part in parts:
        assert part in done.stderr


def test_rates_are_metrics_of_records() -> None:
    rates = {name: kind_of(name).rates for name in KINDS}
    assert {name for name, own in rates.items() if own} == {"driving", "adversarial", "gap"}
    assert {name: next(iter(own)) for name, own in rates.items() if own} == {
        "driving": "CR",
        "adversarial": "proven",
        "gap": "CR",
    }
    metrics = driving_line("k", "RightTurn", "c")["metrics"]
    assert set(rates["driving"].values()) <= set(metrics)
    for name in ("adversarial", "gap"):
        assert set(rates[name].values()) <= {column.name for column in kind_of(name).columns}


def test_the_reference_is_what_its_benchmark_measures(work: Path) -> None:
    lines = []
    for system in ("ppo", "sac"):
        for route in range(4):
            one = driving_line(f"{system}{route}", "RightTurn", f"c{route}", system=system, collision=system == "ppo")
            one["spec"]["scenario"]["name"] = f"RightTurn/0{route}"
            lines.append(one)
    suite = {"name": "s", "kind": "driving", "scenarios": ["RightTurn", "LaneChanging"]}
    folder = write_run(work / "run", DRIVING_HEADER | {"suite": suite}, lines)
    parts = measurements(load_run(folder))
    both, right_turn = next(parts), next(parts)
    assert both["scenarios"] == ["RightTurn", "LaneChanging"]
    assert (right_turn["scenarios"], right_turn["systems"], right_turn["cases"]) == (["RightTurn"], ["ppo", "sac"], 4)
    (pair,) = map(pair_from, right_turn["pairs"])
    assert (pair.rate, pair.first, pair.flips.flips) == ("CR", "ppo", 4)

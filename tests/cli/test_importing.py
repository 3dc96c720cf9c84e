"""CARLA's maps and SafeBench's and FREA's routes, through the command line, to the numbers they must give."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.command import ssad

from ssad.scenarios.dynamic import load_scenarios

NATURAL = ("Town02", "Town05")

pytestmark = pytest.mark.data


@pytest.fixture(autouse=True)
def home(carla_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was imported is what is known."""
    monkeypatch.setenv("SSAD_HOME", str(carla_home))


def test_imports_are_listed() -> None:
    towns = ssad("list", "towns").stdout
    assert all(town in towns for town in ("Town_Safebench_Light", *NATURAL))
    listed = ssad("list", "scenarios").stdout
    assert "frea" in listed
    assert "safebench" in listed


def test_the_maps_that_a_set_still_needs_are_named(
    data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSAD_HOME", str(tmp_path))
    done = ssad("import", "routes", data_dir / "routes" / "frea")
    assert "before they can run, import the maps of Town02, Town05: ssad import map FILE" in done.stdout
    assert "FREA: 150 of 150 entries of" in done.stdout
    assert "doubtful" not in done.stdout


@pytest.mark.parametrize("every", [100, pytest.param(1, marks=pytest.mark.slow)])
def test_safebench_and_natural_traffic(every: int, tmp_path: Path) -> None:
    """Each of SafeBench's eight hits the blind follower and is avoidable; the Autopilot copes with the traffic, in
    every 100th of FREA's scenarios and a quarter of SafeBench's routes, or in all."""
    some = [scenario.name for scenario in load_scenarios("frea")[::every]]
    routes = [scenario.name for scenario in load_scenarios("safebench")[:: 4 if every > 1 else 1]]
    words = [
        "--set",
        f"scenarios=[{','.join([*routes, *some])}]",
        "--set",
        "systems=[autopilot,blind]",
        "--out",
        tmp_path,
    ]
    done = ssad("run", "precrash", *words, "--workers", "1" if every > 1 else "2")
    assert done.returncode == 0, done.stderr
    records = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    assert len(records) == 2 * (len(routes) + len(some))
    assert {r["status"] for r in records} == {"ok"}

    natural = [r for r in records if r["group"] in NATURAL and r["system"] == "autopilot"]
    assert len(natural) == len(some)
    assert sum(r["metrics"]["collision"] for r in natural) / len(some) <= 0.02
    assert sum(r["metrics"]["route_completion"] for r in natural) / len(some) >= 0.95

    blind = [r for r in records if r["group"] not in NATURAL and r["system"] == "blind"]
    assert len(blind) == len(routes)
    hit = {
        group: sum(r["metrics"]["collision"] for r in blind if r["group"] == group)
        for group in {r["group"] for r in blind}
    }
    assert len(hit) == 8
    assert min(hit.values()) >= len(routes) / 16
    for record in blind:
        if record["metrics"]["collision"]:
            assert record["witness"]["verdict"] in ("avoidable", "limit", "unavoidable")
            assert record["metrics"]["avoided_by_cc"] == record["witness"]["avoids"]["cc"]
    avoidable = [r for r in blind if r.get("witness", {}).get("verdict") == "avoidable"]
    assert len(avoidable) >= 0.4 * len(routes)

"""CARLA's maps and SafeBench's and FREA's routes, through the command line, to the numbers they must give."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

TOWNS = ("Town_Safebench_Light", "Town02", "Town05")

pytestmark = pytest.mark.data


def ssad(*arguments: str, home: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "ssad.cli", *arguments]
    environment = {"SSAD_HOME": str(home), "PATH": "/usr/bin:/bin", "HOME": str(home)}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=300)


@pytest.fixture(scope="module")
def home(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("carla", reason="reading OpenDRIVE needs the extra carla")
    folder = tmp_path_factory.mktemp("home")
    for town in TOWNS:
        done = ssad("import", "map", str(data_dir / "maps" / f"{town}.xodr"), home=folder)
        assert done.returncode == 0, done.stderr
        assert f"town {town}: " in done.stdout
    for name, count in (("safebench", 32), ("frea", 150)):
        done = ssad("import", "routes", str(data_dir / "routes" / name), home=folder)
        assert done.returncode == 0, done.stderr
        assert f"set {name}: {count} scenarios" in done.stdout
    return folder


def test_imports_are_listed(home: Path) -> None:
    towns = ssad("list", "towns", home=home).stdout
    assert all(town in towns for town in TOWNS)
    assert "frea" in ssad("list", "scenarios", home=home).stdout


def test_safebench_and_natural_traffic(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of SafeBench's eight hits the blind follower and is avoidable; the Autopilot copes with the traffic."""
    from ssad.bench.run import plan, run
    from ssad.bench.suite import load_suite

    monkeypatch.setenv("SSAD_HOME", str(home))
    suite = load_suite("precrash", ["scenarios=[safebench,frea]", "systems=[autopilot,blind]"])
    records = run(plan(suite), tmp_path, workers=2, console=Console(file=io.StringIO()))
    assert len(records) == 2 * 182
    assert {r["status"] for r in records} == {"ok"}

    natural = [r for r in records if r["group"] in ("Town02", "Town05") and r["system"] == "autopilot"]
    assert len(natural) == 150
    assert sum(r["metrics"]["collision"] for r in natural) / 150 <= 0.02
    assert sum(r["metrics"]["route_completion"] for r in natural) / 150 >= 0.95

    blind = [r for r in records if r["group"] not in ("Town02", "Town05") and r["system"] == "blind"]
    assert len(blind) == 32
    hit = {
        group: sum(r["metrics"]["collision"] for r in blind if r["group"] == group)
        for group in {r["group"] for r in blind}
    }
    assert len(hit) == 8
    assert min(hit.values()) >= 2
    for record in blind:
        if record["metrics"]["collision"]:
            assert record["witness"]["verdict"] in ("avoidable", "anticipation", "autopilot", "unavoidable")
    avoidable = [r for r in blind if r.get("witness", {}).get("verdict") == "avoidable"]
    assert len(avoidable) >= 24

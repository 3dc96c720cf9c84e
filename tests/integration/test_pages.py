"""Pages of numbers are what the measurements in benchmarks/results say, and tell when these are out of date."""

from __future__ import annotations

import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from ssad.core.checkpoints import state_hash
from ssad.experiments.perception.scene_boxes import detector_of
from ssad.recorders.nuscenes import WEATHERS, draw_weather, weather_words
from ssad.recorders.viewpoints import weather_name
from ssad.scenarios.static.shifts import VERSIONS

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("script", "name"),
    [
        ("page", "speed"),
        ("shift_page", "shifts"),
        ("digital_page", "digital"),
        ("detector_accuracy", "accuracy"),
        ("how_often_page", "how-often"),
    ],
)
def test_a_page_is_made_from_the_measurements(script: str, name: str) -> None:
    page = runpy.run_path(str(ROOT / "benchmarks" / f"{script}.py"))["page"]()
    assert page == (ROOT / "docs" / "results" / f"{name}.md").read_text(), f"run python -m benchmarks.{script}"


def test_the_pages_of_physical_attacks_are_made_from_the_measurements() -> None:
    pages = runpy.run_path(str(ROOT / "benchmarks" / "physical_page.py"))["pages"]()
    assert {"physical", "physical-3d", "physical-limits"} <= set(pages)
    for name, page in pages.items():
        assert page == (ROOT / "docs" / "results" / f"{name}.md").read_text(), "run python -m benchmarks.physical_page"


@pytest.mark.parametrize("kind", WEATHERS)
def test_the_light_of_a_recorded_drive_is_read_from_its_words(kind: str) -> None:
    read = runpy.run_path(str(ROOT / "benchmarks" / "detector_accuracy.py"))["weather_of"]
    for k in range(20):
        weather = draw_weather(("drive", k), kind)
        assert read(f"Town, {weather_words(weather)}") == weather_name(weather)


@pytest.mark.parametrize("run", ["shifts", "shifts-paper"])
def test_a_page_says_which_results_are_older_than_weights_and_shifts(run: str) -> None:
    told = json.loads((ROOT / "benchmarks" / "results" / run / "run.json").read_text())
    current = told["versions"]["shifts"] == str(VERSIONS[told["suite"]["calibration"]])
    current &= told["weights"] == {
        name: state_hash(detector_of(name, "", "cpu")) for name in ("fcos3d-light", "pgd-det-light")
    }
    warnings = [
        line for line in (ROOT / "docs" / "results" / "shifts.md").read_text().splitlines() if line.startswith("> **")
    ]
    assert any(f"`{run}` with" in line for line in warnings) is not current


def test_the_page_of_attacks_says_whether_weights_have_changed() -> None:
    told = json.loads((ROOT / "benchmarks" / "results" / "digital" / "run.json").read_text())
    current = told["weights"] == {name: state_hash(detector_of(name, "", "cpu")) for name in told["weights"]}
    assert ("**Measured with earlier weights" in (ROOT / "docs" / "results" / "digital.md").read_text()) is not current


def test_every_page_has_a_place_on_the_site_and_its_links_lead_somewhere(tmp_path: Path) -> None:
    site = runpy.run_path(str(ROOT / "benchmarks" / "site.py"))
    pages = site["write_pages"](tmp_path / "pages")
    parts = site["navigation"](pages)
    assert list(parts) == ["Home", "Tutorials", "How-to guides", "Reference", "Explanation", "Results"]
    assert sorted(page for part in parts.values() for page in part) == sorted(pages)
    for page in pages:
        path = tmp_path / "pages" / f"{page}.md"
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", path.read_text()):
            assert target.startswith("http") or (path.parent / target).exists(), f"{page}: {target}"
    api = (tmp_path / "pages" / "reference" / "api.md").read_text()
    assert "::: ssad.results.run" in api
    assert "::: ssad.core.protocols.Detector" in api


@pytest.mark.slow
def test_the_site_is_built_without_a_network(tmp_path: Path) -> None:
    for tool in ("mkdocs", "mkdocstrings", "material"):
        pytest.importorskip(tool, reason="needs the group site")
    words = [sys.executable, str(ROOT / "benchmarks" / "site.py"), str(tmp_path / "site")]
    blocked = os.environ | {"http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=blocked)
    assert done.returncode == 0, done.stderr
    assert "Results" in (tmp_path / "site" / "reference" / "api.html").read_text()
    assert "https://fonts" not in (tmp_path / "site" / "index.html").read_text()

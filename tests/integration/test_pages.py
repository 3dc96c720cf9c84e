"""Stored results say where they come from; pages that scripts make are what benchmarks/results says."""

from __future__ import annotations

import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import avoidable
from ssad.recorders.nuscenes import WEATHERS, describe_weather, draw_weather
from ssad.recorders.viewpoints import weather_name

ROOT = Path(__file__).parents[2]


RESULTS = sorted(path.stem for path in (ROOT / "docs" / "results").glob("*.md") if path.stem != "index")
COMMIT = re.compile(r"\b[0-9a-f]{7}\b[^.]* \(2\d{3}-\d{2}-\d{2}\)|\bnot recorded\b")
HEADER = re.compile(
    r"> \*\*Stored result\.\*\* Commit: (?P<commit>.+?)\. Weights: (?P<weights>.+?)\. Torch: (?P<torch>.+?)\. "
    r"Make it anew: (?P<command>.+)\."
)


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_begins_with_commit_weights_versions_and_command(name: str) -> None:
    title, blank, line, *_ = (ROOT / "docs" / "results" / f"{name}.md").read_text().splitlines()
    assert title.startswith("# ")
    assert blank == ""
    header = HEADER.fullmatch(line)
    assert header, line
    assert COMMIT.search(header["commit"])
    assert re.search(r"\d+\.\d+\.\d+|not recorded|not used|on the pages", header["torch"])
    for suite in re.findall(r"ssad run (\S+)", header["command"]):
        assert (ROOT / suite).is_file() or (ROOT / "suites" / f"{suite}.yaml").is_file(), suite
    assert "ssad run" not in header["command"] or "`ssad report DIR --markdown`" in header["command"]


@pytest.mark.parametrize(
    ("script", "name"), [("page", "speed"), ("detector_accuracy", "accuracy"), ("frames", "pictures")]
)
def test_a_page_is_made_from_the_measurements(script: str, name: str) -> None:
    page = runpy.run_path(str(ROOT / "benchmarks" / f"{script}.py"))["page"]()
    assert page == (ROOT / "docs" / "results" / f"{name}.md").read_text(), f"run python -m benchmarks.{script}"


def test_the_table_of_trainings_is_what_its_command_makes() -> None:
    shown = avoidable.DOCUMENT.read_text(encoding="utf-8").partition(avoidable.BEGIN)[2].partition(avoidable.END)[0]
    assert shown.strip() == "\n".join(avoidable.table(json.loads(avoidable.RESULTS.read_text()))).strip()


def test_every_draw_of_a_route_counts_in_the_table_of_trainings() -> None:
    hits = {f"natural/Here_{k // 2}/{k % 2:02d}": float(k < 6) for k in range(12)}
    assert avoidable.share(hits).startswith("0.50 ["), "and not the first of each route alone"
    odd = {f"natural/Here_{k // 2}/{k % 2:02d}": float(k % 2) for k in range(12)}
    assert avoidable.share(odd).startswith("0.50 "), "0.00 if later draws were taken for copies"


@pytest.mark.parametrize("kind", WEATHERS)
def test_the_light_of_a_recorded_drive_is_read_from_its_words(kind: str) -> None:
    read = runpy.run_path(str(ROOT / "benchmarks" / "detector_accuracy.py"))["weather_of"]
    for k in range(20):
        weather = draw_weather(("drive", k), kind)
        assert read(f"Town, {describe_weather(weather)}") == weather_name(weather)


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

"""Suites of kind `tour`: parts run in folders of their own, one that fails fails alone, the front page leads to all."""

from __future__ import annotations

import io
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.engine.kind import Resources
from ssad.engine.run import run
from ssad.experiments.runs import kind_of_run, write_report
from ssad.experiments.suites import load_suite
from ssad.experiments.tour.kind import Tour, TourSuite
from ssad.report import check_artefacts
from ssad.report.load import load_run
from ssad.report.verdict import complete_verdict

SHORT = """
name: short
type: StraightObstacle
town: ProvingGround
route: [{x: 217.0, y: -5.25}, {x: 317.0, y: -5.25}]
limits: {max_steps: 8}
"""


def tour_of(folder: Path, **changes: Any) -> TourSuite:
    """Two driving suites and a gap suite without pictures."""
    (folder / "short.yaml").write_text(SHORT)
    driving = f"name: one\nkind: driving\nsystems: [autopilot]\nscenarios: [{folder / 'short.yaml'}]\n"
    (folder / "driving.yaml").write_text(driving)
    gap = "systems: [{name: perfect, detector: truth}]\nceilings: []\n"
    (folder / "gap.yaml").write_text(f"name: two\nkind: gap\n{gap}scenarios: [{folder / 'short.yaml'}]\n")
    parts = [
        {"name": "first", "suite": str(folder / "driving.yaml"), "question": "Does it drive?"},
        {"name": "second", "suite": str(folder / "driving.yaml"), "settings": ["seed=4"]},
        {"name": "third", "suite": str(folder / "gap.yaml"), "limits": "Cameras <b>."},
    ]
    return TourSuite.model_validate({"name": "t", "parts": parts, "limits": ["All of it."]} | changes)


def go(suite: TourSuite, folder: Path, *, retry: bool = False) -> list[dict[str, Any]]:
    plan = Tour().plan(suite)
    return run(plan, folder, Resources(0, console=Console(file=io.StringIO())), retry=retry)


def test_every_part_is_a_run_of_its_own_and_the_front_page_leads_there(tmp_path: Path) -> None:
    out = tmp_path / "out"
    records = go(tour_of(tmp_path), out)
    assert [(one["part"], one["status"], one["metrics"]["cells"]) for one in records] == [
        ("first", "ok", 1.0),
        ("second", "ok", 1.0),
        ("third", "ok", 1.0),
    ]
    write_report(out)
    assert check_artefacts(out) == []
    page = (out / "report.html").read_text()
    links = set(re.findall(r'href="([^#"]+)"', page))
    assert {"first/report.html", "second/report.html", "third/report.html", "tables/third.csv"} <= links
    assert [link for link in links if not (out / link).is_file()] == []
    assert "Does it drive?" in page
    assert "Cameras &lt;b&gt;." in page
    assert "All of it." in page
    for name in ("first", "second", "third"):
        assert all(sentence.replace("'", "&#39;") in page for sentence in verdict(load_run(out / name)))
    assert verdict(load_run(out / "first"))[0].startswith("autopilot collided in 0 of 1 drives")
    assert load_run(out / "second").suite["seed"] == 4
    altered = tmp_path / "altered"
    shutil.copytree(out, altered)
    results = altered / "second" / "results.jsonl"
    results.write_text(results.read_text().replace('"status":"ok"', '"status":"failed"'))
    assert "second/results.jsonl:1: this line was changed" in write_report(altered).read_text()


def test_a_part_that_fails_fails_alone_and_can_be_run_again_and_what_is_done_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ssad.experiments.gap.kind import Gap

    suite, out, prepare = tour_of(tmp_path), tmp_path / "out", Gap.prepare

    def broken(*args: Any, **options: Any) -> Any:
        raise ConfigError("no data today")

    monkeypatch.setattr(Gap, "prepare", broken)
    records = go(suite, out)
    assert [one["status"] for one in records] == ["ok", "ok", "failed"]
    assert "no data today" in records[2]["reason"]
    write_report(out)
    assert "no data today" in (out / "report.html").read_text()
    monkeypatch.setattr(Gap, "prepare", prepare)
    before = (out / "first" / "results.jsonl").read_text()  # its lines say how long they took
    assert [one["status"] for one in go(suite, out, retry=True)] == ["ok"] * 3
    assert (out / "first" / "results.jsonl").read_text() == before


def test_what_is_wrong_is_one_line(tmp_path: Path) -> None:
    suite = tour_of(tmp_path)
    with pytest.raises(ConfigError, match="twice"):
        Tour().plan(suite.model_copy(update={"parts": [suite.parts[0], suite.parts[0]]}))
    (tmp_path / "tour.yaml").write_text(safeio.dump_yaml(suite.model_dump(mode="json")))
    inner = suite.parts[0].model_copy(update={"suite": str(tmp_path / "tour.yaml")})
    with pytest.raises(ConfigError, match="is a tour"):
        Tour().plan(suite.model_copy(update={"parts": [inner]}))


@pytest.mark.slow
def test_the_shipped_tour_can_be_planned() -> None:
    plan = Tour().plan(load_suite("tour"), check=False)
    assert {part.kind.name for part in plan.details.values()} == {
        "driving",
        "detection",
        "digital",
        "physical",
        "adversarial",
        "gap",
    }


def verdict(run):
    return complete_verdict(run, kind_of_run(run).verdict(run))

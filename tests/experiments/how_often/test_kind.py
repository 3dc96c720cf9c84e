"""The kind how-often: three estimators that agree, and a collision that drives again to the bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from helpers.command import ssad

from ssad.core.errors import ConfigError
from ssad.core.jsonl import read_lines
from ssad.drivers import make_system
from ssad.engine.kind import Job, Resources
from ssad.experiments.how_often.failure_rate import ChanceEpisode
from ssad.experiments.how_often.kind import HowOften, HowOftenSuite
from ssad.experiments.suites import load_suite
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.world.roads import load_town

SMALL = ["episodes=1200", "particles=60", "repeats=8", "batch=200", "noise.lapse=0.3"]


@pytest.mark.slow
def test_three_methods_agree_and_what_they_find_is_replayed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    settings = [word for text in SMALL for word in ("--set", text)]
    assert ssad("run", "how-often", "--out", str(out), "--workers", "1", *settings).returncode == 0
    lines = {line["method"]: line for line in read_lines(out / "results.jsonl")}
    assert set(lines) == {"monte-carlo", "splitting", "importance"}
    for method, line in lines.items():
        assert line["status"] == "ok", line
        found = line["metrics"]
        assert found["low"] <= found["per_million"] <= found["high"], method
        assert found["per_hour"] == pytest.approx(1e-3 * found["per_million"] / (8.0 / 3600.0), rel=0.05)
        assert found["per_hour"] > found["per_km"] > 0.0
    plain, learned = lines["monte-carlo"]["metrics"], lines["importance"]["metrics"]
    assert max(plain["low"], learned["low"]) < min(plain["high"], learned["high"])
    assert learned["training"] > 0.0
    assert learned["effective"] > plain["effective"]
    for method in ("splitting", "importance"):
        again = ssad("replay", str(out), f"{method}/autopilot/lane-traffic/05")
        assert again.returncode == 0, again.stdout + again.stderr


def test_a_collision_that_is_kept_is_driven_again_to_the_bit(tmp_path: Path) -> None:
    suite = load_suite("how-often", [*SMALL, "methods=[importance]", "episodes=200", "noise.lapse=0.4"])
    kind = HowOften()
    plan = kind.plan(suite, check=False)
    folder = tmp_path / "out"
    kind.prepare(plan, folder, Resources())
    (cell,) = plan.cells
    (record,) = kind.execute([cell], Job(folder, "cpu", {})).values()
    assert record["metrics"]["effective"] > 1.0
    again = kind.replay(plan, cell, record, folder)
    assert again.difference is None
    assert again.trace.end == "collision"


def test_a_town_may_be_named_by_the_path_of_its_map() -> None:
    (scenario,) = load_scenarios("lane-traffic/05")
    graph = load_town(scenario.town)
    episode = build_episode(replace(scenario, town="maps/own.xodr"), graph, seed=0)
    assert ChanceEpisode(episode, graph, make_system("autopilot"), {}, "cpu", 0).world(2).batch == 2


def test_bad_suites_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="lapse"):
        load_suite("how-often", ["noise.lapse=0.9"])
    with pytest.raises(ConfigError, match="methods"):
        load_suite("how-often", ["methods=[guessing]"])
    assert isinstance(load_suite("how-often"), HowOftenSuite)

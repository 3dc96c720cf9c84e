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
from ssad.experiments.how_often.failure_rate import METHODS, ChanceEpisode
from ssad.experiments.how_often.kind import HowOften, HowOftenSuite
from ssad.experiments.runs import replay
from ssad.experiments.suites import load_suite
from ssad.report.load import load_run
from ssad.results import run
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


HIDDEN, SAVED, CLOCK = (f"helpers.memory_drivers:{name}" for name in ("Hidden", "Saved", "Clock"))
FEW = ["noise.accel=2", "episodes=200", "batch=200", "particles=30", "repeats=2", "components=1"]


def test_a_hidden_memory_is_counted_and_its_accelerated_cells_fail_in_a_line(tmp_path: Path) -> None:
    """It drives like one that reads the clock and remembers nothing, whose cells have the same random numbers."""
    settings = [*FEW, f"systems=[{HIDDEN},{CLOCK}]", "methods=[monte-carlo,splitting,importance]"]
    names = [*(f"{method}/{HIDDEN}" for method in METHODS), f"monte-carlo/{CLOCK}"]
    cells = {"name": [f"{name}/lane-traffic/05" for name in names]}
    results = run("how-often", set=settings, out=tmp_path, workers=0, quiet=True, only=cells)
    rows = {(row["system"].partition(":")[2], row["method"]): row for row in results.rows}
    counted, truth = rows["Hidden", "monte-carlo"], rows["Clock", "monte-carlo"]
    assert counted["metrics"]["events"] > 2
    assert counted["metrics"] == truth["metrics"]
    assert replay(tmp_path, counted["key"]).difference is None
    for method in ("splitting", "importance"):
        assert rows["Hidden", method]["status"] == "failed"
        assert rows["Hidden", method]["reason"] == (
            f"{HIDDEN} has no methods snapshot() and restore(states), so splitting and importance sampling cannot "
            "branch its episodes; set methods=[monte-carlo], or see ssad.core.driving.Branching"
        )


def test_methods_are_chosen_by_what_a_driver_can(tmp_path: Path) -> None:
    plan = HowOften().plan(load_suite("how-often", [*FEW, f"systems=[autopilot,{SAVED},{HIDDEN},line-of-sight]"]))
    methods = {
        system: [cell.fields["method"] for cell in plan.cells if cell.system == system] for system in plan.suite.systems
    }
    every = ["monte-carlo", "splitting", "importance"]
    alone = ["monte-carlo"]
    assert methods == {"autopilot": every, SAVED: every, HIDDEN: alone, "line-of-sight": alone}
    results = run("how-often", set=[*FEW, f"systems=[{HIDDEN}]"], out=tmp_path, workers=0, quiet=True)
    (row,) = results.rows
    assert row["obstacle"] == f"{HIDDEN} has no methods snapshot() and restore(states)"
    gain = "with these two methods (ssad.core.driving.Branching), splitting and importance sampling would measure"
    assert gain in " ".join(str(HowOften().summary(load_run(tmp_path)).note).split())
    assert gain in (tmp_path / "report.html").read_text()


def test_a_suite_of_which_no_cell_can_run_is_refused_before_it_runs() -> None:
    suite = load_suite("how-often", [*FEW, f"systems=[{HIDDEN}]", "methods=[splitting]"])
    with pytest.raises(ConfigError, match=r"Hidden has no methods snapshot.*set methods=") as refused:
        HowOften().plan(suite)
    assert "\n" not in str(refused.value)


def test_agents_of_the_leaderboard_and_perceiving_drivers_are_counted(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    agent = tmp_path / "agent.py"
    agent.write_text(AGENT)
    settings = ["episodes=10", "batch=10", "noise.accel=2", f"systems=[leaderboard:{agent},perceiving-perfect]"]
    results = run("how-often", set=settings, out=tmp_path / "out", workers=0, quiet=True)
    assert [(row["method"], row["status"], row["n"]) for row in results.rows] == [("monte-carlo", "ok", 10)] * 2


AGENT = """
from leaderboard.autoagents.autonomous_agent import AutonomousAgent
import carla


def get_entry_point():
    return "Coasting"


class Coasting(AutonomousAgent):
    def setup(self, path_to_conf_file):
        self.steps = 0

    def sensors(self):
        return [{"type": "sensor.speedometer", "id": "speed"}]

    def run_step(self, input_data, timestamp):
        self.steps += 1
        return carla.VehicleControl(throttle=0.2 if self.steps % 2 else 0.0)
"""


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

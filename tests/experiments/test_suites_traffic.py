"""The key `traffic` of suites: drivers, errors, walkers and cyclists of scenarios that have background traffic."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from ssad.core.errors import ConfigError
from ssad.core.types import TrafficPlan
from ssad.engine.kind import Plan
from ssad.experiments.driving.kind import Driving
from ssad.experiments.suites import load_suite
from ssad.scenarios.dynamic import load_scenarios
from ssad.scenarios.dynamic.schema import check
from ssad.simulators.closed_loop import build_requested_episode

SCENARIO = """\
name: mine/junction
type: NaturalJunction
town: Twinford
route:
- {x: 78.25, y: -1.88}
- {x: 106.25, y: -1.88}
- {x: 121.88, y: 13.75, yaw: 1.5708}
- {x: 121.88, y: 41.75, yaw: 1.5708}
"""
SUITE = """\
kind: driving
name: mine
systems: [autopilot]
scenarios: [junction.yaml]
"""


@pytest.fixture
def suite_file(tmp_path: Path) -> Path:
    (tmp_path / "junction.yaml").write_text(SCENARIO)
    (tmp_path / "mine.yaml").write_text(SUITE)
    return tmp_path / "mine.yaml"


def plan(suite_file: Path, *settings: str) -> Plan:
    return Driving().plan(load_suite(str(suite_file), settings), check=False)


def test_errors_are_set_on_the_command_line_and_reach_every_driver(suite_file: Path) -> None:
    (usual,) = plan(suite_file).cells
    (erring,) = plan(suite_file, "traffic={drivers: population, errors: 2}").cells
    before, after = build_requested_episode(usual), build_requested_episode(erring)
    drivers = [agent.driver for agent in after.agents[1:]]
    assert drivers
    assert all(driver is not None and driver.errors == 2.0 for driver in drivers)
    assert [agent.pose for agent in after.agents] == [agent.pose for agent in before.agents]
    assert erring.seed == usual.seed
    assert erring.key != usual.key


def test_a_suite_file_sets_them_and_a_wrong_value_is_named_with_its_line(suite_file: Path) -> None:
    suite_file.write_text(f"{SUITE}traffic: {{drivers: population, errors: 2}}\n")
    (cell,) = plan(suite_file).cells
    assert cell.spec["scenario"]["traffic"].items() >= {"drivers": "population", "errors": 2.0}.items()
    suite_file.write_text(f"{SUITE}traffic: {{errors: 2}}\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml:5: traffic: .*add drivers: population"):
        plan(suite_file)
    suite_file.write_text(f"{SUITE}traffic: {{errors: 1801}}\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml:5: traffic\.errors: .*1800"):
        plan(suite_file)


def test_walkers_and_cyclists_are_added(suite_file: Path) -> None:
    (cell,) = plan(suite_file, "traffic.walkers=3", "traffic.cyclists=1").cells
    assert cell.spec["scenario"]["traffic"].items() >= {"walkers": 3, "cyclists": 1}.items()


def test_scenarios_without_traffic_stay_as_they_are(suite_file: Path) -> None:
    cells = plan(suite_file, "traffic.walkers=3", "scenarios=[RightTurn/00, junction.yaml]").cells
    (alone,) = plan(suite_file, "scenarios=[RightTurn/00]").cells
    assert [cell.key == alone.key for cell in cells] == [True, False]
    with pytest.raises(ConfigError, match="none of the scenarios has background traffic"):
        plan(suite_file, "traffic.walkers=3", "scenarios=[RightTurn/00]")


@pytest.mark.parametrize(
    ("traffic_plan", "problem"),
    [
        (TrafficPlan(errors=1.0), "only drivers of the population make errors"),
        (TrafficPlan(drivers="population", errors=-1.0), "-1 is outside 0 to 1800 an hour"),
    ],
)
def test_errors_that_nobody_makes_are_refused(suite_file: Path, traffic_plan: TrafficPlan, problem: str) -> None:
    (scenario,) = load_scenarios(str(suite_file.parent / "junction.yaml"))
    check(replace(scenario, traffic=TrafficPlan(drivers="population", errors=1800.0)))
    with pytest.raises(ConfigError, match=problem):
        check(replace(scenario, traffic=traffic_plan))

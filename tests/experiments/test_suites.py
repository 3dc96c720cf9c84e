"""Suites: strict YAML, --set, cells and their keys."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ssad.core.errors import ConfigError, SSADError, UnknownNameError
from ssad.core.types import Pose, Scenario
from ssad.engine.command import command_of
from ssad.engine.kind import Plan, find_cell
from ssad.experiments import scenario_kind
from ssad.experiments.driving import kind as driving
from ssad.experiments.driving.kind import Driving, DrivingSuite
from ssad.experiments.suites import load_suite, suite_files

GOOD = "name: mine\nsystems: [blind]\nscenarios: [precrash]\n"


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str], str]:
    def inner(text: str) -> str:
        path = tmp_path / "mine.yaml"
        path.write_text(text)
        return str(path)

    return inner


def test_shipped_suites_are_valid() -> None:
    assert {"quick", "precrash"} <= set(suite_files())
    for name in suite_files():
        suite = load_suite(name)
        assert suite.name == name
        assert suite.title
        if isinstance(suite, DrivingSuite):
            assert {"autopilot", "blind"} <= set(suite.systems)


def test_set(write: Callable[[str], str]) -> None:
    path = write(GOOD)
    suite = load_suite(path, ["scenarios=[safebench,frea]", "repetitions=3", "systems=my.mod:Sys", "timeout_s=5"])
    assert isinstance(suite, DrivingSuite)
    assert suite.scenarios == ["safebench", "frea"]
    assert (suite.repetitions, suite.systems, suite.timeout_s) == (3, ["my.mod:Sys"], 5.0)


@pytest.mark.parametrize(
    ("text", "settings", "message"),
    [
        (GOOD + "sytems: [x]\n", [], "mine.yaml:4: sytems: unknown key 'sytems'; closest: systems"),
        ("name: mine\nsystems: [blind]\n", [], "the key 'scenarios' is missing"),
        (GOOD + "repetitions: 0\n", [], "mine.yaml:4: repetitions: Input should be greater than or equal to 1"),
        (GOOD + "repetitions: '2'\n", [], "mine.yaml:4: repetitions"),
        (GOOD + "timeout_s: -1\n", [], "mine.yaml:4: timeout_s"),
        (GOOD + "timeout_s: .inf\n", [], "mine.yaml:4: timeout_s"),
        ("name: mine\nsystems: []\nscenarios: [a]\n", [], "mine.yaml:2: systems"),
        ("name: mine\nsystems:\n  - blind\n  - 3\nscenarios: [a]\n", [], "mine.yaml:4: systems[1]"),
        ("- a\n", [], "a suite is a mapping"),
        ("", [], "a suite is a mapping"),
        (GOOD + "name: x\n", [], "appears twice"),
        (GOOD, ["repetition=3"], "--set repetition=3: unknown key 'repetition'; closest: repetitions"),
        (GOOD, ["repetitions=x"], "--set repetitions=x: repetitions"),
        (GOOD, ["repetitions"], "expected key=value"),
        (GOOD + "repetitions: 2\n", ["repetitions.a=1"], "'repetitions' has no keys"),
        (GOOD, ["systems=[a"], "--set systems"),
    ],
)
def test_bad_suites_are_one_line(write: Callable[[str], str], text: str, settings: list[str], message: str) -> None:
    with pytest.raises(SSADError) as caught:
        load_suite(write(text), settings)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_suite() -> None:
    with pytest.raises(UnknownNameError, match="closest: quick"):
        load_suite("quik")


def plan_of(scenarios: list[Scenario], monkeypatch: pytest.MonkeyPatch, **changes: Any) -> Plan:
    """A plan without a world behind it."""
    monkeypatch.setattr(scenario_kind, "suite_scenarios", lambda suite: tuple(scenarios))
    monkeypatch.setattr(scenario_kind, "cached_town", lambda name: None)
    monkeypatch.setattr(scenario_kind, "town_version", lambda graph: "0")
    values = {"name": "s", "systems": ["autopilot", "blind"], "scenarios": ["x"], "repetitions": 2}
    return Driving().plan(DrivingSuite(**(values | changes)), check=False)


def scenario(name: str, **changes: Any) -> Scenario:
    return Scenario(
        **{"name": name, "type": "StraightObstacle", "town": "Nowhere", "route": (Pose(0, 0), Pose(9, 0)), **changes}
    )


def keys(plan: Plan) -> dict[str, str]:
    return {cell.name: cell.key for cell in plan.cells}


def test_cell_keys_depend_on_what_matters_only(monkeypatch: pytest.MonkeyPatch) -> None:
    three = [scenario(name) for name in "abc"]
    found = keys(plan_of(three, monkeypatch))
    assert len(set(found.values())) == 12
    turned = plan_of(three[::-1], monkeypatch, systems=["blind", "autopilot"], chunk=9, timeout_s=1.0)
    assert keys(turned) == found
    assert not set(found.values()) & set(keys(plan_of(three, monkeypatch, seed=1)).values())


def test_only_repetitions_depend_on_the_spread(monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = (keys(plan_of([scenario("a")], monkeypatch, spread=spread)) for spread in (1.0, 0.5))
    assert one["blind/a"] == two["blind/a"], "the nominal case"
    assert one["blind/a#1"] != two["blind/a#1"]


def test_systems_meet_the_same_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    cells = plan_of([scenario("a")], monkeypatch, repetitions=3).cells
    seeds = {(c.system, c.spec["repetition"]): c.seed for c in cells}
    assert all(seeds["autopilot", r] == seeds["blind", r] for r in range(3))
    assert len(set(seeds.values())) == 3


@pytest.mark.parametrize("change", [{"target_speed": 9.0}, {"seed": 1}, {"parameters": {"speed": 2.0}}])
def test_a_changed_scenario_is_another_cell(change: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = (plan_of([s], monkeypatch).cells[0].key for s in (scenario("a"), scenario("a", **change)))
    assert one != two


def test_a_changed_system_or_town_is_another_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    found = set()
    for version in "12":
        for town in "12":
            monkeypatch.setattr(driving, "system_version", lambda name, v=version: v)
            plan = plan_of([scenario("a")], monkeypatch)
            monkeypatch.setattr(scenario_kind, "town_version", lambda graph, v=town: v)
            found.add(Driving().plan(plan.suite, check=False).cells[0].key)
    assert len(found) == 4


def test_find_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    cells = plan_of([scenario("a"), scenario("b")], monkeypatch).cells
    assert find_cell(cells, "blind/a#1").spec["repetition"] == 1
    assert find_cell(cells, cells[0].key[:8]) == cells[0]
    with pytest.raises(ConfigError, match="closest: blind/"):
        find_cell(cells, "blind/x")
    with pytest.raises(ConfigError, match="no cell ''"):
        find_cell(cells, "")


def test_a_command_spells_out_what_differs(write: Callable[[str], str]) -> None:
    assert command_of(load_suite("quick", ["name=lab"])) == "ssad run quick --set name=lab"
    assert command_of(load_suite("quick")) == "ssad run quick"
    assert command_of(load_suite("quick"), "cuda") == "ssad run quick --device cuda"
    assert command_of(load_suite("quick", ["repetitions=3", "systems=blind"])) == (
        "ssad run quick --set 'systems=[blind]' --set repetitions=3"
    )

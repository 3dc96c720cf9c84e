"""Suites: strict YAML, --set, cells and their keys."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.suites import fake_plan, fake_scenario

from ssad.bench.cells import find_cell, make_cells
from ssad.bench.suite import Suite, load_suite, suite_files
from ssad.core.errors import ConfigError, SSADError, UnknownNameError

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
        if isinstance(suite, Suite):
            assert {"autopilot", "blind"} <= set(suite.systems)


def test_set(write: Callable[[str], str]) -> None:
    path = write(GOOD)
    suite = load_suite(path, ["scenarios=[safebench,frea]", "repetitions=3", "systems=my.mod:Sys", "timeout_s=5"])
    assert isinstance(suite, Suite)
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


def test_cell_keys_depend_on_what_matters_only() -> None:
    names = ["a", "b", "c"]
    keys = {c.name: c.key for c in fake_plan(names, systems=("autopilot", "blind"), repetitions=2).cells}
    assert len(set(keys.values())) == 12
    turned = fake_plan(names[::-1], systems=("blind", "autopilot"), repetitions=2, chunk=9, timeout_s=1)
    assert {c.name: c.key for c in turned.cells} == keys
    other = fake_plan(names, systems=("autopilot", "blind"), repetitions=2, seed=1)
    assert not set(keys.values()) & {c.key for c in other.cells}


def test_systems_meet_the_same_episodes() -> None:
    cells = fake_plan(["a"], systems=("autopilot", "blind"), repetitions=3).cells
    seeds = {(c.system, c.repetition): c.seed for c in cells}
    assert all(seeds["autopilot", r] == seeds["blind", r] for r in range(3))
    assert len(set(seeds.values())) == 3


@pytest.mark.parametrize("change", [{"target_speed": 9.0}, {"seed": 1}, {"parameters": {"speed": 2.0}}])
def test_a_changed_scenario_is_another_cell(change: dict[str, object]) -> None:
    suite = Suite(name="s", systems=["blind"], scenarios=["a"])
    one, two = (
        make_cells(suite, [s], systems={"blind": ""}, towns={})[0].key
        for s in (fake_scenario("a"), replace(fake_scenario("a"), **change))  # type: ignore[arg-type]
    )
    assert one != two


def test_a_changed_system_or_town_is_another_cell() -> None:
    suite = Suite(name="s", systems=["m:S"], scenarios=["a"])
    keys = {
        make_cells(suite, [fake_scenario("a")], systems={"m:S": version}, towns={"Nowhere": town})[0].key
        for version in ("1", "2")
        for town in ("1", "2")
    }
    assert len(keys) == 4


def test_find_cell() -> None:
    cells = fake_plan(["a", "b"], systems=("autopilot", "blind"), repetitions=2).cells
    assert find_cell(cells, "blind/a#1").repetition == 1
    assert find_cell(cells, cells[0].key[:8]) == cells[0]
    with pytest.raises(ConfigError, match="closest: blind/"):
        find_cell(cells, "blind/x")
    with pytest.raises(ConfigError, match="no cell ''"):
        find_cell(cells, "")

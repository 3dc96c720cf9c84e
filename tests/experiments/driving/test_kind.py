"""Kind `driving` without a world behind it: its suites, cells, batches, and what it keeps beside the results."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from ssad.core.errors import ConfigError, RouteError, UnknownNameError
from ssad.core.lane_graph import town_file
from ssad.core.types import Actor, Pose, Scenario
from ssad.engine.kind import Cell, Job, Plan, Resources
from ssad.experiments import scenario_kind
from ssad.experiments.driving import kind as driving_kind
from ssad.experiments.driving.kind import Driving, DrivingSuite
from ssad.experiments.scenario_kind import route_key, suite_scenarios


def replace_name(monkeypatch: pytest.MonkeyPatch, name: str, value: Any) -> None:
    """Replace a name in the kind and in its base, wherever it is used."""
    modules = [module for module in (scenario_kind, driving_kind) if hasattr(module, name)]
    assert modules, name
    for module in modules:
        monkeypatch.setattr(module, name, value)


GOOD: dict[str, Any] = {"name": "s", "systems": ["autopilot", "blind"], "scenarios": ["x"]}


def suite(**changes: Any) -> DrivingSuite:
    return DrivingSuite.model_validate(GOOD | changes)


def scenario(name: str, **changes: Any) -> Scenario:
    base = {"name": name, "type": "StraightObstacle", "town": "Nowhere", "route": (Pose(0, 0), Pose(9, 0))}
    return Scenario(**(base | changes))


@pytest.fixture(autouse=True)
def nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Towns of that name, and scenarios that the suite seems to name."""
    replace_name(
        monkeypatch, "cached_town", lambda name: SimpleNamespace(name=name, xy=np.zeros(3), sign_kind=np.zeros(0))
    )


def plan_of(monkeypatch: pytest.MonkeyPatch, *scenarios: Scenario, check: bool = False, **changes: Any) -> Plan:
    replace_name(monkeypatch, "suite_scenarios", lambda suite: scenarios)
    return Driving().plan(suite(**changes), check=check)


def test_what_a_suite_says_by_default() -> None:
    found = suite()
    assert (found.repetitions, found.spread, found.timeout_s, found.chunk) == (1, 1.0, 120.0, 16)
    assert (found.witness, found.pictures) == (True, [])


@pytest.mark.parametrize(
    ("key", "good", "bad"),
    [
        ("repetitions", [1, 100_000], [0, 100_001]),
        ("spread", [0.0, 10.0], [-0.01, 10.01, math.inf, math.nan]),
        ("timeout_s", [0.01], [0.0, math.inf]),
        ("chunk", [1, 4096], [0, 4097]),
        ("pictures", [["shifts", "camera"]], [["cats"]]),
        ("systems", [["a"]], [[], [""]]),
        ("scenarios", [["a"]], [[], [""]]),
    ],
)
def test_what_a_suite_may_say(key: str, good: list[Any], bad: list[Any]) -> None:
    for value in good:
        assert getattr(suite(**{key: value}), key) == value
    for value in bad:
        with pytest.raises(ValidationError):
            suite(**{key: value})


def test_scenario_files_lie_in_the_working_folder_or_beside_the_suite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    for name in ("here/one.yaml", "there/one.yaml", "there/two.yml", "there/three"):
        (tmp_path / name).write_text("")
    monkeypatch.chdir(tmp_path / "here")
    found = suite(scenarios=["one.yaml", "two.yml", "gone.yaml", "three", "set"]).beside(tmp_path / "there" / "s.yaml")
    assert found.scenarios == ["one.yaml", str(tmp_path / "there" / "two.yml"), "gone.yaml", "three", "set"]


def test_a_system_twice_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="suite s: systems: a name appears twice"):
        plan_of(monkeypatch, scenario("a"), systems=["blind", "blind"])


def test_cells_are_named_and_described(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plan_of(monkeypatch, scenario("a/00", group="A"), scenario("b"), repetitions=2, spread=0.5)
    assert [cell.name for cell in plan.cells] == [
        f"{system}/{name}" for system in ("autopilot", "blind") for name in ("a/00", "a/00#1", "b", "b#1")
    ]
    one, again = plan.cells[:2]
    assert one.fields == {"system": "autopilot", "group": "A", "cluster": route_key(scenario("a/00"))}
    assert plan.cells[2].fields["group"] == "StraightObstacle"
    assert (one.spec["repetition"], one.spec["spread"]) == (0, 0.0)
    assert (again.spec["repetition"], again.spec["spread"]) == (1, 0.5)
    assert again.spec["system"] == "autopilot"
    assert one.spec["scenario"]["name"] == "a/00"
    assert set(plan.inputs) == {"towns", "systems"}
    assert list(plan.inputs["towns"]) == ["Nowhere"]
    assert plan.device == "cpu"


def test_scenarios_on_one_route_of_a_town_share_a_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    """The key points and the town decide, not the name. A suite may say that scenarios are independent."""
    first, other = scenario("a/00"), scenario("b/07", route=(Pose(0.001, 0), Pose(9, 0)))
    elsewhere, beyond = scenario("c", town="Elsewhere"), scenario("d", route=(Pose(0, 0), Pose(9.1, 0)))
    scenarios = (first, other, elsewhere, beyond)
    clusters = [cell.fields["cluster"] for cell in plan_of(monkeypatch, *scenarios, systems=["blind"]).cells]
    assert clusters[0] == clusters[1]
    assert len(set(clusters)) == 3
    assert clusters[0].startswith("Nowhere ")
    independent = plan_of(monkeypatch, *scenarios, systems=["blind"], cluster="scenario")
    assert [cell.fields["cluster"] for cell in independent.cells] == ["a/00", "b/07", "c", "d"]


def test_each_scenario_is_built_once_to_check_it(monkeypatch: pytest.MonkeyPatch) -> None:
    built = []

    def build(cell: Cell) -> None:
        built.append(cell.name)
        if cell.name.endswith("bad"):
            raise RouteError("no way")
        if cell.name.endswith("worse"):
            raise RouteError("scenario worse: no way")

    replace_name(monkeypatch, "build_requested_episode", build)
    plan_of(monkeypatch, scenario("a"), scenario("b"), repetitions=3, check=True)
    assert built == ["autopilot/a", "autopilot/b"]
    for name in ("bad", "worse"):
        with pytest.raises(RouteError, match=f"^scenario {name}: no way$"):
            plan_of(monkeypatch, scenario(name), check=True)
        plan_of(monkeypatch, scenario(name))
    plan_of(monkeypatch, scenario("a"))
    built.clear()
    Driving().plan(suite(scenarios=["x"]))
    assert built, "unless it is told not to"


def test_copies_of_towns_lie_beside_the_results(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    saved = []

    def save(graph: Any, path: Path) -> None:
        saved.append((graph.name, path))
        path.parent.mkdir(exist_ok=True)
        path.write_text("")

    replace_name(monkeypatch, "save_graph", save)
    plan = plan_of(monkeypatch, scenario("a"), scenario("b", town="dir/own.npz"), scenario("c", town="Old"))
    (tmp_path / "towns").mkdir()
    (tmp_path / "towns" / "Old.npz").write_text("")
    assert plan.kind.prepare(plan, tmp_path, Resources()) == {"witness": True}
    file = town_file("dir/own.npz")
    assert file.startswith("own-")
    assert saved == [("Nowhere", tmp_path / "towns" / "Nowhere.npz"), ("dir/own.npz", tmp_path / "towns" / file)]
    assert (tmp_path / "traces").is_dir()
    no = plan_of(monkeypatch, scenario("a"), witness=False)
    assert no.kind.prepare(no, tmp_path, Resources()) == {"witness": False}


def test_the_drivers_of_actors_count_in_the_key(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = Actor("car", "car", Pose(0.0, 0.0))
    told = scenario("a", type="Custom", actors=(replace(plain, policy="mine"), plain, replace(plain, policy="mine")))
    keys = []
    for version in ("1", "1", "2"):
        versions = {"mine": version, "autopilot": "0", "blind": "0"}
        replace_name(monkeypatch, "system_version", versions.__getitem__)
        plan = plan_of(monkeypatch, told, scenario("b"))
        keys.append([cell.key for cell in plan.cells if cell.system == "blind"])
    assert keys[0] == keys[1]
    assert keys[0][0] != keys[2][0]
    assert keys[0][1] == keys[2][1], "a scenario without them stays"


@pytest.mark.parametrize(
    ("chunk", "workers", "sizes"),
    [(16, 1, [5, 5]), (16, 2, [5, 5]), (16, 3, [4, 1, 4, 1]), (2, 1, [2, 2, 1] * 2), (16, 99, [1] * 10)],
)
def test_cells_of_a_system_run_together(
    monkeypatch: pytest.MonkeyPatch, chunk: int, workers: int, sizes: list[int]
) -> None:
    plan = plan_of(monkeypatch, *(scenario(name) for name in "abcde"), chunk=chunk)
    found = plan.kind.batches(plan, plan.cells, workers)
    assert [len(batch) for batch in found] == sizes
    assert [cell for batch in found for cell in batch] == list(plan.cells)
    assert plan.kind.batches(plan, [], workers) == []


def test_scenarios_of_a_suite_are_taken_once(monkeypatch: pytest.MonkeyPatch) -> None:
    sets = {
        "one": (scenario("a"), scenario("b")),
        "two": (scenario("b"), scenario("c")),
        "bad": (scenario("b", seed=1),),
    }

    def load(ref: str) -> Any:
        if ref not in sets:
            raise UnknownNameError(f"unknown scenario '{ref}'")
        return sets[ref]

    monkeypatch.setattr("ssad.scenarios.dynamic.load_scenarios", load)
    assert [one.name for one in suite_scenarios(suite(scenarios=["one", "two"]))] == ["a", "b", "c"]
    with pytest.raises(
        ConfigError, match=r"suite s: two different scenarios are named 'b' \(one from bad\); rename one"
    ):
        suite_scenarios(suite(scenarios=["one", "bad"]))
    with pytest.raises(UnknownNameError, match="suite s: unknown scenario 'three'"):
        suite_scenarios(suite(scenarios=["one", "three"]))


def trace_of(end: str) -> Any:
    return SimpleNamespace(town="Nowhere", end=end)


def test_a_record_has_what_was_driven(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    cells = plan_of(monkeypatch, scenario("a"), scenario("b"), systems=["autopilot"]).cells
    episodes = [SimpleNamespace(scenario=SimpleNamespace(name=name)) for name in "ab"]
    asked, clock = [], iter([0.0, 8.0, 10.0, 11.0, 20.0, 22.0] * 2)
    replace_name(monkeypatch, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    replace_name(
        monkeypatch, "drive", lambda cells, *, device: (episodes, [trace_of("collision"), trace_of("route")], {})
    )
    replace_name(monkeypatch, "save_trace", lambda path, trace: path.write_text(trace.end))
    replace_name(monkeypatch, "trace_hash", lambda trace: f"hash {trace.end}")
    replace_name(monkeypatch, "motion_hash", lambda trace: f"motion {trace.end}")
    measured = SimpleNamespace(as_dict=lambda: {"speed": math.inf})
    replace_name(monkeypatch, "episode_metrics", lambda trace, stop_signs: measured)

    def grade_of(*given: Any) -> Any:
        asked.append(given)
        return SimpleNamespace(as_dict=lambda: {"danger": math.nan}, metrics=lambda: {"avoided_by_cc": 1.0})

    replace_name(monkeypatch, "grade_of", grade_of)
    (tmp_path / "traces").mkdir()
    found = Driving().execute(cells, Job(tmp_path, "cpu", {"witness": True}))
    one, two = (found[cell.key] for cell in cells)
    path = f"traces/{cells[0].key}.npz"
    assert one == {
        "metrics": {"speed": None, "avoided_by_cc": 1.0},
        "artefacts": {"trace": path},
        "case": "motion collision",
        "wall_s": 4.0 + 1.0,
        "episode": {
            "scenario": "a",
            "repetition": 0,
            "town": "Nowhere",
            "end": "collision",
            "trace_hash": "hash collision",
            "trace": path,
            "metrics": {"speed": None, "avoided_by_cc": 1.0},
        },
        "witness": {"danger": None},
    }
    assert two["wall_s"] == 4.0 + 2.0
    assert "witness" not in two, "nothing was hit"
    assert [(given[0], given[1].end, given[2]) for given in asked] == [(episodes[0], "collision", "cpu")]
    assert (tmp_path / path).read_text() == "collision"
    found = Driving().execute(cells, Job(tmp_path, "cpu", {"witness": False}))
    assert "witness" not in found[cells[0].key]

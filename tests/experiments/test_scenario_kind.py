"""Sweeps of suites: grid points as cells, their names, seeds and clusters, and what is refused."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from helpers.template import installed_template
from rich.console import Console

from ssad.core.errors import ConfigError
from ssad.engine.kind import Plan, Resources
from ssad.engine.run import run
from ssad.experiments.runs import matrices, read_plan, replay, write_report
from ssad.experiments.suites import kind_of, load_suite
from ssad.simulators.closed_loop import build_requested_episode

SCENARIO = """\
name: my/crossing
type: Custom
town: ProvingGround
route: [{x: 217.0, y: -5.25}, {x: 317.0, y: -5.25}]
parameters:
  ego_speed: {value: 10, range: [5, 15]}
  walk: {value: 1.5, range: [0.5, 3], unit: m/s, grid: [1, 2]}
  distance: {value: 20, range: [10, 40], unit: m}
constraints: [distance > 10 * walk - 5]
target_speed: ego_speed
limits: {max_steps: 80}
actors:
- name: walker
  model: walker
  pose: {x: 257.0, y: -10.0, yaw: pi / 2}
  phases: [{speed: walk, when: {kind: ego_distance, value: distance}}]
"""
SUITE = """\
kind: driving
name: sweep
systems: [blind]
scenarios: [crossing.yaml]
witness: false
sweep:
  walk: [1, 1.5, 3]
  distance: {from: 10, to: 30, step: 10}
"""


def write(folder: Path, suite: str = SUITE, scenario: str = SCENARIO) -> Path:
    (folder / "crossing.yaml").write_text(scenario)
    (folder / "sweep.yaml").write_text(suite)
    return folder / "sweep.yaml"


def plan_of(path: Path, *settings: str) -> Plan:
    suite = load_suite(str(path), settings)
    return kind_of(suite.kind).plan(suite)


def test_each_grid_point_is_a_cell(tmp_path: Path) -> None:
    plan = plan_of(write(tmp_path), "repetitions=2", "systems=[blind, autopilot]")
    points = {(cell.fields["sweep.walk"], cell.fields["sweep.distance"]) for cell in plan.cells}
    assert points == {(1.0, 10.0), (1.0, 20.0), (1.0, 30.0), (1.5, 20.0), (1.5, 30.0), (3.0, 30.0)}
    assert len(plan.cells) == len(points) * 2 * 2
    assert plan.cells[0].name == "blind/my/crossing/distance=10/walk=1"
    assert plan.cells[0].spec["scenario"]["actors"][0]["phases"][0]["speed"] == "walk"
    assert plan.kind.plan_lines(plan) == [
        "sweep: 6 grid points (walk 3 x distance 3 values); 3 more violate a constraint or are not selected"
    ]


def test_points_share_seed_and_cluster(tmp_path: Path) -> None:
    path = write(tmp_path, scenario=SCENARIO.replace("x: 217.0", "x: 217.0 + walk"))
    plan = plan_of(path, "repetitions=2")
    assert len({cell.fields["cluster"] for cell in plan.cells}) == 1
    assert len({cell.seed for cell in plan.cells}) == 2
    by_scenario = plan_of(path, "cluster=scenario")
    assert {cell.fields["cluster"] for cell in by_scenario.cells} == {"my/crossing"}


def test_zipped_grids_and_those_of_the_scenario(tmp_path: Path) -> None:
    zipped = plan_of(write(tmp_path, SUITE + "sweep_mode: zip\n"), "sweep.walk=[1, 1.5, 2]")
    assert [c.name.split("/", 3)[3] for c in zipped.cells] == [
        "distance=10/walk=1",
        "distance=20/walk=1.5",
        "distance=30/walk=2",
    ]
    declared = plan_of(write(tmp_path), "sweep={walk: grid}")
    assert [cell.fields["sweep.walk"] for cell in declared.cells] == [1.0, 2.0]


def test_parameters_of_a_class_and_of_the_ego_are_swept_alike(tmp_path: Path) -> None:
    sweep = "sweep={walker_speed: [1, 2], ego_speed: [0, 5], target_speed: [6, 9]}"
    plan = plan_of(write(tmp_path), "scenarios=StraightObstacle/00", sweep)
    assert len(plan.cells) == 8
    scenario = plan.cells[-1].spec["scenario"]
    assert scenario["parameters"]["walker_speed"] == 2.0
    assert (scenario["parameters"]["ego_speed"], scenario["target_speed"]) == (5.0, 9.0)


def test_parameters_of_a_class_of_a_package_are_swept(tmp_path: Path) -> None:
    sweep = "sweep={speed: [1, 2], gap: {from: 4, to: 6, step: 1}}"
    with installed_template(tmp_path / "site"):
        plan = plan_of(write(tmp_path), "scenarios=ssad_example.scenario:SCENARIO", sweep)
        walkers = build_requested_episode(plan.cells[-1]).agents[1:]
    assert [cell.fields["sweep.gap"] for cell in plan.cells] == [4.0, 4.0, 5.0, 5.0, 6.0, 6.0]
    assert {walker.phases[0].speed for walker in walkers} == {2.0}
    assert walkers[1].pose.x - walkers[0].pose.x == pytest.approx(6.0, abs=0.5)


BAD = [
    (
        "walk: [1, 1.5, 3]",
        "wlak: [1]",
        "sweep.wlak: scenario my/crossing has no such parameter; it has: ego_speed, walk",
    ),
    ("walk: [1, 1.5, 3]", "walk: [1, 4]", "sweep.walk: scenario my/crossing: 4 is outside 0.5 to 3 m/s"),
    ("walk: [1, 1.5, 3]", "walk: []", "sweep.walk: the grid is empty"),
    ("walk: [1, 1.5, 3]", "walk: {from: 3, to: 1, step: 1}", "sweep.walk: the grid from 3 to 1 is empty"),
    ("walk: [1, 1.5, 3]", "ego_speed: grid", "sweep.ego_speed: scenario my/crossing declares no grid"),
    ("walk: [1, 1.5, 3]", "ego_heading: [1]", "sweep.ego_heading: scenario my/crossing: 1 is outside"),
    (
        "distance: {from: 10, to: 30, step: 10}",
        "distance: [1.0e1]\n  ego_speed: [5]\nmatrix: [x]",
        "matrix: 'x' is not swept",
    ),
    ("witness: false", "matrix_metric: colision", "matrix_metric: unknown metric 'colision'"),
]


@pytest.mark.parametrize(("old", "new", "message"), BAD, ids=[bad[1] for bad in BAD])
def test_errors_name_line_and_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write(tmp_path, SUITE.replace(old, new))
    with pytest.raises(ConfigError) as refused:
        plan_of(path)
    line = SUITE[: SUITE.index(old)].count("\n") + 1 + new.count("\n")
    assert str(refused.value).startswith(f"{path}:{line}: {message}")


def test_errors_without_a_line(tmp_path: Path) -> None:
    path = write(tmp_path, SUITE + "sweep_mode: zip\n")
    with pytest.raises(
        ConfigError, match="sweep: grids that are zipped have equally many values, not: distance 3, walk 2"
    ):
        plan_of(path, "sweep.walk=[1, 2]")
    path = write(tmp_path)
    with pytest.raises(ConfigError, match=r"--set sweep\.walk=x: sweep\.walk: a grid is a list"):
        plan_of(path, "sweep.walk=x")
    with pytest.raises(ConfigError, match="no point meets the constraints; the last: 'distance > 10"):
        plan_of(path, "sweep={walk: [3], distance: [10, 20]}")
    many = "{from: 0, to: 0.1, count: 100}"
    with pytest.raises(ConfigError, match="sweep: 1000000 points; a sweep has at most"):
        plan_of(path, f"sweep={{ego_lateral: {many}, ego_longitudinal: {many}, ego_heading: {many}}}")


def test_a_sweep_runs_with_a_matrix_and_replays(tmp_path: Path) -> None:
    plan, folder = plan_of(write(tmp_path), "repetitions=2"), tmp_path / "run"
    run(plan, folder, Resources(0, console=Console(file=io.StringIO())))
    page = write_report(folder).read_text()
    assert page.count('class="data heat"') == 1
    assert "matrix.csv" in page
    assert len((folder / "tables" / "matrix.csv").read_text().splitlines()) == 1 + 3 * 3
    (matrix,) = matrices(folder)
    assert "n = 2 cases behind it in 1 cluster" in matrix.note
    drawn = next(cell.key for cell in read_plan(folder).cells if cell.name.endswith("#1"))
    assert replay(folder, drawn).difference is None

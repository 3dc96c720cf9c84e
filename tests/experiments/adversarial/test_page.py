"""The tables of an adversarial run, and the views of what was found."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.metric_traces import make_trace

from ssad.experiments.adversarial.collision_view import ADVERSARY, EGO, ROAD, draw_collision
from ssad.experiments.adversarial.kind import Adversarial
from ssad.experiments.adversarial.page import (
    against_table,
    budget_table,
    careful_table,
    group_table,
    main_table,
    summary,
    traffic_table,
    transfer_table,
)
from ssad.experiments.adversarial.verdict import verdict
from ssad.report.load import Run
from ssad.world.roads import load_town


def line(generator: str, base: int, first: int | None, *, survived: bool = True, **changes: Any) -> dict[str, Any]:
    metrics: dict[str, Any] = {"survived": survived}
    if survived:
        metrics |= {"CR": first is not None, "rollouts": first, "distinct": 1 if first else 0, "moving": None}
    return {
        "generator": generator,
        "system": "autopilot",
        "group": "A" if base < 6 else "B",
        "cluster": f"base {base}",
        "key": f"{generator}{base}",
        "status": "ok",
        "reason": "",
        "metrics": metrics,
        "spec": {"repetition": 0},
    } | changes


def run(lines: list[dict[str, Any]]) -> Run:
    columns = [{"name": c.name, "title": c.title, "unit": c.unit, "better": c.better} for c in Adversarial.columns]
    header = {"suite": {"name": "t", "budget": 16}, "columns": columns, "kind": "adversarial"}
    return Run(Path("nowhere"), header, tuple(lines), {}, len(lines))


@pytest.fixture
def found() -> Run:
    good = [line("king", k, 3 if k % 2 else 9) for k in range(10)]
    poor = [line("random", k, 16 if k == 0 else None) for k in range(10)]
    lost = [line(name, 10, None, survived=False) for name in ("king", "random")]
    return run(good + poor + lost)


def cell(table: Any, row: int, column: str) -> Any:
    return table.rows[row].cells[table.columns.index(column)]


def test_rates_count_survived_bases_alone(found: Run) -> None:
    table = main_table(found)
    column = next(c.title for c in Adversarial.columns if c.name == "CR")
    assert cell(table, 0, column).mean == 1.0
    assert cell(table, 0, column).n == 10
    assert cell(table, 1, column).mean == pytest.approx(0.1)
    assert cell(table, 1, column).low < 0.1 < cell(table, 1, column).high
    assert cell(table, 0, "plain replay survived").mean == pytest.approx(10 / 11)
    assert [row.head for row in table.rows] == [("king", "autopilot"), ("random", "autopilot")]
    assert len(summary(found).columns) == len(summary(found).rows[0].cells) == 6


def test_the_budget_is_shown_in_parts(found: Run) -> None:
    table = budget_table(found)
    assert table.columns == tuple(f"CR within {n}" for n in (2, 4, 8, 16))
    assert [c.mean for c in table.rows[0].cells] == [0.0, 0.5, 0.5, 1.0]
    assert [c.mean for c in table.rows[1].cells] == [0.0, 0.0, 0.0, 0.1]


def test_generators_are_compared_with_random_search_base_by_base(found: Run) -> None:
    table = against_table(found)
    assert table is not None
    (row,) = table.rows
    assert row.head == ("king", "autopilot")
    proven, collides = row.cells
    assert proven.text == "n/a"
    assert collides.mean == pytest.approx(0.9)
    assert collides.failed == 0
    assert collides.n == 10
    for one in found.lines:
        if one["metrics"]["survived"]:
            one["metrics"]["proven"] = one["key"] == "king3"
    measured = against_table(found)
    assert measured is not None
    assert cell(measured, 0, "difference of proven").mean == pytest.approx(0.1)
    assert against_table(run([line("king", 0, 1)])) is None


def test_the_headline_is_the_share_of_proven_collisions_with_the_raw_rate_beside_it(found: Run) -> None:
    assert [c.text for c in column(summary(found), "proven")] == ["n/a", "n/a"]
    assert group_table(found, "proven") is None
    for one in found.lines:
        if one["metrics"]["survived"]:
            number = int(one["key"].removeprefix(one["generator"]))
            one["metrics"] |= {
                "proven": one["generator"] == "king" and number < 3,
                "CR_any": one["generator"] == "king",
            }
    table = summary(found)
    assert table.columns[1:3] == ("proven", "raw CR")
    king, random = column(table, "proven")
    assert (king.mean, king.n, random.mean) == (pytest.approx(0.3), 10, 0.0)
    assert king.low < 0.3 < king.high
    assert [c.mean for c in column(table, "raw CR")] == [1.0, 0.0]
    groups = group_table(found, "proven")
    assert groups is not None
    assert cell(groups, 0, "A").mean == pytest.approx(3 / 6)
    assert cell(groups, 0, "B").mean == 0.0
    header = {**found.header, "columns": [c for c in found.header["columns"] if c["name"] != "proven"]}
    earlier = Run(found.folder, header, found.lines, {}, len(found.lines))
    assert [c.text for c in column(summary(earlier), "proven")] == ["n/a", "n/a"]
    assert column(summary(earlier), "raw CR")[0].mean == 1.0
    (proven, rate) = verdict(found)
    assert "king in 3 of 10" in proven
    assert "king in 10 of 10" in rate


def column(table: Any, name: str) -> list[Any]:
    return [row.cells[table.columns.index(name)] for row in table.rows]


def test_groups_have_their_own_rates_and_failures_count(found: Run) -> None:
    lines = [*found.lines, line("king", 11, None, status="failed", reason="no road", metrics={})]
    table = group_table(run(lines))
    assert table is not None
    assert table.columns == ("A", "B")
    assert cell(table, 0, "A").mean == pytest.approx(1.0)
    assert cell(table, 0, "B").failed == 1
    assert not math.isnan(cell(table, 1, "A").mean)


def test_natural_and_adversarial_traffic_stand_side_by_side(found: Run) -> None:
    assert traffic_table(found) is None
    spec = {"repetition": 0, "scenario": {"type": "NaturalJunction", "town": "Twinford"}}
    lines = [line("adv-ppo-paper", k, 1, spec=spec, survived=k > 1) for k in range(8)]
    for one in lines[2:]:
        one["metrics"]["CR_any"] = one["cluster"] != "base 7"
    table = traffic_table(run([*lines, line("adv-ppo-paper", 9, 1)]))
    assert table is not None
    ours = [row for row in table.rows if not row.published]
    assert [row.head for row in ours] == [("autopilot", "natural", "Twinford"), ("autopilot", "Adv.PPO", "Twinford")]
    assert [row.cells[0].mean for row in ours] == [2 / 8, 7 / 8]
    assert ours[1].cells[1].mean == 5 / 8
    assert ("PPO", "Adv. PPO", "Town02") in [row.head for row in table.rows if row.published]


def test_a_view_shows_ego_and_adversary_where_they_met() -> None:
    graph = load_town("Twinford")
    x, y = graph.xy[graph.points(0)][0].tolist()
    step = 0.1 * np.arange(31)
    ego, other = (x - 30 + 10 * step, y, 0.0, 10.0), (x + 35 - 10 * step, y, math.pi, 10.0)
    picture = draw_collision(make_trace(31, [ego, other]), graph, [1], size=300)
    assert picture.shape == (300, 300, 3)
    blue, red = ((picture == colour).all(-1) for colour in (EGO, ADVERSARY))
    assert blue.sum() > 100
    assert red.sum() > 100
    assert np.nonzero(blue)[1].mean() < np.nonzero(red)[1].mean()  # east is to the right


def test_a_view_has_the_road_also_where_none_of_its_corners_is() -> None:
    graph = load_town("Longreach")
    lane = max(range(graph.lane_count), key=lambda n: float(graph.length[n]))
    x, y, yaw, _ = graph.at(lane, 0.5 * float(graph.length[lane]))
    picture = draw_collision(make_trace(31, [np.tile([x, y, yaw, 0.0], (31, 1)).T]), graph, [], size=100)
    assert (picture == ROAD).all(-1).mean() > 0.05


def test_grades_and_other_systems_have_tables_of_their_own(found: Run) -> None:
    assert careful_table(found) is None
    assert transfer_table(found) is None
    lines = []
    for k in range(8):
        told = line("king", k, 1, transfer={"ppo": {"base": 0.0, "found": float(k < 6)}})
        told["metrics"] |= {"attributable": float(k < 2), "avoided_by_cc": float(k < 2), "impact_speed": 4.0 + k}
        lines.append(told)
    graded = careful_table(run([*lines, line("king", 9, None)]))
    assert graded is not None
    assert cell(graded, 0, "any of these avoids").mean == pytest.approx(0.25)
    assert cell(graded, 0, "any of these avoids").n == 8
    assert cell(graded, 0, "impact speed, m/s").mean == pytest.approx(7.5)
    moved = transfer_table(run(lines))
    assert moved is not None
    assert moved.rows[0].head == ("king", "autopilot", "ppo")
    assert [c.mean for c in moved.rows[0].cells] == pytest.approx([0.75, 0.0, 0.75])


def test_the_front_of_a_body_is_marked() -> None:
    """The ego drives east: its right edge has a thick dark line, its left one a thin one."""
    graph = load_town("Twinford")
    x, y = graph.xy[graph.points(0)][0].tolist()
    picture = draw_collision(make_trace(31, [(x, y, 0.0, 0.0)], size=(8.0, 6.0)), graph, [], size=400)
    dark = (picture.astype(int).sum(-1) < 3 * 60)[195:205]  # rows through its middle
    columns = np.flatnonzero(dark.all(0))
    front, rear = columns[columns > 200], columns[columns < 200]
    assert 0 < len(rear) < len(front)

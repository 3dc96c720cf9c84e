"""Matrices of a sweep: rows and columns, further parameters, empty points, the terminal's width, shades."""

from __future__ import annotations

import io
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from ssad.report.load import Run
from ssad.report.matrix import MAX_SLICES, run_matrices, shade, sweep_tables, terminal_matrices
from ssad.report.tables import to_csv


def sweep_run(axes: dict[str, list[float]], *, systems: tuple[str, ...] = ("blind",), **suite: Any) -> Run:
    """Return a run in which a drive collides where the sum of the swept values is above 10."""
    lines = []
    for system, values in product(systems, product(*axes.values())):
        point = dict(zip(axes, values, strict=True))
        lines.append(
            {
                "key": f"{system}{values}",
                "case": f"{system}{values}",
                "cluster": "T route",
                "system": system,
                "status": "ok",
                "swept": "my/cut",
                "metrics": {"collision": sum(values) > 10.0, "impact_speed": sum(values)},
                "spec": {"scenario": {"name": "my/cut", "parameters": {"gap": {"value": 1.0, "unit": "m"}}}},
            }
            | {f"sweep.{name}": value for name, value in point.items()}
        )
    header = {"suite": suite, "columns": [{"name": "CR", "title": "collision rate"}]}
    return Run(Path("run"), header, tuple(lines), {}, len(lines))


def test_rows_and_columns_are_those_of_the_suite() -> None:
    run = sweep_run({"gap": [2.0, 8.0], "speed": [1.5, 3.0, 9.0]}, systems=("a", "b"), matrix=["speed", "gap"])
    first, second = run_matrices(run)
    assert (first.title, second.title) == ("Collision rate: a", "Collision rate: b")
    assert (first.name, second.name) == ("matrix", "matrix-2")
    assert first.heads == ("speed \\ gap, m",)
    assert first.columns == ("2", "8")
    assert [row.head[0] for row in first.rows] == ["1.5", "3", "9"]
    assert [[cell.mean for cell in row.cells] for row in first.rows] == [[0.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
    assert "n = 1 case behind it" in first.note
    assert "no interval is taken" in first.note


def test_another_metric() -> None:
    (table,) = run_matrices(sweep_run({"gap": [2.0, 8.0], "speed": [1.5]}, matrix_metric="impact_speed"))
    assert [row.cells[0].mean for row in table.rows] == [3.5, 9.5]


def test_further_parameters_have_matrices_of_their_own_up_to_a_number() -> None:
    few = run_matrices(sweep_run({"a": [1.0, 2.0], "b": [3.0, 4.0], "c": [5.0, 6.0]}, matrix=["a", "b"]))
    assert [table.title for table in few] == ["Collision rate: blind, c = 5", "Collision rate: blind, c = 6"]
    assert [[cell.mean for cell in row.cells] for row in few[0].rows] == [[0.0, 0.0], [0.0, 1.0]]
    values = [float(value) for value in range(MAX_SLICES + 1)]
    (mean,) = run_matrices(sweep_run({"a": [1.0, 2.0], "b": [3.0, 4.0], "c": values}, matrix=["a", "b"]))
    assert "mean over c (7 values). n = 7 cases behind it in 1 cluster" in mean.note
    assert [cell.mean for row in mean.rows for cell in row.cells] == pytest.approx([0.0, 1 / 7, 1 / 7, 2 / 7])


def test_systems_are_the_columns_of_a_single_parameter() -> None:
    (table,) = run_matrices(sweep_run({"gap": [2.0, 12.0]}, systems=("a", "b")))
    assert table.columns == ("a", "b")
    assert [[cell.mean for cell in row.cells] for row in table.rows] == [[0.0, 0.0], [1.0, 1.0]]


def test_points_that_are_left_out_are_empty() -> None:
    run = sweep_run({"gap": [2.0, 8.0], "speed": [1.5, 3.0]})
    run = Run(run.folder, run.header, run.lines[:-1], {}, 3)
    (table,) = run_matrices(run)
    assert table.rows[-1].cells[-1].text == "n/a"
    assert shade(table.rows[-1].cells[-1], table) == ""
    assert shade(table.rows[0].cells[0], table) == "--bad:0%"


def test_without_a_sweep_there_is_none() -> None:
    run = sweep_run({})
    assert sweep_tables(run) == []
    assert terminal_matrices(run) == []


def test_all_points_and_metrics_are_in_one_table() -> None:
    run = sweep_run({"gap": [2.0, 8.0], "speed": [1.5, 3.0]})
    table = sweep_tables(run)[-1]
    assert table.name == "sweep"
    assert to_csv(table).splitlines()[:2] == [
        "system,scenario,gap,speed,column,mean,low,high,n,failed,source,clusters,method",
        "blind,my/cut,2,1.5,collision,0.0,,,1,0,ours,1,none",
    ]


def test_the_terminal_shows_wide_matrices_in_blocks() -> None:
    run = sweep_run({"gap": [float(gap) for gap in range(8)], "speed": [0.1 * step for step in range(40)]})
    buffer = io.StringIO()
    console = Console(file=buffer, width=80)
    for matrix in terminal_matrices(run):
        console.print(matrix)
    text = buffer.getvalue()
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    assert len(terminal_matrices(run)[0].blocks(80)) > 1
    assert text.count("n = 1 case") == 1

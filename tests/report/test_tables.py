"""Tables are pivots of records: rows by factors, columns by metrics or values, published rows in their places."""

from __future__ import annotations

import math
from typing import Any

import pytest

from ssad.report.records import case_of, field, metric_cell, metric_of
from ssad.report.tables import Table, TableCell, TableRow, to_markdown


def line(system: str, town: str, value: float | None, **more: Any) -> dict[str, Any]:
    key = f"{system}-{town}-{value}-{sorted(more.items())}"
    metrics = {"collision": value}
    return {"key": key, "system": system, "town": town, "status": "ok", "metrics": metrics, **more}


LINES = [
    line("b", "A", 1.0),
    line("a", "A", 0.0),
    line("b", "A", 0.0),
    line("b", "B", 1.0, spec={"repetition": 3}),
]


def share(lines: Any, town: str) -> TableCell:
    return metric_cell([one for one in lines if one["town"] == town], "collision", "share")


def test_rows_are_in_the_order_of_the_records_and_columns_in_theirs() -> None:
    table = Table.pivot(
        "t", "Title", LINES, rows={"System": field("system")}, columns={"B": "in B", "A": "in A"}, metric=share
    )
    assert [row.head for row in table.rows] == [("b",), ("a",)]
    assert (table.heads, table.columns) == (("System",), ("in B", "in A"))
    assert [[cell.text for cell in row.cells] for row in table.rows] == [["1.00", "0.50"], ["n/a", "0.00"]]
    assert table.rows[0].cells[1].n == 2
    assert "| b | 1.00" in to_markdown(table)


def test_rows_are_left_out_by_a_condition_on_all_their_records() -> None:
    table = Table.pivot(
        "t",
        "Title",
        LINES,
        rows={"System": field("system"), "Town": field("town")},
        columns={"A": "in A"},
        metric=share,
        condition=lambda lines: len(lines) > 1,
    )
    assert [row.head for row in table.rows] == [("b", "A")]


def test_a_key_keeps_rows_of_equal_heads_apart() -> None:
    rows = {"System": field("system")}
    table = Table.pivot(
        "t", "Title", LINES, rows=rows, columns={"A": "A"}, metric=share, key=lambda one: (one["system"], one["town"])
    )
    assert [row.head for row in table.rows] == [("b",), ("a",), ("b",)]


def test_published_rows_follow_the_row_of_a_record_and_others_stand_below() -> None:
    def published(one: dict[str, Any]) -> list[TableRow]:
        return [TableRow.of_published(["the paper"], (0.25, None))] if one["system"] == "b" else []

    table = Table.pivot(
        "t",
        "Title",
        LINES,
        rows={"System": field("system")},
        columns={"A": "A", "B": "B"},
        metric=share,
        published=published,
        footer_rows=[TableRow.of_published(["others"], (1, 1))],
        source="somewhere",
    )
    assert [row.head[0] for row in table.rows] == ["b", "the paper", "a", "others"]
    assert [row.published for row in table.rows] == [False, True, False, True]
    assert [cell.text for cell in table.rows[1].cells] == ["0.25", "n/a"]
    assert table.source == "somewhere"


def test_a_listing_has_a_row_for_each_record_even_where_heads_are_equal() -> None:
    table = Table.listing(
        "t",
        "Title",
        LINES,
        rows={"System": field("system"), "Repetition": field("repetition")},
        columns={"collision": "CR"},
        metric=lambda one, name: TableCell.value(one["metrics"][name], digits=0),
        published=lambda one: [TableRow.of_published(["p", ""], [2.0])] if one["town"] == "B" else [],
    )
    assert [row.head for row in table.rows] == [("b", ""), ("a", ""), ("b", ""), ("b", "3"), ("p", "")]
    assert [row.cells[0].text for row in table.rows[:4]] == ["1", "0", "0", "1"]


def test_a_failed_cell_has_no_metric_and_counts_as_failed() -> None:
    failed = line("a", "A", 1.0, cluster="route", case="motion") | {"status": "timeout"}
    assert math.isnan(metric_of(failed, "collision"))
    case = case_of(failed, 0.5)
    assert (case.cluster, case.case, case.failed) == ("route", "motion", True)
    assert case_of(LINES[0], 0.5).cluster == LINES[0]["key"]
    cell = metric_cell([*LINES[:3], failed], "collision", "share")
    assert (cell.n, cell.failed) == (3, 1)
    assert cell.mean == pytest.approx(1 / 3)
    assert cell.count == "n = 3, 1 failed"
    never = metric_cell([failed], "collision", "share")
    assert (never.text, never.interval, never.count) == ("n/a", "", "n = 0, 1 failed")

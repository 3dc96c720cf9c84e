"""What a kind need not bring, cells and their keys, and how a cell is found by what a user types."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from pydantic import ValidationError

from ssad.core.errors import ConfigError, StoreError
from ssad.core.run_records import NOT_NEGATIVE, SHARE
from ssad.engine import replay as replays
from ssad.engine.kind import Cell, CellError, Column, Job, Kind, Plan, Replay, Resources, SuiteBase, find_cell
from ssad.experiments.runs import replay


class Least(Kind):
    """The least that a kind must have."""

    name, suite, columns, factors = "least", SuiteBase, (Column("x"),), ("system",)

    def plan(self, suite: Any, *, device: str = "cpu", check: bool = True) -> Plan:
        cells = [self.make_cell(f"{system}/x", system, 3, {"system": system}, {}) for system in "ab"]
        return Plan(self, suite, device, tuple(cells), {})

    def execute(self, cells: Sequence[Cell], job: Job) -> Mapping[str, Mapping[str, Any]]:
        return {}


@pytest.fixture
def plan() -> Plan:
    return Least().plan(SuiteBase(kind="least", name="s"))


def test_what_a_kind_need_not_bring(plan: Plan, tmp_path: Path) -> None:
    kind, job = plan.kind, Job(tmp_path, "cpu", {})
    assert kind.prepare(plan, tmp_path, Resources()) == {}
    assert kind.batches(plan, plan.cells, 4) == [[cell] for cell in plan.cells]
    assert kind.order(plan.cells[0]) == kind.order(plan.cells[1])
    assert kind.pieces(plan.cells[0], job) == {}
    assert kind.patience is None
    kind.start(job)
    kind.finish(plan, tmp_path)
    with pytest.raises(CellError, match="the kind least names pieces of work, but not how they are made"):
        kind.make("piece", None, ["a"], job)
    with pytest.raises(ConfigError, match="cells of kind 'least' cannot be replayed"):
        kind.replay(plan, plan.cells[0], {}, tmp_path)
    assert not list(tmp_path.iterdir())


def test_input_is_checked_unless_it_is_told_not_to() -> None:
    assert inspect.signature(Kind.plan).parameters["check"].default is True


def test_a_run_talks_on_standard_error() -> None:
    assert Resources().console.stderr


def test_the_key_of_a_cell_depends_on_all_that_it_is_made_of(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {
        "name": "n",
        "system": "s",
        "seed": 1,
        "fields": {"a": (1, 2)},
        "spec": {"b": Path("/x").name},
    }

    def key(*inputs: object, **changes: Any) -> str:
        return Least().make_cell(*(given | changes).values(), *inputs).key

    one = Least().make_cell(*given.values(), "version")
    assert (one.name, one.system, one.seed, one.fields, one.spec) == ("n", "s", 1, {"a": [1, 2]}, {"b": "x"})
    assert len(one.key) == 16
    assert key("version") == one.key
    assert key("version", name="other") == one.key, "what people call it does not matter"
    others = [
        key(),
        key("other"),
        key("version", system="t"),
        key("version", seed=2),
        key("version", fields={"a": [1]}),
        key("version", spec={}),
    ]
    monkeypatch.setattr(Least, "code", "0" * 12)
    others.append(key("version"))
    assert len({one.key, *others}) == 8


def cell(key: str, name: str) -> Cell:
    return Cell(key, name, "s", 0, {}, {})


CELLS = [cell("ab12", "s/one"), cell("ab34", "s/two"), cell("cd56", "ab"), cell("ab78", "s/six"), cell("ab90", "s/ten")]


def test_a_cell_is_found_by_its_name_or_the_start_of_its_key() -> None:
    assert find_cell(CELLS, "s/two") is CELLS[1]
    assert find_cell(CELLS, "ab1") is CELLS[0]
    assert find_cell(CELLS, "ab") is CELLS[2], "a name goes before the start of a key"
    with pytest.raises(ConfigError, match=r"'a' means 4 cells: ab12 \(s/one\), ab34 \(s/two\), ab78 \(s/six\) \.\.\.;"):
        find_cell(CELLS, "a")
    with pytest.raises(ConfigError, match="no cell 's/tow' in this run; closest: s/two, s/ten, s/one"):
        find_cell(CELLS, "s/tow")
    with pytest.raises(ConfigError, match="no cell ''"):
        find_cell(CELLS, "")
    with pytest.raises(ConfigError, match=r"no cell '#' in this run; closest: \w+"):
        find_cell(CELLS, "#")


GOOD = {"kind": "least", "name": "s"}


@pytest.mark.parametrize(
    "change",
    [
        {"name": ""},
        {"name": "-x"},
        {"name": "a/b"},
        {"seed": -1},
        {"seed": 1.0},
        {"timeout_s": 0.0},
        {"timeout_s": float("inf")},
        {"timeout_s": "9"},
        {"other": 1},
        {"title": None},
    ],
)
def test_what_no_suite_may_say(change: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        SuiteBase.model_validate(GOOD | change)


def test_what_a_suite_may_say(tmp_path: Path) -> None:
    suite = SuiteBase.model_validate(GOOD)
    assert (suite.seed, suite.timeout_s, suite.title, suite.description, suite.reference) == (0, 3600.0, "", "", None)
    assert suite.beside(tmp_path) is suite
    assert SuiteBase.model_validate(GOOD | {"name": "a.B-9_", "timeout_s": 0.5}).timeout_s == 0.5
    with pytest.raises(ValidationError):
        suite.seed = 3  # type: ignore[misc]


def test_only_what_has_run_well_is_replayed(plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = plan.cells
    records = [{"key": two.key, "status": "timeout", "reason": "too long"}]
    monkeypatch.setattr("ssad.experiments.runs.read_plan", lambda folder: plan)
    monkeypatch.setattr(replays, "read_lines", lambda path: records if path == tmp_path / "results.jsonl" else [])
    with pytest.raises(StoreError, match=rf"cell {one.key} \(a/x\) has not run yet"):
        replay(tmp_path, "a/x")
    with pytest.raises(StoreError, match=rf"cell {two.key} \(b/x\) left no trace: timeout, too long"):
        replay(str(tmp_path), "b/x")
    records.append({"key": one.key, "status": "ok"})
    with pytest.raises(ConfigError, match="cannot be replayed"):
        replay(tmp_path, "a/x")
    found = Replay(one, None, SimpleNamespace(), SimpleNamespace())  # type: ignore[arg-type]

    def again(self: Least, plan: Plan, cell: Cell, record: Mapping[str, Any], folder: Path) -> Replay:
        assert (cell, record, folder) == (one, records[1], tmp_path)
        return found

    monkeypatch.setattr(Least, "replay", again)
    assert replay(tmp_path, one.key[:8]) is found


def test_limits_of_a_metric_come_from_its_column_its_unit_or_the_kind() -> None:
    class Measures(Least):
        columns = (
            Column("share", limits=SHARE),
            Column("gap", unit="m"),
            Column("length", unit="m", limits=NOT_NEGATIVE),
            Column("words"),
            Column("collision"),
        )
        metric_limits: ClassVar = {"collision": SHARE, "other": (None, 5.0)}

    assert Measures().limits == {
        "share": (0.0, 1.0),
        "gap": (-1e7, 1e7),
        "length": (0.0, 1e7),
        "collision": (0.0, 1.0),
        "other": (None, 5.0),
    }

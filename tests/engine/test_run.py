"""The engine's schedule: who waits for what, what is done again, given up and counted, without processes or waiting."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest
from rich.console import Console

from ssad.core import safeio
from ssad.core.errors import ConfigError, StoreError
from ssad.core.jsonl import read_lines
from ssad.core.safeio import read_json
from ssad.engine import run as engine
from ssad.engine.kind import Cell, Column, Job, Kind, Names, Plan, Resources, SuiteBase
from ssad.engine.pool import Pool
from ssad.engine.run import hash_artefacts, run, run_json
from ssad.engine.task import Task, TaskOutcome
from ssad.experiments.runs import read_plan

TIMEOUT = 8.0


class WordSuite(SuiteBase):
    """Systems x words."""

    kind: Literal["engine.test_run:Words"] = "engine.test_run:Words"
    systems: Names
    words: Names
    batch: int = 1
    timeout_s: float = TIMEOUT


class Words(Kind):
    """The length of words; `shares` says which words are a piece of work that systems share."""

    name, suite, factors = "words", WordSuite, ("system", "word")
    columns = (Column("length", "of a word", "letters"),)
    code = "0" * 12
    shares: ClassVar[Callable[[str], Sequence[str]]] = lambda word: ()
    seen: ClassVar[list[Any]] = []

    def plan(self, suite: WordSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        cells = [
            self.make_cell(f"{system}/{word}", system, suite.seed, {"system": system, "word": word}, {"n": len(word)})
            for word in suite.words
            for system in suite.systems
        ]
        return Plan(self, suite, device, tuple(cells), {"systems": list(suite.systems)}, {"dictionary": "3"})

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        self.seen.append(("prepare", folder, [cell.name for cell in retry]))
        return {"setting": 5}

    def batches(self, plan: Plan, cells: Sequence[Cell], workers: int) -> list[list[Cell]]:
        self.seen.append(("batches", workers))
        size = plan.suite.batch
        return [list(cells[k : k + size]) for k in range(0, len(cells), size)]

    def order(self, cell: Cell) -> float:
        return 1.0 if cell.fields["word"].startswith("z") else 0.0

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        return {piece: f"data of {piece}" for piece in type(self).shares(cell.fields["word"])}

    def make(self, name: str, data: Any, systems: Sequence[str], job: Job) -> None:
        assert data == f"data of {name}"

    def execute(self, cells: Sequence[Cell], job: Job) -> Mapping[str, Mapping[str, Any]]:
        assert job.settings == {"setting": 5}
        return {cell.key: {"metrics": {"length": cell.spec["n"]}, "episode": {"said": True}} for cell in cells}


class Eager(Words):
    """One that begins with something."""

    def start(self, job: Job) -> None:
        self.seen.append(("start", job.device))


class Scripted:
    """A backend that does one task at a time, here; `fate` says how one ends that is not to end well."""

    capacity = 1

    def __init__(self, fate: Callable[[Task], Mapping[str, Any] | None], seconds: float) -> None:
        self.fate, self.seconds = fate, seconds
        self.waiting: list[Task] = []
        self.done: list[tuple[str, float]] = []

    @property
    def busy(self) -> int:
        return len(self.waiting)

    def submit(self, task: Task) -> None:
        self.waiting.append(task)

    def wait(self, seconds: float) -> Iterator[TaskOutcome]:
        task = self.waiting.pop()
        self.done.append((called(task), task.timeout_s))
        fate = self.fate(task)
        if fate is not None:
            yield TaskOutcome(task, **({"seconds": self.seconds} | dict(fate)))
        else:
            yield TaskOutcome(task, "ok", task.function(task.argument), seconds=self.seconds)

    def close(self) -> None:
        assert not self.waiting


def called(task: Task) -> str:
    """ "a/one b/two", or "piece for a b"."""
    if isinstance(task.label, list):
        return " ".join(cell.name for cell in task.label)
    name, systems = task.label
    return f"{name} for {' '.join(systems)}"


class Bar:
    """Progress that only counts."""

    last: Bar

    def __init__(self, title: str, total: int, done: int, *, console: Console) -> None:
        self.title, self.total, self.began, self.done, self.failed = title, total, done, done, 0
        Bar.last = self

    def advance(self, ok: bool) -> None:
        self.done += 1
        self.failed += not ok

    def tick(self) -> None:
        pass

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *error: object) -> None:
        pass


class Bench:
    """Runs a suite by a scripted backend."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.fate: Callable[[Task], Mapping[str, Any] | None] = lambda task: None
        self.seconds = 1.0
        self.backend: Scripted
        self.asked: list[tuple[int, dict[str, Any]]] = []
        monkeypatch.setattr(engine, "open_pool", self.open)
        monkeypatch.setattr(engine, "LiveProgress", Bar)
        monkeypatch.setattr(engine, "versions", lambda device: {"ssad": "1", "device": device})
        monkeypatch.setattr(Words, "seen", [])

    def open(self, tasks: int, **options: Any) -> Pool:
        self.asked.append((tasks, options))
        self.backend = Scripted(self.fate, self.seconds)
        return Pool(self.backend)

    def run(
        self,
        systems: str,
        words: str,
        *,
        kind: type[Words] = Words,
        retry: bool = False,
        workers: int | None = 3,
        device: str = "cpu",
        **changes: Any,
    ) -> dict[str, dict[str, Any]]:
        suite = WordSuite(name="w", systems=systems.split(), words=words.split(), **changes)
        resources = Resources(workers, console=Console(file=io.StringIO()))
        records = run(kind().plan(suite, device=device), self.folder, resources, retry=retry)
        assert Bar.last.done == Bar.last.total, "all that was to be done is counted, once"
        return {f"{record['system']}/{record['word']}": record for record in records}

    @property
    def did(self) -> list[str]:
        return [name for name, _ in self.backend.done]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path / "run", monkeypatch)


def ends(*names: str, **how: Any) -> Callable[[Task], Mapping[str, Any] | None]:
    """A fate: tasks of these names end so."""
    return lambda task: how if called(task) in names else None


FAILED = {"status": "failed", "reason": "ValueError: no"}


def test_a_record_says_what_was_run_and_found(bench: Bench) -> None:
    bench.seconds = 2.00006
    records = bench.run("a b", "one three", seed=4, batch=2)
    assert list(records) == ["a/one", "b/one", "a/three", "b/three"]
    record = records["b/three"]
    assert len(record["key"]) == 16
    assert record == {
        "key": record["key"],
        "suite": "w",
        "system": "b",
        "word": "three",
        "seed": 4,
        "status": "ok",
        "reason": "",
        "spec": {"n": 5},
        "metrics": {"length": 5},
        "n": 1,
        "versions": {"ssad": "1", "device": "cpu", "dictionary": "3"},
        "wall_s": 1.0,
        "artefacts": {},
        "hashes": {},
    }
    assert read_lines(bench.folder / "results.jsonl")[-1] == record
    assert read_lines(bench.folder / "episodes.jsonl")[-1] == {
        "key": record["key"],
        "suite": "w",
        "system": "b",
        "word": "three",
        "seed": 4,
        "said": True,
    }
    assert bench.backend.done == [("a/one b/one", 2 * TIMEOUT), ("a/three b/three", 2 * TIMEOUT)]
    assert (Bar.last.title, Bar.last.began, Bar.last.total) == ("w", 0, 4)


def test_what_is_there_is_not_run_again(bench: Bench) -> None:
    bench.fate = ends("a/two", "a/six", **FAILED)
    first = bench.run("a", "one two six")
    assert Bar.last.failed == 2
    assert [r["status"] for r in first.values()] == ["ok", "failed", "failed"]
    bench.fate = lambda task: None
    assert bench.run("a", "one two six") == first
    assert len(bench.asked) == 1, "nothing to do"
    again = bench.run("a", "one two six", retry=True)
    assert bench.did == ["a/two", "a/six"]
    assert (Bar.last.began, Bar.last.total) == (1, 3)
    assert [r["status"] for r in again.values()] == ["ok"] * 3
    assert [seen for seen in Words.seen if seen[0] == "prepare"] == [
        ("prepare", bench.folder, []),
        ("prepare", bench.folder, ["a/two", "a/six"]),
    ]


def test_cells_run_in_the_order_of_their_kind_and_are_told_in_that_of_the_plan(bench: Bench) -> None:
    assert list(bench.run("a", "zero one zwei two")) == ["a/zero", "a/one", "a/zwei", "a/two"]
    assert bench.did == ["a/one", "a/two", "a/zero", "a/zwei"]


def test_the_pool_is_asked_for_what_the_run_may_use(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "default_workers", lambda: 4)
    bench.run("a", "1 2 3 4 5 6")
    bench.folder = bench.folder.with_name("cuda")
    bench.run("a", "1 2 7", workers=None, device="cuda", kind=Eager)
    monkeypatch.setattr(Words, "shares", lambda word: ["all", word])
    for k, workers in enumerate((None, 2)):
        bench.folder = bench.folder.with_name(f"shared-{k}")
        bench.run("a b", "1 2 3", workers=workers)
    (six, plain), (three, own), (shared, _), _ = bench.asked
    function, argument = plain.pop("start")
    assert (six, plain) == (6, {"workers": 3, "ray": None, "device": "cpu"})
    function(argument)
    assert isinstance(argument[0], Words)
    assert three == 3
    function, argument = own.pop("start")
    assert own == {"workers": None, "ray": None, "device": "cuda"}
    function(argument)
    assert ("start", "cuda") in Words.seen
    assert shared == 6 + 4, "cells and pieces"
    assert [seen[1] for seen in Words.seen if seen[0] == "batches"] == [3, 3, 4, 2]


def test_a_batch_that_fails_is_run_one_by_one_at_once(bench: Bench) -> None:
    bench.fate = ends("a/one a/two", "a/two", **FAILED)
    records = bench.run("a", "one two six ten", batch=2)
    assert bench.backend.done == [
        ("a/one a/two", 2 * TIMEOUT),
        ("a/one", TIMEOUT),
        ("a/two", TIMEOUT),
        ("a/six a/ten", 2 * TIMEOUT),
    ]
    assert [record["status"] for record in records.values()] == ["ok", "failed", "ok", "ok"]
    lost = records["a/two"]
    assert (lost["reason"], lost["metrics"], lost["wall_s"], lost["n"]) == ("ValueError: no", {}, 1.0, 1)
    assert len(read_lines(bench.folder / "episodes.jsonl")) == 3


def test_a_time_out_names_the_time_of_the_suite(bench: Bench) -> None:
    bench.fate = ends("a/one", status="timeout", reason="took longer than 9 hours")
    assert bench.run("a", "one")["a/one"]["reason"] == "took longer than 8 s"


def test_the_time_that_a_kind_measures_counts(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def execute(self: Words, cells: Sequence[Cell], job: Job) -> Any:
        return {cell.key: {"wall_s": 0.25 + cell.spec["n"]} for cell in cells}

    monkeypatch.setattr(Words, "execute", execute)
    monkeypatch.setattr(Words, "shares", lambda word: ["piece"] if word == "three" else [])
    records = bench.run("a b", "one three", batch=2)
    assert [record["wall_s"] for record in records.values()] == [3.25, 3.25, 5.75, 5.75]


def test_cells_run_when_all_their_pieces_are_there(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of a piece is shared by the systems, and by the cells of each."""
    bench.seconds = 6.0
    monkeypatch.setattr(Words, "shares", lambda word: [] if word == "one" else list(word))
    records = bench.run("a b c", "ab one b")
    assert bench.did == [
        "a for a b c",
        "b for a b c",
        "a/ab",
        "a/b",
        "b/ab",
        "b/b",
        "c/ab",
        "c/b",
        "a/one",
        "b/one",
        "c/one",
    ]
    assert dict(bench.backend.done)["a for a b c"] == TIMEOUT
    for system in "abc":
        assert records[f"{system}/one"]["wall_s"] == 6.0
        assert records[f"{system}/ab"]["wall_s"] == 6.0 + 2.0 + 1.0
        assert records[f"{system}/b"]["wall_s"] == 6.0 + 1.0
    assert Bar.last.total == 9 + 2


def test_a_piece_that_fails_for_all_is_made_for_each_and_one_that_fails_alone_makes_no_more(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its cells are run all the same: the kind must do without."""
    monkeypatch.setattr(Words, "shares", lambda word: [word])
    bench.fate = ends("x for a b c", "x for b", **FAILED)
    records = bench.run("a b c", "x y z")
    assert {record["status"] for record in records.values()} == {"ok"}
    assert bench.did == [
        "x for a b c",
        "x for a",
        "x for b",
        "x for c",
        "a/x",
        "b/x",
        "b/y",
        "b/z",
        "c/x",
        "y for a c",
        "a/y",
        "c/y",
        "z for a c",
        "a/z",
        "c/z",
    ]


def test_a_system_that_failed_alone_is_left_out_when_a_piece_fails_that_was_at_work(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The piece of several systems had begun when one of them failed at another piece."""
    monkeypatch.setattr(Words, "shares", lambda word: [word])
    schedule: list[Any] = []
    original = engine._Schedule.run_cells

    def work(self: Any, missing: Sequence[Cell]) -> None:
        schedule.append(self)
        self.unshared_systems.add("b")
        original(self, missing)

    monkeypatch.setattr(engine._Schedule, "run_cells", work)
    bench.fate = ends("x for a b", **FAILED)
    records = bench.run("a b", "x")
    assert {record["status"] for record in records.values()} == {"ok"}
    assert bench.did[0] == "x for a b"
    assert sorted(bench.did[1:]) == ["a/x", "b/x", "x for a"]


class Patient(Words):
    """A system may hang or die twice."""

    patience = 2


@pytest.mark.parametrize("how", ["timeout", "crashed"])
def test_a_system_that_hangs_or_dies_again_and_again_is_given_up(bench: Bench, how: str) -> None:
    bench.fate = lambda task: {"status": how, "reason": "gone"} if called(task).startswith("a/") else None
    records = bench.run("a b", "1 2 3 4", kind=Patient)
    assert [name for name in bench.did if name.startswith("a/")] == ["a/1", "a/2"]
    assert {record["status"] for name, record in records.items() if name.startswith("b/")} == {"ok"}
    why = "took longer than 8 s" if how == "timeout" else "gone"
    assert [records[f"a/{k}"]["reason"] for k in (1, 2)] == [why, why]
    for k in (3, 4):
        record = records[f"a/{k}"]
        assert (record["status"], record["wall_s"]) == (how, 0.0)
        assert record["reason"] == "not tried after 2 others of a ended like this: gone"
    assert Bar.last.failed == 4


def test_a_system_that_raises_is_not_given_up(bench: Bench) -> None:
    bench.fate = lambda task: FAILED if called(task).startswith("a/") else None
    bench.run("a b", "1 2 3 4", kind=Patient)
    assert len(bench.did) == 8


def test_a_kind_without_patience_tries_all(bench: Bench) -> None:
    bench.fate = lambda task: {"status": "crashed", "reason": "gone"}
    bench.run("a", "1 2 3 4")
    assert len(bench.did) == 4


def test_what_waits_for_pieces_of_a_system_that_was_given_up_is_not_tried(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Crashes while pieces are made count as those of cells do."""
    monkeypatch.setattr(Words, "shares", lambda word: [word])
    bench.fate = lambda task: {"status": "crashed", "reason": "gone"} if "a" in called(task).split("/")[0] else None
    records = bench.run("a b", "1 2 3 4", kind=Patient)
    assert {name: record["status"] for name, record in records.items()} == {
        f"{system}/{k}": "ok" if system == "b" else "crashed" for system in "ab" for k in (1, 2, 3, 4)
    }
    tried = [name for name in bench.did if name.startswith("a/") or name.endswith("for a")]
    assert len(tried) == 2
    lost = [record["reason"] for name, record in records.items() if name.startswith("a/")]
    assert sum(reason.startswith("not tried after 2 others of a") for reason in lost) >= 3


def test_run_json_says_what_the_folder_holds(bench: Bench) -> None:
    bench.run("a b", "one two", seed=2)
    header = read_json(bench.folder / "run.json")
    suite = WordSuite(name="w", systems=["a", "b"], words=["one", "two"], seed=2)
    plan = Words().plan(suite)
    assert header == run_json(plan) | {"sealed": True}
    assert len(header["identity"]) == 16
    assert header["cells"][1] == {"key": plan.cells[1].key, "name": "b/one", "seed": 2, "system": "b", "word": "one"}
    column = {"name": "length", "title": "of a word", "unit": "letters", "better": "", "clock": False}
    assert header["columns"] == [column]
    assert header["limits"] == {}
    assert (header["kind"], header["factors"], header["code"]) == ("words", ["system", "word"], "0" * 12)
    assert header["versions"] == {"ssad": "1", "device": "cpu", "dictionary": "3"}
    assert header["systems"] == ["a", "b"]
    assert header["suite"]["words"] == ["one", "two"]
    for other in (Words().plan(suite, device="cuda"), Words().plan(suite.model_copy(update={"words": ["one"]}))):
        assert run_json(other)["identity"] != header["identity"]
        with pytest.raises(StoreError, match="holds another run"):
            run(other, bench.folder)


def test_a_plan_is_read_back_unless_something_has_changed(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.run("a b", "one two", device="cuda")
    monkeypatch.setattr("ssad.experiments.runs.kind_of", lambda name: {"engine.test_run:Words": Words()}[name])
    plan = read_plan(bench.folder)
    assert [cell.name for cell in plan.cells] == ["a/one", "b/one", "a/two", "b/two"]
    assert plan.device == "cuda"
    checks = []
    original = Words.plan

    def changed(self: Words, suite: WordSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        checks.append(check)
        made = original(self, suite, device=device)
        return Plan(self, suite, device, made.cells[:1], made.inputs)

    monkeypatch.setattr(Words, "plan", changed)
    with pytest.raises(ConfigError, match="scenarios changed since this run was made; run the suite again"):
        read_plan(bench.folder)
    assert checks == [False], "what is wrong with the input is not looked for"
    monkeypatch.setattr(Words, "code", "1" * 12)
    with pytest.raises(ConfigError, match=": code changed"):
        read_plan(bench.folder)
    header = safeio.read_json(bench.folder / "run.json")
    for wrong, why in (
        (header | {"suite": {"kind": "engine.test_run:Words"}}, "another version"),
        ({"identity": "a"}, "no key 'suite'"),
        (header | {"versions": 3}, "another version"),
    ):
        (bench.folder / "run.json").write_text(safeio.dump_json(wrong))
        with pytest.raises(StoreError, match=f"not what ssad run writes: .*{why}"):
            read_plan(bench.folder)


def test_artefacts_are_hashed_file_by_file(tmp_path: Path) -> None:
    (tmp_path / "deep" / "er").mkdir(parents=True)
    for name in ("deep/b", "deep/a", "deep/er/c", "one", "other"):
        (tmp_path / name).write_text(name)
    found = hash_artefacts(tmp_path, ["deep", "one", "gone"])
    names = ["deep/a", "deep/b", "deep/er/c", "one"]
    assert found == {name: hashlib.blake2b(name.encode(), digest_size=16).hexdigest() for name in names}
    assert list(found) == names


def test_artefacts_of_a_result_are_a_path_or_a_list_of_them(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def execute(self: Words, cells: Sequence[Cell], job: Job) -> Any:
        for name in "xyz":
            (job.folder / name).write_text(name)
        return {cell.key: {"artefacts": {"one": "x", "more": ["y", "z"]}} for cell in cells}

    monkeypatch.setattr(Words, "execute", execute)
    record = bench.run("a", "one")["a/one"]
    assert list(record["hashes"]) == ["x", "y", "z"]
    assert record["artefacts"] == {"one": "x", "more": ["y", "z"]}
    assert not read_lines(bench.folder / "episodes.jsonl"), "a kind need not have episodes"

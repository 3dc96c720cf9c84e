"""The engine, with a kind of its own that misbehaves: isolation, time-outs, resume, kill -9, retry, tables, Ray."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import io
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from helpers import other_dice, own_kind
from helpers.killing import STOPS, kill_9, started_by, wait_until_ended
from helpers.own_kind import DiceSuite
from rich.console import Console

from ssad.core.errors import ConfigError, SSADError, UnknownNameError
from ssad.core.jsonl import read_lines
from ssad.engine.kind import Resources
from ssad.engine.local import WORKER_MEMORY, Worker
from ssad.engine.run import run, select_cells
from ssad.experiments.runs import read_plan, write_report
from ssad.experiments.suites import kind_of, load_suite

TESTS = Path(__file__).resolve().parent.parent


def dice(numbers: list[str], **changes: Any) -> DiceSuite:
    return DiceSuite(**{"name": "dice", "systems": ["fair"], "numbers": numbers, "timeout_s": 60.0, **changes})


def go(
    suite: DiceSuite,
    folder: Path,
    workers: int | None = 1,
    *,
    ray: str | None = None,
    retry: bool = False,
    kind: type[own_kind.Dice] = own_kind.Dice,
) -> Any:
    plan = kind().plan(suite)
    return run(plan, folder, Resources(workers, ray, console=Console(file=io.StringIO())), retry=retry)


def table(folder: Path) -> list[dict[str, Any]]:
    """Results in canonical order without what may differ between two runs."""
    records = [{k: v for k, v in r.items() if k != "wall_s"} for r in read_lines(folder / "results.jsonl")]
    return sorted(records, key=lambda r: r["key"])


def test_all_cells_run_once_and_in_plan_order(tmp_path: Path) -> None:
    suite = dice([f"n-{i}" for i in range(11)], systems=["fair", "loaded"], repetitions=2)
    records = go(suite, tmp_path, workers=2)
    assert [r["key"] for r in records] == [c.key for c in own_kind.Dice().plan(suite).cells]
    assert len({r["key"] for r in records}) == 44
    assert {r["status"] for r in records} == {"ok"}
    assert len(read_lines(tmp_path / "results.jsonl")) == len(read_lines(tmp_path / "episodes.jsonl")) == 44


def test_result_does_not_depend_on_workers_or_batches(tmp_path: Path) -> None:
    for workers, batch in ((0, 2), (1, 9), (2, 4)):
        go(dice([f"n-{i}" for i in range(9)], chunk=batch), tmp_path / f"{workers}-{batch}", workers)
    tables = [[(r["key"], r["metrics"]) for r in table(folder)] for folder in sorted(tmp_path.iterdir())]
    assert tables[0] == tables[1] == tables[2]
    assert len(tables[0]) == 9


BAD = {
    "raise": ("failed", "ValueError: this one raises"),
    "exit": ("failed", "SystemExit: this one leaves"),
    "die": ("crashed", "exit code 3): last words"),
    "segfault": ("crashed", "SIGSEGV"),
    "liar": ("failed", "other cells"),
    "object": ("failed", "not plain data"),
    "nan": ("failed", "not plain data"),
    "absurd": ("failed", "the result is impossible: metrics.value is 7.5, outside of [0, 1]"),
    "text": ("failed", 'the result is impossible: metrics.value is "much", which is no number'),
    "memory": ("crashed", "out of memory: it held"),
}
HANGING = dict.fromkeys(("hang", "spin"), ("timeout", "took longer than 2 s"))


def check_bad_cells(folder: Path, workers: int | None, ray: str | None = None) -> None:
    """Only what hangs has little time: all else must have enough on a machine that is busy."""
    good = ["a", "b", "c", "d"]
    for name, deeds, batch, timeout_s in (("bad", BAD, 6, 60.0), ("hanging", HANGING, 1, 2.0)):
        suite = dice([*good[:2], *deeds, *good[2:]], chunk=batch, timeout_s=timeout_s)
        records = go(suite, folder / name, workers, ray=ray, kind=other_dice.LyingDice)
        found = {r["number"]: r for r in records}
        assert [found[number]["status"] for number in good] == ["ok"] * 4
        for deed, (status, reason) in deeds.items():
            assert found[deed]["status"] == status, found[deed]
            assert reason in found[deed]["reason"]
            assert "\n" not in found[deed]["reason"]
            assert found[deed]["metrics"] == {}
        assert len(read_lines(folder / name / "episodes.jsonl")) == 4


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_bad_cell_costs_only_itself(tmp_path: Path, workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(WORKER_MEMORY, str(512 << 20))
    check_bad_cells(tmp_path, workers)


def test_what_a_kind_imports_costs_no_cell_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine, good cells ran into their time-out, each the first of a new worker. All clocks are one."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "late_dice.py").write_text(
        "import sys, time\nfrom pathlib import Path\nfrom helpers.own_kind import Dice\n\n\n"
        "class Late(Dice):\n    pass\n\n\n"
        "if sys.argv[0].endswith('worker.py'):\n"
        "    Path(__file__).with_name('imported').write_text(repr(time.monotonic()))\n"
    )
    given = []
    give = Worker.start_task
    monkeypatch.setattr(Worker, "start_task", lambda worker, task: given.append(time.monotonic()) or give(worker, task))
    plan = importlib.import_module("late_dice").Late().plan(dice(["a"]))
    (record,) = run(plan, tmp_path / "run", Resources(1, console=Console(file=io.StringIO())))
    assert record["status"] == "ok"
    assert float((tmp_path / "imported").read_text()) < given[0], "before the time of the first cell began"


@pytest.mark.slow
def test_on_ray_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(WORKER_MEMORY, str(512 << 20))
    check_bad_cells(tmp_path / "bad", None, "local")
    suite = dice([f"n-{i}" for i in range(30)], systems=["fair", "loaded"])
    go(suite, tmp_path / "ray", ray="local")
    go(suite, tmp_path / "here", workers=2)
    assert table(tmp_path / "ray") == table(tmp_path / "here")


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_shared_work_is_done_once_and_a_bad_system_fails_alone(tmp_path: Path, workers: int) -> None:
    """Five numbers that five systems share; one dies, one hangs, one raises: after two of its cells it is given up."""
    numbers = [f"n-{i}" for i in range(5)]
    suite = dice(numbers, systems=["fair", "die", "hang", "raise", "loaded"], timeout_s=2.0)
    plan = other_dice.SharedDice().plan(suite)
    records = run(plan, tmp_path, Resources(workers, console=Console(file=io.StringIO())))
    status = {name: {r["status"] for r in records if r["system"] == name} for name in suite.systems}
    assert status == {"fair": {"ok"}, "die": {"crashed"}, "hang": {"timeout"}, "raise": {"failed"}, "loaded": {"ok"}}
    for name in ("fair", "loaded"):
        made = [path.read_text() for path in (tmp_path / "pieces").glob(f"{name}-*")]
        assert len(made) == len(numbers)
        again = sum(text.count("made") > 1 for text in made)
        assert again <= 2 * workers, "together, but for the first"
    given_up = [r["reason"] for r in records if r["system"] == "hang" and "not tried after 2 others" in r["reason"]]
    assert len(given_up) >= len(numbers) - 2 * workers
    again = run(plan, tmp_path, Resources(workers, console=Console(file=io.StringIO())), retry=True)
    assert {r["status"] for r in again if r["system"] == "die"} == {"crashed"}
    assert [r for r in again if r["system"] == "fair"] == [r for r in records if r["system"] == "fair"]


@pytest.mark.slow
def test_a_lost_node_of_a_cluster_changes_nothing(tmp_path: Path) -> None:
    from ray.cluster_utils import Cluster

    suite = dice([f"slow-{i}" for i in range(120)], chunk=2)
    go(suite, tmp_path / "here", workers=2)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = cluster.add_node(num_cpus=1)

    def lose() -> None:
        for _ in range(6000):
            if size(tmp_path / "cluster"):
                break
            time.sleep(0.01)
        cluster.remove_node(second, allow_graceful=False)

    thread = threading.Thread(target=lose)
    thread.start()
    try:
        go(suite, tmp_path / "cluster", ray=cluster.address)
    finally:
        thread.join()
        cluster.shutdown()
    assert table(tmp_path / "cluster") == table(tmp_path / "here")


def test_what_failed_is_kept_until_it_is_retried(tmp_path: Path) -> None:
    suite = dice(["a", "raise", "b"])
    before = go(suite, tmp_path)
    kept = (tmp_path / "results.jsonl").read_bytes()
    assert go(suite, tmp_path) == before
    assert (tmp_path / "results.jsonl").read_bytes() == kept
    again = go(suite, tmp_path, retry=True)
    assert [r["status"] for r in again] == ["ok", "failed", "ok"]
    assert again[0] == before[0]
    assert len(read_lines(tmp_path / "results.jsonl")) == 3


def test_a_slice_that_is_retried_leaves_what_failed_elsewhere(tmp_path: Path) -> None:
    plan = own_kind.Dice().plan(dice(["raise"], systems=["fair", "loaded"]))
    quiet = Resources(1, console=Console(file=io.StringIO()))
    assert {record["status"] for record in run(plan, tmp_path, quiet)} == {"failed"}
    kept = read_lines(tmp_path / "results.jsonl")
    run(plan, tmp_path, quiet, retry=True, only={"system": ["fair"]})
    after = read_lines(tmp_path / "results.jsonl")
    assert [line["system"] for line in after] == ["loaded", "fair"]
    assert after[0] == next(line for line in kept if line["system"] == "loaded")


def test_a_worker_that_cannot_start_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_kind.Dice, "start", _cannot_start)
    monkeypatch.setattr("ssad.engine.run._start_worker", _cannot_start)
    with pytest.raises(SSADError, match="no die here") as caught:
        go(dice(["a"]), tmp_path)
    assert "\n" not in str(caught.value)
    assert read_lines(tmp_path / "results.jsonl") == []


def _cannot_start(*arguments: Any) -> None:
    raise RuntimeError("no die here")


def test_artefacts_are_hashed(tmp_path: Path) -> None:
    for record in go(dice(["a", "b"]), tmp_path):
        (path,) = record["hashes"]
        data = (tmp_path / path).read_bytes()
        assert record["hashes"][path] == hashlib.blake2b(data, digest_size=16).hexdigest()


def test_a_kind_of_ones_own_gets_a_report_for_nothing(tmp_path: Path) -> None:
    """The whole file of the kind has under 60 lines, blank ones and imports included."""
    assert len(inspect.getsource(own_kind).splitlines()) < 60
    path = tmp_path / "dice.yaml"
    path.write_text("name: mine\nkind: helpers.own_kind:Dice\nsystems: [fair]\nnumbers: [a, b, c, raise]\n")
    suite = load_suite(str(path), ["repetitions=2"])
    assert isinstance(suite, DiceSuite)
    plan = kind_of(suite.kind).plan(suite)
    run(plan, tmp_path / "run", Resources(1, console=Console(file=io.StringIO())))
    page = write_report(tmp_path / "run").read_text()
    for record in read_lines(tmp_path / "run" / "results.jsonl"):
        assert record["number"] in page
    assert "this one raises" in page
    with pytest.raises(UnknownNameError):
        kind_of("dise")
    with pytest.raises(ConfigError, match="derived from"):
        kind_of("helpers.own_kind:DiceSuite")


def start(folder: Path, count: int, stop_at: int | None = None) -> subprocess.Popen[bytes]:
    """A run in a process of its own; it stands still once so many cells are there, to be killed."""
    code = f"stop_at = {stop_at}\n{STOPS}" if stop_at is not None else ""
    code += (
        # a shell that runs this in the background has told its children to ignore Ctrl-C
        "import signal, sys\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from helpers.own_kind import Dice, DiceSuite\nfrom ssad.engine.kind import Resources\n"
        "from ssad.engine.run import run\nnumbers = [f'slow-{i}' for i in range(int(sys.argv[2]))]\n"
        "suite = DiceSuite(name='dice', systems=['fair'], numbers=numbers, timeout_s=60.0, chunk=3)\n"
        "run(Dice().plan(suite), sys.argv[1], Resources(2))"
    )
    command = [sys.executable, "-c", code, str(folder), str(count)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])}
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def size(folder: Path) -> int:
    path = folder / "results.jsonl"
    return path.stat().st_size if path.exists() else 0


def kill_and_resume(folder: Path, count: int, kills: int, seed: int) -> int:
    """Kill a run `kills` times at random moments of its work, then let it end; how many kills hit it at work."""
    random_moments = random.Random(seed)
    hit = 0
    for _ in range(kills):
        process = start(folder, count, count - 5)
        before = size(folder)
        while process.poll() is None and size(folder) == before:  # until it has done something
            time.sleep(0.001)
        time.sleep(random_moments.uniform(0, 0.05))
        hit += kill_9(process)
    assert start(folder, count).wait(timeout=500) == 0
    return hit


def check_killed_run(tmp_path: Path, count: int, kills: int) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    go(dice([f"slow-{i}" for i in range(count)], chunk=3), whole, 0)
    assert kill_and_resume(killed, count, kills, seed=1) >= kills // 2
    assert table(killed) == table(whole)
    assert len(table(killed)) == count
    keys = [json.loads(line)["key"] for line in (killed / "episodes.jsonl").read_text().splitlines()]
    assert len(keys) == len(set(keys)) == count
    for name in os.listdir(whole / "dice"):
        assert (killed / "dice" / name).read_bytes() == (whole / "dice" / name).read_bytes()


def test_kill_9_then_resume_equals_an_unbroken_run(tmp_path: Path) -> None:
    check_killed_run(tmp_path, count=60, kills=3)


@pytest.mark.slow
def test_kill_9_at_20_moments(tmp_path: Path) -> None:
    check_killed_run(tmp_path, count=600, kills=20)


def test_workers_end_with_the_run_and_ctrl_c_leaves_a_folder_to_go_on_with(tmp_path: Path) -> None:
    process = start(tmp_path, 40, 35)
    while size(tmp_path) == 0 and process.poll() is None:
        time.sleep(0.01)
    workers = started_by(process.pid)
    assert workers
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGCONT)
    assert process.wait(timeout=120) != 0
    wait_until_ended(workers)
    done = len(read_lines(tmp_path / "results.jsonl"))
    assert 0 < done < 40
    assert start(tmp_path, 40).wait(timeout=500) == 0
    assert len(table(tmp_path)) == 40


def test_a_changed_run_is_not_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go(dice(["a"]), tmp_path / "run")
    assert [c.name for c in read_plan(tmp_path / "run").cells] == ["fair/a#0"]
    monkeypatch.setattr(own_kind.Dice, "code", "other")
    with pytest.raises(ConfigError, match="code changed"):
        read_plan(tmp_path / "run")
    with pytest.raises(SSADError, match="holds another run"):
        go(dice(["a"]), tmp_path / "run")


def test_slices_add_up_to_the_run(tmp_path: Path) -> None:
    plan = own_kind.Dice().plan(dice([f"n-{i}" for i in range(3)], systems=["fair", "loaded"]))
    quiet = Resources(0, console=Console(file=io.StringIO()))
    first = run(plan, tmp_path, quiet, only={"system": ["fair"]})
    assert {record["system"] for record in first} == {"fair"}
    assert len(first) == len(table(tmp_path)) == 3
    write_report(tmp_path)  # of what there is
    assert len(run(plan, tmp_path, quiet, only={"system": ["loaded"]})) == len(plan.cells) == 6
    for only, expected in (
        ({"sytem": ["fair"]}, "system"),
        ({"system": ["fiar"]}, "fair"),
    ):
        with pytest.raises(UnknownNameError, match=expected):
            run(plan, tmp_path, quiet, only=only)


@pytest.mark.parametrize(
    ("only", "expected"),
    [
        ({"system": ["fair,loaded"], "number": ["a"]}, ["fair/a#0", "loaded/a#0"]),
        ({"number": ["a,b"]}, ["fair/a,b#0", "loaded/a,b#0"]),  # there is one that is called so
        ({"number": ["a,c"]}, ["fair/a#0", "fair/c#0", "loaded/a#0", "loaded/c#0"]),
        ({"name": ["loaded/a,b#0", "fair/c#0"]}, ["fair/c#0", "loaded/a,b#0"]),
        ({"number": [7]}, ["fair/7#0", "loaded/7#0"]),
    ],
)
def test_a_slice_is_named_by_values_with_or_without_commas(only: dict[str, list[Any]], expected: list[str]) -> None:
    plan = own_kind.Dice().plan(dice(["a", "c", "a,b", "7"], systems=["fair", "loaded"]))
    assert sorted(cell.name for cell in select_cells(plan, only)) == sorted(expected)

"""The runner: crash isolation, time-outs, kill -9 and resume, with executors that misbehave."""

from __future__ import annotations

import io
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from helpers.suites import fake_plan
from rich.console import Console

from ssad.bench.run import run
from ssad.core.errors import SSADError
from ssad.jobs.store import read_lines

WICKED = "helpers.executors:wicked"
GOOD = "helpers.executors:good"
TESTS = Path(__file__).resolve().parent.parent


def quiet() -> Console:
    return Console(file=io.StringIO())


def table(folder: Path) -> list[dict[str, Any]]:
    """Results in canonical order without what may differ between two runs."""
    records = [{k: v for k, v in r.items() if k != "wall_s"} for r in read_lines(folder / "results.jsonl")]
    return sorted(records, key=lambda r: r["key"])


def test_all_cells_run_once_and_in_plan_order(tmp_path: Path) -> None:
    plan = fake_plan([f"s-{i}" for i in range(11)], systems=("autopilot", "blind"), repetitions=2)
    records = run(plan, tmp_path, workers=2, execute=GOOD, console=quiet())
    assert [r["key"] for r in records] == [c.key for c in plan.cells]
    assert len({r["key"] for r in records}) == 44
    assert {r["status"] for r in records} == {"ok"}
    assert len(read_lines(tmp_path / "results.jsonl")) == len(read_lines(tmp_path / "episodes.jsonl")) == 44


def test_result_does_not_depend_on_workers_or_chunk(tmp_path: Path) -> None:
    names = [f"s-{i}" for i in range(9)]
    for workers, chunk in ((1, 1), (1, 9), (2, 4)):
        folder = tmp_path / f"{workers}-{chunk}"
        run(fake_plan(names, chunk=chunk), folder, workers=workers, execute=GOOD, console=quiet())
    tables = [[(r["key"], r["metrics"]) for r in table(f)] for f in sorted(tmp_path.iterdir())]
    assert tables[0] == tables[1] == tables[2]
    assert len(tables[0]) == 9


@pytest.mark.parametrize(
    ("deed", "status", "reason"),
    [
        ("raise", "failed", "ValueError: this one raises"),
        ("exit", "failed", "SystemExit: this one leaves"),
        ("die", "crashed", "exit code 3): last words"),
        ("segfault", "crashed", "SIGSEGV"),
        ("liar", "failed", "other cells"),
        ("object", "failed", "not plain data"),
        ("nan", "failed", "not plain data"),
    ],
)
def test_a_bad_cell_costs_only_itself(tmp_path: Path, deed: str, status: str, reason: str) -> None:
    names = ["a", "b", deed, "c", "d"]
    records = run(fake_plan(names, chunk=5), tmp_path, workers=1, execute=WICKED, console=quiet())
    found = {r["spec"]["scenario"]["name"]: r for r in records}
    assert found[deed]["status"] == status
    assert reason in found[deed]["reason"]
    assert "\n" not in found[deed]["reason"]
    assert found[deed]["metrics"] == {}
    assert [found[n]["status"] for n in "abcd"] == ["ok"] * 4
    assert len(read_lines(tmp_path / "episodes.jsonl")) == 4


@pytest.mark.parametrize("deed", ["hang", "spin"])
def test_a_hanging_cell_times_out_alone(tmp_path: Path, deed: str) -> None:
    plan = fake_plan(["a", deed, "b"], chunk=3, timeout_s=0.4)
    records = run(plan, tmp_path, workers=1, execute=WICKED, console=quiet())
    assert [r["status"] for r in records] == ["ok", "timeout", "ok"]
    assert "0.4 s" in records[1]["reason"]


def test_a_finished_run_is_not_run_again(tmp_path: Path) -> None:
    plan = fake_plan(["a", "raise", "b"])
    run(plan, tmp_path, workers=1, execute=WICKED, console=quiet())
    before = (tmp_path / "results.jsonl").read_bytes()
    records = run(plan, tmp_path, workers=1, execute="helpers.nowhere:missing", console=quiet())
    assert (tmp_path / "results.jsonl").read_bytes() == before
    assert [r["status"] for r in records] == ["ok", "failed", "ok"]


def test_an_executor_that_cannot_start_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SSADError, match="nowhere"):
        run(fake_plan(["a"]), tmp_path, workers=1, execute="helpers.nowhere:missing", console=quiet())
    assert read_lines(tmp_path / "results.jsonl") == []


def start(folder: Path, count: int) -> subprocess.Popen[bytes]:
    """A run in a process of its own."""
    command = [sys.executable, "-m", "helpers.executors", str(folder), str(count), "2", "3"]
    environment = os.environ | {"PYTHONPATH": str(TESTS)}
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def kill_and_resume(folder: Path, count: int, kills: int, seed: int) -> int:
    """Kill a run `kills` times at random moments of its work, then let it end; how many kills hit it at work."""
    random_moments = random.Random(seed)
    hit = 0
    for _ in range(kills):
        process = start(folder, count)
        before = size(folder)
        while process.poll() is None and size(folder) == before:  # until it has done something
            time.sleep(0.001)
        time.sleep(random_moments.uniform(0, 0.03))
        hit += process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.wait()
    process = start(folder, count)
    assert process.wait(timeout=60) == 0
    return hit


def size(folder: Path) -> int:
    path = folder / "results.jsonl"
    return path.stat().st_size if path.exists() else 0


def check_killed_run(tmp_path: Path, count: int, kills: int) -> None:
    whole = tmp_path / "whole"
    assert start(whole, count).wait(timeout=60) == 0
    killed = tmp_path / "killed"
    assert kill_and_resume(killed, count, kills, seed=1) >= kills // 2
    assert table(killed) == table(whole)
    assert len(table(killed)) == count
    keys = [json.loads(line)["key"] for line in (killed / "episodes.jsonl").read_text().splitlines()]
    assert len(keys) == len(set(keys)) == count
    for name in os.listdir(whole / "traces"):
        assert (killed / "traces" / name).read_bytes() == (whole / "traces" / name).read_bytes()


def test_kill_9_then_resume_equals_an_unbroken_run(tmp_path: Path) -> None:
    check_killed_run(tmp_path, count=150, kills=5)


@pytest.mark.slow
def test_kill_9_at_20_moments(tmp_path: Path) -> None:
    check_killed_run(tmp_path, count=600, kills=20)


def test_children_die_with_the_runner(tmp_path: Path) -> None:
    process = start(tmp_path, 5000)
    children: list[int] = []
    while not children and process.poll() is None:
        listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process.pid)], capture_output=True, check=False)
        children = [int(pid) for pid in listed.stdout.split()]
        time.sleep(0.05)
    assert children
    process.kill()
    process.wait()
    for _ in range(100):
        if not any(Path(f"/proc/{pid}").exists() for pid in children):
            return
        time.sleep(0.05)
    pytest.fail("a worker outlived its runner")


def test_ctrl_c_leaves_a_folder_to_go_on_with(tmp_path: Path) -> None:
    process = start(tmp_path, 150)
    while size(tmp_path) == 0 and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=10) != 0
    done = len(read_lines(tmp_path / "results.jsonl"))
    assert 0 < done < 150
    assert start(tmp_path, 150).wait(timeout=60) == 0
    assert len(table(tmp_path)) == 150

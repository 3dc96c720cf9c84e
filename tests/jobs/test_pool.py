"""The pool: work shared out over processes of this machine or a Ray cluster, and what becomes of each task."""

from __future__ import annotations

import os
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from ssad.core.errors import ConfigError, SSADError, StoreError
from ssad.jobs.local import LocalProcesses, memory_left
from ssad.jobs.machine import visible_gpus
from ssad.jobs.pool import Pool, open_pool, run_all
from ssad.jobs.task import Task


def seen(number: int) -> tuple[int, str]:
    """The GPUs that the process which does this may use."""
    time.sleep(0.3)
    return os.getpid(), os.environ.get("CUDA_VISIBLE_DEVICES", "all")


def threads(number: int) -> str | None:
    """Of the linear algebra in the process which does this."""
    return os.environ.get("OPENBLAS_NUM_THREADS")


def touch(path: Path) -> None:
    """Leaves a trace."""
    time.sleep(0.05)
    path.touch()


def die(number: int) -> int:
    """Ends its process without a word for 1."""
    if number == 1:
        os._exit(3)
    return number


def fail(number: int) -> int:
    """Raises for 1, as a user's mistake for 2."""
    if number == 1:
        raise ValueError("one")
    if number == 2:
        raise ConfigError("two is wrong")
    return number


def begin(folder: Path) -> None:
    """What a worker does first."""
    (folder / str(os.getpid())).touch()


def begun(folder: Path) -> bool:
    """Whether this process has begun well."""
    return (folder / str(os.getpid())).exists()


def test_each_process_sees_one_gpu_in_turn() -> None:
    by_process = dict(run_all(Pool(LocalProcesses(4, gpus=["0", "3"])), seen, range(8)))
    assert len(by_process) > 1, "more than one process worked"
    assert set(by_process.values()) <= {"0", "3"}
    counts = Counter(by_process.values())
    assert abs(counts["0"] - counts["3"]) <= 4 - len(by_process) + 1, "shared out evenly"
    before = os.environ.get("CUDA_VISIBLE_DEVICES", "all")
    assert {gpus for _, gpus in run_all(open_pool(2, workers=2), seen, range(2))} == {before}, (
        "left alone if none is named"
    )


def test_processes_share_the_cores_in_linear_algebra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.setattr("ssad.jobs.pool.default_workers", lambda: 6)
    assert set(run_all(open_pool(4, workers=2), threads, range(4))) == {"3"}
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    assert set(run_all(open_pool(4, workers=2), threads, range(4))) == {"7"}, "what the user set is kept"


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_work_that_turns_up_while_outcomes_are_read_is_done(workers: int) -> None:
    with open_pool(9, workers=workers) as pool:
        for number in (10, 20, 30, 40, 50, 60, 70, 80):
            pool.add(Task(fail, number))
        found = []
        for outcome in pool.outcomes():
            found.append(outcome.value)
            if not outcome.value % 10:
                pool.add(Task(fail, outcome.value + 3), first=True)
    assert sorted(found) == sorted([n + k for n in range(10, 90, 10) for k in (0, 3)])
    if workers < 2:
        assert found[:6] == [10, 13, 20, 23, 30, 33], "what is to come first does not wait for the rest"


def test_what_is_left_when_the_reader_goes_is_not_begun(tmp_path: Path) -> None:
    with open_pool(20, workers=2) as pool:
        for number in range(20):
            pool.add(Task(touch, tmp_path / str(number)))
        next(iter(pool.outcomes()))
    assert 1 <= len(list(tmp_path.iterdir())) < 20


def test_tasks_that_have_not_begun_can_be_taken_back() -> None:
    with open_pool(1, workers=0) as pool:
        for number in (3, 4, 5):
            pool.add(Task(fail, number, label=number))
        assert [task.label for task in pool.drop(lambda task: task.label > 3)] == [4, 5]
        assert [outcome.value for outcome in pool.outcomes()] == [3]


def test_every_worker_begins_with_the_start(tmp_path: Path) -> None:
    assert run_all(Pool(LocalProcesses(2, start=(begin, tmp_path))), begun, [tmp_path] * 6) == [True] * 6
    with pytest.raises(SSADError, match="NotADirectoryError"):
        run_all(Pool(LocalProcesses(1, start=(begin, Path(__file__)))), begun, [tmp_path])


def test_what_cannot_be_handed_over_is_an_outcome() -> None:
    with open_pool(2, workers=1) as pool:
        pool.add(Task(lambda x: x, 1, label="task"))
        pool.add(Task(open, os.devnull, label="result"))
        pool.add(Task(fail, 5, label="fine"))
        found = {outcome.task.label: outcome for outcome in pool.outcomes()}
    assert found["fine"].value == 5
    assert "handed over" in found["task"].reason
    assert "handed over" in found["result"].reason


def test_visible_gpus_follow_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, GPU-ab12")
    assert visible_gpus() == ["2", "GPU-ab12"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert not visible_gpus()


def test_work_that_is_of_use_only_as_a_whole() -> None:
    told: list[tuple[int, int]] = []
    assert run_all(open_pool(2, workers=2), fail, [5, 6, 7], progress=lambda *done: told.append(done)) == [5, 6, 7]
    assert told == [(1, 3), (2, 3), (3, 3)]
    with pytest.raises(ConfigError, match="two is wrong"):
        run_all(open_pool(1, workers=1), fail, [5, 2, 6])
    with pytest.raises(StoreError, match=r"1 of 3 parts failed: ValueError: one .*; run the same command again"):
        run_all(open_pool(1, workers=1), fail, [5, 1, 6])
    with pytest.raises(StoreError, match=r"1 of 3 parts failed: the process ended \(exit code 3\)"):
        run_all(open_pool(2, workers=2), die, range(3))


def test_memory_is_told() -> None:
    total, free = memory_left()
    assert 0 < free < total


@pytest.mark.slow
def test_a_ray_cluster_of_two_nodes_one_of_which_is_lost(tmp_path: Path) -> None:
    """What a lost node had is done again on the other, and what a task does wrong is an outcome."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = cluster.add_node(num_cpus=1)
    try:
        with open_pool(40, ray=cluster.address) as pool:
            for number in range(40):
                pool.add(Task(touch, tmp_path / str(number), label=number))
            pool.add(Task(die, 1, label="die"))
            pool.add(Task(time.sleep, 100, 1.0, label="hang"))
            found: dict[Any, Any] = {}
            for outcome in pool.outcomes():
                found[outcome.task.label] = outcome
                if len(found) == 5:
                    cluster.remove_node(second, allow_graceful=False)
    finally:
        cluster.shutdown()
    assert {found[number].status for number in range(40)} == {"ok"}
    assert len(list(tmp_path.iterdir())) == 40
    assert found["die"].status == "crashed"
    assert "exit code 3" in found["die"].reason
    assert found["hang"].status == "timeout"


def test_a_cluster_that_is_not_there_is_one_line() -> None:
    with pytest.raises(ConfigError, match="no Ray cluster at 'nowhere:1'") as caught:
        open_pool(1, ray="nowhere:1")
    assert "\n" not in str(caught.value)

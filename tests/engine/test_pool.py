"""The pool: work shared out over processes of this machine or a Ray cluster, and what becomes of each task."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ssad.core.errors import ConfigError, SSADError, StoreError
from ssad.engine import pool as pools
from ssad.engine.local import LocalProcesses, available_memory
from ssad.engine.pool import Pool, open_pool, run_all
from ssad.engine.task import Task, TaskOutcome


def seen(number: int) -> tuple[int, str]:
    """The GPUs that the process which does this may use."""
    time.sleep(0.1)
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
    by_process = dict(run_all(Pool(LocalProcesses(2, gpus=["0", "3"])), seen, range(4)))
    assert 1 <= len(by_process) <= 2
    assert len(set(by_process.values())) == len(by_process), "each has one of its own"
    assert set(by_process.values()) <= {"0", "3"}


def test_processes_share_the_cores_in_linear_algebra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("ssad.engine.pool.default_workers", lambda: 6)
    assert set(run_all(open_pool(2, workers=2), threads, range(2))) == {"3"}


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


def test_work_that_is_of_use_only_as_a_whole() -> None:
    told: list[tuple[int, int]] = []
    assert run_all(open_pool(2, workers=2), fail, [5, 6, 7], progress=lambda *done: told.append(done)) == [5, 6, 7]
    assert told == [(1, 3), (2, 3), (3, 3)]
    with pytest.raises(StoreError, match=r"1 of 3 parts failed: the process ended \(exit code 3\); run the same"):
        run_all(open_pool(2, workers=2), die, range(3))


class Told:
    """A backend of one place that ends tasks as `how` says, by their arguments."""

    capacity = 1

    def __init__(self, how: Callable[[Any], dict[str, Any]]) -> None:
        self.how = how
        self.done: list[Task] = []
        self.task: Task | None = None
        self.closed = False

    @property
    def busy(self) -> int:
        return self.task is not None

    def submit(self, task: Task) -> None:
        self.task = task

    def wait(self, seconds: float) -> list[TaskOutcome]:
        assert self.task is not None
        task, self.task = self.task, None
        self.done.append(task)
        return [TaskOutcome(task, **self.how(task.argument))]

    def close(self) -> None:
        self.closed = True


def bad_below_0(number: int) -> dict[str, Any]:
    """How a task ends: well, or not for numbers below 0."""
    return {"status": "ok", "value": 10 * number} if number >= 0 else {"status": "crashed", "reason": f"no {number}"}


def test_what_is_lost_of_a_whole_is_told_when_the_rest_is_done() -> None:
    place = Told(bad_below_0)
    assert run_all(Pool(place), fail, [3, 1], timeout_s=5.0) == [30, 10]
    assert [task.timeout_s for task in place.done] == [5.0, 5.0]
    assert place.closed
    for numbers, words in (
        ([3, -1, 4], "1 of 3 parts failed: no -1; run the same command again"),
        ([-3, -1, 4], r"2 of 3 parts failed: no -3 \(and 1 more\); run the same command again"),
    ):
        place = Told(bad_below_0)
        with pytest.raises(StoreError, match=words):
            run_all(Pool(place), fail, numbers)
        assert [task.argument for task in place.done] == numbers


def test_a_mistake_of_the_user_ends_the_whole() -> None:
    place = Told(lambda number: {"status": "failed", "reason": "two", "error": ConfigError("two is wrong")})
    with pytest.raises(ConfigError, match="two is wrong"):
        run_all(Pool(place), fail, [2, 6])
    assert len(place.done) == 1, "nothing more is begun"
    assert place.closed


class Slow:
    """A backend of two places that ends one task at every other look."""

    capacity = 2

    def __init__(self) -> None:
        self.tasks: list[Task] = []
        self.most = 0
        self.pauses: list[float] = []

    @property
    def busy(self) -> int:
        return len(self.tasks)

    def submit(self, task: Task) -> None:
        self.tasks.append(task)
        self.most = max(self.most, self.busy)

    def wait(self, seconds: float) -> list[TaskOutcome]:
        self.pauses.append(seconds)
        return [] if len(self.pauses) % 2 else [TaskOutcome(self.tasks.pop(0), "ok")]

    def close(self) -> None:
        self.tasks = []


def test_the_reader_is_told_several_times_a_second_that_time_goes_by() -> None:
    place, ticks = Slow(), []
    with Pool(place) as pool:
        for number in range(5):
            pool.add(Task(fail, number))
        found = [outcome.task.argument for outcome in pool.outcomes(lambda: ticks.append(len(place.pauses)))]
        pool.backend.submit(Task(fail, 6))
    assert found == [0, 1, 2, 3, 4]
    assert place.most == 2
    assert max(place.pauses) <= 0.25
    assert ticks == list(range(1, 11))
    assert not place.tasks, "closed at the end"


def test_urgent_tasks_can_be_taken_back_too() -> None:
    with open_pool(1, workers=0) as pool:
        for number in (3, 4, 5, 6):
            pool.add(Task(fail, number, label=number), first=number > 4)
        assert [task.label for task in pool.drop(lambda task: task.label % 2 == 0)] == [6, 4]
        assert [outcome.value for outcome in pool.outcomes()] == [5, 3]


class Asked:
    """What a backend was asked for."""

    def __init__(self, *given: Any, **options: Any) -> None:
        self.given, self.options = given, options


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Backends that only keep what they are asked for, on a machine of 12 cores and 2 GPUs for 4 processes each."""
    has: dict[str, Any] = {"gpus": ["0", "5"], "gpu workers": 4, "cores": 12}
    monkeypatch.setattr(pools, "RayCluster", Asked)
    monkeypatch.setattr(pools, "LocalProcesses", Asked)
    monkeypatch.setattr(pools, "visible_gpus", lambda: has["gpus"])
    monkeypatch.setattr(pools, "gpu_workers", lambda count: has["gpu workers"] * count)
    monkeypatch.setattr(pools, "default_workers", lambda: has["cores"])
    return has


def asked(tasks: int = 100, **options: Any) -> tuple[tuple[Any, ...], dict[str, Any]]:
    backend = open_pool(tasks, **options).backend
    assert isinstance(backend, Asked)
    return backend.given, backend.options


@pytest.mark.parametrize(
    ("options", "workers", "threads"),
    [
        ({}, 12, 1),
        ({"workers": 5}, 5, 2),
        ({"workers": 50}, 50, 1),
        ({"tasks": 3}, 3, 4),
        ({"tasks": 0}, 1, 12),
        ({"workers": 5, "tasks": 2}, 2, 6),
    ],
)
def test_one_process_a_core_but_no_more_than_tasks(
    machine: dict[str, Any], options: dict[str, Any], workers: int, threads: int
) -> None:
    assert asked(**options) == ((workers,), {"start": None, "gpus": [], "threads": threads})


def test_processes_on_gpus_are_as_many_as_their_memory_takes(machine: dict[str, Any]) -> None:
    start = (fail, 3)
    given, options = asked(device="cuda", start=start)
    assert (given, options) == ((8,), {"start": start, "gpus": ["0", "5"], "threads": 1})
    assert asked(device="cuda", workers=11)[0] == (11,)
    machine["cores"] = 6
    assert asked(device="cuda")[0] == (6,)
    machine["gpus"] = []
    assert asked(device="cuda")[0] == (6,)


def test_tasks_of_a_cluster_get_the_part_of_a_gpu_that_they_get_here(machine: dict[str, Any]) -> None:
    start = (fail, 3)
    assert asked(ray="auto", start=start) == (("auto",), {"start": start, "gpu_share": 0.0})
    assert asked(ray="auto", device="cuda")[1]["gpu_share"] == 0.25
    machine["gpu workers"] = 1
    assert asked(ray="auto", device="cuda")[1]["gpu_share"] == 1.0
    machine["gpus"] = []
    assert asked(ray="auto", device="cuda")[1]["gpu_share"] == 1.0, "no GPU is visible here, but there"


def test_gpus_of_different_memory_are_shared_alike(machine: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pools, "gpu_workers", lambda count: 3 + 14)
    assert asked(ray="auto", device="cuda")[1]["gpu_share"] == 0.125


def test_memory_is_told() -> None:
    total, free = available_memory()
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

"""A Ray cluster: what it is asked for and what becomes of its answers, with a stand-in for Ray."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from ssad.core.errors import ConfigError, StoreError
from ssad.engine import cluster
from ssad.engine.cluster import RayCluster
from ssad.engine.task import Task, TaskOutcome


class RayError(Exception):
    """Ray's base of errors."""


class RayTaskError(RayError):
    """A task raised."""

    def __init__(self, cause: Exception) -> None:
        super().__init__("a long traceback")
        self.cause = cause


class FakeRay:
    """Ray as far as it is used. Tasks are done when they are waited for; `fate` says how one ends."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def __init__(self, running: bool = False) -> None:
        self.running = running
        self.resources: dict[str, float] = {"CPU": 3.0}
        self.fate: Callable[[Any], Any] = lambda argument: ("ok", argument, "", None, 0.5)
        self.did: list[tuple[str, Any]] = []
        self.options: dict[str, Any] = {}
        self.given: list[tuple[Any, ...]] = []
        self.cannot_cancel = False

    def is_initialized(self) -> bool:
        return self.running

    def init(self, **options: Any) -> None:
        self.did.append(("init", options))

    def shutdown(self) -> None:
        self.did.append(("shutdown", None))

    def put(self, value: Any) -> tuple[str, Any]:
        return "put", value

    def remote(self, **options: Any) -> Callable[[Any], Any]:
        self.options = options

        def decorate(function: Any) -> SimpleNamespace:
            assert function is cluster._run_on_node
            return SimpleNamespace(remote=self.submitted)

        return decorate

    def submitted(self, *arguments: Any) -> int:
        self.given.append(arguments)
        return len(self.given) - 1

    def cluster_resources(self) -> dict[str, float]:
        return self.resources

    def wait(self, references: list[int], *, timeout: float) -> tuple[list[int], list[int]]:
        self.did.append(("wait", timeout))
        return references[:1], references[1:]

    def get(self, reference: int) -> Any:
        return self.fate(self.given[reference][0][1])

    def cancel(self, reference: int, *, force: bool) -> None:
        self.did.append(("cancel", (reference, force)))
        if self.cannot_cancel:
            raise RayError


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> FakeRay:
    fake = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", fake)
    return fake


def fails(error: Exception) -> Callable[[Any], Any]:
    """A fate: `error` is raised."""

    def fate(argument: Any) -> Any:
        raise error

    return fate


def test_a_cluster_is_joined_and_left_again(ray: FakeRay) -> None:
    place = RayCluster("auto")
    assert ray.did == [("init", {"address": "auto", "log_to_driver": False, "logging_level": "ERROR"})]
    place.close()
    assert ray.did[-1] == ("shutdown", None)


def test_a_cluster_that_was_joined_before_stays_joined(ray: FakeRay) -> None:
    ray.running = True
    RayCluster("auto").close()
    assert ray.did == []


def test_a_task_asks_for_a_core_and_for_a_part_of_a_gpu_if_there_is_one(
    ray: FakeRay, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", ["", "/own"])
    monkeypatch.setenv("SSAD_OWN", "1")
    monkeypatch.setenv("OTHER", "2")
    RayCluster("auto")
    assert (ray.options["num_cpus"], ray.options["max_retries"]) == (1, 5)
    assert "num_gpus" not in ray.options
    environment = ray.options["runtime_env"]["env_vars"]
    assert environment["PYTHONPATH"] == f"{os.getcwd()}{os.pathsep}/own"
    assert environment["SSAD_OWN"] == "1"
    assert "OTHER" not in environment
    RayCluster("auto", gpu_share=0.25)
    assert ray.options["num_gpus"] == 0.25


@pytest.mark.parametrize(("resources", "capacity"), [({"CPU": 3.0}, 6), ({"CPU": 1.0}, 2), ({"CPU": 0.5}, 2), ({}, 2)])
def test_two_tasks_are_at_hand_for_each_core(ray: FakeRay, resources: dict[str, float], capacity: int) -> None:
    ray.resources = resources
    assert RayCluster("auto").capacity == capacity


def test_tasks_are_handed_over_with_the_start_and_come_back_as_outcomes(ray: FakeRay) -> None:
    start = (print, "first")
    place = RayCluster("auto", start=start)
    tasks = [Task(abs, number, 7.0) for number in (-4, -5)]
    assert place.busy == 0
    for task in tasks:
        place.submit(task)
    assert place.busy == 2
    assert ray.given == [((abs, -4, 7.0), ("put", start)), ((abs, -5, 7.0), ("put", start))]
    assert place.wait(0.25) == [TaskOutcome(tasks[0], "ok", -4, "", None, 0.5)]
    assert ray.did[-1] == ("wait", 0.25)
    assert place.busy == 1


def test_without_tasks_it_waits_all_the_same(ray: FakeRay, monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr(cluster, "time", SimpleNamespace(sleep=slept.append))
    assert RayCluster("auto").wait(0.25) == []
    assert slept == [0.25]


@pytest.mark.parametrize(
    ("cause", "raised"), [(ConfigError("no kernels"), ConfigError("no kernels")), (OSError("why"), StoreError("why"))]
)
def test_a_worker_that_cannot_start_ends_the_work(ray: FakeRay, cause: Exception, raised: Exception) -> None:
    place = RayCluster("auto")
    place.submit(Task(abs, 1))
    ray.fate = fails(RayTaskError(cause))
    with pytest.raises(type(raised), match=str(raised)):
        place.wait(0.0)


def test_a_task_whose_nodes_are_lost_is_an_outcome(ray: FakeRay) -> None:
    place = RayCluster("auto")
    place.submit(Task(abs, 1))
    ray.fate = fails(RayError("node\n  died " + 300 * "x"))
    (outcome,) = place.wait(0.0)
    assert (outcome.status, outcome.value, outcome.error, outcome.seconds) == ("crashed", None, None, 0.0)
    assert outcome.reason == "the cluster lost its node 6 times: node died " + 190 * "x"


@pytest.mark.parametrize("cannot", [False, True])
def test_what_runs_ends_with_it(ray: FakeRay, cannot: bool) -> None:
    ray.cannot_cancel = cannot
    place = RayCluster("auto")
    place.submit(Task(abs, 1))
    place.submit(Task(abs, 2))
    place.close()
    assert ray.did[1:] == [("cancel", (0, True)), ("cancel", (1, True)), ("shutdown", None)]
    assert place.busy == 0


def test_an_address_that_nobody_listens_at_is_one_line(ray: FakeRay) -> None:
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))  # taken, but nobody listens there
        address = f"127.0.0.1:{reserved.getsockname()[1]}"
        for running in (False, True):
            ray.running = running
            with pytest.raises(ConfigError, match=f"no Ray cluster at '{address}': .*refused"):
                RayCluster(address)
        assert ray.did == [], "Ray itself would wait for minutes"
        reserved.listen()
        for prefix in ("", "ray://"):
            RayCluster(prefix + address)


@pytest.mark.parametrize("address", ["auto", "local", "ray://head", "head:port"])
def test_an_address_without_a_port_is_left_to_ray(ray: FakeRay, monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    monkeypatch.setattr(ray, "init", lambda **options: fails(OSError("not\nthere"))(None))
    with pytest.raises(ConfigError, match=f"no Ray cluster at '{address}': not there"):
        RayCluster(address)


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"--ray needs the package ray; .*ray"):
        RayCluster("auto")


class FakeProcesses:
    """The child process of a Ray worker: its task ends at the second look."""

    made: list[FakeProcesses]

    def __init__(self, workers: int, *, start: Any) -> None:
        assert workers == 1
        self.start = start
        self.closed = False
        self.tasks: list[Task] = []
        self.looks = 0
        self.made.append(self)

    def submit(self, task: Task) -> None:
        assert not self.closed
        self.tasks.append(task)

    def wait(self, seconds: float) -> list[TaskOutcome]:
        assert 0 < seconds <= 60
        self.looks += 1
        if self.looks % 2:
            return []
        task = self.tasks[-1]
        return [TaskOutcome(task, "failed", task.argument, "why", ConfigError("error"), 0.5)]

    def close(self) -> None:
        self.closed = True


def test_a_ray_worker_keeps_its_child_process_for_tasks_of_one_start(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[FakeProcesses] = []
    monkeypatch.setattr(FakeProcesses, "made", made, raising=False)
    monkeypatch.setattr(cluster, "LocalProcesses", FakeProcesses)
    monkeypatch.setattr(cluster, "_BACKENDS", {})
    start = (print, "first")
    for number in (1, 2):
        status, value, reason, error, seconds = cluster._run_on_node((abs, number, 7.0), start)
        assert (status, value, reason, str(error), seconds) == ("failed", number, "why", "error", 0.5)
    assert [(one.start, one.closed) for one in made] == [(start, False)]
    assert [(task.function, task.argument, task.timeout_s) for task in made[0].tasks] == [(abs, 1, 7.0), (abs, 2, 7.0)]
    cluster._run_on_node((abs, 3, 7.0), None)
    assert [(one.start, one.closed) for one in made] == [(start, True), (None, False)]
    cluster._run_on_node((abs, 4, 7.0), start)
    assert [(one.start, one.closed) for one in made] == [(start, True), (None, True), (start, False)]

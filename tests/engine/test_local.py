"""Worker processes of this machine: how one is started, heard and ended, which gets what, and who may hold memory."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.clock import Clock, stopped
from helpers.descriptors import open_files

from ssad.core.errors import ConfigError, SSADError
from ssad.engine import local
from ssad.engine.local import THREADS, WORKER_MEMORY, LocalProcesses, ThisProcess, Worker, available_memory
from ssad.engine.task import Task, TaskOutcome

GIB = 1 << 30


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return stopped(monkeypatch, local)


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Worker]:
    """A worker whose process is a shell script."""

    def start(script: str) -> Worker:
        path = tmp_path / "worker.sh"
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(path))
        return Worker(None, {})

    return start


# one worker


def test_a_worker_works_and_leaves_nothing_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSAD_TEST", "theirs")
    before = open_files()
    worker = Worker(None, {"SSAD_OTHER": "own"})
    assert not worker.ready, "before it says so"
    assert worker.deadline > time.monotonic() + 60, "it may compile kernels"
    assert worker.read_answer() is None
    assert worker.ready
    assert worker.deadline == float("inf"), "it has nothing to do"
    assert os.getsid(worker.process.pid) == worker.process.pid, "Ctrl-C at the terminal does not reach it"
    for name, value in (("SSAD_TEST", "theirs"), ("SSAD_OTHER", "own")):
        task = Task(os.getenv, name, 60.0)
        assert worker.start_task(task) is None
        assert worker.deadline == worker.began + 60.0
        outcome = worker.read_answer()
        assert outcome is not None
        assert (outcome.task, outcome.status, outcome.value, outcome.reason) == (task, "ok", value, "")
        assert 0 < outcome.seconds < 60
        assert worker.task is None
    told = dict(line.split(":") for line in Path(f"/proc/{worker.process.pid}/status").read_text().splitlines()[:40])
    assert worker.resident_bytes() == pytest.approx(int(told["VmRSS"].split()[0]) * 1024, rel=0.1)
    worker.kill()
    assert worker.process.returncode == -signal.SIGKILL
    assert worker.resident_bytes() == 0
    assert open_files() == before


@pytest.mark.parametrize(
    ("script", "ended"),
    [
        ("exit 0", "(exit code 0)"),
        ("echo so what >&2; exit 3", "(exit code 3): so what"),
        ("kill -9 $$", "(killed by SIGKILL)"),
        ("kill -40 $$", "(killed by signal 40)"),
        ("echo first; echo '  last  ' >&2; echo; echo ' '; exit 1", "(exit code 1): last"),
        ("printf 'a\\377b'; exit 1", "(exit code 1): a\ufffdb"),
    ],
)
def test_how_a_process_ended(runs: Callable[[str], Worker], script: str, ended: str) -> None:
    worker = runs(script)
    with pytest.raises(SSADError) as caught:
        worker.read_answer()
    assert str(caught.value) == f"a worker process cannot start: the process ended {ended}"
    worker.kill()


def test_last_words_are_short(runs: Callable[[str], Worker]) -> None:
    text = "".join(f"{number:05d}" for number in range(1000))
    worker = runs(f"printf '{text}'; exit 1")
    assert worker.describe_exit() == f"the process ended (exit code 1): {text[-4096:][:300]}"
    worker.kill()


def test_a_worker_that_takes_too_long(runs: Callable[[str], Worker], clock: Clock) -> None:
    worker = runs("echo compiling >&2; sleep 60")
    assert worker.deadline == 5000.0 + 600.0
    while not worker._last_output_line():
        time.sleep(0.001)
    with pytest.raises(SSADError, match="a worker process did not start within 600 s: compiling"):
        worker.time_out()
    worker.ready = True
    clock.now += 100.0
    task = Task(abs, -1, 2.5)
    assert worker.start_task(task) is None
    assert worker.deadline == 5102.5
    clock.now += 3.0
    assert worker.time_out() == TaskOutcome(task, "timeout", None, "took longer than 2.5 s", None, 3.0)
    worker.kill()


def test_a_worker_that_dies_at_work(runs: Callable[[str], Worker]) -> None:
    worker = runs("sleep 0; exit 7")
    worker.ready = True
    assert worker.read_answer() is None, "it had nothing to do"
    task = Task(abs, -1)
    assert worker.start_task(task) is None, "that it is dead is heard"
    outcome = worker.read_answer()
    assert outcome is not None
    assert (outcome.status, outcome.reason) == ("crashed", "the process ended (exit code 7)")
    worker.kill()


@pytest.mark.parametrize(
    ("answer", "status", "value", "reason"),
    [
        (("value", 7), "ok", 7, ""),
        (("error", "ValueError: no"), "failed", None, "ValueError: no"),
        (("error", ConfigError("wrong")), "failed", None, "wrong"),
    ],
)
def test_answers_are_outcomes(clock: Clock, answer: tuple[str, Any], status: str, value: Any, reason: str) -> None:
    worker = object.__new__(Worker)
    worker.answers, theirs = Pipe(duplex=False)
    worker.task, worker.began, worker.ready = Task(abs, -1), clock.now, True
    task = worker.task
    theirs.send(answer)
    clock.now += 2.0
    outcome = worker.read_answer()
    assert outcome is not None
    assert (outcome.task, outcome.status, outcome.value, outcome.reason) == (task, status, value, reason)
    assert outcome.seconds == 2.0
    assert isinstance(outcome.error, SSADError) == isinstance(answer[1], SSADError)
    theirs.send(("fatal", "no kernels"))
    with pytest.raises(SSADError, match="no kernels"):
        worker.read_answer()
    worker.answers.close()
    theirs.close()


# many workers


class FakeWorker:
    """A worker without a process: it is ready, and answers, when the test says so."""

    made: list[FakeWorker]

    def __init__(self, start: Any, environment: dict[str, str]) -> None:
        self.start, self.environment = start, environment
        self.answers, self.theirs = Pipe(duplex=False)
        self.process = SimpleNamespace(poll=lambda: None)
        self.ready = False
        self.task: Task | None = None
        self.deadline = float("inf")
        self.held = 0
        self.ended = False
        self.cannot_send = False
        self.made.append(self)

    def start_task(self, task: Task) -> TaskOutcome | None:
        assert self.ready
        assert self.task is None
        self.task = task
        return self.outcome("failed", "not sent") if self.cannot_send else None

    def answer(self, what: str) -> None:
        self.theirs.send(what)

    def read_answer(self) -> TaskOutcome | None:
        answer = self.answers.recv()
        if answer == "ready":
            self.ready = True
            return None
        return self.outcome(answer)

    def outcome(self, status: Any, reason: str = "") -> TaskOutcome:
        assert self.task is not None
        task, self.task = self.task, None
        return TaskOutcome(task, status, None, reason)

    def time_out(self) -> TaskOutcome:
        return self.outcome("timeout")

    def resident_bytes(self) -> int:
        return self.held

    def kill(self) -> None:
        assert not self.ended
        self.ended = True
        self.answers.close()
        self.theirs.close()


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[FakeWorker]:
    """The workers that were made; the machine has 100 GiB of memory, of which half is free."""
    workers: list[FakeWorker] = []
    monkeypatch.setattr(FakeWorker, "made", workers, raising=False)
    monkeypatch.setattr(local, "Worker", FakeWorker)
    monkeypatch.setattr(local, "available_memory", lambda: (100 * GIB, 50 * GIB))
    monkeypatch.delenv(WORKER_MEMORY, raising=False)
    return workers


def submitted(place: LocalProcesses, count: int) -> list[Task]:
    tasks = [Task(abs, number) for number in range(count)]
    for task in tasks:
        place.submit(task)
    return tasks


def test_no_more_workers_are_started_than_there_are_tasks(made: list[FakeWorker]) -> None:
    place = LocalProcesses(3)
    assert place.capacity == 3
    assert place.wait(0.0) == []
    assert not made
    one, two = submitted(place, 2)
    assert place.busy == 2
    place.wait(0.0)
    assert len(made) == 2
    place.wait(0.0)
    assert len(made) == 2, "those that begin will do"
    made[1].answer("ready")
    place.wait(0.0)
    assert [worker.task for worker in made] == [None, one], "who is ready works"
    assert place.busy == 2
    made[1].answer("ok")
    made[0].answer("ready")
    (outcome,) = place.wait(0.0)
    assert outcome.task is one
    assert place.busy == 1
    assert two in [worker.task for worker in made]
    submitted(place, 9)
    place.wait(0.0)
    assert len(made) == 3, "as many as there may be"
    place.close()
    assert all(worker.ended for worker in made)
    assert place.busy == 0
    place.close()
    assert LocalProcesses(0).capacity == 1


def test_with_a_start_the_first_worker_starts_alone(made: list[FakeWorker]) -> None:
    """It may compile kernels for all."""
    start = (abs, -1)
    place = LocalProcesses(3, start=start)
    submitted(place, 3)
    for _ in range(2):
        place.wait(0.0)
        assert [worker.start for worker in made] == [start]
    made[0].answer("ready")
    place.wait(0.0)
    assert [worker.start for worker in made] == [start] * 3
    place.close()


def test_workers_get_gpus_in_turn_and_threads(made: list[FakeWorker], monkeypatch: pytest.MonkeyPatch) -> None:
    for name in THREADS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MKL_NUM_THREADS", "9")
    place = LocalProcesses(3, gpus=["4", "6"], threads=5)
    submitted(place, 3)
    place.wait(0.0)
    assert [worker.environment["CUDA_VISIBLE_DEVICES"] for worker in made] == ["4", "6", "4"]
    assert [made[0].environment[name] for name in THREADS] == ["5", "5", "9"]
    place.close()
    made.clear()
    place = LocalProcesses(1)
    submitted(place, 1)
    place.wait(0.0)
    assert made[0].environment == {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "9"}
    place.close()
    made.clear()
    monkeypatch.delenv("MKL_NUM_THREADS")
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # said of OpenMP, meant of all
    place = LocalProcesses(1, threads=5)
    submitted(place, 1)
    place.wait(0.0)
    assert [made[0].environment[name] for name in THREADS] == ["2", "2", "2"]
    place.close()


def test_what_cannot_be_sent_is_told_at_once(made: list[FakeWorker], monkeypatch: pytest.MonkeyPatch) -> None:
    place = LocalProcesses(1)
    (task,) = submitted(place, 1)
    place.wait(0.0)
    made[0].cannot_send = True
    made[0].answer("ready")
    assert place.wait(0.0) == []
    assert place.busy == 1
    pauses = []

    def wait(answers: list[Any], pause: float) -> list[Any]:
        pauses.append(pause)
        return []

    monkeypatch.setattr(local, "wait", wait)
    (outcome,) = place.wait(9.0)
    assert (outcome.task, outcome.reason) == (task, "not sent")
    assert pauses == [0.0]
    assert place.busy == 0
    place.close()


def test_it_waits_no_longer_than_it_may(made: list[FakeWorker], clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    """For an answer, for the time to look at the memory, or until somebody takes too long."""
    pauses = []

    def wait(answers: list[Any], pause: float) -> list[Any]:
        assert answers == [worker.answers for worker in made if not worker.ended]
        pauses.append(pause)
        return []

    monkeypatch.setattr(local, "wait", wait)
    place = LocalProcesses(2)
    place.wait(0.125)
    place.wait(9.0)
    submitted(place, 2)
    place.wait(9.0)
    one, two = made
    one.ready = two.ready = True
    one.deadline, two.deadline = clock.now + 0.0625, clock.now + 7.0
    place.wait(9.0)
    clock.now += 0.0625
    assert place.wait(9.0) == [], "just in time"
    clock.now += 0.0625
    (outcome,) = place.wait(9.0)
    assert outcome.status == "timeout"
    assert (one.ended, two.ended) == (True, False)
    assert pauses == [0.125, 0.2, 0.2, 0.0625, 0.0, 0.0]
    place.close()


@pytest.mark.parametrize("how", ["its process has ended", "it says so"])
def test_a_worker_that_has_crashed_is_replaced(made: list[FakeWorker], how: str) -> None:
    place = LocalProcesses(1)
    one, two = submitted(place, 2)
    place.wait(0.0)
    made[0].answer("ready")
    place.wait(0.0)
    if how == "it says so":
        made[0].answer("crashed")
    else:
        made[0].answer("ok")
        made[0].process.poll = lambda: 3
    (outcome,) = place.wait(0.0)
    assert outcome.task is one
    assert made[0].ended
    assert len(made) == 2, "at once"
    made[1].answer("ready")
    place.wait(0.0)
    assert made[1].task is two
    made[1].answer("failed")
    (outcome,) = place.wait(0.0)
    assert outcome.task is two
    assert not made[1].ended, "it can go on"
    place.close()


def at_work(made: list[FakeWorker], *held: int) -> LocalProcesses:
    """A worker for each amount of memory, all of them busy."""
    place = LocalProcesses(len(held))
    submitted(place, len(held))
    place.wait(0.0)
    for worker, memory in zip(made, held, strict=True):
        worker.answer("ready")
        worker.held = memory
    place.wait(0.0)
    assert place.busy == len(held)
    return place


def test_a_worker_may_hold_what_its_limit_says(
    made: list[FakeWorker], clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = at_work(made, 2 * GIB, 5 * GIB // 2, GIB)
    clock.now += 1.0
    assert place.wait(0.0) == [], "without a limit"
    monkeypatch.setenv(WORKER_MEMORY, str(2 * GIB))
    clock.now += 0.1
    assert place.wait(0.0) == [], "it looks five times a second"
    clock.now += 0.11
    (outcome,) = place.wait(0.0)
    assert outcome.status == "crashed"
    assert outcome.reason == "out of memory: it held 2.5 GiB, its limit is 2.0"
    assert [worker.ended for worker in made] == [False, True, False]
    made[0].held = 3 * GIB
    made[0].answer("ok")
    clock.now += 0.3
    assert [outcome.status for outcome in place.wait(0.0)] == ["ok"], "what it holds without a task does not count"
    place.close()


def test_the_largest_worker_ends_before_the_machine_has_no_memory_left(
    made: list[FakeWorker], clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = 4 * GIB
    total = 100 * GIB
    monkeypatch.setattr(local, "available_memory", lambda: (total, left))
    monkeypatch.setenv(WORKER_MEMORY, str(90 * GIB))
    place = at_work(made, 2 * GIB, 5 * GIB // 2, GIB)
    clock.now += 1.0
    assert place.wait(0.0) == []
    clock.now += 9.0
    assert place.wait(0.0) == [], "a twenty-fifth is enough"
    left -= 1
    clock.now += 2.0
    assert place.wait(0.0) == [], "it may come back"
    clock.now += 0.25
    (outcome,) = place.wait(0.0)
    assert outcome.reason == "out of memory: it held 2.5 GiB, the machine has none left"
    assert [worker.ended for worker in made] == [False, True, False]
    clock.now += 2.0
    assert place.wait(0.0) == [], "what it held is free only after a while"
    total += 1
    clock.now += 0.25
    assert place.wait(0.0) == [], "a machine that has grown"
    clock.now += 2.25
    (outcome,) = place.wait(0.0)
    assert outcome.reason == "out of memory: it held 2.0 GiB, the machine has none left"
    place.close()


def test_one_that_is_over_its_limit_is_enough(
    made: list[FakeWorker], clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = 0
    monkeypatch.setattr(local, "available_memory", lambda: (100 * GIB, left))
    place = at_work(made, 2 * GIB, 3 * GIB)
    left = 50 * GIB
    clock.now += 1.0
    assert place.wait(0.0) == []
    left = 0
    made[0].held, made[1].held = 5 * GIB, 4 * GIB
    monkeypatch.setenv(WORKER_MEMORY, str(4 * GIB))
    clock.now += 3.0
    assert [outcome.reason for outcome in place.wait(0.0)] == ["out of memory: it held 5.0 GiB, its limit is 4.0"]
    assert not made[1].ended
    clock.now += 0.25
    (outcome,) = place.wait(0.0)
    assert outcome.reason == "out of memory: it held 4.0 GiB, the machine has none left"
    clock.now += 3.0
    assert place.wait(0.0) == [], "nobody is left to end"
    place.close()


# memory of the machine


@pytest.fixture
def machine_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Writes what the kernel says of the memory."""
    monkeypatch.setattr(local, "Path", lambda path: tmp_path / path.lstrip("/"))

    def write(**files: str) -> None:
        for name, text in files.items():
            path = tmp_path / ("proc/meminfo" if name == "meminfo" else f"sys/fs/cgroup/memory.{name}")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    return write


MEMINFO = "MemTotal:   1000 kB\nMemFree:  100 kB\nMemAvailable:  600 kB\n"


def test_memory_that_cannot_be_told_is_none(machine_files: Callable[..., None]) -> None:
    assert available_memory() == (0, 0)
    for text in ("MemTotal: 1000 kB\n", "MemTotal: many kB\nMemAvailable: 1 kB\n", "nothing\n"):
        machine_files(meminfo=text)
        assert available_memory() == (0, 0)


def test_memory_of_the_machine_and_of_the_container(machine_files: Callable[..., None]) -> None:
    machine_files(meminfo=MEMINFO)
    assert available_memory() == (1000 << 10, 600 << 10)
    machine_files(max="max\n")
    assert available_memory() == (1000 << 10, 600 << 10), "the container has no limit"
    machine_files(max="500000\n", current="300000\n", stat="anon 5\ninactive_file 100000\n")
    assert available_memory() == (500000, 300000), "files that are kept in memory for nothing count as free"
    machine_files(max=str(1 << 40), current="300000\n", stat="anon 5\n")
    assert available_memory() == (1000 << 10, 600 << 10), "no more than the machine has"
    machine_files(max="500000\n", current="300000\n", stat="anon 5\n")
    assert available_memory() == (500000, 200000)


# this very process


def refuse(number: int) -> int:
    """A user's mistake for numbers below 0."""
    if number < 0:
        raise ConfigError(f"{number} is below 0")
    return number


def test_tasks_in_this_very_process(clock: Clock) -> None:
    began: list[int] = []

    def take(seconds: float) -> None:
        clock.now += seconds

    place = ThisProcess((began.append, 1))
    assert (place.capacity, place.busy) == (1, 0)
    tasks = [Task(refuse, 2), Task(refuse, -1), Task(take, 3.0)]
    for task in tasks:
        place.submit(task)
    assert place.busy == 3
    assert began == [], "not before its first task"
    good, bad, slow = place.wait(1.0)
    assert (good.task, good.status, good.value, good.seconds) == (tasks[0], "ok", 2, 0.0)
    assert (bad.task, bad.status, bad.value, bad.reason) == (tasks[1], "failed", None, "-1 is below 0")
    assert isinstance(bad.error, ConfigError)
    assert bad.seconds == 0.0
    assert slow.seconds == 3.0
    assert place.busy == 0
    place.submit(tasks[0])
    place.wait(1.0)
    assert began == [1], "once"
    place.submit(tasks[0])
    place.close()
    assert place.busy == 0

"""The child process: what it makes of its orders, and when it ends."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ssad.core.errors import ConfigError
from ssad.engine import worker
from ssad.engine.local import Worker
from ssad.engine.task import Task, TaskOutcome


def begin(path: Path) -> None:
    """What a worker does first."""
    path.touch()


def do(what: str) -> Any:
    """What `what` says."""
    if what == "leave":
        sys.exit("I go")
    if what == "mistake":
        raise ConfigError("my own mistake")
    if what == "error":
        raise ValueError("two\nlines")
    if what == "no result":
        return lambda: None
    if what == "print":
        os.write(1, b"to standard output\n")
        print("and so")
    if what == "death":
        number = ctypes.c_int()
        ctypes.CDLL(None).prctl(2, ctypes.byref(number))  # PR_GET_PDEATHSIG
        return number.value
    return sys.path if what == "path" else what


def work(process: Worker, what: Any) -> TaskOutcome:
    """How a task ended."""
    assert process.start_task(Task(do, what)) is None
    outcome = process.read_answer()
    assert outcome is not None
    return outcome


@pytest.fixture(scope="module")
def process() -> Any:
    """A worker that is ready."""
    one = Worker(None, {})
    one.read_answer()
    yield one
    one.kill()


@pytest.mark.parametrize(
    ("what", "status", "reason", "error"),
    [
        ("anything", "ok", "", None),
        ("print", "ok", "", None),
        ("mistake", "failed", "my own mistake", ConfigError),
        ("error", "failed", "ValueError: two lines (", None),
        ("leave", "failed", "SystemExit: I go (", None),
        ("no result", "failed", "the result cannot be handed over: ", None),
    ],
)
def test_what_a_task_does_is_told(
    process: Worker, what: str, status: str, reason: str, error: type[Exception] | None
) -> None:
    outcome = work(process, what)
    assert (outcome.status, outcome.value) == (status, what if status == "ok" else None)
    assert outcome.reason.startswith(reason)
    assert bool(outcome.reason) == bool(reason)
    assert type(outcome.error) is (error or type(None))


def test_it_imports_what_its_parent_imports_without_doubles(process: Worker) -> None:
    path = work(process, "path").value
    here = [entry or os.getcwd() for entry in sys.path]
    assert path[: len(set(here))] == list(dict.fromkeys(here))
    assert len(path) == len(set(path))


def test_ctrl_c_is_for_the_parent(process: Worker) -> None:
    process.process.send_signal(signal.SIGINT)
    assert work(process, "go on").value == "go on"


def test_what_cannot_be_imported_there_is_told(process: Worker, monkeypatch: pytest.MonkeyPatch) -> None:
    module = SimpleNamespace(__name__="only_here")
    monkeypatch.setitem(sys.modules, "only_here", module)

    class Thing:
        """Known here alone."""

    Thing.__module__, Thing.__qualname__ = "only_here", "Thing"
    module.Thing = Thing
    outcome = work(process, Thing())
    assert outcome.status == "failed"
    assert outcome.reason.startswith("ImportError: ModuleNotFoundError: No module named 'only_here'")


def test_it_begins_with_the_start(tmp_path: Path) -> None:
    one = Worker((begin, tmp_path / "begun"), {})
    assert one.read_answer() is None
    assert one.ready
    assert (tmp_path / "begun").exists()
    one.kill()


@pytest.mark.parametrize(
    ("what", "message"), [("mistake", "^my own mistake$"), ("error", r"^ValueError: two lines \(.*:\d+\)$")]
)
def test_a_start_that_fails_is_told_and_ends_it(what: str, message: str) -> None:
    one = Worker((do, what), {})
    with pytest.raises(Exception, match=message):
        one.read_answer()
    assert one.process.wait() == 0
    one.kill()


def test_it_ends_with_its_input() -> None:
    one = Worker(None, {})
    one.read_answer()
    one._requests.close()
    assert one.process.wait() == 0
    one.kill()


def test_it_ends_with_its_input_even_at_work() -> None:
    one = Worker(None, {})
    one.read_answer()
    assert one.start_task(Task(signal.sigwait, [signal.SIGUSR1])) is None
    one._requests.close()
    assert one.process.wait() == 0
    one.kill()


def test_the_kernel_is_asked_to_end_it_with_its_parent(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(ctypes, "CDLL", lambda name: SimpleNamespace(prctl=lambda *words: asked.append((name, *words))))
    worker._die_with_parent()
    assert asked == [(None, 1, signal.SIGKILL)], "PR_SET_PDEATHSIG"

    def absent(name: None) -> None:
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", absent)
    worker._die_with_parent()


@pytest.mark.skipif(sys.platform != "linux", reason="of Linux")
def test_the_kernel_ends_it_with_its_parent(process: Worker) -> None:
    assert work(process, "death").value == signal.SIGKILL


def test_it_takes_its_descriptors_from_the_command_line() -> None:
    theirs, orders = os.pipe()
    answers, theirs_too = os.pipe()
    command = [sys.executable, "-m", "ssad.engine.worker", str(theirs), str(theirs_too)]
    with subprocess.Popen(command, pass_fds=(theirs, theirs_too)) as one:
        os.close(theirs)
        os.close(theirs_too)
        with Connection(orders) as give, Connection(answers) as hear:
            give.send(([], False))
            assert hear.recv() == ("ready", None)
            give.send((abs, -3))
            assert hear.recv() == ("value", 3)
    assert one.returncode == 0

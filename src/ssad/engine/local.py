"""Tasks in processes of this machine: a task that raises, hangs, dies or eats the memory costs only itself."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from ssad.core.errors import SSADError
from ssad.core.registry import describe
from ssad.engine.task import Outcome, Status, Task

START_S = 600.0  # a worker may compile kernels when it starts
SCARCE = 0.04  # share of the memory: with less left
SCARCE_S = 2.0  # for so many seconds, the largest worker ends
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # environment variables
WORKER_MEMORY = "SSAD_WORKER_MEMORY"  # environment variable: bytes that a worker may hold
LOOK_S = 0.2  # from one look at the memory to the next

Start = tuple[Callable[[Any], None], Any]


class Worker:
    """One child process. It is started at once; what it does first may take long (`ready`)."""

    def __init__(self, start: Start | None, environment: Mapping[str, str]) -> None:
        theirs, orders = os.pipe()
        answers, theirs_too = os.pipe()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  closed by end
        self.process = subprocess.Popen(
            [sys.executable, "-m", "ssad.engine.worker", str(theirs), str(theirs_too)],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            pass_fds=(theirs, theirs_too),
            start_new_session=True,  # Ctrl-C reaches this process only
            env={**os.environ, **environment},
        )
        os.close(theirs)
        os.close(theirs_too)
        self.answers = Connection(answers)
        self._orders = Connection(orders)
        self.ready = False
        self.task: Task | None = None
        self.began = time.monotonic()
        self._send(([p or os.getcwd() for p in sys.path], start is not None))
        if start is not None:
            self._send(start)

    @property
    def deadline(self) -> float:
        """When what it does now has taken too long."""
        if not self.ready:
            return self.began + START_S
        return self.began + self.task.timeout_s if self.task is not None else float("inf")

    def _send(self, message: Any) -> None:
        with contextlib.suppress(OSError):  # if it is dead, the end of its answers says so
            self._orders.send(message)

    def give(self, task: Task) -> Outcome | None:
        """Begin a task; an outcome when it cannot even be sent."""
        self.task, self.began = task, time.monotonic()
        try:
            self._send((task.function, task.argument))
        except Exception as error:  # whatever pickling raises
            return self.outcome("failed", f"the task cannot be handed over: {describe(error)}")
        return None

    def outcome(
        self, status: Status, reason: str = "", *, value: Any = None, error: Exception | None = None
    ) -> Outcome:
        """How its task ended; it has none afterwards."""
        assert self.task is not None
        task, self.task = self.task, None
        return Outcome(task, status, value, reason, error, time.monotonic() - self.began)

    def hear(self) -> Outcome | None:
        """An answer: that it has started, or the outcome of its task.

        Raises:
            SSADError: It cannot start.
        """
        try:
            kind, value = self.answers.recv()
        except (EOFError, OSError):
            if not self.ready:
                raise SSADError(f"a worker process cannot start: {self.how_it_ended()}") from None
            return self.outcome("crashed", self.how_it_ended()) if self.task is not None else None
        if kind == "fatal":
            raise SSADError(value)
        if kind == "ready":
            self.ready = True
            return None
        if kind == "value":
            return self.outcome("ok", value=value)
        return self.outcome("failed", str(value), error=value if isinstance(value, SSADError) else None)

    def overdue(self) -> Outcome:
        """The outcome of a task that took too long.

        Raises:
            SSADError: It was the start that took too long.
        """
        if not self.ready:
            raise SSADError(f"a worker process did not start within {START_S:.0f} s: {self._last_words()}")
        assert self.task is not None
        return self.outcome("timeout", f"took longer than {self.task.timeout_s:g} s")

    def memory(self) -> int:
        """Bytes that it holds; 0 where that cannot be told."""
        try:
            return int(Path(f"/proc/{self.process.pid}/statm").read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except (OSError, IndexError, ValueError):
            return 0

    def _last_words(self) -> str:
        """The last line it wrote to standard error."""
        size = self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, size - 4096))
        lines = [line.strip() for line in self._log.read().decode(errors="replace").splitlines()]
        return next((line for line in reversed(lines) if line), "")[:300]

    def how_it_ended(self) -> str:
        """Wait for the process, and say how it ended.

        Returns:
            Text such as "the process ended (killed by SIGSEGV)" or "the process ended (exit code 3)", with its last
            words.
        """
        code = self.process.wait()
        try:
            text = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        except ValueError:
            text = f"killed by signal {-code}"
        words = self._last_words()
        return f"the process ended ({text}){f': {words}' if words else ''}"

    def end(self) -> None:
        """End the process and forget it."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for connection in (self.answers, self._orders):
            with contextlib.suppress(OSError):
                connection.close()
        self._log.close()


class LocalProcesses:
    """The backend of worker processes on this machine.

    Args:
        workers: how many.
        start: a function and its argument, called once in each worker before its first task; its time does not count
            as a task's. With one the first worker starts alone, since it may compile kernels for all.
        gpus: the workers see one of these each, in turn, as `CUDA_VISIBLE_DEVICES` names them; none: left as it is.
        threads: of linear algebra in each worker, unless the user's environment says otherwise; what it says of
            OpenMP alone holds for all.
    """

    def __init__(self, workers: int, *, start: Start | None = None, gpus: Sequence[str] = (), threads: int = 1) -> None:
        self.capacity = max(1, workers)
        self._start, self._gpus, self._threads = start, tuple(gpus), threads
        self._workers: list[Worker] = []
        self._waiting: list[Task] = []
        self._unsent: list[Outcome] = []
        self._started = 0
        self._looked = time.monotonic()
        self._plenty = (0, time.monotonic())  # memory of the machine, and when there was enough of it

    @property
    def busy(self) -> int:
        """How many tasks it has now."""
        return len(self._waiting) + len(self._unsent) + sum(worker.task is not None for worker in self._workers)

    def submit(self, task: Task) -> None:
        """Take a task; only while `busy` is below `capacity`."""
        self._waiting.append(task)

    def wait(self, seconds: float) -> list[Outcome]:
        """See `Backend`.

        Raises:
            SSADError: No worker can start.
        """
        self._hand_out()
        found, self._unsent = self._unsent, []
        pause = min([seconds, LOOK_S, *(max(0.0, w.deadline - time.monotonic()) for w in self._workers)])
        for answers in wait([w.answers for w in self._workers], 0.0 if found else pause):
            worker = next(w for w in self._workers if w.answers is answers)
            outcome = worker.hear()
            if outcome is not None:
                found.append(outcome)
            if worker.process.poll() is not None or (outcome is not None and outcome.status == "crashed"):
                self._remove(worker)
        now = time.monotonic()
        for worker in [w for w in self._workers if now > w.deadline]:
            found.append(worker.overdue())
            self._remove(worker)
        if now - self._looked > LOOK_S:
            self._looked = now
            found += self._guard_memory()
        self._hand_out()
        return found

    def _hand_out(self) -> None:
        """Tasks to workers that are ready; starts workers where there are more tasks than those."""
        for worker in self._workers:
            if worker.ready and worker.task is None and self._waiting:
                unsent = worker.give(self._waiting.pop(0))
                if unsent is not None:
                    self._unsent.append(unsent)
        idle = sum(worker.task is None for worker in self._workers)
        while len(self._workers) < self.capacity and idle < len(self._waiting):
            if self._start is not None and self._workers and not any(worker.ready for worker in self._workers):
                return  # the first one starts alone
            wanted = os.environ.get("OMP_NUM_THREADS", str(self._threads))  # PyTorch asks MKL before OpenMP
            environment = {name: os.environ.get(name, wanted) for name in THREADS}
            if self._gpus:
                environment["CUDA_VISIBLE_DEVICES"] = self._gpus[self._started % len(self._gpus)]
            self._workers.append(Worker(self._start, environment))
            self._started += 1
            idle += 1

    def _guard_memory(self) -> list[Outcome]:
        """Ends a worker that holds more than it may, and the largest one before the machine runs out of memory."""
        working = [(worker.memory(), worker) for worker in self._workers if worker.task is not None]
        limit = int(os.environ.get(WORKER_MEMORY) or 0)
        too_large = [(held, w) for held, w in working if limit and held > limit]
        total, left = memory_left()
        now = time.monotonic()
        if left >= SCARCE * total or total != self._plenty[0]:  # a virtual machine may grow with its use
            self._plenty = total, now
        elif working and not too_large and now - self._plenty[1] > SCARCE_S:
            too_large = [max(working, key=lambda pair: pair[0])]
            self._plenty = total, now
        found = []
        for held, worker in too_large:
            why = f"its limit is {limit / 2**30:.1f}" if limit and held > limit else "the machine has none left"
            found.append(worker.outcome("crashed", f"out of memory: it held {held / 2**30:.1f} GiB, {why}"))
            self._remove(worker)
        return found

    def _remove(self, worker: Worker) -> None:
        self._workers.remove(worker)
        worker.end()

    def close(self) -> None:
        """End all that runs."""
        for worker in self._workers:
            worker.end()
        self._workers, self._waiting = [], []


def memory_left() -> tuple[int, int]:
    """Memory of this machine, or of the container that this process runs in.

    Returns:
        Total memory and the part that is free to use, bytes; (0, 0) where that is unknown.
    """
    try:
        rows = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        total, free = (int(rows[name].split()[0]) * 1024 for name in ("MemTotal", "MemAvailable"))
    except (OSError, KeyError, ValueError):
        return 0, 0
    group = Path("/sys/fs/cgroup")
    with contextlib.suppress(OSError, ValueError):
        limit = int((group / "memory.max").read_text())
        rows = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        used = int((group / "memory.current").read_text()) - int(rows.get("inactive_file", 0))
        return min(total, limit), min(free, limit - used)
    return total, free


class ThisProcess:
    """The backend that does each task here and now, without isolation or time-outs: for debugging and tests."""

    capacity = 1

    def __init__(self, start: Start | None = None) -> None:
        self._start = start
        self._waiting: list[Task] = []

    @property
    def busy(self) -> int:
        """How many tasks it has now."""
        return len(self._waiting)

    def submit(self, task: Task) -> None:
        """Take a task."""
        self._waiting.append(task)

    def wait(self, seconds: float) -> list[Outcome]:
        """Do what there is."""
        if self._start is not None:
            self._start[0](self._start[1])
            self._start = None
        found = []
        while self._waiting:
            task, began = self._waiting.pop(0), time.monotonic()
            try:
                value = task.function(task.argument)
            except SSADError as error:
                found.append(Outcome(task, "failed", None, str(error), error, time.monotonic() - began))
                continue
            found.append(Outcome(task, "ok", value, seconds=time.monotonic() - began))
        return found

    def close(self) -> None:
        """Forget what was not done."""
        self._waiting = []

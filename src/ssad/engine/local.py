"""Tasks in processes of this machine: a task that raises, hangs, dies or exhausts the memory fails alone."""

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
from ssad.engine.task import Status, Task, TaskOutcome

START_S = 600.0  # a worker may compile kernels when it starts
SCARCE = 0.04  # share of the memory; if less remains
SCARCE_S = 2.0  # for this time, the largest worker is killed
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # environment variables
WORKER_MEMORY = "SSAD_WORKER_MEMORY"  # environment variable: memory limit of a worker, bytes
LOOK_S = 0.2  # interval between checks of the memory

Start = tuple[Callable[[Any], None], Any]


class Worker:
    """A child process. It is started at once; its own start-up may take long (see `ready`)."""

    def __init__(self, start: Start | None, environment: Mapping[str, str]) -> None:
        child_input, request_pipe = os.pipe()
        answer_pipe, child_output = os.pipe()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  closed by end
        self.process = subprocess.Popen(
            [sys.executable, "-m", "ssad.engine.worker", str(child_input), str(child_output)],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            pass_fds=(child_input, child_output),
            start_new_session=True,  # Ctrl-C reaches this process only
            env={**os.environ, **environment},
        )
        # Only the child may hold its ends: the end of its answers then shows that it died.
        os.close(child_input)
        os.close(child_output)
        self.answers = Connection(answer_pipe)
        self._requests = Connection(request_pipe)
        self.ready = False
        self.task: Task | None = None
        self.began = time.monotonic()
        # The child unpickles functions by import, so it needs the import path first.
        self._send(([entry or os.getcwd() for entry in sys.path], start is not None))
        if start is not None:
            self._send(start)

    @property
    def deadline(self) -> float:
        """Time (monotonic clock) at which the current start or task times out."""
        if not self.ready:
            return self.began + START_S
        return self.began + self.task.timeout_s if self.task is not None else float("inf")

    def _send(self, message: Any) -> None:
        with contextlib.suppress(OSError):  # a dead worker is noticed by the end of its answers
            self._requests.send(message)

    def start_task(self, task: Task) -> TaskOutcome | None:
        """Start a task; return an outcome if the task cannot even be sent."""
        self.task, self.began = task, time.monotonic()
        try:
            self._send((task.function, task.argument))
        except Exception as error:  # pickling can raise any exception
            return self.outcome("failed", f"the task cannot be handed over: {describe(error)}")
        return None

    def outcome(
        self, status: Status, reason: str = "", *, value: Any = None, error: Exception | None = None
    ) -> TaskOutcome:
        """Return the outcome of the current task, and clear the task."""
        assert self.task is not None
        task, self.task = self.task, None
        return TaskOutcome(task, status, value, reason, error, time.monotonic() - self.began)

    def read_answer(self) -> TaskOutcome | None:
        """Read an answer: the worker is ready, or its task has an outcome.

        Returns:
            The outcome; None if the worker has only started.

        Raises:
            SSADError: The worker cannot start.
        """
        try:
            kind, value = self.answers.recv()
        except (EOFError, OSError):
            if not self.ready:
                raise SSADError(f"a worker process cannot start: {self.describe_exit()}") from None
            return self.outcome("crashed", self.describe_exit()) if self.task is not None else None
        if kind == "fatal":
            raise SSADError(value)
        if kind == "ready":
            self.ready = True
            return None
        if kind == "value":
            return self.outcome("ok", value=value)
        return self.outcome("failed", str(value), error=value if isinstance(value, SSADError) else None)

    def time_out(self) -> TaskOutcome:
        """Return the outcome of a task that timed out.

        Raises:
            SSADError: The start of the worker timed out.
        """
        if not self.ready:
            raise SSADError(f"a worker process did not start within {START_S:.0f} s: {self._last_output_line()}")
        assert self.task is not None
        return self.outcome("timeout", f"took longer than {self.task.timeout_s:g} s")

    def resident_bytes(self) -> int:
        """Resident memory of the process, bytes; 0 where it is unknown."""
        try:
            return int(Path(f"/proc/{self.process.pid}/statm").read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except (OSError, IndexError, ValueError):
            return 0

    def _last_output_line(self) -> str:
        """Return the last line of the process's output."""
        log_size = self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, log_size - 4096))
        lines = [line.strip() for line in self._log.read().decode(errors="replace").splitlines()]
        return next((line for line in reversed(lines) if line), "")[:300]

    def describe_exit(self) -> str:
        """Wait for the process to end and describe its exit.

        Returns:
            Text such as "the process ended (killed by SIGSEGV)" or "the process ended (exit code 3)", followed by
            the last line of its output.
        """
        exit_code = self.process.wait()
        try:
            cause = f"killed by {signal.Signals(-exit_code).name}" if exit_code < 0 else f"exit code {exit_code}"
        except ValueError:
            cause = f"killed by signal {-exit_code}"
        last_line = self._last_output_line()
        return f"the process ended ({cause}){f': {last_line}' if last_line else ''}"

    def kill(self) -> None:
        """Kill the process and release its resources."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for connection in (self.answers, self._requests):
            with contextlib.suppress(OSError):
                connection.close()
        self._log.close()


class LocalProcesses:
    """Backend of worker processes on this machine.

    Args:
        workers: Number of workers.
        start: A function and its argument, called once in each worker before its first task; its time does not
            count as a task's. With a start the first worker starts alone, since it may compile kernels for all.
        gpus: Each worker sees one of these, in turn, as `CUDA_VISIBLE_DEVICES` names them; none: the variable
            is left as it is.
        threads: Threads of linear algebra in each worker, unless the user's environment sets another number; a
            value for OpenMP alone applies to all libraries.
    """

    def __init__(self, workers: int, *, start: Start | None = None, gpus: Sequence[str] = (), threads: int = 1) -> None:
        self.capacity = max(1, workers)
        self._start, self._gpus, self._threads = start, tuple(gpus), threads
        self._workers: list[Worker] = []
        self._waiting: list[Task] = []
        self._failed_outcomes: list[TaskOutcome] = []
        self._started_count = 0
        self._last_check_time = time.monotonic()
        self._last_ample_memory = (0, time.monotonic())  # total memory, and the last time at which enough was free

    @property
    def busy(self) -> int:
        """Number of submitted tasks without an outcome."""
        return (
            len(self._waiting) + len(self._failed_outcomes) + sum(worker.task is not None for worker in self._workers)
        )

    def submit(self, task: Task) -> None:
        """Submit a task; call only while `busy` is below `capacity`."""
        self._waiting.append(task)

    def wait(self, seconds: float) -> list[TaskOutcome]:
        """Return the outcomes of finished tasks, after at most `seconds`.

        Raises:
            SSADError: No worker can start.
        """
        self._assign_tasks()
        outcomes, self._failed_outcomes = self._failed_outcomes, []
        wait_seconds = min(
            [seconds, LOOK_S, *(max(0.0, candidate.deadline - time.monotonic()) for candidate in self._workers)]
        )
        for connection in wait([candidate.answers for candidate in self._workers], 0.0 if outcomes else wait_seconds):
            worker = next(candidate for candidate in self._workers if candidate.answers is connection)
            outcome = worker.read_answer()
            if outcome is not None:
                outcomes.append(outcome)
            if worker.process.poll() is not None or (outcome is not None and outcome.status == "crashed"):
                self._remove(worker)
        current_time = time.monotonic()
        for worker in [candidate for candidate in self._workers if current_time > candidate.deadline]:
            outcomes.append(worker.time_out())
            self._remove(worker)
        if current_time - self._last_check_time > LOOK_S:
            self._last_check_time = current_time
            outcomes += self._guard_memory()
        self._assign_tasks()
        return outcomes

    def _assign_tasks(self) -> None:
        """Assign tasks to idle workers, and start workers while tasks outnumber them."""
        for worker in self._workers:
            if worker.ready and worker.task is None and self._waiting:
                failed_outcome = worker.start_task(self._waiting.pop(0))
                if failed_outcome is not None:
                    self._failed_outcomes.append(failed_outcome)
        idle = sum(worker.task is None for worker in self._workers)
        while len(self._workers) < self.capacity and idle < len(self._waiting):
            if self._start is not None and self._workers and not any(worker.ready for worker in self._workers):
                return  # the first worker starts alone: it may compile kernels for all
            thread_count = os.environ.get("OMP_NUM_THREADS", str(self._threads))  # PyTorch asks MKL before OpenMP
            environment = {name: os.environ.get(name, thread_count) for name in THREADS}
            if self._gpus:
                environment["CUDA_VISIBLE_DEVICES"] = self._gpus[self._started_count % len(self._gpus)]
            self._workers.append(Worker(self._start, environment))
            self._started_count += 1
            idle += 1

    def _guard_memory(self) -> list[TaskOutcome]:
        """Kill workers above the memory limit, and the largest worker before the machine runs out of memory."""
        workers_by_memory = [(worker.resident_bytes(), worker) for worker in self._workers if worker.task is not None]
        memory_limit = int(os.environ.get(WORKER_MEMORY) or 0)
        too_large = [
            (memory, candidate) for memory, candidate in workers_by_memory if memory_limit and memory > memory_limit
        ]
        total_memory, free_memory = available_memory()
        current_time = time.monotonic()
        if (
            free_memory >= SCARCE * total_memory or total_memory != self._last_ample_memory[0]
        ):  # a virtual machine may grow with its use
            self._last_ample_memory = total_memory, current_time
        # A short dip does not kill: the shortage must last. One worker is killed at a time.
        elif workers_by_memory and not too_large and current_time - self._last_ample_memory[1] > SCARCE_S:
            too_large = [max(workers_by_memory, key=lambda entry: entry[0])]
            self._last_ample_memory = total_memory, current_time
        outcomes = []
        for memory, worker in too_large:
            cause = (
                f"its limit is {memory_limit / 2**30:.1f}"
                if memory_limit and memory > memory_limit
                else "the machine has none left"
            )
            outcomes.append(worker.outcome("crashed", f"out of memory: it held {memory / 2**30:.1f} GiB, {cause}"))
            self._remove(worker)
        return outcomes

    def _remove(self, worker: Worker) -> None:
        self._workers.remove(worker)
        worker.kill()

    def close(self) -> None:
        """Kill all workers."""
        for worker in self._workers:
            worker.kill()
        self._workers, self._waiting = [], []


def available_memory() -> tuple[int, int]:
    """Return the memory of this machine, or of the container that this process runs in.

    Returns:
        Total and available memory, bytes; (0, 0) where that is unknown.
    """
    try:
        fields = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        total_memory, available = (int(fields[name].split()[0]) * 1024 for name in ("MemTotal", "MemAvailable"))
    except (OSError, KeyError, ValueError):
        return 0, 0
    cgroup = Path("/sys/fs/cgroup")
    with contextlib.suppress(OSError, ValueError):
        memory_limit = int((cgroup / "memory.max").read_text())
        fields = dict(line.split() for line in (cgroup / "memory.stat").read_text().splitlines())
        # The kernel can reclaim inactive file pages at any time, so they count as free.
        used_memory = int((cgroup / "memory.current").read_text()) - int(fields.get("inactive_file", 0))
        return min(total_memory, memory_limit), min(available, memory_limit - used_memory)
    return total_memory, available


class ThisProcess:
    """Backend that runs tasks in the calling process, without isolation or time-outs: for debugging and tests."""

    capacity = 1

    def __init__(self, start: Start | None = None) -> None:
        self._start = start
        self._waiting: list[Task] = []

    @property
    def busy(self) -> int:
        """Number of submitted tasks without an outcome."""
        return len(self._waiting)

    def submit(self, task: Task) -> None:
        """Submit a task."""
        self._waiting.append(task)

    def wait(self, seconds: float) -> list[TaskOutcome]:
        """Run all submitted tasks."""
        if self._start is not None:
            self._start[0](self._start[1])
            self._start = None
        outcomes = []
        while self._waiting:
            task, started_at = self._waiting.pop(0), time.monotonic()
            try:
                value = task.function(task.argument)
            except SSADError as error:
                outcomes.append(TaskOutcome(task, "failed", None, str(error), error, time.monotonic() - started_at))
                continue
            outcomes.append(TaskOutcome(task, "ok", value, seconds=time.monotonic() - started_at))
        return outcomes

    def close(self) -> None:
        """Drop the tasks that have not run."""
        self._waiting = []

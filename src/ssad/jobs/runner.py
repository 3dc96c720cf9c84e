"""Runs cells in child processes. A cell that raises, hangs or dies costs only itself, and is recorded.

Cells run in chunks, a batch of the world each. When a chunk fails in any way it is split into single cells which are
run alone, so the fault is pinned on the cell that has it.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ssad.core.errors import SSADError

EXECUTE = "ssad.bench.execute:execute"
Cell = Any  # what is run: with a key, a system and as_dict()
START_S = 600.0  # a worker may compile kernels when it starts

Done = Callable[[Cell, Mapping[str, Any]], None]


@dataclass
class _Worker:
    """One child process and what it is doing."""

    process: subprocess.Popen[bytes]
    answers: int
    log: Any
    deadline: float
    ready: bool = False
    task: list[Cell] = field(default_factory=list)
    buffer: bytes = b""

    def kill(self) -> None:
        """End the process and forget it."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        if self.process.stdin:
            with contextlib.suppress(OSError):
                self.process.stdin.close()
        os.close(self.answers)
        self.log.close()

    def last_words(self) -> str:
        """The last line it wrote to standard error."""
        size = self.log.seek(0, os.SEEK_END)
        self.log.seek(max(0, size - 4096))
        lines = [line.strip() for line in self.log.read().decode(errors="replace").splitlines()]
        return next((line for line in reversed(lines) if line), "")[:300]

    def how_it_ended(self) -> str:
        """ "killed by SIGSEGV" or "exit code 3", with its last words."""
        code = self.process.wait()
        try:
            text = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        except ValueError:
            text = f"killed by signal {-code}"
        words = self.last_words()
        return f"the process ended ({text}){f': {words}' if words else ''}"


class Runner:
    """Runs cells and hands each finished one to `done`; see `run`."""

    def __init__(
        self,
        *,
        execute: str = EXECUTE,
        settings: Mapping[str, Any] | None = None,
        workers: int = 1,
        chunk: int = 16,
        timeout_s: float = 120.0,
    ) -> None:
        self.execute = execute
        self.settings = dict(settings or {})
        self.count = max(1, workers)
        self.chunk = chunk
        self.timeout_s = timeout_s
        self._selector = selectors.DefaultSelector()
        self._workers: list[_Worker] = []

    def run(self, cells: Sequence[Cell], done: Done, tick: Callable[[], None] = lambda: None) -> None:
        """Run all cells; `done(cell, result)` is called in this process as each one ends, in any order.

        result: status ok | failed | timeout | crashed, reason, and what the executor gave. `tick` is called several
        times a second. SSADError when the executor cannot start at all. Ctrl-C ends the children and passes.
        """
        tasks = deque(_chunks(cells, self.chunk))
        try:
            while tasks or any(w.task for w in self._workers):
                self._staff(len(tasks))
                for worker in self._workers:
                    if worker.ready and not worker.task and tasks:
                        self._give(worker, tasks.popleft(), tasks, done)
                for key, _ in self._selector.select(timeout=0.2):
                    self._hear(key.data, tasks, done)
                now = time.monotonic()
                for worker in [w for w in self._workers if (w.task or not w.ready) and now > w.deadline]:
                    self._overdue(worker, tasks, done)
                tick()
        finally:
            for worker in list(self._workers):
                self._remove(worker)

    def _staff(self, waiting: int) -> None:
        """Start workers that are needed: the first one alone, as it may compile kernels for all."""
        idle = sum(1 for w in self._workers if not w.task)
        while len(self._workers) < self.count and idle < waiting:
            if self._workers and not self._workers[0].ready:
                return
            self._workers.append(self._start())
            idle += 1

    def _start(self) -> _Worker:
        read, write = os.pipe()
        log = tempfile.TemporaryFile()  # noqa: SIM115  closed by _Worker.kill
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        process = subprocess.Popen(
            [sys.executable, "-m", "ssad.jobs.worker", str(write)],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            pass_fds=(write,),
            start_new_session=True,  # Ctrl-C reaches this process only
            env=environment,
        )
        os.close(write)
        os.set_blocking(read, False)
        worker = _Worker(process, read, log, time.monotonic() + START_S)
        self._selector.register(read, selectors.EVENT_READ, worker)
        path = [p or os.getcwd() for p in sys.path]
        self._send(worker, {"execute": self.execute, "settings": self.settings, "path": path})
        return worker

    def _send(self, worker: _Worker, message: Mapping[str, Any]) -> None:
        assert worker.process.stdin is not None
        with contextlib.suppress(OSError):  # if it is dead, the end of its answers says so
            worker.process.stdin.write(json.dumps(message).encode() + b"\n")
            worker.process.stdin.flush()

    def _give(self, worker: _Worker, task: list[Cell], tasks: deque[list[Cell]], done: Done) -> None:
        worker.task = task
        # a chunk is a batch: it may take longer than one cell, but not the sum of all
        worker.deadline = time.monotonic() + self.timeout_s * (1 if len(task) == 1 else 2)
        self._send(worker, {"cells": [cell.as_dict() for cell in task]})

    def _hear(self, worker: _Worker, tasks: deque[list[Cell]], done: Done) -> None:
        try:
            data = os.read(worker.answers, 1 << 20)
        except BlockingIOError:
            return
        if not data:
            if not worker.ready:
                raise SSADError(f"a worker process cannot start: {worker.how_it_ended()}")
            task, reason = worker.task, worker.how_it_ended()
            self._remove(worker)
            self._failed(task, "crashed", reason, tasks, done)
            return
        worker.buffer += data
        while b"\n" in worker.buffer:
            line, worker.buffer = worker.buffer.split(b"\n", 1)
            self._answer(worker, json.loads(line), tasks, done)

    def _answer(self, worker: _Worker, message: dict[str, Any], tasks: deque[list[Cell]], done: Done) -> None:
        if "fatal" in message:
            raise SSADError(message["fatal"])
        if not worker.ready:
            worker.ready = True
            return
        task, worker.task = worker.task, []
        results = message.get("results")
        if results is None:
            self._failed(task, "failed", message["error"], tasks, done)
        elif [r.get("key") for r in results] != [c.key for c in task]:
            self._failed(task, "failed", "the executor answered for other cells", tasks, done)
        else:
            for cell, result in zip(task, results, strict=True):
                done(cell, {"status": "ok", "reason": "", **result})

    def _overdue(self, worker: _Worker, tasks: deque[list[Cell]], done: Done) -> None:
        if not worker.ready:
            words = worker.last_words()
            raise SSADError(f"a worker process did not start within {START_S:.0f} s: {words}")
        task = worker.task
        self._remove(worker)
        self._failed(task, "timeout", f"took longer than {self.timeout_s:g} s", tasks, done)

    def _failed(self, task: list[Cell], status: str, reason: str, tasks: deque[list[Cell]], done: Done) -> None:
        if len(task) == 1:
            done(task[0], {"key": task[0].key, "status": status, "reason": reason})
        else:
            tasks.extendleft([cell] for cell in reversed(task))

    def _remove(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        self._selector.unregister(worker.answers)
        worker.kill()


def _chunks(cells: Sequence[Cell], size: int) -> list[list[Cell]]:
    """Batches of cells that share a system."""
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(cell.system, []).append(cell)
    return [g[i : i + size] for g in groups.values() for i in range(0, len(g), size)]
